//! Mirrors and glass against closed forms. Comparisons are Student tests over bakes with fixed seeds at a level of 1e-6
//! per test, as in `closed_form`.

mod common;

use common::formulas::{QuadMap, point_irradiance};
use common::rooms::{Builder, run};
use common::runs::{area_mean, expect_blocks, grey, node_mean, one_round, samples};
use common::statistics::{expect_mean, mean_and_error};
use evenlight::BakeOptions;
use evenlight::options::{Audits, Smoothing};
use evenlight::scene::{LightKind, Material, Scene, Sky};
use glam::{DVec3, Vec3, Vec4};
use std::f64::consts::PI;

const PAGE: u32 = 128;

fn metal(color: [f32; 3], roughness: f32) -> Material {
    Material { base_color: Vec3::from(color).extend(1.0), metallic: 1.0, roughness, ..Material::default() }
}

fn glass(solid: bool) -> Material {
    Material { base_color: Vec4::ONE, transmission: 1.0, roughness: 0.0, solid, ..Material::default() }
}

/// A black floor of 4 m, 16 texels squared, as the first node.
fn black_floor(b: &mut Builder) {
    let black = b.diffuse(0.0, 0.0);
    b.quad("floor", Vec3::new(-2.0, 0.0, -2.0), Vec3::Z * 4.0, Vec3::X * 4.0, black, [16; 2]);
}

/// A lamp over the floor and its image in the mirror at x = -2.
const LAMP: DVec3 = DVec3::new(0.5, 1.0, -0.25);
const IMAGE: DVec3 = DVec3::new(-4.5, 1.0, -0.25);

/// A black floor and a lamp before a wall of `material`, whose image every point of the floor sees in whole.
fn before_a_mirror(material: Material) -> Scene {
    let mut b = Builder::new(PAGE);
    black_floor(&mut b);
    let mirror = b.material(material);
    b.quad("mirror", Vec3::new(-2.0, 0.0, -2.25), Vec3::Y, Vec3::Z * 4.5, mirror, [8, 36]);
    b.point_light(LAMP.as_vec3(), 100.0);
    b.finish()
}

/// What the image of the lamp sends to a point of the floor.
fn mirrored(p: DVec3) -> f64 {
    let cosine = (p - IMAGE).normalize().x;
    (0.6 + 0.4 * (1.0 - cosine).powi(5)) * point_irradiance(p, DVec3::Y, IMAGE, 100.0)
}

/// A lamp before a mirror shines twice: itself, and as its image behind the mirror, by the mirror's Fresnel term.
#[test]
fn a_mirror_shows_a_lamp() {
    let scene = before_a_mirror(metal([0.6; 3], 0.0));
    expect_blocks(&scene, PAGE, 48, |p| point_irradiance(p, DVec3::Y, LAMP, 100.0) + mirrored(p));
}

/// Half a metal throws half of that, and spreads the rest.
#[test]
fn half_a_mirror_throws_half() {
    let scene = before_a_mirror(Material { metallic: 0.5, ..metal([0.6; 3], 0.0) });
    let quad = QuadMap::of(&scene, 0, PAGE);
    let expected = quad.mean([0.0; 2], 1.0, 256, |p| 0.5 * mirrored(p));
    let thrown: Vec<f64> = (0..48)
        .map(|seed| {
            let bake = run(&scene, &BakeOptions { seed, ..one_round(PAGE) });
            let caustics = &bake.solution.caustics.as_ref().expect("a mirror throws light").stored;
            let e: Vec<Vec3> = (0..bake.texels.mapped).map(|t| caustics.mean(t)).collect();
            node_mean(&bake, &e, 0)
        })
        .collect();
    expect_mean("floor", &thrown, expected, 0.03, 1);
}

/// Share that a dielectric reflects, by Fresnel's equations in angles.
fn fresnel(cosine: f64, ior: f64) -> f64 {
    let (i, t) = (cosine.acos(), (cosine.acos().sin() / ior).asin());
    if i < 1e-6 {
        return ((ior - 1.0) / (ior + 1.0)).powi(2);
    }
    let (s, p) = ((i - t).sin() / (i + t).sin(), (i - t).tan() / (i + t).tan());
    0.5 * (s * s + p * p)
}

/// A pane takes from light straight from a lamp what both its faces reflect.
#[test]
fn a_pane_dims_by_fresnels_law() {
    let lamp = DVec3::new(0.5, 2.0, -0.25);
    let mut b = Builder::new(PAGE);
    black_floor(&mut b);
    let pane = b.material(glass(false));
    b.quad("pane", Vec3::new(-2.5, 1.0, -2.5), Vec3::Z * 5.0, Vec3::X * 5.0, pane, [8; 2]);
    b.point_light(lamp.as_vec3(), 100.0);
    expect_blocks(&b.finish(), PAGE, 8, |p| {
        let r = fresnel((lamp - p).normalize().y, 1.5);
        point_irradiance(p, DVec3::Y, lamp, 100.0) * (1.0 - 2.0 * r / (1.0 + r))
    });
}

