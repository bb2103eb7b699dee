//! Whether the error that a bake states is the error that it has.

mod common;

use common::formulas::{QuadMap, point_irradiance};
use common::random::Random;
use common::rooms::{Builder, plain, run};
use common::runs::one_round;
use common::statistics::{expect_mean, mean_and_error, mean_test, normal_upper_quantile};
use evenlight::BakeOptions;
use evenlight::accuracy::{Illuminance, Part};
use evenlight::options::Smoothing;
use evenlight::scene::Scene;
use glam::DVec3;

const PAGE: u32 = 64;

/// A room with a lamp and a point light, coloured walls: 6 x 64 + 6 x 9 texels.
fn room() -> Scene {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(0.6, 0.0);
    b.room(glam::Vec3::ZERO, glam::Vec3::new(3.0, 2.0, 4.0), wall, 8);
    let lamp = b.diffuse(0.5, 20.0);
    b.solid(glam::Vec3::new(1.0, 1.25, 1.0), glam::Vec3::new(1.5, 1.5, 2.0), lamp, 3);
    b.point_light(glam::Vec3::new(2.0, 1.0, 3.0), 10.0);
    b.finish()
}

/// What a seed stores and states.
struct Trial {
    irradiance: Vec<DVec3>,
    sigma: f64,
    interval: [f64; 2],
}

fn trials(scene: &Scene, options: &BakeOptions, seeds: u64) -> (Vec<Trial>, Vec<f64>) {
    let mut weights = Vec::new();
    let trials = (0..seeds)
        .map(|seed| {
            let bake = run(scene, &BakeOptions { seed, ..options.clone() });
            assert_eq!(bake.report.sigma_paper, 2.0 * bake.report.sigma);
            weights = bake.solution.weights.weight.clone();
            Trial {
                irradiance: (0..weights.len()).map(|i| bake.solution.total.mean(i).as_dvec3()).collect(),
                sigma: bake.report.sigma,
                interval: bake.report.texel_error_interval,
            }
        })
        .collect();
    (trials, weights)
}

/// Mean over the trials, texel by texel.
fn centre(trials: &[Trial]) -> Vec<DVec3> {
    let n = trials.len() as f64;
    (0..trials[0].irradiance.len()).map(|i| trials.iter().map(|t| t.irradiance[i]).sum::<DVec3>() / n).collect()
}

/// Mean over area and channels of the squared distance to `truth`, in percent squared of the mean of `truth`.
fn square_error(e: &[DVec3], truth: &[DVec3], weights: &[f64]) -> f64 {
    let (mut square, mut mean, mut weight) = (0.0, 0.0, 0.0);
    for ((e, t), w) in e.iter().zip(truth).zip(weights) {
        square += w * (*e - *t).length_squared() / 3.0;
        mean += w * t.element_sum() / 3.0;
        weight += w;
    }
    1e4 * square / weight / (mean / weight).powi(2)
}

/// sigma^2 of the report against the scatter of 200 seeds, and how often the interval holds the scatter's root.
///
/// Each trial gives the difference of its stated variance and its own squared distance from the mean of all; their
/// mean must be 0. With 200 trials a wrong factor of 1.1 on the variance is seen.
#[test]
fn sigma_is_the_scatter_of_many_seeds() {
    let scene = room();
    for (what, options) in [
        ("one round", one_round(PAGE)),
        ("several rounds", BakeOptions { max_photons: Some(1 << 15), ..plain(PAGE, 4.0) }),
    ] {
        let (trials, weights) = trials(&scene, &options, 200);
        let truth = centre(&trials);
        // The mean of all trials shares a 1 / n of its noise with each of them.
        let n = trials.len() as f64;
        let errors: Vec<f64> =
            trials.iter().map(|t| square_error(&t.irradiance, &truth, &weights) * n / (n - 1.0)).collect();
        let scatter = mean_and_error(&errors).0;
        let ratios: Vec<f64> = trials.iter().zip(&errors).map(|(t, e)| 1.0 + (t.sigma.powi(2) - e) / scatter).collect();
        println!("{what}: scatter {:.3} %, ratio {:?}", scatter.sqrt(), mean_and_error(&ratios));
        expect_mean(what, &ratios, 1.0, 0.1, 1);

        let covered = trials.iter().filter(|t| t.interval[0] <= scatter.sqrt() && scatter.sqrt() <= t.interval[1]);
        let covered = covered.count() as f64 / n;
        println!("{what}: interval holds the truth in {:.1} %", 100.0 * covered);
        let allowed = normal_upper_quantile(1e-6) * (0.95 * 0.05 / n).sqrt();
        assert!((covered - 0.95).abs() <= allowed, "{what}: {covered}");
    }
}

