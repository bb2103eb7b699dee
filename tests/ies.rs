//! Lights that shine as IES files say: irradiance in closed form, files and extensions, damage.

mod common;

use base64::Engine;
use common::formulas::{QuadMap, point_irradiance};
use common::rooms::{self, Builder, plain, run};
use common::runs::{self, area_mean, flux, grey, one_round, samples};
use common::statistics::expect_mean;
use evenlight::SceneError;
use evenlight::scene::{BakeMode, IesProfile, LightKind, Scene};
use glam::{DVec3, Mat3, Quat, Vec3};
use proptest::prelude::*;
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;

/// A file of absolute photometry, type C, all factors 1, with `candela(horizontal, vertical)` at angles in degrees.
fn file(horizontal: &[f64], vertical: &[f64], candela: impl Fn(f64, f64) -> f64) -> String {
    let list = |values: &[f64]| values.iter().map(|v| format!("{v} ")).collect::<String>();
    let rows: String = horizontal
        .iter()
        .map(|&h| list(&vertical.iter().map(|&v| candela(h, v)).collect::<Vec<f64>>()) + "\n")
        .collect();
    format!(
        "IESNA:LM-63-2002\n[MANUFAC] nobody\nTILT=NONE\n1 -1 1 {} {} 1 2 0 0 0\n1 1 0\n{}\n{}\n{rows}",
        vertical.len(),
        horizontal.len(),
        list(vertical),
        list(horizontal)
    )
}

fn steps(from: f64, to: f64, step: f64) -> Vec<f64> {
    (0..=((to - from) / step).round() as i32).map(|k| from + step * f64::from(k)).collect()
}

fn profile(text: &str) -> Arc<IesProfile> {
    Arc::new(IesProfile::from_bytes(Path::new("lamp.ies"), text.as_bytes(), None).expect("a good file").0)
}

const PAGE: u32 = 64;

/// A floor of 4 m, 16 texels squared.
fn floor(albedo: f32) -> Builder {
    let mut b = Builder::new(PAGE);
    let grey = b.diffuse(albedo, 0.0);
    b.quad("floor", Vec3::new(-2.0, 0.0, -2.0), Vec3::Z * 4.0, Vec3::X * 4.0, grey, [16; 2]);
    b
}

/// A light of 1 cd at `at` whose frame is turned by `turn`, then given a profile in white.
fn lamp(b: &mut Builder, at: Vec3, profile: &Arc<IesProfile>, turn: Quat) {
    b.point_light(at, 1.0);
    let light = b.scene_mut().lights.last_mut().expect("just added");
    light.axes = Mat3::from_quat(turn);
    light.direction = turn * Vec3::NEG_Z;
    light.set_profile(profile.clone(), Vec3::ONE);
}

/// Straight down, +X of the light along +X of the world.
fn down() -> Quat {
    Quat::from_rotation_x(-std::f32::consts::FRAC_PI_2)
}

/// Horizontal and vertical angle of type C (degrees) at which a lamp turned by `turn` sends light along `w`.
fn angles(turn: Quat, w: DVec3) -> (f64, f64) {
    let turn = turn.as_dquat();
    let along = |axis: DVec3| w.normalize().dot(turn * axis);
    let horizontal = along(DVec3::Y).atan2(along(DVec3::X)).to_degrees();
    (if horizontal < 0.0 { horizontal + 360.0 } else { horizontal }, along(DVec3::NEG_Z).acos().to_degrees())
}

/// A uniform profile of I is a point light of I, whatever way it is turned.
#[test]
fn a_uniform_profile_is_a_point_light() {
    let at = Vec3::new(0.3, 1.5, -0.4);
    let mut b = floor(0.5);
    b.point_light(at, 120.0);
    let scene = b.finish();
    let point = run(&scene, &plain(PAGE, 5.0));
    let turn = Quat::from_euler(glam::EulerRot::XYZ, 0.3, 1.0, 2.0);
    let mut b = floor(0.5);
    lamp(&mut b, at, &profile(&file(&[0.0], &[0.0, 90.0, 180.0], |_, _| 120.0)), turn);
    let scene = b.finish();
    let uniform = run(&scene, &plain(PAGE, 5.0));
    for i in 0..point.texels.mapped {
        let (a, b) = (point.solution.total.mean(i), uniform.solution.total.mean(i));
        assert!((a - b).abs().max_element() <= 1e-6 * a.max_element(), "{a} and {b}");
    }
    assert_eq!(point.report.work.direct_rays, uniform.report.work.direct_rays);
}

