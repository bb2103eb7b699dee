//! What bilinear filtering makes of the maps: how far it is from the irradiance inside the texels.
//!
//! At random points of the surface the filtered value B of each half is compared with the irradiance E there. Direct
//! light is sampled at the point itself, twice, V1 and V2; reflected light is followed by a quadratic through the
//! texels around, Q. The noise of all four cancels in the mean of (B_odd - Q_odd - V1)(B_even - Q_even - V2), which
//! is that of (B - E)^2 for texels without noise: the squared discretisation error of the founding paper (Voloboy
//! et al., "Analysis of accuracy of global illumination simulation").

use super::{LightmapPage, fill_gutters};
use crate::accuracy::{Halves, Moments, TexelError, TexelWeights, spread};
use crate::atlas::TexelSampler;
use crate::light::{TexelLight, inside_solid};
use crate::options::{BakeOptions, DoubleSided, Normals, TexelValue};
use crate::sampling::{Stream, hash_mix};
use crate::solve::{LightPath, Solution};
use glam::{DVec2, Vec2, Vec3};
use rayon::prelude::*;
use std::ops::Range;

/// Points: so many for each texel, but no more than these in all.
const POINTS_PER_TEXEL: usize = 8;
const MOST_POINTS: usize = 1 << 16;

/// As many again, up to so many times in all, while what could not be told from none is more than this part of what is
/// shown.
const MOST_PASSES: u64 = 16;
const RESOLVED: f64 = 0.25;

/// When points are spread: squared contrast that a texel is taken to have besides that with the texels around, in parts of
/// its own squared light, and of the mean over all.
const OWN_SHARE: f32 = 0.1;
const EVEN_SHARE: f64 = 0.3;

/// A point that is covered is drawn anew so many times at most.
const DRAWS: usize = 4;

/// Sets the random numbers of points apart from all others.
const GRID: u64 = 0x0067_7269_6400_0000;

/// What points are compared with.
#[derive(Debug, Clone, Copy)]
pub struct GridPoints<'a> {
    /// Seed of the bake.
    pub seed: u64,
    /// What direct light is found with, on the normals that receive it.
    pub light: TexelLight<'a>,
    /// How texels count.
    pub weights: &'a TexelWeights,
    /// Reflected light (lux): it has no edges within a texel.
    pub indirect: &'a Halves,
    /// Whether texels are means over the whole of their surface, not its open part alone.
    pub whole: bool,
    /// Whether backs have pages of their own, which are not looked at.
    pub split: bool,
}

/// What was found at one point.
#[derive(Debug, Clone, Copy)]
pub struct Deviation<const N: usize> {
    /// Texel that it lies in.
    pub texel: usize,
    /// An unbiased estimate of the squared deviation of each level without noise, mean over the channels (lux2), ...
    pub squares: [f64; N],
    /// ... and squared noise that filtering leaves of the first level (lux2), both times the chance that a texel drawn by
    /// its weight would have been this one over the chance that it was.
    pub noise: f64,
}

/// Pages of one density, and texels of the finest per texel of theirs, along a side.
pub type Level<'a> = (&'a [LightmapPage], u32);

