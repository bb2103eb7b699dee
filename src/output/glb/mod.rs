//! The scene with its lightmap UVs as one GLB file.
//!
//! In: the document as it was read and unpacked, the scene and its atlas. Out: the same document with TEXCOORD_1
//! on every baked primitive, everything else untouched: the JSON is patched, not rebuilt, so that properties and
//! extensions that nobody here knows survive. Vertices are copied as raw bytes.

mod accessor;
mod container;
mod materials;
mod nodes;
mod primitive;

pub use nodes::fully_baked_lights;

use super::rects::{baked_instances, node_rects};
use super::write_atomically;
use crate::atlas::Atlas;
use crate::error::{BakeError, SceneError, Warning};
use crate::scene::Scene;
use crate::scene::gltf::Document;
use accessor::integer;
use container::{Blob, ViewSlots};
use glam::Vec2;
use primitive::{NewAccessor, Patch};
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::Path;

/// How the scene is written.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct GlbOptions {
    /// Nodes whose light (KHR_lights_punctual, EXT_lights_ies, EXT_lights_area) is in the maps and goes from the scene, so
    /// that no engine lights twice; see [`fully_baked_lights`]. Default: none.
    pub remove_baked_lights: Vec<usize>,
    /// The surroundings of the scene (EXT_lights_image_based) are in the maps and go likewise. Default: false.
    pub remove_baked_sky: bool,
}

/// What was written.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize)]
pub struct GlbInfo {
    /// Size of the file in bytes.
    pub bytes: usize,
    /// Primitives that got lightmap UVs.
    pub primitives: usize,
    /// Of these, primitives with vertices of their own because charts split them.
    pub rewritten_primitives: usize,
    /// Vertices added by splits.
    pub split_vertices: usize,
    /// Primitives whose own TEXCOORD_1 moved to another set.
    pub moved_uv_sets: usize,
    /// Materials duplicated for that.
    pub duplicated_materials: usize,
    /// Images taken into the file.
    pub embedded_images: usize,
    /// Lights removed because they are baked.
    pub removed_lights: usize,
    /// What could not be kept.
    pub warnings: Vec<Warning>,
}

/// Writes `document` with the lightmap UVs of `atlas` to `path`.
///
/// Meshes baked once get final UVs of their page; meshes that several nodes share get UVs of their own and
/// each node a rectangle in `extras.evenlight` (see [`node_rects`]). Triangles without a place on the map have
/// arbitrary finite UVs.
///
/// # Errors
/// [`BakeError::Scene`] names the mesh whose data cannot be copied; [`BakeError::Limit`] beyond 4 GiB;
/// [`BakeError::Io`] where the file cannot be written.
pub fn write(
    path: &Path,
    document: &Document,
    scene: &Scene,
    atlas: &Atlas,
    options: &GlbOptions,
) -> Result<GlbInfo, BakeError> {
    let (bytes, info) = encode(document, scene, atlas, options)?;
    write_atomically(path, &bytes)?;
    Ok(info)
}

fn encode(
    document: &Document,
    scene: &Scene,
    atlas: &Atlas,
    options: &GlbOptions,
) -> Result<(Vec<u8>, GlbInfo), BakeError> {
    let invalid = |what: String| BakeError::Scene(SceneError::Invalid { path: document.path.clone(), what });
    if !nodes::matches(scene, atlas) {
        return Err(invalid("the atlas was made for another scene; bake it again".into()));
    }
    let mut json = document.json.clone();
    let mut info = GlbInfo::default();

    let mut added = Vec::new();
    patch_primitives(&mut json, document, scene, atlas, &mut added, &mut info).map_err(invalid)?;
    nodes::add_rects(&mut json, scene, &node_rects(scene, atlas), &mut info.warnings);
    info.removed_lights = nodes::remove_lights(&mut json, &options.remove_baked_lights);
    if options.remove_baked_sky {
        info.removed_lights += nodes::remove_sky(&mut json);
    }

    let (mut blobs, slots) = place_accessors(&mut json, document, added);
    let folder = document.path.parent().unwrap_or(Path::new(""));
    let (embedded, left) = container::embed_images(&mut json, folder, &mut blobs, |k| slots.slot(k));
    info.embedded_images = embedded;
    info.warnings.extend(left.into_iter().map(|what| Warning::new("image-not-embedded", what)));
    let left = container::embed_profiles(&mut json, folder, &mut blobs, |k| slots.slot(k));
    info.warnings.extend(left.into_iter().map(|what| Warning::new("profile-not-embedded", what)));
    let bytes = container::assemble(json, document, &slots, &blobs)?;
    info.bytes = bytes.len();
    Ok((bytes, info))
}

