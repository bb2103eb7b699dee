//! How strong light may be: what is stated of it is found from squares in single precision, which end at 3.4e38.

use crate::error::{BakeError, SceneError};
use crate::scene::{Light, LightKind, Scene, Sky};

/// Most radiance of a surface or the sky (nit), and most light of a sun (lux). That of the sun's face is 1.6e9 nit.
pub const MOST_RADIANCE: f32 = 1e18;

/// Most intensity of a lamp (cd), as of IES files. The sun's is 3e27.
const MOST_INTENSITY: f32 = 1e30;

/// Most irradiance of a texel (lux): the square of twice as much in three channels is finite. A surface under a sky of
/// [`MOST_RADIANCE`] gets pi times that.
pub const MOST_IRRADIANCE: f32 = 5e18;

/// Refuses light that no bake can state an error of.
///
/// # Errors
/// [`SceneError::Invalid`] names the light or material; [`BakeError::Options`] the sun or sky of the options.
pub(super) fn check(scene: &Scene, lights: &[Light], sky: Option<&Sky>, sky_of_scene: bool) -> Result<(), BakeError> {
    let in_file = |what: String| {
        let what = format!("{what}; dim it in the file, or by --light NAME=SCALE");
        Err(SceneError::Invalid { path: scene.source.path.clone(), what }.into())
    };
    for light in lights {
        let (most, unit) = match light.kind {
            LightKind::Point | LightKind::Spot { .. } => (MOST_INTENSITY, "cd"),
            LightKind::Directional { .. } => (MOST_RADIANCE, "lux"),
            LightKind::Area(_) => (MOST_RADIANCE, "nit"),
        };
        let strength = light.intensity.max_element();
        if strength > most {
            let what = format!("{strength:e} {unit}, more than the {most:e} that can be baked");
            return match light.node {
                Some(_) => in_file(format!("light '{}' has {what}", light.name)),
                None => Err(BakeError::Options(format!("--sun: it has {what}"))),
            };
        }
    }
    for material in scene.emissive_materials().into_iter().map(|i| &scene.materials[i]) {
        let strength = material.emission.max_element();
        if strength > MOST_RADIANCE {
            let what = format!("{strength:e} nit, more than the {MOST_RADIANCE:e} that can be baked");
            return in_file(format!("material '{}' emits {what}", material.name));
        }
    }
    let strength = sky.map_or(0.0, Sky::largest);
    if strength > MOST_RADIANCE {
        let whose = if sky_of_scene { "the sky of the file" } else { "--sky" };
        let what = format!("{strength:e} nit, more than the {MOST_RADIANCE:e} that can be baked; see --sky-scale");
        return Err(BakeError::Options(format!("{whose}: it has {what}")));
    }
    Ok(())
}
