//! A look at the light before charts get their places: where texels are needed.
//!
//! In: charts. Out: a density for each. A bake with wide texels and a coarse target tells how much worse filtering
//! becomes in each chart with wider ones still.

use crate::accuracy::{DensityGoal, GridFall, TexelWeights, chart_densities};
use crate::atlas::{Atlas, Texels, Unwrapping, check_memory};
use crate::cache::Keeping;
use crate::error::BakeError;
use crate::light::{Emitters, Visibility};
use crate::lightmap::{GridPoints, Lightmap, coarser};
use crate::observer::Observer;
use crate::options::{Audits, BakeOptions, Density, MAX_PAGES, Smoothing};
use crate::solve::{Part, Surface, solve};
use std::time::Instant;

/// Texels are so many times as wide as those that the page would hold, first all the same, then as found so far: what is
/// finer than a texel is seen late (measured: an error between texels lower by 5 to 30 % for the same texels than by one
/// look at half the density).
const WIDTHS: [f64; 2] = [4.0, 2.0];

/// Texels between charts: some are left between them where texels are four times as wide.
const GUTTER: u32 = 12;

/// The target is so many times that of the bake, within these percent.
const TARGET: f64 = 5.0;
const TARGETS: std::ops::RangeInclusive<f64> = 5.0..=30.0;

/// Part of a time limit that each look may take, and from which on there is none.
const TIME_SHARE: f64 = 0.04;
const TOO_LATE: f64 = 0.4;

/// Part of a page that gutters may fill: beyond, there is little to share out.
const MOST_GUTTERS: f64 = 0.5;

/// Points that are looked at: so many for each texel, but no more than these in all.
const POINTS_PER_TEXEL: usize = 8;
const MOST_POINTS: usize = 1 << 17;

/// What a pilot says.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Pilot {
    /// What the charts are to be laid out with.
    pub density: Density,
    /// Share of the texels that fit a page which is enough.
    pub share: f64,
    /// An earlier bake looked.
    #[serde(skip)]
    pub from_cache: bool,
}

const NOTHING: Pilot = Pilot { density: Density::Even, share: 1.0, from_cache: false };

/// Sets the densities of the charts of `unwrapping`; all remain the same where nothing can be told. What `keeping` has of
/// an earlier look is taken as it is: texels stay where they were, so that light that is kept fits them.
///
/// # Errors
/// [`BakeError::Cancelled`].
pub fn adapt_density(
    unwrapping: &mut Unwrapping,
    visibility: &Visibility,
    emitters: &Emitters,
    options: &BakeOptions,
    began: Instant,
    mut keeping: Option<&mut Keeping>,
    observer: &mut dyn Observer,
) -> Result<Pilot, BakeError> {
    let started = Instant::now();
    let world = visibility.world;
    let even = unwrapping.even_density(options);
    let sizes = unwrapping.sizes(even, options);
    // A look that a time limit cut short is for bakes with such a limit alone.
    let kinds: &[bool] = if options.time_limit.is_some() { &[false, true] } else { &[false] };
    for hurried in kinds {
        let kept = keeping.as_mut().and_then(|keeping| keeping.slot("density", &(hurried, &sizes)).load());
        let Some((pilot, factors)): Option<(Pilot, Vec<f64>)> = kept else { continue };
        if unwrapping.set_densities(&factors) {
            return Ok(Pilot { from_cache: true, ..pilot });
        }
    }
    let gutters: f64 = sizes.iter().map(|s| s.texels[2]).sum();
    if gutters > MOST_GUTTERS * f64::from(options.max_texture).powi(2) {
        return Ok(NOTHING);
    }
    let coarse = BakeOptions {
        target_percent: (TARGET * options.target_percent).clamp(*TARGETS.start(), *TARGETS.end()),
        target_mesh_percent: Some(f64::MAX),
        time_limit: options.time_limit.map(|s| TIME_SHARE * s),
        gutter: GUTTER.min(options.max_texture / 4),
        max_pages: MAX_PAGES,
        audit: Audits::Off,
        // Where direct light is smoothed, edges of shadows are not seen. That of a sky alone is too noisy else.
        smoothing: match options.smoothing {
            Smoothing::Cells if emitters.sky().is_none() => Smoothing::Indirect,
            smoothing => smoothing,
        },
        ..options.clone()
    };
    let BakeOptions { target_percent, target_shown_percent, .. } = *options;
    let goal = DensityGoal { target_percent, target_shown_percent };
    let mut factors = vec![1.0; sizes.len()];
    let mut found = NOTHING;
    for width in WIDTHS {
        if options.time_limit.is_some_and(|limit| began.elapsed().as_secs_f64() > TOO_LATE * limit) {
            break;
        }
        let coarse = BakeOptions { density: Density::TexelsPerMetre(even / width), ..coarse.clone() };
        let atlas = match unwrapping.lay_out(&coarse, &|| observer.cancelled()) {
            Ok(atlas) => atlas,
            Err(BakeError::Cancelled) => return Err(BakeError::Cancelled),
            Err(_) => break,
        };
        if check_memory(world, &atlas, options).is_err() {
            break;
        }
        let places = unwrapping.places(&atlas);
        let Some(falls) = falls(&atlas, &places, visibility, emitters, &coarse, observer)? else { break };
        let pilot: Vec<f64> = factors.iter().map(|f| f / width).collect();
        let (chosen, share) = chart_densities(&sizes, &falls, &pilot, goal);
        unwrapping.set_densities(&chosen);
        factors = chosen;
        let density = if share == 1.0 { Density::Even } else { Density::TexelsPerMetre(even) };
        found = Pilot { density, share, from_cache: false };
    }
    if let Some(keeping) = keeping {
        let hurried = options.time_limit.is_some_and(|limit| {
            began.elapsed().as_secs_f64() > TOO_LATE * limit || started.elapsed().as_secs_f64() > TIME_SHARE * limit
        });
        keeping.slot("density", &(hurried, &sizes)).keep(&(found, &factors));
    }
    Ok(found)
}

