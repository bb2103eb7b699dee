//! Direct light of every texel in two halves, and where photons start.

use super::emitters::{Emitters, SAMPLE_DIMENSIONS};
use super::receiver::Receiver;
use super::visibility::Visibility;
use crate::atlas::{TexelSampler, Texels};
use crate::sampling::{DIMENSIONS, Stream, hash_mix, hash_seed, sobol, unit_f32};
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

/// One half of one texel: sums over samples.
#[derive(Debug, Clone, Copy)]
struct HalfTexel {
    stored: Vec3,
    exitance: f32,
    slots: [StartSlot; START_SLOTS],
}

/// Direct light of all texels, gathered so far.
#[derive(Debug)]
pub struct Direct {
    halves: [Vec<HalfTexel>; 2],
    samples: u32,
    rays: u64,
}

impl Direct {
    /// Nothing gathered yet.
    pub fn new(texels: usize) -> Direct {
        let empty = HalfTexel { stored: Vec3::ZERO, exitance: 0.0, slots: [NO_SLOT; START_SLOTS] };
        Direct { halves: [vec![empty; texels], vec![empty; texels]], samples: 0, rays: 0 }
    }

    /// Bytes per texel of both halves.
    pub const BYTES_PER_TEXEL: usize = 2 * size_of::<HalfTexel>();

    /// Samples per texel and half so far.
    pub fn samples(&self) -> u32 {
        self.samples
    }

    /// Shadow rays so far.
    pub fn rays(&self) -> u64 {
        self.rays
    }

    /// Mean direct irradiance (lux) that is stored for a texel, one half.
    pub fn stored(&self, half: usize, texel: usize) -> Vec3 {
        self.halves[half][texel].stored / self.samples.max(1) as f32
    }

    /// Mean over the texel's samples of the largest channel of rho E (lux), one half.
    pub fn exitance(&self, half: usize, texel: usize) -> f32 {
        self.halves[half][texel].exitance / self.samples.max(1) as f32
    }

    /// Where photons of this texel start; `None` where it reflects nothing.
    pub fn start(&self, half: usize, texel: usize, slot: usize) -> Option<&StartSlot> {
        let s = &self.halves[half][texel].slots[slot];
        (s.triangle != u32::MAX).then_some(s)
    }

    /// Takes `samples` more per texel and half. Sample k of a texel is point k of a scrambled Sobol sequence of
    /// the texel's own, so that all samples so far stay evenly spread.
    pub fn extend(
        &mut self,
        samples: u32,
        seed: u64,
        smooth: bool,
        texels: &Texels,
        emitters: &Emitters,
        visibility: &Visibility,
    ) {
        let first = self.samples;
        let [odd, even] = &mut self.halves;
        let rays: u64 = odd
            .par_chunks_mut(CHUNK)
            .zip(even.par_chunks_mut(CHUNK))
            .enumerate()
            .map(|(chunk, (odd, even))| {
                let mut sampler = TexelSampler::default();
                let mut rays = 0;
                for (i, halves) in odd.iter_mut().zip(even).enumerate() {
                    let id = chunk * CHUNK + i;
                    sampler.load(texels, id);
                    let back = texels.texels[id].back;
                    for (h, half) in [halves.0, halves.1].into_iter().enumerate() {
                        let key = hash_mix(seed, (id as u64) << 1 | h as u64);
                        let points = Points { seed: hash_seed(&[key]), key };
                        for k in first..first + samples {
                            half.add(points, k, &sampler, back, smooth, emitters, visibility, &mut rays);
                        }
                    }
                }
                rays
            })
            .sum();
        self.samples += samples;
        self.rays += rays;
    }
}

/// The sequence of one half of one texel.
#[derive(Clone, Copy)]
struct Points {
    seed: u32,
    key: u64,
}

impl HalfTexel {
    fn add(
        &mut self,
        points: Points,
        k: u32,
        sampler: &TexelSampler,
        back: bool,
        smooth: bool,
        emitters: &Emitters,
        visibility: &Visibility,
        rays: &mut u64,
    ) {
        const { assert!(SAMPLE_DIMENSIONS + 2 <= DIMENSIONS) };
        let u = |d: usize| unit_f32(sobol(k, d, points.seed));
        let (triangle, uv) = sampler.sample(Vec2::new(u(0), u(1)));
        let at = Receiver::new(visibility.world, triangle, uv, back, smooth);
        let light = emitters.sample(&at, visibility, |d| u(d + 2), rays);
        if !light.stored.is_finite() || !light.transported.is_finite() {
            return;
        }
        self.stored += light.stored;
        if light.transported == Vec3::ZERO {
            return;
        }
        let surface = visibility.world.surface(triangle, uv);
        let b = surface.albedo * surface.alpha * light.transported;
        let largest = b.max_element();
        if largest <= 0.0 {
            return;
        }
        self.exitance += largest;
        let mut stream = Stream::new(hash_mix(points.key, u64::from(k)));
        for slot in &mut self.slots {
            if stream.unit() * self.exitance < largest {
                let color = (b / largest * 65535.0).round();
                *slot = StartSlot { triangle, uv, color: [color.x as u16, color.y as u16, color.z as u16] };
            }
        }
    }
}
