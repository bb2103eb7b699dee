//! What smoothing over cells adds to the error.

use super::tree::{Node, SurfaceTree};
use glam::Vec3;
use rayon::prelude::*;

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

    fn add(&mut self, term: f64) {
        self.square += term;
        self.variance += term * term;
    }
}

/// The squared bias of the mean of both halves, for each of `groups` groups and, at the end, for all together.
/// `weight(k)` is the weight of element k, 0 where nothing is smoothed, and its group.
///
/// With R the reconstruction of a half and r its raw irradiance, both independent of the other half's,
/// `(R_odd - r_odd) (R_even - r_even)` has the product of both biases as its expectation, however the cells were
/// chosen: with sigma from the difference of the halves it adds up to the squared error of the mean. On single
/// texels r is too noisy to see it, so means over `blocks` are taken, halved `depth` times, for the bias of a plane
/// changes sign within its cell. What averages out within one goes unseen. `values` are the irradiances R (lux) and
/// `caught` the flux that r is of.
pub fn bias(
    tree: &SurfaceTree,
    caught: [&[[f32; 3]]; 2],
    values: [&[Vec3]; 2],
    blocks: &[Node],
    groups: usize,
    depth: u32,
    weight: impl Fn(usize) -> (f64, u32) + Sync,
) -> Vec<Bias> {
    let mut blocks: Vec<Node> = blocks.to_vec();
    for _ in 0..depth {
        let halve = |n: Node| tree.children(&n).map_or_else(|| vec![n], |pair| pair.to_vec());
        blocks = blocks.into_iter().flat_map(halve).collect();
    }
    // What each group, of which there are few, has in each block: texels of a mesh that are known well must not be told
    // the noise of those of another beside them.
    let parts: Vec<Vec<(u32, Part)>> = blocks
        .into_par_iter()
        .map(|block| {
            let mut parts = Vec::<(u32, Part)>::new();
            for k in block.elements {
                let (weight, group) = weight(k);
                if weight <= 0.0 {
                    continue;
                }
                let area = tree.elements[k].area;
                let over = [0, 1].map(|h| {
                    let of = |c: usize| f64::from(area * values[h][k][c]) - f64::from(caught[h][k][c]);
                    std::array::from_fn(of)
                });
                let one = Part { weight, area: area.into(), over };
                match parts.iter_mut().find(|p| p.0 == group) {
                    Some((_, part)) => *part = part.with(&one),
                    None => parts.push((group, one)),
                }
            }
            parts
        })
        .collect();
    let mut sums = vec![Bias::default(); groups + 1];
    for parts in parts {
        parts.iter().for_each(|(group, part)| sums[*group as usize].add(part.square()));
        if let Some(whole) = parts.into_iter().map(|p| p.1).reduce(|a, b| a.with(&b)) {
            sums[groups].add(whole.square());
        }
    }
    sums
}

/// Some elements of a block.
#[derive(Clone, Copy)]
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
