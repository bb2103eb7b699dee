//! EXT_mesh_gpu_instancing: nodes that draw a mesh many times become groups of nodes that draw it once.
//!
//! In: a document with such nodes, its geometry unpacked. Out: the same document with a child per instance, and no
//! trace of the extension. Each instance so has a lightmap of its own, under a node index as any other: engines
//! that draw instances at once know of no lightmap rectangle for each, and all read plain nodes.

use super::{drop_extension, number, push, take_extension};
use crate::error::{SceneError, Warning};
use crate::scene::gltf::Document;
use crate::scene::gltf::reader::{REPAIR, Reader};
use glam::{DQuat, Quat};
use serde_json::{Map, Value, json};

pub(super) const NAME: &str = "EXT_mesh_gpu_instancing";

/// Most instances of a file: 2^18. Each becomes a node, with its own part of the atlas.
const MOST_INSTANCES: u64 = 1 << 18;

/// Properties of a node that go with its mesh.
const OF_MESH: [&str; 3] = ["mesh", "skin", "weights"];

/// Replaces all instanced nodes of a document; adds to `warnings`.
///
/// # Errors
/// [`SceneError::Invalid`] names the node, what is wrong with its instances, and the cure.
pub(super) fn unpack(document: &mut Document, warnings: &mut Vec<Warning>) -> Result<(), SceneError> {
    let mut left = MOST_INSTANCES;
    let count = document.json.get("nodes").and_then(Value::as_array).map_or(0, Vec::len);
    for node in 0..count {
        let Some(extension) = take_extension(&mut document.json["nodes"][node], NAME) else { continue };
        let mut reader = Reader::new(document, std::mem::take(warnings));
        let transforms = read(&mut reader, node, &extension, &mut left)?;
        *warnings = reader.warnings;
        if let Some(transforms) = transforms {
            replace(&mut document.json, node, transforms);
        }
    }
    drop_extension(&mut document.json, NAME);
    Ok(())
}

/// Translation, rotation and scale of each instance, as properties of a node; `None`, with a warning, where the
/// node is drawn once.
fn read(
    reader: &mut Reader,
    node: usize,
    extension: &Value,
    left: &mut u64,
) -> Result<Option<Vec<Map<String, Value>>>, SceneError> {
    let label = reader.label("nodes", node);
    let attributes = extension.get("attributes").and_then(Value::as_object);
    let lost: Vec<&str> =
        attributes.into_iter().flatten().map(|(k, _)| k.as_str()).filter(|k| k.starts_with('_')).collect();
    let mut accessors = Vec::new();
    for key in ["TRANSLATION", "ROTATION", "SCALE"] {
        if let Some(index) = attributes.and_then(|a| a.get(key)) {
            let index = index.as_u64().and_then(|i| usize::try_from(i).ok());
            let index = index.ok_or_else(|| reader.invalid(format!("{label}: its {key} is no accessor; {REPAIR}")))?;
            accessors.push((key, index));
        }
    }
    let has_mesh = reader.value("nodes", node, "the file")?.get("mesh").is_some();
    let Some(&(_, first)) = accessors.first().filter(|_| has_mesh) else {
        let what =
            if has_mesh { "instances without places; its mesh is baked once" } else { "instances without a mesh" };
        reader.warn("gpu-instancing", format!("{label} has {what}"));
        return Ok(None);
    };
    if !lost.is_empty() {
        let message = format!("{label}: the numbers {} of its instances are not kept", lost.join(", "));
        reader.warn("attribute-dropped", message);
    }
    let count = count(reader, first, &label)?;
    // Each takes a node, and a channel of each animation of its morph targets.
    let copies = count.saturating_mul(1 + weight_channels(&reader.document.json, node));
    *left = left.checked_sub(copies).ok_or_else(|| {
        reader.invalid(format!("{label}: with it the file has more than {MOST_INSTANCES} instances; split the scene"))
    })?;
    let mut transforms = vec![Map::new(); count as usize];
    let mut nowhere = vec![false; count as usize];
    for (key, accessor) in accessors {
        let by = format!("{label} {key}");
        let components = if key == "ROTATION" { 4 } else { 3 };
        let n = self::count(reader, accessor, &by)?;
        if n != count {
            return Err(reader.invalid(format!("{by} has {n} values for {count} instances; {REPAIR}")));
        }
        let values = reader.vectors::<4>(accessor, &[components], 0.0, &by)?;
        for ((value, transform), nowhere) in values.into_iter().zip(&mut transforms).zip(&mut nowhere) {
            *nowhere |= value.iter().any(|c| !c.is_finite());
            let value = if key == "ROTATION" { unit(value) } else { value };
            transform.insert(key.to_ascii_lowercase(), json!(value[..components]));
        }
    }
    let lost = nowhere.iter().filter(|n| **n).count();
    if lost > 0 {
        reader.warn("odd-transform", format!("{label}: {lost} of its instances are nowhere and left out"));
    }
    Ok(Some(transforms.into_iter().zip(nowhere).filter(|(_, nowhere)| !nowhere).map(|(t, _)| t).collect()))
}

