//! Two surfaces at the same place are one to the light, whichever stands first in the file.

mod common;

use common::rooms::{Builder, mean_where, plain, run};
use evenlight::BakeOptions;
use evenlight::options::{Smoothing, TexelValue};
use evenlight::scene::{Material, Scene};
use glam::{Vec3, Vec4};
use std::f64::consts::PI;

const PAGE: u32 = 128;
const RADIANCE: f32 = 2.0;
const ALBEDO: f32 = 0.6;
const TEXELS: u32 = 16;

/// A room of glowing walls in which every point receives pi L / (1 - rho), with a tile in the middle of its floor, in
/// the floor's own plane and off the floor's grid.
fn tiled_room(tile_first: bool, tile_two_sided: bool, floor_two_sided: bool) -> (Scene, [usize; 2]) {
    let mut b = Builder::new(PAGE);
    let mut glowing = |two_sided: bool| {
        b.material(Material {
            base_color: Vec4::new(ALBEDO, ALBEDO, ALBEDO, 1.0),
            emission: Vec3::splat(RADIANCE),
            double_sided: two_sided,
            ..Material::default()
        })
    };
    let [wall, tile, floor] = [false, tile_two_sided, floor_two_sided].map(&mut glowing);
    let (x, y, z) = (Vec3::X * 2.0, Vec3::Y * 3.0, Vec3::Z * 4.0);
    // No coordinate is a power of two.
    let lo = Vec3::new(-0.9, 0.1, -1.7);
    let t = [TEXELS; 2];
    let lay = |b: &mut Builder| {
        let [[z0, z1], [x0, x1]] = TILE.map(|side| side.map(|s| s as f32));
        b.quad("tile", lo + x0 * x + z0 * z, (z1 - z0) * z, (x1 - x0) * x, tile, [7, 9])
    };
    let early = tile_first.then(|| lay(&mut b));
    let ground = b.quad("floor", lo, z, x, floor, t);
    b.quad("-x", lo, y, z, wall, t);
    b.quad("+x", lo + x, z, y, wall, t);
    b.quad("+y", lo + y, x, z, wall, t);
    b.quad("-z", lo, x, y, wall, t);
    b.quad("+z", lo + z, y, x, wall, t);
    let tile = early.unwrap_or_else(|| lay(&mut b));
    (b.finish(), [ground, tile])
}

/// The tile's place in the floor along the floor's two sides.
const TILE: [[f64; 2]; 2] = [[0.31, 0.68], [0.23, 0.64]];

/// Share of a texel of the floor that the tile leaves open.
fn open_floor(texel: [u32; 2]) -> f64 {
    let covered = |k: usize| {
        let at = f64::from(texel[k]);
        ((at + 1.0).min(TILE[k][1] * f64::from(TEXELS)) - at.max(TILE[k][0] * f64::from(TEXELS))).max(0.0)
    };
    1.0 - covered(0) * covered(1)
}

#[test]
fn both_surfaces_show_the_light_of_the_one_in_front() {
    let truth = PI * f64::from(RADIANCE) / (1.0 - f64::from(ALBEDO));
    for (tile_first, tile_two_sided, floor_two_sided) in
        [(true, false, false), (false, false, false), (false, true, false), (true, false, true), (false, true, true)]
    {
        let case = format!("tile first {tile_first}, two-sided {tile_two_sided}, floor {floor_two_sided}");
        let (scene, nodes) = tiled_room(tile_first, tile_two_sided, floor_two_sided);
        let options = BakeOptions { texel_value: TexelValue::Open, smoothing: Smoothing::Cells, ..plain(PAGE, 2.0) };
        let bake = run(&scene, &options);
        assert!(bake.report.warnings.iter().any(|w| w.code == "coincident-surfaces"), "{case}: no warning");
        let page = &bake.lightmap.pages[0];
        for node in nodes {
            let uvs = &scene.meshes[node].primitives[0].tex_coords[1];
            let [lo, hi] = [uvs[0], uvs[2]].map(|uv| (uv * PAGE as f32).round().as_uvec2());
            let mut sum = 0.0;
            for (row, column) in (lo.y..hi.y).flat_map(|y| (lo.x..hi.x).map(move |x| (y, x))) {
                let e = f64::from(page.irradiance[(row * PAGE + column) as usize][1]);
                // How much of a texel is open is known to a few hundredths.
                let known = node != nodes[0] || !(0.01..0.3).contains(&open_floor([column - lo.x, row - lo.y]));
                assert!(
                    !known || (e / truth - 1.0).abs() < 0.25,
                    "{case}: node {node} has {e} at {column}, {row}, not {truth}"
                );
                sum += e;
            }
            let mean = sum / f64::from((hi - lo).element_product());
            assert!((mean / truth - 1.0).abs() < 0.02, "{case}: node {node} has {mean} on average, not {truth}");
        }
    }
}

