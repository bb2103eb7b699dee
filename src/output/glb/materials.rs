//! Makes room for lightmap UVs in TEXCOORD_1 where materials already read that set.
//!
//! The set moves to a free number on the primitive and the textures of its material follow. A material that
//! is also used where nothing moves is duplicated, so that those places keep reading what they read.

use super::accessor::integer;
use super::items;
use serde_json::{Map, Value};
use std::collections::{BTreeMap, BTreeSet};

/// Mesh and primitive index in the document.
pub(super) type PrimitiveId = (usize, usize);

/// What moved.
#[derive(Debug, Default)]
pub(super) struct Moves {
    /// The new set number of what was TEXCOORD_1, per primitive.
    pub sets: BTreeMap<PrimitiveId, usize>,
    /// Number of materials that were duplicated.
    pub duplicated: usize,
}

/// A place in the document that names a material.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Use {
    primitive: PrimitiveId,
    /// Index of the mapping of KHR_materials_variants; `None` for the primitive's own material.
    variant: Option<usize>,
}

/// Decides which of the `lightmapped` primitives must move their TEXCOORD_1 and patches the materials; the
/// primitives' attributes are left to the caller.
pub(super) fn make_room(json: &mut Value, lightmapped: &BTreeSet<PrimitiveId>) -> Moves {
    let uses = uses_of_materials(json);
    let mut moves = Moves::default();
    for (&material, places) in &uses {
        if !reads_set_1(&json["materials"][material]) {
            continue;
        }
        for place in places.iter().filter(|place| lightmapped.contains(&place.primitive)) {
            let (m, p) = place.primitive;
            let attributes = &json["meshes"][m]["primitives"][p]["attributes"];
            if attributes.get("TEXCOORD_1").is_some() {
                moves.sets.insert(place.primitive, free_set(attributes));
            }
        }
    }
    for (&material, places) in &uses {
        let original = json["materials"][material].clone();
        if !reads_set_1(&original) {
            continue;
        }
        let mut by_set: BTreeMap<Option<usize>, Vec<Use>> = BTreeMap::new();
        for place in places {
            by_set.entry(moves.sets.get(&place.primitive).copied()).or_default().push(*place);
        }
        // The first group keeps the index: those that stay where they are (`None` sorts first), if any.
        for (k, (set, places)) in by_set.into_iter().enumerate() {
            let Some(set) = set else { continue };
            let mut patched = original.clone();
            retarget(&mut patched, set);
            if k == 0 {
                json["materials"][material] = patched;
            } else {
                let copy = append(&mut json["materials"], patched);
                places.iter().for_each(|place| assign(json, place, copy));
                moves.duplicated += 1;
            }
        }
    }
    moves
}

/// Where each material is used, in the order of the document.
fn uses_of_materials(json: &Value) -> BTreeMap<usize, Vec<Use>> {
    let mut uses: BTreeMap<usize, Vec<Use>> = BTreeMap::new();
    for (m, mesh) in items(json, "meshes").enumerate() {
        for (p, primitive) in items(mesh, "primitives").enumerate() {
            let mut add = |material: Option<usize>, variant| {
                if let Some(material) = material {
                    uses.entry(material).or_default().push(Use { primitive: (m, p), variant });
                }
            };
            add(integer(primitive.get("material")), None);
            let variants = &primitive["extensions"]["KHR_materials_variants"];
            for (v, mapping) in items(variants, "mappings").enumerate() {
                add(integer(mapping.get("material")), Some(v));
            }
        }
    }
    uses
}

/// Makes `place` use `material`.
fn assign(json: &mut Value, place: &Use, material: usize) {
    let (m, p) = place.primitive;
    let primitive = &mut json["meshes"][m]["primitives"][p];
    match place.variant {
        None => primitive["material"] = material.into(),
        Some(v) => primitive["extensions"]["KHR_materials_variants"]["mappings"][v]["material"] = material.into(),
    }
}

fn append(list: &mut Value, item: Value) -> usize {
    let Some(list) = list.as_array_mut() else { return 0 };
    list.push(item);
    list.len() - 1
}

/// The first unused set above 1: sets have to be numbered without gaps.
fn free_set(attributes: &Value) -> usize {
    (2..).find(|n| attributes.get(format!("TEXCOORD_{n}")).is_none()).unwrap_or(2)
}

/// True where any texture of the material, also of its extensions, reads TEXCOORD_1.
fn reads_set_1(material: &Value) -> bool {
    match material {
        Value::Object(object) => {
            let own = is_texture_info(object)
                && (integer(object.get("texCoord")) == Some(1) || integer(transform_set(object)) == Some(1));
            own || object.iter().any(|(key, value)| key != "extras" && reads_set_1(value))
        }
        _ => false,
    }
}

/// Sends all readers of TEXCOORD_1 to `set`.
fn retarget(material: &mut Value, set: usize) {
    let Value::Object(object) = material else { return };
    if is_texture_info(object) {
        if integer(object.get("texCoord")) == Some(1) {
            object["texCoord"] = set.into();
        }
        if integer(transform_set(object)) == Some(1) {
            object["extensions"]["KHR_texture_transform"]["texCoord"] = set.into();
        }
    }
    object.iter_mut().filter(|(key, _)| *key != "extras").for_each(|(_, value)| retarget(value, set));
}

/// Inside a material only texture infos have an index, those of unknown extensions included.
fn is_texture_info(object: &Map<String, Value>) -> bool {
    integer(object.get("index")).is_some()
}

/// The set by which KHR_texture_transform overrides the texture info's own.
fn transform_set(texture_info: &Map<String, Value>) -> Option<&Value> {
    texture_info.get("extensions")?.get("KHR_texture_transform")?.get("texCoord")
}
