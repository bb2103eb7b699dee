//! Which nodes of the tree become cells: as fine as the photons can tell.

use super::Caught;
use super::tree::{Node, SurfaceTree};
use std::sync::atomic::{AtomicU8, AtomicU32, Ordering::Relaxed};

/// How much more than the mean gain of pure noise a split must gain to be kept. At 1 this is Mallows' Cp; more,
/// since the best of many trees is looked for.
const PENALTY: f64 = 3.0;

/// A cell has at least this many photons, or the area for as many: one photon on a speck of surface says nothing,
/// however unlikely it was.
const LEAST_PHOTONS: f64 = 8.0;

/// Photons in a block of [`dispersion`], both halves and all channels together.
const BLOCK_PHOTONS: f64 = 64.0;

/// Blocks that a region of one dispersion has at most.
const REGION_BLOCKS: u32 = 64;

/// Weight of the scene's mean in the dispersion of a region, in blocks.
const SCENE_BLOCKS: f64 = 16.0;

/// Elements in a region of one scatter, and weight of what is expected, in elements.
const SCATTER_REGION: usize = 64;
const SCATTER_DRAWN: f64 = 16.0;

/// Flux and area under a node, and what splitting it gains.
#[derive(Clone, Copy)]
struct Sum {
    area: f64,
    flux: [f64; 3],
    variance: f64,
    /// Dispersion, summed over the area.
    dispersion: f64,
    /// Deviance gained by the splits kept below, what they have to gain taken off.
    gain: f64,
}

/// Flux of one photon: what noise of this variance, mean over the channels, is of when photons bring `flux`.
fn photon(flux: &[f64; 3], variance: f64) -> f64 {
    let mean = flux.iter().sum::<f64>() / 3.0;
    if mean > 0.0 { variance / mean } else { f64::INFINITY }
}

/// What [`choose`] found.
#[derive(Debug, Clone, Default)]
pub struct Choice {
    /// Nodes that are cells, in order.
    pub cells: Vec<Node>,
    /// Nodes too small for a cell of their own, each with the sibling whose cells it may join.
    pub specks: Vec<(Node, Node)>,
}

/// The cells of one half: the nodes that explain what was caught best, each cell paying for itself (Kolaczyk and Nowak,
/// "Multiscale likelihood analysis and complexity penalized estimation", 2004; optimal pruning as in dyadic
/// CART, Donoho 1997). `dispersion` is what [`dispersion`] found.
pub fn choose(tree: &SurfaceTree, caught: &Caught, dispersion: &[f32]) -> Choice {
    let mut choice = Choice::default();
    if tree.is_empty() {
        return choice;
    }
    let marks: Vec<AtomicU8> = (0..tree.len()).map(|_| AtomicU8::new(WHOLE)).collect();
    let leaf = |k: usize| {
        let area = f64::from(tree.elements[k].area);
        Sum {
            area,
            flux: caught.flux[k].map(f64::from),
            variance: caught.variance[k],
            dispersion: area * f64::from(dispersion[k]),
            gain: 0.0,
        }
    };
    let join = |node: &Node, a: Sum, b: Sum| {
        let sum = Sum {
            area: a.area + b.area,
            flux: std::array::from_fn(|c| a.flux[c] + b.flux[c]),
            variance: a.variance + b.variance,
            dispersion: a.dispersion + b.dispersion,
            gain: a.gain + b.gain,
        };
        let price = (1.0 + PENALTY) * sum.dispersion / sum.area;
        let photon = photon(&sum.flux, sum.variance);
        let photons = |s: &Sum| s.flux.iter().fold(0.0, |m: f64, &f| m.max(f)) / photon;
        let small = |s: &Sum| photons(s).max(photons(&sum) * s.area / sum.area) < LEAST_PHOTONS;
        // To split off a speck gains nothing and costs nothing: what is below the rest decides.
        let (mark, gain) = match (small(&a), small(&b)) {
            (true, true) => (WHOLE, 0.0),
            (true, false) => (SPECK_FIRST, sum.gain),
            (false, true) => (SPECK_SECOND, sum.gain),
            (false, false) => (SPLIT, sum.gain + deviance(&a, &b, photon) - price),
        };
        marks[node.index].store(if gain > 0.0 { mark } else { WHOLE }, Relaxed);
        Sum { gain: gain.max(0.0), ..sum }
    };
    tree.fold(&tree.root(), &leaf, &join);
    let mut open = vec![tree.root()];
    while let Some(node) = open.pop() {
        let mark = marks[node.index].load(Relaxed);
        match tree.children(&node).filter(|_| mark != WHOLE) {
            None => choice.cells.push(node),
            Some([a, b]) => match mark {
                SPECK_FIRST => {
                    choice.specks.push((a, b.clone()));
                    open.push(b);
                }
                SPECK_SECOND => {
                    choice.specks.push((b, a.clone()));
                    open.push(a);
                }
                _ => open.extend([b, a]),
            },
        }
    }
    choice
}

