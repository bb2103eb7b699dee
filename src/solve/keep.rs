//! The work so far, kept where another bake may go on from it.
//!
//! Kept is what was traced, and what had been decided when that was traced: what is concluded from it is concluded
//! again, from the same numbers.

use super::shots::Shots;
use super::{Course, Earlier, Gathering, LightSeconds, Solver};
use crate::error::BakeError;
use crate::light::Direct;
use crate::observer::Progress;
use crate::photon::{PhotonKind, Sums};

/// All of it: direct light, what is in the bins, photons of both kinds, what was gathered, what is decided, and seconds
/// of light and since the first call.
type Work = (Direct, Sums, [Shots; 2], Gathering, Course, LightSeconds, f64);

impl Solver<'_, '_> {
    /// Between two pieces of work: tells the observer where the bake stands, and keeps what is done where that is due.
    ///
    /// # Errors
    /// [`BakeError::Cancelled`]; what was done by then is kept.
    pub(super) fn pause(&mut self) -> Result<Progress, BakeError> {
        let progress = self.report_progress();
        if progress.is_err() || self.slot.as_ref().is_some_and(|slot| slot.cache.is_due()) {
            self.keep();
        }
        progress
    }

    /// Keeps the work so far, unless it is all that of an earlier bake.
    pub(super) fn keep(&mut self) {
        if self.rays() != self.earlier.rays {
            self.keep_all();
        }
    }

    /// Keeps the work so far.
    pub(super) fn keep_all(&mut self) {
        // What is concluded from a round is concluded again: it may be done with another target.
        let course = self.traced.as_ref().unwrap_or(&self.course);
        let elapsed = self.earlier.elapsed + self.began.elapsed().as_secs_f64();
        let shots = [&self.diffuse, &self.caustics];
        if let Some(slot) = &mut self.slot {
            slot.keep(&(&self.direct, self.bins.sums(), shots, &self.gathering, course, self.seconds, elapsed));
        }
    }

    /// Goes on from what was kept, if anything was; whether it was.
    pub(super) fn recall(&mut self) -> bool {
        let texels = self.direct.texels();
        let instances = self.texels_of.len();
        let Some(slot) = &mut self.slot else { return false };
        // Not both at once: they are most of the memory of a bake.
        self.direct = Direct::new(0);
        let mut rest = None;
        let found = self.bins.put(|| {
            let (direct, sums, shots, gathering, course, seconds, elapsed) = slot.load::<Work>()?;
            let fits =
                direct.texels() == texels && gathering.at.len() == instances && course.gathered.len() == instances;
            rest = fits.then_some((direct, shots, gathering, course, seconds, elapsed));
            fits.then_some(sums)
        });
        let Some((direct, [diffuse, caustics], gathering, course, seconds, elapsed)) = rest.filter(|_| found) else {
            self.direct = Direct::new(texels);
            return false;
        };
        (self.direct, self.diffuse, self.caustics) = (direct, diffuse, caustics);
        (self.gathering, self.course) = (gathering, course);
        // Time may run out before the next photons start: what there is then was brought by those before.
        self.start_anew();
        (self.seconds, self.earlier) = (seconds, Earlier { rays: self.rays(), elapsed, seconds });
        true
    }

    /// Where light leaves, by the direct light that there is.
    pub(super) fn start_anew(&mut self) {
        for kind in [PhotonKind::Diffuse, PhotonKind::Caustic] {
            let starts = (self.shots(kind).photons > 0).then(|| self.starts(kind));
            self.shots(kind).starts = starts;
        }
    }
}
