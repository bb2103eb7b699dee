//! Which charts need how many texels.
//!
//! In: how the error of filtering grew in each chart when its texels were made twice and four times as wide. Out: a
//! density for each, so that the error over all is least for the texels that a page holds (a texel more then gains the
//! same in all charts), or fewer where more make little difference. The founding rule: texels where discretisation is
//! the larger part of the error.

use super::interval::Moments;
use crate::atlas::ChartSize;
use crate::bisect::bisected;

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

/// Densities relative to the even one: these powers of 2 to the power of 1 over so many.
const STEPS: f64 = 4.0;
const LADDER: std::ops::RangeInclusive<i32> = -12..=16;

/// Where twice the texels lower what is shown by less than this share, half of them do.
const LEAST_GAIN: f64 = 0.1;

/// Part of a target that is aimed at: what is foretold is not quite so.
const AIM: f64 = 0.9;

/// No budget below this part of the texels that fit is looked at.
const LEAST_BUDGET: f64 = 1.0 / 256.0;

/// Squared error falls with the width of texels by a power between that at an edge and that of smooth light.
const POWERS: std::ops::RangeInclusive<f64> = 1.0..=4.0;

/// ... and that of what is finer than the texels by this, once they are fine enough.
const FINER_POWER: f64 = 2.0;

/// Points like the mean of all that a chart is taken to have scattered by besides its own.
const SCATTER_DRAWN: f64 = 2.0;

/// A chart's part of the squared error, with texels of the pilot, and how it falls with their width.
#[derive(Debug, Clone, Copy)]
struct Part {
    square: f64,
    power: f64,
    /// What is left of it: of what is finer than the texels.
    finer: f64,
}

impl Part {
    /// With texels of `pilot / factor` times the width.
    fn at(&self, pilot: f64, factor: f64) -> f64 {
        let width = pilot / factor;
        self.square * libm::pow(width, self.power) + self.finer * libm::pow(width, FINER_POWER)
    }
}

/// The density of each chart relative to the even one, and the share of the texels that fit which these are. `falls` are
/// from texels of the densities `pilot`, relative to the same.
pub fn chart_densities(sizes: &[ChartSize], falls: &[GridFall], pilot: &[f64], goal: DensityGoal) -> (Vec<f64>, f64) {
    let factors: Vec<f64> = LADDER.map(|k| libm::exp2(f64::from(k) / STEPS)).collect();
    let parts = parts(falls);
    let choice = |size: &ChartSize, part: &Part, pilot: f64| -> Vec<Choice> {
        let of = |&factor: &f64| Choice { factor, square: part.at(pilot, factor), texels: size.at(factor) };
        let fitting = factors.iter().take_while(|f| **f <= size.most).count().max(1);
        factors[..fitting].iter().map(of).collect()
    };
    let choices: Vec<Vec<Choice>> = sizes.iter().zip(&parts).zip(pilot).map(|((s, p), &d)| choice(s, p, d)).collect();
    let whole: f64 = sizes.iter().map(|s| s.at(1.0)).sum();
    let noise = (goal.target_percent / 100.0).powi(2);
    let spend = |share: f64| {
        let chosen = spent(&choices, share * whole);
        let square: f64 = chosen.iter().map(|c| c.square).sum();
        ((square + noise).sqrt(), chosen)
    };
    let step = if goal.target_shown_percent.is_some() { libm::exp2(-1.0 / STEPS) } else { 0.5 };
    let (mut shown, mut chosen) = spend(1.0);
    let mut share = 1.0;
    while share > LEAST_BUDGET {
        let (with_less, fewer) = spend(step * share);
        let enough = match goal.target_shown_percent {
            Some(target) => with_less <= AIM * target / 100.0,
            None => with_less * (1.0 - LEAST_GAIN) < shown,
        };
        if !enough {
            break;
        }
        (shown, chosen, share) = (with_less, fewer, step * share);
    }
    let texels: f64 = chosen.iter().map(|c| c.texels).sum();
    let share = if share < 1.0 { (texels / whole).min(1.0) } else { 1.0 };
    (chosen.iter().map(|c| c.factor).collect(), share)
}

/// A density that a chart may have.
#[derive(Debug, Clone, Copy)]
struct Choice {
    factor: f64,
    square: f64,
    texels: f64,
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
        let grown = fine / (libm::exp2(power) - 1.0);
        // The error itself is far noisier than how it grows; what is wider than the chart does not grow any more.
        let (own, scatter) = mean_square(f.share, &f.own, &all.own);
        let total = grown.clamp((own - scatter.sqrt()).max(0.0), (own + scatter.sqrt()).max(0.0));
        let square = grown.min(total);
        let finer = total - square;
        Part { square: f.share * square, power, finer: f.share * finer }
    };
    falls.iter().map(part).collect()
}

