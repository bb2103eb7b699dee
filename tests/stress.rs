//! Numbers at the ends of their range: huge and tiny scenes, far from the origin, bright beside dim, and geometry that
//! no modeller means to make. Each must bake without a panic and without a texel that is no irradiance, and each photon
//! step must be accounted for.

mod common;

use common::glb::SceneBuilder;
use common::rooms::{Builder, plain, run};
use common::runs::{grey, node_mean, one_round, samples};
use common::stage::Stage;
use common::statistics::{ALPHA, normal_upper_quantile, sidak, welch_score};
use evenlight::options::{Audits, Smoothing};
use evenlight::photon::{Bins, Deposit, DepositSink, Trail};
use evenlight::scene::Scene;
use evenlight::{Bake, BakeOptions, NoObserver, bake};
use glam::{DVec3, Vec2, Vec3};
use serde_json::json;
use std::path::Path;

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

/// Two closed rooms, their lamps 1 : 1e12. What a room receives is twice the flux of its lamp, as in any closed room of
/// albedo 0.5: the sum of 1, 1/2, 1/4, ... Errors are relative to the mean of the map, so that no photon is spent on the dim
/// room and direct light is all that it has; as a group of its own, its lamp has photons.
#[test]
fn a_dim_room_is_right_beside_one_a_trillion_times_as_bright() {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(0.5, 0.0);
    b.room(Vec3::ZERO, Vec3::splat(3.0), wall, 6);
    b.room(Vec3::new(4.0, 0.0, 0.0), Vec3::new(7.0, 3.0, 3.0), wall, 6);
    b.point_light(Vec3::new(1.5, 1.5, 1.5), 1e12);
    b.point_light(Vec3::new(5.5, 1.5, 1.5), 1.0);
    let scene = b.finish();
    let groups = vec![("bright".into(), "light 0".into()), ("dim".into(), "light 1".into())];
    for (groups, reflected) in [(Vec::new(), 0.0), (groups, 1.0)] {
        let bake = run(&scene, &BakeOptions { groups, ..plain(PAGE, 2.0) });
        let mut received = [0.0; 2];
        for i in 0..bake.texels.mapped {
            let area = f64::from(bake.texels.texels[i].area) * bake.world.frame.metres.powi(2);
            let e = bake.solution.total.mean(i);
            assert!(e.is_finite() && e.min_element() >= 0.0, "texel {i}: {e}");
            received[bake.solution.weights.instance[i] as usize / 6] += grey(e) * area;
        }
        for (room, (candela, share)) in [(1e12, 2.0), (1.0, 1.0 + reflected)].into_iter().enumerate() {
            let found = received[room] / (4.0 * std::f64::consts::PI * candela);
            // Half the target of 2 %: noise of texels averages out over a room.
            assert!((found / share - 1.0).abs() <= 0.01, "room {room}: {found}, not {share}");
        }
    }
}

/// Bakes what a file holds and checks what must hold whatever it is; the codes of its warnings, or `None` where an error
/// says that there is nothing to bake.
fn survives(what: &str, builder: SceneBuilder, options: &BakeOptions) -> Option<Vec<&'static str>> {
    let file = format!("{what}.glb");
    let scene = match evenlight::scene::gltf::load_bytes(Path::new(&file), &builder.glb()) {
        Ok(scene) => scene,
        Err(e) => {
            assert!(e.to_string().contains(&file), "{what}: {e} does not name the file");
            return None;
        }
    };
    let bake = match bake(&scene, options, &mut NoObserver) {
        Ok(bake) => bake,
        Err(e) => {
            assert!(!e.to_string().is_empty(), "{what}");
            return None;
        }
    };
    assert_eq!(bake.solution.ledger.imbalance(), [0; 3], "{what}");
    let sums = &bake.solution.total;
    let texels = sums.odd.iter().chain(&sums.even).map(|e| e.to_array());
    let stored = bake.lightmap.pages.iter().flat_map(|p| &p.irradiance).copied();
    for e in texels.chain(stored) {
        assert!(e.iter().all(|c| c.is_finite() && *c >= 0.0), "{what}: a texel is {e:?}");
    }
    assert!(bake.report.texel_error_percent.is_finite(), "{what}: no error is stated");
    Some(bake.report.warnings.iter().map(|w| w.code).collect())
}