/// A bake that ends at its target has at most that error in most seeds: the target bounds the upper end of the 95 %
/// interval, so the error itself lies under it in all but about 2.5 % (and more often, since bakes overshoot).
#[test]
fn the_target_is_kept() {
    let scene = room();
    let options = plain(PAGE, 4.0);
    let (trials, weights) = trials(&scene, &options, 60);
    // The mean of all: its own error is an eighth of a single one's.
    let truth = centre(&trials);
    let errors: Vec<f64> = trials.iter().map(|t| square_error(&t.irradiance, &truth, &weights).sqrt()).collect();
    assert!(trials.iter().all(|t| t.interval[1] <= 4.0));
    let kept = errors.iter().filter(|&&e| e <= 4.0).count();
    println!("kept in {kept} of {}, mean error {:?}", errors.len(), mean_and_error(&errors));
    assert!(kept as f64 >= 0.9 * errors.len() as f64, "kept in {kept} of {}", errors.len());
    // Neither may a bake work on long after the target is met.
    assert!(mean_and_error(&errors).0 > 2.0);
}

/// Stopping at the target does not bias the mean.
#[test]
fn stopping_does_not_bias() {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(0.5, 0.0);
    b.room(glam::Vec3::ZERO, glam::Vec3::new(3.0, 2.0, 4.0), wall, 8);
    b.point_light(glam::Vec3::new(2.0, 1.0, 3.0), 10.0);
    let scene = b.finish();
    let [flux] = common::runs::samples(&scene, &plain(PAGE, 4.0), 0..40, |bake, e| [common::runs::flux(bake, e)]);
    expect_mean("flux", &flux, 4.0 * std::f64::consts::PI * 10.0 / 0.5, 0.01, 1);
}

/// Photons of equal weight that fall evenly on equal texels: the deposits on a texel follow Poisson's law, and the
/// squared relative error of the indirect light is the number of texels over the number of deposits. Photons from
/// one low-discrepancy net scatter less, but not where a net has hardly more photons than there are texels.
#[test]
fn indirect_error_follows_the_law_of_poisson() {
    let mut b = Builder::new(128);
    // A point light in the middle of a sphere: the same irradiance everywhere.
    let wall = b.diffuse(0.75, 0.0);
    b.inner_sphere(1.0, 2, wall, 2);
    b.point_light(glam::Vec3::ZERO, 10.0);
    let scene = b.finish();
    let figures: Vec<f64> = (0..40)
        .map(|seed| {
            let bake = run(&scene, &BakeOptions { seed, ..one_round(128) });
            let indirect = bake.solution.error.indirect / 100.0 / 0.75;
            // A texel of area a expects a share a of the deposits, and its error counts with weight a: whatever
            // the areas, the law has the number of texels.
            indirect.powi(2) * bake.report.work.deposits as f64 / bake.texels.mapped as f64
        })
        .collect();
    println!("{:?}", mean_and_error(&figures));
    let (mean, _) = mean_and_error(&figures);
    mean_test(&figures, mean.clamp(0.85, 1.05), 1).expect("variance of counts");
}

