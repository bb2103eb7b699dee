//! A ray made ready for traversal: everything that depends on the ray alone, computed once.
//!
//! Two things make the rest simple. The direction is scaled by a power of two so that its largest component
//! lies in [1, 2), hence nothing over- or underflows for short or long directions. And an origin far outside
//! is first moved along the ray, in f64, to near the triangles: at 10^6 times the size of the scene,
//! `vertex - origin` in f32 would have lost the scene altogether.

use super::Ray;
use glam::{DVec3, Vec3};

/// How far, in units of `f32::EPSILON * max(|origin|, |any corner|)`, a box is widened for a ray.
///
/// The sheared corners of [`super::triangle`] are rounded: with m the largest coordinate, `corner - origin` is at
/// most 2m and is off by 1 eps m, the shear (at most 1, rounded), the product and the difference add 5 eps m, and
/// the f32 corner along the ray another eps m. A ray that meets the rounded triangle thus passes within 7 eps m,
/// per axis, of the exact one, and `origin + pad` is itself rounded by half an eps.
const PAD: f32 = 8.0;

/// Factor on the far end of a box, for the rounding of both ends: a difference, a reciprocal and a product of
/// relative error eps / 2 each (Ize, Robust BVH Ray Traversal, JCGT 2013).
pub(super) const FAR_FACTOR: f32 = 1.0 + 4.0 * f32::EPSILON;

/// Stands for 1/0. Finite, so that a plane through the origin gives 0 and not NaN; and so large that any other
/// plane lies beyond everything.
const MAX_INVERSE: f32 = 1e18;

/// A ray ready for traversal. Distances are those of the scaled direction, counted from `origin`.
#[derive(Debug, Clone)]
pub(super) struct PreparedRay {
    /// Start, perhaps moved along the ray.
    pub origin: Vec3,
    /// Permutation of the axes: `axes[2]` is the largest component of the direction, and the winding is kept.
    pub axes: [usize; 3],
    /// What to take from x and y per unit of z, in permuted axes, to shear the ray onto the z axis; in [-1, 1].
    pub shear: [f32; 2],
    /// Largest component of the scaled direction, with its sign.
    pub direction_z: f64,
    /// Reciprocal of the scaled direction, finite.
    pub inverse: Vec3,
    /// Row of [`super::wide::Node::bounds`] in which the ray enters a box, by axis; `row ^ 1` is where it leaves.
    pub near_rows: [usize; 3],
    /// Origin moved forward by the padding: entry distances from it come out early.
    pub near_origin: Vec3,
    /// Origin moved back by the padding: exit distances from it come out late.
    pub far_origin: Vec3,
    /// End of the ray.
    pub end: f32,
    /// Distance from the ray's own origin to `origin`.
    start: f64,
    /// Lengths of the scaled direction per length of the given one, a power of two.
    scale: f64,
}

impl PreparedRay {
    /// Prepares `ray` for triangles all of whose coordinates are within [-`extent`, `extent`]. None if it can hit
    /// nothing: not finite, no direction, no length, or passing far from every triangle.
    #[inline]
    pub fn new(ray: &Ray, extent: f32) -> Option<PreparedRay> {
        let size = ray.direction.abs().max_element();
        let usable = ray.origin.is_finite() && ray.direction.is_finite() && size >= f32::MIN_POSITIVE;
        // The length may be NaN, which is not above 0.
        if !(usable && ray.t_max > 0.0) {
            return None;
        }
        // The exponent bits of `size` alone are the power of two below it.
        let scale = 1.0 / f64::from(f32::from_bits(size.to_bits() & 0x7f80_0000));
        let d = (ray.direction.as_dvec3() * scale).as_vec3();
        let end = f64::from(ray.t_max) / scale;
        let (origin, start) = if ray.origin.abs().max_element() <= 2.0 * extent {
            (ray.origin, 0.0)
        } else {
            approach(ray.origin, d, extent)?
        };
        let end = (end - start) as f32;
        if end <= 0.0 {
            return None;
        }

        let a = d.abs();
        let kz = if a.x > a.y && a.x > a.z {
            0
        } else if a.y > a.z {
            1
        } else {
            2
        };
        let (mut kx, mut ky) = ((kz + 1) % 3, (kz + 2) % 3);
        if d[kz] < 0.0 {
            std::mem::swap(&mut kx, &mut ky);
        }
        let inverse = Vec3::from_array(d.to_array().map(|x| (1.0 / x).clamp(-MAX_INVERSE, MAX_INVERSE)));
        let pad = Vec3::splat(PAD * f32::EPSILON * origin.abs().max_element().max(extent)).copysign(inverse);
        Some(PreparedRay {
            origin,
            axes: [kx, ky, kz],
            shear: [d[kx] / d[kz], d[ky] / d[kz]],
            direction_z: f64::from(d[kz]),
            inverse,
            near_rows: std::array::from_fn(|axis| 2 * axis + usize::from(inverse[axis] < 0.0)),
            near_origin: origin + pad,
            far_origin: origin - pad,
            end,
            start,
            scale,
        })
    }