/// A few rounds into small maps.
fn hasty() -> BakeOptions {
    BakeOptions {
        target_percent: 20.0,
        max_photons: Some(1 << 14),
        max_texture: PAGE,
        time_limit: Some(10.0),
        audit: Audits::Off,
        ..BakeOptions::default()
    }
}

/// A room of 4 x 3 x 4 m with a lamp.
fn lit_room(albedo: f32) -> SceneBuilder {
    SceneBuilder::new().material("wall", [albedo; 3]).room("room", [0.0; 3], [4.0, 3.0, 4.0]).point_light(
        "lamp",
        [2.25, 2.0, 1.75],
        [10.0; 3],
    )
}

/// Two boxes in the open with a lamp.
fn yard(albedo: f32) -> SceneBuilder {
    SceneBuilder::new()
        .material("wall", [albedo; 3])
        .cuboid("low", [0.0; 3], [4.0, 1.0, 4.0])
        .cuboid("high", [1.0, 1.25, 1.0], [2.0, 2.0, 2.0])
        .point_light("lamp", [3.0, 2.0, 3.0], [10.0; 3])
}

/// A quad of the floor's plane at `y`, seen from above.
fn sheet(y: f32, lo: [f32; 2], hi: [f32; 2]) -> [[f32; 3]; 4] {
    [[lo[0], y, hi[1]], [hi[0], y, hi[1]], [hi[0], y, lo[1]], [lo[0], y, lo[1]]]
}

