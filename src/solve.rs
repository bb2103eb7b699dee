//! Light until the error is under the target: rounds of direct samples and photons.
//!
//! In: texels, emitters, what rays meet. Out: [`Solution`], the irradiance of every texel in two halves with
//! its error. After each round the noise of the direct and of the indirect part is known from the halves, and
//! the next round is sized so that the target is met with the fewest rays. All decisions are made between
//! rounds from sums in fixed order; only a time limit can make two runs differ.

use crate::accuracy::{ErrorEstimate, Halves, Pools, TexelWeights, estimate_error, mesh_errors};
use crate::atlas::{NO_CHART, Texels};
use crate::error::BakeError;
use crate::light::{Direct, Emitters, Visibility};
use crate::observer::{Observer, Progress};
use crate::options::{BakeOptions, DoubleSided, Normals};
use crate::photon::{Bins, EnergyLedger, Flux, Shooting, StartTable};
use crate::report::{HistoryEntry, percentile_95};
use glam::Vec3;
use rayon::prelude::*;
use std::time::Instant;

/// Direct samples per texel and half of the first round.
const FIRST_SAMPLES: u32 = 2;

/// Direct samples between two looks at the clock and at what they found.
const MOST_SAMPLES_AT_ONCE: u64 = 1 << 24;

/// Photons of the first round per half: 2^(12..20), by the number of texels.
const FIRST_NET_BITS: std::ops::RangeInclusive<u32> = 12..=20;

/// Nets of one round are powers of two of at least this many photons.
const LEAST_NET_BITS: u32 = 12;

/// Largest net: rounds between two looks at the clock.
const LARGEST_NET_BITS: u32 = 21;

/// A round multiplies the work so far by at most this much: forecasts from little data are poor.
const MOST_GROWTH: f64 = 5.0;

/// Rounds aim this far below the target, since the estimate itself scatters.
const MARGIN: f64 = 0.98;

/// What rays meet and what shines: the inputs of the solution.
#[derive(Debug, Clone, Copy)]
pub struct LightPath<'a> {
    /// All texels.
    pub texels: &'a Texels,
    /// Open share of the area of each texel of the map.
    pub open: &'a [f32],
    /// Where texels too small to catch photons take their indirect light from.
    pub pools: &'a Pools,
    /// What shines.
    pub emitters: &'a Emitters,
    /// What rays meet.
    pub visibility: &'a Visibility<'a>,
}

/// Irradiance of all texels with its error.
#[derive(Debug)]
pub struct Solution {
    /// Irradiance (lux) of each texel of the map.
    pub total: Halves,
    /// Weights of the texels that are stored.
    pub weights: TexelWeights,
    /// Error of the whole.
    pub error: ErrorEstimate,
    /// Error of the direct part, relative to the whole mean.
    pub direct_error: ErrorEstimate,
    /// Error of the indirect part, relative to the whole mean.
    pub indirect_error: ErrorEstimate,
    /// Error that 95 % of the meshes are under.
    pub mesh_percent: f64,
    /// Variance that direct samples, and that photons would lower, of what binds.
    variances: (f64, f64),
    /// Which limit ended it before the targets were met.
    pub limit: Option<&'static str>,
    /// One entry per round.
    pub history: Vec<HistoryEntry>,
    /// Direct samples of all texels and both halves.
    pub direct_samples: u64,
    /// Shadow rays of direct light.
    pub direct_rays: u64,
    /// Where the photons' flux went.
    pub ledger: EnergyLedger,
    /// Flux over the three channels that met the backs of each instance's one-sided surfaces.
    pub back_flux: Vec<i64>,
    /// Flux of one integer step [lux x frame units squared].
    pub unit: f64,
    /// Seconds of direct light, photons, estimates.
    pub seconds: [f64; 3],
}

