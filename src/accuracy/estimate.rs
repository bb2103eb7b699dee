//! Error of the mean of two halves: their noise, and the bias of cells.

use super::illuminance::Illuminance;
use super::interval::{TWO_SIDED_95, chi_square_quantile};
use super::plan::SMOOTH_FALL;
use crate::atlas::Texels;
use crate::cell::{Bias, Node, SurfaceTree};
use crate::options::TexelValue;
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

    /// Light of both kinds.
    pub fn plus(&self, other: &Halves) -> Halves {
        let add = |a: &[Vec3], b: &[Vec3]| a.par_iter().zip(b).map(|(a, b)| *a + *b).collect();
        Halves { odd: add(&self.odd, &other.odd), even: add(&self.even, &other.even) }
    }

    /// Half the difference: as noisy as the mean, with expectation 0.
    pub fn difference(&self, texel: usize) -> Vec3 {
        (self.odd[texel] - self.even[texel]) * 0.5
    }
}

/// Light that came from lamps over mirrors and through glass alone.
#[derive(Debug, Clone)]
pub struct Caustics {
    /// What of it is in the values of the texels of the map (lux).
    pub stored: Halves,
    /// Irradiance (lux) of the open part of every texel, on the map or not: what is reflected.
    pub everywhere: Halves,
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

    /// Weights of texels that hold `value`.
    pub fn of_values(world: &World, texels: &Texels, open: &[f32], value: TexelValue) -> TexelWeights {
        match value {
            TexelValue::Open => TexelWeights::new(world, texels, open),
            TexelValue::Mean => TexelWeights::new(world, texels, &vec![1.0; texels.mapped]),
        }
    }

    /// Leaves a texel out of the maps and of all figures.
    pub fn drop(&mut self, texel: usize) {
        self.weight[texel] = 0.0;
        self.stored[texel] = false;
    }
}

/// `n` texels, evenly spread over all of their `weights` in order, moved by `moved` of the way from one to the next, in
/// [0, 1).
pub fn spread(weights: &[f64], n: usize, moved: f64) -> Vec<usize> {
    let sum = |sum: &mut f64, w: &f64| {
        *sum += w;
        Some(*sum)
    };
    let cumulative: Vec<f64> = weights.iter().scan(0.0, sum).collect();
    let total = cumulative.last().copied().unwrap_or(0.0);
    let pick = |j: usize| cumulative.partition_point(|c| *c <= (j as f64 + moved) / n as f64 * total);
    (0..n).map(|j| pick(j).min(cumulative.len().saturating_sub(1))).collect()
}

/// The error of the map, in percent of its mean irradiance, all channels together.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TexelError {
    /// Area-weighted mean irradiance over the three channels (lux).
    pub mean: f64,
    /// Noise of the stored mean.
    pub sigma: f64,
    /// Of it direct light.
    pub direct: f64,
    /// Of it indirect light.
    pub indirect: f64,
    /// What smoothing over cells adds.
    pub cell_bias: f64,
    /// Its standard error, as the root of that of its square.
    pub cell_bias_resolution: f64,
    /// What an audit found beyond both.
    pub unseen: f64,
    /// All together.
    pub percent: f64,
    /// Lower end of its 95 % interval.
    pub low: f64,
    /// Upper end of its 95 % interval.
    pub high: f64,
    /// Noise in luminance, relative to the mean luminance, and the bias.
    pub luminance_percent: f64,
    /// Share of the squared noise in the worst thousandth of the texels.
    pub outlier_share: f64,
}

/// Squared error that halves do not show: what is finer than the photons can tell is smoothed away in both, and cells
/// too fine for their noise hide their bias. An audit finds it.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Unseen {
    /// Its square, in percent squared.
    pub square: f64,
    /// Standard error of that.
    pub deviation: f64,
    /// Photons at the time.
    pub photons: u64,
}

