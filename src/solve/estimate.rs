//! What is known after a round: the irradiance of every texel, and how far it is from the truth.

use super::light::{Smooth, scattered};
use super::{LightPath, Solution, Solver, Squares, Surface};
use crate::accuracy::{Halves, Known, Missed, TexelWeights, mesh_errors, texel_error};
use crate::atlas::NO_CHART;
use crate::cell::{Bias, NO_CELL};
use crate::error::BakeError;
use crate::options::{DoubleSided, Smoothing, TexelValue};
use crate::report::percentile_95;
use glam::Vec3;

/// Bias is looked for in sixteenths of a cell: in quarters, a third of its square goes unseen.
const BIAS_DEPTH: u32 = 4;

/// ... or finer, in so many blocks: a cell may be a whole room.
const LEAST_BLOCKS: usize = 256;

/// ... and of a mesh, which has few cells, in quarters, where it drowns less in noise.
const MESH_BIAS_DEPTH: u32 = 2;

/// Direct light is smoothed over cells while its own noise is more than this share of the target, ...
const SMOOTH_WHILE: f64 = 0.35;

/// ... from when it is more than this one, ...
const SMOOTH_FROM: f64 = 0.7;

/// ... and where less than this share of the squared error is left; once it is smoothed, less than this one.
const SMOOTH_GAIN: f64 = 0.5;
const SMOOTH_KEEP: f64 = 0.9;

/// Direct light of all texels.
struct DirectLight {
    /// What each texel has by its own samples.
    apart: Halves,
    /// What is smoothed.
    soft: Option<Soft>,
}

/// Smoothed direct light.
struct Soft {
    light: Smooth,
    /// The same by texel.
    halves: Halves,
}