/// Work under way.
struct Solver<'a, 'o> {
    path: LightPath<'a>,
    options: &'a BakeOptions,
    observer: &'o mut dyn Observer,
    began: Instant,
    weights: TexelWeights,
    direct: Direct,
    bins: Bins<'a>,
    flux: Option<Flux>,
    /// Start flux of one half, as the last round found it [lux x frame units squared].
    start_total: f64,
    /// Photons per half, and nets per half so far.
    photons: u64,
    nets: u64,
    ledger: EnergyLedger,
    seconds: [f64; 3],
    history: Vec<HistoryEntry>,
    last: Option<(f64, f64)>,
}

/// Solves until the targets of `options` are met or a limit binds. `began` is when the bake began.
///
/// # Errors
/// [`BakeError::Cancelled`] when the observer says so.
pub fn solve(
    path: LightPath,
    weights: TexelWeights,
    options: &BakeOptions,
    began: Instant,
    observer: &mut dyn Observer,
) -> Result<Solution, BakeError> {
    let mut solver = Solver {
        path,
        options,
        observer,
        began,
        weights,
        direct: Direct::new(path.texels.texels.len()),
        bins: Bins::new(path.visibility.world, path.texels),
        flux: None,
        start_total: 0.0,
        photons: 0,
        nets: 0,
        ledger: EnergyLedger::default(),
        seconds: [0.0; 3],
        history: Vec::new(),
        last: None,
    };
    solver.run()
}

/// Work for the next round: direct samples of all texels and both halves (the first round takes the same number
/// everywhere), photons per half.
#[derive(Debug, Clone, Copy)]
struct Round {
    samples: u64,
    photons: u64,
}

impl Solver<'_, '_> {
    fn run(&mut self) -> Result<Solution, BakeError> {
        let bits = (self.path.texels.texels.len().max(1).ilog2()).clamp(*FIRST_NET_BITS.start(), *FIRST_NET_BITS.end());
        let mut round = Round { samples: 1, photons: 1 << bits };
        loop {
            let stopped = self.trace(round)?;
            let started = Instant::now();
            let mut solution = self.solution();
            self.seconds[2] += started.elapsed().as_secs_f64();
            let needed = self.reduction_needed(&solution);
            let next = self.plan(&solution, needed);
            let rays = self.rays();
            let cost =
                |r: &Round| self.cost_per_sample() * r.samples as f64 + self.cost_per_photon() * r.photons as f64;
            let forecast_rays = rays as f64 + self.unbounded_plan(&solution, needed).map_or(0.0, |r| cost(&r));
            self.history.push(HistoryEntry {
                direct_samples: self.direct.samples(),
                photons: self.photons * 2,
                rays,
                percent: solution.error.percent,
                high: solution.error.high,
                forecast_rays,
            });
            self.last = Some((solution.error.high, forecast_rays));
            self.report_progress()?;
            let done = needed <= 1.0;
            if done || stopped.is_some() || next.is_none() {
                solution.limit = if done { None } else { stopped.or(Some(self.exhausted())) };
                solution.history = std::mem::take(&mut self.history);
                solution.seconds = self.seconds;
                return Ok(solution);
            }
            round = next.expect("a round was planned");
        }
    }