/// How filtering errs more with wider texels, by the place of the chart; `places` are those of the charts of `atlas`. `None`
/// where there is no light.
fn falls(
    atlas: &Atlas,
    places: &[usize],
    visibility: &Visibility,
    emitters: &Emitters,
    options: &BakeOptions,
    observer: &mut dyn Observer,
) -> Result<Option<Vec<GridFall>>, BakeError> {
    let world = visibility.world;
    let surface = Surface::new(Texels::new(world, atlas), atlas, visibility, options);
    let path = surface.path(emitters, visibility);
    let weights = TexelWeights::of_values(world, &surface.texels, &surface.open, options.texel_value);
    let part = Part { path, weights, options, began: Instant::now(), slot: None };
    let solution = solve(part, &mut Muted(observer))?;
    if solution.error.mean <= 0.0 {
        return Ok(None);
    }
    let pages = Lightmap::new(world, atlas, &surface.texels, &surface.shown, &solution, options).pages;
    let twice: Vec<_> = pages.iter().map(coarser).collect();
    let four_times: Vec<_> = twice.iter().map(coarser).collect();
    let points = GridPoints::new(&path, &solution, options);
    let count = (POINTS_PER_TEXEL * surface.texels.mapped).min(MOST_POINTS);
    let mut falls = vec![GridFall::default(); places.iter().max().map_or(0, |p| p + 1)];
    let weight = points.weights();
    let all: f64 = weight.iter().sum();
    let place = |texel: usize| places[surface.texels.texels[texel].chart as usize];
    weight.iter().enumerate().for_each(|(i, w)| falls[place(i)].share += w / all);
    for d in points.deviations(&[(&pages, 1), (&twice, 2), (&four_times, 4)], count, 0..1) {
        let [one, two, four] = d.squares.map(|s| s / solution.error.mean.powi(2));
        let chart = &mut falls[place(d.texel)];
        chart.own.add(one);
        chart.fine.add(two - one);
        chart.coarse.add(four - two);
    }
    Ok(Some(falls))
}

/// Passes on whether to stop, and nothing else: what a pilot finds is not the bake's.
struct Muted<'a>(&'a mut dyn Observer);

impl Observer for Muted<'_> {
    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }
}
