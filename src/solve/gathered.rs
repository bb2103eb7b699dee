//! Indirect light that meshes gather, for which photons are too slow, smoothed over cells of its own where that is
//! better.

use super::estimate::stored_weights;
use super::light::{Smooth, scattered};
use super::{Solver, Surface};
use crate::accuracy::{Caustics, GATHER_AGAIN, block_variance};
use crate::cell::{Bias, Caught, Element, Gather, Gathered, NO_CELL, Node, Reconstruction, SurfaceTree};
use crate::error::BakeError;
use crate::options::Smoothing;
use glam::Vec3;
use std::time::Instant;

/// Texels that gather between two looks at the clock.
const GATHER_CHUNK: usize = 4096;

/// What a mesh gathered is smoothed where less than this share of its squared error is left.
const SMOOTH_GAIN: f64 = 0.9;

impl Solver<'_, '_> {
    /// Replaces the indirect light of the meshes that gather it: of those that were to begin when time ran out,
    /// none that is not done.
    pub(super) fn gather(&mut self, found: &mut Reconstruction, caustics: Option<&Caustics>) -> Result<(), BakeError> {
        let started = Instant::now();
        let Surface { tree, open, .. } = self.path.surface;
        if self.diffuse.starts.is_none() || self.course.gathered.iter().all(|&n| n == 0) {
            return Ok(());
        }
        // Gathered once, light stays as it is until more rays are asked for or the map it came from is much better.
        let states: Vec<(u32, u64)> = self.course.gathered.iter().map(|&rays| (rays, self.diffuse.photons)).collect();
        let is_fresh = |i: usize| {
            let ((rays, photons), (had, at)) = (states[i], self.gathering.at[i]);
            rays > 0 && (had != rays || photons >= GATHER_AGAIN * at)
        };
        let instance = |texel: u32| self.weights.instance[texel as usize] as usize;
        let texels = tree.elements.iter().map(|e| (instance(e.texel), e.texel));
        let mut fresh: Vec<(usize, u32)> = texels.filter(|&(i, _)| is_fresh(i)).collect();
        fresh.sort_by_key(|f| f.0);
        let wanted: Vec<(u32, u32)> = fresh.iter().map(|&(i, texel)| (texel, states[i].0)).collect();
        let indirect = [0, 1].map(|h| scattered(&tree.elements, &found.values[h], open.len(), Vec3::ZERO));
        let blur = [0, 1].map(|h| scattered(&tree.elements, &found.sides[h], open.len(), 0.0));
        let mut began = Instant::now();
        self.seconds.gather += (began - started).as_secs_f64();
        // What is not done of a mesh is not kept.
        let mut done: Vec<[Gathered; 2]> = Vec::new();
        let mut rays = 0;
        for chunk in whole_meshes(&fresh) {
            if self.out_of_time() {
                break;
            }
            let Some(starts) = &self.diffuse.starts else { break };
            let gather = Gather {
                seed: self.options.seed,
                light: self.path.light(false),
                direct: &self.direct,
                starts,
                caustics: caustics.map(|c| [c.everywhere.odd.as_slice(), &c.everywhere.even]),
                indirect: [&indirect[0], &indirect[1]],
                blur: [&blur[0], &blur[1]],
            };
            let light = [0, 1].map(|h| gather.texels(h, &wanted[chunk.clone()]));
            done.extend(light[0].0.iter().zip(&light[1].0).map(|(odd, even)| [*odd, *even]));
            rays += light[0].1 + light[1].1;
            if fresh.get(chunk.end).is_none_or(|next| next.0 != fresh[chunk.end - 1].0) {
                let of_meshes = &fresh[chunk.end - done.len()..chunk.end];
                for (&(i, texel), light) in of_meshes.iter().zip(done.drain(..)) {
                    self.gathering.kept.insert(texel, light);
                    self.gathering.at[i] = states[i];
                }
                self.gathering.rays += std::mem::take(&mut rays);
            }
            self.seconds.gather += began.elapsed().as_secs_f64();
            self.pause()?;
            began = Instant::now();
        }
        self.gathering.rays += rays;
        let has_gathered = |e: &Element| self.has_gathered(self.weights.instance[e.texel as usize] as usize);
        for (k, e) in tree.elements.iter().enumerate().filter(|(_, e)| has_gathered(e)) {
            let light = self.gathering.kept[&e.texel];
            (0..2).for_each(|h| found.values[h][k] = light[h].light);
            if let Some(cell) = found.cell_of.get_mut(k) {
                *cell = NO_CELL;
            }
        }
        Ok(())
    }

    /// Whether the indirect light of an instance is gathered, not that of photons.
    pub(super) fn has_gathered(&self, instance: usize) -> bool {
        self.gathering.at[instance].0 > 0
    }

