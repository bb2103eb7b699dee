//! Direct light of every texel in two halves, and where photons start.

use super::emitters::{Emitters, SAMPLE_DIMENSIONS};
use super::open::{cover_above, cover_in_part};
use super::receiver::Receiver;
use super::visibility::Visibility;
use crate::atlas::{TexelSampler, Texels};
use crate::sampling::{DIMENSIONS, Stream, hash_mix, hash_seed, sobol, unit_f32};
use crate::scene::SurfaceFlags;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

/// Start points kept per texel and half.
pub const START_SLOTS: usize = 2;

/// Texels per task.
const CHUNK: usize = 256;

/// A point that photons start from, drawn among the texel's direct samples in proportion to the largest
/// channel of B = rho E there (weighted reservoir sampling: Chao 1982).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartSlot {
    /// Triangle id.
    pub triangle: u32,
    /// Barycentric weights of the second and third corner.
    pub uv: Vec2,
    /// B over its largest channel, in units of 1 / 65535.
    pub color: [u16; 3],
}

const NO_SLOT: StartSlot = StartSlot { triangle: u32::MAX, uv: Vec2::ZERO, color: [0; 3] };

/// One half of one texel: sums over its samples.
#[derive(Debug, Clone, Copy)]
struct HalfTexel {
    samples: u32,
    /// Stored irradiance.
    stored: Vec3,
    /// Largest channel of rho E.
    exitance: f32,
    /// Variance of one sample as the first samples show it, of what is stored and of what is sent out.
    pilot_variance: f32,
    slots: [StartSlot; START_SLOTS],
}

impl HalfTexel {
    const EMPTY: HalfTexel =
        HalfTexel { samples: 0, stored: Vec3::ZERO, exitance: 0.0, pilot_variance: 0.0, slots: [NO_SLOT; START_SLOTS] };
}

/// Direct light of all texels, gathered so far.
#[derive(Debug)]
pub struct Direct {
    halves: [Vec<HalfTexel>; 2],
    samples: u64,
    rays: u64,
}

impl Direct {
    /// Nothing gathered yet.
    pub fn new(texels: usize) -> Direct {
        Direct { halves: [vec![HalfTexel::EMPTY; texels], vec![HalfTexel::EMPTY; texels]], samples: 0, rays: 0 }
    }

    /// Bytes per texel of both halves.
    pub const BYTES_PER_TEXEL: usize = 2 * size_of::<HalfTexel>();

    /// Samples of all texels and both halves so far.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Shadow rays so far, and those that looked for covers.
    pub fn rays(&self) -> u64 {
        self.rays
    }

    /// Mean direct irradiance (lux) that is stored for a texel, one half.
    pub fn stored(&self, half: usize, texel: usize) -> Vec3 {
        let t = &self.halves[half][texel];
        t.stored / t.samples.max(1) as f32
    }

    /// Mean over the texel's samples of the largest channel of rho E (lux), one half.
    pub fn exitance(&self, half: usize, texel: usize) -> f32 {
        let t = &self.halves[half][texel];
        t.exitance / t.samples.max(1) as f32
    }

    /// Where photons of this texel start; `None` where it reflects nothing.
    pub fn start(&self, half: usize, texel: usize, slot: usize) -> Option<&StartSlot> {
        let s = &self.halves[half][texel].slots[slot];
        (s.triangle != u32::MAX).then_some(s)
    }

