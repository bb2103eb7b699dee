//! The error of bilinear filtering against formulas: exact means of texels are filtered and compared with the
//! irradiance at a fine grid of points. What bakes say of it, over a number of seeds, must agree at a level of 1e-6 per
//! scene, and the comparison must tell a tenth of its square.

mod common;

use common::formulas::{QuadMap, point_irradiance, polygon_irradiance};
use common::rooms::{Builder, plain, run};
use common::stage::Stage;
use evenlight::BakeOptions;
use evenlight::accuracy::{Halves, Moments, TexelWeights};
use evenlight::light::Visibility;
use evenlight::lightmap::{GridPoints, LightmapPage, fill_gutters};
use evenlight::scene::Scene;
use glam::{DVec3, Vec3};

const PAGE: u32 = 48;

/// Points per side of a texel: with 32 the edge of the shadow is so far off that its error is 2 % too small.
const FINE: u32 = 128;

/// A floor of 4 m, 32 texels squared, and whatever else is in the scene without a map.
fn floor() -> Builder {
    let mut b = Builder::new(PAGE);
    let grey = b.diffuse(0.0, 0.0);
    b.quad("floor", Vec3::new(-2.0, 0.0, -2.0), Vec3::Z * 4.0, Vec3::X * 4.0, grey, [32; 2]);
    b
}

/// A page of exact means of `e`, and the RMS of filtering it against `e`, in percent of the mean.
fn exact(quad: &QuadMap, e: &dyn Fn(DVec3) -> f64) -> (LightmapPage, f64) {
    let texel = |x: u32, y: u32| -> Vec<f64> {
        let at = |k: u32| (f64::from(k) + 0.5) / f64::from(FINE);
        (0..FINE * FINE).map(|k| e(quad.point(x, y, at(k % FINE), at(k / FINE)))).collect()
    };
    let cells: Vec<[u32; 2]> = (0..PAGE * PAGE)
        .map(|i| [i % PAGE, i / PAGE])
        .filter(|c| (0..2).all(|k| (quad.origin[k]..quad.origin[k] + quad.texels[k]).contains(&c[k])))
        .collect();
    let inside: Vec<Vec<f64>> = cells.iter().map(|&[x, y]| texel(x, y)).collect();
    let n = (PAGE * PAGE) as usize;
    let mut page = LightmapPage {
        width: PAGE,
        height: PAGE,
        irradiance: vec![[0.0; 3]; n],
        half_difference: vec![[0.0; 3]; n],
        coverage: vec![0.0; n],
        ..LightmapPage::default()
    };
    for (&[x, y], inside) in cells.iter().zip(&inside) {
        let i = (y * PAGE + x) as usize;
        page.irradiance[i] = [(inside.iter().sum::<f64>() / f64::from(FINE * FINE)) as f32; 3];
        page.coverage[i] = 1.0;
    }
    fill_gutters(&mut page, 1);
    let filtered = |x: f64, y: f64| {
        let (x, y) = (x - 0.5, y - 0.5);
        let (s, t) = (x - x.floor(), y - y.floor());
        let texel = |dx: f64, dy: f64| {
            let i = (y.floor() + dy) as usize * PAGE as usize + (x.floor() + dx) as usize;
            f64::from(page.irradiance[i][0])
        };
        let row = |dy: f64| texel(0.0, dy) * (1.0 - s) + texel(1.0, dy) * s;
        row(0.0) * (1.0 - t) + row(1.0) * t
    };
    let (mut square, mut sum) = (0.0, 0.0);
    for (&[x, y], inside) in cells.iter().zip(&inside) {
        for (k, e) in (0..).zip(inside) {
            let at = |k: u32| (f64::from(k) + 0.5) / f64::from(FINE);
            square += (filtered(f64::from(x) + at(k % FINE), f64::from(y) + at(k / FINE)) - e).powi(2);
            sum += e;
        }
    }
    let n = inside.len() as f64 * f64::from(FINE * FINE);
    (page, 100.0 * (square / n).sqrt() / (sum / n))
}

