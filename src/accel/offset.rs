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
    position + normal * height(position, extent)
}

/// Where a ray leaves to the side from which light came to `position` along `arriving`, over a free way of length
/// `way`: as high as by [`offset_origin`], but back on that way. Straight up, beside an edge where another surface leans
/// over, it could be behind that one, inside a solid.
pub fn reflected_origin(position: Vec3, normal: Vec3, extent: f32, arriving: Vec3, way: f32) -> Vec3 {
    let height = height(position, extent);
    let cosine = -normal.dot(arriving);
    let back = (height / cosine.max(LEAST_COSINE)).min(0.5 * way);
    position - arriving * back + normal * (height - back * cosine).max(0.0)
}

fn height(position: Vec3, extent: f32) -> f32 {
    HEIGHT * f32::EPSILON * position.abs().max_element().max(extent)
}

/// Light that comes in at a lower angle is not followed back all the way.
const LEAST_COSINE: f32 = 0.05;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moves_along_the_normal_by_a_few_millionths() {
        let p = offset_origin(Vec3::new(0.5, 0.0, -0.25), Vec3::Y, 1.0);
        assert_eq!((p.x, p.z), (0.5, -0.25));
        assert!(p.y > 3e-6 && p.y < 4e-6, "moved by {}", p.y);
    }

    #[test]
    fn what_is_reflected_leaves_from_where_it_came() {
        let at = Vec3::new(0.5, 0.0, -0.25);
        let plain = offset_origin(at, Vec3::Y, 1.0).y;
        for cosine in [1.0f32, 0.5, 0.1, 0.01] {
            let arriving = Vec3::new((1.0 - cosine * cosine).sqrt(), -cosine, 0.0);
            let p = reflected_origin(at, Vec3::Y, 1.0, arriving, 1.0);
            assert!((p.y / plain - 1.0).abs() < 1e-5, "as high at {cosine}");
            let off = (p - at).cross(arriving).length();
            assert!(cosine < LEAST_COSINE || off < 1e-7, "off the way by {off} at {cosine}");
        }
        // No further than half of the way.
        let p = reflected_origin(at, Vec3::Y, 1.0, Vec3::NEG_Y, 1e-6);
        assert!((p.y / plain - 1.0).abs() < 1e-5);
    }
}
