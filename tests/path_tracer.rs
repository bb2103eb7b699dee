//! Bakes against the tests' own path tracer, which shares no code with the library.
//!
//! 200 texels of each scene; the difference of a texel has a standard error of a few percent, so that its mean over
//! the texels sees a common factor of 1.01 (tests/power.rs plants one). Level 1e-6 per scene.

mod common;

use common::agreement::scores;
use common::path_tracer::Fault;
use common::rooms::{Builder, plain};
use common::statistics::score_tests;
use evenlight::BakeOptions;
use evenlight::options::DoubleSided;
use evenlight::scene::{Alpha, LightKind, Material, Scene, Sky};
use glam::{Vec3, Vec4};

const PAGE: u32 = 64;

fn agree(what: &str, scene: &Scene, seeds: u64, paths: usize) {
    let options = BakeOptions { max_photons: Some(1 << 17), double_sided: DoubleSided::Split, ..plain(PAGE, 0.5) };
    let (z, noise) = scores(scene, &options, seeds, paths, Fault::None);
    let n = z.len() as f64;
    println!(
        "{what}: {n} texels, noise {:.2} %, mean score {:.3}, squares {:.1}",
        100.0 * noise,
        z.iter().sum::<f64>() / n,
        z.iter().map(|z| z * z).sum::<f64>()
    );
    assert!(noise < 0.05, "{what}: too noisy to tell anything");
    if let Err(e) = score_tests(&z) {
        panic!("{what}: {e}");
    }
}

fn coloured(b: &mut Builder, r: f32, g: f32, blue: f32) -> usize {
    b.material(Material { base_color: Vec4::new(r, g, blue, 1.0), ..Material::default() })
}

/// Five coloured walls and a front, a lamp under the ceiling, a box in the way.
#[test]
fn cornell_box_with_a_box() {
    agree("cornell", &common::rooms::cornell(PAGE), 16, 3000);
}

/// A room that is lit by the sky through a window.
#[test]
fn room_with_a_window() {
    let mut b = Builder::new(PAGE);
    let white = coloured(&mut b, 0.7, 0.6, 0.5);
    let (x, y, z) = (Vec3::X * 4.0, Vec3::Y * 3.0, Vec3::Z * 4.0);
    b.quad("floor", Vec3::ZERO, z, x, white, [8; 2]);
    b.quad("ceiling", y, x, z, white, [8; 2]);
    b.quad("back", Vec3::ZERO, x, y, white, [8; 2]);
    b.quad("front", z, y, x, white, [8; 2]);
    b.quad("right", x, z, y, white, [8; 2]);
    // The left wall has a hole from 1 to 2.5 m high and 1 to 3 m along.
    b.quad("below", Vec3::ZERO, Vec3::Y, z, white, [3, 8]);
    b.quad("above", Vec3::Y * 2.5, Vec3::Y * 0.5, z, white, [2, 8]);
    b.quad("beside", Vec3::Y, Vec3::Y * 1.5, Vec3::Z, white, [4, 2]);
    b.quad("beside too", Vec3::new(0.0, 1.0, 3.0), Vec3::Y * 1.5, Vec3::Z, white, [4, 2]);
    b.scene_mut().sky = Some(Sky::Constant(Vec3::new(1.0, 1.5, 2.5)));
    agree("window", &b.finish(), 32, 10000);
}

/// A point and a spot light in a room of coloured walls with a box.
#[test]
fn spot_and_point() {
    let mut b = Builder::new(PAGE);
    let (red, blue) = (coloured(&mut b, 0.8, 0.3, 0.2), coloured(&mut b, 0.2, 0.5, 0.85));
    b.room(Vec3::ZERO, Vec3::new(4.0, 3.0, 3.0), red, 8);
    b.solid(Vec3::new(1.0, 0.5, 1.0), Vec3::new(2.0, 1.25, 2.0), blue, 4);
    b.point_light(Vec3::new(3.25, 2.0, 0.75), 10.0);
    b.light(Vec3::new(0.75, 2.5, 1.5), Vec3::new(0.4, -1.0, 0.1), 60.0, LightKind::Spot { inner: 0.2, outer: 0.7 });
    agree("spot and point", &b.finish(), 16, 3000);
}

