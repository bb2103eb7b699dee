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
use std::collections::BTreeMap;

pub(super) const NAME: &str = "EXT_mesh_gpu_instancing";

/// Most instances of a file: 2^18. Each becomes a node, with its own part of the atlas.
const MOST_INSTANCES: u64 = 1 << 18;

/// Most bytes of JSON that instances may copy from their nodes: 256 MiB.
const MOST_COPIED: u64 = 1 << 28;

/// Properties of a node that go with its mesh.
const OF_MESH: [&str; 3] = ["mesh", "skin", "weights"];

/// What instances may still take of memory.
struct Left {
    instances: u64,
    copied: u64,
}

/// Replaces all instanced nodes of a document; adds to `warnings`.
///
/// # Errors
/// [`SceneError::Invalid`] names the node, what is wrong with its instances, and the cure.
pub(super) fn unpack(document: &mut Document, warnings: &mut Vec<Warning>) -> Result<(), SceneError> {
    let mut left = Left { instances: MOST_INSTANCES, copied: MOST_COPIED };
    let animated = animated_weights(&document.json);
    let mut groups = BTreeMap::new();
    let count = document.json.get("nodes").and_then(Value::as_array).map_or(0, Vec::len);
    for node in 0..count {
        let Some(extension) = take_extension(&mut document.json["nodes"][node], NAME) else { continue };
        // Bytes that each instance copies, at most.
        let copied = document.json["nodes"][node].to_string().len() + animated.get(&(node as u64)).unwrap_or(&0);
        let mut reader = Reader::new(document, std::mem::take(warnings));
        let transforms = read(&mut reader, node, &extension, copied as u64, &mut left)?;
        *warnings = reader.warnings;
        if let Some(transforms) = transforms {
            groups.insert(node as u64, replace(&mut document.json, node, transforms));
        }
    }
    retarget_weights(&mut document.json, &groups);
    drop_extension(&mut document.json, NAME);
    Ok(())
}

/// Translation, rotation and scale of each instance, as properties of a node; `None`, with a warning, where the
/// node is drawn once.
fn read(
    reader: &mut Reader,
    node: usize,
    extension: &Value,
    copied: u64,
    left: &mut Left,
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
    let fits = left.instances.checked_sub(count).zip(left.copied.checked_sub(count.saturating_mul(copied)));
    let Some((instances, copied)) = fits else {
        return Err(reader.invalid(format!(
            "{label}: with it the file has more than {MOST_INSTANCES} instances, or {} MiB of them; split the scene",
            MOST_COPIED >> 20
        )));
    };
    *left = Left { instances, copied };
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

/// Moves the mesh of a node to new children, one per transform; returns their indices.
fn replace(json: &mut Value, node: usize, transforms: Vec<Map<String, Value>>) -> Vec<Value> {
    let Some(group) = json["nodes"][node].as_object_mut() else { return Vec::new() };
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
    let Some(group) = json["nodes"][node].as_object_mut() else { return children };
    match group.get_mut("children").and_then(Value::as_array_mut) {
        Some(own) => own.extend(children.iter().cloned()),
        // A list of children must not be empty.
        None if children.is_empty() => {}
        None => _ = group.insert("children".into(), children.clone().into()),
    }
    children
}

/// The node whose morph targets a channel animates.
fn weights_of(channel: &Value) -> Option<u64> {
    let target = channel.get("target")?;
    number(target, "node").filter(|_| target.get("path").and_then(Value::as_str) == Some("weights"))
}

/// Bytes of the channels that animate the morph targets of each node.
fn animated_weights(json: &Value) -> BTreeMap<u64, usize> {
    let animations = json.get("animations").and_then(Value::as_array).into_iter().flatten();
    let mut bytes = BTreeMap::new();
    for channel in animations.filter_map(|a| a.get("channels").and_then(Value::as_array)).flatten() {
        if let Some(node) = weights_of(channel) {
            *bytes.entry(node).or_insert(0) += channel.to_string().len();
        }
    }
    bytes
}

/// Lets animations of the morph targets of groups act on the nodes that now draw the mesh.
fn retarget_weights(json: &mut Value, groups: &BTreeMap<u64, Vec<Value>>) {
    for animation in json.get_mut("animations").and_then(Value::as_array_mut).into_iter().flatten() {
        let Some(channels) = animation.get_mut("channels").and_then(Value::as_array_mut) else { continue };
        for channel in std::mem::take(channels) {
            let Some(children) = weights_of(&channel).and_then(|node| groups.get(&node)) else {
                channels.push(channel);
                continue;
            };
            for child in children {
                let mut copy = channel.clone();
                copy["target"]["node"] = child.clone();
                channels.push(copy);
            }
        }
    }
}
