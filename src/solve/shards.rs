//! The work of one bake, shared out: a plan of all that is left to do once the light is roughly known, shards that do a
//! part of it each, on any machine, and their sum.
//!
//! A shard is whole nets of photons, which start all over the scene, and the direct light of some blocks of texels. A net
//! more or less only changes how many photons there are, so that without some of the shards the light is as unbiased as
//! with all. Photons start where the plan found light: no shard waits for another.

use super::groups::Parts;
use super::shots::LARGEST_NET_BITS;
use super::wish::MOST_REDUCTION;
use super::{Earlier, LEAST_NET_BITS, LightSeconds, Round, Solution, Solver, growing};
use crate::cache::Keeping;
use crate::error::BakeError;
use crate::light::{Direct, DirectPart};
use crate::observer::Observer;
use crate::options::Normals;
use crate::photon::{EnergyLedger, NetPart, PhotonKind, Sums};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// What a plan is kept as.
const PLAN: &str = "plan";

/// A plan is made once the error is below this many times its target, and has been seen so often: how it falls is known
/// well enough by then to say what more it takes.
const NEAR: f64 = 4.0;
const LEAST_ROUNDS: usize = 3;

/// ... and the light that photons start with has less noise than this share of the target.
const START_SHARE: f64 = 0.3;

/// Part of the targets that a plan aims at: what is foretold is not quite so, and there is no second round.
const AIM: f64 = 0.9;

/// Largest net.
const MOST_NET_BITS: u32 = 31;

/// Kinds of photons, as plans and shards have them.
const KINDS: [PhotonKind; 2] = [PhotonKind::Diffuse, PhotonKind::Caustic];

/// Direct samples between two looks at whether to stop.
const SAMPLES_AT_ONCE: u64 = 1 << 22;

/// One of several parts of the work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shard {
    /// From 1.
    pub number: u32,
    /// Of so many.
    pub count: u32,
}

impl Shard {
    /// All of the work.
    pub const WHOLE: Shard = Shard { number: 1, count: 1 };

    /// Whether it does piece `k`.
    fn takes(&self, k: u64) -> bool {
        k % u64::from(self.count.max(1)) + 1 == u64::from(self.number)
    }
}

/// All that is left to do of one part of the light.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Planned {
    round: Round,
    nets: [Nets; 2],
    /// Fewer photons than the targets take, since there may be no more.
    bound: bool,
}

/// Nets of photons of a kind that are to be shot, and the binary logarithm of the photons in each half of one.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
struct Nets {
    count: u64,
    bits: u32,
}

impl Nets {
    /// About `photons` for each half, `most` at most, in so many nets at least where they are not too small.
    fn of(photons: u64, least: u32, most: u64) -> Nets {
        let bits = (photons / u64::from(least.max(1))).max(1).ilog2().clamp(LEAST_NET_BITS, LARGEST_NET_BITS);
        Nets { count: photons.div_ceil(1 << bits).min(most >> bits), bits }
    }

    /// Number `k` of them: parts of one net, or of several where one would be too large, from number `first` on.
    fn part(&self, first: u64, k: u64) -> NetPart {
        let part_bits = self.count.next_power_of_two().ilog2().min(MOST_NET_BITS - self.bits);
        NetPart { net: first + (k >> part_bits), part: (k & ((1 << part_bits) - 1)) as u32, part_bits, bits: self.bits }
    }
}

/// What a plan foretells.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub struct PlanOutlook {
    /// Upper end of the interval of the error when the plan was made (percent).
    pub percent: f64,
    /// Seconds that all shards would take together on this machine.
    pub shard_seconds: f64,
    /// Seconds of gathering, which is left to the merge.
    pub merge_seconds: f64,
    /// Nets of photons: more shards than these have no photons to trace.
    pub nets: u64,
    /// Photons of both halves.
    pub photons: u64,
    /// Direct samples of both halves.
    pub direct_samples: u64,
}

