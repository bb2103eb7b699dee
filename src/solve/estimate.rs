//! What is known after a round: the irradiance of every texel, and how far it is from the truth.

use super::{LightPath, Solution, Solver};
use crate::accuracy::{GATHER_AGAIN, Halves, Known, Missed, TexelWeights, mesh_errors, texel_error};
use crate::atlas::NO_CHART;
use crate::cell::{Bias, Element, ElementFlux, Gather, NO_CELL, Reconstruction, bias};
use crate::error::BakeError;
use crate::options::{DoubleSided, Smoothing, TexelValue};
use crate::report::percentile_95;
use glam::Vec3;
use rayon::prelude::*;

/// Bias is looked for in sixteenths of a cell: in quarters, a third of its square goes unseen.
const BIAS_DEPTH: u32 = 4;

/// ... and of a mesh, which has few cells, in quarters, where it drowns less in noise.
const MESH_BIAS_DEPTH: u32 = 2;

/// Texels that gather between two looks at the clock.
const GATHER_CHUNK: usize = 4096;

impl Solver<'_, '_> {
    /// Irradiance and errors as they stand.
    ///
    /// # Errors
    /// [`BakeError::Cancelled`].
    pub(super) fn solution(&mut self) -> Result<Solution, BakeError> {
        let LightPath { open, tree, visibility, .. } = self.path;
        let instances = visibility.world.scene.instances.len();
        let direct = self.direct_halves();
        let caught = self.caught();
        let mut found = self.reconstruct(&caught);
        self.gather(&mut found)?;
        let indirect = self.indirect_halves(&found);
        let add = |a: &[Vec3], b: &[Vec3]| a.par_iter().zip(b).map(|(a, b)| *a + *b).collect::<Vec<_>>();
        let total = Halves { odd: add(&direct.odd, &indirect.odd), even: add(&direct.even, &indirect.even) };
        let weights = self.stored_weights(&total);

        let whole = self.options.texel_value == TexelValue::Mean;
        let weight = |k: usize| {
            let i = tree.elements[k].texel as usize;
            // A mean over buried area as well errs in its open share alone.
            let share = if whole { f64::from(open[i]).powi(2) } else { 1.0 };
            (weights.weight[i] * share, weights.instance[i])
        };
        let biases = |depth: u32| match self.options.smoothing {
            Smoothing::Cells => bias(tree, [&caught[0], &caught[1]], &found, instances, depth, weight),
            Smoothing::None => vec![Bias::default(); instances + 1],
        };
        let whole_bias = biases(BIAS_DEPTH)[instances];
        let mut biases = biases(MESH_BIAS_DEPTH);
        // What is gathered is not smoothed.
        let gathered = biases.iter_mut().zip(&self.gathered_at).filter(|(_, at)| at.0 > 0);
        gathered.for_each(|(b, _)| *b = Bias::default());
        let error = texel_error(&Known {
            direct: &direct,
            indirect: &indirect,
            total: &total,
            weights: &weights,
            tree,
            blocks: &found.blocks,
            bias: whole_bias,
        });
        let (target, mesh_target) = (self.options.target_percent, self.options.mesh_target());
        let (meshes, area_within_target) = mesh_errors(visibility.world, &total, &weights, &biases, error.mean, target);
        let mesh_percent = percentile_95(&meshes);
        let split = self.squares(&direct, &indirect, &weights, &biases);
        let squares = split.iter().fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
        let rays_noise = self.gather_noise(&weights);
        let missed = meshes.iter().filter(|m| m.error_percent > mesh_target).map(|m| {
            let (a, b) = split[m.instance];
            let square = (m.error_percent / mesh_target).powi(2) / (a + b).max(1e-300);
            Missed {
                instance: m.instance,
                direct: a * square,
                indirect: b * square,
                texels: m.texels,
                gathered: self.gathered[m.instance],
                of_rays: rays_noise[m.instance].min(b) * square,
            }
        });
        let missed = missed.collect();
        let flux = |values: &[Vec3]| -> f64 {
            let of = |(e, v): (&Element, &Vec3)| f64::from(e.area) * f64::from(v.element_sum());
            tree.elements.iter().zip(values).map(of).sum()
        };
        let kept: f64 = found.values.iter().map(|v| flux(v)).sum();
        let all: f64 = caught.iter().flatten().flatten().map(|&f| f64::from(f)).sum();
        Ok(Solution {
            total,
            weights,
            error,
            meshes,
            mesh_percent,
            area_within_target,
            cells: found.cells,
            cell_of: if found.cell_of.is_empty() {
                Vec::new()
            } else {
                scattered(&tree.elements, &found.cell_of, open.len(), NO_CELL)
            },
            energy_change: if all > 0.0 { kept / all - 1.0 } else { 0.0 },
            squares,
            missed,
            limit: None,
            history: Vec::new(),
            rounds: Vec::new(),
            direct_samples: self.direct.samples(),
            direct_rays: self.direct.rays(),
            gather_rays: self.gather_rays,
            gathered_meshes: self.gathered_at.iter().filter(|at| at.0 > 0).count(),
            ledger: self.ledger,
            back_flux: self.bins.back_flux(),
            unit: self.flux.map_or(0.0, |f| f.unit),
            seconds: self.seconds,
        })
    }