/// A cosine lamp of I0 that looks straight down from h: E = I0 h^2 / d^4.
#[test]
fn a_cosine_lamp_on_a_plane() {
    let at = DVec3::new(0.5, 1.0, -0.25);
    let cosine = profile(&file(&[0.0], &steps(0.0, 90.0, 0.5), |_, v| 100.0 * v.to_radians().cos()));
    let mut b = floor(0.5);
    lamp(&mut b, at.as_vec3(), &cosine, down());
    runs::expect_texels("cosine", &b.finish(), PAGE, 32, |p, _| 100.0 / (p - at).length_squared().powi(2));
}

/// Intensities that are bilinear in the angles are exact between them; turned lamps of each symmetry.
#[test]
fn turned_lamps_of_each_symmetry() {
    let at = DVec3::new(-0.5, 1.25, 0.25);
    let f = |h: f64, v: f64| 60.0 + 0.1 * h + 0.2 * v + 0.002 * h * v;
    let v = [0.0, 60.0, 180.0];
    let all = steps(0.0, 360.0, 45.0);
    let turns = [down(), Quat::from_euler(glam::EulerRot::YXZ, 0.7, -1.1, 0.4)];
    let half = |h: f64| if h > 180.0 { 360.0 - h } else { h };
    type Fold = fn(f64) -> f64;
    let folds: [(&str, &[f64], Fold); 4] = [
        ("quadrant", &[0.0, 30.0, 90.0], |h| f64::min(h.min(360.0 - h), 180.0 - h.min(360.0 - h))),
        ("half", &[0.0, 30.0, 180.0], |h| h.min(360.0 - h)),
        ("across", &[90.0, 100.0, 270.0], |h| {
            if h < 90.0 {
                180.0 - h
            } else if h > 270.0 {
                540.0 - h
            } else {
                h
            }
        }),
        // Not bilinear over the seam: mirrored as well, so that it is.
        ("around", &all, |h| h.min(360.0 - h)),
    ];
    for turn in turns {
        for (what, planes, fold) in folds {
            let lit = profile(&file(planes, &v, |h, v| if what == "around" { f(half(h), v) } else { f(h, v) }));
            let mut b = floor(0.0);
            lamp(&mut b, at.as_vec3(), &lit, turn);
            runs::expect_texels(what, &b.finish(), PAGE, 8, |p, n| {
                let (h, v) = angles(turn, p - at);
                point_irradiance(p, n, at, f(fold(h), v))
            });
        }
    }
}

/// Candela by horizontal and vertical angle (degrees).
type Candela = fn(f64, f64) -> f64;

/// Place, turn and intensity.
type Lamp = (DVec3, Quat, Candela);

