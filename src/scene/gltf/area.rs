//! EXT_lights_area: rectangles and discs of light.
//!
//! The extension is a draft (KhronosGroup/glTF, pull request 2525); this reads its text as of 2026: `type` `rect` or
//! `disk`, `size` and `rect.aspect`, `intensity` in nit, -Z as the side that shines, scaled evenly by the largest scale
//! of the node. The draft does not say whether such a light is seen or blocks; as a light of an engine it does neither.

use super::light::{axes, bake_mode, light_index};
use super::node::direction;
use super::reader::{REPAIR, Reader};
use crate::error::SceneError;
use crate::scene::{AreaShape, Light, LightKind};
use glam::{DAffine3, DVec3, Vec3};
use serde::Deserialize;
use serde_json::Value;

/// The list of lights, as messages call it.
pub(super) const PANELS: &str = "EXT_lights_area.lights";

/// A light as the file has it.
#[derive(Deserialize)]
#[serde(default)]
struct RawLight {
    color: [f32; 3],
    /// Nit.
    intensity: f32,
    r#type: String,
    /// Height of a rectangle, diameter of a disc.
    size: f64,
    rect: RawRectangle,
}

#[derive(Deserialize)]
#[serde(default)]
struct RawRectangle {
    /// Width over height.
    aspect: f64,
}

impl Default for RawLight {
    fn default() -> RawLight {
        let rect = RawRectangle::default();
        RawLight { color: [1.0; 3], intensity: 1000.0, r#type: String::new(), size: 1.0, rect }
    }
}

impl Default for RawRectangle {
    fn default() -> RawRectangle {
        RawRectangle { aspect: 1.0 }
    }
}

/// Reads the light that `extension` gives a node. `None`, with a warning, where it shines nowhere.
pub(super) fn read(
    reader: &mut Reader,
    extension: &Value,
    node: usize,
    world_from_node: DAffine3,
) -> Result<Option<Light>, SceneError> {
    let by = reader.label("nodes", node);
    let index = light_index(reader, extension, "EXT_lights_area", &by)?;
    let raw: RawLight = reader.object(PANELS, index, &by)?;
    let label = reader.label(PANELS, index);
    let m = world_from_node.matrix3;
    let scale = [m.x_axis, m.y_axis, m.z_axis].into_iter().map(DVec3::length).fold(0.0, f64::max);
    let size = raw.size * scale;
    let (shape, least) = match raw.r#type.as_str() {
        "rect" => {
            let width = size * raw.rect.aspect;
            (AreaShape::Rectangle { width, height: size }, width.min(size))
        }
        "disk" => (AreaShape::Disc { radius: 0.5 * size }, size),
        other => {
            return Err(reader.invalid(format!("{label} has the type '{other}', neither rect nor disk; {REPAIR}")));
        }
    };
    let radiance = Vec3::from(raw.color) * raw.intensity;
    let pointing = direction(&world_from_node, DVec3::NEG_Z);
    let flat = least.is_nan() || least <= 0.0 || !((size * raw.rect.aspect.max(1.0)) as f32).is_finite();
    let (Some(direction), false) =
        (pointing, flat || !radiance.is_finite() || !world_from_node.translation.as_vec3().is_finite())
    else {
        reader.warn("odd-light", format!("{label} has no finite strength, place, size or direction and is left out"));
        return Ok(None);
    };
    if radiance.min_element() < 0.0 {
        reader.warn("negative-light", format!("{label} takes light away, which cannot be baked; taken as 0"));
    }
    let name = reader.name(PANELS, index).or(reader.name("nodes", node));
    Ok(Some(Light {
        name: name.map_or_else(|| format!("area light {index}"), str::to_owned),
        node: Some(node),
        position: world_from_node.translation,
        direction,
        axes: axes(&world_from_node),
        intensity: radiance.max(Vec3::ZERO),
        kind: LightKind::Area(shape),
        profile: None,
        bake: bake_mode(reader, PANELS, index, node),
    }))
}
