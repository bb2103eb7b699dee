//! What nodes gain and lose: their place in the lightmaps, and lights that are baked.

use super::{items, items_mut};
use crate::atlas::Atlas;
use crate::error::Warning;
use crate::options::Lights;
use crate::output::NodeRect;
use crate::scene::gltf::{drop_extension, take_extension};
use crate::scene::{BakeMode, Light, Scene};
use serde_json::{Value, json};

/// Extensions that give a node a light.
const LIGHTS: [&str; 3] = ["KHR_lights_punctual", "EXT_lights_ies", "EXT_lights_area"];

/// Nodes of the lights whose direct and reflected light is all in the maps, in ascending order: what
/// [`GlbOptions::remove_baked_lights`](super::GlbOptions::remove_baked_lights) wants to know.
pub fn fully_baked_lights(scene: &Scene, lights: Lights) -> Vec<usize> {
    let full = |light: &&Light| lights == Lights::All && light.bake == BakeMode::Full;
    // A node may have several lights, which go together or stay.
    let stays = |node: &usize| scene.lights.iter().any(|light| light.node == Some(*node) && !full(&light));
    let baked = scene.lights.iter().filter(full).filter_map(|light| light.node);
    let mut nodes: Vec<usize> = baked.filter(|node| !stays(node)).collect();
    nodes.sort_unstable();
    nodes.dedup();
    nodes
}

/// Merges `evenlight: { lightmap, rect }` into the extras of baked nodes.
pub(super) fn add_rects(json: &mut Value, scene: &Scene, rects: &[Option<NodeRect>], warnings: &mut Vec<Warning>) {
    for (instance, rect) in scene.instances.iter().zip(rects) {
        let (node, Some(rect)) = (instance.node, rect) else { continue };
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
        if let Some(own) = own.as_object_mut() {
            own.insert("lightmap".into(), rect.page.into());
            own.insert("rect".into(), json!(rect.rect));
        }
    }
}

/// Takes the lights from the given nodes; without any left the extension goes too. Returns from how many.
pub(super) fn remove_lights(json: &mut Value, nodes: &[usize]) -> usize {
    let mut removed = 0;
    for &node in nodes {
        let Some(node) = items_mut(json, "nodes").nth(node) else { continue };
        let gone = LIGHTS.map(|name| take_extension(node, name).is_some());
        removed += usize::from(gone.contains(&true));
    }
    for name in LIGHTS {
        if removed > 0 && !items(json, "nodes").any(|node| node["extensions"].get(name).is_some()) {
            drop_extension(json, name);
        }
    }
    removed
}

/// Takes the surroundings from the scene that is baked; where no other scene has any, the extension goes too. Returns
/// from how many.
pub(super) fn remove_sky(json: &mut Value) -> usize {
    const NAME: &str = "EXT_lights_image_based";
    let scene = json.get("scene").and_then(Value::as_u64).map_or(0, |i| i as usize);
    let Some(scene) = items_mut(json, "scenes").nth(scene) else { return 0 };
    let removed = usize::from(take_extension(scene, NAME).is_some());
    if removed > 0 && !items(json, "scenes").any(|scene| scene["extensions"].get(NAME).is_some()) {
        drop_extension(json, NAME);
    }
    removed
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
