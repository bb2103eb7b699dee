//! Which part of a texel's surface lies inside closed solids, or under another surface.
//!
//! A floor under a box is never seen and never lit; as part of a texel's mean it would only darken the visible
//! rest. Nor is a sheet seen that another lies upon, but light that strays between two white ones is reflected
//! hundreds of times and would outshine all else. A point is *buried* if another surface lies upon it, much nearer
//! than a texel is wide, or if every ray from it meets such a one or the back of a one-sided surface first. The share of a texel's area that is
//! open divides its flux in place of the whole area.

use super::receiver::Receiver;
use super::visibility::Visibility;
use crate::accel::{PARTING, Ray};
use crate::atlas::{TexelSampler, Texels};
use crate::sampling::{cosine_hemisphere, hash_seed, sobol, unit_f32};
use crate::scene::SurfaceFlags;
use glam::Vec2;
use rayon::prelude::*;

/// Points per texel that tell whether it is near a solid's foot.
const FIRST_POINTS: u32 = 2;

/// Points per texel beside one in which a buried point was found.
const SECOND_POINTS: u32 = 4;

/// Points per texel with a buried point; its open share is known to about 1 / POINTS.
const POINTS: u32 = 64;

/// A surface nearer than this share of a texel's side lies upon it.
pub const COVER: f32 = 1.0 / 32.0;

/// A surface that was parted from another in its plane lies under it, however small texels are [frame units].
const LEAST_COVER: f32 = 2.0 * PARTING;

/// Rays that must all meet backs or a cover for a point to be buried.
const RAYS: u32 = 6;

/// Open share of the area of each texel of the map, in [0, 1], and the number of rays traced.
///
/// Few texels are near a solid's foot: two points each find most of those, four points their neighbours, and only
/// texels with a buried point get the points that tell the share.
pub fn open_shares(texels: &Texels, visibility: &Visibility, seed: u64) -> (Vec<f32>, u64) {
    let found: Vec<(bool, u64)> = map_texels(texels, |sampler, id| {
        let mut probe = Probe::new(texels, visibility, sampler, seed, id);
        ((0..FIRST_POINTS).any(|k| probe.buried(k)), probe.rays)
    });
    let beside = |id: usize| texels.around(id).any(|n| found[n].0);
    let shares: Vec<(f32, u64)> = map_texels(texels, |sampler, id| {
        if !found[id].0 && !beside(id) {
            return (1.0, 0);
        }
        let mut probe = Probe::new(texels, visibility, sampler, seed, id);
        (probe.open_share(found[id].0), probe.rays)
    });
    let rays = found.iter().map(|f| f.1).chain(shares.iter().map(|s| s.1)).sum();
    (shares.into_iter().map(|s| s.0).collect(), rays)
}

fn map_texels<T: Send>(texels: &Texels, f: impl Fn(&mut TexelSampler, usize) -> T + Sync + Send) -> Vec<T> {
    (0..texels.mapped).into_par_iter().map_init(TexelSampler::default, f).collect()
}

/// Looks from points of one texel.
struct Probe<'a> {
    visibility: &'a Visibility<'a>,
    sampler: &'a TexelSampler,
    back: bool,
    /// Distance below which a surface is a cover [frame units].
    cover: f32,
    scramble: u32,
    rays: u64,
}

impl<'a> Probe<'a> {
    fn new(
        texels: &Texels,
        visibility: &'a Visibility,
        sampler: &'a mut TexelSampler,
        seed: u64,
        id: usize,
    ) -> Probe<'a> {
        sampler.load(texels, id);
        let scramble = hash_seed(&[seed, 0x6f70_656e, id as u64]);
        let t = &texels.texels[id];
        Probe { visibility, sampler, back: t.back, cover: (COVER * t.area.sqrt()).max(LEAST_COVER), scramble, rays: 0 }
    }

    /// Whether all rays from point `k` meet backs or a cover.
    fn buried(&mut self, k: u32) -> bool {
        let u = |d: usize| unit_f32(sobol(k, d, self.scramble));
        let (triangle, uv) = self.sampler.sample(Vec2::new(u(0), u(1)));
        let at = Receiver::new(self.visibility.world, triangle, uv, self.back, false);
        self.rays += 1;
        if covered(self.visibility, &at, self.cover) {
            return true;
        }
        (0..RAYS).all(|j| {
            self.rays += 1;
            let v = |d| unit_f32(sobol(k * RAYS + j, d, self.scramble));
            blind(self.visibility, &at, Vec2::new(v(2), v(3)), self.cover)
        })
    }

    /// Share of the points that are not buried, 1 where `known` says nothing and none of the first is.
    fn open_share(&mut self, known: bool) -> f32 {
        if !known && !(0..SECOND_POINTS).any(|k| self.buried(k)) {
            return 1.0;
        }
        let n = (0..POINTS).filter(|&k| self.buried(k)).count();
        1.0 - n as f32 / POINTS as f32
    }
}

/// Whether a surface that light does not pass lies upon the point, less than `cover` above it.
fn covered(visibility: &Visibility, at: &Receiver, cover: f32) -> bool {
    let ray = Ray { origin: at.origin, direction: at.geometric_normal, t_max: cover };
    let passes = |t: u32| visibility.world.flags[t as usize].has(SurfaceFlags::PASSES_LIGHT);
    visibility.accel.closest(&ray).is_some_and(|hit| !passes(hit.triangle))
}

/// Whether a ray meets a back, or a surface nearer than `cover`.
fn blind(visibility: &Visibility, at: &Receiver, u: Vec2, cover: f32) -> bool {
    let direction = cosine_hemisphere(at.geometric_normal, u);
    let ray = Ray { origin: at.origin, direction, t_max: f32::INFINITY };
    visibility.accel.closest(&ray).is_some_and(|hit| {
        let flags = visibility.world.flags[hit.triangle as usize];
        let from_behind = visibility.world.normals[hit.triangle as usize].dot(direction) > 0.0;
        let back = from_behind && !flags.has(SurfaceFlags::DOUBLE_SIDED);
        (back || hit.t < cover) && !flags.has(SurfaceFlags::PASSES_LIGHT)
    })
}