impl<'a> GridPoints<'a> {
    /// Points to compare the maps of `solution` at, found along `path`.
    pub fn new(path: &LightPath<'a>, solution: &'a Solution, options: &BakeOptions) -> GridPoints<'a> {
        GridPoints {
            seed: options.seed,
            light: path.light(options.normals == Normals::Smooth),
            weights: &solution.weights,
            indirect: &solution.indirect,
            whole: options.texel_value == TexelValue::Mean,
            split: options.double_sided == DoubleSided::Split,
        }
    }

    /// Deviations of `levels` at `count` points in each of `passes`, which sets their random numbers apart; more of them
    /// where neighbouring texels of the finest level differ: the mean over all of a pass is that over the surface, by weight.
    pub fn deviations<const N: usize>(
        &self,
        levels: &[Level; N],
        count: usize,
        passes: Range<u64>,
    ) -> Vec<Deviation<N>> {
        let weights = self.weights();
        let chances = self.chances(&weights, levels[0].0);
        let (all, whole) = (chances.iter().sum::<f64>(), weights.iter().sum::<f64>());
        let mut out = Vec::with_capacity(count * (passes.end - passes.start) as usize);
        for pass in passes {
            let mut random = Stream::new(hash_mix(self.seed, GRID + 2 * pass));
            let drawn = spread(&chances, count, f64::from(random.unit()));
            let of = |sampler: &mut TexelSampler, (j, &texel): (usize, &usize)| {
                let key = hash_mix(hash_mix(self.seed, GRID + 2 * pass + 1), j as u64);
                let found = self.deviation(texel, levels, sampler, &mut Stream::new(key))?;
                Some((found, (weights[texel] / whole) / (chances[texel] / all)))
            };
            let found: Vec<(Deviation<N>, f64)> =
                drawn.par_iter().enumerate().map_init(TexelSampler::default, of).flatten().collect();
            // Some points are found to be no part of the surface.
            let mean = found.iter().map(|f| f.1).sum::<f64>() / found.len().max(1) as f64;
            let times = |d: &Deviation<N>, ratio: f64| Deviation {
                texel: d.texel,
                squares: d.squares.map(|s| s * ratio),
                noise: d.noise * ratio,
            };
            out.extend(found.iter().map(|(d, ratio)| times(d, ratio / mean)));
        }
        out
    }

    /// Weights of the texels that are looked at: what is wholly buried shows nothing, or the light of what lies upon it.
    pub fn weights(&self) -> Vec<f64> {
        let of = |i: usize| {
            let left_out = self.light.open[i] <= 0.0 || (self.split && self.light.texels.texels[i].back);
            if left_out { 0.0 } else { self.weights.weight[i] }
        };
        (0..self.weights.weight.len()).map(of).collect()
    }

    /// How likely each texel is to be looked at: by its weight, by how far the texels around it differ from it, and by its
    /// light, since what is small has few around it.
    fn chances(&self, weight: &[f64], pages: &[LightmapPage]) -> Vec<f64> {
        let texels = self.light.texels;
        let contrast = |texel: usize| {
            let (page, x, y) = texels.page_position(texel);
            let page = &pages[page];
            let shown = |x: u32, y: u32| Vec3::from(page.irradiance[(y * page.width + x) as usize]);
            let columns = x.saturating_sub(1)..(x + 2).min(page.width);
            let rows = y.saturating_sub(1)..(y + 2).min(page.height);
            let own = shown(x, y);
            let squares = rows.flat_map(|y| columns.clone().map(move |x| (x, y)));
            let contrast = squares.map(|(x, y)| (shown(x, y) - own).length_squared()).fold(0.0, f32::max);
            f64::from(contrast + OWN_SHARE * own.length_squared())
        };
        let of = |i: usize| if weight[i] > 0.0 { weight[i] * contrast(i) } else { 0.0 };
        let found: Vec<f64> = (0..weight.len()).into_par_iter().map(of).collect();
        let mean = found.iter().sum::<f64>() / weight.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        found.iter().zip(weight).map(|(f, w)| f + w * (EVEN_SHARE * mean).max(f64::MIN_POSITIVE)).collect()
    }

    fn deviation<const N: usize>(
        &self,
        texel: usize,
        levels: &[Level; N],
        sampler: &mut TexelSampler,
        stream: &mut Stream,
    ) -> Option<Deviation<N>> {
        let texels = self.light.texels;
        sampler.load(texels, texel);
        let in_part = self.light.open[texel] < 1.0;
        let mut draw = || {
            let u = Vec2::new(stream.unit(), stream.unit());
            let at = self.light.point(texel, sampler, u, &mut 0);
            let at = at.filter(|at| {
                let area = texels.texels[texel].area;
                !(in_part && inside_solid(self.light.visibility, at, area, || stream.unit()))
            });
            (sampler.sample(u), at)
        };
        // What is buried is black where it belongs to its texel, and no part of it else.
        let draws = if self.whole { 1 } else { DRAWS };
        let ((triangle, uv), at) = (0..draws).map(|_| draw()).find(|(_, at)| self.whole || at.is_some())?;
        let place = texels.on_page(triangle, uv)?;
        let (page, x, y) = texels.page_position(texel);
        let offset =
            (place - DVec2::new(f64::from(x), f64::from(y)) - 0.5).clamp(DVec2::splat(-0.5), DVec2::splat(0.5));
        let truth = at.map_or([Vec3::ZERO; 2], |at| {
            let halves = [&self.indirect.odd, &self.indirect.even];
            halves.map(|half| {
                let direct = self.light.any_light(at, stream, &mut 0).stored;
                direct + self.within(half, texel, offset.as_vec2())
            })
        });
        let filtered = levels.map(|(pages, step)| {
            let page = &pages[page];
            let shown = |values: &[[f32; 3]]| page.filtered(values, place / f64::from(step)).unwrap_or_default();
            [shown(&page.irradiance), shown(&page.half_difference)]
        });
        let square = |[mean, difference]: [Vec3; 2]| {
            let [odd, even] = [mean + difference - truth[0], mean - difference - truth[1]];
            f64::from(odd.dot(even)) / 3.0
        };
        let noise = f64::from(filtered[0][1].length_squared()) / 3.0;
        Some(Deviation { texel, squares: filtered.map(square), noise })
    }

    /// Light inside a texel, `offset` texels from its middle, where the texels of its chart around it are means of a
    /// quadratic; a plane where one is missing.
    fn within(&self, half: &[Vec3], texel: usize, offset: Vec2) -> Vec3 {
        let open = |id: usize| if self.whole { self.light.open[id] } else { 1.0 };
        let beside = |right: i32, down: i32| {
            let id = self.light.texels.beside(texel, [right, down])?;
            (self.weights.stored[id] && open(id) > 0.0).then(|| half[id] / open(id))
        };
        let own = half[texel] / open(texel).max(f32::MIN_POSITIVE);
        let along = |t: f32, before: Option<Vec3>, after: Option<Vec3>| match (before, after) {
            (Some(a), Some(b)) => {
                let bend = a + b - 2.0 * own;
                (b - a) * (0.5 * t) + bend * (0.5 * t * t - 1.0 / 24.0)
            }
            (Some(a), None) => (own - a) * t,
            (None, Some(b)) => (b - own) * t,
            (None, None) => Vec3::ZERO,
        };
        let (left, right, up, down) = (beside(-1, 0), beside(1, 0), beside(0, -1), beside(0, 1));
        let (mut twist, mut corners) = (Vec3::ZERO, 0.0);
        for (sign, dx, dy, x, y) in
            [(1.0, -1, -1, left, up), (-1.0, 1, -1, right, up), (-1.0, -1, 1, left, down), (1.0, 1, 1, right, down)]
        {
            if let (Some(x), Some(y), Some(corner)) = (x, y, beside(dx, dy)) {
                twist += sign * (corner - x - y + own);
                corners += 1.0;
            }
        }
        let twist = if corners > 0.0 { twist * (offset.x * offset.y / corners) } else { Vec3::ZERO };
        own + along(offset.x, left, right) + along(offset.y, up, down) + twist
    }
}