/// A leaf, a curtain of which half is missing, and a shade around a lamp, which pass light diffusely.
#[test]
fn leaves_and_lampshades() {
    let mut b = Builder::new(PAGE);
    let ground = coloured(&mut b, 0.5, 0.6, 0.4);
    b.quad("ground", Vec3::new(-3.0, 0.0, -3.0), Vec3::Z * 6.0, Vec3::X * 6.0, ground, [12; 2]);
    let leaf = Material {
        base_color: Vec4::new(0.3, 0.6, 0.2, 1.0),
        diffuse_transmission: 0.6,
        diffuse_transmission_color: Vec3::new(0.9, 0.7, 0.2),
        ..Material::default()
    };
    let curtain =
        Material { base_color: Vec4::new(0.8, 0.7, 0.6, 0.5), alpha: Alpha::Blend, double_sided: true, ..leaf.clone() };
    let [leaf, curtain] = [leaf, curtain].map(|m| b.material(m));
    b.quad("leaf", Vec3::new(1.0, 0.5, -1.5), Vec3::X * 1.5, Vec3::new(0.0, 0.5, 2.0), leaf, [6; 2]);
    b.quad("curtain", Vec3::new(-0.5, 0.2, -1.5), Vec3::Y * 1.5, Vec3::new(0.5, 0.0, 2.0), curtain, [6; 2]);
    for (at, along) in [
        (Vec3::new(-2.25, 0.25, 1.0), Vec3::X),
        (Vec3::new(-1.25, 0.25, 1.0), Vec3::Z),
        (Vec3::new(-1.25, 0.25, 2.0), Vec3::NEG_X),
        (Vec3::new(-2.25, 0.25, 2.0), Vec3::NEG_Z),
    ] {
        b.quad("shade", at, Vec3::Y * 0.75, along, leaf, [4; 2]);
    }
    b.point_light(Vec3::new(-1.75, 0.6, 1.5), 3.0);
    b.light(Vec3::ZERO, Vec3::new(0.3, -1.0, 0.4), 8.0, LightKind::Directional { angular_diameter: 0.0 });
    b.scene_mut().sky = Some(Sky::Constant(Vec3::new(0.5, 0.75, 1.0)));
    agree("leaves", &b.finish(), 16, 3000);
}

/// Sheets that pass light, shine or reflect on both sides, in an open scene under a sun.
#[test]
fn sheets_in_the_open() {
    let mut b = Builder::new(PAGE);
    let ground = coloured(&mut b, 0.5, 0.6, 0.4);
    b.quad("ground", Vec3::new(-3.0, 0.0, -3.0), Vec3::Z * 6.0, Vec3::X * 6.0, ground, [12; 2]);
    let veil = b.material(Material {
        base_color: Vec4::new(0.9, 0.4, 0.3, 0.5),
        alpha: Alpha::Blend,
        double_sided: true,
        ..Material::default()
    });
    b.quad("veil", Vec3::new(-1.0, 0.5, -1.0), Vec3::Y * 1.5, Vec3::new(0.5, 0.0, 2.0), veil, [6; 2]);
    let glass = b.material(Material {
        base_color: Vec4::new(0.3, 0.9, 0.6, 1.0),
        transmission: 0.7,
        ior: 1.0,
        double_sided: true,
        ..Material::default()
    });
    b.quad("glass", Vec3::new(1.0, 0.25, -1.5), Vec3::X * 1.5, Vec3::new(0.0, 1.0, 2.0), glass, [6; 2]);
    let lamp = b.material(Material {
        base_color: Vec4::new(0.4, 0.4, 0.4, 1.0),
        emission: Vec3::new(6.0, 3.0, 1.0),
        double_sided: true,
        ..Material::default()
    });
    b.quad("lamp", Vec3::new(-2.5, 2.0, -0.5), Vec3::X * 1.0, Vec3::Z, lamp, [4; 2]);
    b.light(Vec3::ZERO, Vec3::new(0.3, -1.0, 0.4), 8.0, LightKind::Directional { angular_diameter: 0.0 });
    b.scene_mut().sky = Some(Sky::Constant(Vec3::new(0.5, 0.75, 1.0)));
    agree("sheets", &b.finish(), 16, 3000);
}