    /// How many more samples each half of each texel should take, so that `budget` in all bring the noise down
    /// most: in proportion to the square root of area times variance (Neyman 1934), counting what a texel has.
    ///
    /// What steers a texel are the first samples of the *other* texels around it, and of its own half. The number of
    /// samples of a texel is then independent of their values, so that their mean is unbiased; and nothing passes
    /// from one half to the other, so that the halves stay independent. (What all texels together decide, the scale
    /// here and when to stop, depends on any one of them by a part in their number.)
    pub fn allocate(&self, budget: u64, texels: &Texels, importance: impl Fn(usize) -> f32) -> [Vec<u32>; 2] {
        [0, 1].map(|half| {
            let wish = self.wishes(half, texels, &importance);
            let have = &self.halves[half];
            let more = |scale: f64| {
                let chunks = wish
                    .par_chunks(CHUNK)
                    .zip(have.par_chunks(CHUNK))
                    .map(|(w, h)| w.iter().zip(h).map(|(w, h)| more_samples(*w, scale, h.samples)).sum::<u64>());
                chunks.sum::<u64>()
            };
            // The scale at which the additions use up this half's share of the budget.
            let (mut low, mut high) = (0.0, 1.0);
            while more(high) < budget / 2 && high < 1e12 {
                high *= 4.0;
            }
            for _ in 0..24 {
                let middle = 0.5 * (low + high);
                if more(middle) < budget / 2 { low = middle } else { high = middle }
            }
            wish.iter().zip(have).map(|(w, h)| more_samples(*w, low, h.samples) as u32).collect()
        })
    }

    /// Square root of area times variance of each texel, relative to the mean. The variance is that of its
    /// neighbours: a penumbra found by one texel is looked for in those beside it.
    fn wishes(&self, half: usize, texels: &Texels, importance: &impl Fn(usize) -> f32) -> Vec<f64> {
        let variance: Vec<f64> = self.halves[half].iter().map(|h| f64::from(h.pilot_variance)).collect();
        let around = around(&variance);
        let weight = |i: usize| f64::from(texels.texels[i].area) * f64::from(importance(i));
        let wanted: Vec<f64> = around.iter().enumerate().map(|(i, v)| weight(i) * v).collect();
        let mean = wanted.iter().sum::<f64>() / wanted.len().max(1) as f64;
        if mean <= 0.0 {
            return vec![1.0; wanted.len()];
        }
        wanted.iter().map(|v| (v / mean + LEAST_SHARE).sqrt()).collect()
    }

    /// Takes the same number of samples in every texel and half.
    pub fn extend_all(
        &mut self,
        samples: u32,
        seed: u64,
        smooth: bool,
        texels: &Texels,
        light: (&Emitters, &Visibility, &[f32]),
    ) {
        self.extend(&|_, _| samples, seed, smooth, texels, light);
    }

    /// Takes `more(half, texel)` samples in each half of each texel. `open` is the open share of those on the map:
    /// where it is below 1, points that another surface lies upon receive and send out nothing. Sample k of a texel
    /// is point k of a scrambled Sobol sequence of the texel's own, so that all samples so far stay evenly spread.
    pub fn extend(
        &mut self,
        more: &(impl Fn(usize, usize) -> u32 + Sync),
        seed: u64,
        smooth: bool,
        texels: &Texels,
        (emitters, visibility, open): (&Emitters, &Visibility, &[f32]),
    ) {
        let [odd, even] = &mut self.halves;
        let (samples, rays) = odd
            .par_chunks_mut(CHUNK)
            .zip(even.par_chunks_mut(CHUNK))
            .enumerate()
            .map(|(chunk, (odd, even))| {
                let mut sampler = TexelSampler::default();
                let (mut samples, mut rays) = (0u64, 0u64);
                for (i, halves) in odd.iter_mut().zip(even).enumerate() {
                    let id = chunk * CHUNK + i;
                    let counts = [more(0, id), more(1, id)];
                    if counts == [0, 0] {
                        continue;
                    }
                    sampler.load(texels, id);
                    let t = &texels.texels[id];
                    let cover = open.get(id).and_then(|&open| cover_in_part(open, t.area));
                    for (h, half) in [halves.0, halves.1].into_iter().enumerate() {
                        let key = hash_mix(seed, (id as u64) << 1 | h as u64);
                        let points = Points { seed: hash_seed(&[key]), key };
                        let mut squares = 0.0;
                        for k in half.samples..half.samples + counts[h] {
                            squares +=
                                half.add(points, k, &sampler, (t.back, cover), smooth, emitters, visibility, &mut rays);
                        }
                        if half.samples == 0 && counts[h] > 1 {
                            let mean2 = half.stored.length_squared() / 3.0 + half.exitance * half.exitance;
                            let n = counts[h] as f32;
                            half.pilot_variance = ((squares - mean2 / n) / (n - 1.0)).max(0.0);
                        }
                        half.samples += counts[h];
                        samples += u64::from(counts[h]);
                    }
                }
                (samples, rays)
            })
            .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        self.samples += samples;
        self.rays += rays;
    }
}

