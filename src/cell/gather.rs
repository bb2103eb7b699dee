//! Final gather: the indirect light of single texels, looked up where their rays end.
//!
//! A small or dark mesh catches a photon in a million, but its few texels can look around for themselves: one ray
//! brings the light of all bounces, since where it ends the map already knows it (Jensen, "Global illumination
//! using photon maps", 1996). Rays leave by the cosine, and towards the texels that send out most direct light;
//! the balance heuristic weighs both, so that neither a small bright patch nor a near wall makes spikes.
//!
//! Each half looks up its own half alone: the halves of what is gathered stay independent.

use crate::accel::Ray;
use crate::atlas::TexelSampler;
use crate::light::{Direct, Leaving, Receiver, START_SLOTS, TexelLight};
use crate::photon::StartTable;
use crate::sampling::{Stream, cosine_hemisphere, hash_mix, hash_seed, sobol, unit_f32};
use crate::scene::Met;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::f32::consts::PI;

/// A ray ends after this many surfaces that only pass or have no place on the map.
const MAX_SURFACES: u32 = 64;

/// Bounces of a path before light is looked up on the next mapped surface, however near.
const MOST_NEAR_STEPS: u32 = 3;

/// Direct light is not looked up but sampled on texels nearer than this many of their sides.
const NEAR: f32 = 4.0;

