//! A point that light falls on.

use crate::accel;
use crate::scene::World;
use glam::{Vec2, Vec3};

/// A point on one side of a surface, in the frame.
#[derive(Debug, Clone, Copy)]
pub struct Receiver {
    /// Triangle id.
    pub triangle: u32,
    /// Barycentric weights of the second and third corner.
    pub uv: Vec2,
    /// Position moved off the surface: where rays start.
    pub origin: Vec3,
    /// Unit geometric normal of the receiving side.
    pub geometric_normal: Vec3,
    /// Unit shading normal of the receiving side; the geometric one unless smooth normals are asked for.
    pub shading_normal: Vec3,
}

/// Origins move towards the inner of their triangle by this share of their height.
const ASIDE: f32 = 0.71;

impl Receiver {
    /// The point of `triangle` at `uv`, seen from its front or back.
    pub fn new(world: &World, triangle: u32, uv: Vec2, back: bool, smooth: bool) -> Receiver {
        let side = if back { -1.0 } else { 1.0 };
        let geometric_normal = world.normals[triangle as usize] * side;
        let shading_normal = if smooth { world.shading_normal(triangle, uv) * side } else { geometric_normal };
        let position = world.position(triangle, uv);
        let origin = accel::offset_origin(position, geometric_normal, world.extent(triangle));
        // Straight up from an edge, it could be behind a surface that leans over there, inside a solid.
        let inwards = world.inner(triangle) - position;
        let aside = (ASIDE * (origin - position).length() / inwards.length().max(f32::MIN_POSITIVE)).min(1.0);
        let origin = origin + inwards * aside;
        Receiver { triangle, uv, origin, geometric_normal, shading_normal }
    }

    /// The point of `triangle` at `uv` where light arrives along `arriving`, over a free way of length `way`. `facing` is
    /// the normal on that side.
    pub fn met(world: &World, triangle: u32, uv: Vec2, facing: Vec3, arriving: Vec3, way: f32) -> Receiver {
        let (position, extent) = (world.position(triangle, uv), world.extent(triangle));
        let origin = accel::reflected_origin(position, facing, extent, arriving, way);
        Receiver { triangle, uv, origin, geometric_normal: facing, shading_normal: facing }
    }

    /// The same point on the far side of its surface.
    pub fn opposite(&self, world: &World) -> Receiver {
        let back = self.geometric_normal.dot(world.normals[self.triangle as usize]) > 0.0;
        Receiver::new(world, self.triangle, self.uv, back, false)
    }

    /// Where a ray starts that leaves through the surface, on its far side.
    pub fn beyond(&self, world: &World) -> Vec3 {
        let position = world.position(self.triangle, self.uv);
        accel::offset_origin(position, -self.geometric_normal, world.extent(self.triangle))
    }

    /// Cosines of a unit direction with the geometric and the shading normal; both 0 below the surface.
    pub fn cosines(&self, direction: Vec3) -> (f32, f32) {
        let g = self.geometric_normal.dot(direction);
        if g <= 0.0 { (0.0, 0.0) } else { (g, self.shading_normal.dot(direction).max(0.0)) }
    }
}
