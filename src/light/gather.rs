//! Direct light of every texel in two halves, and where photons start.

use super::emitters::SAMPLE_DIMENSIONS;
use super::point::{StartSlot, TexelLight};
use crate::atlas::{TexelSampler, Texels};
use crate::bisect::bisected;
use crate::sampling::{DIMENSIONS, Stream, hash_mix, hash_seed, sobol, unit_f32};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Start points kept per texel and half.
pub const START_SLOTS: usize = 2;

/// Texels per task.
const CHUNK: usize = 256;

/// One half of one texel: sums over its samples.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct HalfTexel {
    samples: u32,
    /// Stored irradiance.
    stored: Vec3,
    /// Its soft part.
    soft: Vec3,
    /// Sum of the squares of that, mean over the channels.
    soft_squares: f32,
    /// Largest channel of what leaves.
    exitance: f32,
    steering: Steering,
    slots: [StartSlot; START_SLOTS],
}

impl HalfTexel {
    const EMPTY: HalfTexel = HalfTexel {
        samples: 0,
        stored: Vec3::ZERO,
        soft: Vec3::ZERO,
        soft_squares: 0.0,
        exitance: 0.0,
        steering: Steering { stored: Vec3::ZERO, exitance: 0.0, squares: 0.0 },
        slots: [StartSlot::NONE; START_SLOTS],
    };
}

/// Sums over the samples that every texel takes the same number of.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Steering {
    /// Stored irradiance.
    stored: Vec3,
    /// Largest channel of rho E.
    exitance: f32,
    /// Sum of the squares of both: of what is stored, the mean over the channels.
    squares: f32,
}

impl Steering {
    /// Variance of one of `n` samples, of what is stored and of what is sent out.
    fn variance(&self, n: u32) -> f64 {
        let n = f64::from(n);
        let square_of_sum = f64::from(self.stored.length_squared()) / 3.0 + f64::from(self.exitance).powi(2);
        if n > 1.0 { ((f64::from(self.squares) - square_of_sum / n) / (n - 1.0)).max(0.0) } else { 0.0 }
    }
}

/// Samples for each half of each texel.
#[derive(Debug, Clone)]
pub struct Allocation {
    /// How many more: half, texel.
    pub more: [Vec<u32>; 2],
    /// The first of these, as many everywhere, steer those to come.
    pub steering: u32,
    /// Share of the growth asked for that these are.
    pub grown: f64,
}

/// Texels whose samples are to be `factor` times as many.
#[derive(Debug, Clone, Copy)]
pub struct Growth<'a> {
    /// Ids, in order.
    pub texels: &'a [u32],
    /// At least 1.
    pub factor: f64,
}

/// Direct light of all texels, gathered so far.
#[derive(Debug, Serialize, Deserialize)]
pub struct Direct {
    halves: [Vec<HalfTexel>; 2],
    samples: u64,
    /// Samples of each half of each texel that steer.
    steering: u32,
    rays: u64,
}

impl Direct {
    /// Nothing gathered yet.
    pub fn new(texels: usize) -> Direct {
        Direct {
            halves: [vec![HalfTexel::EMPTY; texels], vec![HalfTexel::EMPTY; texels]],
            samples: 0,
            steering: 0,
            rays: 0,
        }
    }

    /// Bytes per texel of both halves.
    pub const BYTES_PER_TEXEL: usize = 2 * size_of::<HalfTexel>();

    /// Texels.
    pub fn texels(&self) -> usize {
        self.halves[0].len().min(self.halves[1].len())
    }

    /// Samples of all texels and both halves so far.
    pub fn all_samples(&self) -> u64 {
        self.samples
    }