/// What becomes of a node.
const WHOLE: u8 = 0;
const SPLIT: u8 = 1;
const SPECK_FIRST: u8 = 2;
const SPECK_SECOND: u8 = 3;

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

/// Mean deviance that a split gains by noise alone, around each element: 1 for photons of one channel that arrive
/// independently, 3 for grey ones, less where low-discrepancy nets spread them evenly, more where they come in
/// showers, as in a white lampshade. From the difference of the halves in blocks of many photons each, pooled over
/// regions of many blocks and drawn to the mean of the scene.
pub fn dispersion(tree: &SurfaceTree, halves: [&Caught; 2]) -> Vec<f32> {
    if tree.is_empty() {
        return Vec::new();
    }
    /// Flux of both halves and their variance where it is still too little for a block, else (sum, number) of the
    /// blocks.
    enum Part {
        Flux([[f64; 3]; 2], f64),
        Blocks(f64, u32),
    }
    let block = |f: &[[f64; 3]; 2], photon: f64| {
        let channel = |c: usize| {
            let (sum, difference) = (f[0][c] + f[1][c], f[0][c] - f[1][c]);
            if sum > 0.0 { difference * difference / (sum * photon) } else { 0.0 }
        };
        (0..3).map(channel).sum::<f64>()
    };
    let photon = |f: &[[f64; 3]; 2], variance: f64| photon(&std::array::from_fn(|c| f[0][c] + f[1][c]), variance);
    let found: Vec<(AtomicU32, AtomicU32)> = (0..tree.len()).map(|_| Default::default()).collect();
    let leaf = |k: usize| {
        let variance = halves.iter().map(|h| h.variance[k]).sum();
        Part::Flux(halves.map(|h| h.flux[k].map(f64::from)), variance)
    };
    let join = |node: &Node, a: Part, b: Part| {
        let part = match (a, b) {
            (Part::Flux(a, v), Part::Flux(b, w)) => {
                let sum: [[f64; 3]; 2] = std::array::from_fn(|h| std::array::from_fn(|c| a[h][c] + b[h][c]));
                let photon = photon(&sum, v + w);
                if sum.iter().flatten().sum::<f64>() >= BLOCK_PHOTONS * photon {
                    Part::Blocks(block(&sum, photon), 1)
                } else {
                    Part::Flux(sum, v + w)
                }
            }
            (Part::Blocks(s, n), Part::Blocks(t, m)) => Part::Blocks(s + t, n + m),
            (blocks @ Part::Blocks(..), _) | (_, blocks) => blocks,
        };
        if let Part::Blocks(sum, n) = part {
            found[node.index].0.store((sum as f32).to_bits(), Relaxed);
            found[node.index].1.store(n, Relaxed);
        }
        part
    };
    let mean = match tree.fold(&tree.root(), &leaf, &join) {
        Part::Blocks(sum, n) => (sum / f64::from(n)).max(1e-3),
        Part::Flux(sum, variance) => block(&sum, photon(&sum, variance)).max(1.0),
    };
    let mut out = vec![0.0; tree.elements.len()];
    for region in tree.cut(|n| found[n.index].1.load(Relaxed) <= REGION_BLOCKS) {
        let (sum, n) = &found[region.index];
        let (sum, n) = (f64::from(f32::from_bits(sum.load(Relaxed))), f64::from(n.load(Relaxed)));
        let drawn = (sum + SCENE_BLOCKS * mean) / (n + SCENE_BLOCKS);
        out[region.elements].fill(drawn as f32);
    }
    out
}

/// Squared difference of the halves of single elements, summed over the channels, in proportion to the variance that
/// their own samples show: 3 where samples are random, less where they are so many that their low-discrepancy
/// sequence tells. Pooled over regions of neighbours; empty where elements have no samples of their own.
pub fn scatter(tree: &SurfaceTree, halves: [&Caught; 2]) -> Vec<f32> {
    let [Some(odd), Some(even)] = halves.map(|h| h.samples.as_ref()) else { return Vec::new() };
    let mut out = vec![3.0; tree.elements.len()];
    for region in tree.cut(|n| n.elements.len() <= SCATTER_REGION) {
        let n = region.elements.len() as f64;
        let (mut seen, mut shown) = (0.0, 0.0);
        for k in region.elements.clone() {
            let difference = |c: usize| f64::from(halves[0].flux[k][c]) - f64::from(halves[1].flux[k][c]);
            seen += (0..3).map(|c| difference(c).powi(2)).sum::<f64>();
            shown += odd.scatter[k] + even.scatter[k];
        }
        if shown > 0.0 {
            out[region.elements].fill(((seen / shown * n + 3.0 * SCATTER_DRAWN) / (n + SCATTER_DRAWN)) as f32);
        }
    }
    out
}
