//! Indirect light smoothed over cells or gathered: as wrong as stated, and never through a wall.
//!
//! Truth comes from the same scenes without smoothing, where every texel has its own photons and is unbiased
//! (tests/error_estimate.rs, tests/path_tracer.rs). It is taken twice, from independent seeds, so that its own noise
//! drops out of squared distances: E[(x - t1) (x - t2)] = (x - truth)^2.

mod common;

use common::rooms::{Builder, centre, plain, run, two_rooms};
use common::runs::one_round;
use common::statistics::{mean_and_error, mean_test};
use evenlight::options::{DoubleSided, Smoothing};
use evenlight::scene::{Material, Scene, Sky};
use evenlight::{Bake, BakeOptions};
use glam::{DVec3, Vec3, Vec4};

const PAGE: u32 = 128;

/// A room of coloured walls with a block on the floor, a board close to a wall and a lamp: contact shadows, dark
/// gaps and colour.
fn room() -> Scene {
    room_with_gap(0.1)
}

/// ... where one block is so far from the wall.
fn room_with_gap(gap: f32) -> Scene {
    let mut b = Builder::new(PAGE);
    let wall = b.material(Material { base_color: Vec4::new(0.7, 0.5, 0.3, 1.0), ..Material::default() });
    b.room(Vec3::ZERO, Vec3::new(3.0, 2.0, 4.0), wall, 24);
    let block = b.diffuse(0.5, 0.0);
    b.solid(Vec3::new(0.5, 0.0, 0.6), Vec3::new(1.2, 0.7, 1.4), block, 8);
    b.solid(Vec3::new(2.6 - gap, 0.6, 1.0), Vec3::new(3.0 - gap, 1.4, 2.0), block, 6);
    let lamp = b.diffuse(0.0, 20.0);
    b.quad("lamp", Vec3::new(1.2, 1.99, 1.8), Vec3::X * 0.5, Vec3::Z * 0.5, lamp, [4; 2]);
    b.finish()
}

/// A room with a block on its floor, and a window to a grey sky that few directions from most of the room go through.
fn skylit() -> Scene {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(0.6, 0.0);
    let (x, y, z) = (Vec3::X * 3.0, Vec3::Y * 2.0, Vec3::Z * 4.0);
    b.quad("left", Vec3::ZERO, y, z, wall, [16, 32]);
    b.quad("right", x, z, y, wall, [32, 16]);
    b.quad("floor", Vec3::ZERO, z, x, wall, [32, 24]);
    b.quad("ceiling", y, x, z, wall, [24, 32]);
    b.quad("back", Vec3::ZERO, x, y, wall, [24, 16]);
    // The front wall around the window, from x = 1 to 2 and y = 0.8 to 1.6.
    b.quad("below", z, y * 0.4, x, wall, [6, 24]);
    b.quad("above", z + y * 0.8, y * 0.2, x, wall, [3, 24]);
    b.quad("beside", z + y * 0.4, y * 0.4, x / 3.0, wall, [6, 8]);
    b.quad("beyond", z + y * 0.4 + x * (2.0 / 3.0), y * 0.4, x / 3.0, wall, [6, 8]);
    let block = b.diffuse(0.5, 0.0);
    b.solid(Vec3::new(0.5, 0.0, 0.6), Vec3::new(1.2, 0.7, 1.4), block, 8);
    b.scene_mut().sky = Some(Sky::Constant(Vec3::new(20.0, 30.0, 40.0)));
    b.finish()
}

fn mean_map(bakes: impl Iterator<Item = Vec<DVec3>>) -> Vec<DVec3> {
    let mut sum: Vec<DVec3> = Vec::new();
    let mut n = 0.0;
    for map in bakes {
        sum.resize(map.len(), DVec3::ZERO);
        sum.iter_mut().zip(map).for_each(|(s, e)| *s += e);
        n += 1.0;
    }
    sum.into_iter().map(|s| s / n).collect()
}

fn map(bake: &Bake) -> Vec<DVec3> {
    (0..bake.texels.mapped).map(|i| bake.solution.total.mean(i).as_dvec3()).collect()
}

/// Two independent maps of the truth.
fn truth(scene: &Scene) -> [Vec<DVec3>; 2] {
    let options = BakeOptions { max_photons: Some(1 << 23), ..plain(PAGE, 0.2) };
    [100, 101].map(|seed| map(&run(scene, &BakeOptions { seed, ..options.clone() })))
}

/// Squared distance from the truth in percent squared of its mean, over area and channels.
fn square_error(e: &[DVec3], truth: &[Vec<DVec3>; 2], weights: &[f64]) -> f64 {
    let (mut square, mut mean, mut weight) = (0.0, 0.0, 0.0);
    for (i, w) in weights.iter().enumerate() {
        square += w * (e[i] - truth[0][i]).dot(e[i] - truth[1][i]) / 3.0;
        mean += w * (truth[0][i] + truth[1][i]).element_sum() / 6.0;
        weight += w;
    }
    1e4 * square / weight / (mean / weight).powi(2)
}