/// Texels along the Morton curve that are neighbours, and those of a wider neighbourhood.
const NEAR: usize = 32;
const WIDE: usize = 256;

/// Part of the wider neighbourhood in what a texel is taken to vary by.
const WIDE_SHARE: f64 = 0.1;

/// Share of the mean variance that every texel is taken to have at least.
const LEAST_SHARE: f64 = 0.02;

/// Mean of the values around each one, without its own.
fn around(values: &[f64]) -> Vec<f64> {
    let mean = |sum: f64, own: f64, n: usize| if n > 1 { (sum - own).max(0.0) / (n - 1) as f64 } else { 0.0 };
    let mut out = Vec::with_capacity(values.len());
    for wide in values.chunks(WIDE) {
        let wide_sum = wide.iter().sum::<f64>();
        for near in wide.chunks(NEAR) {
            let near_sum = near.iter().sum::<f64>();
            out.extend(near.iter().map(|&own| {
                (1.0 - WIDE_SHARE) * mean(near_sum, own, near.len()) + WIDE_SHARE * mean(wide_sum, own, wide.len())
            }));
        }
    }
    out
}

/// Most samples of one half of one texel.
const MAX_SAMPLES: f64 = 65536.0;

/// Additional samples for a texel that wants `wish * scale` and has `have`: too few to be worth the set-up of
/// its sampler are left for later.
fn more_samples(wish: f64, scale: f64, have: u32) -> u64 {
    let want = (wish * scale).min(MAX_SAMPLES);
    let more = (want - f64::from(have)).max(0.0) as u64;
    if more < 2 { 0 } else { more }
}

/// The sequence of one half of one texel.
#[derive(Clone, Copy)]
struct Points {
    seed: u32,
    key: u64,
}

impl HalfTexel {
    /// Adds one sample and returns its square: of what is stored, mean of the channels, and of what is sent out.
    fn add(
        &mut self,
        points: Points,
        k: u32,
        sampler: &TexelSampler,
        (back, cover): (bool, Option<f32>),
        smooth: bool,
        emitters: &Emitters,
        visibility: &Visibility,
        rays: &mut u64,
    ) -> f32 {
        const { assert!(SAMPLE_DIMENSIONS + 2 <= DIMENSIONS) };
        let u = |d: usize| unit_f32(sobol(k, d, points.seed));
        let (triangle, uv) = sampler.sample(Vec2::new(u(0), u(1)));
        let at = Receiver::new(visibility.world, triangle, uv, back, smooth);
        if let Some(height) = cover {
            *rays += 1;
            if cover_above(visibility, &at, height).is_some() {
                return 0.0;
            }
        }
        let mut stream = Stream::new(hash_mix(points.key, u64::from(k)));
        let light = emitters.sample(&at, visibility, |d| u(d + 2), &mut stream, rays);
        if !light.stored.is_finite() || !light.transported.is_finite() {
            return 0.0;
        }
        self.stored += light.stored;
        let stored_square = light.stored.length_squared() / 3.0;
        let unseen = visibility.world.flags[triangle as usize].has(SurfaceFlags::UNSEEN);
        if light.transported == Vec3::ZERO || unseen {
            return stored_square;
        }
        let surface = visibility.world.surface(triangle, uv);
        let b = surface.albedo * surface.alpha * light.transported;
        let largest = b.max_element();
        if largest <= 0.0 {
            return stored_square;
        }
        self.exitance += largest;
        for slot in &mut self.slots {
            if stream.unit() * self.exitance < largest {
                let color = (b / largest * 65535.0).round();
                *slot = StartSlot { triangle, uv, color: [color.x as u16, color.y as u16, color.z as u16] };
            }
        }
        stored_square + largest * largest
    }
}
