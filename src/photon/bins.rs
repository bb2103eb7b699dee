//! Deposits into texels: the replaceable last stage of the photon walk.

use crate::atlas::Texels;
use crate::light::cover_in_part;
use crate::scene::World;
use glam::{Vec2, Vec3};
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicI64, Ordering::Relaxed};

/// A photon meeting a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deposit {
    /// Triangle id.
    pub triangle: u32,
    /// Met on the back of a double-sided surface.
    pub back: bool,
    /// Barycentric weights of the second and third corner.
    pub uv: Vec2,
    /// Arriving flux per channel in the integer unit of the bake.
    pub flux: [u32; 3],
    /// Unit direction in which the photon travels.
    pub direction: Vec3,
    /// How far it came since it was reflected [frame units].
    pub distance: f32,
    /// Nothing reflected it diffusely yet: it came from a lamp over mirrors and through glass alone.
    pub caustic: bool,
}

/// What one photon, or many, left behind.
#[derive(Debug, Clone, Default)]
pub struct Trail {
    /// Light that surfaces received.
    pub deposits: Vec<Deposit>,
    /// Triangle and flux over the three channels of light that met the back of a one-sided surface and ended.
    pub backs: Vec<(u32, u64)>,
}

/// Takes what photons deposit. Sums must not depend on the order of calls, which come from many threads.
pub trait DepositSink: Sync {
    /// Adds what paths of one parity left.
    fn take(&self, half: usize, trail: &Trail);
}

/// Flux per texel of the map, two halves, in integers: exact and free of order.
#[derive(Debug)]
pub struct Bins<'t> {
    texels: &'t Texels,
    world: &'t World<'t>,
    open: &'t [f32],
    sums: Sums,
}

/// What is in the bins.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Sums {
    halves: [Vec<[AtomicI64; 3]>; 2],
    /// The same for light that came over mirrors and through glass alone, of all texels, on the map or not; empty where
    /// nothing is specular.
    caustics: [Vec<[AtomicI64; 3]>; 2],
    /// Flux over the three channels that the back of each triangle took up.
    backs: Vec<AtomicI64>,
}

impl Sums {
    /// Bins of each kind.
    fn lengths(&self) -> [usize; 5] {
        let Sums { halves: [odd, even], caustics: [odd_caustics, even_caustics], backs } = self;
        [odd.len(), even.len(), odd_caustics.len(), even_caustics.len(), backs.len()]
    }

    /// All of them in order.
    fn bins(&self) -> impl Iterator<Item = &AtomicI64> {
        self.halves.iter().chain(&self.caustics).flatten().flatten().chain(&self.backs)
    }
}

impl<'t> Bins<'t> {
    /// Bytes per texel of both halves.
    pub const BYTES_PER_TEXEL: usize = 2 * size_of::<[AtomicI64; 3]>();