impl Unseen {
    /// What of it is left with `photons`: cells shrink, as when they show their bias.
    fn left(&self, photons: u64) -> f64 {
        libm::pow(self.photons.max(1) as f64 / photons.max(1) as f64, SMOOTH_FALL).min(1.0)
    }
}

impl TexelError {
    /// What halves show, and what of `unseen` is left where there are now `photons`.
    pub fn with(&self, unseen: &Unseen, photons: u64) -> TexelError {
        let left = unseen.left(photons);
        let spread = TWO_SIDED_95 * unseen.deviation * left;
        let seen = self.percent.powi(2);
        let (below, above) = (seen - self.low.powi(2), self.high.powi(2) - seen);
        self.stated(unseen.square * left, below.hypot(spread), above.hypot(spread))
    }

    /// Raised to what an audit found at the time: the audit's own interval.
    pub fn raised(&self, unseen: &Unseen) -> TexelError {
        let spread = TWO_SIDED_95 * unseen.deviation;
        self.stated(unseen.square, spread, spread)
    }

    /// Of the sum of two maps with noise of their own; bias adds up, as it does at worst.
    pub fn plus(&self, other: &TexelError) -> TexelError {
        let mean = self.mean + other.mean;
        if mean <= 0.0 {
            return TexelError::default();
        }
        let shares = [self.mean / mean, other.mean / mean];
        let both = |of: fn(&TexelError) -> f64| [shares[0] * of(self), shares[1] * of(other)];
        let apart = |of| both(of).into_iter().fold(0.0, f64::hypot);
        let alike = |of| both(of).into_iter().sum::<f64>();
        let (sigma, cell_bias, unseen) = (apart(|e| e.sigma), alike(|e| e.cell_bias), alike(|e| e.unseen));
        let square = sigma * sigma + cell_bias * cell_bias + unseen * unseen;
        // Ends of squared errors that err by themselves.
        let reach =
            |of: fn(&TexelError) -> f64| both(of).into_iter().fold(0.0, |sum: f64, root| sum.hypot(root * root));
        let above = reach(|e| (e.high * e.high - e.percent * e.percent).max(0.0).sqrt());
        let below = reach(|e| (e.percent * e.percent - e.low * e.low).max(0.0).sqrt());
        let worst = |a: f64, b: f64| if other.sigma * shares[1] > self.sigma * shares[0] { b } else { a };
        TexelError {
            mean,
            sigma,
            direct: apart(|e| e.direct),
            indirect: apart(|e| e.indirect),
            cell_bias,
            cell_bias_resolution: apart(|e| e.cell_bias_resolution),
            unseen,
            percent: square.sqrt(),
            low: (square - below).max(0.0).sqrt(),
            high: (square + above).sqrt(),
            luminance_percent: apart(|e| e.luminance_percent),
            outlier_share: worst(self.outlier_share, other.outlier_share),
        }
    }

    /// The same with another unseen square, where the interval of the whole square reaches so far `below` and `above`.
    fn stated(&self, unseen: f64, below: f64, above: f64) -> TexelError {
        let beyond = unseen - self.unseen.powi(2);
        let square = self.percent.powi(2) + beyond;
        TexelError {
            unseen: unseen.sqrt(),
            percent: square.sqrt(),
            low: (square - below).max(0.0).sqrt(),
            high: (square + above).sqrt(),
            luminance_percent: (self.luminance_percent.powi(2) + beyond).sqrt(),
            ..*self
        }
    }
}

/// Texels per block of the sums.
const BLOCK: usize = 64;

/// Degrees of freedom of the noise in a block of a cell's size: a mean and two slopes.
const CELL_FREEDOM: f64 = 3.0;

/// Rec. 709 luminance.
pub(super) fn luminance(c: Vec3) -> f64 {
    0.2126 * f64::from(c.x) + 0.7152 * f64::from(c.y) + 0.0722 * f64::from(c.z)
}