impl Solver<'_, '_> {
    /// Irradiance and errors as they stand.
    ///
    /// # Errors
    /// [`BakeError::Cancelled`].
    pub(super) fn solution(&mut self) -> Result<Solution, BakeError> {
        let LightPath { surface: Surface { open, tree, .. }, visibility, .. } = self.path;
        let instances = visibility.world.scene.instances.len();
        let caught = self.caught();
        let mut found = self.reconstruct(&caught);
        let caustic = self.caustic_light();
        let caustics = caustic.as_ref().map(|c| self.caustics(c));
        self.gather(&mut found, caustics.as_ref())?;
        let gathered = self.smooth_gathered(&mut found);
        let mut indirect = self.texel_halves(&found);
        if let Some(c) = &caustics {
            indirect = indirect.plus(&c.stored);
        }
        let DirectLight { apart, soft } = self.direct_light(&indirect);
        let direct = soft.as_ref().map_or_else(|| apart.clone(), |soft| apart.plus(&soft.halves));
        let total = direct.plus(&indirect);
        let weights = stored_weights(self.path, &self.weights, self.options.double_sided, &total);

        let weight = |k: usize| {
            let i = tree.elements[k].texel as usize;
            let smooth = soft.is_some() || caustic.is_some() || !self.has_gathered(weights.instance[i] as usize);
            (if smooth { self.open_weight(&weights, i) } else { 0.0 }, weights.instance[i])
        };
        let others: Vec<&Smooth> = soft.iter().map(|s| &s.light).chain(&caustic).collect();
        let smoothed = self.smoothed(&caught, &found, &others);
        let (mut whole_bias, mut biases) = (Bias::default(), vec![Bias::default(); instances]);
        if self.options.smoothing != Smoothing::None {
            let (compared, blocks) = (smoothed.compared(tree), &smoothed.blocks);
            let depth = BIAS_DEPTH.max(LEAST_BLOCKS.div_ceil(blocks.len().max(1)).next_power_of_two().ilog2());
            whole_bias = compared.bias(blocks, depth, |k| weight(k).0);
            if let Some(Soft { light, .. }) = &soft {
                // What averages out within blocks is seen where texels have samples of their own: edges of shadows.
                let fine = light.compared(tree).bias(&light.found.blocks, u32::MAX, |k| weight(k).0);
                let coarse = light.compared(tree).bias(blocks, depth, |k| weight(k).0);
                whole_bias.square += fine.square - coarse.square;
                whole_bias.variance = (whole_bias.variance - coarse.variance).max(0.0) + fine.variance;
            }
            biases = compared.biases(blocks, MESH_BIAS_DEPTH, instances, weight);
            whole_bias = gathered.biases.iter().fold(whole_bias, |all, b| all.plus(b));
        }
        let error = texel_error(&Known {
            direct: &direct,
            indirect: &indirect,
            total: &total,
            apart: &apart,
            weights: &weights,
            tree,
            blocks: &smoothed.blocks,
            bias: whole_bias,
            more_variance: gathered.variance,
            start_noise: self.start_noise(),
        });
        let error = self.course.unseen.map_or(error, |unseen| error.with(&unseen, self.diffuse.photons * 2));
        let (target, mesh_target) = (self.options.target_percent, self.options.mesh_target());
        let all_biases: Vec<Bias> = biases.iter().zip(&gathered.biases).map(|(a, b)| a.plus(b)).collect();
        let (meshes, area_within_target) =
            mesh_errors(visibility.world, &total, &weights, &all_biases, error.mean, target);
        let mesh_percent = percentile_95(&meshes);
        let parts = [soft.as_ref().map(|s| &s.halves), caustics.as_ref().map(|c| &c.stored)];
        let mut split = self.squares(&apart, parts, &indirect, &weights, &biases);
        split.iter_mut().zip(&gathered.biases).for_each(|(s, bias)| s.indirect += bias.likely());
        let squares = split.iter().fold(Squares::default(), |s, p| s + *p);
        let by_photons = (0..instances).filter(|&i| !self.has_gathered(i)).map(|i| split[i].indirect).sum();
        let rays_noise = self.gather_noise(&weights);
        let missed = meshes.iter().filter(|m| m.error_percent > mesh_target).map(|m| {
            let Squares { apart, soft, indirect, caustic } = split[m.instance];
            let square = (m.error_percent / mesh_target).powi(2) / (apart + soft + indirect + caustic).max(1e-300);
            let of_rays = rays_noise[m.instance] * gathered.left[m.instance].unwrap_or(1.0)
                + gathered.biases[m.instance].likely();
            Missed {
                instance: m.instance,
                direct: (apart + soft) * square,
                indirect: indirect * square,
                caustic: caustic * square,
                texels: m.texels,
                gathered: self.course.gathered[m.instance],
                of_rays: of_rays.min(indirect) * square,
                smooths: self.options.smoothing != Smoothing::None,
            }
        });
        let missed = missed.collect();
        // Flux of an integer step, of all photons of both halves.
        let step = 0.5 * self.diffuse.scale().step;
        Ok(Solution {
            unsmoothed: self.unsmoothed(&caught, caustic.as_ref()),
            total,
            indirect,
            caustics,
            weights,
            error,
            meshes,
            biases: all_biases,
            mesh_percent,
            area_within_target,
            cells: found.cells,
            cell_of: if found.cell_of.is_empty() {
                Vec::new()
            } else {
                scattered(&tree.elements, &found.cell_of, open.len(), NO_CELL)
            },
            smoothed: smoothed.energy(tree),
            squares,
            by_photons,
            missed,
            groups: Vec::new(),
            limit: None,
            audit: Err("audit: not asked for"),
            history: Vec::new(),
            rounds: Vec::new(),
            direct_samples: self.direct.all_samples(),
            direct_rays: self.direct.rays(),
            photons: self.diffuse.photons * 2,
            caustic_photons: self.caustics.photons * 2,
            caustic_rays: self.caustics.ledger.rays,
            gather_rays: self.gathering.rays,
            gathered_meshes: (0..instances).filter(|&i| self.has_gathered(i)).count(),
            kept_rays: self.earlier.rays,
            ledger: self.diffuse.ledger,
            reflected: self.diffuse.ledger.emitted.iter().sum::<i128>() as f64 * step,
            back_flux: self.bins.back_flux().into_iter().map(|flux| flux as f64 * step).collect(),
            unit: self.diffuse.flux.map_or(0.0, |f| f.unit),
            seconds: self.seconds.since(&self.earlier.seconds),
        })
    }