/// Gives every baked primitive its TEXCOORD_1.
fn patch_primitives(
    json: &mut Value,
    document: &Document,
    scene: &Scene,
    atlas: &Atlas,
    added: &mut Vec<NewAccessor>,
    info: &mut GlbInfo,
) -> Result<(), String> {
    let instances = baked_instances(scene, atlas);
    let baked = || {
        let meshes = scene.meshes.iter().zip(&atlas.meshes).zip(&instances);
        meshes.filter_map(|((mesh, layout), instances)| Some((mesh, layout.as_ref()?, instances.first()?, instances)))
    };
    let lightmapped: BTreeSet<_> =
        baked().flat_map(|(mesh, ..)| mesh.primitives.iter().map(|p| (mesh.source, p.source))).collect();
    let moves = materials::make_room(json, &lightmapped);
    info.moved_uv_sets = moves.sets.len();
    info.duplicated_materials = moves.duplicated;

    let first_new = count(&document.json, "accessors");
    for (mesh, layout, &first, instances) in baked() {
        let placement = atlas.placements[first].filter(|_| instances.len() == 1);
        let to_page = |uv: Vec2| match placement {
            None => uv,
            Some(place) => {
                let page = atlas.pages[place.page as usize];
                (place.origin + uv * place.size) / Vec2::new(page.width as f32, page.height as f32)
            }
        };
        for (loaded, layout) in mesh.primitives.iter().zip(&layout.primitives) {
            let moved_set = moves.sets.get(&(mesh.source, loaded.source)).copied();
            let patch = Patch { document, layout, moved_set, first_new };
            let name = || format!("mesh {} ({:?}), primitive {}", mesh.source, mesh.name, loaded.source);
            let primitive = items_mut(json, "meshes")
                .nth(mesh.source)
                .and_then(|mesh| items_mut(mesh, "primitives").nth(loaded.source))
                .ok_or_else(|| format!("{} does not exist", name()))?;
            let patched = patch.apply(primitive, to_page, added).map_err(|what| format!("{}: {what}", name()))?;
            info.primitives += 1;
            info.rewritten_primitives += usize::from(patched.rewritten);
            info.split_vertices += patched.split_vertices;
            if !patched.lost.is_empty() {
                let what = format!("{}: not kept: {}", name(), patched.lost.join(", "));
                info.warnings.push(Warning::new("attribute-dropped", what));
            }
        }
    }
    Ok(())
}

/// Numbers new accessors and their views, those that nothing uses any more first, and puts the accessors into
/// the document. Until then new accessors are known by numbers from the old count on.
fn place_accessors(json: &mut Value, document: &Document, added: Vec<NewAccessor>) -> (Vec<Blob>, ViewSlots) {
    let first_new = count(&document.json, "accessors");
    let before = used_accessors(&document.json);
    let after = used_accessors(json);
    let mut dead: Vec<usize> = before.difference(&after).copied().filter(|&i| i < first_new).collect();
    dead.truncate(added.len());
    let slot = |k: usize| dead.get(k).copied().unwrap_or(first_new + k.saturating_sub(dead.len()));

    let views_before = used_views(json, &BTreeSet::new());
    let views_after = used_views(json, &dead.iter().copied().collect());
    let slots = ViewSlots {
        dead: views_before.difference(&views_after).copied().take(added.len()).collect(),
        old_count: count(json, "bufferViews"),
    };
    for_each_vertex_reference(json, &mut |reference| {
        if let Some(k) = integer(Some(reference)).and_then(|i| i.checked_sub(first_new)) {
            *reference = slot(k).into();
        }
    });
    let mut blobs = Vec::with_capacity(added.len());
    for (k, NewAccessor { mut object, blob }) in added.into_iter().enumerate() {
        object.insert("bufferView".into(), slots.slot(k).into());
        container::put(json, "accessors", slot(k), Value::Object(object));
        blobs.push(blob);
    }
    (blobs, slots)
}

