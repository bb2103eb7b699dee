//! Which part of a texel's surface lies inside closed solids, or under another surface.
//!
//! A floor under a box is never seen and never lit; as part of a texel's mean it would only darken the visible
//! rest. Nor is a sheet seen that another lies upon, but light that strays between two white ones is reflected
//! hundreds of times and would outshine all else. A point is *buried* if another surface lies upon it, much nearer
//! than a texel is wide, or if every ray from it meets such a one or the back of a one-sided surface first. The share
//! of a texel's area that is open divides its flux in place of the whole area.

use super::receiver::Receiver;
use super::visibility::Visibility;
use crate::accel::{Hit, LAYERS, PARTING, Ray};
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

/// A surface that was parted from another in its plane lies under it, however small texels are: by one layer, or two
/// where three sheets meet [frame units].
const LEAST_COVER: f32 = 3.0 * PARTING;

/// Rays that must all meet backs or a cover for a point to be buried, ...
const RAYS: u32 = 6;

/// ... and for the first buried point of a texel, which makes it one of the few: from beside the back of a one-sided
/// wall half of all rays meet it, so that by six of them alone one of 64 such points would pass for buried.
const FIRST_RAYS: u32 = 32;

/// Open share of the area of each texel of the map, in [0, 1], and the number of rays traced.
///
/// Few texels are near a solid's foot: two points each find most of those, four points their neighbours, and only
/// texels with a buried point get the points that tell the share.
pub fn open_shares(texels: &Texels, visibility: &Visibility, seed: u64) -> (Vec<f32>, u64) {
    let found: Vec<(bool, u64)> = map_texels(texels, |sampler, id| {
        let mut probe = Probe::new(texels, visibility, sampler, seed, id);
        ((0..FIRST_POINTS).any(|k| probe.buried(k, FIRST_RAYS)), probe.rays)
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

/// For each texel of the map the one whose light it shows: its own, unless it has no open surface and lies under a
/// sheet turned to the same side. Seen through that, as z-fighting does, it should look the same.
pub fn shown_texels(texels: &Texels, visibility: &Visibility, open: &[f32]) -> Vec<u32> {
    let above: Vec<u32> = map_texels(texels, |sampler, id| {
        let above = || {
            let t = &texels.texels[id];
            sampler.load(texels, id);
            let (triangle, uv) = sampler.sample(Vec2::splat(0.5));
            let at = Receiver::new(visibility.world, triangle, uv, t.back, false);
            let hit = cover_above(visibility, &at, cover_height(t.area))?;
            let front = visibility.world.normals[hit.triangle as usize].dot(at.geometric_normal) > 0.0;
            let two_sided = visibility.world.flags[hit.triangle as usize].has(SurfaceFlags::DOUBLE_SIDED);
            let by = (front || two_sided).then(|| texels.at(hit.triangle, !front, Vec2::new(hit.u, hit.v)))??;
            ((by as usize) < texels.mapped).then_some(by)
        };
        let covered = open[id] == 0.0;
        covered.then(above).flatten().unwrap_or(id as u32)
    });
    // Through all the sheets that lie upon each other, up to one that is open.
    let top = |id: usize| {
        let top = (0..LAYERS).fold(id as u32, |at, _| above[at as usize]);
        if open[top as usize] > 0.0 { top } else { id as u32 }
    };
    (0..texels.mapped).map(top).collect()
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
        Probe { visibility, sampler, back: t.back, cover: cover_height(t.area), scramble, rays: 0 }
    }

    /// Whether all of `rays` rays from point `k` meet backs or a cover.
    fn buried(&mut self, k: u32, rays: u32) -> bool {
        let u = |d: usize| unit_f32(sobol(k, d, self.scramble));
        let (triangle, uv) = self.sampler.sample(Vec2::new(u(0), u(1)));
        let at = Receiver::new(self.visibility.world, triangle, uv, self.back, false);
        self.rays += 1;
        if cover_above(self.visibility, &at, self.cover).is_some() {
            return true;
        }
        (0..rays).all(|j| {
            self.rays += 1;
            let v = |d| unit_f32(sobol(k * rays + j, d, self.scramble));
            blind(self.visibility, &at, Vec2::new(v(2), v(3)), self.cover)
        })
    }

    /// Share of the points that are not buried, 1 where `known` says nothing and none of the first is.
    fn open_share(&mut self, known: bool) -> f32 {
        if !known && !(0..SECOND_POINTS).any(|k| self.buried(k, FIRST_RAYS)) {
            return 1.0;
        }
        let n = (0..POINTS).filter(|&k| self.buried(k, RAYS)).count();
        1.0 - n as f32 / POINTS as f32
    }
}

/// Height below which a surface covers a texel of this area [frame units].
pub fn cover_height(area: f32) -> f32 {
    (COVER * area.sqrt()).max(LEAST_COVER)
}

/// [`cover_height`] of a texel of which not everything is open, that is, which may be covered in part.
pub fn cover_in_part(open: f32, area: f32) -> Option<f32> {
    (open < 1.0).then(|| cover_height(area))
}

/// The surface that lies upon the point, less than `height` above it.
pub fn cover_above(visibility: &Visibility, at: &Receiver, height: f32) -> Option<Hit> {
    visibility.opaque_above(at.origin, at.geometric_normal, height)
}

/// Whether a point of a texel of `area`, which is open in part and not covered there, is inside a solid. `random` gives
/// random numbers.
pub fn inside_solid(visibility: &Visibility, at: &Receiver, area: f32, mut random: impl FnMut() -> f32) -> bool {
    (0..RAYS).all(|_| blind(visibility, at, Vec2::new(random(), random()), cover_height(area)))
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
