//! Light of groups of lights, each solved by itself, and their sum.
//!
//! Each has random numbers of its own and meets the targets relative to its own mean: dimmed, brightened or coloured
//! later, it is as good as was asked. The sum of what each stores is the whole, texel by texel.

use super::audit::audit;
use super::estimate::stored_weights;
use super::{LightPath, Part, Solution, solve};
use crate::accuracy::{Audit, Caustics, Halves, TexelError, TexelWeights, mesh_errors};
use crate::cache::Keeping;
use crate::error::BakeError;
use crate::light::{Emitters, LightGroup};
use crate::observer::{Observer, Stage};
use crate::options::{Audits, BakeOptions, DoubleSided};
use crate::photon::EnergyLedger;
use crate::report::{HistoryEntry, RoundSeconds, percentile_95};
use crate::sampling::hash_mix;
use glam::Vec3;
use std::time::Instant;

/// Sets the random numbers of groups apart.
const GROUP: u64 = 0x0067_726f_7570;

/// The light of one group.
#[derive(Debug)]
pub struct GroupSolution {
    /// The group.
    pub group: LightGroup,
    /// Irradiance (lux) of each texel of the map.
    pub light: Vec<Vec3>,
    /// Its error, relative to its own mean.
    pub error: TexelError,
    /// Error that 95 % of the meshes are under, each relative to its mean light of this group.
    pub mesh_percent: f64,
    /// Which limit ended it before its targets were met.
    pub limit: Option<&'static str>,
    /// What path tracing says of it, or why it was not asked.
    pub audit: Result<Audit, &'static str>,
    /// One entry per round.
    pub history: Vec<HistoryEntry>,
}

/// What is done on part number 0, 1, ... of the light.
pub(super) type PartWork<'w, T> =
    dyn for<'o> FnMut(usize, Part<'o, 'o>, &'o mut dyn Observer) -> Result<T, BakeError> + 'w;

/// All light, in the parts that are solved by themselves.
#[derive(Clone)]
pub struct Parts<'a> {
    /// What rays meet, and all that shines.
    pub path: LightPath<'a>,
    /// Groups of lights; the light of `path` as a whole is the only part where there are none.
    pub groups: &'a [LightGroup],
    /// What shines of a group.
    pub emitters: &'a dyn Fn(&LightGroup) -> Emitters,
    /// Weights of the texels of the map.
    pub weights: TexelWeights,
    /// Targets, limits and seed. A time limit is shared out evenly, and so are most photons.
    pub options: &'a BakeOptions,
    /// When the bake began.
    pub began: Instant,
}

impl Parts<'_> {
    /// Does `work` on each part in order, of which `keeping` has a place of a `kind` for each.
    ///
    /// # Errors
    /// [`BakeError::Cancelled`] when the observer says so, and what `work` returns.
    pub(super) fn each(
        &mut self,
        kind: &'static str,
        mut keeping: Option<&mut Keeping>,
        observer: &mut dyn Observer,
        work: &mut PartWork<()>,
    ) -> Result<(), BakeError> {
        let Parts { path, groups, emitters, options, began, .. } = *self;
        if groups.is_empty() {
            let slot = keeping.as_mut().map(|keeping| keeping.slot(kind, &()));
            return work(0, Part { path, weights: self.weights.clone(), options, began, slot }, observer);
        }
        self.weights = sides(path, self.weights.clone(), options, began, observer)?;
        let count = groups.len();
        for (k, group) in groups.iter().enumerate() {
            observer.group(&group.name, k + 1, count);
            let gone = began.elapsed().as_secs_f64();
            let own = BakeOptions {
                seed: hash_mix(hash_mix(options.seed, GROUP), k as u64),
                time_limit: options.time_limit.map(|limit| gone + (limit - gone).max(0.0) / (count - k) as f64),
                max_photons: options.max_photons.map(|most| most / count as u64),
                // Which sides are stored is known: all that is left counts.
                double_sided: DoubleSided::Split,
                ..options.clone()
            };
            let emitters = emitters(group);
            let path = LightPath { emitters: &emitters, ..path };
            let slot = keeping.as_mut().map(|keeping| keeping.slot(kind, &(k, group)));
            work(k, Part { path, weights: self.weights.clone(), options: &own, began, slot }, observer)?;
        }
        Ok(())
    }

    /// The light of all parts, each as `solve` finds it.
    ///
    /// # Errors
    /// As [`each`](Self::each).
    pub(super) fn sum(
        mut self,
        kind: &'static str,
        keeping: Option<&mut Keeping>,
        observer: &mut dyn Observer,
        solve: &mut PartWork<Solution>,
    ) -> Result<Solution, BakeError> {
        let (groups, mut sum) = (self.groups, None);
        self.each(kind, keeping, observer, &mut |k, part, observer| {
            let solved = solve(k, part, observer)?;
            let group = groups.get(k).map(|group| GroupSolution::new(group, &solved));
            let mut whole = match sum.take() {
                None => solved,
                Some(others) => Solution::plus(others, solved),
            };
            whole.groups.extend(group);
            sum = Some(whole);
            Ok(())
        })?;
        match sum {
            Some(sum) if groups.is_empty() => Ok(sum),
            Some(sum) => sum.whole(self, observer),
            None => Err(BakeError::Nothing("there is no part of the light to solve".into())),
        }
    }
}

impl GroupSolution {
    fn new(group: &LightGroup, solved: &Solution) -> GroupSolution {
        GroupSolution {
            group: group.clone(),
            light: (0..solved.weights.weight.len()).map(|i| solved.total.mean(i)).collect(),
            error: solved.error,
            mesh_percent: solved.mesh_percent,
            limit: solved.limit,
            audit: solved.audit,
            history: solved.history.clone(),
        }
    }
}

