//! Light until the error is under the target: rounds of direct samples and photons, and gathering where both are
//! too slow.
//!
//! In: texels, emitters, what rays meet. Out: [`Solution`], the irradiance of every texel in two halves with
//! its error. After each round the error of the direct and of the indirect part is known from the halves, and
//! the next round is sized so that the target is met at the least cost. Where it is met, an audit is asked: what that
//! finds beyond the halves is part of the error from then on. All decisions are made between
//! rounds from sums in fixed order; only a time limit can make two runs differ.

mod audit;
mod estimate;
mod forecast;
mod gathered;
mod groups;
mod keep;
mod light;
mod shards;
mod shots;
mod surface;
mod wish;

pub use forecast::LightSeconds;
pub use groups::{GroupSolution, Parts, solve_groups};
pub use shards::{PlanOutlook, Shard, ShardWork, Shards, merge_groups, plan_groups, shard_groups};
pub use surface::Surface;

use forecast::{Falls, Outlook};
use shards::Planned;
use shots::Shots;
use wish::MOST_REDUCTION;

use crate::accuracy::{Audit, Caustics, Halves, MeshError, Missed, TexelError, TexelWeights, Unseen};
use crate::cache::Slot;
use crate::cell::{Bias, Gathered};
use crate::error::BakeError;
use crate::light::{Direct, Emitters, Growth, TexelLight, Visibility};
use crate::observer::{Observer, Stage};
use crate::options::{BakeOptions, Normals};
use crate::photon::{Bins, EnergyLedger, PhotonKind};
use crate::report::{HistoryEntry, RoundSeconds};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::time::Instant;

/// Direct samples per texel and half of the first round.
const FIRST_SAMPLES: u32 = 2;

/// Direct samples between two looks at the clock and at what they found, at most; or as many for each texel, since a
/// look goes over all texels.
const MOST_SAMPLES_AT_ONCE: u64 = 1 << 20;
const MOST_PER_TEXEL_AT_ONCE: u64 = 4;

/// Photons of the first round per half: 2^(12..16), by the number of texels.
const FIRST_NET_BITS: std::ops::RangeInclusive<u32> = 12..=16;

/// Nets of one round are powers of two of at least this many photons.
const LEAST_NET_BITS: u32 = 12;

/// What rays meet and what shines: the inputs of the solution.
#[derive(Debug, Clone, Copy)]
pub struct LightPath<'a> {
    /// What light falls on.
    pub surface: &'a Surface,
    /// What shines.
    pub emitters: &'a Emitters,
    /// What rays meet.
    pub visibility: &'a Visibility<'a>,
}

impl<'a> LightPath<'a> {
    /// What direct light is sampled with.
    pub fn light(&self, smooth: bool) -> TexelLight<'a> {
        let LightPath { surface: Surface { texels, open, .. }, emitters, visibility } = *self;
        TexelLight { texels, open, emitters, visibility, smooth }
    }
}

/// Squared errors by what lowers them.
#[derive(Debug, Clone, Copy, Default)]
struct Squares {
    /// Of direct light, texel by texel: direct samples.
    apart: f64,
    /// Of direct light that is smoothed over cells: direct samples, but more slowly.
    soft: f64,
    /// Of indirect light: photons, or gathering.
    indirect: f64,
    /// Of light from lamps over mirrors and through glass: photons.
    caustic: f64,
}

impl std::ops::Add for Squares {
    type Output = Squares;

    fn add(self, o: Squares) -> Squares {
        Squares {
            apart: self.apart + o.apart,
            soft: self.soft + o.soft,
            indirect: self.indirect + o.indirect,
            caustic: self.caustic + o.caustic,
        }
    }
}

