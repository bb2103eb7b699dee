//! Whether path tracing confirms what the halves tell.

use super::{LightPath, Solution, Solver};
use crate::accuracy::{Audit, Auditor, Effort, Unseen};
use crate::error::BakeError;
use crate::observer::{Observer, Stage};
use crate::options::{Audits, BakeOptions, Normals, TexelValue};
use std::time::Instant;

/// Rays of an audit: this share of those of the bake, or this many where that is more.
const SHARE: f64 = 0.03;
const LEAST: u64 = 1 << 21;

impl Solver<'_, '_> {
    /// What path tracing says of `solution`, or why it was not asked.
    ///
    /// # Errors
    /// [`BakeError::Cancelled`].
    pub(super) fn audit(&mut self, solution: &Solution) -> Result<Result<Audit, &'static str>, BakeError> {
        let started = Instant::now();
        if self.options.audit != Audits::Off {
            self.observer.stage(Stage::Audit);
        }
        let (rays, late) = (self.rays(), || self.out_of_time());
        let audit = audit(&self.path, solution, self.options, rays, &*self.observer, &late);
        self.seconds.audit += started.elapsed().as_secs_f64();
        if audit.is_err() {
            self.keep();
        }
        audit
    }

    /// Raises the stated error of `solution`, and of all that follow, to what its audit found where that is surely more.
    pub(super) fn believe_audit(&mut self, solution: &mut Solution) {
        let Some(unseen) = solution.found_unseen(solution.photons) else { return };
        solution.error = solution.error.raised(&unseen);
        if let Some(last) = self.course.history.last_mut() {
            (last.percent, last.low, last.high) = (solution.error.percent, solution.error.low, solution.error.high);
        }
        self.course.unseen = Some(unseen);
    }
}

impl Solution {
    /// What the audit surely found beyond the stated error, after `photons`.
    pub(super) fn found_unseen(&self, photons: u64) -> Option<Unseen> {
        let weight: f64 = self.weights.weight.iter().sum();
        let blind = self.squares.caustic / weight.max(1e-300) * (100.0 / self.error.mean.max(1e-300)).powi(2);
        self.audit.as_ref().ok()?.unseen(&self.error, blind, photons)
    }
}

/// What path tracing along `path` says of `solution`, which took `rays`, or why it was not asked.
///
/// # Errors
/// [`BakeError::Cancelled`].
pub(super) fn audit(
    path: &LightPath,
    solution: &Solution,
    options: &BakeOptions,
    rays: u64,
    observer: &dyn Observer,
    late: &(dyn Fn() -> bool + Sync),
) -> Result<Result<Audit, &'static str>, BakeError> {
    const LATE: &str = "audit: the time limit had passed";
    let effort = match options.audit {
        Audits::Off => return Ok(Err("audit: not asked for")),
        _ if solution.error.mean <= 0.0 => return Ok(Err("audit: the maps are black")),
        _ if late() => return Ok(Err(LATE)),
        Audits::Auto => Effort::Rays(LEAST.max((SHARE * rays as f64) as u64)),
        Audits::Texels(n) => Effort::Texels(n),
    };
    let auditor = Auditor {
        seed: options.seed,
        light: path.light(options.normals == Normals::Smooth),
        total: &solution.total,
        caustics: solution.caustics.as_ref(),
        weights: &solution.weights,
        whole: options.texel_value == TexelValue::Mean,
        crevice: path.surface.crevice,
    };
    let go_on = || !observer.cancelled() && !late();
    match auditor.run(effort, &solution.error, options.target_percent, &go_on) {
        Some(audit) => Ok(Ok(audit)),
        None if observer.cancelled() => Err(BakeError::Cancelled),
        None => Ok(Err(LATE)),
    }
}
