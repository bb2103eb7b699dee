//! Bakes against formulas. Every comparison is a Student test over the halves of bakes with fixed seeds at a
//! level of 1e-6 per test; the last numbers of `expect_mean` are the relative deviation that it is sure to see
//! (power 99 %) and the number of comparisons that share the level.

mod common;

use common::formulas::{QuadMap, disc_irradiance, point_irradiance, polygon_irradiance};
use common::rooms::{Builder, plain, run};
use common::runs::{self, area_mean, flux, grey, node_mean, one_round, samples};
use common::statistics::expect_mean;
use evenlight::options::{Lights, SkySource, Sun};
use evenlight::scene::{ClearSky, LightKind, Material, Scene, Sky};
use evenlight::{Bake, BakeOptions};
use glam::{DVec3, Vec3, Vec4};
use std::f64::consts::PI;

/// Nothing leaves a closed room.
fn assert_closed(scene: &Scene, options: &BakeOptions) {
    let ledger = run(scene, options).solution.ledger;
    assert_eq!((ledger.escaped, ledger.cut, ledger.back_absorbed), ([0; 3], [0; 3], [0; 3]));
}

/// Every wall emits L and reflects rho, so E = pi L / (1 - rho) in every texel, in each channel with its own L
/// and rho.
#[test]
fn furnace() {
    let mut b = Builder::new(128);
    let wall = b.material(Material {
        base_color: Vec4::new(0.2, 0.5, 0.8, 1.0),
        emission: Vec3::new(1.0, 2.0, 3.0),
        ..Material::default()
    });
    b.room(Vec3::new(-1.0, -2.0, -1.5), Vec3::new(1.0, 2.0, 1.5), wall, 12);
    let scene = b.finish();
    assert_closed(&scene, &one_round(128));
    let whole = samples(&scene, &one_round(128), 0..48, |bake, e| area_mean(bake, e, |_| true).to_array());
    for (c, (l, rho)) in [(1.0, 0.2), (2.0, 0.5), (3.0, 0.8)].into_iter().enumerate() {
        expect_mean("channel", &whole[c], PI * l / (1.0 - rho), 0.02, 3);
    }
    let walls = samples(&scene, &one_round(128), 100..124, |bake, e| {
        std::array::from_fn::<_, 6, _>(|i| {
            let of_wall = |t: usize| bake.solution.weights.instance[t] as usize == i;
            area_mean(bake, e, of_wall).y
        })
    });
    for wall in &walls {
        expect_mean("wall", wall, PI * 2.0 / 0.5, 0.04, 6);
    }
}

/// The same in an L-shaped room, whose walls do not all see each other.
#[test]
fn furnace_round_a_corner() {
    let mut b = Builder::new(128);
    let wall = b.diffuse(0.6, 5.0);
    b.l_room(wall, 8);
    let scene = b.finish();
    assert_closed(&scene, &one_round(128));
    let [mean] = samples(&scene, &one_round(128), 0..48, |bake, e| [grey(area_mean(bake, e, |_| true).as_vec3())]);
    expect_mean("mean", &mean, PI * 5.0 / 0.4, 0.02, 1);
}

/// In a closed room with the same rho everywhere, sum E a = Phi / (1 - rho) whatever its shape.
fn integrating_sphere(what: &str, scene: &Scene, page: u32, source: f64, rho: f64) {
    assert_closed(scene, &one_round(page));
    let [received] = samples(scene, &one_round(page), 0..32, |bake, e| [flux(bake, e)]);
    expect_mean(what, &received, source / (1.0 - rho), 0.015, 1);
}

#[test]
fn integrating_box() {
    let mut b = Builder::new(128);
    let wall = b.diffuse(0.7, 0.0);
    b.room(Vec3::new(0.0, 0.0, 0.0), Vec3::new(3.0, 2.0, 5.0), wall, 12);
    b.point_light(Vec3::new(1.0, 1.5, 1.25), 40.0);
    integrating_sphere("box", &b.finish(), 128, 4.0 * PI * 40.0, 0.7);
}

#[test]
fn integrating_l_room() {
    let mut b = Builder::new(128);
    let wall = b.diffuse(0.6, 0.0);
    b.l_room(wall, 8);
    b.point_light(Vec3::new(3.0, 1.0, 1.0), 40.0);
    integrating_sphere("L-shaped room", &b.finish(), 128, 4.0 * PI * 40.0, 0.6);
}

