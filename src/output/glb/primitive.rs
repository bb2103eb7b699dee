//! One primitive with lightmap UVs: as it was plus TEXCOORD_1, or with vertices split where charts need it.

use super::accessor::{Accessor, bounds, integer};
use super::container::Blob;
use super::items_mut;
use crate::atlas::PrimitiveLayout;
use crate::scene::gltf::Document;
use glam::Vec2;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// An accessor to be added, with its data; the JSON lacks the bufferView, which is numbered later.
pub(super) struct NewAccessor {
    pub object: Map<String, Value>,
    pub blob: Blob,
}

const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// What is known of the primitive at hand.
pub(super) struct Patch<'a> {
    pub document: &'a Document,
    pub layout: &'a PrimitiveLayout,
    /// Where its TEXCOORD_1 has to go, if materials read it.
    pub moved_set: Option<usize>,
    /// First index that new accessors may have; they are numbered from here in the order of `added`.
    pub first_new: usize,
}

/// What happened to a primitive.
#[derive(Debug, Default)]
pub(super) struct Patched {
    /// Vertices were rewritten, and by how many there are more than the file had.
    pub rewritten: bool,
    pub split_vertices: usize,
    /// Attributes that could not be kept, with the reason.
    pub lost: Vec<String>,
}

impl Patch<'_> {
    /// Patches the primitive's JSON; `uv` gives the stored UV of a layout UV. Accessors are appended to `added`.
    ///
    /// # Errors
    /// Object and fault, without the name of the file.
    pub fn apply(
        &self,
        primitive: &mut Value,
        uv: impl Fn(Vec2) -> Vec2,
        added: &mut Vec<NewAccessor>,
    ) -> Result<Patched, String> {
        let layout = self.layout;
        let count = self.vertex_count(primitive)?;
        let new_count = layout.source_vertices.len();
        if layout.uvs.len() != new_count || layout.triangles.iter().flatten().any(|&v| v as usize >= new_count) {
            return Err("its atlas layout is inconsistent; please report this with the scene".into());
        }
        self.free_set_1(primitive);
        let mut patched = Patched::default();
        // Vertices that triangles use: several primitives may share one long list.
        let mut used: Vec<u32> = layout.triangles.iter().flatten().copied().collect();
        used.sort_unstable();
        used.dedup();
        let vertices = if new_count > count || 2 * used.len() < count {
            patched.rewritten = true;
            patched.split_vertices = new_count.saturating_sub(count);
            self.rewrite(primitive, &used, added, &mut patched.lost)?;
            used
        } else {
            (0..count as u32).collect()
        };
        let uvs = vertices.iter().map(|&v| layout.uvs.get(v as usize).map_or(Vec2::ZERO, |&at| uv(at)));
        let uvs: Vec<Vec2> = uvs.map(|at| if at.is_finite() { at } else { Vec2::ZERO }).collect();
        let index = Value::from(self.first_new + added.len());
        added.push(floats("VEC2", 2, uvs.len(), bytemuck::cast_slice(&uvs)));
        let attributes = object(&mut primitive["attributes"])?;
        if !attributes.contains_key("TEXCOORD_0") {
            // Sets have to be numbered without gaps (glTF 2.0, section 3.7.2.1).
            attributes.insert("TEXCOORD_0".into(), index.clone());
        }
        attributes.insert("TEXCOORD_1".into(), index);
        Ok(patched)
    }

    fn vertex_count(&self, primitive: &Value) -> Result<usize, String> {
        let position = integer(primitive["attributes"].get("POSITION")).ok_or("it has no POSITION")?;
        integer(self.document.json["accessors"][position].get("count"))
            .ok_or_else(|| format!("accessor {position} has no count"))
    }

    /// Moves TEXCOORD_1, in morph targets as well, to where materials will look for it, or drops it.
    fn free_set_1(&self, primitive: &mut Value) {
        let rename = |attributes: &mut Value| {
            let Some(attributes) = attributes.as_object_mut() else { return };
            if let (Some(old), Some(set)) = (attributes.shift_remove("TEXCOORD_1"), self.moved_set) {
                attributes.insert(format!("TEXCOORD_{set}"), old);
            }
        };
        rename(&mut primitive["attributes"]);
        items_mut(primitive, "targets").for_each(rename);
    }

    /// Gives the primitive copies of its own of all attributes and morph targets, with the vertices `kept`
    /// of the layout, and new indices of a triangle list.
    fn rewrite(
        &self,
        primitive: &mut Value,
        kept: &[u32],
        added: &mut Vec<NewAccessor>,
        lost: &mut Vec<String>,
    ) -> Result<(), String> {
        let sources: Vec<u32> = kept.iter().map(|&v| self.layout.source_vertices[v as usize]).collect();
        let mut copies: BTreeMap<usize, usize> = BTreeMap::new();
        let mut copy_all = |attributes: &mut Value, is_target: bool| -> Result<(), String> {
            let attributes = object(attributes)?;
            for (name, index) in std::mem::take(attributes) {
                let old = integer(Some(&index)).ok_or_else(|| format!("attribute {name} is not an index"))?;
                if let Some(&copy) = copies.get(&old) {
                    attributes.insert(name, copy.into());
                    continue;
                }
                // What the bake did not need must not keep it from being written.
                let copy = match self.copy(old, &name, &sources) {
                    Ok(copy) => copy,
                    Err(what) if name == "POSITION" && !is_target => return Err(what),
                    Err(what) => {
                        lost.push(format!("{name} ({what})"));
                        continue;
                    }
                };
                let index = self.first_new + added.len();
                copies.insert(old, index);
                attributes.insert(name, index.into());
                added.push(copy);
            }
            Ok(())
        };
        copy_all(&mut primitive["attributes"], false)?;
        for target in items_mut(primitive, "targets") {
            copy_all(target, true)?;
        }
        let primitive = object(primitive)?;
        primitive.insert("indices".into(), (self.first_new + added.len()).into());
        if primitive.contains_key("mode") {
            primitive.insert("mode".into(), 4.into());
        }
        added.push(self.indices(kept));
        Ok(())
    }

    /// Triangles of the layout as indices into `kept`.
    fn indices(&self, kept: &[u32]) -> NewAccessor {
        let triangles = self.layout.triangles.iter().flatten();
        // Every vertex of a triangle is in `kept`, which is sorted.
        let indices = triangles.map(|v| kept.partition_point(|k| k < v) as u32);
        // 65535 restarts primitives in 16-bit lists.
        let (component_type, data): (u32, Vec<u8>) = if kept.len() < 65536 {
            (5123, indices.flat_map(|i| (i as u16).to_le_bytes()).collect())
        } else {
            (5125, indices.flat_map(u32::to_le_bytes).collect())
        };
        let fields = json!({
            "componentType": component_type, "count": self.layout.triangles.len() * 3, "type": "SCALAR"
        });
        NewAccessor { object: map(fields), blob: Blob { data, stride: None, target: Some(ELEMENT_ARRAY_BUFFER) } }
    }

    /// The elements `sources` of accessor `index`, byte by byte.
    fn copy(&self, index: usize, name: &str, sources: &[u32]) -> Result<NewAccessor, String> {
        let accessor = Accessor::open(self.document, index)?;
        let stride = accessor.element.next_multiple_of(4);
        let mut data = Vec::with_capacity(sources.len() * stride);
        for &v in sources {
            if !accessor.copy_element(v as usize, &mut data) {
                return Err(format!("accessor {index} has {} elements, vertex {v} is used", accessor.count));
            }
            data.resize(data.len().next_multiple_of(4), 0);
        }
        let mut object = accessor.object.clone();
        for key in ["bufferView", "byteOffset", "sparse"] {
            object.shift_remove(key);
        }
        object.insert("count".into(), sources.len().into());
        if object.contains_key("min") || object.contains_key("max") || name == "POSITION" {
            object.shift_remove("min");
            object.shift_remove("max");
            if let Some([min, max]) = bounds(&object, &data, stride) {
                object.insert("min".into(), min.into());
                object.insert("max".into(), max.into());
            }
        }
        let padded = Some(stride).filter(|&s| s != accessor.element);
        Ok(NewAccessor { object, blob: Blob { data, stride: padded, target: Some(ARRAY_BUFFER) } })
    }
}

/// A float accessor with bounds where it holds positions or normals.
fn floats(kind: &str, components: usize, count: usize, data: &[u8]) -> NewAccessor {
    let mut object = map(json!({ "componentType": 5126, "count": count, "type": kind }));
    if components == 3
        && let Some([min, max]) = bounds(&object, data, 12)
    {
        object.insert("min".into(), min.into());
        object.insert("max".into(), max.into());
    }
    NewAccessor { object, blob: Blob { data: data.to_vec(), stride: None, target: Some(ARRAY_BUFFER) } }
}

fn object(value: &mut Value) -> Result<&mut Map<String, Value>, String> {
    value.as_object_mut().ok_or_else(|| "its attributes are not an object".into())
}

fn map(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}