/// What is known of the light of every texel of the map.
#[derive(Debug, Clone, Copy)]
pub struct Known<'a> {
    /// Light straight from emitters.
    pub direct: &'a Halves,
    /// Reflected light.
    pub indirect: &'a Halves,
    /// Both.
    pub total: &'a Halves,
    /// Of it, light in which every texel errs on its own; in the rest, what lies in one block errs together.
    pub apart: &'a Halves,
    /// How texels count.
    pub weights: &'a TexelWeights,
    /// The surface that blocks are of.
    pub tree: &'a SurfaceTree,
    /// Blocks of the smoothed light.
    pub blocks: &'a [Node],
    /// Its squared bias over all.
    pub bias: Bias,
    /// Variance of the sum of squared noise by light that was smoothed over other blocks besides.
    pub more_variance: f64,
    /// Squared relative noise that all indirect light has in common.
    pub start_noise: f64,
}

#[derive(Clone, Copy, Default)]
struct Sums {
    weight: f64,
    square_weight: f64,
    e: f64,
    y: f64,
    square: f64,
    square_y: f64,
    direct: f64,
    indirect: f64,
    /// Squared indirect light itself.
    indirect_light: f64,
    apart: f64,
}

/// The error over all texels with weight.
pub fn texel_error(known: &Known) -> TexelError {
    let Known { direct, indirect, total, apart, weights, .. } = *known;
    let n = weights.weight.len();
    let third = |d: Vec3| f64::from(d.length_squared()) / 3.0;
    // Fixed blocks, summed in order: the same bits for any number of threads.
    let blocks: Vec<Sums> = (0..n.div_ceil(BLOCK))
        .into_par_iter()
        .map(|b| {
            let mut s = Sums::default();
            for i in b * BLOCK..((b + 1) * BLOCK).min(n) {
                let w = weights.weight[i];
                if w > 0.0 {
                    let (d, e) = (total.difference(i), total.mean(i));
                    s.weight += w;
                    s.square_weight += w * w;
                    s.e += w * f64::from(e.element_sum()) / 3.0;
                    s.y += w * luminance(e);
                    s.square += w * third(d);
                    s.square_y += w * luminance(d).powi(2);
                    s.direct += w * third(direct.difference(i));
                    s.indirect += w * third(indirect.difference(i));
                    s.indirect_light += w * third(indirect.mean(i));
                    s.apart += w * third(apart.difference(i));
                }
            }
            s
        })
        .collect();
    let sum = |f: fn(&Sums) -> f64| blocks.iter().map(f).sum::<f64>();
    let (weight, square, mean) = (sum(|s| s.weight), sum(|s| s.square), sum(|s| s.e));
    if weight <= 0.0 || mean <= 0.0 {
        return TexelError::default();
    }
    let mean = mean / weight;
    let percent = |square: f64| 100.0 * (square.max(0.0) / weight).sqrt() / mean;
    // Upper and lower end of the noise, taken as chi-square.
    let common = known.start_noise * sum(|s| s.indirect_light);
    let variance = apart_variance(&blocks) + smoothed_variance(known) + known.more_variance + 2.0 * common * common;
    // Never more degrees of freedom than texels that count.
    let texels = weight * weight / sum(|s| s.square_weight);
    let nu = if variance > 0.0 { 2.0 * square * square / variance } else { f64::INFINITY };
    let nu = nu.min(texels).clamp(3.0, 1e6);
    let noise_low = square * nu / chi_square_quantile(0.975, nu);
    let noise_high = square * nu / chi_square_quantile(0.025, nu);
    let spread = TWO_SIDED_95 * known.bias.variance.sqrt();
    let middle = square + known.bias.square.max(0.0);
    let bias = percent(known.bias.square);
    let y = 100.0 * (sum(|s| s.square_y) / weight).sqrt() / (sum(|s| s.y) / weight);
    TexelError {
        mean,
        sigma: percent(square),
        direct: percent(sum(|s| s.direct)),
        indirect: percent(sum(|s| s.indirect)),
        cell_bias: bias,
        cell_bias_resolution: percent(known.bias.variance.sqrt()),
        unseen: 0.0,
        percent: percent(middle),
        low: percent(middle - (square - noise_low).hypot(spread)),
        high: percent(middle + (noise_high - square).hypot(spread)),
        luminance_percent: y.hypot(bias),
        outlier_share: outlier_share(total, weights, square),
    }
}

