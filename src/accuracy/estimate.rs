//! Error of the mean of two halves.

use super::interval::chi_square_quantile;
use crate::atlas::Texels;
use crate::scene::World;
use glam::Vec3;
use rayon::prelude::*;
use serde::Serialize;

/// Irradiance of each texel of the map in two independent halves (lux).
#[derive(Debug, Clone, Default)]
pub struct Halves {
    /// From odd data alone.
    pub odd: Vec<Vec3>,
    /// From even data alone.
    pub even: Vec<Vec3>,
}

impl Halves {
    /// What is stored: the mean of both.
    pub fn mean(&self, texel: usize) -> Vec3 {
        (self.odd[texel] + self.even[texel]) * 0.5
    }

    /// Half the difference: as noisy as the mean, with expectation 0.
    pub fn difference(&self, texel: usize) -> Vec3 {
        (self.odd[texel] - self.even[texel]) * 0.5
    }
}

/// How much each texel of the map counts, and to whom it belongs.
#[derive(Debug, Clone, Default)]
pub struct TexelWeights {
    /// Open surface area [frame units squared] times the node's weight; 0 for texels that are not stored.
    pub weight: Vec<f64>,
    /// Scene instance of each texel.
    pub instance: Vec<u32>,
    /// False for texels that do not reach the maps: buried, or the side of a double-sided surface that is not
    /// kept. Stored texels of nodes with weight 0 are written but counted nowhere.
    pub stored: Vec<bool>,
}

impl TexelWeights {
    /// Weights by open area, all texels taken as stored.
    pub fn new(world: &World, texels: &Texels, open: &[f32]) -> TexelWeights {
        let instance: Vec<u32> =
            (0..texels.mapped).map(|i| world.refs[texels.pieces_of(i)[0].triangle as usize].instance).collect();
        let weight: Vec<f64> = (0..texels.mapped)
            .map(|i| {
                let node = f64::from(world.scene.instances[instance[i] as usize].weight);
                f64::from(texels.texels[i].area) * f64::from(open[i]) * node
            })
            .collect();
        let stored = open.iter().map(|&o| o > 0.0).collect();
        TexelWeights { weight, instance, stored }
    }
}

impl TexelWeights {
    /// Leaves a texel out of the maps and of all figures.
    pub fn drop(&mut self, texel: usize) {
        self.weight[texel] = 0.0;
        self.stored[texel] = false;
    }
}

/// An error over many texels, in percent of their mean.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ErrorEstimate {
    /// Area-weighted mean irradiance over the three channels (lux).
    pub mean: f64,
    /// RMS error of the stored mean, all channels together.
    pub percent: f64,
    /// Lower end of its 95 % interval.
    pub low: f64,
    /// Upper end of its 95 % interval.
    pub high: f64,
    /// The same for luminance, relative to the mean luminance.
    pub luminance_percent: f64,
    /// Degrees of freedom of the estimate.
    pub degrees_of_freedom: f64,
    /// Share of the squared error in the worst thousandth of the texels.
    pub outlier_share: f64,
}

/// Texels per block of the variance of the estimate: longer than noise is correlated.
const BLOCK: usize = 64;

/// Rec. 709 luminance.
fn luminance(c: Vec3) -> f64 {
    0.2126 * f64::from(c.x) + 0.7152 * f64::from(c.y) + 0.0722 * f64::from(c.z)
}

#[derive(Clone, Copy, Default)]
struct Sums {
    weight: f64,
    e: f64,
    y: f64,
    square: f64,
    square_y: f64,
}

/// Error over all texels with weight, against the mean of `total` (give other halves than `part` to relate one
/// part's error to the whole light).
pub fn estimate_error(part: &Halves, total: &Halves, weights: &TexelWeights) -> ErrorEstimate {
    let n = weights.weight.len();
    // Fixed blocks, summed in order: the same bits for any number of threads.
    let blocks: Vec<Sums> = (0..n.div_ceil(BLOCK))
        .into_par_iter()
        .map(|b| {
            let mut s = Sums::default();
            for i in b * BLOCK..((b + 1) * BLOCK).min(n) {
                let w = weights.weight[i];
                if w > 0.0 {
                    let (d, e) = (part.difference(i), total.mean(i));
                    s.weight += w;
                    s.e += w * f64::from(e.element_sum()) / 3.0;
                    s.y += w * luminance(e);
                    s.square += w * f64::from(d.length_squared()) / 3.0;
                    s.square_y += w * luminance(d).powi(2);
                }
            }
            s
        })
        .collect();
    let sum = |f: fn(&Sums) -> f64| blocks.iter().map(f).sum::<f64>();
    let (weight, square) = (sum(|s| s.weight), sum(|s| s.square));
    if weight <= 0.0 {
        return ErrorEstimate::default();
    }
    let mean = sum(|s| s.e) / weight;
    let relative = |square: f64, mean: f64| {
        if mean > 0.0 { 100.0 * (square / weight).max(0.0).sqrt() / mean } else { 0.0 }
    };
    let percent = relative(square, mean);
    let nu = degrees_of_freedom(&blocks, square);
    ErrorEstimate {
        mean,
        percent,
        low: percent * (nu / chi_square_quantile(0.975, nu)).sqrt(),
        high: percent * (nu / chi_square_quantile(0.025, nu)).sqrt(),
        luminance_percent: relative(sum(|s| s.square_y), sum(|s| s.y) / weight),
        degrees_of_freedom: nu,
        outlier_share: outlier_share(part, weights, square),
    }
}