    /// Distance in units of the given direction, from the given origin.
    pub fn distance(&self, t: f32) -> f32 {
        ((self.start + f64::from(t)) * self.scale) as f32
    }
}

/// Moves an origin along `d` to where it enters the cube of twice the extent, with the distance gone; None if it
/// passes the cube. In f64 from exact inputs: the moved ray is off by one rounding to f32 near the triangles, less
/// than the padding, and it is the same ray for every triangle.
#[cold]
fn approach(origin: Vec3, d: Vec3, extent: f32) -> Option<(Vec3, f64)> {
    let (o, d, reach) = (origin.as_dvec3(), d.as_dvec3(), 2.0 * f64::from(extent));
    let (mut enter, mut leave) = (0.0f64, f64::INFINITY);
    for axis in 0..3 {
        if d[axis] == 0.0 {
            if o[axis].abs() > reach {
                return None;
            }
            continue;
        }
        let towards = reach.copysign(d[axis]);
        enter = enter.max((-towards - o[axis]) / d[axis]);
        leave = leave.min((towards - o[axis]) / d[axis]);
    }
    if enter > leave {
        return None;
    }
    let moved: DVec3 = o + d * enter;
    Some((moved.as_vec3(), enter))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(origin: [f32; 3], direction: [f32; 3]) -> Ray {
        Ray { origin: origin.into(), direction: direction.into(), t_max: f32::INFINITY }
    }

    #[test]
    fn unusable_rays_are_refused() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for axis in 0..3 {
                let mut r = ray([0.0; 3], [0.0, 0.0, 1.0]);
                r.origin[axis] = bad;
                assert!(PreparedRay::new(&r, 1.0).is_none());
                let mut r = ray([0.0; 3], [0.0, 0.0, 1.0]);
                r.direction[axis] = bad;
                assert!(PreparedRay::new(&r, 1.0).is_none());
            }
        }
        assert!(PreparedRay::new(&ray([0.0; 3], [0.0; 3]), 1.0).is_none());
        for t_max in [0.0, -1.0, f32::NAN] {
            assert!(PreparedRay::new(&Ray { t_max, ..ray([0.0; 3], [1.0, 0.0, 0.0]) }, 1.0).is_none());
        }
    }

    #[test]
    fn far_origins_come_near_and_keep_their_distance() {
        let r = PreparedRay::new(&ray([1e6, 0.25, 0.0], [-4.0, 0.0, 0.0]), 1.0).expect("aims at the cube");
        assert_eq!(r.origin, Vec3::new(2.0, 0.25, 0.0));
        assert_eq!(r.distance(4.0), (1e6 + 2.0) / 4.0);
        assert!(PreparedRay::new(&ray([1e6, 2.5, 0.0], [-4.0, 0.0, 0.0]), 1.0).is_none());
        assert!(PreparedRay::new(&ray([1e6, 0.0, 0.0], [4.0, 0.0, 0.0]), 1.0).is_none());
    }

    #[test]
    fn any_length_of_direction_gives_the_same_ray() {
        let a = PreparedRay::new(&ray([0.1, 0.2, 0.3], [0.3, -0.5, 0.7]), 1.0).expect("a ray");
        for power in [-100i32, -20, 3, 100] {
            let s = 2f32.powi(power);
            let b = PreparedRay::new(&ray([0.1, 0.2, 0.3], [0.3 * s, -0.5 * s, 0.7 * s]), 1.0).expect("a ray");
            assert_eq!((a.inverse, a.shear, a.direction_z), (b.inverse, b.shear, b.direction_z));
            assert_eq!(a.distance(1.5) / s, b.distance(1.5));
        }
    }
}