    /// Traces one round; the name of the limit that ended it early.
    fn trace(&mut self, round: Round) -> Result<Option<&'static str>, BakeError> {
        let smooth = self.options.normals == Normals::Smooth;
        let LightPath { texels, emitters, visibility, .. } = self.path;
        let mut left = round.samples;
        while left > 0 {
            let started = Instant::now();
            let budget = left.min(MOST_SAMPLES_AT_ONCE);
            if self.direct.samples() == 0 {
                self.direct.extend_all(FIRST_SAMPLES, self.options.seed, smooth, texels, (emitters, visibility));
                left = 0;
            } else {
                let more = self.direct.allocate(budget, texels);
                let counts = |half: usize, texel: usize| more[half][texel];
                self.direct.extend(&counts, self.options.seed, smooth, texels, (emitters, visibility));
                left -= budget;
            }
            self.seconds[0] += started.elapsed().as_secs_f64();
            self.report_progress()?;
            if left > 0 && self.out_of_time() {
                return Ok(Some("time-limit"));
            }
        }
        let started = Instant::now();
        let starts = [0, 1].map(|h| StartTable::new(self.path.texels, &self.direct, h));
        let total = starts[0].total().max(starts[1].total());
        if total <= 0.0 {
            return Ok(None);
        }
        self.start_total = total;
        if self.flux.is_some_and(|f| !f.holds(total)) {
            // The first direct samples missed nearly all of the light: so did the photons they started.
            self.flux = None;
            self.bins = Bins::new(visibility.world, texels);
            self.ledger = EnergyLedger::default();
            self.photons = 0;
        }
        let flux = *self.flux.get_or_insert_with(|| Flux::for_total(total));
        let shooting = Shooting {
            seed: self.options.seed,
            flux,
            starts,
            direct: &self.direct,
            texels: self.path.texels,
            visibility: self.path.visibility,
        };
        let mut left = round.photons;
        let mut limit = None;
        while left > 0 {
            // The smallest net is shot whatever the limit: without any, indirect light would be black.
            let most = self.options.max_photons.map_or(u64::MAX, |m| (m / 2).max(1 << LEAST_NET_BITS));
            let allowed = most.saturating_sub(self.photons);
            if allowed < 1 << LEAST_NET_BITS {
                limit = Some("max-photons");
                break;
            }
            let bits = left.min(allowed).ilog2().clamp(LEAST_NET_BITS, LARGEST_NET_BITS);
            for half in 0..2 {
                // A half whose direct samples found no light sends out nothing, but its photons count.
                if shooting.starts[half].total() > 0.0 {
                    self.ledger += &shooting.net(half, self.nets, bits, &self.bins);
                }
            }
            self.nets += 1;
            self.photons += 1 << bits;
            left = left.saturating_sub(1 << bits);
            let elapsed = self.began.elapsed().as_secs_f64();
            if left > 0 && self.options.time_limit.is_some_and(|t| elapsed > t) {
                limit = Some("time-limit");
                break;
            }
            let progress = progress(
                self.began,
                self.options,
                self.direct.rays() + self.ledger.rays,
                self.last,
                self.seconds[0] + self.seconds[1] + started.elapsed().as_secs_f64(),
            );
            self.observer.progress(&progress);
            if self.observer.cancelled() {
                return Err(BakeError::Cancelled);
            }
        }
        self.seconds[1] += started.elapsed().as_secs_f64();
        if limit.is_none() && self.out_of_time() {
            limit = Some("time-limit");
        }
        Ok(limit)
    }

    fn out_of_time(&self) -> bool {
        self.options.time_limit.is_some_and(|t| self.began.elapsed().as_secs_f64() > t)
    }

    fn rays(&self) -> u64 {
        self.direct.rays() + self.ledger.rays
    }

    fn report_progress(&mut self) -> Result<(), BakeError> {
        let p = progress(self.began, self.options, self.rays(), self.last, self.seconds[0] + self.seconds[1]);
        self.observer.progress(&p);
        if self.observer.cancelled() { Err(BakeError::Cancelled) } else { Ok(()) }
    }

    /// Rays per direct sample, and per photon of each half.
    fn cost_per_sample(&self) -> f64 {
        self.direct.rays().max(1) as f64 / self.direct.samples().max(1) as f64
    }

    fn cost_per_photon(&self) -> f64 {
        self.ledger.rays.max(1) as f64 / self.photons.max(1) as f64
    }

    /// Factor by which the variance must fall, >= 1 while a target is unmet.
    fn reduction_needed(&self, s: &Solution) -> f64 {
        let target = self.options.target_percent;
        let mesh = self.options.mesh_target();
        (s.error.high / target).max(s.mesh_percent / mesh).powi(2)
    }

    /// The least work that brings the variance down to 1 / `needed`, taking both parts to fall as 1 / n:
    /// minimise R_d x + R_i y subject to A / x + B / y = (A + B) / needed.
    fn unbounded_plan(&self, s: &Solution, needed: f64) -> Option<Round> {
        if needed <= 1.0 {
            return None;
        }
        let (a, b) = s.variances;
        let goal = (a + b) / needed * MARGIN * MARGIN;
        let (ra, rb) = (self.direct.rays().max(1) as f64, self.ledger.rays.max(1) as f64);
        let share = (a * ra).sqrt() + (b * rb).sqrt();
        let (mut x, mut y) = ((a / ra).sqrt() * share / goal, (b / rb).sqrt() * share / goal);
        if x < 1.0 {
            (x, y) = (1.0, b / (goal - a).max(1e-300));
        } else if y < 1.0 {
            (x, y) = (a / (goal - b).max(1e-300), 1.0);
        }
        let samples = self.direct.samples() as f64 * (x - 1.0).max(0.0);
        let photons = self.photons as f64 * (y - 1.0).max(0.0);
        Some(Round { samples: samples.ceil().min(1e18) as u64, photons: photons.ceil().min(1e18) as u64 })
    }

    /// The next round, bounded in growth; `None` where no more work can help.
    fn plan(&self, s: &Solution, needed: f64) -> Option<Round> {
        let wish = self.unbounded_plan(s, needed)?;
        let most_samples = (self.direct.samples() as f64 * (MOST_GROWTH - 1.0)) as u64;
        let samples = wish.samples.min(most_samples);
        let most_photons = (self.photons as f64 * (MOST_GROWTH - 1.0)) as u64;
        let photons = wish.photons.min(most_photons).next_multiple_of(1 << LEAST_NET_BITS);
        (samples > 0 || photons > 0 && self.flux.is_some()).then_some(Round { samples, photons })
    }

    fn exhausted(&self) -> &'static str {
        if self.options.max_photons.is_some() { "max-photons" } else { "samples" }
    }

    /// Irradiance and errors as they stand.
    fn solution(&mut self) -> Solution {
        let (direct, indirect) = (self.direct_halves(), self.indirect_halves());
        let add = |a: &[Vec3], b: &[Vec3]| a.par_iter().zip(b).map(|(a, b)| *a + *b).collect::<Vec<_>>();
        let total = Halves { odd: add(&direct.odd, &indirect.odd), even: add(&direct.even, &indirect.even) };
        let weights = self.stored_weights(&total);
        let error = estimate_error(&total, &total, &weights);
        let direct_error = estimate_error(&direct, &total, &weights);
        let indirect_error = estimate_error(&indirect, &total, &weights);
        let world = self.path.visibility.world;
        let (target, mesh_target) = (self.options.target_percent, self.options.mesh_target());
        let (meshes, _) = mesh_errors(world, &total, &weights, error.mean, target);
        let mesh_percent = percentile_95(&meshes);
        let split = self.variances(&direct, &indirect, &weights);
        let variances = if mesh_percent / mesh_target > error.high / target {
            // The meshes bind. Each that misses its target counts alike, however far it is from it: the worst
            // twentieth may miss it.
            let missed = meshes.iter().filter(|m| m.error_percent > mesh_target).map(|m| split[m.instance]);
            let share = missed.map(|(a, b)| (a / (a + b).max(1e-300), b / (a + b).max(1e-300)));
            share.fold((0.0, 0.0), |sum, s| (sum.0 + s.0, sum.1 + s.1))
        } else {
            split.iter().fold((0.0, 0.0), |sum, s| (sum.0 + s.0, sum.1 + s.1))
        };
        Solution {
            total,
            weights,
            error,
            direct_error,
            indirect_error,
            mesh_percent,
            variances,
            limit: None,
            history: Vec::new(),
            direct_samples: self.direct.samples(),
            direct_rays: self.direct.rays(),
            ledger: self.ledger,
            back_flux: self.bins.back_flux(),
            unit: self.flux.map_or(0.0, |f| f.unit),
            seconds: self.seconds,
        }
    }

    /// Variance that more direct samples would lower, and that more photons would, of each instance.
    ///
    /// Photons of equal weight w are counted with the variance of a Poisson process, w E / area each; what the
    /// indirect light scatters beyond that comes from the direct samples that photons start from.
    fn variances(&self, direct: &Halves, indirect: &Halves, weights: &TexelWeights) -> Vec<(f64, f64)> {
        let LightPath { texels, open, visibility, .. } = self.path;
        let photon_weight = self.start_total / self.photons.max(1) as f64;
        let mut sums = vec![[0f64; 3]; visibility.world.scene.instances.len()];
        for i in (0..weights.weight.len()).filter(|&i| weights.weight[i] > 0.0) {
            let (w, sum) = (weights.weight[i], &mut sums[weights.instance[i] as usize]);
            sum[0] += w * f64::from(direct.difference(i).length_squared()) / 3.0;
            sum[1] += w * f64::from(indirect.difference(i).length_squared()) / 3.0;
            let e = f64::from(indirect.mean(i).element_sum()) / 3.0;
            sum[2] += w * 0.5 * photon_weight * e / f64::from(texels.texels[i].area * open[i]);
        }
        let split = |[direct, indirect, counted]: [f64; 3]| {
            let photons = indirect.min(counted);
            (direct + indirect - photons, photons)
        };
        sums.into_iter().map(split).collect()
    }

    fn direct_halves(&self) -> Halves {
        let (direct, open) = (&self.direct, self.path.open);
        let half = |h| (0..open.len()).into_par_iter().map(|i| direct.stored(h, i) * per_open(open[i])).collect();
        Halves { odd: half(0), even: half(1) }
    }

    fn indirect_halves(&self) -> Halves {
        let LightPath { texels, open, pools, .. } = self.path;
        let Some(flux) = self.flux.filter(|_| self.photons > 0) else {
            return Halves { odd: vec![Vec3::ZERO; open.len()], even: vec![Vec3::ZERO; open.len()] };
        };
        let (bins, per_photon) = (&self.bins, flux.unit / self.photons as f64);
        let value = |h: usize, i: usize| {
            let per_area = per_photon / f64::from(texels.texels[i].area) * f64::from(per_open(open[i]));
            Vec3::from_array(bins.flux(h, i).map(|f| (f as f64 * per_area) as f32))
        };
        let half = |h| {
            let mut values: Vec<Vec3> = (0..open.len()).into_par_iter().map(|i| value(h, i)).collect();
            pools.apply(&mut values, |i| texels.texels[i].area * open[i]);
            values
        };
        Halves { odd: half(0), even: half(1) }
    }

    /// Weights with the sides that are not stored set to 0.
    fn stored_weights(&self, total: &Halves) -> TexelWeights {
        let texels = &self.path.texels.texels[..self.path.texels.mapped];
        let mut weights = self.weights.clone();
        match self.options.double_sided {
            DoubleSided::Split => {}
            DoubleSided::Front => {
                (0..texels.len()).filter(|&i| texels[i].back).for_each(|i| weights.drop(i));
            }
            DoubleSided::Auto => {
                let charts =
                    texels.iter().filter(|t| t.chart != NO_CHART).map(|t| t.chart as usize + 1).max().unwrap_or(0);
                let mut received = vec![[0f64; 2]; charts];
                for (i, t) in texels.iter().enumerate() {
                    received[t.chart as usize][usize::from(t.back)] +=
                        f64::from(t.area) * f64::from(total.mean(i).element_sum());
                }
                for (i, t) in texels.iter().enumerate() {
                    let [front, back] = received[t.chart as usize];
                    if t.back != (back > front) {
                        weights.drop(i);
                    }
                }
            }
        }
        weights
    }
}

/// Factor from flux over the whole area to flux over the open area; 0 where nothing is open.
fn per_open(open: f32) -> f32 {
    if open > 0.0 { 1.0 / open } else { 0.0 }
}

fn progress(began: Instant, options: &BakeOptions, rays: u64, last: Option<(f64, f64)>, tracing: f64) -> Progress {
    let rate = if tracing > 0.0 { rays as f64 / tracing } else { 0.0 };
    let remaining = last.filter(|_| rate > 0.0).map(|(_, forecast)| (forecast - rays as f64).max(0.0) / rate);
    Progress {
        percent: last.map_or(f64::INFINITY, |l| l.0),
        target: options.target_percent,
        rays,
        rays_per_second: rate,
        elapsed: began.elapsed().as_secs_f64(),
        remaining,
    }
}