/// Degrees of freedom of Q = the sum of the blocks: the variance of Q is the sum of the squared differences of
/// neighbouring blocks, in which what varies slowly over the atlas cancels.
fn degrees_of_freedom(blocks: &[Sums], square: f64) -> f64 {
    let variance: f64 = blocks.chunks_exact(2).map(|p| (p[0].square - p[1].square).powi(2)).sum();
    if square <= 0.0 || variance <= 0.0 {
        return (blocks.len() * BLOCK) as f64;
    }
    (2.0 * square * square / variance).clamp(4.0, (blocks.len() * BLOCK) as f64)
}

fn outlier_share(part: &Halves, weights: &TexelWeights, square: f64) -> f64 {
    let n = weights.weight.len();
    let mut terms: Vec<f64> =
        (0..n).map(|i| weights.weight[i] * f64::from(part.difference(i).length_squared()) / 3.0).collect();
    let worst = n.div_ceil(1000).min(n);
    if worst == 0 || square <= 0.0 {
        return 0.0;
    }
    terms.select_nth_unstable_by(worst - 1, |a, b| b.total_cmp(a));
    let mut top = terms[..worst].to_vec();
    top.sort_unstable_by(f64::total_cmp);
    top.iter().sum::<f64>() / square
}

/// Error of one node's texels.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeshError {
    /// Scene instance.
    #[serde(skip)]
    pub instance: usize,
    /// Name of the node.
    pub name: String,
    /// Texels on the map.
    pub texels: usize,
    /// Mean irradiance (lux), over area and channels.
    pub mean: f64,
    /// Least mean irradiance of a texel (lux).
    pub minimum: f64,
    /// Largest mean irradiance of a texel (lux).
    pub maximum: f64,
    /// RMS error relative to the larger of the node's mean and 1 % of the scene's.
    pub error_percent: f64,
    /// Share of its texels' area whose error is at most the target times the larger of E there and 1 % of the
    /// scene's mean.
    pub area_within_target: f64,
}

/// Errors per node, in the order of the instances, and the share of all area within the target.
pub fn mesh_errors(
    world: &World,
    halves: &Halves,
    weights: &TexelWeights,
    scene_mean: f64,
    target_percent: f64,
) -> (Vec<MeshError>, f64) {
    #[derive(Clone, Copy)]
    struct Node {
        texels: usize,
        sums: Sums,
        within: f64,
        least: f64,
        largest: f64,
    }
    let empty = Node { texels: 0, sums: Sums::default(), within: 0.0, least: f64::INFINITY, largest: 0.0 };
    let mut nodes = vec![empty; world.scene.instances.len()];
    let floor = 0.01 * scene_mean;
    for i in 0..weights.weight.len() {
        let w = weights.weight[i];
        if w <= 0.0 {
            continue;
        }
        let node = &mut nodes[weights.instance[i] as usize];
        let (d, e) = (halves.difference(i), f64::from(halves.mean(i).element_sum()) / 3.0);
        let square = f64::from(d.length_squared()) / 3.0;
        node.texels += 1;
        node.sums.weight += w;
        node.sums.e += w * e;
        node.sums.square += w * square;
        node.least = node.least.min(e);
        node.largest = node.largest.max(e);
        // The half difference is distributed as the error itself, so counting it counts the error.
        if square.sqrt() <= target_percent / 100.0 * e.max(floor) {
            node.within += w;
        }
    }
    let within: f64 = nodes.iter().map(|n| n.within).sum();
    let weight: f64 = nodes.iter().map(|n| n.sums.weight).sum();
    let errors = nodes
        .iter()
        .enumerate()
        .filter(|(_, n)| n.texels > 0)
        .map(|(i, n)| {
            let mean = n.sums.e / n.sums.weight;
            let base = mean.max(floor);
            let rms = (n.sums.square / n.sums.weight).sqrt();
            MeshError {
                instance: i,
                name: world.scene.instances[i].name.clone(),
                texels: n.texels,
                mean,
                minimum: n.least,
                maximum: n.largest,
                error_percent: if base > 0.0 { 100.0 * rms / base } else { 0.0 },
                area_within_target: n.within / n.sums.weight,
            }
        })
        .collect();
    (errors, if weight > 0.0 { within / weight } else { 1.0 })
}
