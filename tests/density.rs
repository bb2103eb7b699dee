//! Texels go where light changes: bakes with densities that a pilot found, against even ones.

mod common;

use common::rooms::Builder;
use evenlight::options::{Audits, Density};
use evenlight::report::Report;
use evenlight::scene::{LightKind, Scene};
use evenlight::{BakeOptions, NoObserver, bake};
use glam::Vec3;

/// Plates of ground in the sun, one of them in the shadow of a few posts.
fn scene() -> Scene {
    let mut b = Builder::new(256);
    let grey = b.diffuse(0.3, 0.0);
    for i in 0..6 {
        b.quad("plate", Vec3::X * 5.0 * i as f32, Vec3::Z * 4.0, Vec3::X * 4.0, grey, [8; 2]);
    }
    for i in 0..4 {
        let corner = Vec3::new(0.4 + 0.9 * i as f32, 0.0, 1.0);
        b.solid(corner, corner + Vec3::new(0.2, 2.0, 0.2), grey, 8);
    }
    b.light(Vec3::ZERO, Vec3::new(0.2, -1.0, 0.9), 1000.0, LightKind::Directional { angular_diameter: 0.0 });
    b.finish()
}

fn baked(scene: &Scene, page: u32, density: Density, target: f64, shown: Option<f64>) -> Report {
    let options = BakeOptions {
        target_percent: target,
        target_mesh_percent: Some(1e9),
        target_shown_percent: shown,
        max_texture: page,
        density,
        audit: Audits::Off,
        ..BakeOptions::default()
    };
    let bake = bake(scene, &options, &mut NoObserver).expect("the bake succeeds");
    assert!(bake.report.texel_error_percent <= target);
    bake.report
}

#[test]
fn a_third_of_the_texels_shows_as_much() {
    let scene = scene();
    let even = baked(&scene, 256, Density::Even, 1.0, None);
    let adapted = baked(&scene, 128, Density::Auto, 1.0, None);
    println!(
        "{} % by {} texels, {} % by {}",
        even.texel_grid_error, even.atlas.texels, adapted.texel_grid_error, adapted.atlas.texels
    );
    assert!(adapted.atlas.texels * 3 < even.atlas.texels);
    assert!(adapted.texel_grid_error <= even.texel_grid_error);
}

#[test]
fn no_more_texels_than_the_target_asks_for() {
    let scene = scene();
    let most = baked(&scene, 256, Density::Auto, 3.0, None);
    let met = baked(&scene, 256, Density::Auto, 3.0, Some(20.0));
    println!(
        "{} % by {} texels, {} % by {}",
        most.shown_error_percent, most.atlas.texels, met.shown_error_percent, met.atlas.texels
    );
    assert!(met.target_met && met.shown_error_percent <= 20.0);
    assert!(met.atlas.texels < most.atlas.texels);
    assert!(met.skips.iter().any(|s| s.contains("texels")), "{:?}", met.skips);

    let missed = baked(&scene, 64, Density::Auto, 3.0, Some(3.1));
    assert!(!missed.target_met && missed.shown_error_percent > 3.1);
    assert_eq!(missed.limit, Some("texels"));
}

/// Charts and their densities are a function of the scene alone.
#[test]
fn threads_do_not_matter() {
    let scene = scene();
    let with = |threads: usize| {
        let options = BakeOptions {
            target_percent: 5.0,
            max_texture: 128,
            threads,
            audit: Audits::Off,
            ..BakeOptions::default()
        };
        let bake = bake(&scene, &options, &mut NoObserver).expect("the bake succeeds");
        (bake.lightmap.pages.iter().map(|p| p.irradiance.clone()).collect::<Vec<_>>(), bake.atlas.pages)
    };
    assert!(with(1) == with(3));
}

#[test]
fn fewer_texels_where_memory_is_short() {
    let scene = scene();
    let options = BakeOptions {
        target_percent: 20.0,
        max_texture: 256,
        density: Density::Even,
        audit: Audits::Off,
        ..BakeOptions::default()
    };
    let full = bake(&scene, &options, &mut NoObserver).expect("the bake succeeds").report;
    let limit = 20 << 20;
    let less = bake(&scene, &BakeOptions { memory_limit: limit, ..options.clone() }, &mut NoObserver);
    let less = less.expect("fewer texels do").report;
    assert!(less.atlas.texels < full.atlas.texels && less.atlas.texels > full.atlas.texels / 8);
    assert!(less.warnings.iter().any(|w| w.code == "density-limited-by-memory"), "{:?}", less.warnings);
    // What was asked for in numbers is refused.
    let asked = Density::TexelsPerMetre(full.atlas.texels_per_metre);
    let refused = bake(&scene, &BakeOptions { memory_limit: limit, density: asked, ..options }, &mut NoObserver);
    assert!(refused.is_err_and(|e| e.to_string().contains("--memory-limit")));
}

/// A box inside another gets light from nowhere and is seen from nowhere: a pilot gives it few texels, where even density
/// gives it as many as the rest, and the report says so.
#[test]
fn what_is_inside_a_solid_gets_few_texels() {
    let mut b = Builder::new(256);
    let grey = b.diffuse(0.3, 0.0);
    b.quad("ground", Vec3::new(-4.0, 0.0, -4.0), Vec3::Z * 8.0, Vec3::X * 8.0, grey, [8; 2]);
    b.solid(Vec3::new(-1.0, 0.5, -1.0), Vec3::new(1.0, 2.5, 1.0), grey, 8);
    b.solid(Vec3::new(-0.9, 0.6, -0.9), Vec3::new(0.9, 2.4, 0.9), grey, 8);
    b.point_light(Vec3::new(2.0, 4.0, 1.0), 100.0);
    let scene = b.finish();
    let inside = |density| {
        let report = baked(&scene, 128, density, 3.0, None);
        let line = report.skips.iter().find(|s| s.starts_with("light: ")).expect("buried charts").clone();
        println!("{line}");
        let numbers: Vec<f64> = line.split(' ').filter_map(|w| w.parse().ok()).collect();
        assert_eq!(numbers[..2], [6.0, 13.0], "{line}");
        numbers[2] / numbers[3]
    };
    let (even, adapted) = (inside(Density::Even), inside(Density::Auto));
    // By area 19.44 of 107.44 m2.
    assert!((even - 0.18).abs() < 0.03, "{even}");
    assert!(adapted < 0.25 * even, "{adapted} for {even}");
}
