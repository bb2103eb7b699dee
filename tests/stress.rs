//! Numbers at the ends of their range: huge and tiny scenes, far from the origin, bright beside dim, and geometry that
//! no modeller means to make. Each must bake without a panic and without a texel that is no irradiance, and each photon
//! step must be accounted for.

mod common;

use common::rooms::{Builder, plain, run};
use common::runs::{node_mean, one_round, samples};
use common::stage::Stage;
use common::statistics::{ALPHA, normal_upper_quantile, sidak, welch_score};
use evenlight::options::Smoothing;
use evenlight::photon::{Bins, Deposit, DepositSink, Trail};
use evenlight::scene::Scene;
use evenlight::{Bake, BakeOptions};
use glam::{DVec3, Vec2, Vec3};

/// Texels of the page, squared.
const PAGE: u32 = 64;

/// A closed room with a point light, an emissive quad and a box, all corners and lights at multiples of 1/4 m.
fn furnished() -> Scene {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(0.5, 0.0);
    b.room(Vec3::ZERO, Vec3::new(4.0, 3.0, 4.0), wall, 8);
    b.solid(Vec3::new(0.5, 0.25, 0.5), Vec3::new(1.5, 1.25, 1.5), wall, 4);
    let lamp = b.diffuse(0.25, 20.0);
    b.quad("lamp", Vec3::new(2.0, 2.5, 2.0), Vec3::X, Vec3::Z, lamp, [4; 2]);
    b.point_light(Vec3::new(2.5, 1.5, 1.0), 10.0);
    b.finish()
}

/// Every position through `place`.
fn moved(mut scene: Scene, place: impl Fn(DVec3) -> DVec3) -> Scene {
    for p in scene.meshes.iter_mut().flat_map(|m| &mut m.primitives).flat_map(|p| &mut p.positions) {
        *p = place(p.as_dvec3()).as_vec3();
    }
    scene.lights.iter_mut().for_each(|l| l.position = place(l.position));
    scene
}

/// Several rounds, with cells and gathering.
fn several_rounds() -> BakeOptions {
    BakeOptions { smoothing: Smoothing::Cells, max_photons: Some(1 << 15), ..plain(PAGE, 3.0) }
}

/// Irradiance of both halves of every texel, over `factor`.
fn halves(bake: &Bake, factor: f32) -> Vec<[f32; 3]> {
    let total = &bake.solution.total;
    total.odd.iter().chain(&total.even).map(|e| (*e / factor).to_array()).collect()
}

/// Same bits: no texel is no number, so that equality says it.
fn assert_same(what: &str, a: &[[f32; 3]], b: &[[f32; 3]]) {
    assert_eq!(a.len(), b.len(), "{what}");
    let differing = a.iter().zip(b).filter(|(a, b)| a != b).count();
    assert_eq!(differing, 0, "{what}: {differing} of {} values differ", a.len());
}

/// A scene from a thousandth of a millimetre per metre to a thousand kilometres per metre, its light such that irradiance
/// stays: the same bits. Light alone over the same range: bits times that.
#[test]
fn powers_of_two_of_size_and_light_change_no_bit() {
    let reference = halves(&run(&furnished(), &several_rounds()), 1.0);
    for k in [-20, -10, 10, 20] {
        let factor = 2f32.powi(k);
        // A point light falls off with the square of the distance; a surface that emits does not.
        let mut larger = moved(furnished(), |p| p * f64::from(factor));
        larger.lights.iter_mut().for_each(|l| l.intensity *= factor * factor);
        assert_same(&format!("2^{k} as large"), &reference, &halves(&run(&larger, &several_rounds()), 1.0));

        let mut brighter = furnished();
        brighter.lights.iter_mut().for_each(|l| l.intensity *= factor);
        brighter.materials.iter_mut().for_each(|m| m.emission *= factor);
        assert_same(&format!("2^{k} as bright"), &reference, &halves(&run(&brighter, &several_rounds()), factor));
    }
}

/// A black room with a lamp at least 1 m from every wall, at no multiple of a power of two.
fn black_room() -> Scene {
    let mut b = Builder::new(PAGE);
    let black = b.diffuse(0.0, 0.0);
    b.room(Vec3::new(0.1, 0.2, 0.3), Vec3::new(3.4, 2.9, 4.7), black, 8);
    b.point_light(Vec3::new(1.3, 1.6, 2.7), 10.0);
    b.finish()
}

/// Largest relative difference of the light of texels, whose random numbers are the same in both scenes.
fn apart(a: &Scene, b: &Scene) -> f32 {
    let [a, b] = [a, b].map(|scene| halves(&run(scene, &one_round(PAGE)), 1.0));
    assert_eq!(a.len(), b.len());
    a.iter().zip(&b).map(|(a, b)| (b[0] / a[0] - 1.0).abs()).fold(0.0, f32::max)
}

