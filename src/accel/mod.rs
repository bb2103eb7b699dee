//! 3. What a ray hits.
//!
//! In: triangles and rays in the normalised frame ([`crate::scene::World`]). Out: the nearest triangle with
//! its barycentric weights, or whether anything blocks. The hierarchy is built by obvhs, which is seen only
//! here; the traversal is our own: watertight, and with the same hits bit for bit whichever kernel runs.

use glam::Vec3;

/// A ray, or a segment: points `origin + t * direction` for t in (0, `t_max`).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Start, already moved off the surface it leaves.
    pub origin: Vec3,
    /// Direction, of any length > 0.
    pub direction: Vec3,
    /// End of the ray in units of `direction`; infinity for none.
    pub t_max: f32,
}

/// The nearest triangle along a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Triangle id; of two at the same distance, the lower one.
    pub triangle: u32,
    /// Distance in units of the ray's direction.
    pub t: f32,
    /// Barycentric weight of the second corner, in [0, 1].
    pub u: f32,
    /// Barycentric weight of the third corner, in [0, 1]; u + v <= 1.
    pub v: f32,
}

/// Triangles in a hierarchy that rays can be traced through.
#[derive(Debug)]
pub struct Accel {}