    /// Samples of one half of a texel.
    pub fn samples(&self, half: usize, texel: usize) -> u32 {
        self.halves[half][texel].samples
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

    /// What of it is soft: light of surfaces, and of the sky without that of a sun in its image.
    pub fn soft(&self, half: usize, texel: usize) -> Vec3 {
        let t = &self.halves[half][texel];
        t.soft / t.samples.max(1) as f32
    }

    /// Variance of [`soft`](Self::soft), mean over the channels: as its samples show it, and at least that of light
    /// that all of them saw by chance (Laplace's rule of succession).
    pub fn soft_variance(&self, half: usize, texel: usize) -> (f64, f64) {
        let t = &self.halves[half][texel];
        let n = f64::from(t.samples);
        if n < 2.0 {
            return (0.0, 0.0);
        }
        let square = f64::from(t.soft.length_squared()) / (3.0 * n * n);
        let shown = ((f64::from(t.soft_squares) / n - square) / (n - 1.0)).max(0.0);
        (shown, shown.max(square / (n * (n + 2.0))))
    }

    /// Mean over the texel's samples of the largest channel of what leaves, diffusely or not (lux), one half.
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
    /// most: in proportion to the square root of area times variance (Neyman 1934), counting what a texel has. Up to
    /// `share` of the budget goes first to what is to grow.
    ///
    /// What steers a texel are samples of the *other* texels around it, and of its own half: samples that every texel
    /// takes the same number of. The number of samples of a texel is then independent of their values, so that their
    /// mean is unbiased; and nothing passes from one half to the other, so that the halves stay independent. Steered by
    /// all samples, the few texels of a dim room that find its window would have their neighbours looked at closely,
    /// hence be so themselves, and be corrected, while those that miss it would not: that room lost 1 % of its light.
    /// (What all texels together decide, the scale here and when to stop, depends on any one of them by a part in
    /// their number; so does the growth of a mesh, in the number of its own.)
    pub fn allocate(&self, budget: u64, texels: &Texels, growth: &[Growth], share: f64) -> Allocation {
        let all = 2 * texels.texels.len().max(1) as u64;
        let steering =
            ((STEERING_SHARE * (self.samples + budget) as f64 / all as f64) as u32).saturating_sub(self.steering);
        let steering = steering.min((MAX_SAMPLES as u32).saturating_sub(self.steering));
        let steering = if steering < LEAST_MORE { 0 } else { steering };
        let noise = [0, 1].map(|half| self.noise_around(half, texels));
        let wanted = [0, 1].map(|half| self.wanted(half, &noise[half], growth));
        // Whole samples, so that the sum is the same in any order.
        let sum: u64 = wanted.iter().flatten().map(|w| w.ceil() as u64).sum();
        let grown = (share * budget as f64 / sum.max(1) as f64).min(1.0);
        let more = [0, 1].map(|half| {
            let wished: Vec<(f64, u32, u64)> = wishes(&noise[half])
                .zip(&self.halves[half])
                .zip(&wanted[half])
                .map(|((wish, have), w)| (wish, have.samples, u64::from(steering).max((w * grown).ceil() as u64)))
                .collect();
            let more_samples =
                |&(wish, have, least): &(f64, u32, u64), scale: f64| more_samples(wish, scale, have).max(least);
            let more = |scale: f64| -> u64 { wished.par_iter().map(|w| more_samples(w, scale)).sum() };
            // The scale at which the additions use up this half's share of the budget.
            let short = |scale: f64| more(scale) < budget / 2;
            let mut high = 1.0;
            while short(high) && high < 1e12 {
                high *= 4.0;
            }
            let (low, high) = bisected(0.0, high, 24, short);
            // Texels that all wish the same get nothing by the smaller.
            let scale = if more(low) > 0 { low } else { high };
            wished.iter().map(|w| more_samples(w, scale) as u32).collect()
        });
        Allocation { more, steering, grown }
    }

    /// Area times variance of each texel. The variance is that of its neighbours: a penumbra found by one texel is looked
    /// for in those beside it.
    fn noise_around(&self, half: usize, texels: &Texels) -> Vec<f64> {
        let variance: Vec<f64> = self.halves[half].iter().map(|t| t.steering.variance(self.steering)).collect();
        around(&variance).iter().zip(&texels.texels).map(|(v, t)| f64::from(t.area) * v).collect()
    }

    /// Samples of both halves that all of `growth` takes.
    pub fn samples_to_grow(&self, growth: &[Growth]) -> f64 {
        let have = |texel: &u32| self.halves.iter().map(|h| u64::from(h[*texel as usize].samples)).sum::<u64>();
        growth.iter().map(|g| (g.factor - 1.0) * g.texels.iter().map(have).sum::<u64>() as f64).sum()
    }

    /// Samples of one half that all of `growth` takes, by texel: spread as in [`allocate`](Self::allocate), for one factor
    /// for all texels of a mesh would look as long where nothing is unsure.
    fn wanted(&self, half: usize, noise: &[f64], growth: &[Growth]) -> Vec<f64> {
        let of = |growth: &Growth| -> Vec<f64> {
            let have = |&t: &u32| f64::from(self.halves[half][t as usize].samples);
            let noise: Vec<f64> = growth.texels.iter().map(|&t| noise[t as usize]).collect();
            let wished: Vec<(f64, f64)> = wishes(&noise).zip(growth.texels.iter().map(have)).collect();
            let more = |&(wish, have): &(f64, f64), scale: f64| (wish * scale).min(MAX_SAMPLES).max(have) - have;
            let all: f64 = wished.iter().map(|w| w.1).sum();
            let budget = ((growth.factor - 1.0) * all).min(MAX_SAMPLES * wished.len() as f64 - all);
            let short = |scale: f64| wished.iter().map(|w| more(w, scale)).sum::<f64>() < budget;
            let (_, scale) = bisected(0.0, MAX_SAMPLES / LEAST_SHARE.sqrt(), 40, short);
            wished.iter().map(|w| more(w, scale)).collect()
        };
        let found: Vec<Vec<f64>> = growth.par_iter().map(of).collect();
        let mut out = vec![0.0; noise.len()];
        for (growth, found) in growth.iter().zip(found) {
            growth.texels.iter().zip(found).for_each(|(&t, w)| out[t as usize] = w);
        }
        out
    }

    /// Takes `more(half, texel)` samples in each half of each texel, at least `steering` everywhere. Sample k of a texel
    /// is point k of a scrambled Sobol sequence of the texel's own, so that all samples so far stay evenly spread.
    pub fn extend(
        &mut self,
        more: &(impl Fn(usize, usize) -> u32 + Sync),
        steering: u32,
        seed: u64,
        light: &TexelLight,
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
                    sampler.load(light.texels, id);
                    for (h, half) in [halves.0, halves.1].into_iter().enumerate() {
                        let key = hash_mix(seed, (id as u64) << 1 | h as u64);
                        half.add([counts[h], steering], (id, &sampler), key, light, &mut rays);
                        samples += u64::from(counts[h]);
                    }
                }
                (samples, rays)
            })
            .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        self.samples += samples;
        self.steering += steering;
        self.rays += rays;
    }
}

