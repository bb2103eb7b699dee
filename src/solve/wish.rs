//! What to do next: the least work that meets the targets by what is known, and how much of it a round takes.

use super::{LEAST_NET_BITS, Round, Solution, Solver, growing};
use crate::accuracy::{CAUSTIC_SHARE, PhotonCost, Spent, caustic_growth, cheapest_growth, gather_rays, plan_meshes};

/// Samples of each half of a texel that must all be black before a scene with lights is believed to be.
const DARK_SAMPLES: f64 = 64.0;

/// A round multiplies the work so far by at most this much: forecasts from little data are poor.
const MOST_GROWTH: f64 = 5.0;

/// A round lowers the squared error by at most this much: what photons bring when they grow by the most. Direct
/// light then does not run ahead of them.
pub(super) const MOST_REDUCTION: f64 = 2.6;

/// ... but that of one mesh by this many times as much.
const MOST_MESH_GROWTH: f64 = 4.0;

/// Meshes gather once the error over all is below this many times its target.
const GATHER_FROM: f64 = 1.5;

/// Cost of a direct sample in rays of photons: lamps are weighed and texels clipped besides.
const SAMPLE_COST: f64 = 2.0;

impl Solver<'_, '_> {
    /// Rays that a round takes.
    pub(super) fn cost(&self, round: &Round) -> f64 {
        let per_sample = self.direct.rays().max(1) as f64 / self.direct.all_samples().max(1) as f64;
        let amount = self.amount(round);
        per_sample * amount.samples + amount.photon_rays + amount.gather_rays
    }

    /// Rays that (instance, gather rays of each texel and half) take.
    pub(super) fn gather_cost(&self, gather: &[(usize, u32)]) -> f64 {
        gather.iter().map(|&(i, n)| gather_rays(f64::from(n), self.texels_of[i].len())).sum()
    }

    /// The least work that meets the targets by what is known, or lowers the squared error by `most`; `None` where
    /// the targets are met.
    pub(super) fn wish(&self, s: &Solution, most: f64) -> Option<Round> {
        self.wish_for(s, 1.0, most)
    }

    /// The same for `aim` times the targets.
    pub(super) fn wish_for(&self, s: &Solution, aim: f64, most: f64) -> Option<Round> {
        let (target, mesh_target) = (aim * self.options.target_percent, aim * self.options.mesh_target());
        let samples = self.direct.all_samples() as f64;
        if s.error.mean <= 0.0 {
            // Nothing found any light yet. It may come through a keyhole: black is believed after a good look.
            let looks = samples / (2 * self.path.surface.texels.texels.len()).max(1) as f64;
            let looks_on = looks < DARK_SAMPLES && !self.path.emitters.is_empty();
            return looks_on.then(|| Round { samples: samples as u64, ..Round::default() });
        }
        if s.error.high <= target && s.mesh_percent <= mesh_target {
            return None;
        }
        // More photons alone lower what only audits see.
        let weight: f64 = s.weights.weight.iter().sum();
        let unseen = (s.error.unseen / 100.0 * s.error.mean).powi(2) * weight;
        let spent = Spent {
            direct: s.squares.apart,
            soft: s.squares.soft,
            indirect: s.squares.indirect + unseen,
            falls: [self.course.falls.soft.exponent(), self.course.falls.indirect.exponent()],
            direct_cost: SAMPLE_COST * samples,
            photon_cost: self.diffuse.ledger.rays.max(1) as f64,
        };
        let needed = (s.error.high / target).powi(2);
        // Caustics have photons of their own: these are to leave a small share of what is allowed.
        let (others, thrown) = (spent.direct + spent.soft + spent.indirect, s.squares.caustic);
        let allowed = (others + thrown) / needed;
        let mut z = caustic_growth(thrown / (CAUSTIC_SHARE * allowed).max(1e-300));
        let needed = others / (allowed - thrown.min(CAUSTIC_SHARE * allowed));
        // All the way, and as far as this round goes.
        let (x_all, y_all) = cheapest_growth(&spent, needed);
        let (x, mut y) = cheapest_growth(&spent, needed.min(most));
        let mut round = Round { samples: (samples * (x - 1.0)).ceil().min(1e18) as u64, ..Round::default() };
        if s.mesh_percent > mesh_target {
            // What a mesh needs beyond that: most of them get better with the whole.
            let cost = PhotonCost { diffuse: spent.photon_cost, caustic: self.caustics.ledger.rays as f64 };
            let plan = plan_meshes(&s.missed, s.meshes.len() / 20, mesh_target / 100.0, cost, y_all);
            y *= plan.photons / y_all;
            z = z.max(plan.caustics);
            // Light is gathered from what photons found: not before that is about good enough by itself. A look all the
            // way counts it.
            if s.error.high <= GATHER_FROM * target || most.is_infinite() {
                round.gather = plan.gather;
            }
            let beyond = plan.direct.into_iter().map(|(i, factor)| (i, (factor / x_all).min(most * MOST_MESH_GROWTH)));
            round.direct = beyond.filter(|g| g.1 > 1.0).collect();
            let more = self.direct.samples_to_grow(&growing(&self.texels_of, &round.direct));
            round.samples = round.samples.saturating_add(more.ceil().min(1e18) as u64);
        }
        if self.diffuse.flux.is_some() {
            round.photons = (self.diffuse.photons as f64 * (y - 1.0)).ceil().min(1e18) as u64;
        }
        round.caustics = (self.caustics.photons as f64 * (z - 1.0)).ceil().min(1e18) as u64;
        Some(round)
    }

    /// `wish`, bounded in growth and time; the limit where no work is left that would help. Notes which meshes gather.
    pub(super) fn bounded(&mut self, mut wish: Round) -> Result<Round, &'static str> {
        let most = |n: u64| (n as f64 * (MOST_GROWTH - 1.0)) as u64;
        wish.samples = wish.samples.min(most(self.direct.all_samples()));
        wish.photons = wish.photons.min(most(self.diffuse.photons)).next_multiple_of(1 << LEAST_NET_BITS);
        let caustics_left = self.caustics.left(self.options.max_photons);
        wish.caustics = wish.caustics.min(most(self.caustics.photons)).min(caustics_left);
        // The cheapest meshes first, for about as many rays as the rest of the round may take; one at least where there
        // is nothing else to do.
        let allowed = most(self.rays()) as f64;
        let idle = wish.samples == 0 && wish.photons == 0;
        let mut costs: Vec<(f64, (usize, u32))> = wish.gather.iter().map(|g| (self.gather_cost(&[*g]), *g)).collect();
        costs.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut sum = 0.0;
        let affordable = costs.into_iter().take_while(|c| {
            let first = sum == 0.0;
            sum += c.0;
            sum <= allowed || (first && idle)
        });
        wish.gather = affordable.map(|c| c.1).collect();
        if wish.is_empty() {
            return Err(self.exhausted());
        }
        let round = self.in_time(wish);
        if round.is_empty() {
            return Err("time-limit");
        }
        round.gather.iter().for_each(|&(instance, rays)| self.course.gathered[instance] = rays);
        Ok(round)
    }

    fn exhausted(&self) -> &'static str {
        let most = self.options.max_photons;
        let bound = [&self.diffuse, &self.caustics].into_iter().any(|shots| shots.left(most) == 0);
        if bound { "max-photons" } else { "samples" }
    }
}
