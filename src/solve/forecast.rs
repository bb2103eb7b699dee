//! Time: when the targets will be met, from the work still to do and the speed that each kind of it had so far, and how
//! much of it a time limit leaves.

use super::wish::MOST_REDUCTION;
use super::{LEAST_NET_BITS, Round, Solution, Solver};
use crate::accuracy::{Fall, GATHER_RAY_COST};
use crate::error::BakeError;
use crate::observer::{Progress, Remaining};
use serde::{Deserialize, Serialize};

/// Share of a time limit that light may take: the maps are yet to be made.
const TIME_SHARE: f64 = 0.98;

/// The band around a forecast is a factor of e^this wide to each side for a squared error that is to fall by a factor of
/// e (with all three, 26 of 31 rounds of seven bakes of 30 to 120 s foretold the end within it, some by a hair), ...
const SPREAD: f64 = 0.4;

/// ... by this much besides, ...
const LEAST_SPREAD: f64 = 0.15;

/// ... and by this while meshes are above their target, of which it is not known yet how hard they are.
const MESH_SPREAD: f64 = 0.4;

/// Seconds that light took, by kinds of work.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub struct LightSeconds {
    /// Direct samples.
    pub direct: f64,
    /// Photons.
    pub photons: f64,
    /// Gathering.
    pub gather: f64,
    /// Estimates of the error.
    pub estimate: f64,
    /// Audits.
    pub audit: f64,
}

impl LightSeconds {
    /// Of both.
    pub(super) fn plus(&self, o: &LightSeconds) -> LightSeconds {
        self.with(o, |a, b| a + b)
    }

    /// Without those of `earlier`, which are in them.
    pub(super) fn since(&self, earlier: &LightSeconds) -> LightSeconds {
        self.with(earlier, |a, b| a - b)
    }

    fn with(&self, o: &LightSeconds, of: impl Fn(f64, f64) -> f64) -> LightSeconds {
        LightSeconds {
            direct: of(self.direct, o.direct),
            photons: of(self.photons, o.photons),
            gather: of(self.gather, o.gather),
            estimate: of(self.estimate, o.estimate),
            audit: of(self.audit, o.audit),
        }
    }
}

/// Amounts of work, or seconds for one of each.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Work {
    pub(super) samples: f64,
    pub(super) photon_rays: f64,
    pub(super) gather_rays: f64,
}

impl Work {
    fn plus(&self, o: &Work) -> Work {
        Work {
            samples: self.samples + o.samples,
            photon_rays: self.photon_rays + o.photon_rays,
            gather_rays: self.gather_rays + o.gather_rays,
        }
    }

    /// What of it is left once `done` is.
    fn after(&self, done: &Work) -> Work {
        Work {
            samples: (self.samples - done.samples).max(0.0),
            photon_rays: (self.photon_rays - done.photon_rays).max(0.0),
            gather_rays: (self.gather_rays - done.gather_rays).max(0.0),
        }
    }

    fn times(&self, seconds: &Work) -> f64 {
        self.samples * seconds.samples + self.photon_rays * seconds.photon_rays + self.gather_rays * seconds.gather_rays
    }
}

/// What was known after a round.
#[derive(Debug, Clone, Copy)]
pub(super) struct Outlook {
    /// Upper end of the interval of the error.
    percent: f64,
    /// Work from the start until the targets are met.
    until: Work,
    /// Estimates from then on.
    estimates: f64,
    /// What is left may take so many times as long, or as short.
    spread: f64,
}

/// A state of the solution that later ones are compared with.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Mark {
    soft: f64,
    indirect: f64,
    samples: f64,
    photons: f64,
    gather_rays: u64,
}

/// How the errors of smoothed light fall.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct Falls {
    pub(super) soft: Fall,
    pub(super) indirect: Fall,
    last: Option<Mark>,
}

impl Falls {
    pub(super) fn new() -> Falls {
        Falls { soft: Fall::of_soft_light(), indirect: Fall::of_photons(), last: None }
    }

    fn learn(&mut self, now: Mark) {
        // What is gathered from now on, or smoothed, is not what it was.
        let same = |last: &Mark| last.gather_rays == now.gather_rays && (last.soft > 0.0) == (now.soft > 0.0);
        if let Some(last) = self.last.filter(same) {
            self.indirect.learn(now.photons / last.photons, last.indirect / now.indirect);
            self.soft.learn(now.samples / last.samples, last.soft / now.soft);
        }
        self.last = Some(now);
    }
}

impl Solver<'_, '_> {
    /// Learns from a round how errors fall. That of the first, of a few samples each, is itself not known well: nothing
    /// is learnt from it.
    pub(super) fn learn(&mut self, solution: &Solution) {
        if self.course.history.is_empty() {
            return;
        }
        self.course.falls.learn(Mark {
            soft: solution.squares.soft,
            indirect: solution.by_photons,
            samples: self.direct.all_samples() as f64,
            photons: self.diffuse.photons as f64,
            gather_rays: self.gathering.rays,
        });
    }