#[test]
fn integrating_icosphere() {
    let mut b = Builder::new(128);
    let wall = b.diffuse(0.75, 0.0);
    b.inner_sphere(2.0, 2, wall, 4);
    b.point_light(Vec3::new(0.5, -0.75, 0.25), 40.0);
    integrating_sphere("icosphere", &b.finish(), 128, 4.0 * PI * 40.0, 0.75);
}

#[test]
fn integrating_room_with_a_box() {
    let mut b = Builder::new(128);
    let wall = b.diffuse(0.7, 0.0);
    b.room(Vec3::ZERO, Vec3::new(4.0, 3.0, 4.0), wall, 12);
    b.solid(Vec3::new(0.5, 1.0, 0.5), Vec3::new(2.5, 2.0, 1.5), wall, 8);
    b.point_light(Vec3::new(3.0, 0.5, 3.0), 40.0);
    integrating_sphere("room with a box", &b.finish(), 128, 4.0 * PI * 40.0, 0.7);
}

/// A lamp with faces on all sides sends out pi L times its area.
#[test]
fn integrating_room_with_a_lamp() {
    let mut b = Builder::new(128);
    let wall = b.diffuse(0.5, 0.0);
    b.room(Vec3::ZERO, Vec3::new(4.0, 3.0, 4.0), wall, 12);
    let lamp = b.diffuse(0.5, 100.0);
    b.solid(Vec3::new(1.0, 1.5, 1.5), Vec3::new(2.0, 2.0, 2.0), lamp, 6);
    let area = 2.0 * (1.0 * 0.5 + 0.5 * 0.5 + 1.0 * 0.5);
    integrating_sphere("room with a lamp", &b.finish(), 128, PI * 100.0 * area, 0.5);
}

/// A floor of 4 m, 16 texels squared: the first node of the scenes of open planes.
fn floor(b: &mut Builder) {
    let grey = b.diffuse(0.5, 0.0);
    b.quad("floor", Vec3::new(-2.0, 0.0, -2.0), Vec3::Z * 4.0, Vec3::X * 4.0, grey, [16; 2]);
}

const PAGE: u32 = 64;

/// Every texel of the first node against the mean over the texel of `e(position, normal)`.
fn expect_texels(what: &str, scene: &Scene, seeds: u64, e: impl Fn(DVec3, DVec3) -> f64) {
    runs::expect_texels(what, scene, PAGE, seeds, e);
}

#[test]
fn inverse_square_on_a_plane() {
    let mut b = Builder::new(PAGE);
    floor(&mut b);
    b.point_light(Vec3::new(0.5, 1.0, -0.25), 100.0);
    expect_texels("point light", &b.finish(), 32, |p, n| point_irradiance(p, n, DVec3::new(0.5, 1.0, -0.25), 100.0));
}

/// glTF's spot: the square of a linear ramp in the cosine between both cones.
#[test]
fn spot_on_a_plane() {
    let mut b = Builder::new(PAGE);
    floor(&mut b);
    let (at, towards) = (Vec3::new(-1.0, 2.0, 0.5), Vec3::new(1.0, -2.0, -0.5).normalize());
    let (inner, outer) = (0.3f32, 0.9f32);
    b.light(at, towards, 100.0, LightKind::Spot { inner, outer });
    let (ci, co) = (f64::from(inner).cos(), f64::from(outer).cos());
    let scene = b.finish();
    let quad = QuadMap::of(&scene, 0, PAGE);
    // The ramp has kinks: 64 x 64 midpoints per block of 4 x 4 texels, the blocks as independent figures.
    let formula = |p: DVec3| {
        let cosine = (p - at.as_dvec3()).normalize().dot(towards.as_dvec3().normalize());
        let ramp = ((cosine - co) / (ci - co)).clamp(0.0, 1.0);
        point_irradiance(p, quad.normal, at.as_dvec3(), 100.0) * ramp * ramp
    };
    runs::expect_blocks(&scene, PAGE, 32, formula);
    let [total] = samples(&scene, &one_round(PAGE), 100..132, |bake, e| [node_mean(bake, e, 0)]);
    expect_mean("whole plane", &total, quad.mean([0.0; 2], 1.0, 1024, formula), 0.005, 1);
}

