//! The error once more, by other means: random texels of the finished map, path-traced to the end.
//!
//! Each texel gets two estimates V1, V2 of its irradiance E that know nothing of each other nor of the map. The
//! noise of both cancels in the mean of (X - V1)(X - V2), which is that of (X - E)^2: the squared error of what is
//! stored, X, with all that the halves cannot show. No photons, cells or caches take part, but for caustics: light from
//! lamps over mirrors and through solid glass, which paths from the texels cannot find, is taken as the map has it.
//! Geometry, materials, emitters and the open shares of texels are the ones that the map was made with.

use super::estimate::{Caustics, Halves, TexelError, TexelWeights, Unseen, spread};
use super::interval::{Moments, TWO_SIDED_95};
use crate::accel::{Hit, Ray};
use crate::atlas::TexelSampler;
use crate::light::{Receiver, SAMPLE_DIMENSIONS, TexelLight};
use crate::photon::MOST_CREVICE_STEPS;
use crate::sampling::{Stream, cosine_hemisphere, hash_mix, hash_seed, sobol, unit_f32};
use crate::scene::Met;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use serde::Serialize;

/// A path ends after this many surfaces; roulette ends nearly all before.
const MAX_SURFACES: u32 = 1000;

/// Texels and paths of each that tell how noisy a path is.
const PILOT_TEXELS: usize = 32;
const PILOT_PATHS: u32 = 64;

/// Paths of one estimate of a texel. Within these, so many that their noise is a few times the stated error: with f the
/// fourth moment of the error over its squared square, sqrt(sqrt(f - 1)) times are best for a given number of rays,
/// and few texels err by far more than most, so that f is large.
const PATHS: std::ops::RangeInclusive<f64> = 32.0..=16384.0;
const NOISE: f64 = 2.0;

/// Errors are taken for at least this share of the target here.
const LEAST_STATED: f64 = 0.1;

/// Texels, where a number of rays decides.
const TEXELS: std::ops::RangeInclusive<usize> = 64..=65536;

/// Where an error above the stated interval is found but not surely, so many times the rays are spent at most.
const MOST_EXTENSION: usize = 4;

/// Texels between two questions whether to go on.
const CHUNK: usize = 64;

/// Sets the random numbers of audits apart from all others.
const AUDIT: u64 = 0x0061_7564_6974_0000;

/// How much is audited.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effort {
    /// As many texels as about so many rays allow, and up to four times as many to decide whether an error is above
    /// the stated interval.
    Rays(u64),
    /// So many texels.
    Texels(usize),
}

/// What an audit says of the stated error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// The error found is not above the stated interval.
    Agrees,
    /// An error at the target could not be told from none: more texels would tell.
    NotResolved,
    /// The error is above the stated interval, which is raised to it.
    Raised,
}

/// What an audit found. Percent of the map's mean irradiance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Audit {
    /// What it says of the stated error.
    pub verdict: Verdict,
    /// Error of the texels.
    pub error_percent: f64,
    /// Its 95 % interval.
    pub error_interval: [f64; 2],
    /// An error smaller than this could not be told from none.
    pub resolution_percent: f64,
    /// Mean of the map less that of the paths: light that is lost, or too much.
    pub mean_difference_percent: f64,
    /// Its standard error.
    pub mean_difference_deviation: f64,
    /// Texels audited, drawn by their weight.
    pub texels: usize,
    /// Paths of each.
    pub paths_per_texel: u32,
    /// Rays of all paths.
    pub rays: u64,
}

impl Audit {
    /// What it found beyond `stated`, where that is sure; `photons` had been shot. `blind` is the squared error, in percent
    /// squared, of what it takes as the map has it: caustics.
    pub fn unseen(&self, stated: &TexelError, blind: f64, photons: u64) -> Option<Unseen> {
        let seen = stated.percent.powi(2) - stated.unseen.powi(2) - blind;
        let square = self.error_percent.powi(2) - seen;
        let deviation = self.resolution_percent.powi(2) / TWO_SIDED_95;
        (self.verdict == Verdict::Raised).then_some(Unseen { square, deviation, photons })
    }
}

/// What is audited, and what with.
#[derive(Debug, Clone, Copy)]
pub struct Auditor<'a> {
    /// Seed of the bake.
    pub seed: u64,
    /// What direct light is found with, on the normals that receive it.
    pub light: TexelLight<'a>,
    /// The map.
    pub total: &'a Halves,
    /// What came from lamps over mirrors and through glass, which paths do not find: it is taken as the map has it.
    pub caustics: Option<&'a Caustics>,
    /// How its texels count.
    pub weights: &'a TexelWeights,
    /// Mean over the whole of each texel, not its open part alone.
    pub whole: bool,
    /// Width below which a gap between surfaces is none, as for photons [frame units].
    pub crevice: f32,
}

/// Two estimates of a texel.
#[derive(Clone, Copy, Default)]
struct Estimates {
    values: [Vec3; 2],
    /// Variance of the paths, mean over the channels.
    scatter: f64,
    rays: u64,
}