/// Far from the origin. Coordinates are taken from the middle of the scene in f64, so that all that is lost is what f32
/// corners cannot say there: nothing where they lie on its grid, or where nodes move them.
#[test]
fn far_from_the_origin_only_corners_lose_digits() {
    let (near, black) = (furnished(), black_room());
    let reference = halves(&run(&near, &several_rounds()), 1.0);
    for (metres, step) in [(1e3, 2f32.powi(-14)), (1e5, 2f32.powi(-7))] {
        let shift = DVec3::new(metres, -metres, metres);
        let far = moved(furnished(), |p| p + shift);
        assert_same(&format!("{metres} m"), &reference, &halves(&run(&far, &several_rounds()), 1.0));

        let mut by_nodes = black_room();
        by_nodes.instances.iter_mut().for_each(|i| i.world_from_object.translation = shift);
        by_nodes.lights.iter_mut().for_each(|l| l.position += shift);
        let off = apart(&black, &by_nodes);
        // Coordinates in the frame are f32: a few roundings.
        assert!(off <= 1e-5, "{metres} m, by nodes: {off:e}");

        // E = I h / d^3, h the height of the lamp above the wall: corners that move by up to half a step along each axis
        // change h and d by sqrt(3) / 2 steps and E by up to 4 times that over 1 m.
        let off = apart(&black, &moved(black_room(), |p| p + shift));
        let bound = 4.0 * 0.75f32.sqrt() * step + 1e-5;
        assert!(off <= bound, "{metres} m, by corners: {off:e}, not {bound:e}");
    }
}

/// A quarter of a turn about each axis: direct light the same but for rounding, reflected light, whose directions are drawn
/// about other axes, the same in expectation.
#[test]
fn quarter_turns_change_nothing_but_the_noise() {
    let turns: [fn(DVec3) -> DVec3; 3] =
        [|p| DVec3::new(p.x, -p.z, p.y), |p| DVec3::new(p.z, p.y, -p.x), |p| DVec3::new(-p.y, p.x, p.z)];
    let upright = furnished();
    let nodes = |bake: &Bake, e: &[Vec3]| std::array::from_fn::<_, 13, _>(|node| node_mean(bake, e, node));
    let expected = samples(&upright, &one_round(PAGE), 0..6, nodes);
    let limit = normal_upper_quantile(0.5 * sidak(ALPHA, 13 * turns.len()));
    for (axis, turn) in turns.into_iter().enumerate() {
        let off = apart(&black_room(), &moved(black_room(), turn));
        assert!(off <= 1e-5, "about axis {axis}: {off:e}");
        let found = samples(&moved(furnished(), turn), &one_round(PAGE), 10..16, nodes);
        for (node, (a, b)) in expected.iter().zip(&found).enumerate() {
            let z = welch_score(a, b).unwrap_or(0.0);
            assert!(z.abs() <= limit, "about axis {axis}: node {node} scores {z:.1}");
        }
    }
}

/// A bin that took the flux of 1e10 photons, and one beside it that took one step: exact both.
#[test]
fn full_bins_lose_no_step() {
    /// The flux of 1e10 photons in deposits of the largest flux, 2^15 at a time.
    const CALLS: u64 = 10_000_000_000 * FLUX_OF_A_PHOTON / (u32::MAX as u64 * (1 << 15)) + 1;
    const FLUX_OF_A_PHOTON: u64 = 1 << 24;
    let scene = furnished();
    let stage = Stage::new(&scene, PAGE);
    let open = vec![1.0; stage.texels.texels.len()];
    let bins = Bins::new(&stage.world, &stage.texels, &open);
    let deposit = |u: f32, flux: u32| Deposit {
        triangle: 0,
        back: false,
        uv: Vec2::new(u, 0.01),
        flux: [flux; 3],
        direction: Vec3::NEG_Y,
        distance: 1.0,
        caustic: false,
    };
    let full = Trail { deposits: vec![deposit(0.3, u32::MAX); 1 << 15], ..Trail::default() };
    (0..CALLS).for_each(|_| bins.take(0, &full));
    bins.take(0, &Trail { deposits: vec![deposit(0.45, 1)], ..Trail::default() });
    let texel = |u: f32| stage.texels.at(0, false, Vec2::new(u, 0.01)).expect("on the map") as usize;
    assert_eq!(texel(0.3) + 1, texel(0.45), "side by side");
    assert_eq!(bins.flux(0, texel(0.3)), [(CALLS * (1 << 15) * u64::from(u32::MAX)) as i64; 3]);
    assert_eq!(bins.flux(0, texel(0.45)), [1; 3]);
    assert_eq!(bins.flux(1, texel(0.3)), [0; 3]);
}