    /// Squared errors of each instance, times its weight: what more direct samples would lower, and what more
    /// photons would.
    ///
    /// Photons start at direct samples: how far the start fluxes of the halves are apart is noise of all indirect
    /// light that only direct samples lower.
    fn squares(&self, direct: &Halves, indirect: &Halves, weights: &TexelWeights, biases: &[Bias]) -> Vec<(f64, f64)> {
        let [odd, even] = self.start_totals();
        let start_noise = if odd + even > 0.0 { ((odd - even) / (odd + even)).powi(2) } else { 0.0 };
        let mut sums = vec![[0f64; 3]; biases.len() - 1];
        for i in (0..weights.weight.len()).filter(|&i| weights.weight[i] > 0.0) {
            let (w, sum) = (weights.weight[i], &mut sums[weights.instance[i] as usize]);
            sum[0] += w * f64::from(direct.difference(i).length_squared()) / 3.0;
            sum[1] += w * f64::from(indirect.difference(i).length_squared()) / 3.0;
            sum[2] += w * start_noise * f64::from(indirect.mean(i).length_squared()) / 3.0;
        }
        let split = |([direct, indirect, starts], bias): ([f64; 3], &Bias)| {
            let starts = indirect.min(starts);
            (direct + starts, indirect - starts + bias.likely())
        };
        sums.into_iter().zip(biases).map(split).collect()
    }

    /// Squared error that too few gather rays leave in each instance, times its weight.
    fn gather_noise(&self, weights: &TexelWeights) -> Vec<f64> {
        let mut sums = vec![0.0; self.gathered.len()];
        // In the order of the texels, so that the sums have the same bits on every run.
        for e in self.path.tree.elements.iter().filter(|_| !self.kept.is_empty()) {
            let i = e.texel as usize;
            if let Some(halves) = weights.weight.get(i).and_then(|_| self.kept.get(&e.texel)) {
                let variance = halves.iter().map(|g| f64::from(g.variance)).sum::<f64>() / 4.0;
                sums[weights.instance[i] as usize] += weights.weight[i] * variance;
            }
        }
        sums
    }

    fn direct_halves(&self) -> Halves {
        let (direct, open) = (&self.direct, self.path.open);
        let whole = self.options.texel_value == TexelValue::Mean;
        let half = |h| {
            (0..open.len())
                .into_par_iter()
                .map(|i| direct.stored(h, i) * if whole { 1.0 } else { per_open(open[i]) })
                .collect()
        };
        Halves { odd: half(0), even: half(1) }
    }

    /// Flux that each element caught, in two halves.
    fn caught(&self) -> [ElementFlux; 2] {
        let elements = &self.path.tree.elements;
        let per_photon = self.flux.map_or(0.0, |f| f.unit / self.photons.max(1) as f64);
        [0, 1].map(|h| {
            let of = |texel: u32| self.bins.flux(h, texel as usize).map(|f| (f as f64 * per_photon) as f32);
            elements.par_iter().map(|e| of(e.texel)).collect()
        })
    }

    /// Irradiance of the elements from what they caught.
    fn reconstruct(&self, caught: &[ElementFlux; 2]) -> Reconstruction {
        let LightPath { tree, visibility, .. } = self.path;
        let [odd, even] = self.start_totals();
        let (caught, photon) = ([&caught[0], &caught[1]], odd.max(even) / self.photons.max(1) as f64);
        match self.options.smoothing {
            Smoothing::Cells => Reconstruction::new(tree, caught, photon, visibility.accel),
            Smoothing::None => Reconstruction::raw(tree, caught),
        }
    }

