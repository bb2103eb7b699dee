//! The one place where it is decided whether a ray meets a triangle, and where.
//!
//! The watertight test of Woop, Benthin and Wald (JCGT 2013): corners are translated to the ray's origin and
//! sheared so that the ray becomes the z axis, both in f32, and the signs of three 2D edge functions decide.
//! Deviates: every edge function is evaluated in f64, where the products of f32 are exact and hence the sign is
//! always right; the paper does so only for those that come out 0. Two triangles that share an edge see the same
//! rounded corners and the same sign, so no ray passes between them, and the distance is as good as the rounded
//! corners even where the ray grazes. The vector kernels only sort out most of the triangles that are missed.

use super::Hit;
use super::ray::PreparedRay;
use super::wide::Packet;

/// Where a ray crosses a triangle's plane inside the triangle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Crossing {
    /// Triangle id.
    pub triangle: u32,
    /// Distance along the prepared ray.
    pub t: f32,
    /// Edge functions of the second and third corner, and the sum of all three.
    v: f64,
    w: f64,
    sum: f64,
}

impl Crossing {
    /// True if this one is met before `other`; of two at the same distance the lower id is.
    #[inline(always)]
    pub fn precedes(&self, other: &Crossing) -> bool {
        self.t < other.t || (self.t == other.t && self.triangle < other.triangle)
    }

    /// The crossing in the units of the ray it belongs to.
    #[inline]
    pub fn hit(&self, ray: &PreparedRay) -> Hit {
        let u = (self.v / self.sum) as f32;
        // Rounded on their own, the two can exceed 1 by an ulp.
        let v = ((self.w / self.sum) as f32).min(1.0 - u);
        Hit { triangle: self.triangle, t: ray.distance(self.t), u, v }
    }
}

/// Where the ray crosses the triangle in a lane, at a distance in (0, `ray.end`). A triangle seen edge-on is not
/// crossed: its neighbours are.
#[inline(always)]
pub(super) fn intersect(ray: &PreparedRay, packet: &Packet, lane: usize) -> Option<Crossing> {
    let [kx, ky, kz] = ray.axes;
    // Rounded exactly as the kernels do it; the products of the result are exact in f64.
    let corner = |k: usize| {
        let z = packet.corners[k][kz][lane] - ray.origin[kz];
        let x = (packet.corners[k][kx][lane] - ray.origin[kx]) - ray.shear[0] * z;
        let y = (packet.corners[k][ky][lane] - ray.origin[ky]) - ray.shear[1] * z;
        [f64::from(x), f64::from(y), f64::from(z)]
    };
    let (a, b, c) = (corner(0), corner(1), corner(2));
    let u = c[0] * b[1] - c[1] * b[0];
    let v = a[0] * c[1] - a[1] * c[0];
    let w = b[0] * a[1] - b[1] * a[0];
    if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
        return None;
    }
    let sum = u + v + w;
    let t = ((u * a[2] + v * b[2] + w * c[2]) / (sum * ray.direction_z)) as f32;
    // Also false for the NaN of a sum of 0.
    (t > 0.0 && t < ray.end).then_some(Crossing { triangle: packet.ids[lane], t, v, w, sum })
}
