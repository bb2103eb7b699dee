//! The lights of a bake: those of the scene, and those that the options add.

use crate::error::{BakeError, Warning};
use crate::options::{BakeOptions, SkySource};
use crate::scene::{BakeMode, Light, LightKind, Scene, Sky};
use glam::{DVec3, Mat3, Vec3};

/// All light sources besides emissive surfaces.
#[derive(Debug, Clone)]
pub struct Lighting {
    /// Lights without area.
    pub lights: Vec<Light>,
    /// Light from beyond the geometry.
    pub sky: Option<Sky>,
    /// What was odd about them.
    pub warnings: Vec<Warning>,
}

impl Lighting {
    /// The lights of `scene` with the sky and sun of `options`. A sky in the options replaces the scene's.
    ///
    /// # Errors
    /// A sky file that cannot be read.
    pub fn new(scene: &Scene, options: &BakeOptions) -> Result<Lighting, BakeError> {
        let mut lights = scene.lights.clone();
        let mut warnings = Vec::new();
        let scale = options.sky_scale;
        let sky = match &options.sky {
            None => scene.sky.clone(),
            Some(SkySource::Constant(l)) => Some(Sky::Constant(*l * scale)),
            Some(SkySource::File(path)) => {
                let (sky, found) = Sky::from_file(path, options.sky_rotation, scale)?;
                warnings.extend(found);
                Some(sky)
            }
        };
        if let Some(sun) = options.sun {
            let (e, a) = (f64::from(sun.elevation).to_radians(), f64::from(sun.azimuth).to_radians());
            let ((se, ce), (sa, ca)) = (libm::sincos(e), libm::sincos(a));
            let towards = DVec3::new(sa * ce, se, -ca * ce);
            lights.push(Light {
                name: "sun".into(),
                node: None,
                position: DVec3::ZERO,
                direction: (-towards).as_vec3(),
                axes: Mat3::IDENTITY,
                intensity: Vec3::splat(sun.illuminance),
                kind: LightKind::Directional { angular_diameter: sun.diameter.to_radians() },
                profile: None,
                bake: BakeMode::Full,
            });
        }
        Ok(Lighting { lights, sky, warnings })
    }
}