/// Number of elements of an accessor.
fn count(reader: &Reader, accessor: usize, by: &str) -> Result<u64, SceneError> {
    Ok(number(reader.value("accessors", accessor, by)?, "count").unwrap_or(0))
}

/// A rotation of length 1, as glTF has it, where integers are not quite; one without a length stays.
fn unit(rotation: [f32; 4]) -> [f32; 4] {
    let q = Quat::from_array(rotation).as_dquat();
    let length = q.length();
    if length > 0.0 && length.is_finite() {
        DQuat::from_vec4(glam::DVec4::from(q) / length).as_quat().to_array()
    } else {
        rotation
    }
}

/// Moves the mesh of a node to new children, one per transform.
fn replace(json: &mut Value, node: usize, transforms: Vec<Map<String, Value>>) {
    let Some(group) = json["nodes"][node].as_object_mut() else { return };
    let mut common = Map::new();
    for key in OF_MESH {
        common.extend(group.shift_remove(key).map(|value| (key.to_owned(), value)));
    }
    // What is said of the bake holds for each.
    let extras = group.get("extras").and_then(Value::as_object).into_iter().flatten();
    let ours: Map<String, Value> = extras
        .filter(|(k, _)| matches!(k.as_str(), "evenlight" | "compare_weight"))
        .map(|(k, v)| (k.clone(), v.clone()))
        .collect();
    if !ours.is_empty() {
        common.insert("extras".into(), ours.into());
    }
    let name = group.get("name").and_then(Value::as_str).map(str::to_owned);
    let mut children: Vec<Value> = Vec::with_capacity(transforms.len());
    for (i, transform) in transforms.into_iter().enumerate() {
        let mut child = Map::new();
        child.extend(name.as_ref().map(|name| ("name".to_owned(), format!("{name}_{i}").into())));
        child.extend(common.clone());
        child.extend(transform);
        children.push(push(json, "nodes", child.into()).into());
    }
    retarget_weights(json, node, &children);
    let Some(group) = json["nodes"][node].as_object_mut() else { return };
    match group.get_mut("children").and_then(Value::as_array_mut) {
        Some(own) => own.extend(children),
        // A list of children must not be empty.
        None if children.is_empty() => {}
        None => _ = group.insert("children".into(), children.into()),
    }
}

/// True for a channel that animates the morph targets of a node.
fn moves_weights(channel: &Value, node: usize) -> bool {
    let target = channel.get("target");
    target.is_some_and(|t| number(t, "node") == Some(node as u64) && t.get("path") == Some(&json!("weights")))
}

/// Number of channels of all animations that animate the morph targets of a node.
fn weight_channels(json: &Value, node: usize) -> u64 {
    let animations = json.get("animations").and_then(Value::as_array).into_iter().flatten();
    let channels = animations.filter_map(|a| a.get("channels").and_then(Value::as_array)).flatten();
    channels.filter(|channel| moves_weights(channel, node)).count() as u64
}

/// Lets animations of a node's morph targets act on those that now draw its mesh.
fn retarget_weights(json: &mut Value, node: usize, children: &[Value]) {
    for animation in json.get_mut("animations").and_then(Value::as_array_mut).into_iter().flatten() {
        let Some(channels) = animation.get_mut("channels").and_then(Value::as_array_mut) else { continue };
        for channel in std::mem::take(channels) {
            if !moves_weights(&channel, node) {
                channels.push(channel);
                continue;
            }
            for child in children {
                let mut copy = channel.clone();
                copy["target"]["node"] = child.clone();
                channels.push(copy);
            }
        }
    }
}