/// Irradiance of all texels with its error.
#[derive(Debug)]
pub struct Solution {
    /// Irradiance (lux) of each texel of the map.
    pub total: Halves,
    /// The same before smoothing: without its bias, and noisier.
    pub unsmoothed: Halves,
    /// Of it reflected light.
    pub indirect: Halves,
    /// Of that what came straight from lamps over mirrors and through glass; `None` where nothing did.
    pub caustics: Option<Caustics>,
    /// Weights of the texels that are stored.
    pub weights: TexelWeights,
    /// Error of the whole.
    pub error: TexelError,
    /// Error of each node with texels on the map.
    pub meshes: Vec<MeshError>,
    /// Their biases.
    biases: Vec<Bias>,
    /// Error that 95 % of the meshes are under.
    pub mesh_percent: f64,
    /// Share of the area whose error is within the target.
    pub area_within_target: f64,
    /// Cells of each half.
    pub cells: [usize; 2],
    /// Flux of all light that is smoothed, sum of both halves and the channels, as it was caught and as the cells' planes
    /// have it [lux x frame units squared].
    pub smoothed: [f64; 2],
    /// Squared errors by what lowers them.
    squares: Squares,
    /// Squared error of the indirect light that is not gathered.
    by_photons: f64,
    /// Meshes above their target.
    missed: Vec<Missed>,
    /// Light of each group, where lights are solved in groups: this is their sum.
    pub groups: Vec<GroupSolution>,
    /// Which limit ended it before the targets were met.
    pub limit: Option<&'static str>,
    /// What path tracing says of it, or why it was not asked.
    pub audit: Result<Audit, &'static str>,
    /// Cell of the odd half that each texel of the map is in, or [`NO_CELL`](crate::cell::NO_CELL): buried, or
    /// gathered. Empty where nothing is smoothed.
    pub cell_of: Vec<u32>,
    /// One entry per round.
    pub history: Vec<HistoryEntry>,
    /// When each of them ended.
    pub rounds: Vec<RoundSeconds>,
    /// Direct samples of all texels and both halves.
    pub direct_samples: u64,
    /// Shadow rays of direct light.
    pub direct_rays: u64,
    /// Photons of both halves.
    pub photons: u64,
    /// Photons for caustics alone, of both halves.
    pub caustic_photons: u64,
    /// Rays of these.
    pub caustic_rays: u64,
    /// Rays that gathered indirect light.
    pub gather_rays: u64,
    /// Meshes whose indirect light was gathered.
    pub gathered_meshes: usize,
    /// Of all rays those of earlier bakes, whose work was kept.
    pub kept_rays: u64,
    /// Where the photons' flux went.
    pub ledger: EnergyLedger,
    /// Reflected flux, sum of the channels [lux x frame units squared], ...
    pub reflected: f64,
    /// ... and what of it met the back of each triangle of one-sided surface.
    pub back_flux: Vec<f64>,
    /// Flux of one integer step [lux x frame units squared].
    pub unit: f64,
    /// How long it took.
    pub seconds: LightSeconds,
}

/// Light that is solved by itself: all of it, or that of a group.
#[derive(Debug)]
pub struct Part<'a, 'o> {
    /// What it is.
    pub path: LightPath<'a>,
    /// Weights of the texels of the map.
    pub weights: TexelWeights,
    /// Targets, limits and seed.
    pub options: &'a BakeOptions,
    /// When the bake began.
    pub began: Instant,
    /// Where its work is kept, if anywhere.
    pub slot: Option<Slot<'o>>,
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
    /// Photons that light carries on which was reflected diffusely.
    diffuse: Shots,
    /// Photons that bring what lamps throw over mirrors and through glass.
    caustics: Shots,
    gathering: Gathering,
    /// Texels of each instance on the map, in order.
    texels_of: Vec<Vec<u32>>,
    course: Course,
    /// The course as it stood when the last round was traced, before anything was concluded from it.
    traced: Option<Course>,
    seconds: LightSeconds,
    last: Option<Outlook>,
    /// Where the work so far is kept, if anywhere.
    slot: Option<Slot<'o>>,
    /// What of it an earlier bake did.
    earlier: Earlier,
}

/// Indirect light that meshes gather.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Gathering {
    rays: u64,
    /// Gather rays and photons at which each instance gathered last.
    at: Vec<(u32, u64)>,
    /// Gathered light of both halves by texel.
    kept: HashMap<u32, [Gathered; 2]>,
}

/// What was decided from the light so far.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Course {
    /// What the round has left to do.
    round: Round,
    /// Samples, photons and gather rays before it.
    before: (u64, u64, u64),
    /// Gather rays of each texel and half, per instance; 0 where photons do.
    gathered: Vec<u32>,
    /// Whether direct light was better smoothed over cells when that was last tried.
    smooths_direct: Option<bool>,
    /// What an audit found beyond the halves.
    unseen: Option<Unseen>,
    /// All that is still to do, where shards do it.
    planned: Option<Planned>,
    falls: Falls,
    history: Vec<HistoryEntry>,
    rounds: Vec<RoundSeconds>,
}

/// What an earlier bake, whose work was kept, took.
#[derive(Debug, Clone, Copy, Default)]
struct Earlier {
    rays: u64,
    /// Seconds from its call.
    elapsed: f64,
    seconds: LightSeconds,
}