fn agrees(what: &str, scene: &Scene, options: &BakeOptions, e: &dyn Fn(DVec3, DVec3) -> f64) {
    const SEEDS: u64 = 64;
    let quad = QuadMap::of(scene, 0, PAGE);
    let expected = exact(&quad, &|p| e(p, quad.normal)).1.powi(2);
    let (mut square, mut variance) = (0.0, 0.0);
    for seed in 0..SEEDS {
        let bake = run(scene, &BakeOptions { seed, ..options.clone() });
        square += bake.report.texel_grid_error.powi(2) / SEEDS as f64;
        variance += bake.report.texel_grid_resolution.powi(4) / (SEEDS * SEEDS) as f64;
    }
    let spread = 4.9 * variance.sqrt();
    assert!(spread < 0.1 * expected, "{what}: {} of {} is not resolved", spread.sqrt(), expected.sqrt());
    let off = (square - expected).abs();
    assert!(off <= spread, "{what}: {} % expected, {} found, off by {off} of {spread}", expected.sqrt(), square.sqrt());
}

/// Curved light without edges, and with those of the chart, beyond which nothing is known.
#[test]
fn point_light_near_a_floor() {
    let mut b = floor();
    let at = Vec3::new(0.3, 0.4, -0.2);
    b.point_light(at, 100.0);
    let e = |p: DVec3, n: DVec3| point_irradiance(p, n, at.as_dvec3(), 100.0);
    agrees("point light", &b.finish(), &plain(PAGE, 2.0), &e);
}

#[test]
fn edge_of_a_shadow() {
    let mut b = floor();
    let black = b.diffuse(0.0, 0.0);
    let blocker = b.quad("blocker", Vec3::new(-0.4, 1.0, -0.5), Vec3::Z, Vec3::X * 0.9, black, [1; 2]);
    let at = Vec3::new(0.3, 3.0, -0.2);
    b.point_light(at, 100.0);
    let mut scene = b.finish();
    scene.instances[blocker].bake = false;
    let e = |p: DVec3, n: DVec3| {
        let at = at.as_dvec3();
        let through = at + (p - at) * ((at.y - 1.0) / (at.y - p.y));
        let blocked = (-0.4..0.5).contains(&through.x) && (-0.5..0.5).contains(&through.z);
        if blocked { 0.0 } else { point_irradiance(p, n, at, 100.0) }
    };
    agrees("shadow", &scene, &plain(PAGE, 2.0), &e);
}

fn lamp_corners() -> [DVec3; 4] {
    [DVec3::new(-0.3, 0.5, -0.3), DVec3::new(0.3, 0.5, -0.3), DVec3::new(0.3, 0.5, 0.3), DVec3::new(-0.3, 0.5, 0.3)]
}

/// Light of a surface, sampled at the points.
#[test]
fn lamp_near_a_floor() {
    let corners = lamp_corners();
    let mut b = floor();
    let bright = b.diffuse(0.0, 50.0);
    let lamp = b.quad("lamp", corners[0].as_vec3(), Vec3::X * 0.6, Vec3::Z * 0.6, bright, [1; 2]);
    let mut scene = b.finish();
    scene.instances[lamp].bake = false;
    let e = |p: DVec3, n: DVec3| polygon_irradiance(p, n, &corners, 50.0);
    agrees("lamp", &scene, &plain(PAGE, 2.0), &e);
}

/// The same light taken for reflected, which texels alone tell of.
#[test]
fn reflected_light_near_a_floor() {
    let corners = lamp_corners();
    let scene = floor().finish();
    let quad = QuadMap::of(&scene, 0, PAGE);
    let (page, expected) = exact(&quad, &|p| polygon_irradiance(p, quad.normal, &corners, 50.0));
    let stage = Stage::new(&scene, PAGE);
    let visibility = Visibility::new(&stage.world, &stage.accel);
    let open = vec![1.0; stage.texels.mapped];
    let exact: Vec<Vec3> = (0..stage.texels.mapped)
        .map(|i| {
            let (_, x, y) = stage.texels.page_position(i);
            page.irradiance[(y * PAGE + x) as usize].into()
        })
        .collect();
    let points = GridPoints {
        seed: 0,
        light: stage.light(&visibility, &open),
        weights: &TexelWeights::new(&stage.world, &stage.texels, &open),
        indirect: &Halves { odd: exact.clone(), even: exact.clone() },
        whole: true,
        split: false,
    };
    let mut square = Moments::default();
    points.deviations(&[(&[page][..], 1)], 1 << 17, 0..1).iter().for_each(|d| square.add(d.squares[0]));
    let mean = exact.iter().map(|e| f64::from(e.x)).sum::<f64>() / exact.len() as f64;
    let found = 100.0 * square.mean().sqrt() / mean;
    // What a quadratic leaves of it is the rest.
    assert!((found / expected - 1.0).abs() < 0.05, "{found} % of {expected}");
}