/// A page with texels twice as wide, each the mean over the surface of those that it covers.
pub fn coarser(page: &LightmapPage) -> LightmapPage {
    let (width, height) = (page.width.div_ceil(2), page.height.div_ceil(2));
    let n = (width * height) as usize;
    let mut out = LightmapPage {
        width,
        height,
        irradiance: vec![[0.0; 3]; n],
        half_difference: vec![[0.0; 3]; n],
        groups: Vec::new(),
        back: Vec::new(),
        coverage: vec![0.0; n],
        area: vec![0.0; n],
    };
    for i in (0..page.coverage.len()).filter(|&i| page.coverage[i] > 0.0) {
        let (x, y) = (i % page.width as usize / 2, i / page.width as usize / 2);
        let to = y * width as usize + x;
        // An area of 0 is that of a texel that shows another's light.
        let area = page.area[i].max(f32::MIN_POSITIVE);
        for c in 0..3 {
            out.irradiance[to][c] += area * page.irradiance[i][c];
            out.half_difference[to][c] += area * page.half_difference[i][c];
        }
        out.area[to] += area;
        out.coverage[to] += 0.25 * page.coverage[i];
    }
    for i in (0..n).filter(|&i| out.coverage[i] > 0.0) {
        let area = out.area[i];
        out.irradiance[i] = out.irradiance[i].map(|e| e / area);
        out.half_difference[i] = out.half_difference[i].map(|e| e / area);
    }
    fill_gutters(&mut out, 1);
    out
}

/// Error of what filtering shows. Percent of the mean irradiance.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Shown {
    /// RMS of filtering texels without noise against the irradiance inside them.
    pub grid: f64,
    /// What could not be told from none: the root of the standard error of its square.
    pub resolution: f64,
    /// All together: that, the noise that filtering leaves, and what else is wrong with the texels.
    pub percent: f64,
}

/// Error of what filtering shows of `pages`, whose texels are stated to err by `error`. Points take `samples` direct
/// samples, or somewhat more.
pub fn shown_error(points: &GridPoints, pages: &[LightmapPage], error: &TexelError, samples: u64) -> Shown {
    if error.mean <= 0.0 {
        return Shown::default();
    }
    let count = (POINTS_PER_TEXEL * points.weights.weight.len()).min(MOST_POINTS);
    let most = (samples / (2 * count as u64).max(1)).clamp(1, MOST_PASSES);
    // The bias of direct light that is smoothed counts twice, for filtered texels have it too.
    let others = (error.percent.powi(2) - error.sigma.powi(2)).max(0.0);
    let (mut square, mut noise) = (Moments::default(), Moments::default());
    let mut look = |passes: Range<u64>| {
        for d in points.deviations(&[(pages, 1)], count, passes) {
            square.add(d.squares[0] / error.mean.powi(2));
            noise.add(d.noise / error.mean.powi(2));
        }
        let (grid, noise) = (square.percent(0.0), noise.percent(0.0));
        let percent = (grid.powi(2) + noise.powi(2) + others).sqrt();
        Shown { grid, resolution: 100.0 * square.deviation().sqrt(), percent }
    };
    let first = look(0..1);
    // Decided once: where it is asked again and again, what looks sure by chance would end it.
    let wanted = (first.resolution / (RESOLVED * first.percent)).powi(4).ceil();
    let passes = wanted.min(most as f64) as u64;
    if passes > 1 { look(1..passes) } else { first }
}