/// Mean square over a chart of `share` of all weight, and its squared standard error.
fn mean_square(share: f64, found: &Moments, all: &Moments) -> (f64, f64) {
    // A point of this chart counts for so much of its mean.
    let points = (all.count() * share).max(1e-300);
    let scatter = found.squares() + SCATTER_DRAWN * all.squares() / all.count().max(1.0);
    (found.count() * found.mean() / points, scatter / (points * points))
}

/// The same, drawn to that over `all` as far as its own scatter leaves it unsure; above 0.
fn drawn(share: f64, found: &Moments, all: &Moments) -> f64 {
    let mean = all.mean().max(1e-12);
    let (own, scatter) = mean_square(share, found, all);
    // Charts differ by orders of magnitude.
    let spread = mean.max(own).powi(2);
    let sure = spread / (spread + scatter);
    (sure * own + (1.0 - sure) * mean).max(1e-3 * mean)
}

/// A choice for each chart, for the least square error at about `budget` texels.
fn spent(choices: &[Vec<Choice>], budget: f64) -> Vec<Choice> {
    let choose = |price: f64| -> Vec<Choice> {
        let value = |c: &Choice| c.square + price * c.texels;
        let best = |of: &Vec<Choice>| *of.iter().min_by(|a, b| value(a).total_cmp(&value(b))).unwrap_or(&of[0]);
        choices.iter().map(best).collect()
    };
    // Powers of two of the price of a texel.
    let texels = |price: f64| choose(libm::exp2(price)).iter().map(|c| c.texels).sum::<f64>();
    let (_, dear) = bisected(-80.0, 20.0, 40, |price| texels(price) > budget);
    choose(libm::exp2(dear))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: ChartSize = ChartSize { texels: [10000.0, 0.0, 0.0], most: f64::INFINITY };

    /// A chart of half of the surface whose error without noise is `square` and falls as an edge's does.
    fn edge(square: f64) -> GridFall {
        let mut fall = GridFall { share: 0.5, ..GridFall::default() };
        for _ in 0..1000 {
            fall.own.add(square);
            fall.fine.add(square);
            fall.coarse.add(2.0 * square);
        }
        fall
    }

    fn goal(target_shown_percent: Option<f64>) -> DensityGoal {
        DensityGoal { target_percent: 1.0, target_shown_percent }
    }

    /// The least of sum of s / f where f^2 sums to a constant is where f goes as the cube root of s.
    #[test]
    fn edges_get_texels_by_the_cube_root_of_their_error() {
        let (factors, share) = chart_densities(&[SIZE, SIZE], &[edge(0.1), edge(0.1 / 64.0)], &[0.5; 2], goal(None));
        assert_eq!(share, 1.0);
        assert!(((factors[0] / factors[1]).log2() - 2.0).abs() <= 1.0 / STEPS, "{factors:?}");
        let texels: f64 = factors.iter().map(|f| SIZE.at(*f)).sum();
        // Densities come in steps.
        assert!(texels <= 20000.0 && texels > 0.7 * 20000.0, "{texels}");
    }

    #[test]
    fn texels_that_make_no_difference_are_left_out() {
        let (_, share) = chart_densities(&[SIZE, SIZE], &[edge(1e-8), edge(1e-9)], &[0.5; 2], goal(None));
        assert_eq!(share, 1.0 / 64.0, "the lowest density squared");
    }

    #[test]
    fn a_target_is_met_with_no_more_texels_than_needed() {
        let falls = [edge(0.01), edge(0.001)];
        let (factors, share) = chart_densities(&[SIZE, SIZE], &falls, &[0.5; 2], goal(Some(6.0)));
        let shown = |factors: &[f64]| {
            let square: f64 = falls.iter().zip(factors).map(|(f, x)| f.share * f.own.mean() * 0.5 / x).sum();
            100.0 * (square + 1e-4).sqrt()
        };
        assert!(share < 1.0 && shown(&factors) <= AIM * 6.0, "{share} {}", shown(&factors));
        let fewer: Vec<f64> = factors.iter().map(|f| f * libm::exp2(-1.0 / STEPS)).collect();
        assert!(shown(&fewer) > AIM * 6.0);
        // None do: all that fit.
        assert_eq!(chart_densities(&[SIZE, SIZE], &falls, &[0.5; 2], goal(Some(1.1))).1, 1.0);
    }
}