/// Where light is looked up.
#[derive(Debug, Clone, Copy)]
pub struct Gather<'a> {
    /// Seed of the bake.
    pub seed: u64,
    /// What direct light is found with, where that of texels is too coarse.
    pub light: TexelLight<'a>,
    /// Direct light of all texels.
    pub direct: &'a Direct,
    /// Where direct light leaves from, of each half.
    pub starts: &'a [StartTable; 2],
    /// Irradiance (lux) of every texel by light from lamps over mirrors and through glass alone, of each half.
    pub caustics: Option<[&'a [Vec3]; 2]>,
    /// Other indirect irradiance (lux) of the open part of each texel of the map, of each half.
    pub indirect: [&'a [Vec3]; 2],
    /// How far that is smoothed around each texel [frame units].
    pub blur: [&'a [f32]; 2],
}

/// What one texel gathered from one half.
#[derive(Debug, Clone, Copy, Default, serde::Serialize, serde::Deserialize)]
pub struct Gathered {
    /// Indirect irradiance (lux) of its open part.
    pub light: Vec3,
    /// Squared standard error of it, mean over the channels, as if its rays were independent: an upper bound of what
    /// they add, without what is wrong with the light that they look up.
    pub variance: f32,
}

impl Gather<'_> {
    /// What each of `wanted`, (texel, samples), gathers from one half; with the number of rays traced.
    pub fn texels(&self, half: usize, wanted: &[(u32, u32)]) -> (Vec<Gathered>, u64) {
        let found: Vec<(Gathered, u64)> = wanted
            .par_iter()
            .with_min_len(16)
            .map_init(TexelSampler::default, |sampler, &(texel, samples)| {
                self.texel(half, texel as usize, samples, sampler)
            })
            .collect();
        let rays = found.iter().map(|f| f.1).sum();
        (found.into_iter().map(|f| f.0).collect(), rays)
    }

    fn texel(&self, half: usize, texel: usize, samples: u32, sampler: &mut TexelSampler) -> (Gathered, u64) {
        let key = hash_mix(hash_mix(self.seed, 0x6761_7468_6572), (texel as u64) << 1 | half as u64);
        let scramble = hash_seed(&[key]);
        let lit = self.starts[half].total() > 0.0;
        sampler.load(self.light.texels, texel);
        let (mut sum, mut squares, mut rays) = (Vec3::ZERO, 0.0, 0);
        for k in 0..samples {
            let u = |d: usize| unit_f32(sobol(k, d, scramble));
            let mut stream = Stream::new(hash_mix(key, u64::from(k)));
            let Some(at) = self.light.point(texel, sampler, Vec2::new(u(0), u(1)), &mut rays) else { continue };
            let direction = cosine_hemisphere(at.geometric_normal, Vec2::new(u(2), u(3)));
            let mut sample = self.along(half, &at, direction, &mut stream, &mut rays);
            if lit {
                sample += self.towards_light(half, &at, u(4), &mut stream, &mut rays);
            }
            sum += sample;
            squares += sample.length_squared();
        }
        let (n, open) = (samples as f32, self.light.open[texel]);
        let light = sum / (n * open);
        if open <= 0.0 || !light.is_finite() {
            return (Gathered::default(), rays);
        }
        let scatter = (squares - sum.length_squared() / n).max(0.0) / (n - 1.0).max(1.0);
        (Gathered { light, variance: scatter / (3.0 * n * open * open) }, rays)
    }

    /// Radiosity that comes back along a cosine-distributed direction. Direct light reflected at the first
    /// surface counts by its share of the balance heuristic.
    fn along(&self, half: usize, at: &Receiver, direction: Vec3, stream: &mut Stream, rays: &mut u64) -> Vec3 {
        let TexelLight { texels, visibility, .. } = self.light;
        let world = visibility.world;
        let cosine = at.geometric_normal.dot(direction).max(0.0);
        let (mut sum, mut carried) = (Vec3::ZERO, Vec3::ONE);
        let mut ray = Ray { origin: at.origin, direction, t_max: f32::INFINITY };
        // Distance from `at` while nothing but passing surfaces was met.
        let mut straight = Some(0.0f32);
        let mut near_steps = 0;
        for _ in 0..MAX_SURFACES {
            *rays += 1;
            let Some(hit) = visibility.accel.closest(&ray) else { return sum };
            let uv = Vec2::new(hit.u, hit.v);
            let found = world.meet(hit.triangle, uv, ray.direction);
            let Met { back, facing, receives, passes, reflected, transmitted, passed, .. } = found;
            if !receives && !passes {
                return sum;
            }
            let bounce = world.bounce((hit.triangle, uv), &found, ray.direction, hit.t, || stream.unit());
            let thrown = bounce.map_or(Vec3::ZERO, |b| b.importance());
            let before = || world.hair_before(hit.triangle, uv, ray.direction);
            let texel = if receives { texels.at(hit.triangle, back, before()) } else { None };
            let met = Receiver::met(world, hit.triangle, uv, facing, ray.direction, hit.t);
            // What comes back is light that this side reflects, and that the far side transmits.
            let mut sides = [(reflected, texel, Leaving::Reflected), (transmitted, None, Leaving::Transmitted)];
            if receives && transmitted != Vec3::ZERO {
                sides[1].1 = texels.at(hit.triangle, !back, before());
            }
            for (share, texel, leaving) in &mut sides {
                let Some(texel) = texel.map(|t| t as usize) else { continue };
                let weight = match straight {
                    Some(gone) => {
                        let d2 = (gone + hit.t).powi(2);
                        let by_cosine = cosine * facing.dot(-direction).max(0.0) / (PI * d2.max(1e-20));
                        let by_light = self.light_density(half, texel);
                        by_cosine / (by_cosine + by_light).max(1e-30)
                    }
                    None => 1.0,
                };
                // Half a shadowed texel is not as bright as its mean.
                let near = hit.t < NEAR * texels.texels[texel].area.sqrt();
                let sent = match leaving {
                    _ if !near => self.sent_directly(half, texel, *leaving),
                    Leaving::Transmitted => self.light.any_light(met.opposite(world), stream, rays).sent_beyond,
                    _ => self.light.any_light(met, stream, rays).sent,
                };
                sum += carried * sent * weight;
                sum += self.caustics.map_or(Vec3::ZERO, |c| carried * *share * c[half][texel]);
                // What is near would be looked up too blurred: a few bounces more, and it no longer matters.
                let mapped = texel < texels.mapped;
                let far = mapped && hit.t >= self.blur[half][texel];
                if mapped && (far || near_steps == MOST_NEAR_STEPS) {
                    sum += carried * *share * self.indirect[half][texel];
                    *share = Vec3::ZERO;
                }
            }
            // What has no place on the map has no light to look up: go on to where it gets its own.
            let [reflected, transmitted] = sides.map(|(share, ..)| share);
            let [r, s, p, t] = [reflected, thrown, passed, transmitted].map(|share| share.max_element());
            let all = (r + s + p + t).max(1.0);
            let pick = stream.unit() * all;
            if pick < r {
                near_steps = (near_steps + 1).min(MOST_NEAR_STEPS);
                carried *= reflected / r * all;
                let direction = cosine_hemisphere(facing, Vec2::new(stream.unit(), stream.unit()));
                ray = Ray { origin: met.origin, direction, t_max: f32::INFINITY };
                straight = None;
            } else if let Some(b) = bounce.filter(|_| pick < r + s) {
                // Light straight from a lamp over a mirror is not in here: photons bring it.
                carried *= thrown / s * all;
                let origin = if b.through { met.beyond(world) } else { met.origin };
                ray = Ray { origin, direction: b.direction, t_max: f32::INFINITY };
                straight = None;
            } else if pick < r + s + p {
                carried *= passed / p * all;
                straight = straight.map(|gone| gone + hit.t);
                ray.origin = met.beyond(world);
            } else if pick < r + s + p + t {
                near_steps = (near_steps + 1).min(MOST_NEAR_STEPS);
                carried *= transmitted / t * all;
                let direction = cosine_hemisphere(-facing, Vec2::new(stream.unit(), stream.unit()));
                ray = Ray { origin: met.opposite(world).origin, direction, t_max: f32::INFINITY };
                straight = None;
            } else {
                return sum;
            }
        }
        sum
    }

    /// Irradiance from one point that sends out direct light, drawn in proportion to it; its share of the balance
    /// heuristic.
    fn towards_light(&self, half: usize, at: &Receiver, u: f32, stream: &mut Stream, rays: &mut u64) -> Vec3 {
        let starts = &self.starts[half];
        let texel = starts.pick(f64::from(u), None);
        let slot = stream.bits() as usize % START_SLOTS;
        let Some(start) = self.direct.start(half, texel, slot) else { return Vec3::ZERO };
        let from = self.light.start(texel, start);
        let from = match start.way() {
            Leaving::Reflected => from,
            Leaving::Transmitted => from.opposite(self.light.visibility.world),
            // Mirrors send nothing to where one looks from by chance.
            Leaving::Along(_) => return Vec3::ZERO,
        };
        let to = from.origin - at.origin;
        let d2 = to.length_squared();
        if d2 < 1e-14 {
            return Vec3::ZERO;
        }
        let w = to / d2.sqrt();
        let (near, far) = (at.geometric_normal.dot(w), from.geometric_normal.dot(-w));
        if near <= 0.0 || far <= 0.0 {
            return Vec3::ZERO;
        }
        *rays += 1;
        let passed = self.light.visibility.transmittance(&Ray { origin: at.origin, direction: to, t_max: 1.0 });
        if passed == Vec3::ZERO {
            return Vec3::ZERO;
        }
        let by_cosine = near * far / (PI * d2);
        let by_light = self.light_density(half, texel);
        passed * start.color() * (starts.total() as f32 * by_cosine * by_light / (by_cosine + by_light))
    }

    /// Density per area with which [`towards_light`](Self::towards_light) picks points of a texel.
    fn light_density(&self, half: usize, texel: usize) -> f32 {
        let total = self.starts[half].total() as f32;
        if total > 0.0 { self.direct.exitance(half, texel) / total } else { 0.0 }
    }

    /// Radiosity (lux) of direct light on a texel that leaves in one of the diffuse ways.
    fn sent_directly(&self, half: usize, texel: usize, way: Leaving) -> Vec3 {
        let exitance = self.direct.exitance(half, texel);
        if exitance <= 0.0 {
            return Vec3::ZERO;
        }
        let starts = (0..START_SLOTS).filter_map(|s| self.direct.start(half, texel, s));
        let (sum, n) = starts.fold((Vec3::ZERO, 0.0), |(sum, n), s| {
            (sum + if s.way() == way { s.color() } else { Vec3::ZERO }, n + 1.0)
        });
        if n > 0.0 { sum * (exitance / n) } else { Vec3::ZERO }
    }
}