    /// Empty bins for the texels of the map, `open` the open share of each: where it is below 1, light between
    /// the texel and a surface that lies upon it is not counted.
    pub fn new(world: &'t World<'t>, texels: &'t Texels, open: &'t [f32]) -> Bins<'t> {
        let mut bins = Bins { texels, world, open, sums: Sums::default() };
        bins.sums = bins.empty();
        bins
    }

    fn empty(&self) -> Sums {
        let empty = |count: usize| (0..count).map(|_| Default::default()).collect();
        let [mapped, caustics, backs] = self.lengths();
        let backs = (0..backs).map(|_| AtomicI64::new(0)).collect();
        Sums { halves: [empty(mapped), empty(mapped)], caustics: [empty(caustics), empty(caustics)], backs }
    }

    /// Texels of the map, those that have caustics, and triangles.
    fn lengths(&self) -> [usize; 3] {
        let Bins { texels, world, .. } = self;
        [texels.mapped, if world.is_specular() { texels.texels.len() } else { 0 }, world.len()]
    }

    /// What is in them.
    pub fn sums(&self) -> &Sums {
        &self.sums
    }

    /// Puts in what `load` finds, if that is of bins of the same texels, or else nothing; whether it is. There is never
    /// memory taken for both.
    pub fn put(&mut self, load: impl FnOnce() -> Option<Sums>) -> bool {
        self.sums = Sums::default();
        let [mapped, caustics, backs] = self.lengths();
        let fits = |s: &Sums| {
            s.halves.iter().all(|h| h.len() == mapped)
                && s.caustics.iter().all(|c| c.len() == caustics)
                && s.backs.len() == backs
        };
        let found = load().filter(fits);
        let fit = found.is_some();
        self.sums = found.unwrap_or_else(|| self.empty());
        fit
    }

    /// Takes out what is in them: they are of no further use.
    pub fn take_sums(&mut self) -> Sums {
        std::mem::take(&mut self.sums)
    }

    /// Adds what was in other bins of the same texels; false, and nothing is changed, where they were of others.
    pub fn add(&mut self, more: &Sums) -> bool {
        let fits = self.sums.lengths() == more.lengths();
        if fits {
            self.sums.bins().zip(more.bins()).for_each(|(sum, more)| {
                sum.fetch_add(more.load(Relaxed), Relaxed);
            });
        }
        fits
    }

    /// Flux over the three channels that the back of each triangle took up.
    pub fn back_flux(&self) -> Vec<i64> {
        self.sums.backs.iter().map(|b| b.load(Relaxed)).collect()
    }

    /// Whether a photon comes from a surface that lies upon the texel of the map.
    fn cover_sends(&self, texel: usize, d: &Deposit) -> bool {
        let area = self.texels.texels[texel].area;
        let height = d.distance * self.world.normals[d.triangle as usize].dot(d.direction).abs();
        cover_in_part(self.open[texel], area).is_some_and(|cover| height < cover) && d.distance < area.sqrt()
    }

    /// Flux of light that was reflected diffusely at least once, of a texel, one half.
    pub fn flux(&self, half: usize, texel: usize) -> [i64; 3] {
        sum_of(&self.sums.halves[half][texel])
    }

    /// Empties all of them.
    pub fn empty_all(&mut self) {
        self.sums.bins().for_each(|bin| bin.store(0, Relaxed));
    }

    /// Empties the bins of such light.
    pub fn forget_caustics(&mut self) {
        self.sums.caustics.iter_mut().flatten().flatten().for_each(|bin| *bin.get_mut() = 0);
    }

    /// Whether any light came over mirrors or through glass alone.
    pub fn has_caustics(&self) -> bool {
        self.sums.caustics.iter().flatten().any(|bin| sum_of(bin) != [0; 3])
    }

    /// Flux of such light, of any texel.
    pub fn caustic_flux(&self, half: usize, texel: usize) -> [i64; 3] {
        self.sums.caustics[half].get(texel).map_or([0; 3], sum_of)
    }
}

fn sum_of(bin: &[AtomicI64; 3]) -> [i64; 3] {
    std::array::from_fn(|c| bin[c].load(Relaxed))
}

impl DepositSink for Bins<'_> {
    fn take(&self, half: usize, trail: &Trail) {
        for &(triangle, flux) in &trail.backs {
            self.sums.backs[triangle as usize].fetch_add(flux as i64, Relaxed);
        }
        for d in &trail.deposits {
            let bins = if d.caustic { &self.sums.caustics[half] } else { &self.sums.halves[half] };
            if let Some(texel) = self.texels.at(d.triangle, d.back, d.uv).map(|t| t as usize)
                && let Some(bin) = bins.get(texel)
                && (texel >= self.texels.mapped || !self.cover_sends(texel, d))
            {
                bin.iter().zip(d.flux).for_each(|(sum, flux)| {
                    sum.fetch_add(i64::from(flux), Relaxed);
                });
            }
        }
    }
}
