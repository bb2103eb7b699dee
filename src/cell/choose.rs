//! Which nodes of the tree become cells: as fine as the photons can tell.

use super::ElementFlux;
use super::tree::{Node, SurfaceTree};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// How much more than the mean gain of pure noise a split must gain to be kept. At 1 this is Mallows' Cp; more,
/// since the best of many trees is looked for.
const PENALTY: f64 = 3.0;

/// Photons in a block of [`dispersion`], both halves and all channels together.
const BLOCK_PHOTONS: f64 = 64.0;

/// Flux and area under a node, and what splitting it gains.
#[derive(Clone, Copy)]
struct Sum {
    area: f64,
    flux: [f64; 3],
    /// Deviance gained by the splits kept below, what they have to gain taken off.
    gain: f64,
}

/// The cells of one half: the antichain of nodes that explains `flux` best, each cell paying for itself
/// (Kolaczyk and Nowak, "Multiscale likelihood analysis and complexity penalized estimation", 2004; optimal
/// pruning as in dyadic CART, Donoho 1997). `photon` is the flux of one photon, `dispersion` what
/// [`dispersion`] found.
pub fn choose(tree: &SurfaceTree, flux: &ElementFlux, photon: f64, dispersion: f64) -> Vec<Node> {
    if tree.is_empty() {
        return Vec::new();
    }
    let price = (1.0 + PENALTY) * dispersion;
    let split: Vec<AtomicBool> = (0..tree.len()).map(|_| AtomicBool::new(false)).collect();
    let leaf =
        |k: usize| Sum { area: f64::from(tree.elements[k].area), flux: flux[k].map(f64::from), gain: 0.0 };
    let join = |node: &Node, a: Sum, b: Sum| {
        let gain = a.gain + b.gain + deviance(&a, &b, photon) - price;
        split[node.index].store(gain > 0.0, Relaxed);
        Sum { area: a.area + b.area, flux: std::array::from_fn(|c| a.flux[c] + b.flux[c]), gain: gain.max(0.0) }
    };
    tree.fold(&tree.root(), &leaf, &join);
    tree.cut(|node| !split[node.index].load(Relaxed))
}

/// Twice the log likelihood ratio of two Poisson means against one, summed over the channels, where one photon
/// carries `photon`.
fn deviance(a: &Sum, b: &Sum, photon: f64) -> f64 {
    let area = a.area + b.area;
    let channel = |c: usize| {
        let flux = a.flux[c] + b.flux[c];
        let term = |part: &Sum| match part.flux[c] {
            f if f > 0.0 => f * libm::log(f * area / (flux * part.area)),
            _ => 0.0,
        };
        2.0 * (term(a) + term(b)) / photon
    };
    (0..3).map(channel).sum::<f64>().max(0.0)
}

/// Mean deviance that a split gains by noise alone: 1 for photons of one channel that arrive independently, 3
/// for grey ones, less where low-discrepancy nets spread them evenly, more where they come in showers. One
/// number for the scene, from the difference of the halves in blocks of many photons each.
pub fn dispersion(tree: &SurfaceTree, halves: [&ElementFlux; 2], photon: f64) -> f64 {
    if tree.is_empty() || photon <= 0.0 {
        return 1.0;
    }
    /// Flux of both halves where it is still too little for a block, else (sum, number) of the blocks.
    enum Part {
        Flux([[f64; 3]; 2]),
        Blocks(f64, f64),
    }
    let block = |f: &[[f64; 3]; 2]| {
        let channel = |c: usize| {
            let (sum, difference) = (f[0][c] + f[1][c], f[0][c] - f[1][c]);
            if sum > 0.0 { difference * difference / (sum * photon) } else { 0.0 }
        };
        (0..3).map(channel).sum::<f64>()
    };
    let leaf = |k: usize| Part::Flux(halves.map(|h| h[k].map(f64::from)));
    let join = |_: &Node, a: Part, b: Part| match (a, b) {
        (Part::Flux(a), Part::Flux(b)) => {
            let sum: [[f64; 3]; 2] = std::array::from_fn(|h| std::array::from_fn(|c| a[h][c] + b[h][c]));
            if sum.iter().flatten().sum::<f64>() >= BLOCK_PHOTONS * photon {
                Part::Blocks(block(&sum), 1.0)
            } else {
                Part::Flux(sum)
            }
        }
        (Part::Blocks(s, n), Part::Blocks(t, m)) => Part::Blocks(s + t, n + m),
        (blocks @ Part::Blocks(..), _) | (_, blocks) => blocks,
    };
    match tree.fold(&tree.root(), &leaf, &join) {
        Part::Blocks(sum, n) => (sum / n).max(1e-3),
        Part::Flux(sum) => block(&sum).max(1.0),
    }
}
