//! Illuminance of each node as those ask for it who light rooms: mean, least and largest (lux), and uniformity.
//!
//! In: irradiance of the texels in two halves. Out: figures that a luxmeter can check, each with one standard error.
//!
//! Least and largest are those of *patches*: parts of a chart as wide as the measuring grid of EN 12464-1 is fine, so
//! that neither the size of a texel nor a single noisy one decides. The least of noisy values is too low on the average,
//! however little noise there is. So one half says where it is and the other what it is there, and the other way round:
//! unbiased for the place that was picked, which may be the wrong one, and then too high. Between both is the truth; how
//! far they are apart is part of the error.
//!
//! Places are picked in the light of the maps. Values are read from it as it was before smoothing, which lightens the
//! dark corners that a minimum is about: its noise is more, but all of it shows in the halves.

use super::estimate::{Halves, MeshError, TexelWeights, luminance};
use crate::atlas::Texels;
use crate::scene::World;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;

/// Illuminance of the stored, open surface of a node: irradiance weighted by Rec. 709 luminance (lux). Errors are one
/// standard error each.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Illuminance {
    /// Mean over the area.
    pub mean: f64,
    /// Its error.
    pub mean_error: f64,
    /// Least mean of a patch.
    pub minimum: f64,
    /// Its error.
    pub minimum_error: f64,
    /// Largest mean of a patch.
    pub maximum: f64,
    /// Its error.
    pub maximum_error: f64,
    /// Uniformity U0 of EN 12464-1: `minimum` over `mean`; `None` in the dark.
    pub uniformity: Option<f64>,
    /// Its error.
    pub uniformity_error: Option<f64>,
    /// Patches that count.
    pub patches: usize,
    /// Their width (m): the root of their mean area.
    pub patch_width: f64,
}

/// What is known of one texel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Part {
    /// Patch that it belongs to.
    pub patch: usize,
    /// Area (m2), > 0.
    pub area: f64,
    /// Illuminance (lux) in two independent halves, as in the maps.
    pub smooth: [f64; 2],
    /// The same before smoothing.
    pub raw: [f64; 2],
}

/// Most numbers of groups of texels, each four times as many as before, that tell how the noise of a mean adds up.
const MOST_GROUPS: usize = 64;

/// Noise of the least patch is that of so many patches next to it in value, or of an eighth of all if that is more.
const LEAST_POOL: usize = 8;

/// A patch counts from this share of the area of one that is as wide as the grid, or of the largest if all are smaller:
/// the reveal of a window does, where sun may fall on it alone, a chamfer does not.
const FULL: f64 = 0.1;

/// Spacing of the measuring grid of an area (m2) with sides of about the same length: p = 0.2 x 5^(log10 d) with the side
/// d, p at most 10 m (EN 12464-1:2021, illuminance grid).
pub fn grid_spacing(area: f64) -> f64 {
    let side = area.max(1e-12).sqrt();
    (0.2 * libm::pow(5.0, libm::log10(side))).min(10.0)
}

impl Illuminance {
    /// From the texels of a node in the order of the atlas, which holds neighbours together. `spacing` is the width of a
    /// whole patch (m). `None` without texels.
    pub fn new(parts: &[Part], spacing: f64) -> Option<Illuminance> {
        let area: f64 = parts.iter().map(|p| p.area).sum();
        if parts.is_empty() || area <= 0.0 {
            return None;
        }
        let [odd, even] = [0, 1].map(|h| parts.iter().map(|p| p.area * p.raw[h]).sum::<f64>() / area);
        let mean = 0.5 * (odd + even);
        let mean_error = mean_noise(parts) / area;
        let patches = Patch::of(parts, spacing);
        let (minimum, minimum_error) = least(&patches, 1.0);
        let (maximum, maximum_error) = least(&patches, -1.0);
        let lit = mean > 0.0;
        let uniformity = minimum / mean;
        Some(Illuminance {
            mean,
            mean_error,
            minimum,
            minimum_error,
            maximum,
            maximum_error,
            uniformity: lit.then_some(uniformity),
            uniformity_error: lit.then(|| minimum_error.hypot(uniformity * mean_error) / mean),
            patches: patches.len(),
            patch_width: (patches.iter().map(|p| p.area).sum::<f64>() / patches.len() as f64).sqrt(),
        })
    }
}

/// Standard error of the sum of area times illuminance [lux m2]. Neighbours may err together, as where both look up the
/// same light, so the half differences of groups of them are summed first: the largest of some sizes of groups is taken,
/// up to all in one, which misses no correlation but tells little by itself.
fn mean_noise(parts: &[Part]) -> f64 {
    let difference = |p: &Part| p.area * half_difference(p.raw);
    let mut most = 0f64;
    let mut groups = 1;
    while groups <= MOST_GROUPS.min(parts.len()) {
        let each = parts.len().div_ceil(groups);
        let square = |group: &[Part]| group.iter().map(difference).sum::<f64>().powi(2);
        most = most.max(parts.chunks(each).map(square).sum());
        groups *= 4;
    }
    most.sqrt()
}

fn half_difference([odd, even]: [f64; 2]) -> f64 {
    0.5 * (odd - even)
}

/// Part of a chart.
#[derive(Debug, Clone, Copy, Default)]
struct Patch {
    area: f64,
    /// Means of each half (lux), smoothed and not.
    smooth: [f64; 2],
    raw: [f64; 2],
}