/// The stated error, noise and bias of cells together, against the true one over 48 seeds. What blocks of a quarter
/// of a cell average out goes unseen: up to a third of the square here, never more; and never half as much too many.
#[test]
fn cells_are_as_wrong_as_stated() {
    let scene = room();
    let truth = truth(&scene);
    let options = BakeOptions { smoothing: Smoothing::Cells, ..plain(PAGE, 3.0) };
    let (mut stated, mut real, mut noise) = (Vec::new(), Vec::new(), Vec::new());
    let mut covered = 0;
    for seed in 0..48 {
        let bake = run(&scene, &BakeOptions { seed, ..options.clone() });
        assert!(bake.report.target_met && bake.solution.cells[0] > 50 && bake.solution.cells[0] < 2000);
        let error = square_error(&map(&bake), &truth, &bake.solution.weights.weight);
        stated.push(bake.report.texel_error_percent.powi(2));
        noise.push(bake.report.sigma.powi(2));
        real.push(error);
        covered += usize::from(error.max(0.0).sqrt() <= 3.0);
    }
    let (real_mean, _) = mean_and_error(&real);
    println!(
        "true {:.3} %, stated {:.3} %, sigma {:.3} %, {covered} of 48 within the target",
        real_mean.sqrt(),
        mean_and_error(&stated).0.sqrt(),
        mean_and_error(&noise).0.sqrt(),
    );
    let ratio = mean_and_error(&stated).0 / real_mean;
    assert!((0.67..1.5).contains(&ratio), "stated over true square: {ratio}");
    assert!(mean_and_error(&noise).0 < real_mean, "noise alone is less than all of the error");
    assert!(covered >= 43, "{covered} of 48 bakes are within the target");
}

/// Light of the sky is smoothed like that of photons: as wrong as stated, no more than 0.4 % of it lost or won, for half of the
/// samples that texels by themselves take, and for two fifths in the mean over seeds.
#[test]
fn light_of_the_sky_is_as_wrong_as_stated() {
    let scene = skylit();
    let truth = truth(&scene);
    let raw = run(&scene, &plain(PAGE, 3.0)).solution.direct_samples;
    let options = BakeOptions { smoothing: Smoothing::Cells, ..plain(PAGE, 3.0) };
    let (mut stated, mut real, mut change) = (Vec::new(), Vec::new(), Vec::new());
    let (mut covered, mut all_samples) = (0, 0);
    for seed in 0..32 {
        let bake = run(&scene, &BakeOptions { seed, ..options.clone() });
        let (weights, samples) = (&bake.solution.weights.weight, bake.solution.direct_samples);
        assert!(bake.report.target_met && 2 * samples < raw, "{samples} samples, {raw} without cells");
        all_samples += samples;
        let error = square_error(&map(&bake), &truth, weights);
        stated.push(bake.report.texel_error_percent.powi(2));
        real.push(error);
        covered += usize::from(error.max(0.0).sqrt() <= 3.0);
        let light = |e: &[DVec3]| weights.iter().zip(e).map(|(w, e)| w * e.element_sum()).sum::<f64>();
        change.push(2.0 * light(&map(&bake)) / (light(&truth[0]) + light(&truth[1])) - 1.0);
    }
    let (real_mean, stated_mean) = (mean_and_error(&real).0, mean_and_error(&stated).0);
    let (energy, of_energy) = mean_and_error(&change);
    println!("true {:.3} %, stated {:.3} %, {covered} of 32 within the target", real_mean.sqrt(), stated_mean.sqrt());
    println!("energy {:+.3} +- {:.3} %", 100.0 * energy, 100.0 * of_energy);
    assert!(all_samples < 2 * 32 * raw / 5, "{} samples, {raw} without cells", all_samples / 32);
    let ratio = stated_mean / real_mean;
    assert!((0.67..1.5).contains(&ratio), "stated over true square: {ratio}");
    assert!(covered >= 28, "{covered} of 32 bakes are within the target");
    assert!(energy.abs() < 0.004, "energy changes by {energy}");
}