/// More lamps than are looped over, narrow and wide, up and down: all found through the light tree.
#[test]
fn many_lamps_through_the_light_tree() {
    let narrow = profile(&file(&[0.0], &[0.0, 20.0, 40.0], |_, v| 50.0 * (40.0 - v)));
    let wings = profile(&file(&[0.0, 90.0, 180.0], &[0.0, 60.0, 90.0], |h, v| 30.0 + h * 0.3 + v * 2.0));
    let both = profile(&file(&[0.0], &[0.0, 90.0, 180.0], |_, v| (v - 90.0).abs()));
    let mut b = floor(0.0);
    let mut lamps: Vec<Lamp> = Vec::new();
    for k in 0..40 {
        let at = Vec3::new((k % 8) as f32 * 0.5 - 1.8, 0.5 + 0.1 * (k % 5) as f32, (k / 8) as f32 * 0.8 - 1.6);
        let turn = down() * Quat::from_euler(glam::EulerRot::YXZ, 0.3 * k as f32, 0.02 * k as f32, k as f32);
        let (lit, f): (_, Candela) = match k % 3 {
            0 => (&narrow, |_, v| if v <= 40.0 { 50.0 * (40.0 - v) } else { 0.0 }),
            1 => (&wings, |h, v| if v <= 90.0 { 30.0 + h.min(360.0 - h) * 0.3 + v * 2.0 } else { 0.0 }),
            _ => (&both, |_, v| (v - 90.0).abs()),
        };
        lamp(&mut b, at, lit, turn);
        lamps.push((at.as_dvec3(), turn, f));
    }
    let scene = b.finish();
    let quad = QuadMap::of(&scene, 0, PAGE);
    let formula = |p: DVec3| -> f64 {
        let one = |&(at, turn, f): &Lamp| {
            let (h, v) = angles(turn, p - at);
            point_irradiance(p, quad.normal, at, f(h, v))
        };
        lamps.iter().map(one).sum()
    };
    // The edges of the light cross texels: 1024 x 1024 midpoints of the floor, in quarters.
    let mean = |x: u32, z: u32| -> f64 {
        let at = |k: u32, i: u32| f64::from(k) * 2.0 - 2.0 + (f64::from(i) + 0.5) / 256.0;
        let points = (0..512u32).flat_map(|i| (0..512u32).map(move |k| DVec3::new(at(x, i), 0.0, at(z, k))));
        points.map(formula).sum::<f64>() / (512.0 * 512.0)
    };
    let quarters = samples(&scene, &one_round(PAGE), 0..400, |bake, e| {
        std::array::from_fn::<_, 4, _>(|k| {
            let inside = |i: usize| {
                let at = rooms::centre(bake, i);
                (at.x > 0.0) == (k & 1 == 1) && (at.z > 0.0) == (k & 2 == 2)
            };
            grey(area_mean(bake, e, inside).as_vec3())
        })
    });
    for (k, quarter) in quarters.iter().enumerate() {
        expect_mean("quarter", quarter, mean(k as u32 & 1, k as u32 >> 1), 0.04, 4);
    }
}

/// In a closed room of albedo rho, all surface together receives flux / (1 - rho).
#[test]
fn all_flux_arrives_in_a_room() {
    let lit = profile(&file(&[0.0, 90.0], &steps(0.0, 180.0, 15.0), |h, v| 10.0 + h * 0.5 + (v - 70.0).abs()));
    let mut b = Builder::new(128);
    let wall = b.diffuse(0.6, 0.0);
    b.room(Vec3::ZERO, Vec3::new(3.0, 2.0, 5.0), wall, 12);
    lamp(&mut b, Vec3::new(1.0, 1.5, 1.25), &lit, Quat::from_euler(glam::EulerRot::YXZ, 1.0, -1.0, 0.5));
    let scene = b.finish();
    let [received] = samples(&scene, &one_round(128), 0..32, |bake, e| [flux(bake, e)]);
    expect_mean("room", &received, lit.flux() / 0.4, 0.015, 1);
}

fn load(json: Value, folder: &Path) -> Result<Scene, SceneError> {
    let path = folder.join("scene.gltf");
    std::fs::write(&path, json.to_string()).expect("written");
    Scene::from_gltf(&path)
}