    /// What a round foretells, where `wish` is all that is to do.
    pub(super) fn outlook(&self, solution: &Solution, wish: Option<&Round>) -> Outlook {
        let to_do = wish.map_or(Work::default(), |round| self.amount(round));
        // Rounds to come, each of which ends with an estimate.
        let target = self.options.target_percent;
        let needed = (solution.error.high / target).powi(2).max(1.0).ln();
        let rounds = if wish.is_some() { (needed / MOST_REDUCTION.ln()).ceil().max(1.0) } else { 0.0 };
        let meshes = if solution.mesh_percent > self.options.mesh_target() { MESH_SPREAD } else { 0.0 };
        Outlook {
            percent: solution.error.high,
            until: self.done().plus(&to_do),
            estimates: rounds * self.seconds_per_estimate(),
            spread: LEAST_SPREAD.hypot(SPREAD * needed).hypot(meshes).exp(),
        }
    }

    /// Seconds that a round takes at the speed so far.
    pub(super) fn seconds_of(&self, round: &Round) -> f64 {
        self.amount(round).times(&self.rates())
    }

    /// Foretells the end of a round of which `share` is done here.
    pub(super) fn foresee(&mut self, round: &Round, share: f64) {
        let Work { samples, photon_rays, .. } = self.amount(round);
        let to_do = Work { samples: share * samples, photon_rays: share * photon_rays, gather_rays: 0.0 };
        self.last = Some(Outlook {
            percent: self.course.history.last().map_or(f64::INFINITY, |h| h.high),
            until: self.done().plus(&to_do),
            estimates: 0.0,
            spread: LEAST_SPREAD.exp(),
        });
    }

    /// Tells the observer where the bake stands.
    ///
    /// # Errors
    /// [`BakeError::Cancelled`].
    pub(super) fn report_progress(&mut self) -> Result<Progress, BakeError> {
        let (done, rates, rays) = (self.done(), self.rates(), self.rays());
        let tracing = self.seconds.direct + self.seconds.photons + self.seconds.gather;
        let remaining = self.last.map(|last| {
            let seconds = last.until.after(&done).times(&rates) + last.estimates;
            Remaining { seconds, low: seconds / last.spread, high: seconds * last.spread }
        });
        let progress = Progress {
            percent: self.last.map_or(f64::INFINITY, |last| last.percent),
            target: self.options.target_percent,
            rays,
            rays_per_second: if tracing > 0.0 { rays as f64 / tracing } else { 0.0 },
            elapsed: self.earlier.elapsed + self.began.elapsed().as_secs_f64(),
            remaining,
        };
        self.observer.progress(&progress);
        if self.observer.cancelled() { Err(BakeError::Cancelled) } else { Ok(progress) }
    }

    pub(super) fn out_of_time(&self) -> bool {
        self.options.time_limit.is_some_and(|t| self.began.elapsed().as_secs_f64() > t)
    }

    /// Seconds that light may still take: until the time limit, less those of an estimate.
    pub(super) fn seconds_left(&self) -> Option<f64> {
        let left = |limit: f64| limit * TIME_SHARE - self.began.elapsed().as_secs_f64() - self.seconds_per_estimate();
        self.options.time_limit.map(left)
    }

    fn seconds_per_estimate(&self) -> f64 {
        self.seconds.estimate / self.course.history.len().max(1) as f64
    }

    /// As much of a round as there is time for: of the meshes that are to gather, the cheapest first as they are, those
    /// that would be done by then, and of the rest all kinds alike, for what comes last would get nothing.
    pub(super) fn in_time(&self, mut round: Round) -> Round {
        let Some(left) = self.seconds_left() else { return round };
        while !round.gather.is_empty() && self.gather_cost(&round.gather) * self.rates().gather_rays > left {
            round.gather.pop();
        }
        let share = (left / self.amount(&round).times(&self.rates()).max(1e-9)).clamp(0.0, 1.0);
        if share < 1.0 {
            round.samples = (round.samples as f64 * share) as u64;
            round.caustics = (round.caustics as f64 * share) as u64;
            round.photons = ((round.photons as f64 * share) as u64).next_multiple_of(1 << LEAST_NET_BITS);
            round.direct.iter_mut().for_each(|(_, factor)| *factor = 1.0 + (*factor - 1.0) * share);
        }
        round
    }

    fn done(&self) -> Work {
        Work {
            samples: self.direct.all_samples() as f64,
            photon_rays: self.photon_rays() as f64,
            gather_rays: self.gathering.rays as f64,
        }
    }

    pub(super) fn amount(&self, round: &Round) -> Work {
        let per_photon = self.diffuse.ledger.rays.max(1) as f64 / self.diffuse.photons.max(1) as f64;
        let per_caustic = self.caustics.ledger.rays as f64 / self.caustics.photons.max(1) as f64;
        Work {
            samples: round.samples as f64,
            photon_rays: per_photon * round.photons as f64 + per_caustic * round.caustics as f64,
            gather_rays: self.gather_cost(&round.gather),
        }
    }

    /// Seconds for one of each.
    fn rates(&self) -> Work {
        let done = self.done();
        let photon_rays = self.seconds.photons / done.photon_rays.max(1.0);
        Work {
            samples: self.seconds.direct / done.samples.max(1.0),
            photon_rays,
            gather_rays: match self.gathering.rays {
                0 => GATHER_RAY_COST * photon_rays,
                n => self.seconds.gather / n as f64,
            },
        }
    }
}
