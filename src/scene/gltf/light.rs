//! KHR_lights_punctual: point, spot and directional lights.

use super::node::direction;
use super::reader::{REPAIR, Reader};
use crate::error::SceneError;
use crate::scene::{BakeMode, Light, LightKind};
use glam::{DAffine3, DVec3, Mat3, Vec3};
use gltf::json;
use json::extensions::scene::khr_lights_punctual::{Light as RawLight, Type};
use json::validation::Checked;
use serde_json::Value;

/// Which light of the list of `name`, an extension, `extension` gives to `by`.
///
/// # Errors
/// [`SceneError`] where it names none.
pub(super) fn light_index(reader: &Reader, extension: &Value, name: &str, by: &str) -> Result<usize, SceneError> {
    let index = extension.get("light").and_then(Value::as_u64);
    let index = index.ok_or_else(|| reader.invalid(format!("{by}: its {name} names no `light`; {REPAIR}")))?;
    // What is beyond is in no list, which the reader says.
    Ok(usize::try_from(index).unwrap_or(usize::MAX))
}

/// Reads the light at a node: at its origin, along its -Z axis, its scale ignored. `None`, with a warning,
/// where it shines nowhere.
pub(super) fn read(
    reader: &mut Reader,
    index: usize,
    node: usize,
    world_from_node: DAffine3,
) -> Result<Option<Light>, SceneError> {
    let raw: RawLight = reader.object("lights", index, &reader.label("nodes", node))?;
    let label = reader.label("lights", index);
    let Checked::Valid(kind) = raw.type_ else {
        return Err(reader.invalid(format!("{label} has an unknown type; {REPAIR}")));
    };
    let intensity = Vec3::from(raw.color) * raw.intensity;
    let pointing = direction(&world_from_node, DVec3::NEG_Z);
    let aimless = pointing.is_none() && kind != Type::Point;
    if !intensity.is_finite() || !world_from_node.translation.is_finite() || aimless {
        reader.warn("odd-light", format!("{label} has no finite strength, place or direction and is left out"));
        return Ok(None);
    }
    if intensity.min_element() < 0.0 {
        reader.warn("negative-light", format!("{label} takes light away, which cannot be baked; taken as 0"));
    }
    if raw.range.is_some() {
        reader.warn("light-range", format!("{label} has a range; its light is baked without end, as physics has it"));
    }
    let kind = match kind {
        Type::Point => LightKind::Point,
        Type::Directional => LightKind::Directional { angular_diameter: 0.0 },
        Type::Spot => spot(reader, &raw, &label),
    };
    let name = reader.name("lights", index).or(reader.name("nodes", node));
    Ok(Some(Light {
        name: name.map_or_else(|| format!("light {index}"), str::to_owned),
        node: Some(node),
        position: world_from_node.translation,
        direction: pointing.unwrap_or(Vec3::NEG_Z),
        axes: axes(&world_from_node),
        intensity: intensity.max(Vec3::ZERO),
        kind,
        profile: None,
        bake: bake_mode(reader, "lights", index, node),
    }))
}

fn spot(reader: &mut Reader, raw: &RawLight, label: &str) -> LightKind {
    // The narrowest ramp between the cones, so that the edge of a hard spot stays defined [rad].
    const MIN_RAMP: f32 = 1e-4;
    let (inner, outer) =
        raw.spot.as_ref().map_or((0.0, std::f32::consts::FRAC_PI_4), |s| (s.inner_cone_angle, s.outer_cone_angle));
    let outer_fixed = outer.clamp(MIN_RAMP, std::f32::consts::FRAC_PI_2);
    let inner_fixed = inner.clamp(0.0, outer_fixed - MIN_RAMP);
    // Blender writes equal angles for a hard edge: no fault.
    if outer != outer_fixed || !(0.0..=outer_fixed).contains(&inner) {
        reader.warn(
            "odd-spot",
            format!("{label} has the cones {inner} and {outer}; {inner_fixed} and {outer_fixed} are used"),
        );
    }
    LightKind::Spot { inner: inner_fixed, outer: outer_fixed }
}

/// Unit axes of a node's frame in world space, its -Z where the light points. What is skewed is set upright, what is
/// scaled to nothing guessed; a mirror stays.
pub(super) fn axes(world_from_node: &DAffine3) -> Mat3 {
    let m = world_from_node.matrix3;
    let z = m.z_axis.try_normalize().unwrap_or(DVec3::Z);
    let x = (m.x_axis - z * z.dot(m.x_axis)).try_normalize().unwrap_or_else(|| z.any_orthonormal_vector());
    let y = z.cross(x) * if m.determinant() < 0.0 { -1.0 } else { 1.0 };
    Mat3::from_cols(x.as_vec3(), y.as_vec3(), z.as_vec3())
}

/// Extras `evenlight.bake` of the node where it is a mode, else of light `light` of `list`. On a node, false speaks of
/// its mesh.
pub(super) fn bake_mode(reader: &mut Reader, list: &str, light: usize, node: usize) -> BakeMode {
    let on_node = reader.extras("nodes", node).and_then(|e| e.get("bake")).filter(|v| v.is_string());
    let Some(value) = on_node.or_else(|| reader.extras(list, light)?.get("bake")) else {
        return BakeMode::default();
    };
    match value {
        Value::Bool(true) => BakeMode::Full,
        Value::Bool(false) => BakeMode::Off,
        _ => match value.as_str() {
            Some("full") => BakeMode::Full,
            Some("indirect") => BakeMode::Indirect,
            Some("off") => BakeMode::Off,
            _ => {
                let label = reader.label(list, light);
                reader.warn(
                    "odd-extras",
                    format!("{label}: extras evenlight.bake is {value}, not full, indirect or off"),
                );
                BakeMode::default()
            }
        },
    }
}
