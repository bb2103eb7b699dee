//! Which texel a photon starts from.

use crate::atlas::Texels;
use crate::light::Direct;
use crate::scene::{SurfaceFlags, World};
use rayon::prelude::*;

/// Cumulative start flux over the texels of one half. Texels stand in chart and Morton order, so that photons
/// with near start coordinates start at near places.
#[derive(Debug)]
pub struct StartTable {
    cumulative: Vec<f64>,
}

impl StartTable {
    /// Flux that leaves each texel by the half's own direct samples: area times the largest channel of what is reflected,
    /// diffusely or not [lux x frame units squared].
    pub fn new(texels: &Texels, direct: &Direct, half: usize) -> StartTable {
        StartTable::of(texels, direct, half, |_| true)
    }

    /// The same of the texels with specular surface alone: no caustic starts elsewhere.
    pub fn of_specular(world: &World, texels: &Texels, direct: &Direct, half: usize) -> StartTable {
        let specular = |triangle: u32| world.flags[triangle as usize].has(SurfaceFlags::SPECULAR);
        StartTable::of(texels, direct, half, |i| texels.pieces_of(i).iter().any(|p| specular(p.triangle)))
    }

    fn of(texels: &Texels, direct: &Direct, half: usize, starts: impl Fn(usize) -> bool + Sync) -> StartTable {
        let flux: Vec<f64> = texels
            .texels
            .par_iter()
            .enumerate()
            .map(|(i, t)| if starts(i) { f64::from(t.area) * f64::from(direct.exitance(half, i)) } else { 0.0 })
            .collect();
        let mut sum = 0.0;
        let cumulative = flux
            .into_iter()
            .map(|f| {
                sum += f;
                sum
            })
            .collect();
        StartTable { cumulative }
    }

    /// Flux of all texels.
    pub fn total(&self) -> f64 {
        self.cumulative.last().copied().unwrap_or(0.0)
    }

    /// First texel whose cumulative flux exceeds `u * total`, u in [0, 1); searched from texel `from` on where
    /// it is known not to lie before.
    pub fn pick(&self, u: f64, from: Option<usize>) -> usize {
        let target = u * self.total();
        let texel = match from {
            None => self.cumulative.partition_point(|&c| c <= target),
            Some(mut i) => {
                while i + 1 < self.cumulative.len() && self.cumulative[i] <= target {
                    i += 1;
                }
                i
            }
        };
        texel.min(self.cumulative.len() - 1)
    }
}