/// Direct light of some texels, as one of several machines gathered it.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct DirectPart {
    /// Texel and both halves of it.
    texels: Vec<(u32, [HalfTexel; 2])>,
    /// Samples and rays that these took.
    samples: u64,
    rays: u64,
}

impl Direct {
    /// Texels with numbers in the same block are lit alike.
    pub const BLOCK: usize = CHUNK;

    /// What there is of `texels`, and all that was added since `before` had so many samples and rays.
    pub fn part(&self, texels: impl Iterator<Item = u32>, before: (u64, u64)) -> DirectPart {
        let [odd, even] = &self.halves;
        DirectPart {
            texels: texels.map(|t| (t, [odd[t as usize], even[t as usize]])).collect(),
            samples: self.samples - before.0,
            rays: self.rays - before.1,
        }
    }

    /// Puts in what another machine gathered on top of the same; false, and nothing is changed, where it is of other
    /// texels.
    pub fn put(&mut self, part: &DirectPart) -> bool {
        let fits = part.texels.iter().all(|(t, _)| (*t as usize) < self.texels());
        if fits {
            for &(texel, [odd, even]) in &part.texels {
                self.halves[0][texel as usize] = odd;
                self.halves[1][texel as usize] = even;
            }
            self.samples += part.samples;
            self.rays += part.rays;
        }
        fits
    }
}

/// Square roots of `noise`, relative to the mean.
fn wishes(noise: &[f64]) -> impl Iterator<Item = f64> {
    let mean = noise.iter().sum::<f64>() / noise.len().max(1) as f64;
    noise.iter().map(move |v| if mean > 0.0 { (v / mean + LEAST_SHARE).sqrt() } else { 1.0 })
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

/// Share of the samples that every texel takes, whatever it is lit by. Measured as noise at equal time, at shares of
/// 0.15, 0.3, 0.5: 42, 31, 27 in a hall of many lamps (modern-hall), 2.4, 2.3, 2.2 in a box (cornell-box); but a room
/// behind a window takes more samples the larger it is.
const STEERING_SHARE: f64 = 0.35;

/// A texel takes at least this many more at once, or none.
const LEAST_MORE: u32 = 2;

/// Most samples of one half of one texel.
const MAX_SAMPLES: f64 = 65536.0;

/// Additional samples for a texel that wants `wish * scale` and has `have`: too few to be worth the set-up of
/// its sampler are left for later.
fn more_samples(wish: f64, scale: f64, have: u32) -> u64 {
    let want = (wish * scale).min(MAX_SAMPLES);
    let more = (want - f64::from(have)).max(0.0) as u64;
    if more < LEAST_MORE.into() { 0 } else { more }
}

impl HalfTexel {
    /// Adds the next `count` samples of the sequence that belongs to `key`, of which the first `steering` steer.
    fn add(
        &mut self,
        [count, steering]: [u32; 2],
        (texel, sampler): (usize, &TexelSampler),
        key: u64,
        light: &TexelLight,
        rays: &mut u64,
    ) {
        const { assert!(SAMPLE_DIMENSIONS + 2 <= DIMENSIONS) };
        let scramble = hash_seed(&[key]);
        for k in self.samples..self.samples + count {
            let u = |d: usize| unit_f32(sobol(k, d, scramble));
            let Some(at) = light.point(texel, sampler, Vec2::new(u(0), u(1)), rays) else { continue };
            let mut more = Stream::new(hash_mix(key, u64::from(k)));
            let found = light.light(at, |d| u(d + 2), &mut more, rays);
            self.stored += found.stored;
            self.soft += found.soft;
            self.soft_squares += found.soft.length_squared() / 3.0;
            let steers = k < self.samples + steering;
            if steers {
                self.steering.stored += found.stored;
                self.steering.squares += found.stored.length_squared() / 3.0;
            }
            let Some(start) = StartSlot::new(&found) else { continue };
            self.exitance += start.largest;
            if steers {
                self.steering.exitance += start.largest;
                self.steering.squares += start.largest * start.largest;
            }
            for slot in &mut self.slots {
                if more.unit() * self.exitance < start.largest {
                    *slot = start;
                }
            }
        }
        self.samples += count;
    }
}