/// What a shard did for one part of the light.
#[derive(Debug, Serialize, Deserialize)]
pub struct ShardWork {
    direct: DirectPart,
    sums: Sums,
    /// Of each kind of photons.
    shots: [NetsShot; 2],
    seconds: LightSeconds,
}

/// Nets that were shot, and where their flux went.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
struct NetsShot {
    count: u64,
    ledger: EnergyLedger,
}

/// What all shards did that there are.
pub trait Shards {
    /// Shows what each shard did for a part of the light.
    ///
    /// # Errors
    /// [`BakeError`] where one cannot be read, and what `take` returns.
    fn visit(&self, part: usize, take: &mut dyn FnMut(&ShardWork) -> Result<(), BakeError>) -> Result<(), BakeError>;

    /// Whether none is missing.
    fn are_complete(&self) -> bool;
}

/// All parts, done at once.
impl Shards for Vec<ShardWork> {
    fn visit(&self, part: usize, take: &mut dyn FnMut(&ShardWork) -> Result<(), BakeError>) -> Result<(), BakeError> {
        self.get(part).map_or(Ok(()), take)
    }

    fn are_complete(&self) -> bool {
        true
    }
}

/// Plans each part of the light: looks at it until it is known what more it takes, and keeps that in `keeping`, in no less
/// than `shards` nets where there are photons enough.
///
/// # Errors
/// [`BakeError::Cancelled`] when the observer says so.
pub fn plan_groups(
    mut parts: Parts,
    shards: u32,
    keeping: Option<&mut Keeping>,
    observer: &mut dyn Observer,
) -> Result<Vec<PlanOutlook>, BakeError> {
    let mut found = Vec::new();
    parts.each(PLAN, keeping, observer, &mut |_, part, observer| {
        found.push(Solver::new(part, observer).plan(shards)?);
        Ok(())
    })?;
    Ok(found)
}

/// Does what of the plan in `keeping` is `shard`'s, for each part of the light.
///
/// # Errors
/// [`BakeError::Plan`] where there is none, [`BakeError::Cancelled`] when the observer says so.
pub fn shard_groups(
    mut parts: Parts,
    shard: Shard,
    keeping: Option<&mut Keeping>,
    observer: &mut dyn Observer,
) -> Result<Vec<ShardWork>, BakeError> {
    let mut done = Vec::new();
    parts.each(PLAN, keeping, observer, &mut |_, part, observer| {
        let mut solver = Solver::new(part, observer);
        let planned = solver.planned()?;
        done.push(solver.work_of(&planned, shard)?);
        Ok(())
    })?;
    Ok(done)
}

/// The light of all `shards` on top of that of the plan in `keeping`, each part by itself, and their sum. Targets that are
/// not met have the limit `plan`, or `shards` where some are missing.
///
/// # Errors
/// As [`shard_groups`], and what `shards` return.
pub fn merge_groups(
    parts: Parts,
    shards: &dyn Shards,
    keeping: Option<&mut Keeping>,
    observer: &mut dyn Observer,
) -> Result<Solution, BakeError> {
    let limit = if shards.are_complete() { "plan" } else { "shards" };
    parts.sum(PLAN, keeping, observer, &mut |k, part, observer| {
        let mut solver = Solver::new(part, observer);
        let planned = solver.planned()?;
        shards.visit(k, &mut |work| solver.take(&planned, work))?;
        solver.conclude(&planned, limit)
    })
}

