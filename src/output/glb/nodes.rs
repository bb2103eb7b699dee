//! What nodes gain and lose: their place in the lightmaps, and lights that are baked.

use super::{items, items_mut};
use crate::atlas::Atlas;
use crate::error::Warning;
use crate::options::Lights;
use crate::output::NodeRect;
use crate::scene::{BakeMode, Scene};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// Extensions that give a node a light.
const LIGHTS: [&str; 2] = ["KHR_lights_punctual", "EXT_lights_ies"];

/// Nodes of the lights whose direct and reflected light is all in the maps, in ascending order: what
/// [`GlbOptions::remove_baked_lights`](super::GlbOptions::remove_baked_lights) wants to know.
pub fn fully_baked_lights(scene: &Scene, lights: Lights) -> Vec<usize> {
    let full = scene.lights.iter().filter(|light| lights == Lights::All && light.bake == BakeMode::Full);
    let mut nodes: Vec<usize> = full.filter_map(|light| light.node).collect();
    nodes.sort_unstable();
    nodes.dedup();
    nodes
}

/// Merges `evenlight: { lightmap, rect }` into the extras of baked nodes. A node that draws several instances
/// (EXT_mesh_gpu_instancing) gets a list `instances` of them in the order of the scene.
pub(super) fn add_rects(json: &mut Value, scene: &Scene, rects: &[Option<NodeRect>], warnings: &mut Vec<Warning>) {
    let mut by_node: BTreeMap<usize, Vec<Map<String, Value>>> = BTreeMap::new();
    for (instance, rect) in scene.instances.iter().zip(rects) {
        if let Some(rect) = rect {
            let mut place = Map::new();
            place.insert("lightmap".into(), rect.page.into());
            place.insert("rect".into(), json!(rect.rect));
            by_node.entry(instance.node).or_default().push(place);
        }
    }
    for (node, mut places) in by_node {
        let Some(node_json) = items_mut(json, "nodes").nth(node).and_then(Value::as_object_mut) else { continue };
        let extras = node_json.entry("extras").or_insert_with(|| json!({}));
        let Some(extras) = extras.as_object_mut() else {
            let what = format!("node {node} has extras that are no object: its lightmap is in the manifest only");
            warnings.push(Warning::new("extras-not-an-object", what));
            continue;
        };
        let own = extras.entry("evenlight").or_insert_with(|| json!({}));
        if !own.is_object() {
            *own = json!({});
        }
        let place = match places.len() {
            1 => places.remove(0),
            _ => Map::from_iter([("instances".to_owned(), json!(places))]),
        };
        if let Some(own) = own.as_object_mut() {
            own.extend(place);
        }
    }
}

/// Takes the lights from the given nodes; without any left the extension goes too. Returns from how many.
pub(super) fn remove_lights(json: &mut Value, nodes: &[usize]) -> usize {
    let mut removed = 0;
    for &node in nodes {
        let Some(node) = items_mut(json, "nodes").nth(node).and_then(Value::as_object_mut) else { continue };
        let Some(extensions) = node.get_mut("extensions").and_then(Value::as_object_mut) else { continue };
        let mut gone = LIGHTS.map(|name| extensions.shift_remove(name)).into_iter().flatten();
        removed += usize::from(gone.next().is_some());
        if extensions.is_empty() {
            node.shift_remove("extensions");
        }
    }
    for name in LIGHTS {
        if removed > 0 && !items(json, "nodes").any(|node| node["extensions"].get(name).is_some()) {
            drop_extension(json, name);
        }
    }
    removed
}

/// Removes an extension that nothing uses any more from the root of the document.
pub(super) fn drop_extension(json: &mut Value, name: &str) {
    let Some(root) = json.as_object_mut() else { return };
    if let Some(extensions) = root.get_mut("extensions").and_then(Value::as_object_mut) {
        extensions.shift_remove(name);
        if extensions.is_empty() {
            root.shift_remove("extensions");
        }
    }
    for list in ["extensionsUsed", "extensionsRequired"] {
        if let Some(names) = root.get_mut(list).and_then(Value::as_array_mut) {
            names.retain(|n| n != name);
            if names.is_empty() {
                root.shift_remove(list);
            }
        }
    }
}

/// True where the atlas speaks of the scene at hand.
pub(super) fn matches(scene: &Scene, atlas: &Atlas) -> bool {
    atlas.placements.len() == scene.instances.len()
        && atlas.meshes.len() == scene.meshes.len()
        && scene
            .meshes
            .iter()
            .zip(&atlas.meshes)
            .all(|(mesh, layout)| layout.as_ref().is_none_or(|layout| layout.primitives.len() == mesh.primitives.len()))
}
