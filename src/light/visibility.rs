//! How much light passes between two points.

use crate::accel::{Accel, Hit, Ray};
use crate::scene::{SurfaceFlags, World};
use glam::{Vec2, Vec3};
use std::ops::ControlFlow;

/// Shadow rays through a world.
#[derive(Debug, Clone, Copy)]
pub struct Visibility<'a> {
    /// Materials and geometry.
    pub world: &'a World<'a>,
    /// What rays meet.
    pub accel: &'a Accel,
    /// Some surface passes light: otherwise every hit blocks and no material is looked at.
    pub some_pass: bool,
}

impl<'a> Visibility<'a> {
    /// Looks once through the flags of `world`.
    pub fn new(world: &'a World<'a>, accel: &'a Accel) -> Visibility<'a> {
        let some_pass = world.flags.iter().any(|f| f.has(SurfaceFlags::PASSES_LIGHT));
        Visibility { world, accel, some_pass }
    }

    /// The nearest surface less than `reach` straight above a point of another, if light does not pass it. `origin` is
    /// off that point's own surface already.
    pub fn opaque_above(&self, origin: Vec3, normal: Vec3, reach: f32) -> Option<Hit> {
        let passes = |t: u32| self.world.flags[t as usize].has(SurfaceFlags::PASSES_LIGHT);
        let up = Ray { origin, direction: normal, t_max: reach };
        self.accel.closest(&up).filter(|hit| !passes(hit.triangle))
    }

    /// Share of light per channel that passes along `ray`, in [0, 1]: exact, since every surface crossed
    /// multiplies once and the order does not matter.
    pub fn transmittance(&self, ray: &Ray) -> Vec3 {
        if !self.some_pass {
            return if self.accel.occluded(ray) { Vec3::ZERO } else { Vec3::ONE };
        }
        let (mut passed, length) = (Vec3::ONE, ray.direction.length());
        let blocked = self.accel.visit_hits(ray, |hit| {
            if !self.world.flags[hit.triangle as usize].has(SurfaceFlags::PASSES_LIGHT) {
                return ControlFlow::Break(());
            }
            let s = self.world.surface(hit.triangle, Vec2::new(hit.u, hit.v));
            passed *= s.passed(self.world.normals[hit.triangle as usize].dot(ray.direction) / length);
            if passed.max_element() <= 0.0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        if blocked { Vec3::ZERO } else { passed }
    }
}