    /// Direct light, smoothed over cells where that is surely better than what the samples of each texel tell alone.
    fn direct_light(&mut self, indirect: &Halves) -> DirectLight {
        let Surface { tree, .. } = self.path.surface;
        let raw = self.direct_halves(false);
        let weight = &self.weights.weight;
        let noise = |halves: &Halves| -> f64 {
            let of = |i: usize| weight[i] * f64::from(halves.difference(i).length_squared()) / 3.0;
            (0..weight.len()).filter(|&i| weight[i] > 0.0).map(of).sum()
        };
        let light = |i: usize| weight[i] * f64::from((raw.mean(i) + indirect.mean(i)).element_sum()) / 3.0;
        let all: f64 = weight.iter().sum();
        let mean = (0..weight.len()).map(light).sum::<f64>() / all.max(1e-300);
        let raw_noise = noise(&raw);
        let under_sky = self.path.emitters.sky().is_some();
        let share = if self.course.smooths_direct == Some(true) || under_sky { SMOOTH_WHILE } else { SMOOTH_FROM };
        let allowed = all * (share * self.options.target_percent / 100.0 * mean).powi(2);
        // Under lamps alone a second look at a scene is much better than the first.
        let early = self.course.history.is_empty() && !under_sky;
        if raw_noise > allowed
            && !early
            && self.course.smooths_direct != Some(false)
            && let Some(light) = self.soft_light()
        {
            let soft = Soft { halves: self.texel_halves(&light.found), light };
            let apart = self.direct_halves(true);
            let texel_weight = |k: usize| weight[tree.elements[k].texel as usize];
            let bias = soft.light.compared(tree).bias(&soft.light.found.blocks, u32::MAX, texel_weight);
            let left = noise(&apart.plus(&soft.halves)) + bias.likely();
            let gain = if self.course.smooths_direct == Some(true) { SMOOTH_KEEP } else { SMOOTH_GAIN };
            let gains = left < gain * raw_noise;
            // The more samples there are, the less there is to gain; but those of the first round tell little.
            if gains || !self.course.history.is_empty() {
                self.course.smooths_direct = Some(gains);
            }
            if gains {
                return DirectLight { apart, soft: Some(soft) };
            }
        }
        DirectLight { apart: raw, soft: None }
    }

    /// Squared relative noise of the flux that photons start with. They start at direct samples: how far the halves
    /// are apart in it is noise of all indirect light that only direct samples lower.
    pub(super) fn start_noise(&self) -> f64 {
        let [odd, even] = self.diffuse.start_totals();
        if odd + even > 0.0 { ((odd - even) / (odd + even)).powi(2) } else { 0.0 }
    }

