//! Which part of a texel's surface lies inside closed solids.
//!
//! A floor under a box is never seen and never lit; as part of a texel's mean it would only darken the visible
//! rest. A point is *buried* if every ray from it meets the back of a one-sided surface first. The share of a
//! texel's area that is open divides its flux in place of the whole area.

use super::receiver::Receiver;
use super::visibility::Visibility;
use crate::accel::Ray;
use crate::atlas::{TexelSampler, Texels};
use crate::sampling::{cosine_hemisphere, hash_seed, sobol, unit_f32};
use crate::scene::SurfaceFlags;
use glam::Vec2;
use rayon::prelude::*;

/// Points per texel whose first look meets a back face; the share is known to about 1 / POINTS.
const POINTS: u32 = 64;

/// Rays that must all meet backs for a point to be buried.
const RAYS: u32 = 6;

/// Open share of the area of each texel of the map, in [0, 1], and the number of rays traced.
pub fn open_shares(texels: &Texels, visibility: &Visibility, seed: u64) -> (Vec<f32>, u64) {
    let results: Vec<(f32, u64)> = (0..texels.mapped)
        .into_par_iter()
        .map_init(TexelSampler::default, |sampler, id| {
            sampler.load(texels, id);
            let back = texels.texels[id].back;
            let scramble = hash_seed(&[seed, 0x6f70_656e, id as u64]);
            let mut rays = 0;
            let buried = |k: u32, rays: &mut u64| {
                let u = |d: usize| unit_f32(sobol(k, d, scramble));
                let (triangle, uv) = sampler.sample(Vec2::new(u(0), u(1)));
                let at = Receiver::new(visibility.world, triangle, uv, back, false);
                (0..RAYS).all(|j| {
                    *rays += 1;
                    let v = |d| unit_f32(sobol(k * RAYS + j, d, scramble));
                    meets_back(visibility, &at, Vec2::new(v(2), v(3)))
                })
            };
            // Few texels are near a solid's foot: four looks tell the rest.
            if !(0..4).any(|k| buried(k, &mut rays)) {
                return (1.0, rays);
            }
            let n = (0..POINTS).filter(|&k| buried(k, &mut rays)).count();
            (1.0 - n as f32 / POINTS as f32, rays)
        })
        .collect();
    let rays = results.iter().map(|r| r.1).sum();
    (results.into_iter().map(|r| r.0).collect(), rays)
}

fn meets_back(visibility: &Visibility, at: &Receiver, u: Vec2) -> bool {
    let direction = cosine_hemisphere(at.geometric_normal, u);
    let ray = Ray { origin: at.origin, direction, t_max: f32::INFINITY };
    visibility.accel.closest(&ray).is_some_and(|hit| {
        let flags = visibility.world.flags[hit.triangle as usize];
        let from_behind = visibility.world.normals[hit.triangle as usize].dot(direction) > 0.0;
        from_behind && !flags.has(SurfaceFlags::DOUBLE_SIDED) && !flags.has(SurfaceFlags::PASSES_LIGHT)
    })
}