/// Solves until the targets are met or a limit binds. Goes on from the work that the part's slot holds, and keeps there
/// what is done; the result is the same bytes as if it had never been interrupted.
///
/// # Errors
/// [`BakeError::Cancelled`] when the observer says so.
pub fn solve<'o>(part: Part<'_, 'o>, observer: &'o mut dyn Observer) -> Result<Solution, BakeError> {
    Solver::new(part, observer).run()
}

/// Work for a round.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct Round {
    /// Direct samples of all texels and both halves; the first round takes the same number everywhere.
    samples: u64,
    /// Photons per half.
    photons: u64,
    /// Photons per half for caustics alone.
    caustics: u64,
    /// (instance, factor) by which its direct samples are to grow.
    direct: Vec<(usize, f64)>,
    /// Share of the samples that goes to these first; unknown until the first are taken.
    direct_share: Option<f64>,
    /// (instance, gather rays of each texel and half) from now on.
    gather: Vec<(usize, u32)>,
}

impl Round {
    fn is_empty(&self) -> bool {
        self.samples == 0 && self.photons == 0 && self.caustics == 0 && self.gather.is_empty()
    }
}

impl<'a, 'o> Solver<'a, 'o> {
    /// Before the first round.
    fn new(part: Part<'a, 'o>, observer: &'o mut dyn Observer) -> Solver<'a, 'o> {
        let Part { path, weights, options, began, slot } = part;
        let texels = &path.surface.texels;
        let instances = path.visibility.world.scene.instances.len();
        let mut texels_of = vec![Vec::new(); instances];
        (0..).zip(&weights.instance).for_each(|(texel, &i)| texels_of[i as usize].push(texel));
        let bits = (texels.texels.len().max(1).ilog2()).clamp(*FIRST_NET_BITS.start(), *FIRST_NET_BITS.end());
        Solver {
            path,
            options,
            observer,
            began,
            weights,
            direct: Direct::new(texels.texels.len()),
            bins: Bins::new(path.visibility.world, texels, &path.surface.open),
            diffuse: Shots::default(),
            caustics: Shots::default(),
            gathering: Gathering { at: vec![(0, 0); instances], ..Gathering::default() },
            texels_of,
            course: Course {
                round: Round { samples: 1, photons: 1 << bits, caustics: 1 << bits, ..Round::default() },
                before: (0, 0, 0),
                gathered: vec![0; instances],
                smooths_direct: None,
                unseen: None,
                planned: None,
                falls: Falls::new(),
                history: Vec::new(),
                rounds: Vec::new(),
            },
            traced: None,
            seconds: LightSeconds::default(),
            last: None,
            slot,
            earlier: Earlier::default(),
        }
    }

    fn run(&mut self) -> Result<Solution, BakeError> {
        self.recall();
        loop {
            let mut solution = self.converge()?;
            solution.audit = self.audit(&solution)?;
            self.believe_audit(&mut solution);
            // Where an audit finds that the target is not met after all, there is more to do.
            if solution.limit.is_none()
                && let Some(wish) = self.wish(&solution, MOST_REDUCTION)
            {
                match self.bounded(wish) {
                    Ok(next) => {
                        self.last = Some(self.outlook(&solution, self.wish(&solution, f64::INFINITY).as_ref()));
                        let now = self.pause()?;
                        let last = self.course.rounds.last_mut();
                        last.into_iter().for_each(|last| *last = RoundSeconds::new(&now));
                        self.observer.stage(Stage::Light);
                        self.begin(next);
                        continue;
                    }
                    Err(limit) => solution.limit = Some(limit),
                }
            }
            self.keep();
            return Ok(self.finished(solution));
        }
    }

    /// `solution` with how it came about.
    fn finished(&mut self, mut solution: Solution) -> Solution {
        solution.history = std::mem::take(&mut self.course.history);
        solution.rounds = std::mem::take(&mut self.course.rounds);
        solution.seconds = self.seconds.since(&self.earlier.seconds);
        solution
    }

    /// The round to do next.
    fn begin(&mut self, round: Round) {
        self.course.round = round;
        self.course.before = self.work();
        self.traced = None;
    }