    /// Replaces the indirect light of the meshes that gather it: of those that were to begin when time ran out,
    /// none that is not done.
    fn gather(&mut self, found: &mut Reconstruction) -> Result<(), BakeError> {
        let LightPath { tree, open, .. } = self.path;
        let Some(starts) = self.starts.as_ref().filter(|_| self.gathered.iter().any(|&n| n > 0)) else { return Ok(()) };
        // Gathered once, light stays as it is until more rays are asked for or the map it came from is much better.
        let fresh: Vec<(usize, (u32, u64))> = (0..self.gathered.len())
            .filter(|&i| self.gathered[i] > 0)
            .map(|i| (i, (self.gathered[i], self.photons)))
            .filter(|&(i, (rays, photons))| {
                let (had, at) = self.gathered_at[i];
                had != rays || photons >= GATHER_AGAIN * at
            })
            .collect();
        let mut again = vec![false; self.gathered.len()];
        fresh.iter().for_each(|f| again[f.0] = true);
        let instance = |texel: u32| self.weights.instance[texel as usize] as usize;
        let wanted: Vec<(u32, u32)> = tree
            .elements
            .iter()
            .filter(|e| again[instance(e.texel)])
            .map(|e| (e.texel, self.gathered[instance(e.texel)]))
            .collect();
        let indirect = [0, 1].map(|h| scattered(&tree.elements, &found.values[h], open.len(), Vec3::ZERO));
        let blur = [0, 1].map(|h| scattered(&tree.elements, &found.sides[h], open.len(), 0.0));
        let gather = Gather {
            seed: self.options.seed,
            light: self.path.light(false),
            direct: &self.direct,
            starts,
            indirect: [&indirect[0], &indirect[1]],
            blur: [&blur[0], &blur[1]],
        };
        let mut done = true;
        for wanted in wanted.chunks(GATHER_CHUNK) {
            if self.observer.cancelled() {
                return Err(BakeError::Cancelled);
            }
            if self.out_of_time() {
                done = false;
                break;
            }
            let light = [0, 1].map(|h| gather.texels(h, wanted));
            for (j, &(texel, _)) in wanted.iter().enumerate() {
                self.kept.insert(texel, [light[0].0[j], light[1].0[j]]);
            }
            self.gather_rays += light[0].1 + light[1].1;
        }
        if done {
            fresh.iter().for_each(|&(instance, state)| self.gathered_at[instance] = state);
        }
        let gathers = |e: &Element| self.gathered_at[instance(e.texel)].0 > 0;
        for (k, e) in tree.elements.iter().enumerate().filter(|(_, e)| gathers(e)) {
            let light = self.kept[&e.texel];
            (0..2).for_each(|h| found.values[h][k] = light[h].light);
            if let Some(cell) = found.cell_of.get_mut(k) {
                *cell = NO_CELL;
            }
        }
        Ok(())
    }

    /// Indirect light of the texels in two halves.
    fn indirect_halves(&self, found: &Reconstruction) -> Halves {
        let LightPath { tree, open, .. } = self.path;
        let whole = self.options.texel_value == TexelValue::Mean;
        let [odd, even] = [0, 1].map(|h| {
            let mut out = scattered(&tree.elements, &found.values[h], open.len(), Vec3::ZERO);
            if whole {
                out.iter_mut().zip(open).for_each(|(e, open)| *e *= *open);
            }
            out
        });
        Halves { odd, even }
    }

    /// Weights with the sides that are not stored set to 0.
    fn stored_weights(&self, total: &Halves) -> TexelWeights {
        let texels = &self.path.texels.texels[..self.path.texels.mapped];
        let mut weights = self.weights.clone();
        match self.options.double_sided {
            DoubleSided::Split => {}
            DoubleSided::Front => {
                (0..texels.len()).filter(|&i| texels[i].back).for_each(|i| weights.drop(i));
            }
            DoubleSided::Auto => {
                let charts =
                    texels.iter().filter(|t| t.chart != NO_CHART).map(|t| t.chart as usize + 1).max().unwrap_or(0);
                let mut received = vec![[0f64; 2]; charts];
                for (i, t) in texels.iter().enumerate() {
                    received[t.chart as usize][usize::from(t.back)] +=
                        f64::from(t.area) * f64::from(total.mean(self.path.shown[i] as usize).element_sum());
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
}

/// Factor from flux over the whole area to flux over the open area; 0 where nothing is open.
fn per_open(open: f32) -> f32 {
    if open > 0.0 { 1.0 / open } else { 0.0 }
}

/// Values of elements at the places of their texels, `none` elsewhere.
fn scattered<T: Copy>(elements: &[Element], values: &[T], texels: usize, none: T) -> Vec<T> {
    let mut out = vec![none; texels];
    elements.iter().zip(values).for_each(|(e, v)| out[e.texel as usize] = *v);
    out
}