/// A directional light gives its lux on a plane facing it, and the cosine of that on others; so does a sun with
/// a disc, wherever the whole disc is above the horizon.
#[test]
fn directional_and_sun_disc() {
    for angular_diameter in [0.0f32, 0.0093, 0.5, 1.2] {
        let mut b = Builder::new(PAGE);
        floor(&mut b);
        let towards = Vec3::new(0.5, 1.0, 0.25).normalize();
        b.light(Vec3::ZERO, -towards, 1000.0, LightKind::Directional { angular_diameter });
        let expected = 1000.0 * f64::from(towards.y);
        expect_texels(&format!("sun of {angular_diameter}"), &b.finish(), 32, |_, _| expected);
    }
}

/// A sky of one radiance gives pi L on an open plane, and half of it on an open wall over a black ground.
#[test]
fn constant_sky_on_open_planes() {
    let mut b = Builder::new(PAGE);
    floor(&mut b);
    b.scene_mut().sky = Some(Sky::Constant(Vec3::splat(7.0)));
    expect_texels("sky", &b.finish(), 2, |_, _| PI * 7.0);
}

/// A sky image on a plane: the sum over its pixels of L times the integral of the cosine over the pixel.
#[test]
fn sky_image_on_an_open_plane() {
    let (width, height) = (8, 4);
    // Bright spots of very different strength, one above and one below the horizon.
    let radiance: Vec<Vec3> =
        (0..width * height).map(|i| Vec3::splat(if i == 11 { 500.0 } else { 1.0 + (i % 5) as f32 })).collect();
    let mut b = Builder::new(PAGE);
    floor(&mut b);
    b.scene_mut().sky = Some(Sky::Image { width, height, radiance: radiance.clone().into(), rotation: 0.4 });
    let mut expected = 0.0;
    for y in 0..height / 2 {
        // The integral of cos theta sin theta over the row, times the width of a pixel.
        let s = |k: usize| (k as f64 / height as f64 * PI).sin().powi(2);
        let cosine = 0.5 * (s(y + 1) - s(y)) * 2.0 * PI / width as f64;
        expected += (0..width).map(|x| f64::from(radiance[y * width + x].x) * cosine).sum::<f64>();
    }
    expect_texels("sky image", &b.finish(), 32, |_, _| expected);
}

/// Centre of a disc above a small texel: pi L R^2 / (R^2 + h^2). The disc is a polygon of 256 triangles, whose
/// own irradiance by Lambert's formula differs by 0.01 %.
#[test]
fn disc_over_its_axis() {
    let mut b = Builder::new(PAGE);
    let grey = b.diffuse(0.5, 0.0);
    b.quad("texel", Vec3::new(-0.01, 0.0, -0.01), Vec3::Z * 0.02, Vec3::X * 0.02, grey, [1; 2]);
    let lamp = b.diffuse(0.0, 50.0);
    let corners = disc(&mut b, lamp, 0.75, 1.0, 256);
    let scene = b.finish();
    let [found] = samples(&scene, &one_round(PAGE), 0..200, |bake, e| [node_mean(bake, e, 0)]);
    let polygon = polygon_irradiance(DVec3::ZERO, DVec3::Y, &corners, 50.0);
    assert!((polygon / disc_irradiance(0.75, 1.0, 50.0) - 1.0).abs() < 2e-4);
    expect_mean("disc", &found, polygon, 0.02, 1);
}

/// A fan of triangles that shines downwards at `height`; its corners, counter-clockwise from below.
fn disc(b: &mut Builder, material: usize, radius: f32, height: f32, n: u32) -> Vec<DVec3> {
    let rim: Vec<Vec3> = (0..n)
        .map(|i| {
            let (s, c) = (i as f32 / n as f32 * std::f32::consts::TAU).sin_cos();
            Vec3::new(radius * c, height, radius * s)
        })
        .collect();
    let mut positions = vec![Vec3::new(0.0, height, 0.0)];
    positions.extend(&rim);
    let uvs = positions.iter().map(|p| glam::Vec2::new(0.7 + 0.2 * p.x, 0.7 + 0.2 * p.z)).collect();
    let triangles = (0..n).map(|i| [0, 1 + i, 1 + (i + 1) % n]).collect();
    b.triangles("disc", positions, uvs, triangles, material);
    rim.iter().map(|p| p.as_dvec3()).collect()
}