    /// Squared errors of each instance, times its weight, of `indirect` light with its caustics.
    fn squares(
        &self,
        apart: &Halves,
        [soft, caustic]: [Option<&Halves>; 2],
        indirect: &Halves,
        weights: &TexelWeights,
        biases: &[Bias],
    ) -> Vec<Squares> {
        let start_noise = self.start_noise();
        let mut sums = vec![(Squares::default(), 0.0); biases.len()];
        for i in (0..weights.weight.len()).filter(|&i| weights.weight[i] > 0.0) {
            let (sum, starts) = &mut sums[weights.instance[i] as usize];
            let square = |v: Vec3| weights.weight[i] * f64::from(v.length_squared()) / 3.0;
            sum.apart += square(apart.difference(i));
            sum.soft += soft.map_or(0.0, |s| square(s.difference(i)));
            let thrown = caustic.map_or(Vec3::ZERO, |c| c.difference(i));
            sum.caustic += square(thrown);
            sum.indirect += square(indirect.difference(i) - thrown);
            *starts += start_noise * square(indirect.mean(i));
        }
        let split = |(instance, ((sum, starts), bias)): (usize, ((Squares, f64), &Bias))| {
            let starts = sum.indirect.min(starts);
            let photons = sum.indirect - starts;
            // Bias is smoothed noise: of what is noisier there is more. What is gathered is not smoothed among photons:
            // called its own, the bias of direct light had photons asked for that could not lower it.
            let smooth = if self.has_gathered(instance) { 0.0 } else { photons };
            let noise = sum.soft + sum.caustic + smooth;
            // Without noise the bias is that of indirect light; a quotient would overflow in bright light.
            let per_noise = if noise > 0.0 { bias.likely() / noise } else { 0.0 };
            let [of_direct, of_caustic] = [sum.soft * per_noise, sum.caustic * per_noise];
            Squares {
                apart: sum.apart + starts,
                soft: sum.soft + of_direct,
                indirect: photons + bias.likely() - of_direct - of_caustic,
                caustic: sum.caustic + of_caustic,
            }
        };
        sums.into_iter().zip(biases).enumerate().map(split).collect()
    }

    /// Squared error that too few gather rays leave in each instance, times its weight.
    fn gather_noise(&self, weights: &TexelWeights) -> Vec<f64> {
        let mut sums = vec![0.0; self.course.gathered.len()];
        // In the order of the texels, so that the sums have the same bits on every run.
        for e in self.path.surface.tree.elements.iter().filter(|_| !self.gathering.kept.is_empty()) {
            let i = e.texel as usize;
            if let Some(halves) = weights.weight.get(i).and_then(|_| self.gathering.kept.get(&e.texel)) {
                let variance = halves.iter().map(|g| f64::from(g.variance)).sum::<f64>() / 4.0;
                sums[weights.instance[i] as usize] += weights.weight[i] * variance;
            }
        }
        sums
    }

    /// Weight of an error of the light of a texel's open part: a mean over buried area as well errs in that share alone.
    pub(super) fn open_weight(&self, weights: &TexelWeights, texel: usize) -> f64 {
        let whole = self.options.texel_value == TexelValue::Mean;
        let share = if whole { f64::from(self.path.surface.open[texel]).powi(2) } else { 1.0 };
        weights.weight[texel] * share
    }
}

/// `weights` with the sides that are not stored set to 0: where that is automatic, the darker side of each chart by its
/// light in `total`. The back of glass or of a leaf that is not double-sided receives light, but is not drawn, and never
/// stands for both.
pub(super) fn stored_weights(
    path: LightPath,
    weights: &TexelWeights,
    sides: DoubleSided,
    total: &Halves,
) -> TexelWeights {
    let LightPath { surface, visibility, .. } = path;
    let texels = &surface.texels.texels[..surface.texels.mapped];
    let drawn = |i: usize| {
        let piece = surface.texels.pieces_of(i).first();
        !texels[i].back || piece.is_some_and(|p| visibility.world.material(p.triangle).double_sided)
    };
    let mut weights = weights.clone();
    match sides {
        DoubleSided::Split => {}
        DoubleSided::Front => {
            (0..texels.len()).filter(|&i| texels[i].back).for_each(|i| weights.drop(i));
        }
        DoubleSided::Auto => {
            let charts = texels.iter().filter(|t| t.chart != NO_CHART).map(|t| t.chart as usize + 1).max().unwrap_or(0);
            let mut received = vec![[0f64; 2]; charts];
            for (i, t) in texels.iter().enumerate().filter(|&(i, _)| drawn(i)) {
                received[t.chart as usize][usize::from(t.back)] +=
                    f64::from(t.area) * f64::from(total.mean(surface.shown[i] as usize).element_sum());
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
