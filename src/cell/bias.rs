//! What smoothing over cells adds to the error.

use super::tree::{Node, SurfaceTree};
use glam::Vec3;
use rayon::prelude::*;
use std::ops::Range;

/// Sums of a squared bias over surface.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Bias {
    /// Sum of weight times squared bias, mean over the channels; below 0 where noise outweighs it.
    pub square: f64,
    /// Variance of `square`.
    pub variance: f64,
}

impl Bias {
    /// What the bias may well be: its square and one standard error. Where photons are too few to show whether a
    /// mesh is right, this says so.
    pub fn likely(&self) -> f64 {
        self.square.max(0.0) + self.variance.sqrt()
    }

    /// Of both.
    pub fn plus(&self, other: &Bias) -> Bias {
        Bias { square: self.square + other.square, variance: self.variance + other.variance }
    }

    /// Of both where they add up, as they do at worst.
    pub fn plus_alike(&self, other: &Bias) -> Bias {
        let root = self.square.max(0.0).sqrt() + other.square.max(0.0).sqrt();
        Bias { square: root * root, variance: self.variance + other.variance }
    }

    fn add(&mut self, term: f64) {
        self.square += term;
        self.variance += term * term;
    }
}

/// Light before and after it was smoothed, in two halves, in the order of the tree.
#[derive(Debug, Clone, Copy)]
pub struct Compared<'a> {
    /// Surface.
    pub tree: &'a SurfaceTree,
    /// Flux that was caught [lux x frame units squared].
    pub caught: [&'a [[f32; 3]]; 2],
    /// Irradiance (lux) after smoothing.
    pub values: [&'a [Vec3]; 2],
}

impl Compared<'_> {
    /// The squared bias of the mean of both halves, over all elements. `weight(k)` is the weight of element k, 0 where
    /// nothing is smoothed.
    ///
    /// With R the reconstruction of a half and r its raw irradiance, both independent of the other half's,
    /// `(R_odd - r_odd) (R_even - r_even)` has the product of both biases as its expectation, however the cells were
    /// chosen: with sigma from the difference of the halves it adds up to the squared error of the mean. On single
    /// texels r is too noisy to see it, so means over `blocks` are taken, halved `depth` times, for the bias of a plane
    /// changes sign within its cell. What averages out within one goes unseen.
    pub fn bias(&self, blocks: &[Node], depth: u32, weight: impl Fn(usize) -> f64 + Sync) -> Bias {
        let of_block = |block: &Node| {
            let mut sum = Bias::default();
            self.halved(block, depth, &mut |elements| {
                let parts = elements.map(|k| (weight(k), k)).filter(|p| p.0 > 0.0).map(|(w, k)| self.part(k, w));
                if let Some(whole) = parts.reduce(|a, b| a.with(&b)) {
                    sum.add(whole.square());
                }
            });
            sum
        };
        let sums: Vec<Bias> = blocks.par_iter().map(of_block).collect();
        sums.iter().fold(Bias::default(), |all, sum| all.plus(sum))
    }

    /// That of each of `groups` groups: the elements of one in a block, of which there are few, are taken by themselves,
    /// for texels of a mesh that are known well must not be told the noise of those of another beside them. `weight(k)`
    /// is the weight of element k and its group.
    pub fn biases(
        &self,
        blocks: &[Node],
        depth: u32,
        groups: usize,
        weight: impl Fn(usize) -> (f64, u32) + Sync,
    ) -> Vec<Bias> {
        let of_block = |block: &Node| {
            let (mut sums, mut parts) = (Vec::<(u32, Bias)>::new(), Vec::<(u32, Part)>::new());
            self.halved(block, depth, &mut |elements| {
                for ((weight, group), k) in elements.map(|k| (weight(k), k)).filter(|p| p.0.0 > 0.0) {
                    let part = of_group(&mut parts, group);
                    *part = part.with(&self.part(k, weight));
                }
                parts.drain(..).for_each(|(group, part)| of_group(&mut sums, group).add(part.square()));
            });
            sums
        };
        let found: Vec<Vec<(u32, Bias)>> = blocks.par_iter().map(of_block).collect();
        let mut sums = vec![Bias::default(); groups];
        for (group, sum) in found.iter().flatten() {
            sums[*group as usize] = sums[*group as usize].plus(sum);
        }
        sums
    }

    /// Calls `each` with the elements of a node halved `depth` times, in order.
    fn halved(&self, node: &Node, depth: u32, each: &mut impl FnMut(Range<usize>)) {
        match self.tree.children(node).filter(|_| depth > 0) {
            Some(pair) => pair.iter().for_each(|half| self.halved(half, depth - 1, each)),
            None => each(node.elements.clone()),
        }
    }

    fn part(&self, k: usize, weight: f64) -> Part {
        let area = self.tree.elements[k].area;
        let over = |h: usize, c: usize| f64::from(area * self.values[h][k][c]) - f64::from(self.caught[h][k][c]);
        Part { weight, area: area.into(), over: [0, 1].map(|h| std::array::from_fn(|c| over(h, c))) }
    }
}

/// What belongs to a group, of which there are few.
fn of_group<T: Default>(all: &mut Vec<(u32, T)>, group: u32) -> &mut T {
    let i = all.iter().position(|entry| entry.0 == group).unwrap_or_else(|| {
        all.push((group, T::default()));
        all.len() - 1
    });
    &mut all[i].1
}

/// Some elements of a block.
#[derive(Clone, Copy, Default)]
struct Part {
    weight: f64,
    area: f64,
    /// Flux of each half and channel that the reconstruction tells beyond what was caught.
    over: [[f64; 3]; 2],
}

impl Part {
    fn with(&self, other: &Part) -> Part {
        let over = std::array::from_fn(|h| std::array::from_fn(|c| self.over[h][c] + other.over[h][c]));
        Part { weight: self.weight + other.weight, area: self.area + other.area, over }
    }

    /// Its weight times the squared bias of its mean.
    fn square(&self) -> f64 {
        let product = (0..3).map(|c| self.over[0][c] * self.over[1][c]).sum::<f64>() / 3.0;
        self.weight * product / (self.area * self.area)
    }
}