/// Geometry that no modeller means to make.
#[test]
fn odd_geometry_bakes() {
    let none: &[[f32; 3]] = &[];
    let sliver = [[0.5, 1.0, 0.5], [3.5, 1.0, 0.5], [2.0, 1.0, 0.500_003]];
    // An edge from (1, 1) to (3, 1) on one side, halved by a corner at (2, 1) on the other.
    let t_junction =
        [[1.0, 1.0, 1.0], [3.0, 1.0, 1.0], [2.0, 1.0, 3.0], [2.0, 1.0, 1.0], [1.0, 1.0, 0.0], [3.0, 1.0, 0.0]];
    let flat = [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0], [3.0, 1.0, 1.0], [1.0, 1.0, 1.0]];
    let triangle = [[1.0, 1.0, 1.0], [1.0, 1.0, 2.0], [2.0, 1.0, 1.0]];
    let down = triangle.map(|_| [0.0, -1.0, 0.0]);
    let lamp = || SceneBuilder::new().material("grey", [0.5; 3]).point_light("lamp", [1.25, 2.0, 1.25], [10.0; 3]);
    let cases = [
        ("a sliver", lit_room(0.5).mesh("sliver", &sliver, none, &[], &[[0, 2, 1]])),
        ("a sliver alone", lamp().mesh("sliver", &sliver, none, &[], &[[0, 2, 1]])),
        (
            "a T-junction",
            lit_room(0.5).mesh("t", &t_junction, none, &[], &[[0, 2, 1], [0, 3, 4], [3, 5, 4], [3, 1, 5]]),
        ),
        ("the same face twice", lit_room(0.5).quad("a", sheet(1.0, [1.0; 2], [2.0; 2])).instance("b")),
        (
            "the same triangle twice",
            lit_room(0.5).mesh("twice", &triangle, none, &[], &[[0, 1, 2], [0, 1, 2], [0, 2, 1]]),
        ),
        (
            "solids in one another",
            lit_room(0.5).cuboid("a", [1.0; 3], [2.0; 3]).cuboid("b", [1.5; 3], [2.5, 2.5, 2.75]),
        ),
        ("a solid through a wall", lit_room(0.5).cuboid("a", [-1.0, 1.0, 1.0], [1.0, 2.0, 2.0])),
        ("normals turned over", lit_room(0.5).mesh("over", &triangle, &down, &[], &[[0, 1, 2]])),
        ("no area", lit_room(0.5).mesh("flat", &flat, none, &[], &[[0, 1, 2], [0, 3, 1], [0, 0, 0]])),
        ("no area at all", lamp().mesh("flat", &flat, none, &[], &[[0, 1, 2], [0, 3, 1]])),
        ("one triangle", lamp().mesh("one", &triangle, none, &[], &[[0, 1, 2]])),
        ("a wall 1e-6 m thin", lit_room(0.5).cuboid("wall", [2.0, 0.0, 0.0], [2.000_001, 3.0, 4.0])),
        (
            "two sheets 1e-6 m apart",
            lit_room(0.5).quad("a", sheet(1.0, [1.0; 2], [3.0; 2])).quad("b", sheet(1.000_001, [1.0; 2], [3.0; 2])),
        ),
        ("scaled to nothing", lit_room(0.5).cuboid("a", [1.0; 3], [2.0; 3]).with("scale", json!([0, 0, 0]))),
        ("flattened", lit_room(0.5).cuboid("a", [1.0; 3], [2.0; 3]).with("scale", json!([1, 0, 1]))),
        (
            "as large as f32",
            lit_room(0.5)
                .cuboid("a", [1.0; 3], [2.0; 3])
                .with("scale", json!([1e30, 1e30, 1e30]))
                .with("translation", json!([1e38, -1e38, 0])),
        ),
        ("beyond f32", lit_room(0.5).cuboid("a", [1.0; 3], [2.0; 3]).with("scale", json!([1e39, 1, 1]))),
        (
            "a corner that is no number",
            lit_room(0.5).mesh(
                "nan",
                &[[f32::NAN, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]],
                none,
                &[],
                &[[0, 1, 2]],
            ),
        ),
    ];
    for (what, scene) in cases {
        let warnings = survives(what, scene, &hasty());
        assert_eq!(warnings.is_none(), what == "no area at all", "{what}: {warnings:?}");
        let said = match what {
            "no area" | "flattened" => "degenerate-triangles",
            "scaled to nothing" | "beyond f32" => "odd-transform",
            "a corner that is no number" => "non-finite-position",
            "the same face twice" | "the same triangle twice" => "coincident-surfaces",
            _ => continue,
        };
        assert!(warnings.is_some_and(|w| w.contains(&said)), "{what}: not said");
    }
}

/// Surface that keeps all light or none, or would make some, and lights at the ends of their range. White surface stands in
/// the open: in a closed white room light never ends.
#[test]
fn odd_materials_and_lights_bake() {
    let spot =
        |inner, outer| lit_room(0.5).spot_light("spot", [2.0, 2.5, 2.0], [0.0, -1.0, 0.0], [10.0; 3], inner, outer);
    let right = std::f32::consts::FRAC_PI_2;
    let cases = [
        ("black", lit_room(0.0)),
        ("white", yard(1.0)),
        ("whiter than white", yard(2.0)),
        ("a spot of 0 degrees", spot(0.0, 0.0)),
        ("a hard spot of 90 degrees", spot(right, right)),
        ("a soft spot of 90 degrees", spot(0.0, right)),
        ("a lamp on the floor", lit_room(0.5).point_light("low", [1.0, 0.0, 1.0], [10.0; 3])),
        ("a lamp in a corner", lit_room(0.5).point_light("low", [0.0; 3], [10.0; 3])),
        ("a lamp in a solid", lit_room(0.5).cuboid("a", [1.0; 3], [2.0; 3]).point_light("in", [1.5; 3], [10.0; 3])),
        ("a lamp of 1e15 cd", lit_room(0.5).point_light("sun", [1.0; 3], [1e15; 3])),
        (
            "a lamp of 1e-15 cd",
            SceneBuilder::new()
                .material("g", [0.5; 3])
                .room("r", [0.0; 3], [4.0; 3])
                .point_light("dim", [1.0; 3], [1e-15; 3]),
        ),
    ];
    for (what, scene) in cases {
        let warnings = survives(what, scene, &hasty()).unwrap_or_else(|| panic!("{what}: refused"));
        let said = match what {
            "whiter than white" => "odd-material",
            "a spot of 0 degrees" => "odd-spot",
            _ => continue,
        };
        assert!(warnings.contains(&said), "{what}: not said");
    }
}

