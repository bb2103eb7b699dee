//! The lights of a bake: those of the scene, and those that the options add.

use super::groups::LightGroup;
use super::strength;
use crate::cache::Digest;
use crate::error::{BakeError, Warning};
use crate::options::{BakeOptions, SkySource};
use crate::scene::{BakeMode, ClearSky, Light, LightKind, Scene, Sky};
use glam::{DVec3, Mat3, Vec3};

/// All light sources besides emissive surfaces.
#[derive(Debug, Clone)]
pub struct Lighting {
    /// Lights that are no surfaces.
    pub lights: Vec<Light>,
    /// Light from beyond the geometry.
    pub sky: Option<Sky>,
    /// Groups of them whose light is kept apart; none where none are asked for.
    pub groups: Vec<LightGroup>,
    /// The sky is that of the scene's file.
    pub sky_of_scene: bool,
    /// What was odd about them.
    pub warnings: Vec<Warning>,
}

impl Lighting {
    /// Adds all that shines besides emissive surfaces.
    pub(crate) fn feed(&self, digest: &mut Digest) {
        digest.debug(&(&self.lights, &self.groups, self.sky.is_some()));
        self.sky.iter().for_each(|sky| sky.feed(digest));
    }

    /// The lights of `scene` with the sky and sun of `options`. A sky in the options replaces the scene's.
    ///
    /// # Errors
    /// A sky file that cannot be read, light that is too strong to be baked, or a group of lights that nothing is in.
    pub fn new(scene: &Scene, options: &BakeOptions) -> Result<Lighting, BakeError> {
        let mut lights = scene.lights.clone();
        let mut warnings = Vec::new();
        let scale = options.sky_scale;
        let sky = match &options.sky {
            None if scene.sky.is_none() && (scale != 1.0 || options.sky_rotation != 0.0) => {
                let what = "--sky-scale, --sky-rotation: neither the file nor --sky has a sky; leave them out";
                return Err(BakeError::Options(what.into()));
            }
            None => scene.sky.clone().map(|sky| sky.changed(options.sky_rotation, scale)),
            Some(SkySource::Constant(l)) => Some(Sky::Constant(*l * scale)),
            Some(SkySource::File(path)) => {
                let (sky, found) = Sky::from_file(path, options.sky_rotation, scale)?;
                warnings.extend(found);
                Some(sky)
            }
            Some(SkySource::Clear { turbidity, ground }) => {
                let towards_sun = options.sun.map_or(DVec3::Y, |sun| sun.towards());
                let clear = ClearSky { turbidity: *turbidity, ground: *ground, towards_sun };
                Some(clear.image(scale).map_err(|e| BakeError::Options(format!("--sky clear: {e}")))?)
            }
        };
        if let Some(sun) = options.sun {
            lights.push(Light {
                name: "sun".into(),
                node: None,
                position: DVec3::ZERO,
                direction: (-sun.towards()).as_vec3(),
                axes: Mat3::IDENTITY,
                intensity: Vec3::splat(sun.illuminance),
                kind: LightKind::Directional { angular_diameter: sun.diameter.to_radians() },
                profile: None,
                bake: BakeMode::Full,
            });
        }
        let sky_of_scene = options.sky.is_none() && sky.is_some();
        strength::check(scene, &lights, sky.as_ref(), sky_of_scene)?;
        let groups = LightGroup::all(scene, &lights, sky.is_some(), &options.groups)?;
        Ok(Lighting { lights, sky, sky_of_scene, groups, warnings })
    }
}