    /// Smooths what meshes gathered, which stands in `found`, over cells of its own. Among photons it would be lost: they
    /// tell much less, and cells would be as large as they need.
    pub(super) fn smooth_gathered(&self, found: &mut Reconstruction) -> SmoothGathered {
        let instances = self.course.gathered.len();
        let mut done = SmoothGathered::none(instances);
        let Surface { tree: all, open, .. } = self.path.surface;
        let instance = |e: &Element| self.weights.instance[e.texel as usize] as usize;
        let elements: Vec<Element> = all.elements.iter().filter(|e| self.has_gathered(instance(e))).copied().collect();
        if elements.is_empty() || self.options.smoothing == Smoothing::None {
            return done;
        }
        let tree = SurfaceTree::of(elements);
        let caught = [0, 1].map(|h| self.gathered_caught(&tree, h));
        let smooth = Reconstruction::new(&tree, [&caught[0], &caught[1]], self.path.visibility.accel);
        let light = Smooth { caught, found: smooth };
        let total = self.direct_halves(false).plus(&self.texel_halves(found));
        let weights = stored_weights(self.path, &self.weights, self.options.double_sided, &total);
        let weight = |k: usize| self.open_weight(&weights, tree.elements[k].texel as usize);
        // Bias is looked for texel by texel, as that of direct light.
        let (compared, blocks) = (light.compared(&tree), &light.found.blocks);
        let of = |k: usize| (weight(k), instance(&tree.elements[k]) as u32);
        let biases = compared.biases(blocks, u32::MAX, instances, of);
        // Squared noise before and after.
        let square = |k: usize, [odd, even]: [Vec3; 2]| weight(k) * f64::from((odd - even).length_squared()) / 12.0;
        let smooth = |k: usize| square(k, [0, 1].map(|h| light.found.values[h][k]));
        let mut noise = vec![[0.0; 2]; instances];
        for (k, e) in tree.elements.iter().enumerate() {
            let [before, after] = &mut noise[instance(e)];
            *before += square(k, self.gathering.kept[&e.texel].map(|g| g.light));
            *after += smooth(k);
        }
        for (i, [before, after]) in noise.into_iter().enumerate() {
            if after + biases[i].likely() < SMOOTH_GAIN * before {
                (done.biases[i], done.left[i]) = (biases[i], Some(after / before));
            }
        }
        let of_block = |b: &Node| -> f64 {
            let smoothed = b.elements.clone().filter(|&k| done.left[instance(&tree.elements[k])].is_some());
            block_variance(smoothed.map(smooth).sum())
        };
        done.variance = blocks.iter().map(of_block).sum();
        let values = [0, 1].map(|h| scattered(&tree.elements, &light.found.values[h], open.len(), Vec3::ZERO));
        for (k, e) in all.elements.iter().enumerate().filter(|(_, e)| done.left[instance(e)].is_some()) {
            (0..2).for_each(|h| found.values[h][k] = values[h][e.texel as usize]);
        }
        done
    }

    /// What the elements of `tree` gathered in one half.
    fn gathered_caught(&self, tree: &SurfaceTree, half: usize) -> Caught {
        let gathered = |e: &Element| self.gathering.kept[&e.texel][half];
        let variance = |e: &Element| {
            // Rays that agree by chance are not as good as they look.
            let n = f64::from(self.gathering.at[self.weights.instance[e.texel as usize] as usize].0);
            let likely = f64::from(gathered(e).light.length_squared()) / (3.0 * n * (n + 2.0));
            f64::from(gathered(e).variance).max(likely) * f64::from(e.area).powi(2)
        };
        Caught {
            flux: tree.elements.iter().map(|e| (gathered(e).light * e.area).to_array()).collect(),
            variance: tree.elements.iter().map(variance).collect(),
            // Detail that cells do not tell is noise here for the most part: rays are dear, and few.
            samples: None,
        }
    }
}

/// Ranges of (instance, texel), by instance, that are gathered between two looks at the clock: whole meshes, or a part of
/// one that is larger.
fn whole_meshes(fresh: &[(usize, u32)]) -> Vec<std::ops::Range<usize>> {
    let mut out = Vec::new();
    let mut start = 0;
    let mut at = 0;
    for mesh in fresh.chunk_by(|a, b| a.0 == b.0) {
        if at > start && at + mesh.len() - start > GATHER_CHUNK {
            out.push(start..at);
            start = at;
        }
        at += mesh.len();
        while at - start > GATHER_CHUNK {
            out.push(start..start + GATHER_CHUNK);
            start += GATHER_CHUNK;
        }
    }
    if at > start {
        out.push(start..at);
    }
    out
}

/// What smoothing did to the light that was gathered.
pub(super) struct SmoothGathered {
    /// Its bias for each instance.
    pub(super) biases: Vec<Bias>,
    /// Variance of the sum of its squared noise.
    pub(super) variance: f64,
    /// Share of the squared noise of each instance that is left; `None` where it is not smoothed.
    pub(super) left: Vec<Option<f64>>,
}

impl SmoothGathered {
    fn none(instances: usize) -> SmoothGathered {
        SmoothGathered { variance: 0.0, biases: vec![Bias::default(); instances], left: vec![None; instances] }
    }
}
