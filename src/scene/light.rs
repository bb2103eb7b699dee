//! Lights that are no surfaces of the scene, and cameras.

use super::IesProfile;
use glam::{DVec2, DVec3, Mat3, Vec3};
use std::sync::Arc;

/// A light of KHR_lights_punctual, EXT_lights_ies or EXT_lights_area, or a sun given on the command line.
#[derive(Debug, Clone)]
pub struct Light {
    /// Name of the light or its node.
    pub name: String,
    /// Index of the node in the source document; `None` for a light that is not from the file.
    pub node: Option<usize>,
    /// World position (m), of the centre where it has an area; meaningless for directional lights.
    pub position: DVec3,
    /// Unit direction in which the light travels, world space; meaningless for point lights.
    pub direction: Vec3,
    /// Unit axes of the light's frame in world space; it shines along its -Z. A node that mirrors mirrors its light.
    pub axes: Mat3,
    /// Colour times intensity: candela for point and spot lights, along the brightest direction of those with a
    /// profile; lux on a plane facing the light for directional ones; nit for those with an area.
    pub intensity: Vec3,
    /// Shape of the emission.
    pub kind: LightKind,
    /// How a point light's intensity depends on the direction; `None`: as `kind` says.
    pub profile: Option<Arc<IesProfile>>,
    /// Which part of its light is baked (extras `evenlight.bake` on the light or its node).
    pub bake: BakeMode,
}

impl Light {
    /// Makes this a point light whose intensity is that of `profile`, times `color`, times what the tilt of the
    /// luminaire leaves of it: the angle between the light's -Z and straight down, -Y.
    pub fn set_profile(&mut self, profile: Arc<IesProfile>, color: Vec3) {
        let tilt = libm::acos(f64::from(self.direction.dot(Vec3::NEG_Y)).clamp(-1.0, 1.0));
        self.intensity = color * (profile.peak() * profile.tilt_factor(tilt)) as f32;
        self.kind = LightKind::Point;
        self.profile = Some(profile);
    }
}

/// Shape of a light's emission.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LightKind {
    /// The same intensity everywhere.
    Point,
    /// Full intensity inside `inner`, zero outside `outer`; between them the squared linear ramp in the
    /// cosine that KHR_lights_punctual recommends.
    Spot {
        /// Half angle of the full cone (rad).
        inner: f32,
        /// Half angle of the whole cone (rad), > `inner`.
        outer: f32,
    },
    /// From infinitely far away.
    Directional {
        /// Angular diameter of the disc (rad); 0 for parallel light.
        angular_diameter: f32,
    },
    /// A flat surface about the light's position, across its -Z: it shines to that side alone, evenly, by Lambert's
    /// law. It is not seen and blocks nothing.
    Area(AreaShape),
}

/// Outline of a light with area, in the plane of its X and Y.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AreaShape {
    /// A rectangle.
    Rectangle {
        /// Extent along X (m), > 0.
        width: f64,
        /// Extent along Y (m), > 0.
        height: f64,
    },
    /// A disc.
    Disc {
        /// Radius (m), > 0.
        radius: f64,
    },
}

/// Corners of the polygon that stands for a disc. With the area of the disc, its irradiance on the axis is that of the
/// disc to within 0.004 % at any distance. So few that two discs are still weighed without the light tree.
const DISC_CORNERS: u32 = 16;

impl AreaShape {
    /// Its triangles (m), of the same area together as the shape; counter-clockwise as seen from +Z.
    pub fn triangles(&self) -> Vec<[DVec2; 3]> {
        match *self {
            AreaShape::Rectangle { width, height } => {
                let corner = |x: f64, y: f64| DVec2::new(0.5 * x * width, 0.5 * y * height);
                let [a, b, c, d] = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
                vec![[a, b, c], [a, c, d]]
            }
            AreaShape::Disc { radius } => {
                use std::f64::consts::TAU;
                let step = TAU / f64::from(DISC_CORNERS);
                // Of a regular polygon with n corners at r the area is n / 2 r^2 sin(2 pi / n).
                let r = radius * (step / libm::sin(step)).sqrt();
                let corner = |k: u32| {
                    let (s, c) = libm::sincos(f64::from(k % DISC_CORNERS) * step);
                    DVec2::new(c, s) * r
                };
                (0..DISC_CORNERS).map(|k| [DVec2::ZERO, corner(k), corner(k + 1)]).collect()
            }
        }
    }
}

/// Which part of a light's light goes into the maps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
pub enum BakeMode {
    /// Direct and reflected light.
    #[default]
    Full,
    /// Reflected light only: the engine adds the direct part at run time.
    Indirect,
    /// Nothing.
    Off,
}

impl BakeMode {
    /// `full`, `indirect` or `off`.
    pub fn word(self) -> &'static str {
        match self {
            BakeMode::Full => "full",
            BakeMode::Indirect => "indirect",
            BakeMode::Off => "off",
        }
    }
}

/// A camera of the file, for previews.
#[derive(Debug, Clone)]
pub struct Camera {
    /// Name of the camera or its node.
    pub name: String,
    /// World position (m).
    pub position: DVec3,
    /// Unit view direction, world space.
    pub forward: Vec3,
    /// Unit up vector, world space.
    pub up: Vec3,
    /// Perspective or parallel.
    pub projection: Projection,
}

/// Projection of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Projection {
    /// Vertical field of view (rad), and width over height where the file gives it.
    Perspective {
        /// Full vertical angle (rad).
        vertical_fov: f32,
        /// Width over height, if given.
        aspect: Option<f32>,
    },
    /// Half extents (m).
    Orthographic {
        /// Half the width (m).
        half_width: f32,
        /// Half the height (m).
        half_height: f32,
    },
}