/// Variance of the sum of the squared noise of texels that err apart: neighbouring blocks are compared, in which what
/// varies slowly over the atlas cancels.
fn apart_variance(blocks: &[Sums]) -> f64 {
    let pairs: f64 = blocks.chunks_exact(2).map(|p| (p[0].apart - p[1].apart).powi(2)).sum();
    let last = match blocks {
        [.., a, b] if blocks.len() % 2 == 1 => (a.apart - b.apart).powi(2),
        _ => 0.0,
    };
    pairs + last
}

/// Variance of the squared noise of smoothed light, summed to `square` over a block of a cell's size.
pub fn block_variance(square: f64) -> f64 {
    2.0 / CELL_FREEDOM * square * square
}

/// Variance of the sum of the squared noise of the smoothed light, from what each block adds to it.
fn smoothed_variance(known: &Known) -> f64 {
    let Known { total, apart, weights, tree, blocks, .. } = *known;
    let term = |b: &Node| {
        let of = |k: usize| {
            let i = tree.elements[k].texel as usize;
            weights.weight[i] * f64::from((total.difference(i) - apart.difference(i)).length_squared()) / 3.0
        };
        block_variance(b.elements.clone().map(of).sum())
    };
    let terms: Vec<f64> = blocks.par_iter().map(term).collect();
    terms.iter().sum()
}

fn outlier_share(total: &Halves, weights: &TexelWeights, square: f64) -> f64 {
    let n = weights.weight.len();
    let mut terms: Vec<f64> =
        (0..n).map(|i| weights.weight[i] * f64::from(total.difference(i).length_squared()) / 3.0).collect();
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
    /// Least irradiance of a texel (lux), noise and all; `illuminance` has what a luxmeter would find.
    pub minimum: f64,
    /// Largest irradiance of a texel (lux), likewise.
    pub maximum: f64,
    /// RMS error relative to the larger of the node's mean and 1 % of the scene's; with one standard error of the
    /// bias on top, so that too few photons to show whether it is right do not pass for none.
    pub error_percent: f64,
    /// Share of its texels' area whose error is at most the target times the larger of E there and 1 % of the
    /// scene's mean.
    pub area_within_target: f64,
    /// Illuminance with its errors; `None` until the maps are made.
    pub illuminance: Option<Illuminance>,
}

/// Errors per node, in the order of the instances, and the share of all area within the target. `bias` is that of
/// each instance.
pub fn mesh_errors(
    world: &World,
    halves: &Halves,
    weights: &TexelWeights,
    bias: &[Bias],
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
    let mut weight = vec![0f64; nodes.len()];
    (0..weights.weight.len()).for_each(|i| weight[weights.instance[i] as usize] += weights.weight[i]);
    let mean_bias: Vec<f64> =
        bias.iter().zip(&weight).map(|(b, &w)| if w > 0.0 { b.likely() / w } else { 0.0 }).collect();
    for i in 0..weights.weight.len() {
        let w = weights.weight[i];
        if w <= 0.0 {
            continue;
        }
        let instance = weights.instance[i] as usize;
        let node = &mut nodes[instance];
        let (d, e) = (halves.difference(i), f64::from(halves.mean(i).element_sum()) / 3.0);
        let square = f64::from(d.length_squared()) / 3.0 + mean_bias[instance];
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
                illuminance: None,
            }
        })
        .collect();
    (errors, if weight > 0.0 { within / weight } else { 1.0 })
}
