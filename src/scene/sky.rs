//! Light from beyond the geometry.

use glam::Vec3;
use std::sync::Arc;

/// Radiance of the surroundings as a function of direction.
#[derive(Debug, Clone)]
pub enum Sky {
    /// The same radiance [nit] from everywhere.
    Constant(Vec3),
    /// An equirectangular image: row 0 is straight up, the centre column looks along -Z, +X is to its right.
    Image {
        /// Width in texels.
        width: usize,
        /// Height in texels.
        height: usize,
        /// Radiance [nit], linear Rec. 709, row-major, non-negative and finite.
        radiance: Arc<[Vec3]>,
        /// Rotation about +Y [rad]: positive turns the picture counter-clockwise as seen from above.
        rotation: f32,
    },
}
impl Sky {
    /// stub
    pub fn from_file(
        _p: &std::path::Path,
        _r: f32,
        _s: f32,
    ) -> Result<(Sky, Vec<crate::error::Warning>), crate::error::SceneError> {
        Ok((Sky::Constant(Vec3::ZERO), vec![]))
    }
}
