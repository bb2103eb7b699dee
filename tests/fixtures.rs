//! The scenes of `fixtures/`: what is committed is what the tool writes, and bakes of it meet its formulas.

mod common;
#[path = "../tools/fixtures/scenes/mod.rs"]
mod scenes;

use common::glb;
use common::rooms::{centre, mean_where, received, run};
use evenlight::options::{Audits, Density, DoubleSided, Normals, TexelValue};
use evenlight::output::{NodeRect, node_rects};
use evenlight::{Bake, BakeOptions, Scene};
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures")
}

fn load(name: &str) -> Scene {
    Scene::from_gltf(folder().join(name)).expect("the fixture loads")
}

/// Plain texel means on generated UVs, `page` squared.
fn options(page: u32, target_percent: f64) -> BakeOptions {
    BakeOptions {
        target_percent,
        target_mesh_percent: Some(1e9),
        max_texture: page,
        density: Density::Even,
        normals: Normals::Geometric,
        texel_value: TexelValue::Mean,
        ..BakeOptions::default()
    }
}

/// Irradiance [lux] of every stored texel, its area [m2] and its instance.
fn texels<'a>(bake: &'a Bake) -> impl Iterator<Item = (f64, f64, u32)> + 'a {
    let metres2 = bake.world.frame.metres.powi(2);
    (0..bake.texels.mapped).filter(|&i| bake.solution.weights.stored[i]).map(move |i| {
        let e = f64::from(bake.solution.total.mean(i).element_sum()) / 3.0;
        (e, f64::from(bake.texels.texels[i].area) * metres2, bake.solution.weights.instance[i])
    })
}

#[test]
fn committed_files_are_what_the_tool_writes() {
    for (name, bytes) in scenes::all() {
        let path = folder().join(name);
        let committed = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(committed == bytes, "{name} is stale: run `cargo run --release --example make_fixtures`");
    }
}

/// Luminances of the walls: solution of the radiosity equation by Gauss-Legendre quadrature, extrapolated. The
/// mean over a face follows from flux alone: L = 4 pi I rho / (1 - rho) / (pi A).
#[test]
fn cube_meets_the_radiosity_solution() {
    let scene = load("cube.glb");
    let bake = run(&scene, &options(128, 1.0));
    let luminance = |e: f64| e * (2.0 / 3.0) / PI;
    let mean = luminance(received(&bake) / 600.0);
    assert!((mean / 666.667 - 1.0).abs() < 0.005, "face mean {mean}");
    let expected = [(0.0, 0.0, 892.8), (0.5, 0.0, 768.7), (0.5, 0.5, 686.7)];
    for (x, y, l) in expected {
        // Over all faces, all places that the cube's symmetry maps to (x, y).
        let (mut sum, mut n) = (0.0, 0);
        for wall in 0..6 {
            let axes = [(wall / 2 + 1) % 3, (wall / 2 + 2) % 3];
            let near = |p: glam::DVec3, x: f64, y: f64| {
                (p[axes[0]].abs() / 5.0 - x).abs() < 0.05 && (p[axes[1]].abs() / 5.0 - y).abs() < 0.05
            };
            let (e, count) = mean_where(&bake, wall, |p| near(p, x, y) || near(p, y, x));
            sum += e * count as f64;
            n += count;
        }
        let found = luminance(sum / n as f64);
        assert!(n >= 6 && (found / l - 1.0).abs() < 0.02, "({x}, {y}): {found} for {l}, {n} texels");
    }
}

/// The mean of one bake at 2 % scatters by 0.11 % (64 seeds), that of 16 by 0.027 %: off by 0.12 % by chance once in
/// 100,000 runs.
#[test]
fn furnace_is_the_same_everywhere() {
    let scene = load("furnace.glb");
    let expected = PI * 3.0 / (1.0 - 0.5);
    let seeds = 16;
    let mut means = 0.0;
    for seed in 0..seeds {
        let bake = run(&scene, &BakeOptions { seed, ..options(64, 2.0) });
        let (mut sum, mut area, mut squares) = (0.0, 0.0, 0.0);
        for (e, a, _) in texels(&bake) {
            sum += e * a;
            area += a;
            squares += (e / expected - 1.0).powi(2) * a;
        }
        means += sum / area / seeds as f64;
        let rms = (squares / area).sqrt() * 100.0;
        // One channel's noise is the joint noise here: all channels carry the same light.
        assert!(
            rms < 1.3 * bake.report.texel_error_interval[1],
            "rms {rms} %, reported {:?}",
            bake.report.texel_error_interval
        );
    }
    assert!((means / expected - 1.0).abs() < 0.0012, "mean {means} for {expected}");
}

#[test]
fn instances_share_uvs_and_receive_the_same() {
    let scene = load("instances.glb");
    let bake = run(&scene, &options(128, 1.0));
    assert_eq!(scene.meshes.len(), 1);
    assert_eq!(bake.atlas.meshes.iter().flatten().count(), 1, "one set of UVs");
    let rects: Vec<NodeRect> = node_rects(&scene, &bake.atlas).into_iter().flatten().collect();
    assert_eq!(rects.len(), 5);
    for (i, a) in rects.iter().enumerate() {
        let [x, y, w, h] = a.rect;
        assert!(x >= 0.0 && y >= 0.0 && x + w <= 1.0 && y + h <= 1.0, "{a:?} leaves the page");
        for b in &rects[i + 1..] {
            let [u, v, s, t] = b.rect;
            let apart = x + w <= u || u + s <= x || y + h <= v || v + t <= y;
            assert!(a.page != b.page || apart, "{a:?} and {b:?} overlap");
        }
    }
    let expected = 100.0 * PI;
    for instance in 0..5 {
        let (sum, area) = texels(&bake)
            .filter(|t| t.2 == instance)
            .fold((0.0, 0.0), |(sum, area), (e, a, _)| (sum + e * a, area + a));
        let name = &scene.instances[instance as usize].name;
        assert!((sum / area / expected - 1.0).abs() < 0.01, "{name}: {} for {expected}", sum / area);
    }
}

#[test]
fn no_light_passes_a_wall_without_thickness() {
    let scene = load("two-rooms.glb");
    let bake = run(&scene, &BakeOptions { double_sided: DoubleSided::Split, ..options(128, 4.0) });
    // What the lit room receives follows from flux alone: 4 pi I / (1 - rho). A texel of the floor may lie on
    // both sides of the wall; the light in it belongs to the lit room.
    let flux = 4.0 * PI * 100.0 / (1.0 - 0.5);
    let found = received(&bake);
    assert!((found / flux - 1.0).abs() < 0.01, "{found} lux m2 for {flux}");
    let texel = 1.5 / bake.atlas.texels_per_metre;
    let dark = (0..bake.texels.mapped).filter(|&i| centre(&bake, i).x > texel);
    let lit = dark.filter(|&i| bake.solution.total.mean(i) != glam::Vec3::ZERO);
    assert_eq!(lit.count(), 0, "texels with light in the dark room");
}

/// The demo room meets its target for few photons, as does every mesh in it: books that see the window through a slit
/// gather their indirect light, and where the sky is what they get wrong, no photon mends it.
#[test]
fn the_demo_room_needs_few_photons() {
    let scene = load("room.glb");
    for seed in [0, 5, 9] {
        let options = BakeOptions {
            seed,
            target_percent: 5.0,
            max_texture: 256,
            max_photons: Some(1 << 24),
            audit: Audits::Off,
            ..BakeOptions::default()
        };
        let bake = run(&scene, &options);
        assert!(bake.report.target_met, "seed {seed}: {} photons", bake.solution.ledger.photons);
    }
}