impl Auditor<'_> {
    /// Audits a map that is not black and is stated to err by `stated`, for a `target` in percent. `None` where `go_on`
    /// said no.
    pub fn run(&self, effort: Effort, stated: &TexelError, target: f64, go_on: &dyn Fn() -> bool) -> Option<Audit> {
        let mean = stated.mean;
        let draw = |n: usize, moved: f64| spread(&self.weights.weight, n, moved);
        let mut random = Stream::new(hash_mix(self.seed, AUDIT));

        let pilot = self.estimates(&draw(PILOT_TEXELS, f64::from(random.unit())), PILOT_PATHS, 1, go_on)?;
        let scatter = pilot.iter().map(|p| p.scatter).sum::<f64>() / pilot.len() as f64;
        let per_path =
            pilot.iter().map(|p| p.rays).sum::<u64>() as f64 / (2 * PILOT_TEXELS as u32 * PILOT_PATHS) as f64;
        let noise = NOISE * stated.percent.max(LEAST_STATED * target) / 100.0 * mean;
        let paths = (scatter / (noise * noise)).clamp(*PATHS.start(), *PATHS.end());
        let (texels, paths) = match effort {
            Effort::Texels(n) => (n, paths),
            Effort::Rays(rays) => {
                let affordable = rays as f64 / (2.0 * per_path.max(1.0));
                let n = ((affordable / paths) as usize).clamp(*TEXELS.start(), *TEXELS.end());
                (n, paths.min(affordable / n as f64).max(*PATHS.start()))
            }
        };
        let most = if let Effort::Rays(_) = effort { MOST_EXTENSION * texels } else { texels };

        let (mut square, mut difference) = (Moments::default(), Moments::default());
        let (mut rays, mut audited, mut pass) = (pilot.iter().map(|f| f.rays).sum::<u64>(), 0, 2);
        loop {
            // As many as there are already: all of them together are spread about as evenly.
            let drawn = draw(audited.max(texels), f64::from(random.unit()));
            let found = self.estimates(&drawn, paths as u32, pass, go_on)?;
            for (&i, f) in drawn.iter().zip(&found) {
                let [a, b] = f.values.map(|v| (self.total.mean(i) - v).as_dvec3() / mean);
                square.add(a.dot(b) / 3.0);
                difference.add((a + b).element_sum() / 6.0);
            }
            rays += found.iter().map(|f| f.rays).sum::<u64>();
            (audited, pass) = (audited + drawn.len(), pass + 1);
            let error = |deviations: f64| square.percent(deviations);
            let undecided = error(0.0) > stated.high && error(-TWO_SIDED_95) <= stated.high;
            if !undecided || 2 * audited > most {
                break;
            }
        }
        let [low, high] = [-TWO_SIDED_95, TWO_SIDED_95].map(|deviations| square.percent(deviations));
        let resolution = 100.0 * (TWO_SIDED_95 * square.deviation()).sqrt();
        let verdict = if low > stated.high {
            Verdict::Raised
        } else if resolution > target.max(stated.high) {
            Verdict::NotResolved
        } else {
            Verdict::Agrees
        };
        Some(Audit {
            verdict,
            error_percent: square.percent(0.0),
            error_interval: [low, high],
            resolution_percent: resolution,
            mean_difference_percent: 100.0 * difference.mean(),
            mean_difference_deviation: 100.0 * difference.deviation(),
            texels: audited,
            paths_per_texel: 2 * paths as u32,
            rays,
        })
    }

    /// Two estimates of each of `texels`, by `paths` paths each; `pass` sets their random numbers apart.
    fn estimates(&self, texels: &[usize], paths: u32, pass: u64, go_on: &dyn Fn() -> bool) -> Option<Vec<Estimates>> {
        let mut out = Vec::with_capacity(texels.len());
        for (c, chunk) in texels.chunks(CHUNK).enumerate() {
            if !go_on() {
                return None;
            }
            let of = |sampler: &mut TexelSampler, (j, &texel): (usize, &usize)| {
                let key = hash_mix(hash_mix(self.seed, AUDIT + pass), (c * CHUNK + j) as u64);
                self.estimate(texel, paths, key, sampler)
            };
            out.par_extend(chunk.par_iter().enumerate().map_init(TexelSampler::default, of));
        }
        Some(out)
    }

    fn estimate(&self, texel: usize, paths: u32, key: u64, sampler: &mut TexelSampler) -> Estimates {
        const { assert!(SAMPLE_DIMENSIONS + 2 <= crate::sampling::DIMENSIONS) };
        let open = if self.whole { 1.0 } else { self.light.open[texel] };
        let mut out = Estimates::default();
        sampler.load(self.light.texels, texel);
        for (v, value) in out.values.iter_mut().enumerate() {
            let key = hash_mix(key, v as u64);
            let (place, way) = (hash_seed(&[key, 0]), hash_seed(&[key, 1]));
            let (mut sum, mut squares) = (Vec3::ZERO, 0.0f64);
            for k in 0..paths {
                let u = |d: usize| unit_f32(sobol(k, d, place));
                let Some(at) = self.light.point(texel, sampler, Vec2::new(u(0), u(1)), &mut out.rays) else { continue };
                let mut stream = Stream::new(hash_mix(key, 2 + u64::from(k)));
                let direct = self.light.light(at, |d| u(d + 2), &mut stream, &mut out.rays).stored;
                let turn = Vec2::new(unit_f32(sobol(k, 0, way)), unit_f32(sobol(k, 1, way)));
                let direction = cosine_hemisphere(at.geometric_normal, turn);
                let light = direct + self.reflected(&at, direction, &mut stream, &mut out.rays);
                sum += light;
                squares += f64::from(light.length_squared());
            }
            let n = paths as f32;
            *value = sum / (n * open.max(1e-6)) + self.caustics.map_or(Vec3::ZERO, |c| c.stored.mean(texel));
            let scatter = squares / f64::from(n) - f64::from((sum / n).length_squared());
            out.scatter += scatter.max(0.0) / (6.0 * f64::from(open.max(1e-6)).powi(2));
        }
        out
    }

    /// Irradiance (lux) that lamps send over mirrors and through glass to where light arrives, on its `back` or front.
    fn caustic(&self, hit: &Hit, back: bool, arriving: Vec3) -> Vec3 {
        let Some(caustics) = self.caustics else { return Vec3::ZERO };
        let uv = self.light.visibility.world.hair_before(hit.triangle, Vec2::new(hit.u, hit.v), arriving);
        let texel = self.light.texels.at(hit.triangle, back, uv);
        texel.map_or(Vec3::ZERO, |t| caustics.everywhere.mean(t as usize))
    }

    /// Radiosity that comes back to `at` along `direction`, by one path.
    fn reflected(&self, at: &Receiver, direction: Vec3, stream: &mut Stream, rays: &mut u64) -> Vec3 {
        let (visibility, world) = (self.light.visibility, self.light.visibility.world);
        let reflecting = TexelLight { smooth: false, ..self.light };
        let (mut sum, mut carried) = (Vec3::ZERO, Vec3::ONE);
        let mut ray = Ray { origin: at.origin, direction, t_max: f32::INFINITY };
        let mut in_crevice = 0;
        for _ in 0..MAX_SURFACES {
            *rays += 1;
            let Some(hit) = visibility.accel.closest(&ray) else { break };
            in_crevice = if hit.t < self.crevice { in_crevice + 1 } else { 0 };
            if in_crevice > MOST_CREVICE_STEPS {
                break;
            }
            let uv = Vec2::new(hit.u, hit.v);
            let met = world.meet(hit.triangle, uv, ray.direction);
            let Met { back, facing, reflected: albedo, transmitted, passed, .. } = met;
            let lit = Receiver::met(world, hit.triangle, uv, facing, ray.direction, hit.t);
            if albedo != Vec3::ZERO {
                let caustic = self.caustic(&hit, back, ray.direction);
                sum += carried * (reflecting.any_light(lit, stream, rays).sent + albedo * caustic);
            }
            // Light of the far side, which leaves on this one.
            if transmitted != Vec3::ZERO {
                let caustic = self.caustic(&hit, !back, ray.direction);
                let beyond = reflecting.any_light(lit.opposite(world), stream, rays).sent_beyond;
                sum += carried * (beyond + transmitted * caustic);
            }
            let bounce = world.bounce((hit.triangle, uv), &met, ray.direction, hit.t, || stream.unit());
            let thrown = bounce.map_or(Vec3::ZERO, |b| b.importance());
            // Roulette by what is left of the path.
            let [r, s, p, t] = [albedo, thrown, passed, transmitted].map(|share| (carried * share).max_element());
            let whole = (r + s + p + t).max(1e-30);
            let alive = whole.min(1.0);
            let pick = stream.unit() * (whole / alive);
            if pick < r {
                carried *= albedo * (whole / (r * alive));
                let direction = cosine_hemisphere(facing, Vec2::new(stream.unit(), stream.unit()));
                ray = Ray { origin: lit.origin, direction, t_max: f32::INFINITY };
            } else if let Some(b) = bounce.filter(|_| pick < r + s) {
                carried *= thrown * (whole / (s * alive));
                let origin = if b.through { lit.beyond(world) } else { lit.origin };
                ray = Ray { origin, direction: b.direction, t_max: f32::INFINITY };
            } else if pick < r + s + p {
                carried *= passed * (whole / (p * alive));
                ray.origin = lit.beyond(world);
            } else if pick < r + s + p + t {
                carried *= transmitted * (whole / (t * alive));
                let direction = cosine_hemisphere(-facing, Vec2::new(stream.unit(), stream.unit()));
                ray = Ray { origin: lit.opposite(world).origin, direction, t_max: f32::INFINITY };
            } else {
                break;
            }
        }
        if sum.is_finite() { sum } else { Vec3::ZERO }
    }
}