/// A target that no work can meet ends the bake with the name of what is exhausted.
#[test]
fn work_that_cannot_grow_ends() {
    let mut b = Builder::new(PAGE);
    let black = b.diffuse(0.0, 0.0);
    b.quad("floor", glam::Vec3::ZERO, glam::Vec3::Z, glam::Vec3::X, black, [1, 2]);
    b.point_light(glam::Vec3::new(0.2, 0.1, 0.3), 10.0);
    let scene = b.finish();
    let bake = run(&scene, &plain(PAGE, 1e-6));
    assert_eq!((bake.report.target_met, bake.report.limit), (false, Some("samples")));
}

/// Figures of illuminance, their errors and the truth.
fn figures(found: &Illuminance, truth: [f64; 3]) -> [[f64; 3]; 4] {
    let uniformity = found.uniformity.zip(found.uniformity_error).expect("light");
    [
        [found.mean, found.mean_error, truth[0]],
        [found.minimum, found.minimum_error, truth[1]],
        [found.maximum, found.maximum_error, truth[2]],
        [uniformity.0, uniformity.1, truth[1] / truth[0]],
    ]
}

/// At most this share of the figures may be more than two of their standard errors off: for known Gaussian errors 4.6 %
/// are, for those that about ten degrees of freedom tell 7.3 %.
const BEYOND_TWO: f64 = 0.1;

/// Rejects, in one of a million cases wrongly, that no more than [`BEYOND_TWO`] of independent figures are beyond two.
#[track_caller]
fn expect_covered(what: &str, figures: &[[f64; 3]]) {
    let n = figures.len() as f64;
    let beyond = figures.iter().filter(|[found, error, truth]| (found - truth).abs() > 2.0 * error + 1e-5 * truth);
    let share = beyond.count() as f64 / n;
    let allowed = BEYOND_TWO + normal_upper_quantile(1e-6) * (BEYOND_TWO * (1.0 - BEYOND_TWO) / n).sqrt();
    println!("{what}: {share:.3} of {n} beyond two standard errors, {allowed:.3} allowed");
    assert!(share <= allowed, "{what}: {share} of {n} beyond two standard errors");
}

/// Values without light transport: on a slope, which has its least patch in one place, and on a plateau, where noise
/// alone picks it. The least of the noisy values is far too low on the plateau; what the other half says of it is not.
#[test]
fn illuminance_of_noisy_values() {
    for slope in [0.0, 0.02] {
        let mut random = Random::new(7);
        let (mut all, mut naive) = (vec![Vec::new(); 4], Vec::new());
        for _ in 0..400 {
            let mut parts = Vec::new();
            for i in 0..64 * 9 {
                let e = 10.0 + slope * f64::from(i / 9);
                let raw = [0; 2].map(|_| e + 1.5 * random.normal());
                parts.push(Part { patch: i as usize / 9, area: 1.0 / 9.0, smooth: raw, raw });
            }
            let found = Illuminance::new(&parts, 1.0).expect("texels");
            assert_eq!((found.patches, found.patch_width), (64, 1.0));
            let top = 10.0 + slope * 63.0;
            let truth = [0.5 * (10.0 + top), 10.0, top];
            all.iter_mut().zip(figures(&found, truth)).for_each(|(to, f)| to.push(f));
            let patch = |p: &[Part]| p.iter().map(|p| 0.5 * (p.raw[0] + p.raw[1])).sum::<f64>() / 9.0;
            naive.push(parts.chunks(9).map(patch).fold(f64::INFINITY, f64::min) - 10.0);
        }
        all.iter().zip(["mean", "minimum", "maximum", "uniformity"]).for_each(|(f, what)| expect_covered(what, f));
        if slope == 0.0 {
            let least: Vec<f64> = all[1].iter().map(|f| f[0]).collect();
            expect_mean("minimum of a plateau", &least, 10.0, 0.02, 1);
            assert!(mean_and_error(&naive).0 < -0.5, "the least of noisy values is too low");
        }
    }
}

