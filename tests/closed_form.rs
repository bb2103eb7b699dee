//! Bakes against formulas.

mod common;

use common::rooms::{Builder, mean_where, plain, received, run};
use glam::Vec3;

/// Scene CUBE of the Keldysh institute's lighting tests: inside of a 10 m cube, point light of 50 000 cd in its
/// centre, all walls diffuse 2/3. Luminances by solving the radiosity equation (Gauss-Legendre, extrapolated).
#[test]
fn cube_with_point_light() {
    let mut b = Builder::new(256);
    let grey = b.diffuse(2.0 / 3.0, 0.0);
    b.room(Vec3::splat(-5.0), Vec3::splat(5.0), grey, 40);
    b.point_light(Vec3::ZERO, 50_000.0);
    let scene = b.finish();
    let bake = run(&scene, &plain(256, 1.0));
    let pi = std::f64::consts::PI;
    let luminance = |e: f64| e * (2.0 / 3.0) / pi;
    let mean = luminance(received(&bake) / 600.0);
    assert!((mean - 666.67).abs() < 2.0, "face mean {mean}");
    let spot = |x: f64, y: f64| {
        let (e, n) = mean_where(&bake, 4, |p| (p.x - x * 5.0).abs() < 0.3 && (p.y - y * 5.0).abs() < 0.3);
        assert!(n >= 1);
        luminance(e)
    };
    println!("error {:?}", bake.report.texel_error_percent);
    for (x, y, l) in [(0.0, 0.0, 892.8), (0.5, 0.0, 768.7), (0.5, 0.5, 686.7)] {
        let found = spot(x, y);
        println!("({x}, {y}): {found} for {l}");
        assert!((found / l - 1.0).abs() < 0.02, "({x}, {y}): {found} for {l}");
    }
}

/// Furnace: every wall emits L and reflects rho, so E = pi L / (1 - rho) in every texel.
#[test]
fn furnace() {
    let mut b = Builder::new(128);
    let wall = b.diffuse(0.5, 3.0);
    b.room(Vec3::new(-1.0, -2.0, -1.5), Vec3::new(1.0, 2.0, 1.5), wall, 16);
    let scene = b.finish();
    let bake = run(&scene, &plain(128, 1.0));
    let expected = std::f64::consts::PI * 3.0 / 0.5;
    let area = 2.0 * (2.0 * 4.0 + 2.0 * 3.0 + 4.0 * 3.0);
    let mean = received(&bake) / area;
    println!("mean {mean} for {expected}, error {}", bake.report.texel_error_percent);
    assert!((mean / expected - 1.0).abs() < 0.005);
}