/// Noise of the reconstruction is what the halves say: the mean over seeds is their common expectation, and each
/// bake's squared distance from it is its sigma squared, cells chosen anew every time.
#[test]
fn sigma_of_cells_is_the_scatter_of_seeds() {
    let scene = room();
    let options = BakeOptions { smoothing: Smoothing::Cells, ..one_round(PAGE) };
    let bakes: Vec<(Vec<DVec3>, f64)> = (0..64)
        .map(|seed| {
            let bake = run(&scene, &BakeOptions { seed, ..options.clone() });
            (map(&bake), bake.report.sigma.powi(2))
        })
        .collect();
    let weights = run(&scene, &options).solution.weights.weight.clone();
    let centre = mean_map(bakes.iter().map(|b| b.0.clone()));
    let both = [centre.clone(), centre];
    // The mean of all shares 1 / n of its noise with each.
    let n = bakes.len() as f64;
    let ratios: Vec<f64> =
        bakes.iter().map(|b| square_error(&b.0, &both, &weights) * n / (n - 1.0) / b.1 - 1.0).collect();
    let (mean, error) = mean_and_error(&ratios);
    println!("scatter over sigma, squared: 1 {mean:+.3} +- {error:.3}");
    // Where sigma is large by chance the scatter is not: a ratio of two estimates is off by their noise.
    mean_test(&ratios, mean.clamp(-0.05, 0.08), 1).expect("sigma");
}

/// Two rooms under one floor and one ceiling; the other room is black, exactly, though cells are as large as a room.
#[test]
fn no_cell_reaches_through_a_wall() {
    for (columns, open) in [(32, false), (33, false), (32, true), (33, true)] {
        let mut scene = two_rooms(PAGE, columns, false);
        if open {
            // Light of the sky comes in where a wall was.
            scene.lights.clear();
            scene.instances[2].casts = false;
            scene.sky = Some(Sky::Constant(Vec3::splat(1e6)));
        }
        // From the first few photons on. Points on the edges of floor and ceiling, in the planes of walls, must not see
        // the sky behind them, nor points beside a wall what is on its other side; a photon that rounding puts beyond
        // the wall has not been there; no wall may go unnoticed because all of a few rays from beside it meet its back.
        for (photons, seed) in (1..33).flat_map(|seed| [(1 << 13, seed), (1 << 17, seed)]) {
            let options = BakeOptions {
                seed,
                max_photons: Some(photons),
                smoothing: Smoothing::Cells,
                double_sided: DoubleSided::Split,
                ..plain(PAGE, 0.1)
            };
            let bake = run(&scene, &options);
            let width = 6.0 / f64::from(columns);
            let dark: Vec<usize> = (0..bake.texels.mapped)
                .filter(|&i| bake.solution.weights.instance[i] != 6 && centre(&bake, i).x - 3.0 > 0.51 * width)
                .collect();
            assert!(dark.len() > 800);
            let lit = dark.iter().filter(|&&i| bake.solution.total.mean(i) != Vec3::ZERO).count();
            assert_eq!(lit, 0, "{columns} columns, {photons} photons: texels with light in the dark room");
        }
    }
}

/// Meshes that have to be right by themselves gather their light, and are as wrong as they say.
#[test]
fn gathered_light_is_right() {
    gathers(&room(), 3.0);
}

/// ... where each of them has a second side in the dark, too, which does not reach the maps. Without the gap: to the face
/// that looks into it, looked-up light adds 3 to 6 % here.
#[test]
fn gathered_light_of_one_side_is_right() {
    let mut scene = room_with_gap(0.6);
    scene.materials.iter_mut().for_each(|m| m.double_sided = true);
    gathers(&scene, 2.0);
}

fn gathers(scene: &Scene, target: f64) {
    let truth = truth(scene);
    let options = BakeOptions { smoothing: Smoothing::Cells, target_mesh_percent: Some(target), ..plain(PAGE, 4.0) };
    let (mut true_sum, mut stated_sum) = (0.0, 0.0);
    for seed in 0..6 {
        let bake = run(scene, &BakeOptions { seed, ..options.clone() });
        assert!(bake.report.target_met && bake.report.work.gathered_meshes > 0, "{:?}", bake.report.limit);
        for m in bake.report.meshes.iter().filter(|m| m.mean > 0.01 * bake.report.mean_irradiance) {
            let weights: Vec<f64> = (0..bake.texels.mapped)
                .map(|i| {
                    let own = bake.solution.weights.instance[i] as usize == m.instance;
                    if own { bake.solution.weights.weight[i] } else { 0.0 }
                })
                .collect();
            let error = square_error(&map(&bake), &truth, &weights);
            // A face that looks into a dark gap has light looked up on texels as wide as the gap: 2 % too much of
            // its own little light, which its noise does not tell.
            let percent = error.max(0.0).sqrt();
            assert!(percent < 1.5 * target, "{}: {percent:.2} % for {:.2} %", m.name, m.error_percent);
            true_sum += error;
            stated_sum += m.error_percent.powi(2);
        }
    }
    println!("true over stated square, over all meshes: {:.3}", true_sum / stated_sum);
    assert!(true_sum / stated_sum < 1.5);
}
