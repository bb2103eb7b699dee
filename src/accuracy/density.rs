//! Which charts need how many texels.
//!
//! In: how the error of filtering grew in each chart when its texels were made twice and four times as wide. Out: a
//! density for each, so that the error over all is least for the texels that a page holds (a texel more then gains the
//! same in all charts), or fewer where more make little difference. The founding rule: texels where discretisation is
//! the larger part of the error.

use super::interval::Moments;
use crate::atlas::ChartSize;

/// How filtering errs more in one chart with wider texels, at points of which each stands for the same part of the error
/// over all. Squares relative to that of the mean irradiance.
#[derive(Debug, Clone, Copy, Default)]
pub struct GridFall {
    /// Share of the weight of all texels.
    pub share: f64,
    /// Squared error with the texels there are.
    pub own: Moments,
    /// Squared error with texels twice as wide less that with the texels there are.
    pub fine: Moments,
    /// ... four times as wide less twice as wide.
    pub coarse: Moments,
}

/// What texels are for.
#[derive(Debug, Clone, Copy)]
pub struct DensityGoal {
    /// Target of the texel error (percent).
    pub target_percent: f64,
    /// Target of what filtering shows (percent).
    pub target_shown_percent: Option<f64>,
}

/// Densities relative to the even one: powers of the fourth root of 2 in this range.
const LADDER: std::ops::RangeInclusive<i32> = -12..=16;

/// Where twice the texels lower what is shown by less than this share, half of them do.
const LEAST_GAIN: f64 = 0.1;

/// No less than this part of the texels that fit.
const LEAST_BUDGET: f64 = 1.0 / 256.0;

/// Squared error falls with the width of texels by a power between that at an edge and that of smooth light.
const POWERS: std::ops::RangeInclusive<f64> = 1.0..=4.0;

/// Points like the mean of all that a chart is taken to have scattered by besides its own.
const SCATTER_DRAWN: f64 = 2.0;

/// A chart's part of the squared error, with texels of the pilot, and how it falls with their width.
#[derive(Debug, Clone, Copy)]
struct Part {
    square: f64,
    power: f64,
    /// What is left of it: of what is finer than the texels. It is taken to fall like that of an edge.
    finer: f64,
}

impl Part {
    /// With texels of `pilot / factor` times the width.
    fn at(&self, pilot: f64, factor: f64) -> f64 {
        let width = pilot / factor;
        self.square * libm::pow(width, self.power) + self.finer * width
    }
}

/// The density of each chart relative to the even one, and the share of the texels that fit which these are. `falls` are
/// from texels `pilot` times as dense as the even ones.
pub fn chart_densities(sizes: &[ChartSize], falls: &[GridFall], pilot: f64, goal: DensityGoal) -> (Vec<f64>, f64) {
    let parts = parts(falls);
    let whole: f64 = sizes.iter().map(|s| s.at(1.0)).sum();
    let noise = (goal.target_percent / 100.0).powi(2);
    let spend = |share: f64| {
        let chosen = spent(sizes, &parts, pilot, share * whole);
        let square: f64 = parts.iter().zip(&chosen).map(|(p, &f)| p.at(pilot, f)).sum();
        ((square + noise).sqrt(), chosen)
    };
    let (mut shown, mut chosen) = spend(1.0);
    let mut share = 1.0;
    while share > LEAST_BUDGET {
        let (with_half, fewer) = spend(0.5 * share);
        let enough = match goal.target_shown_percent {
            Some(target) => with_half <= target / 100.0,
            None => with_half * (1.0 - LEAST_GAIN) < shown,
        };
        if !enough {
            break;
        }
        (shown, chosen, share) = (with_half, fewer, 0.5 * share);
    }
    (chosen, share)
}

fn parts(falls: &[GridFall]) -> Vec<Part> {
    let mut all = GridFall::default();
    for f in falls {
        all.own.append(&f.own);
        all.fine.append(&f.fine);
        all.coarse.append(&f.coarse);
    }
    let part = |f: &GridFall| {
        let fine = drawn(f.share, &f.fine, &all.fine);
        let coarse = drawn(f.share, &f.coarse, &all.coarse);
        let power = libm::log2(coarse / fine).clamp(*POWERS.start(), *POWERS.end());
        let square = fine / (libm::exp2(power) - 1.0);
        let finer = (drawn(f.share, &f.own, &all.own) - square).max(0.0);
        Part { square: f.share * square, power, finer: f.share * finer }
    };
    falls.iter().map(part).collect()
}

/// Mean square over a chart of `share` of all weight, drawn to that over `all` as far as its own scatter leaves it unsure;
/// above 0.
fn drawn(share: f64, found: &Moments, all: &Moments) -> f64 {
    let mean = all.mean().max(1e-12);
    // A point of this chart counts for so much of its mean.
    let points = (all.count() * share).max(1e-300);
    let own = found.count() * found.mean() / points;
    let scatter = (found.squares() + SCATTER_DRAWN * all.squares() / all.count().max(1.0)) / (points * points);
    // Charts differ by orders of magnitude.
    let spread = mean.max(own).powi(2);
    let sure = spread / (spread + scatter);
    (sure * own + (1.0 - sure) * mean).max(1e-3 * mean)
}

/// A density for each chart, for the least square error at about `budget` texels.
fn spent(sizes: &[ChartSize], parts: &[Part], pilot: f64, budget: f64) -> Vec<f64> {
    let factors: Vec<f64> = LADDER.map(|k| libm::exp2(f64::from(k) / 4.0)).collect();
    let choose = |price: f64| -> Vec<f64> {
        let best = |(size, part): (&ChartSize, &Part)| {
            let value = |f: f64| part.at(pilot, f) + price * size.at(f);
            let fitting = factors.iter().copied().filter(|&f| f <= size.most);
            fitting.min_by(|a, b| value(*a).total_cmp(&value(*b))).unwrap_or(factors[0])
        };
        sizes.iter().zip(parts).map(best).collect()
    };
    let cost = |chosen: &[f64]| sizes.iter().zip(chosen).map(|(s, &f)| s.at(f)).sum::<f64>();
    // Powers of two of the price of a texel.
    let (mut cheap, mut dear) = (-80.0, 20.0);
    for _ in 0..40 {
        let middle = 0.5 * (cheap + dear);
        if cost(&choose(libm::exp2(middle))) > budget { cheap = middle } else { dear = middle }
    }
    choose(libm::exp2(dear))
}
