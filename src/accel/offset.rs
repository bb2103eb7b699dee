//! Moving the start of a ray off the surface that it leaves.

use glam::Vec3;

/// Height of the new origin over the surface, in units of `f32::EPSILON * max(|position|, extent)`.
///
/// With M that maximum and errors counted along the normal (at most sqrt(3) times those per axis): a position
/// interpolated from three corners is off its plane by at most gamma(7) M = 3.5 eps M per axis (Pharr, Jakob and
/// Humphreys, Physically Based Rendering, section 6.8), that is 6.1 eps M. The watertight test sees the corners
/// moved by at most 7 eps M per axis (see `PAD` in the ray's preparation), 12.1 eps M; this holds for a grazing ray
/// too, since its distances are computed from the moved corners without further loss. Adding the height rounds by
/// 0.9 eps M. Together 19.1, taken to the next power of two.
const HEIGHT: f32 = 32.0;

/// Moves a point off its surface along `normal`, far enough that a ray that leaves to that side does not meet the
/// plane of its own triangle again.
///
/// `position` was interpolated from the triangle's corners in f32; `normal` is its geometric unit normal, turned to
/// the side of the ray; `extent` is the largest |coordinate| of the triangle, or of all: 1 in the normalised frame,
/// where the point moves by 3.8e-6. Holds for directions with a cosine to the normal of at least 1e-4; below that, the
/// rounding of the normal itself matters on long triangles.
pub fn offset_origin(position: Vec3, normal: Vec3, extent: f32) -> Vec3 {
    position + normal * (HEIGHT * f32::EPSILON * position.abs().max_element().max(extent))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moves_along_the_normal_by_a_few_millionths() {
        let p = offset_origin(Vec3::new(0.5, 0.0, -0.25), Vec3::Y, 1.0);
        assert_eq!((p.x, p.z), (0.5, -0.25));
        assert!(p.y > 3e-6 && p.y < 4e-6, "moved by {}", p.y);
    }
}
