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
    // Mean squared bias of each block, and the weight of the groups in it: few.
    let terms: Vec<(f64, Vec<(u32, f64)>)> = blocks
        .into_par_iter()
        .map(|block| {
            let (mut area, mut over, mut weights) = (0.0, [[0f64; 3]; 2], Vec::<(u32, f64)>::new());
            for k in block.elements {
                let a = tree.elements[k].area;
                let (w, group) = weight(k);
                if w <= 0.0 {
                    continue;
                }
                area += f64::from(a);
                match weights.iter_mut().find(|g| g.0 == group) {
                    Some(g) => g.1 += w,
                    None => weights.push((group, w)),
                }
                for h in 0..2 {
                    for c in 0..3 {
                        over[h][c] += f64::from(a * values[h][k][c]) - f64::from(caught[h][k][c]);
                    }
                }
            }
            let product = (0..3).map(|c| over[0][c] * over[1][c]).sum::<f64>() / 3.0;
            (if area > 0.0 { product / (area * area) } else { 0.0 }, weights)
        })
        .collect();
    let mut sums = vec![Bias::default(); groups + 1];
    for (square, weights) in terms {
        weights.iter().for_each(|&(group, w)| sums[group as usize].add(w * square));
        sums[groups].add(weights.iter().map(|g| g.1).sum::<f64>() * square);
    }
    sums
}
