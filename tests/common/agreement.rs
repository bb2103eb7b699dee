//! The bake against the tests' path tracer on random texels.

use super::formulas::QuadMap;
use super::path_tracer::{Fault, PathTracer};
use super::random::Random;
use super::rooms::run;
use super::runs::texel_samples;
use super::statistics::{mean_and_error, welch_score};
use evenlight::BakeOptions;
use evenlight::scene::Scene;
use glam::DVec3;

/// How many texels are compared.
pub const TEXELS: usize = 200;

/// Normal scores of the difference between bake and path tracer on [`TEXELS`] random texels of `scene`, which holds
/// quads only, and the mean relative standard error of a difference. The channel is drawn at random too; each texel
/// gets `paths` paths, each from a point of its own, uniform over the texel.
pub fn scores(scene: &Scene, options: &BakeOptions, seeds: u64, paths: usize, fault: Fault) -> (Vec<f64>, f64) {
    let layout = run(scene, options);
    let baked = texel_samples(scene, options, 0..seeds);
    let tracer = PathTracer::new(scene, fault);
    let mut random = Random::new(77);
    let (mut scores, mut noise) = (Vec::new(), 0.0);
    for _ in 0..TEXELS {
        let i = random.below(layout.texels.mapped);
        let channel = random.below(3);
        let quad = QuadMap::of(scene, layout.solution.weights.instance[i] as usize, options.max_texture);
        let normal = if layout.texels.texels[i].back { -quad.normal } else { quad.normal };
        let (_, x, y) = layout.texels.page_position(i);
        let traced: Vec<f64> = (0..paths)
            .map(|_| {
                let p = quad.point(x, y, random.unit(), random.unit());
                let e: DVec3 = tracer.irradiance(p, normal, &mut random);
                e[channel]
            })
            .collect();
        let own: Vec<f64> = baked[i].iter().map(|e| f64::from(e[channel])).collect();
        match welch_score(&own, &traced) {
            None => assert_eq!(own[0], traced[0], "texel {i} has no noise"),
            Some(z) => {
                scores.push(z);
                let ((_, a), (mean, b)) = (mean_and_error(&own), mean_and_error(&traced));
                noise += a.hypot(b) / mean / TEXELS as f64;
            }
        }
    }
    (scores, noise)
}