/// Light that no error can be stated of is refused by its name, before or after it was traced; a sun as far away as it is,
/// given in candela, is not.
#[test]
fn light_beyond_all_measure_is_refused_by_name() {
    let emissive = |nit: f64| {
        lit_room(0.5).material("glow", [0.5; 3]).quad("panel", sheet(1.0, [1.0; 2], [2.0; 2])).patch(move |j| {
            j["materials"][1]["emissiveFactor"] = json!([1, 1, 1]);
            j["materials"][1]["extensions"] = json!({"KHR_materials_emissive_strength": {"emissiveStrength": nit}});
        })
    };
    let sun_above = |lux: f32| yard(0.5).sun("noon", [0.1, -1.0, 0.2], [lux; 3]);
    let sun = |illuminance: f32| {
        let sun = evenlight::options::Sun { elevation: 60.0, azimuth: 0.0, illuminance, diameter: 0.53 };
        BakeOptions { sun: Some(sun), ..hasty() }
    };
    let far = yard(0.5).point_light("star", [0.0, 1.5e11, 0.0], [3e27; 3]);
    let good = [
        (lit_room(0.5).point_light("a", [1.0; 3], [1e18; 3]), hasty()),
        (sun_above(1e18), hasty()),
        (yard(0.5).sky([1e18; 3]), hasty()),
        (emissive(1e18), hasty()),
        (far, hasty()),
        (yard(0.5), sun(1e18)),
    ];
    for (k, (builder, options)) in good.into_iter().enumerate() {
        survives(&format!("strong light {k}"), builder, &options).unwrap_or_else(|| panic!("{k} is refused"));
    }
    let bad = [
        (lit_room(0.5).point_light("a", [1.0; 3], [1e38; 3]), hasty(), "light 'a' has 1e38 cd"),
        (lit_room(0.5).point_light("a", [1.0; 3], [1e25; 3]), hasty(), "receives more than 5e18 lux"),
        (sun_above(1e19), hasty(), "light 'noon' has 1e19 lux"),
        (yard(0.5).sky([1e38; 3]), hasty(), "the sky of the file: it has 1e38 nit"),
        (emissive(1e30), hasty(), "material 'glow' emits 1e30 nit"),
        (yard(0.5), sun(1e20), "--sun: it has 1e20 lux"),
    ];
    for (builder, options, expected) in bad {
        let scene = evenlight::scene::gltf::load_bytes(Path::new("bright.glb"), &builder.glb()).expect("a good file");
        let said = bake(&scene, &options, &mut NoObserver).expect_err(expected).to_string();
        assert!(said.contains(expected), "{said}, not {expected}");
    }
}

/// Hundreds of charts on a page of 16 texels: baked, with a warning.
#[test]
fn hundreds_of_charts_on_a_tiny_page() {
    let mut builder = lit_room(0.5);
    for k in 0..300u16 {
        let (x, z) = (f32::from(k % 20) * 0.2, f32::from(k / 20) * 0.2);
        builder = builder.quad(&format!("sheet {k}"), sheet(0.5 + f32::from(k) / 512.0, [x, z], [x + 0.1, z + 0.1]));
    }
    let options = BakeOptions { max_texture: 16, gutter: 1, ..hasty() };
    let warnings = survives("hundreds of charts", builder, &options).expect("it bakes");
    assert!(warnings.contains(&"chart-larger-than-page"), "{warnings:?}");
}
