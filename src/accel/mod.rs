//! 3. What a ray hits.
//!
//! In: triangles and rays in the normalised frame ([`crate::scene::World`]). Out: the nearest triangle with
//! its barycentric weights, or whether anything blocks. The hierarchy is built by obvhs, which is seen only
//! here; the traversal is our own: watertight, and with the same hits bit for bit whichever kernel runs.

mod build;
mod coincident;
mod kernel;
mod offset;
mod ray;
mod traverse;
mod triangle;
mod wide;

pub use coincident::{LAYERS, PARTING, coincident_warning, part_coincident};
pub use kernel::Kernel;
pub use offset::{offset_origin, reflected_origin};

use glam::Vec3;
use ray::PreparedRay;
use std::ops::ControlFlow;
use traverse::{Any, Closest, Each, trace};
use wide::{Node, Packet};

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
///
/// Both sides of a triangle are met. Triangles that share the positions of an edge leave no gap there. A ray that
/// runs exactly within a triangle's plane does not meet that triangle, and a ray that is not finite or has no
/// direction meets nothing.
///
/// What is hit depends on the triangles and the ray alone: not on the hierarchy, the kernel or the threads that
/// built it. Origins may lie far outside: distances are then compared before they are rounded to f32.
///
/// ```
/// use evenlight::accel::{Accel, Ray};
/// use glam::Vec3;
///
/// let triangle = [Vec3::ZERO, Vec3::X, Vec3::Y];
/// let accel = Accel::build(&[triangle], |_| false);
/// let ray = Ray { origin: Vec3::new(0.25, 0.5, 0.75), direction: Vec3::NEG_Z, t_max: f32::INFINITY };
/// let hit = accel.closest(&ray).expect("the ray points at the triangle");
/// assert_eq!((hit.triangle, hit.t, hit.u, hit.v), (0, 0.75, 0.25, 0.5));
/// ```
#[derive(Debug)]
pub struct Accel {
    nodes: Vec<Node>,
    packets: Vec<Packet>,
    /// Largest |coordinate| of any triangle.
    extent: f32,
    kernel: Kernel,
}

impl Accel {
    /// Builds the hierarchy of `triangles`, whose ids are their indices. Those for which `skip` is true are left
    /// out, and so are those with a corner that is not finite.
    ///
    /// Runs on the current rayon pool; the hits do not depend on its threads.
    pub fn build(triangles: &[[Vec3; 3]], skip: impl Fn(u32) -> bool) -> Accel {
        let (nodes, packets, extent) = build::build(triangles, skip);
        Accel { nodes, packets, extent, kernel: Kernel::best() }
    }

    /// The nearest triangle along the ray, at a distance in (0, `t_max`).
    pub fn closest(&self, ray: &Ray) -> Option<Hit> {
        let ray = PreparedRay::new(ray, self.extent)?;
        let mut query = Closest::new(&ray);
        trace(self.kernel, &self.nodes, &self.packets, &ray, &mut query);
        query.hit(&ray)
    }

    /// True if the ray meets any triangle at a distance in (0, `t_max`).
    pub fn occluded(&self, ray: &Ray) -> bool {
        PreparedRay::new(ray, self.extent)
            .is_some_and(|ray| trace(self.kernel, &self.nodes, &self.packets, &ray, &mut Any { end: ray.end }))
    }

    /// Calls `visit` for every triangle that the ray crosses at a distance in (0, `t_max`): each once, in no
    /// order, until it returns `Break`. True if it did.
    pub fn visit_hits(&self, ray: &Ray, visit: impl FnMut(Hit) -> ControlFlow<()>) -> bool {
        PreparedRay::new(ray, self.extent)
            .is_some_and(|ray| trace(self.kernel, &self.nodes, &self.packets, &ray, &mut Each { ray: &ray, visit }))
    }

    /// The kernel in use: the fastest of this processor, unless another was chosen.
    pub fn kernel(&self) -> Kernel {
        self.kernel
    }

    /// The same triangles with another kernel, for tests and measurements. One that this processor lacks leaves
    /// the choice as it is.
    pub fn with_kernel(self, kernel: Kernel) -> Accel {
        if kernel.is_available() { Accel { kernel, ..self } } else { self }
    }

    /// Memory held, in bytes.
    pub fn memory_bytes(&self) -> usize {
        self.nodes.capacity() * size_of::<Node>() + self.packets.capacity() * size_of::<Packet>()
    }
}
