//! Point, spot and directional lights in the frame.

use super::emitters::LightSettings;
use super::receiver::Receiver;
use super::tree::LightBounds;
use crate::scene::{BakeMode, IesProfile, Light, LightKind, World};
use glam::{Mat3, Vec3};
use std::sync::Arc;

/// A light without area, in the frame.
#[derive(Debug, Clone)]
pub(super) struct Punctual {
    pub(super) position: Vec3,
    pub(super) direction: Vec3,
    /// Candela over metres^2 of the frame unit: E = intensity cos / distance^2 in frame units. Lux for
    /// directional lights.
    pub(super) intensity: Vec3,
    pub(super) shape: Shape,
    pub(super) stored: bool,
}

#[derive(Debug, Clone)]
pub(super) enum Shape {
    Point,
    /// Falloff of a profile. Elsewhere, since most lights have none, and all are looked at again and again.
    Profile(Box<PlacedProfile>),
    /// Spot falloff ((cos - cos_outer) * scale)^2, clamped.
    Spot {
        cos_outer: f32,
        scale: f32,
    },
    /// Cosine of half the angular diameter; 1 for parallel light.
    Directional {
        cos_radius: f32,
    },
}

/// A profile in the frame whose axes are the rows.
#[derive(Debug, Clone)]
pub(super) struct PlacedProfile {
    profile: Arc<IesProfile>,
    light_from_world: Mat3,
}

impl PlacedProfile {
    #[inline(never)]
    fn share(&self, towards: Vec3) -> f32 {
        self.profile.share(self.light_from_world * towards)
    }
}

impl Punctual {
    /// Whether it stands somewhere.
    pub(super) fn is_lamp(&self) -> bool {
        !matches!(self.shape, Shape::Directional { .. })
    }

    /// The way from `at` to a point or spot light, its unit direction, and the share of the intensity that goes there
    /// over the distance squared; `None` on the light itself.
    #[inline]
    pub(super) fn towards(&self, at: &Receiver) -> Option<(Vec3, Vec3, f32)> {
        let to = self.position - at.origin;
        let d2 = to.length_squared();
        if d2 < 1e-14 {
            return None;
        }
        let w = to / d2.sqrt();
        let cone = match &self.shape {
            Shape::Spot { cos_outer, scale } => {
                let f = ((self.direction.dot(-w) - cos_outer) * scale).clamp(0.0, 1.0);
                f * f
            }
            Shape::Profile(placed) => placed.share(-w),
            Shape::Point | Shape::Directional { .. } => 1.0,
        };
        Some((to, w, cone / d2))
    }
}

/// A light without area; `None` for one that has one.
pub(super) fn to_frame(light: &Light, world: &World, settings: LightSettings) -> Option<Punctual> {
    let m = world.frame.metres;
    let (shape, scale) = match light.kind {
        LightKind::Point => match &light.profile {
            None => (Shape::Point, 1.0 / (m * m)),
            Some(profile) => {
                let light_from_world = light.axes.transpose();
                let placed = PlacedProfile { profile: profile.clone(), light_from_world };
                (Shape::Profile(Box::new(placed)), 1.0 / (m * m))
            }
        },
        LightKind::Spot { inner, outer } => {
            let (ci, co) = (libm::cosf(inner), libm::cosf(outer));
            (Shape::Spot { cos_outer: co, scale: 1.0 / (ci - co).max(1e-4) }, 1.0 / (m * m))
        }
        LightKind::Directional { angular_diameter } => {
            // Lux count on a plane facing the light: the mean cosine over the disc belongs to them.
            let cos_radius = libm::cos(f64::from(angular_diameter) * 0.5);
            (Shape::Directional { cos_radius: cos_radius as f32 }, 2.0 / (1.0 + cos_radius))
        }
        LightKind::Area(_) => return None,
    };
    Some(Punctual {
        position: world.frame.from_world(light.position),
        direction: light.direction,
        intensity: light.intensity * scale as f32,
        shape,
        stored: !settings.indirect_only && light.bake == BakeMode::Full,
    })
}

/// Bounds of a point or spot light. Those of a profile send its flux, spread as the cone around it is.
pub(super) fn punctual_bounds(light: &Punctual) -> LightBounds {
    let around = LightBounds {
        lo: light.position,
        hi: light.position,
        power: light.intensity.element_sum(),
        axis: Vec3::Y,
        cos_spread: -1.0,
        two_sided: false,
        all_around: true,
    };
    let Shape::Profile(placed) = &light.shape else { return around };
    let PlacedProfile { profile, light_from_world } = &**placed;
    let (axis, angle) = profile.cone();
    let share = profile.flux() / (profile.peak() * cone_integral(f64::from(angle)));
    LightBounds {
        power: around.power * share.clamp(1e-3, 1.0) as f32,
        axis: light_from_world.transpose() * axis,
        cos_spread: libm::cosf(angle),
        all_around: false,
        ..around
    }
}

/// Integral over all directions of cos(max(0, t - angle)), t the angle to an axis, up to a right angle beyond [sr].
fn cone_integral(angle: f64) -> f64 {
    use std::f64::consts::{FRAC_PI_2, PI};
    let (s, c) = libm::sincos(angle);
    let beyond = FRAC_PI_2.min(PI - angle);
    let sin = libm::sin(beyond);
    2.0 * PI * (1.0 - c + s * (0.5 * beyond + 0.25 * libm::sin(2.0 * beyond)) + 0.5 * c * sin * sin)
}

#[cfg(test)]
mod tests {
    use super::cone_integral;
    use std::f64::consts::PI;

    /// A ray sends pi, as a surface does; all around it is the whole sphere; between them against a sum.
    #[test]
    fn cones_integrate() {
        assert!((cone_integral(0.0) - PI).abs() < 1e-12 && (cone_integral(PI) - 4.0 * PI).abs() < 1e-12);
        for angle in [0.3, 1.0, 2.0, 3.0] {
            let n = 100_000;
            let t = |k: i32| (f64::from(k) + 0.5) * PI / f64::from(n);
            let bound = |t: f64| if t > angle + PI / 2.0 { 0.0 } else { (t - angle).max(0.0).cos() };
            let sum: f64 = (0..n).map(|k| bound(t(k)) * t(k).sin() * 2.0 * PI * PI / f64::from(n)).sum();
            assert!((cone_integral(angle) - sum).abs() < 1e-6, "{angle}: {}, not {sum}", cone_integral(angle));
        }
    }
}
