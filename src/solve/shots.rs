//! Photons of one kind, shot in nets round after round.

use super::forecast::Falls;
use super::{LEAST_NET_BITS, LightPath, Solver, Surface};
use crate::error::BakeError;
use crate::photon::{Bins, EnergyLedger, Flux, NetPart, PhotonKind, Shooting, StartTable};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Largest net, or part of one, that is shot between two looks at the clock.
pub(super) const LARGEST_NET_BITS: u32 = 21;

/// Photons of one kind so far.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Shots {
    pub(super) flux: Option<Flux>,
    /// Where light leaves by the direct light so far: not kept, for that tells it.
    #[serde(skip)]
    pub(super) starts: Option<[StartTable; 2]>,
    /// Start flux of each half, as the last round found it [lux x frame units squared].
    totals: [f64; 2],
    /// Photons per half.
    pub(super) photons: u64,
    /// Nets per half.
    pub(super) nets: u64,
    pub(super) ledger: EnergyLedger,
}

impl Shots {
    /// Start flux of each half, as the last round found it [lux x frame units squared].
    pub(super) fn start_totals(&self) -> [f64; 2] {
        self.totals
    }

    /// Flux of an integer step of a bin, and of a photon [lux x frame units squared].
    pub(super) fn scale(&self) -> FluxScale {
        let photons = self.photons.max(1) as f64;
        let [odd, even] = self.start_totals();
        FluxScale { step: self.flux.map_or(0.0, |f| f.unit / photons), photon: odd.max(even) / photons }
    }

    /// Photons per half that `most_photons` of both halves leave; less than the smallest net is none.
    pub(super) fn left(&self, most_photons: Option<u64>) -> u64 {
        // The smallest net is shot whatever the limit: without any, its light would be black.
        let most = most_photons.map_or(u64::MAX, |m| (m / 2).max(1 << LEAST_NET_BITS));
        let left = most.saturating_sub(self.photons);
        if left < 1 << LEAST_NET_BITS { 0 } else { left }
    }
}

/// What is in the bins, in flux [lux x frame units squared].
pub(super) struct FluxScale {
    /// Of an integer step.
    pub(super) step: f64,
    /// Of a photon.
    pub(super) photon: f64,
}

impl Solver<'_, '_> {
    /// Shoots the photons of one kind that the round has left, in nets; the limit that ended them early.
    pub(super) fn shoot(&mut self, kind: PhotonKind) -> Result<Option<&'static str>, BakeError> {
        let mut started = Instant::now();
        let starts = self.starts(kind);
        let totals = starts.each_ref().map(StartTable::total);
        let total = totals[0].max(totals[1]);
        if total <= 0.0 {
            return Ok(None);
        }
        if self.shots(kind).flux.is_some_and(|f| !f.holds(total)) {
            self.forget(kind);
        }
        let flux = *self.shots(kind).flux.get_or_insert_with(|| Flux::for_total(total));
        let most = self.options.max_photons;
        let mut limit = None;
        if self.shots(kind).photons == 0 {
            let left = self.left(kind);
            *left = (*left).max(1 << LEAST_NET_BITS);
        }
        self.shots(kind).totals = totals;
        loop {
            let left = *self.left(kind);
            if left == 0 {
                break;
            }
            let allowed = self.shots(kind).left(most);
            if allowed == 0 {
                limit = Some("max-photons");
                break;
            }
            let bits = left.min(allowed).ilog2().clamp(LEAST_NET_BITS, LARGEST_NET_BITS);
            let net = NetPart::whole(self.shots(kind).nets, bits);
            let ledger = self.shooting(kind, flux, &starts, false).both_halves(net, &self.bins);
            let shots = self.shots(kind);
            shots.ledger += &ledger;
            shots.nets += 1;
            shots.photons += 1 << bits;
            *self.left(kind) = left.saturating_sub(1 << bits);
            self.seconds.photons += started.elapsed().as_secs_f64();
            self.pause()?;
            started = Instant::now();
            if *self.left(kind) > 0 && self.out_of_time() {
                limit = Some("time-limit");
                break;
            }
        }
        self.shots(kind).starts = Some(starts);
        Ok(limit)
    }

    /// What photons of a kind are shot with; `used` where others started at the same points.
    pub(super) fn shooting<'s>(
        &'s self,
        kind: PhotonKind,
        flux: Flux,
        starts: &'s [StartTable; 2],
        used: bool,
    ) -> Shooting<'s> {
        Shooting {
            kind,
            seed: self.options.seed,
            flux,
            used,
            starts,
            direct: &self.direct,
            light: self.path.light(false),
            crevice: self.path.surface.crevice,
        }
    }

    /// Where photons start by the direct light so far.
    pub(super) fn starts(&self, kind: PhotonKind) -> [StartTable; 2] {
        let LightPath { surface: Surface { texels, .. }, visibility, .. } = self.path;
        [0, 1].map(|h| match kind {
            PhotonKind::Diffuse => StartTable::new(texels, &self.direct, h),
            PhotonKind::Caustic => StartTable::of_specular(visibility.world, texels, &self.direct, h),
        })
    }

    /// Photons per half that the round has left.
    fn left(&mut self, kind: PhotonKind) -> &mut u64 {
        match kind {
            PhotonKind::Diffuse => &mut self.course.round.photons,
            PhotonKind::Caustic => &mut self.course.round.caustics,
        }
    }

    pub(super) fn shots(&mut self, kind: PhotonKind) -> &mut Shots {
        match kind {
            PhotonKind::Diffuse => &mut self.diffuse,
            PhotonKind::Caustic => &mut self.caustics,
        }
    }

    /// Begins anew: the first direct samples missed nearly all of the light, and so did the photons they started.
    fn forget(&mut self, kind: PhotonKind) {
        let LightPath { surface: Surface { texels, open, .. }, visibility, .. } = self.path;
        self.caustics = Shots::default();
        match kind {
            PhotonKind::Caustic => self.bins.forget_caustics(),
            PhotonKind::Diffuse => {
                self.bins = Bins::new(visibility.world, texels, open);
                self.diffuse = Shots::default();
                self.gathering.at.fill((0, 0));
                (self.course.falls, self.last) = (Falls::new(), None);
            }
        }
    }

    /// Rays of photons of both kinds.
    pub(super) fn photon_rays(&self) -> u64 {
        self.diffuse.ledger.rays + self.caustics.ledger.rays
    }
}