/// Lambert's formula for a lamp of two triangles and one of many, flat above the plane and standing upright on it.
#[test]
fn polygon_lamps_on_a_plane() {
    let lamp_at = |corner: Vec3, u: Vec3, v: Vec3| {
        let mut b = Builder::new(PAGE);
        floor(&mut b);
        let lamp = b.diffuse(0.0, 50.0);
        b.quad("lamp", corner, u, v, lamp, [4; 2]);
        let corners = [corner, corner + u, corner + u + v, corner + v].map(|p| p.as_dvec3());
        (b.finish(), corners.to_vec())
    };
    let mut many = Builder::new(PAGE);
    floor(&mut many);
    let material = many.diffuse(0.0, 50.0);
    let rim = disc(&mut many, material, 0.6, 0.8, 48);
    let lamps = [
        ("flat", lamp_at(Vec3::new(-0.5, 1.0, -0.5), Vec3::X, Vec3::Z * 2.0)),
        ("upright", lamp_at(Vec3::new(-2.125, 0.25, -0.5), Vec3::Y, Vec3::Z)),
        ("disc of 48 triangles", (many.finish(), rim)),
    ];
    for (what, (scene, corners)) in lamps {
        expect_texels(what, &scene, 48, |p, n| polygon_irradiance(p, n, &corners, 50.0));
    }
}

/// View factors of the unit cube: to the opposite face 0.1998249, to each other 0.2000438.
#[test]
fn view_factors_of_the_cube() {
    let mut b = Builder::new(64);
    let black = b.diffuse(0.0, 0.0);
    b.room(Vec3::ZERO, Vec3::ONE, black, 8);
    let lamp = b.diffuse(0.0, std::f32::consts::FRAC_1_PI);
    b.scene_mut().meshes[0].primitives[0].material = lamp;
    // To an error of 1 %: an effort chosen by the estimate moves the mean by far less than its own noise.
    let faces = samples(&b.finish(), &plain(64, 1.0), 0..32, |bake, e| {
        std::array::from_fn::<_, 6, _>(|i| node_mean(bake, e, i))
    });
    assert!(faces[0].iter().all(|&e| e == 0.0), "a face does not see itself");
    for (i, face) in faces.iter().enumerate().skip(1) {
        expect_mean("view factor", face, if i == 1 { 0.199_824_9 } else { 0.200_043_8 }, 0.005, 5);
    }
}