/// A point light over a floor: patches of 2 x 2 of its 16 x 16 texels, against quadrature over each.
#[test]
fn illuminance_under_a_point_light() {
    let mut b = Builder::new(PAGE);
    let grey = b.diffuse(0.5, 0.0);
    b.quad("floor", glam::Vec3::new(-2.0, 0.0, -2.0), glam::Vec3::Z * 4.0, glam::Vec3::X * 4.0, grey, [16; 2]);
    let at = DVec3::new(0.3, 1.0, -0.7);
    b.point_light(at.as_vec3(), 100.0);
    let scene = b.finish();
    let quad = QuadMap::of(&scene, 0, PAGE);
    let e = |p| point_irradiance(p, quad.normal, at, 100.0);
    let patch = |k: i32| quad.mean([f64::from(k % 8) / 8.0, f64::from(k / 8) / 8.0], 0.125, 64, e);
    let patches: Vec<f64> = (0..64).map(patch).collect();
    let least = patches.iter().copied().fold(f64::INFINITY, f64::min);
    let truth = [patches.iter().sum::<f64>() / 64.0, least, patches.iter().copied().fold(0.0, f64::max)];
    let mut all = vec![Vec::new(); 4];
    for seed in 0..60 {
        let bake = run(&scene, &BakeOptions { seed, ..one_round(PAGE) });
        let found = bake.report.meshes[0].illuminance.expect("light");
        assert_eq!(found.patches, 64);
        assert!((found.patch_width - 0.5).abs() < 1e-5);
        all.iter_mut().zip(figures(&found, truth)).for_each(|(to, f)| to.push(f));
    }
    all.iter().zip(["mean", "minimum", "maximum", "uniformity"]).for_each(|(f, what)| expect_covered(what, f));
    let minimum: Vec<f64> = all[1].iter().map(|f| f[0]).collect();
    expect_mean("minimum", &minimum, truth[1], 0.02, 1);
}

/// A furnace is lit evenly: U0 is 1, in every mesh, smoothed or not.
#[test]
fn illuminance_of_a_furnace() {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(0.5, 2.0);
    b.room(glam::Vec3::ZERO, glam::Vec3::new(2.0, 4.0, 3.0), wall, 8);
    let scene = b.finish();
    let e = std::f64::consts::PI * 2.0 / 0.5;
    for smoothing in [Smoothing::None, Smoothing::Cells] {
        let mut all = vec![Vec::new(); 4];
        for seed in 0..12 {
            let bake = run(&scene, &BakeOptions { seed, smoothing, ..one_round(PAGE) });
            for mesh in &bake.report.meshes {
                let found = figures(&mesh.illuminance.expect("light"), [e; 3]);
                all.iter_mut().zip(found).for_each(|(to, f)| to.push(f));
            }
        }
        all.iter().zip(["mean", "minimum", "maximum", "uniformity"]).for_each(|(f, what)| expect_covered(what, f));
    }
}

/// Smoothing lightens dark corners: with the bias that it has on the whole as the error of a minimum, 22 % of those of
/// the walls here were more than two standard errors off.
#[test]
fn illuminance_of_smoothed_walls() {
    let scene = room();
    let truth = run(&scene, &BakeOptions { seed: 99, ..plain(PAGE, 0.7) });
    let mut all = vec![Vec::new(); 4];
    for seed in 0..12 {
        let bake = run(&scene, &BakeOptions { seed, smoothing: Smoothing::Cells, ..plain(PAGE, 5.0) });
        for (mesh, truth) in bake.report.meshes.iter().zip(&truth.report.meshes).filter(|m| m.0.texels == 64) {
            let truth = truth.illuminance.expect("light");
            let found = figures(&mesh.illuminance.expect("light"), [truth.mean, truth.minimum, truth.maximum]);
            all.iter_mut().zip(found).for_each(|(to, f)| to.push(f));
        }
    }
    all.iter().zip(["mean", "minimum", "maximum", "uniformity"]).for_each(|(f, what)| expect_covered(what, f));
}