/// Sunlight through a slab of solid coloured glass: what the faces reflect to and fro, and what the glass absorbs on
/// the way that Snell's law gives.
#[test]
fn a_slab_refracts_and_absorbs() {
    let absorption = 3.0f32;
    let mut b = Builder::new(PAGE);
    black_floor(&mut b);
    let slab = b.material(Material { absorption: Vec3::splat(absorption), ..glass(true) });
    b.solid(Vec3::new(-3.5, 0.5, -3.5), Vec3::new(3.5, 0.6, 3.5), slab, 8);
    let cosine = 0.6f64;
    let down = Vec3::new(0.8, -0.6, 0.0);
    b.light(Vec3::ZERO, down, 1000.0, LightKind::Directional { angular_diameter: 0.0 });
    let scene = b.finish();
    let inside = (1.0 - (0.8f64 / 1.5).powi(2)).sqrt();
    let kept = (-f64::from(absorption) * 0.1 / inside).exp();
    let r = fresnel(cosine, 1.5);
    let expected = 1000.0 * cosine * (1.0 - r).powi(2) * kept / (1.0 - (r * kept).powi(2));
    let [floor] = samples(&scene, &one_round(PAGE), 0..48, |bake, e| [node_mean(bake, e, 0)]);
    expect_mean("floor", &floor, expected, 0.03, 1);
}

/// Where every wall sends out the same light, a clear block of glass and a perfect mirror change nothing: E stays
/// pi L / (1 - rho) on the walls, and on the faces that they send it to.
#[test]
fn nothing_specular_shows_in_a_furnace() {
    for (what, material) in [("mirror", metal([1.0; 3], 0.0)), ("glass", glass(true)), ("pane", glass(false))] {
        let mut b = Builder::new(PAGE);
        let wall = b.diffuse(0.6, 5.0);
        b.room(Vec3::ZERO, Vec3::new(3.0, 2.0, 4.0), wall, 12);
        let block = b.material(material);
        b.solid(Vec3::new(1.0, 0.5, 1.5), Vec3::new(2.0, 1.25, 2.5), block, 6);
        let scene = b.finish();
        let [walls, block] = samples(&scene, &one_round(PAGE), 0..32, |bake, e| {
            let mean = |wall: bool| {
                let of = |i: usize| (bake.solution.weights.instance[i] < 6) == wall && !bake.texels.texels[i].back;
                grey(area_mean(bake, e, of).as_vec3())
            };
            [mean(true), mean(false)]
        });
        expect_mean(&format!("{what}: walls"), &walls, PI * 5.0 / 0.4, 0.02, 6);
        expect_mean(&format!("{what}: block"), &block, PI * 5.0 / 0.4, 0.02, 6);
    }
}

/// A room with a window to the sun, a mirror, a block of glass and a rough metal, whose white floor spreads what they
/// throw.
fn glittering() -> Scene {
    let mut b = Builder::new(PAGE);
    let white = b.diffuse(0.7, 0.0);
    b.quad("floor", Vec3::ZERO, Vec3::Z * 4.0, Vec3::X * 4.0, white, [16; 2]);
    b.quad("left", Vec3::ZERO, Vec3::Y * 3.0, Vec3::Z * 4.0, white, [12, 16]);
    b.quad("back", Vec3::ZERO, Vec3::X * 4.0, Vec3::Y * 3.0, white, [16, 12]);
    let mirror = b.material(metal([0.9, 0.8, 0.5], 0.0));
    b.quad("mirror", Vec3::new(0.5, 0.02, 1.0), Vec3::Z * 1.5, Vec3::X, mirror, [6; 2]);
    let rough = b.material(metal([0.9; 3], 0.5));
    b.quad("rough", Vec3::new(4.0, 0.0, 0.0), Vec3::Z * 2.0, Vec3::Y * 2.0, rough, [6; 2]);
    let block = b.material(glass(true));
    b.solid(Vec3::new(2.25, 0.25, 2.0), Vec3::new(3.0, 1.0, 3.0), block, 4);
    b.light(Vec3::ZERO, Vec3::new(-0.4, -1.0, -0.3), 40.0, LightKind::Directional { angular_diameter: 0.01 });
    b.scene_mut().sky = Some(Sky::Constant(Vec3::new(1.0, 1.5, 2.0)));
    b.finish()
}

/// Photons and the audit's paths find the same light in `scene`.
fn expect_paths_to_agree(scene: &Scene) {
    let smooth = BakeOptions { smoothing: Smoothing::Cells, max_photons: Some(1 << 20), ..one_round(PAGE) };
    let bake = run(scene, &BakeOptions { target_percent: 5.0, audit: Audits::Texels(1000), ..smooth });
    let audit = bake.solution.audit.expect("audited");
    let off = audit.mean_difference_percent / audit.mean_difference_deviation;
    assert!(off.abs() < 4.0 && audit.mean_difference_deviation < 0.4, "{audit:?}");
}