/// A lamp let into a ceiling lights the floor as one just below does, whichever sides both have and whatever touches
/// the ceiling from outside.
#[test]
fn a_lamp_in_the_plane_of_the_ceiling_shines() {
    let floor_light = |ceiling_sides: bool, lamp_sides: bool, lamp_up: bool, drop: f32| {
        let mut b = Builder::new(PAGE);
        let sided = |b: &mut Builder, two_sided: bool, radiance: f32| {
            b.material(Material {
                base_color: Vec4::new(0.0, 0.0, 0.0, 1.0),
                emission: Vec3::splat(radiance),
                double_sided: two_sided,
                ..Material::default()
            })
        };
        let ceiling = sided(&mut b, ceiling_sides, 0.0);
        let lamp = sided(&mut b, lamp_sides, 5.0);
        let cap = sided(&mut b, true, 0.0);
        let (x, z) = (Vec3::X * 3.1, Vec3::Z * 2.7);
        let height = Vec3::Y * 1.9;
        let floor = b.quad("floor", Vec3::ZERO, z, x, ceiling, [16, 16]);
        b.quad("ceiling", height, x, z, ceiling, [16, 16]);
        let at = height + 0.3 * x + 0.4 * z - Vec3::Y * drop;
        if lamp_up {
            b.quad("lamp", at, 0.2 * z, 0.2 * x, lamp, [4, 4]);
        } else {
            b.quad("lamp", at, 0.2 * x, 0.2 * z, lamp, [4, 4]);
        }
        b.quad("foot of a column", height + 0.1 * x + 0.1 * z, 0.8 * z, 0.15 * x, cap, [4, 8]);
        let scene = b.finish();
        let bake = run(&scene, &BakeOptions { texel_value: TexelValue::Open, ..plain(PAGE, 5.0) });
        mean_where(&bake, floor, |_| true).0
    };
    for (ceiling, lamp, up) in [(false, false, false), (false, true, false), (false, true, true), (true, true, true)] {
        let [flush, below] = [0.0, 0.001].map(|drop| floor_light(ceiling, lamp, up, drop));
        let case = format!("ceiling two-sided {ceiling}, lamp two-sided {lamp}, turned up {up}");
        assert!((flush / below - 1.0).abs() < 0.02, "{case}: {flush}, not {below}");
    }
}

/// Two one-sided walls back to back, with a picture in the plane of one of them: both rooms keep their light.
#[test]
fn a_picture_on_one_of_two_walls_back_to_back_darkens_neither() {
    let light = |picture: bool| {
        let mut b = Builder::new(PAGE);
        let m = b.diffuse(0.0, 0.0);
        let (y, z) = (Vec3::Y * 2.3, Vec3::Z * 3.1);
        let right = b.quad("right", Vec3::ZERO, y, z, m, [12, 12]);
        let left = b.quad("left", Vec3::ZERO, z, y, m, [12, 12]);
        if picture {
            b.quad("picture", 0.4 * y + 0.3 * z, 0.21 * y, 0.17 * z, m, [5, 5]);
        }
        b.point_light(Vec3::new(1.1, 1.0, 1.5), 10.0);
        b.point_light(Vec3::new(-1.3, 1.0, 1.5), 20.0);
        let scene = b.finish();
        let bake = run(&scene, &BakeOptions { texel_value: TexelValue::Open, ..plain(PAGE, 1.0) });
        [right, left].map(|node| mean_where(&bake, node, |p| p.z < 0.8).0)
    };
    let (with, without) = (light(true), light(false));
    for (a, b) in with.into_iter().zip(without) {
        assert!(b > 0.5 && (a / b - 1.0).abs() < 0.02, "{with:?}, not {without:?}");
    }
}

/// Faces that look away from each other are the two sides of a wall, and meet the light of two rooms.
#[test]
fn backs_of_one_sided_faces_stay_where_they_are() {
    let mut b = Builder::new(PAGE);
    let m = b.diffuse(0.5, 0.0);
    b.quad("right", Vec3::ZERO, Vec3::Y, Vec3::Z, m, [8, 8]);
    b.quad("left", Vec3::ZERO, Vec3::Z, Vec3::Y, m, [8, 8]);
    b.point_light(Vec3::new(1.0, 0.5, 0.5), 10.0);
    let scene = b.finish();
    let bake = run(&scene, &plain(PAGE, 10.0));
    assert!(!bake.report.warnings.iter().any(|w| w.code == "coincident-surfaces"));
    assert!(bake.world.positions.iter().flatten().all(|p| *p == bake.world.positions[0][0] || p.x == 0.0));
}