    /// Rounds until the targets are met by what the halves tell or a limit binds.
    fn converge(&mut self) -> Result<Solution, BakeError> {
        loop {
            let mut stopped = self.trace()?;
            let mut solution = self.concluded()?;
            if self.work() == self.course.before {
                stopped = stopped.or(Some("samples"));
            }
            let Some(wish) = self.wish(&solution, MOST_REDUCTION) else { return Ok(solution) };
            let next = self.bounded(wish);
            if self.seconds_left().is_some_and(|left| left <= 0.0) {
                stopped = stopped.or(Some("time-limit"));
            }
            match (stopped, next) {
                (None, Ok(next)) => self.begin(next),
                (stopped, next) => {
                    solution.limit = stopped.or(next.err());
                    return Ok(solution);
                }
            }
        }
    }

    /// What is known once a round is traced.
    fn concluded(&mut self) -> Result<Solution, BakeError> {
        self.traced = Some(self.course.clone());
        let (started, gather) = (Instant::now(), self.seconds.gather);
        let solution = self.solution()?;
        self.learn(&solution);
        self.seconds.estimate += started.elapsed().as_secs_f64() - (self.seconds.gather - gather);
        let wish = self.wish(&solution, f64::INFINITY);
        let rays = self.rays();
        self.course.history.push(HistoryEntry {
            direct_samples: self.direct.all_samples(),
            photons: self.diffuse.photons * 2,
            rays,
            percent: solution.error.percent,
            low: solution.error.low,
            high: solution.error.high,
            forecast_rays: rays as f64 + wish.as_ref().map_or(0.0, |r| self.cost(r)),
        });
        self.last = Some(self.outlook(&solution, wish.as_ref()));
        let now = self.pause()?;
        self.course.rounds.push(RoundSeconds::new(&now));
        Ok(solution)
    }

    /// Traces what is left of the round; the name of the limit that ended it early.
    fn trace(&mut self) -> Result<Option<&'static str>, BakeError> {
        if let Some(limit) = self.sample()? {
            return Ok(Some(limit));
        }
        let mut limit = self.shoot(PhotonKind::Diffuse)?;
        if self.path.visibility.world.is_specular() {
            limit = limit.or(self.shoot(PhotonKind::Caustic)?);
        }
        Ok(limit.or_else(|| self.out_of_time().then_some("time-limit")))
    }

    /// Takes the direct samples that the round has left; the limit that ended them early.
    fn sample(&mut self) -> Result<Option<&'static str>, BakeError> {
        let texels = &self.path.surface.texels;
        let light = self.path.light(self.options.normals == Normals::Smooth);
        let share = self.course.round.direct_share.unwrap_or_else(|| {
            let grows = self.direct.samples_to_grow(&growing(&self.texels_of, &self.course.round.direct));
            (grows / self.course.round.samples.max(1) as f64).min(1.0)
        });
        self.course.round.direct_share = Some(share);
        while self.course.round.samples > 0 {
            let left = self.course.round.samples;
            let started = Instant::now();
            let most = MOST_SAMPLES_AT_ONCE.max(MOST_PER_TEXEL_AT_ONCE * texels.texels.len() as u64);
            let budget = left.min(most);
            if self.direct.all_samples() == 0 {
                self.direct.extend(&|_, _| FIRST_SAMPLES, FIRST_SAMPLES, self.options.seed, &light);
                self.course.round.samples = 0;
            } else {
                let factors = &mut self.course.round.direct;
                let next = self.direct.allocate(budget, texels, &growing(&self.texels_of, factors), share);
                factors.iter_mut().for_each(|(_, f)| *f /= 1.0 + (*f - 1.0) * next.grown);
                let before = self.direct.all_samples();
                self.direct.extend(&|half, texel| next.more[half][texel], next.steering, self.options.seed, &light);
                // Where all texels have the most that they may take, none takes any.
                self.course.round.samples = if self.direct.all_samples() == before { 0 } else { left - budget };
            }
            self.seconds.direct += started.elapsed().as_secs_f64();
            self.pause()?;
            if self.course.round.samples > 0 && self.out_of_time() {
                return Ok(Some("time-limit"));
            }
        }
        Ok(None)
    }

    /// Samples, photons and gather rays so far.
    fn work(&self) -> (u64, u64, u64) {
        (self.direct.all_samples(), self.diffuse.photons + self.caustics.photons, self.gathering.rays)
    }

    fn rays(&self) -> u64 {
        self.direct.rays() + self.photon_rays() + self.gathering.rays
    }
}

/// The texels of each (instance, factor).
fn growing<'a>(texels_of: &'a [Vec<u32>], factors: &[(usize, f64)]) -> Vec<Growth<'a>> {
    factors.iter().map(|&(instance, factor)| Growth { texels: &texels_of[instance], factor }).collect()
}