impl Patch {
    /// Those that count, in order; at least one.
    fn of(parts: &[Part], spacing: f64) -> Vec<Patch> {
        let mut patches = BTreeMap::<usize, Patch>::new();
        for part in parts {
            let sum = patches.entry(part.patch).or_default();
            sum.area += part.area;
            for h in [0, 1] {
                sum.smooth[h] += part.area * part.smooth[h];
                sum.raw[h] += part.area * part.raw[h];
            }
        }
        let largest = patches.values().map(|p| p.area).fold(0.0, f64::max);
        let whole = spacing * spacing;
        let full = if largest >= FULL * whole { whole } else { largest };
        let counts = |p: &Patch| p.area >= FULL * full;
        let mean =
            |p: Patch| Patch { smooth: p.smooth.map(|e| e / p.area), raw: p.raw.map(|e| e / p.area), area: p.area };
        patches.into_values().filter(counts).map(mean).collect()
    }

    /// Mean of both halves, as in the maps.
    fn mean(&self) -> f64 {
        0.5 * (self.smooth[0] + self.smooth[1])
    }
}

/// Least value of a patch and its error, or the largest where `sign` is -1.
fn least(patches: &[Patch], sign: f64) -> (f64, f64) {
    let first = |of: &dyn Fn(&Patch) -> f64| {
        let key = |k: &usize| sign * of(&patches[*k]);
        (0..patches.len()).min_by(|a, b| key(a).total_cmp(&key(b))).unwrap_or_default()
    };
    let picked = [0, 1].map(|h| &patches[first(&|p| p.smooth[h])]);
    let read = |of: &dyn Fn(&Patch) -> [f64; 2]| 0.5 * (of(picked[0])[1] + of(picked[1])[0]);
    // How much too high the wrong place is, as far as the maps tell.
    let gap = read(&|p| p.smooth) - patches[first(&Patch::mean)].mean();
    let mut by_value: Vec<&Patch> = patches.iter().collect();
    by_value.sort_by(|a, b| (sign * a.mean()).total_cmp(&(sign * b.mean())));
    by_value.truncate(LEAST_POOL.max(patches.len() / 8));
    let square: f64 = by_value.iter().map(|p| half_difference(p.raw).powi(2)).sum();
    let noise = (square / by_value.len() as f64).sqrt();
    (read(&|p| p.raw), noise.hypot(gap))
}

/// Fills in the illuminance of the nodes of `meshes` from the irradiance of the maps, `total`, and from that before
/// smoothing.
pub fn add_illuminances(
    world: &World,
    texels: &Texels,
    [total, unsmoothed]: [&Halves; 2],
    weights: &TexelWeights,
    meshes: &mut [MeshError],
) {
    let mut of_instance = vec![Vec::new(); world.scene.instances.len()];
    (0..texels.mapped)
        .filter(|&i| weights.weight[i] > 0.0)
        .for_each(|i| of_instance[weights.instance[i] as usize].push(i));
    meshes.par_iter_mut().for_each(|mesh| {
        let texels_of = &of_instance[mesh.instance];
        // Weights are open areas times the node's own weight.
        let metres2 = world.frame.metres.powi(2) / f64::from(world.scene.instances[mesh.instance].weight);
        let area = |i: usize| weights.weight[i] * metres2;
        let spacing = grid_spacing(texels_of.iter().map(|&i| area(i)).sum());
        let width = spacing / world.frame.metres;
        let parts: Vec<Part> = patches(texels, texels_of, width)
            .into_iter()
            .zip(texels_of)
            .map(|(patch, &i)| {
                let luminances = |e: &Halves| [luminance(e.odd[i]), luminance(e.even[i])];
                Part { patch, area: area(i), smooth: luminances(total), raw: luminances(unsmoothed) }
            })
            .collect();
        mesh.illuminance = Illuminance::new(&parts, spacing);
    });
}

/// A side of a chart on its page (texels).
#[derive(Clone, Copy)]
struct Extent {
    low: [u32; 2],
    high: [u32; 2],
    /// Surface [frame units squared].
    area: f64,
    /// Texels that it fills.
    covered: f64,
    /// Columns and rows of patches, and the number of its first one.
    columns: u32,
    rows: u32,
    first: usize,
}

/// The patch of each of `ids`, texels of one node: its charts are cut into columns and rows about `width` [frame units]
/// wide.
fn patches(texels: &Texels, ids: &[usize], width: f64) -> Vec<usize> {
    let place = |i: usize| {
        let (_, x, y) = texels.page_position(i);
        [x, y]
    };
    let mut sides = BTreeMap::<(u32, bool), Extent>::new();
    for &i in ids {
        let (t, at) = (&texels.texels[i], place(i));
        let side = sides.entry((t.chart, t.back)).or_insert(Extent {
            low: at,
            high: at,
            area: 0.0,
            covered: 0.0,
            columns: 1,
            rows: 1,
            first: 0,
        });
        side.low = std::array::from_fn(|k| side.low[k].min(at[k]));
        side.high = std::array::from_fn(|k| side.high[k].max(at[k]));
        side.area += f64::from(t.area);
        side.covered += f64::from(t.coverage);
    }
    let mut count = 0;
    for side in sides.values_mut() {
        let texel = (side.area / side.covered.max(1e-6)).sqrt();
        let [columns, rows] = [0, 1].map(|k| {
            let across = side.high[k] - side.low[k] + 1;
            ((f64::from(across) * texel / width).round() as u32).clamp(1, across)
        });
        (side.columns, side.rows, side.first) = (columns, rows, count);
        count += columns as usize * rows as usize;
    }
    let patch = |&i: &usize| {
        let (t, at) = (&texels.texels[i], place(i));
        let side = &sides[&(t.chart, t.back)];
        let step = |k: usize, n: u32| {
            let across = u64::from(side.high[k] - side.low[k] + 1);
            (u64::from(at[k] - side.low[k]) * u64::from(n) / across) as usize
        };
        side.first + step(1, side.rows) * side.columns as usize + step(0, side.columns)
    };
    ids.iter().map(patch).collect()
}