/// Solves each of the parts by itself, and adds them up.
///
/// # Errors
/// [`BakeError::Cancelled`] when the observer says so.
pub fn solve_groups(
    parts: Parts,
    keeping: Option<&mut Keeping>,
    observer: &mut dyn Observer,
) -> Result<Solution, BakeError> {
    parts.sum("light", keeping, observer, &mut |_, part, observer| solve(part, observer))
}

/// `weights` without the sides that are not stored. Where light decides, a look by all lights tells which these are: each
/// group by itself might choose others.
fn sides(
    path: LightPath,
    weights: TexelWeights,
    options: &BakeOptions,
    began: Instant,
    observer: &mut dyn Observer,
) -> Result<TexelWeights, BakeError> {
    let texels = &path.surface.texels;
    let has_backs = texels.texels[..texels.mapped].iter().any(|t| t.back);
    if options.double_sided == DoubleSided::Front {
        return Ok(stored_weights(path, &weights, options.double_sided, &Halves::default()));
    }
    if options.double_sided == DoubleSided::Split || !has_backs {
        return Ok(weights);
    }
    let one_round = BakeOptions {
        target_percent: f64::MAX,
        target_mesh_percent: Some(f64::MAX),
        audit: Audits::Off,
        ..options.clone()
    };
    let part = Part { path, weights, options: &one_round, began, slot: None };
    Ok(solve(part, observer)?.weights)
}

impl Solution {
    /// Light of both, but for what [`whole`](Self::whole) finds out of that.
    fn plus(mut self, other: Solution) -> Solution {
        let unit = match (self.unit, other.unit) {
            (a, b) if a <= 0.0 || b <= 0.0 => a.max(b),
            (a, b) => a.min(b),
        };
        let mut ledger = EnergyLedger::default();
        ledger += &self.ledger.in_steps(self.unit, unit);
        ledger += &other.ledger.in_steps(other.unit, unit);
        let brightest = self.groups.iter().map(|g| g.error.mean).fold(0.0, f64::max);
        if other.error.mean > brightest {
            self.cell_of = other.cell_of;
        }
        (0..2).for_each(|k| self.smoothed[k] += other.smoothed[k]);
        self.error = self.error.plus(&other.error);
        self.total = self.total.plus(&other.total);
        self.indirect = self.indirect.plus(&other.indirect);
        self.unsmoothed = self.unsmoothed.plus(&other.unsmoothed);
        self.caustics = match (self.caustics, other.caustics) {
            (Some(a), Some(b)) => {
                Some(Caustics { stored: a.stored.plus(&b.stored), everywhere: a.everywhere.plus(&b.everywhere) })
            }
            (a, b) => a.or(b),
        };
        self.biases = self.biases.iter().zip(&other.biases).map(|(a, b)| a.plus_alike(b)).collect();
        (0..2).for_each(|h| self.cells[h] += other.cells[h]);
        self.squares = self.squares + other.squares;
        self.by_photons += other.by_photons;
        self.limit = self.limit.or(other.limit);
        self.direct_samples += other.direct_samples;
        self.direct_rays += other.direct_rays;
        self.photons += other.photons;
        self.caustic_photons += other.caustic_photons;
        self.caustic_rays += other.caustic_rays;
        self.gather_rays += other.gather_rays;
        self.kept_rays += other.kept_rays;
        // Nodes that gather the light of one group gather that of others as a rule.
        self.gathered_meshes = self.gathered_meshes.max(other.gathered_meshes);
        self.reflected += other.reflected;
        self.back_flux.iter_mut().zip(&other.back_flux).for_each(|(sum, flux)| *sum += flux);
        (self.ledger, self.unit) = (ledger, unit);
        self.seconds = self.seconds.plus(&other.seconds);
        self
    }

    /// What is known of the sum as a whole, and what an audit of it by all lights says.
    fn whole(mut self, parts: Parts, observer: &mut dyn Observer) -> Result<Solution, BakeError> {
        let Parts { path, weights, options, began, .. } = parts;
        self.weights = weights;
        let (world, target) = (path.visibility.world, options.target_percent);
        (self.meshes, self.area_within_target) =
            mesh_errors(world, &self.total, &self.weights, &self.biases, self.error.mean, target);
        self.mesh_percent = percentile_95(&self.meshes);
        let late = || options.time_limit.is_some_and(|limit| began.elapsed().as_secs_f64() > limit);
        let started = Instant::now();
        observer.stage(Stage::Audit);
        let rays = self.rays();
        self.audit = audit(&path, &self, options, rays, &*observer, &late)?;
        if let Some(unseen) = self.found_unseen(self.photons) {
            self.error = self.error.raised(&unseen);
            if self.error.high > target {
                self.limit = self.limit.or(Some("audit"));
            }
        }
        // Each group may have spared other meshes.
        if self.mesh_percent > options.mesh_target() {
            self.limit = self.limit.or(Some("meshes"));
        }
        self.seconds.audit += started.elapsed().as_secs_f64();
        self.history = vec![HistoryEntry {
            direct_samples: self.direct_samples,
            photons: self.photons,
            rays,
            percent: self.error.percent,
            low: self.error.low,
            high: self.error.high,
            forecast_rays: rays as f64,
        }];
        let at = began.elapsed().as_secs_f64();
        self.rounds = vec![RoundSeconds { at, forecast: at, forecast_low: at, forecast_high: at }];
        Ok(self)
    }

    fn rays(&self) -> u64 {
        self.direct_rays + self.ledger.rays + self.caustic_rays + self.gather_rays
    }
}
