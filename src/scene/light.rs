//! Lights without area, and cameras.

use glam::{DVec3, Vec3};

/// A light of KHR_lights_punctual, or a sun given on the command line.
#[derive(Debug, Clone)]
pub struct Light {
    /// Name of the light or its node.
    pub name: String,
    /// Index of the node in the source document; `None` for a light that is not from the file.
    pub node: Option<usize>,
    /// World position (m); meaningless for directional lights.
    pub position: DVec3,
    /// Unit direction in which the light travels, world space; meaningless for point lights.
    pub direction: Vec3,
    /// Colour times intensity: candela for point and spot lights, lux on a plane facing the light for
    /// directional ones.
    pub intensity: Vec3,
    /// Shape of the emission.
    pub kind: LightKind,
    /// Which part of its light is baked (extras `evenlight.bake` on the light or its node).
    pub bake: BakeMode,
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
}

/// Which part of a light's light goes into the maps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum BakeMode {
    /// Direct and reflected light.
    #[default]
    Full,
    /// Reflected light only: the engine adds the direct part at run time.
    Indirect,
    /// Nothing.
    Off,
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