#[test]
fn paths_find_the_specular_light_of_photons() {
    expect_paths_to_agree(&glittering());
}

/// So they do where a mirror throws light on a wall that has no map.
#[test]
fn light_thrown_on_what_has_no_map_is_not_lost() {
    let mut scene = glittering();
    // The wall that the mirror throws the sun at.
    scene.instances[1].bake = false;
    expect_paths_to_agree(&scene);
}

/// Small things in the dark part of a room, which gather, beside those that `furnish` puts there; these count nothing where
/// they are specular, for they would take more photons than the small ones.
fn dark_corner(furnish: impl FnOnce(&mut Builder)) -> Scene {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(0.6, 0.0);
    for k in 0..3 {
        b.quad("small", Vec3::new(0.25, 0.5, 2.6 + 0.3 * k as f32), Vec3::Z * 0.1, Vec3::X * 0.1, wall, [2; 2]);
    }
    b.l_room(wall, 8);
    furnish(&mut b);
    b.point_light(Vec3::new(3.5, 1.0, 0.5), 40.0);
    for (i, instance) in b.scene_mut().instances.iter_mut().enumerate() {
        instance.weight = if i < 3 {
            3000.0
        } else if instance.name.starts_with("solid") || ["mirror", "pane"].contains(&instance.name.as_str()) {
            0.0
        } else {
            1.0
        };
    }
    b.finish()
}

/// Things gather in `scene`, and what they gather is what paths find.
fn expect_gathered_light_to_agree(scene: &Scene) {
    let (mut meshes, mut differences) = (0, Vec::new());
    for seed in 0..16 {
        let options = BakeOptions {
            target_percent: 40.0,
            target_mesh_percent: Some(12.0),
            smoothing: Smoothing::Cells,
            audit: Audits::Texels(200),
            max_photons: Some(1 << 20),
            seed,
            ..one_round(PAGE)
        };
        let bake = run(scene, &options);
        meshes += bake.report.work.gathered_meshes;
        differences.push(bake.solution.audit.expect("audited").mean_difference_percent);
    }
    assert!(meshes >= 16, "only {meshes} times a thing gathered");
    // Their own noise is part of how far they scatter.
    let (mean, deviation) = mean_and_error(&differences);
    assert!(mean.abs() < 5.0 * deviation && deviation < 2.0, "{mean} +- {deviation} %: {differences:?}");
}

/// Beside a mirror, a pane and a block of glass.
#[test]
fn what_is_gathered_comes_over_mirrors_and_through_glass() {
    expect_gathered_light_to_agree(&dark_corner(|b| {
        let mirror = b.material(metal([0.9, 0.8, 0.6], 0.0));
        b.quad("mirror", Vec3::new(0.02, 0.1, 2.25), Vec3::Y * 1.6, Vec3::Z * 1.5, mirror, [4; 2]);
        let pane = b.material(Material { base_color: Vec4::new(0.9, 0.4, 0.4, 1.0), ..glass(false) });
        b.quad("pane", Vec3::new(0.1, 1.0, 2.25), Vec3::Z, Vec3::X * 1.5, pane, [4; 2]);
        let block = b.material(glass(true));
        b.solid(Vec3::new(0.5, 0.1, 2.5), Vec3::new(0.9, 0.9, 3.5), block, 2);
    }));
}

/// Passes more light diffusely than it reflects.
fn curtain() -> Material {
    Material {
        base_color: Vec4::new(0.8, 0.6, 0.3, 1.0),
        diffuse_transmission: 0.7,
        diffuse_transmission_color: Vec3::new(1.0, 0.8, 0.6),
        ..Material::default()
    }
}

/// Under an awning with a lamp above it.
#[test]
fn what_is_gathered_comes_through_awnings() {
    expect_gathered_light_to_agree(&dark_corner(|b| {
        let awning = b.material(curtain());
        b.quad("awning", Vec3::new(0.05, 0.9, 2.3), Vec3::Z * 1.2, Vec3::X * 1.2, awning, [6; 2]);
        b.point_light(Vec3::new(0.6, 1.7, 2.9), 10.0);
    }));
}

/// Curtains before mirrors and glass: the audit's paths look at both sides of each.
#[test]
fn paths_find_the_light_through_curtains() {
    let mut scene = glittering();
    // The wall that the mirror throws the sun at, and one of those around.
    scene.materials.push(curtain());
    let curtain = scene.materials.len() - 1;
    for wall in [1, 2] {
        let mesh = scene.instances[wall].mesh;
        scene.meshes[mesh].primitives[0].material = curtain;
    }
    expect_paths_to_agree(&scene);
}
