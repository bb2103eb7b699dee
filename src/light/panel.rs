//! Lights with area that are no surfaces, in the frame.

use super::emitters::LightSettings;
use super::tree::LightBounds;
use crate::scene::{AreaShape, BakeMode, Light, World};
use glam::{DVec2, Vec3};

/// A triangle of a light with area, in the frame: no surface of the scene, for no ray meets it.
#[derive(Debug, Clone)]
pub(super) struct Panel {
    pub(super) corners: [Vec3; 3],
    /// Unit vector to the side that shines.
    pub(super) normal: Vec3,
    /// Nit.
    pub(super) radiance: Vec3,
    pub(super) stored: bool,
}

/// The triangles of a light of `shape`.
pub(super) fn panels_of(light: &Light, shape: AreaShape, world: &World, settings: LightSettings) -> Vec<Panel> {
    let [x, y] = [light.axes.x_axis, light.axes.y_axis].map(Vec3::as_dvec3);
    let place = |p: DVec2| world.frame.from_world(light.position + x * p.x + y * p.y);
    let panel = |corners: [DVec2; 3]| Panel {
        corners: corners.map(place),
        normal: -light.axes.z_axis,
        radiance: light.intensity,
        stored: !settings.indirect_only && light.bake == BakeMode::Full,
    };
    shape.triangles().into_iter().map(panel).collect()
}

pub(super) fn panel_bounds(panel: &Panel) -> LightBounds {
    let [a, b, c] = panel.corners;
    LightBounds {
        lo: a.min(b).min(c),
        hi: a.max(b).max(c),
        power: panel.radiance.element_sum() * 0.5 * (b - a).cross(c - a).length(),
        axis: panel.normal,
        cos_spread: 1.0,
        two_sided: false,
        all_around: false,
    }
}
