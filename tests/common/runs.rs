//! Figures of many bakes as independent samples.

use super::formulas::QuadMap;
use super::rooms::run;
use super::statistics::{mean_test, score, score_tests};
use evenlight::scene::Scene;
use evenlight::{Bake, BakeOptions};
use glam::{DVec3, Vec3};
use std::ops::Range;

/// Options under which a bake ends after its first round, whatever its error: 2 direct samples per texel and half,
/// at least 4096 photons per half. Nothing then depends on an estimate, and many bakes average to the truth.
pub fn one_round(page: u32) -> BakeOptions {
    super::rooms::plain(page, 1e9)
}

/// Figures of both halves of one bake per seed: `out[figure]` holds two independent samples for each seed.
/// `figures` is given a bake and the irradiance of its texels from one half.
pub fn samples<const N: usize>(
    scene: &Scene,
    options: &BakeOptions,
    seeds: Range<u64>,
    figures: impl Fn(&Bake, &[Vec3]) -> [f64; N],
) -> [Vec<f64>; N] {
    let mut out = std::array::from_fn(|_| Vec::new());
    for seed in seeds {
        let bake = run(scene, &BakeOptions { seed, ..options.clone() });
        for half in [&bake.solution.total.odd, &bake.solution.total.even] {
            for (to, x) in out.iter_mut().zip(figures(&bake, half)) {
                to.push(x);
            }
        }
    }
    out
}

/// Irradiance of every texel in both halves of one bake per seed: `out[texel]` holds two samples for each seed.
pub fn texel_samples(scene: &Scene, options: &BakeOptions, seeds: Range<u64>) -> Vec<Vec<Vec3>> {
    let mut out = Vec::new();
    for seed in seeds {
        let bake = run(scene, &BakeOptions { seed, ..options.clone() });
        out.resize(bake.texels.mapped, Vec::new());
        for half in [&bake.solution.total.odd, &bake.solution.total.even] {
            out.iter_mut().zip(half).for_each(|(to, e)| to.push(*e));
        }
    }
    out
}

/// Mean over the channels.
pub fn grey(e: Vec3) -> f64 {
    f64::from(e.element_sum()) / 3.0
}

/// Mean irradiance over the area of the texels that `keep` selects, per channel [lux].
pub fn area_mean(bake: &Bake, e: &[Vec3], keep: impl Fn(usize) -> bool) -> DVec3 {
    let (mut sum, mut area) = (DVec3::ZERO, 0.0);
    for i in (0..bake.texels.mapped).filter(|&i| keep(i)) {
        let a = f64::from(bake.texels.texels[i].area);
        sum += e[i].as_dvec3() * a;
        area += a;
    }
    assert!(area > 0.0, "no texel selected");
    sum / area
}

/// Mean irradiance over a node and the channels, front sides only [lux].
pub fn node_mean(bake: &Bake, e: &[Vec3], instance: usize) -> f64 {
    side_mean(bake, e, instance, false)
}

/// Mean irradiance over one side of a node and the channels [lux].
pub fn side_mean(bake: &Bake, e: &[Vec3], instance: usize, back: bool) -> f64 {
    let of_node =
        |i: usize| bake.solution.weights.instance[i] as usize == instance && bake.texels.texels[i].back == back;
    area_mean(bake, e, of_node).element_sum() / 3.0
}

/// Sum of irradiance times area over all texels of the map, mean of the channels [lux m2].
pub fn flux(bake: &Bake, e: &[Vec3]) -> f64 {
    let m2 = bake.world.frame.metres.powi(2);
    (0..bake.texels.mapped).map(|i| grey(e[i]) * f64::from(bake.texels.texels[i].area) * m2).sum()
}

/// Every texel of the first node, a quad, against the mean over the texel of `e(position, normal)`: the largest score of
/// all texels, and where the noise of the texels is independent (direct light), their mean and squares too.
pub fn expect_texels(what: &str, scene: &Scene, page: u32, seeds: u64, e: impl Fn(DVec3, DVec3) -> f64) {
    let quad = QuadMap::of(scene, 0, page);
    let places = run(scene, &one_round(page));
    let found = texel_samples(scene, &one_round(page), 0..seeds);
    let scores: Vec<f64> = (0..places.texels.mapped)
        .filter(|&i| places.solution.weights.instance[i] == 0)
        .map(|i| {
            let (_, x, y) = places.texels.page_position(i);
            let expected = quad.texel_mean(x, y, |p| e(p, quad.normal));
            score(&found[i].iter().map(|&e| grey(e)).collect::<Vec<_>>(), expected)
        })
        .collect();
    // Where the sampling is exact there is no noise to test.
    if scores.iter().any(|&z| z != 0.0)
        && let Err(e) = score_tests(&scores)
    {
        panic!("{what}: {e}");
    }
}

/// Means of the first node, a quad of 16 x 16 texels, over its blocks of 4 x 4 texels against those of `e`.
pub fn expect_blocks(scene: &Scene, page: u32, seeds: u64, e: impl Fn(DVec3) -> f64) {
    let quad = QuadMap::of(scene, 0, page);
    let block = |bake: &Bake, texel: usize| {
        let (_, x, y) = bake.texels.page_position(texel);
        let stands = bake.solution.weights.instance[texel] == 0 && !bake.texels.texels[texel].back;
        stands.then(|| ((y - quad.origin[1]) / 4 * 4 + (x - quad.origin[0]) / 4) as usize)
    };
    let blocks = samples(scene, &one_round(page), 0..seeds, |bake, e| {
        std::array::from_fn::<_, 16, _>(|k| grey(area_mean(bake, e, |i| block(bake, i) == Some(k)).as_vec3()))
    });
    for (k, found) in blocks.iter().enumerate() {
        let corner = [(k % 4) as f64 / 4.0, (k / 4) as f64 / 4.0];
        if let Err(e) = mean_test(found, quad.mean(corner, 0.25, 64, &e), 16) {
            panic!("block {k}: {e}");
        }
    }
}