/// Scene CUBE of the Keldysh institute's lighting tests: inside of a 10 m cube, point light of 50 000 cd in its
/// centre, all walls diffuse 2/3. Luminances by solving the radiosity equation (Gauss-Legendre, extrapolated).
///
/// They are values at points. What is compared is the indirect part, which is smooth: the mean over the blocks of
/// 4 x 4 texels (1 m) about each point and about all that the cube's symmetry maps to it, against the luminance
/// less the direct part by its formula. At the corner, where the indirect part has a gradient, a parabola through
/// the means of the first three texels on the diagonal is extended to the corner. What either does to the exact
/// solution is under 0.1 % and 0.6 % of it, and allowed for.
#[test]
fn cube_with_point_light() {
    let rho = 2.0 / 3.0;
    let mut b = Builder::new(256);
    let grey_wall = b.diffuse(rho as f32, 0.0);
    b.room(Vec3::splat(-5.0), Vec3::splat(5.0), grey_wall, 40);
    b.point_light(Vec3::ZERO, 50_000.0);
    let scene = b.finish();
    assert_closed(&scene, &one_round(256));
    let quads: Vec<QuadMap> = (0..6).map(|i| QuadMap::of(&scene, i, 256)).collect();
    // Sum and number of the luminances of all texels that the cube's symmetry maps to one another: column and row
    // counted from the middle of the face, both ways, the larger last.
    let by_symmetry = |bake: &Bake, e: &[Vec3]| {
        let mut sums = [[[0.0, 0.0]; 20]; 20];
        for i in 0..bake.texels.mapped {
            let quad = &quads[bake.solution.weights.instance[i] as usize];
            let (_, x, y) = bake.texels.page_position(i);
            let fold = |k: u32| if k < 20 { 19 - k } else { k - 20 } as usize;
            let (a, b) = (fold(x - quad.origin[0]), fold(y - quad.origin[1]));
            let sum = &mut sums[a.min(b)][a.max(b)];
            *sum = [sum[0] + grey(e[i]) * rho / PI, sum[1] + 1.0];
        }
        sums
    };
    let options =
        BakeOptions { lights: Lights::Indirect, target_percent: 0.01, max_photons: Some(1 << 19), ..one_round(256) };
    let figures = samples(&scene, &options, 0..16, |bake, e| {
        let sums = by_symmetry(bake, e);
        let mean = |columns: &[usize], rows: &[usize]| {
            let mut total = [0.0, 0.0];
            for (&a, &b) in columns.iter().flat_map(|a| rows.iter().map(move |b| (a, b))) {
                let [sum, n] = sums[a.min(b)][a.max(b)];
                total = [total[0] + sum, total[1] + n];
            }
            total[0] / total[1]
        };
        // Two texels on either side of the middle, and of 2.5 m.
        let (middle, half) = (&[0, 1], &[8, 9, 10, 11]);
        let diagonal = [19, 18, 17].map(|k| mean(&[k], &[k]));
        let corner = (15.0 * diagonal[0] - 10.0 * diagonal[1] + 3.0 * diagonal[2]) / 8.0;
        let whole = area_mean(bake, e, |_| true).x * rho / PI;
        [mean(middle, middle), mean(half, middle), mean(half, half), corner, whole]
    });
    let direct = |x: f64, y: f64| {
        point_irradiance(DVec3::new(5.0 * x, 5.0 * y, -5.0), DVec3::Z, DVec3::ZERO, 50_000.0) * rho / PI
    };
    let points = [(0.0, 0.0, 892.8), (0.5, 0.0, 768.7), (0.5, 0.5, 686.7), (1.0, 1.0, 388.4)];
    for (k, (x, y, luminance)) in points.into_iter().enumerate() {
        let (systematic, visible) = if k == 3 { (0.006, 0.15) } else { (0.001, 0.03) };
        let expected = luminance - direct(x, y);
        expect_near(&format!("({x}, {y})"), &figures[k], expected, systematic * luminance, visible, 5);
    }
    let source = 4.0 * PI * 50_000.0 * rho / PI / 600.0;
    assert!((source / (1.0 - rho) - 666.67).abs() < 0.01);
    expect_mean("mean of the faces", &figures[4], source * rho / (1.0 - rho), 0.005, 5);
}

/// [`expect_mean`] where the comparison itself is off by up to `systematic`.
fn expect_near(what: &str, samples: &[f64], expected: f64, systematic: f64, visible: f64, tests: usize) {
    let (mean, _) = common::statistics::mean_and_error(samples);
    let nearest = expected + (mean - expected).clamp(-systematic, systematic);
    println!("{what}: {mean} for {expected}");
    expect_mean(what, samples, nearest, visible, tests);
}

/// Open ground under a clear sky gets what its pixels send, weighed by the cosine.
#[test]
fn clear_sky_on_the_ground() {
    let mut b = Builder::new(PAGE);
    floor(&mut b);
    let scene = b.finish();
    let sun = Sun { elevation: 35.0, azimuth: 110.0, illuminance: 0.0, diameter: 0.53 };
    let sky = Some(SkySource::Clear { turbidity: 2.5, ground: 0.2 });
    let options = BakeOptions { sky, sun: Some(sun), sky_scale: 0.5, ..one_round(PAGE) };
    let clear = ClearSky { turbidity: 2.5, ground: 0.2, towards_sun: sun.towards() };
    let Ok(Sky::Image { width, height, radiance, .. }) = clear.image(1.0) else { panic!("an image") };
    let sin2 = |y: usize| (y as f64 * PI / height as f64).sin().powi(2);
    let expected: f64 = (0..height / 2)
        .map(|y| {
            let row: f64 = radiance[y * width..(y + 1) * width].iter().map(|&l| grey(l)).sum();
            row * (sin2(y + 1) - sin2(y)) * PI / width as f64
        })
        .sum();
    let [mean] = samples(&scene, &options, 0..32, |bake, e| [node_mean(bake, e, 0)]);
    expect_mean("ground", &mean, 0.5 * expected, 0.02, 1);
}