impl Solver<'_, '_> {
    /// Rounds until it is known what more the targets take; keeps that and the light so far.
    fn plan(&mut self, shards: u32) -> Result<PlanOutlook, BakeError> {
        let solution = loop {
            let stopped = self.trace()?;
            let solution = self.concluded()?;
            let target = self.options.target_percent;
            let near = solution.error.mean > 0.0 && solution.error.high <= NEAR * target;
            // All photons to come start where the light so far is: more direct samples do not mend that.
            let steady = self.start_noise().sqrt() <= START_SHARE * target / 100.0;
            let enough = near && steady && self.course.history.len() >= LEAST_ROUNDS;
            if enough || stopped.is_some() || self.work() == self.course.before {
                break solution;
            }
            match self.wish(&solution, MOST_REDUCTION).map(|wish| self.bounded(wish)) {
                Some(Ok(next)) => self.begin(next),
                _ => break solution,
            }
        };
        let mut round = self.wish_for(&solution, AIM, f64::INFINITY).unwrap_or_default();
        let most = self.options.max_photons;
        let left = [self.diffuse.left(most), self.caustics.left(most)];
        let bound = round.photons > left[0] || round.caustics > left[1];
        round.photons = round.photons.min(left[0]);
        round.caustics = round.caustics.min(left[1]);
        let nets = [Nets::of(round.photons, shards, left[0]), Nets::of(round.caustics, shards, left[1])];
        let gather = Round { gather: round.gather.clone(), ..Round::default() };
        let all = self.seconds_of(&round);
        let outlook = PlanOutlook {
            percent: solution.error.high,
            shard_seconds: all - self.seconds_of(&gather),
            merge_seconds: self.seconds_of(&gather),
            nets: nets[0].count.max(nets[1].count),
            photons: 2 * nets.iter().map(|n| n.count << n.bits).sum::<u64>(),
            direct_samples: round.samples,
        };
        self.begin(Round::default());
        self.course.planned = Some(Planned { round, nets, bound });
        self.keep_all();
        Ok(outlook)
    }

    /// Goes back to where a plan was made, and what it says.
    fn planned(&mut self) -> Result<Planned, BakeError> {
        let found = self.recall();
        // What is done from here on is not for the plan.
        self.slot = None;
        let planned = self.course.planned.take().filter(|_| found);
        planned.ok_or_else(|| BakeError::Plan("it holds no light of this scene with these options".into()))
    }

    /// Does what of a plan is `shard`'s.
    fn work_of(&mut self, planned: &Planned, shard: Shard) -> Result<ShardWork, BakeError> {
        self.foresee(&planned.round, 1.0 / f64::from(shard.count));
        // What the plan has in its bins is added by the merge.
        self.bins.empty_all();
        let mut shots = [NetsShot::default(); 2];
        for (k, kind) in KINDS.into_iter().enumerate() {
            shots[k] = self.shoot_nets(kind, planned.nets[k], shard)?;
        }
        let direct = self.sample_blocks(&planned.round, shard)?;
        let seconds = self.seconds.since(&self.earlier.seconds);
        Ok(ShardWork { direct, sums: self.bins.take_sums(), shots, seconds })
    }

    fn shoot_nets(&mut self, kind: PhotonKind, nets: Nets, shard: Shard) -> Result<NetsShot, BakeError> {
        let mut shot = NetsShot::default();
        let Some(flux) = self.shots(kind).flux.filter(|_| nets.count > 0) else { return Ok(shot) };
        let starts = self.shots(kind).starts.take().unwrap_or_else(|| self.starts(kind));
        let total = starts[0].total().max(starts[1].total());
        if total <= 0.0 || !flux.holds(total) {
            return Ok(shot);
        }
        let first = self.shots(kind).nets;
        for k in (0..nets.count).filter(|&k| shard.takes(k)) {
            let started = Instant::now();
            let ledger = self.shooting(kind, flux, &starts, true).both_halves(nets.part(first, k), &self.bins);
            shot.ledger += &ledger;
            shot.count += 1;
            self.shots(kind).ledger += &ledger;
            self.seconds.photons += started.elapsed().as_secs_f64();
            self.pause()?;
        }
        Ok(shot)
    }