/// A scene with the given profiles and the extension `node` at its only node.
fn extended(profiles: Value, node: Value) -> Value {
    json!({"asset": {"version": "2.0"}, "extensionsUsed": ["EXT_lights_ies"], "extensionsRequired": ["EXT_lights_ies"],
        "extensions": {"EXT_lights_ies": {"lights": profiles}}, "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "post", "translation": [1, 2, 3], "extensions": {"EXT_lights_ies": node}}]})
}

fn data_uri(text: &str) -> String {
    format!("data:application/x-ies-lm-63;base64,{}", base64::engine::general_purpose::STANDARD.encode(text))
}

const SPOT: [f64; 3] = [0.0, 20.0, 40.0];

fn spot_file() -> String {
    file(&[0.0], &SPOT, |_, v| 10.0 * (40.0 - v))
}

#[test]
fn the_extension_is_read_from_files_uris_and_views() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("a spot.ies"), spot_file()).expect("written");
    let light = |profile: Value, node: Value| {
        let mut scene = load(extended(json!([profile]), node), folder.path()).expect("a good scene");
        assert_eq!(scene.lights.len(), 1);
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        scene.lights.remove(0)
    };
    let white = light(json!({"uri": "a%20spot.ies"}), json!({"light": 0}));
    assert_eq!((white.name.as_str(), white.node, white.kind), ("post", Some(0), LightKind::Point));
    assert_eq!((white.intensity, white.position), (Vec3::splat(400.0), DVec3::new(1.0, 2.0, 3.0)));
    assert_eq!((white.direction, white.axes), (Vec3::NEG_Z, Mat3::IDENTITY));
    // Multiplier times colour, which is clamped to 1.
    let dim =
        light(json!({"uri": data_uri(&spot_file())}), json!({"light": 0, "multiplier": 0.5, "color": [1, 0.25, 4]}));
    assert_eq!(dim.intensity, Vec3::new(200.0, 50.0, 200.0));
    let text = spot_file();
    let mut scene = extended(
        json!([{"bufferView": 0, "mimeType": "application/x-ies-lm-63", "name": "view"}]),
        json!({"light": 0}),
    );
    scene["buffers"] = json!([{"byteLength": text.len(), "uri": data_uri(&text)}]);
    scene["bufferViews"] = json!([{"buffer": 0, "byteLength": text.len()}]);
    scene["nodes"][0].as_object_mut().expect("a node").remove("name");
    let viewed = load(scene, folder.path()).expect("a good scene");
    assert_eq!((viewed.lights[0].name.as_str(), viewed.lights[0].intensity), ("view", Vec3::splat(400.0)));
    let profile = viewed.lights[0].profile.as_ref().expect("a profile");
    assert!((f64::from(profile.share(Vec3::NEG_Z)) - 1.0).abs() < 1e-6 && profile.share(Vec3::Z) == 0.0);
}

#[test]
fn lamps_turn_and_mirror_with_their_nodes_and_mind_the_tilt() {
    let folder = tempfile::tempdir().expect("a folder");
    let tilted = spot_file().replace("=NONE", "=INCLUDE\n1 2\n0 90\n1 0.5");
    let with = |node: Value| {
        let mut scene = extended(json!([{"uri": data_uri(&tilted)}]), json!({"light": 0}));
        scene["nodes"][0].as_object_mut().expect("a node").extend(node.as_object().expect("an object").clone());
        load(scene, folder.path()).expect("a good scene").lights.remove(0)
    };
    // Untransformed it looks along the horizon, where the tilt leaves half.
    let plain = with(json!({}));
    assert!((plain.intensity.x - 200.0).abs() < 1e-3, "{}", plain.intensity);
    let down = with(json!({"rotation": down().to_array()}));
    assert!((down.intensity.x - 400.0).abs() < 1e-2 && down.direction.distance(Vec3::NEG_Y) < 1e-6, "{down:?}");
    assert!(down.axes.x_axis.distance(Vec3::X) < 1e-6 && down.axes.y_axis.distance(Vec3::NEG_Z) < 1e-6);
    // A mirror at x: +X of the light looks along -X, +Y stays; what scales does not count.
    let mirrored = with(json!({"scale": [-3, 2, 2]}));
    assert_eq!(mirrored.axes, Mat3::from_diagonal(Vec3::new(-1.0, 1.0, 1.0)));
    assert_eq!(mirrored.intensity, plain.intensity);
}

