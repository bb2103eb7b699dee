//! Whether path tracing confirms what the halves tell.

use super::{Solution, Solver};
use crate::accuracy::{Audit, Auditor, Effort};
use crate::error::BakeError;
use crate::observer::Stage;
use crate::options::{Audits, Normals, TexelValue};
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
        const LATE: &str = "audit: the time limit had passed";
        let effort = match self.options.audit {
            Audits::Off => return Ok(Err("audit: not asked for")),
            _ if solution.error.mean <= 0.0 => return Ok(Err("audit: the maps are black")),
            _ if self.out_of_time() => return Ok(Err(LATE)),
            Audits::Auto => Effort::Rays(LEAST.max((SHARE * self.rays() as f64) as u64)),
            Audits::Texels(n) => Effort::Texels(n),
        };
        let started = Instant::now();
        self.observer.stage(Stage::Audit);
        let auditor = Auditor {
            seed: self.options.seed,
            light: self.path.light(self.options.normals == Normals::Smooth),
            total: &solution.total,
            caustics: solution.caustics.as_ref(),
            weights: &solution.weights,
            whole: self.options.texel_value == TexelValue::Mean,
            crevice: self.path.surface.crevice,
        };
        let go_on = || !self.observer.cancelled() && !self.out_of_time();
        let audit = auditor.run(effort, &solution.error, self.options.target_percent, &go_on);
        self.seconds.audit += started.elapsed().as_secs_f64();
        match audit {
            Some(audit) => Ok(Ok(audit)),
            None if self.observer.cancelled() => Err(BakeError::Cancelled),
            None => Ok(Err(LATE)),
        }
    }

    /// Raises the stated error of `solution`, and of all that follow, to what its audit found where that is surely more.
    pub(super) fn believe_audit(&mut self, solution: &mut Solution) {
        let weight: f64 = solution.weights.weight.iter().sum();
        let blind = solution.squares.caustic / weight.max(1e-300) * (100.0 / solution.error.mean.max(1e-300)).powi(2);
        let audit = solution.audit.as_ref().ok();
        let Some(unseen) = audit.and_then(|a| a.unseen(&solution.error, blind, self.diffuse.photons * 2)) else {
            return;
        };
        solution.error = solution.error.raised(&unseen);
        if let Some(last) = self.history.last_mut() {
            (last.percent, last.low, last.high) = (solution.error.percent, solution.error.low, solution.error.high);
        }
        self.unseen = Some(unseen);
    }
}