/// The entries of the list `key` of an object; none where there is no such list.
fn items<'a>(object: &'a Value, key: &str) -> std::slice::Iter<'a, Value> {
    object.get(key).and_then(Value::as_array).map_or(&[][..], Vec::as_slice).iter()
}

/// As [`items`], to change. (Indexing with `[key]` would add what is missing.)
fn items_mut<'a>(object: &'a mut Value, key: &str) -> std::slice::IterMut<'a, Value> {
    object.get_mut(key).and_then(Value::as_array_mut).map_or(&mut [][..], Vec::as_mut_slice).iter_mut()
}

fn count(json: &Value, list: &str) -> usize {
    items(json, list).len()
}

/// Calls `f` on every accessor index that primitives hold.
fn for_each_vertex_reference(json: &mut Value, f: &mut impl FnMut(&mut Value)) {
    for mesh in items_mut(json, "meshes") {
        for primitive in items_mut(mesh, "primitives") {
            let Some(primitive) = primitive.as_object_mut() else { continue };
            primitive.get_mut("indices").into_iter().for_each(&mut *f);
            let attributes = primitive.get_mut("attributes").and_then(Value::as_object_mut);
            attributes.into_iter().flatten().for_each(|(_, index)| f(index));
            let targets = primitive.get_mut("targets").and_then(Value::as_array_mut);
            for target in targets.into_iter().flatten() {
                target.as_object_mut().into_iter().flatten().for_each(|(_, index)| f(index));
            }
        }
    }
}

/// Accessors that anything refers to.
fn used_accessors(json: &Value) -> BTreeSet<usize> {
    fn values(object: &Value) -> impl Iterator<Item = &Value> {
        object.as_object().into_iter().flat_map(|o| o.values())
    }
    let mut used: Vec<&Value> = Vec::new();
    for primitive in items(json, "meshes").flat_map(|mesh| items(mesh, "primitives")) {
        used.push(&primitive["indices"]);
        used.extend(values(&primitive["attributes"]));
        used.extend(items(primitive, "targets").flat_map(values));
    }
    for sampler in items(json, "animations").flat_map(|animation| items(animation, "samplers")) {
        used.extend([&sampler["input"], &sampler["output"]]);
    }
    used.extend(items(json, "skins").map(|skin| &skin["inverseBindMatrices"]));
    used.into_iter().filter_map(|index| integer(Some(index))).collect()
}

/// Views that anything but the accessors `without` refers to: whatever the object, the key is `bufferView`.
fn used_views(json: &Value, without: &BTreeSet<usize>) -> BTreeSet<usize> {
    fn collect(value: &Value, used: &mut BTreeSet<usize>) {
        match value {
            Value::Object(object) => {
                used.extend(integer(object.get("bufferView")));
                object.values().for_each(|v| collect(v, used));
            }
            Value::Array(list) => list.iter().for_each(|v| collect(v, used)),
            _ => {}
        }
    }
    let mut used = BTreeSet::new();
    for (key, value) in json.as_object().into_iter().flatten() {
        match value.as_array() {
            Some(accessors) if key == "accessors" => {
                let kept = accessors.iter().enumerate().filter(|(i, _)| !without.contains(i));
                kept.for_each(|(_, accessor)| collect(accessor, &mut used));
            }
            _ => collect(value, &mut used),
        }
    }
    used
}