#[test]
fn extras_say_what_is_baked_and_the_better_of_two_lights_is_taken() {
    let folder = tempfile::tempdir().expect("a folder");
    let profiles = json!([{"uri": data_uri(&spot_file()), "extras": {"evenlight": {"bake": "indirect"}}}]);
    let mut scene = extended(profiles, json!({"light": 0}));
    scene["extensions"]["KHR_lights_punctual"] = json!({"lights": [{"type": "point"}]});
    scene["nodes"][0]["extensions"]["KHR_lights_punctual"] = json!({"light": 0});
    let scene = load(scene, folder.path()).expect("a good scene");
    assert_eq!((scene.lights.len(), scene.lights[0].bake), (1, BakeMode::Indirect));
    assert!(scene.lights[0].profile.is_some());
    assert!(scene.warnings.iter().any(|w| w.code == "two-lights"), "{:?}", scene.warnings);
}

#[test]
fn bad_extensions_are_refused_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let good = json!({"uri": data_uri(&spot_file())});
    for (profile, node, what) in [
        (good.clone(), json!({}), "nodes[0] 'post': its EXT_lights_ies names no `light`"),
        (good.clone(), json!({"light": 7}), "refers to EXT_lights_ies.lights[7]"),
        (good.clone(), json!({"light": 0, "multiplier": -1}), "multiplier -1"),
        (good.clone(), json!({"light": 0, "multiplier": 1e300}), "multiplier"),
        (good, json!({"light": 0, "color": [1, 2]}), "color [1,2]"),
        (json!({"name": "bare"}), json!({"light": 0}), "lights[0] 'bare' has neither a uri nor a bufferView"),
        (json!({"bufferView": 3}), json!({"light": 0}), "bufferViews[3]"),
        (json!({"uri": "../secret.ies"}), json!({"light": 0}), "leaves the scene's folder"),
        (json!({"uri": "none.ies"}), json!({"light": 0}), "none.ies"),
        (json!({"uri": data_uri("no file")}), json!({"light": 0}), "lights[0]: line 1: has no line TILT="),
    ] {
        let error = load(extended(json!([profile]), node), folder.path()).expect_err(what).to_string();
        assert!(error.contains(what), "{error}, not {what}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, rng_seed: proptest::test_runner::RngSeed::Fixed(1), ..ProptestConfig::default() })]

    /// Whatever happens to a file: a profile whose shares and flux are in range, or an error that names a line.
    #[test]
    fn damaged_files_never_panic(
        kind in 0..4usize,
        cuts in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0..4u8), 1..6),
        token in prop::sample::select(vec!["", "0", "-1", "1e9", "4294967296", "1e308", "NaN", "90", "180", "360", "\n", ","]),
    ) {
        let mut bytes = match kind {
            0 => spot_file(),
            1 => file(&[0.0, 90.0, 180.0], &[0.0, 90.0, 180.0], |h, v| h + v),
            2 => spot_file().replace("=NONE", "=INCLUDE\n1 2\n0 90\n1 0.5"),
            _ => file(&[-90.0, 0.0, 90.0], &[-90.0, 0.0, 90.0], |h, v| h + v + 180.0).replace(" 1 2 0 0 0", " 2 2 0 0 0"),
        }
        .into_bytes();
        for (at, byte, how) in cuts {
            let at = at.index(bytes.len().max(1)).min(bytes.len());
            match how {
                0 if at < bytes.len() => bytes[at] = byte,
                1 => bytes.truncate(at),
                2 if at < bytes.len() => { bytes.remove(at); }
                _ => { bytes.splice(at..at, token.bytes()); }
            }
        }
        match IesProfile::from_bytes(Path::new("lamp.ies"), &bytes, None) {
            Ok((profile, _)) => {
                prop_assert!(profile.flux() >= 0.0 && profile.flux().is_finite());
                for w in [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z, Vec3::splat(3f32.sqrt().recip())] {
                    let share = profile.share(w);
                    prop_assert!((0.0..=1.0).contains(&share), "{share}");
                }
            }
            Err(error) => prop_assert!(error.to_string().contains("lamp.ies"), "{error}"),
        }
    }
}