    fn sample_blocks(&mut self, round: &Round, shard: Shard) -> Result<DirectPart, BakeError> {
        let texels = &self.path.surface.texels;
        let light = self.path.light(self.options.normals == Normals::Smooth);
        let before = (self.direct.all_samples(), self.direct.rays());
        if round.samples == 0 {
            return Ok(DirectPart::default());
        }
        let growth = growing(&self.texels_of, &round.direct);
        let share = (self.direct.samples_to_grow(&growth) / round.samples as f64).min(1.0);
        let next = self.direct.allocate(round.samples, texels, &growth, share);
        let block = |texel: usize| (texel / Direct::BLOCK) as u64;
        let takes = |texel: usize| shard.takes(block(texel));
        let blocks = (self.direct.texels().div_ceil(Direct::BLOCK) as u64).div_ceil(shard.count.into()).max(1);
        let turns = (round.samples / u64::from(shard.count)).div_ceil(SAMPLES_AT_ONCE).clamp(1, blocks);
        for turn in 0..turns {
            let started = Instant::now();
            let now = |texel: usize| takes(texel) && block(texel) / u64::from(shard.count) % turns == turn;
            let more = |half: usize, texel: usize| if now(texel) { next.more[half][texel] } else { 0 };
            // There is no round after this one that any would steer.
            self.direct.extend(&more, 0, self.options.seed, &light);
            self.seconds.direct += started.elapsed().as_secs_f64();
            self.pause()?;
        }
        let sampled = |t: &usize| takes(*t) && (next.more[0][*t] > 0 || next.more[1][*t] > 0);
        Ok(self.direct.part((0..self.direct.texels()).filter(sampled).map(|t| t as u32), before))
    }

    /// Adds what a shard of a plan did.
    fn take(&mut self, planned: &Planned, work: &ShardWork) -> Result<(), BakeError> {
        if !self.bins.add(&work.sums) || !self.direct.put(&work.direct) {
            return Err(BakeError::Plan("a shard is of other texels".into()));
        }
        for ((kind, nets), shot) in KINDS.into_iter().zip(planned.nets).zip(&work.shots) {
            let shots = self.shots(kind);
            shots.nets += shot.count;
            shots.photons += shot.count << nets.bits;
            shots.ledger += &shot.ledger;
        }
        self.seconds = self.seconds.plus(&work.seconds);
        Ok(())
    }

    /// What is known once all shards are in; `limit` where that is not what was to be.
    fn conclude(&mut self, planned: &Planned, limit: &'static str) -> Result<Solution, BakeError> {
        self.earlier = Earlier::default();
        self.start_anew();
        for &(instance, rays) in &planned.round.gather {
            self.course.gathered[instance] = rays;
        }
        let mut solution = self.concluded()?;
        solution.audit = self.audit(&solution)?;
        self.believe_audit(&mut solution);
        let limit = if planned.bound { "max-photons" } else { limit };
        solution.limit = self.wish(&solution, f64::INFINITY).map(|_| limit);
        Ok(self.finished(solution))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_piece_is_one_shards() {
        for count in [1, 2, 3, 7, 16] {
            for k in 0..100 {
                let takers = (1..=count).filter(|&number| Shard { number, count }.takes(k)).count();
                assert_eq!(takers, 1, "piece {k} of {count}");
            }
        }
    }

    #[test]
    fn nets_are_enough_for_all_shards_where_there_are_photons_for_them() {
        for (photons, shards) in [(0, 8), (5000, 8), (1 << 20, 8), (1 << 20, 100), (3 << 30, 64)] {
            let nets = Nets::of(photons, shards, u64::MAX);
            assert!(nets.count << nets.bits >= photons);
            let bound = Nets::of(photons, shards, photons);
            assert!(bound.count << bound.bits <= photons && bound.bits == nets.bits);
            assert!(nets.count >= u64::from(shards) || photons < u64::from(shards) << LEAST_NET_BITS, "{nets:?}");
        }
    }
}
