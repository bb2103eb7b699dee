//! EXT_lights_ies: lights that shine as an IES file says.

use super::container;
use super::light::{axes, bake_mode, light_index};
use super::node::direction;
use super::reader::{REPAIR, Reader};
use crate::error::{SceneError, Warning};
use crate::scene::{IesProfile, Light, LightKind};
use glam::{DAffine3, DVec3, Vec3};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The list of profiles, as messages call it.
pub(super) const PROFILES: &str = "EXT_lights_ies.lights";

/// Profiles read so far, by index in the document.
pub(super) type Profiles = BTreeMap<usize, Arc<IesProfile>>;

/// Reads the light that `extension` gives a node: at its origin, its profile turned as the node is, its scale ignored.
/// The intensity is that of the profile times `multiplier` times `color`. `None`, with a warning, where it shines
/// nowhere.
pub(super) fn read(
    reader: &mut Reader,
    profiles: &mut Profiles,
    extension: &Value,
    node: usize,
    world_from_node: DAffine3,
) -> Result<Option<Light>, SceneError> {
    let by = reader.label("nodes", node);
    let index = light_index(reader, extension, "EXT_lights_ies", &by)?;
    reader.value(PROFILES, index, &by)?;
    let multiplier = match extension.get("multiplier") {
        None => 1.0,
        Some(value) => value.as_f64().filter(|m| *m >= 0.0 && *m <= f64::from(f32::MAX)).ok_or_else(|| {
            reader.invalid(format!("{by}: its EXT_lights_ies has the multiplier {value}, no number from 0; {REPAIR}"))
        })?,
    };
    let color = match extension.get("color") {
        None => Vec3::ONE,
        Some(value) => <[f32; 3] as serde::Deserialize>::deserialize(value).map(Vec3::from).map_err(|_| {
            reader.invalid(format!("{by}: its EXT_lights_ies has the color {value}, not three numbers; {REPAIR}"))
        })?,
    };
    let profile = match profiles.get(&index) {
        Some(known) => known.clone(),
        None => {
            let new = Arc::new(read_profile(reader, index)?);
            profiles.insert(index, new.clone());
            new
        }
    };
    let name = reader.name("nodes", node).or(reader.name(PROFILES, index));
    let mut light = Light {
        name: name.map_or_else(|| format!("light of node {node}"), str::to_owned),
        node: Some(node),
        position: world_from_node.translation,
        direction: direction(&world_from_node, DVec3::NEG_Z).unwrap_or(Vec3::NAN),
        axes: axes(&world_from_node),
        intensity: Vec3::ZERO,
        kind: LightKind::Point,
        profile: None,
        bake: bake_mode(reader, PROFILES, index, node),
    };
    // The extension clamps colours, so that they only ever take light away.
    light.set_profile(profile, color.clamp(Vec3::ZERO, Vec3::ONE) * multiplier as f32);
    if !light.position.is_finite() || !light.direction.is_finite() || !light.intensity.is_finite() {
        reader.warn("odd-light", format!("{by}: its light has no finite strength, place or direction and is left out"));
        return Ok(None);
    }
    Ok(Some(light))
}

fn read_profile(reader: &mut Reader, index: usize) -> Result<IesProfile, SceneError> {
    let label = reader.label(PROFILES, index);
    let raw = reader.value(PROFILES, index, "the file")?;
    let scene = reader.document.path.clone();
    let bytes = match (raw.get("bufferView"), raw.get("uri")) {
        (Some(view), _) => {
            let view = view.as_u64().and_then(|v| usize::try_from(v).ok());
            let view = view.ok_or_else(|| reader.invalid(format!("{label}: its bufferView is no index; {REPAIR}")))?;
            reader.view(view, &label)?.0.to_vec()
        }
        (None, Some(Value::String(uri))) if container::is_data_uri(uri) => container::read_uri(&scene, uri, &label)?,
        (None, Some(Value::String(uri))) => {
            let file = container::file_of_uri(&scene, uri, &label)?;
            return take(reader, IesProfile::from_file(&file)?);
        }
        _ => return Err(reader.invalid(format!("{label} has neither a uri nor a bufferView; {REPAIR}"))),
    };
    let read = IesProfile::from_bytes(&inside(&scene, &label), &bytes, None)?;
    take(reader, read)
}

fn take(reader: &mut Reader, (profile, warnings): (IesProfile, Vec<Warning>)) -> Result<IesProfile, SceneError> {
    reader.warnings.extend(warnings);
    Ok(profile)
}

/// How messages call what lies inside of a scene.
fn inside(scene: &Path, label: &str) -> PathBuf {
    let mut name = scene.as_os_str().to_owned();
    name.push(": ");
    name.push(label);
    name.into()
}
