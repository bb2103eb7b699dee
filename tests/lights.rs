//! Lights that glTF extensions bring beside lamps without area: the surroundings of EXT_lights_image_based, and the
//! rectangles and discs of EXT_lights_area.

mod common;

use common::formulas::{disc_irradiance, polygon_irradiance};
use common::glb::SceneBuilder;
use common::program::{evenlight, expect, read_json, text};
use common::rooms::{Builder, mean_where, plain, run};
use evenlight::light::SkySampler;
use evenlight::options::UvSource;
use evenlight::scene::{AreaShape, BakeMode, Changes, LightChange, LightKind, Scene, Sky};
use evenlight::{BakeOptions, NoObserver};
use glam::{DVec3, Quat, Vec2, Vec3};
use image::{DynamicImage, ImageFormat, RgbImage, RgbaImage};
use serde_json::{Value, json};
use std::f64::consts::{FRAC_1_SQRT_2, PI};
use std::io::Cursor;
use std::path::Path;

const FLOOR: [[f32; 3]; 4] = [[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]];

fn load(builder: SceneBuilder) -> Result<Scene, String> {
    evenlight::scene::gltf::load_bytes(Path::new("scene.glb"), &builder.glb()).map_err(|e| e.to_string())
}

fn png(image: impl Into<DynamicImage>) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, ImageFormat::Png).expect("an image");
    bytes.into_inner()
}

/// sRGB code of a linear value (IEC 61966-2-1).
fn srgb(linear: f64) -> u8 {
    let c = linear.clamp(0.0, 1.0);
    let encoded = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
    (encoded * 255.0).round() as u8
}

/// Direction through a place of a face in [0, 1]^2 from its top left, by the table of OpenGL (4.6, 8.19): major axis,
/// sc and tc. The extension wants the images turned over left to right: s is 1 - s.
fn direction(face: usize, s: f64, t: f64, mirrored: bool) -> Vec3 {
    let s = if mirrored { 1.0 - s } else { s };
    let (a, b) = ((2.0 * s - 1.0) as f32, (2.0 * t - 1.0) as f32);
    let [x, y, z] = [[1.0, -b, -a], [-1.0, -b, a], [a, 1.0, b], [a, -1.0, -b], [a, -b, 1.0], [-a, -b, -1.0]][face];
    Vec3::new(x, y, z).normalize()
}

/// Six faces in RGBD of what `radiance` says per direction; `mirrored` as the extension wants them.
fn faces(size: u32, mirrored: bool, radiance: impl Fn(Vec3) -> [f64; 3]) -> Vec<Vec<u8>> {
    let face = |f: usize| {
        png(RgbaImage::from_fn(size, size, |x, y| {
            let [s, t] = [x, y].map(|i| (f64::from(i) + 0.5) / f64::from(size));
            let l = radiance(direction(f, s, t, mirrored));
            // The largest divisor that keeps all channels within 1.
            let d = (255.0 / l.iter().fold(1.0, |a: f64, &b| a.max(b))).floor().max(1.0);
            let [r, g, b] = l.map(|c| srgb(c * d / 255.0));
            image::Rgba([r, g, b, d as u8])
        }))
    };
    (0..6).map(face).collect()
}

/// A floor in surroundings of six images.
fn surroundings(faces: &[Vec<u8>], light: Value) -> SceneBuilder {
    let mut b = SceneBuilder::new().material("grey", [0.5; 3]).quad("floor", FLOOR);
    let views: Vec<usize> = faces.iter().map(|f| b.view(f)).collect();
    b.patch(move |j| {
        j["images"] = views.iter().map(|v| json!({"bufferView": v, "mimeType": "image/png"})).collect();
        j["extensionsUsed"] = json!(["EXT_lights_image_based"]);
        j["extensionsRequired"] = json!(["EXT_lights_image_based"]);
        let mut all = json!({"name": "yard", "specularImages": [[0, 1, 2, 3, 4, 5]],
            "irradianceCoefficients": vec![[0.0; 3]; 9]});
        all.as_object_mut().expect("an object").extend(light.as_object().cloned().expect("an object"));
        j["extensions"] = json!({"EXT_lights_image_based": {"lights": [all]}});
        j["scenes"][0]["extensions"] = json!({"EXT_lights_image_based": {"light": 0}});
    })
}

/// Real spherical harmonics up to degree 2, in the order of the extension (Ramamoorthi and Hanrahan 2001).
fn harmonics(w: Vec3) -> [f64; 9] {
    let [x, y, z] = w.to_array().map(f64::from);
    [
        0.282_095,
        0.488_603 * y,
        0.488_603 * z,
        0.488_603 * x,
        1.092_548 * x * y,
        1.092_548 * y * z,
        0.315_392 * (3.0 * z * z - 1.0),
        1.092_548 * x * z,
        0.546_274 * (x * x - y * y),
    ]
}

fn expand(coefficients: &[[f64; 3]; 9], w: Vec3) -> [f64; 3] {
    let y = harmonics(w);
    std::array::from_fn(|c| (0..9).map(|k| coefficients[k][c] * y[k]).sum())
}

/// Irradiance [lux] on a plane with the normal `n`, by the bake's own samples of the sky.
fn irradiance(sky: &Sky, n: Vec3) -> [f64; 3] {
    let Some(SkySampler::Image(image)) = SkySampler::new(sky) else { panic!("a sky with images") };
    const SIDE: usize = 256;
    let mut sum = [0.0; 3];
    for k in 0..SIDE * SIDE {
        let (w, density) =
            image.sample(Vec2::new(((k % SIDE) as f32 + 0.5) / SIDE as f32, ((k / SIDE) as f32 + 0.5) / SIDE as f32));
        let weight = f64::from(n.dot(w).max(0.0) / density);
        let l = sky.radiance(w).to_array();
        sum.iter_mut().zip(l).for_each(|(s, l)| *s += f64::from(l) * weight);
    }
    sum.map(|s| s / (SIDE * SIDE) as f64)
}

/// Radiance that is a sum of harmonics up to degree 2 gives an irradiance that is such a sum exactly, with the
/// coefficients pi, 2 pi / 3 and pi / 4 times as large: those of the file. Eight bits and 32 texels are what is between.
#[test]
fn irradiance_is_that_of_the_coefficients() {
    let radiance: [[f64; 3]; 9] = [
        [60.0, 40.0, 80.0],
        [5.0, 2.0, 9.0],
        [-3.0, 1.0, 2.0],
        [4.0, -2.0, 1.0],
        [1.0, 1.0, -2.0],
        [2.0, 0.5, 1.0],
        [-1.0, 0.7, 3.0],
        [1.5, -0.8, 0.4],
        [0.6, 0.9, -1.0],
    ];
    let bands = [1.0, 2.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0, 0.25, 0.25, 0.25, 0.25, 0.25];
    let coefficients: [[f64; 3]; 9] = std::array::from_fn(|k| radiance[k].map(|l| PI * bands[k] * l));
    let turn = Quat::from_axis_angle(Vec3::new(1.0, 2.0, -1.0).normalize(), 0.8);
    let light = json!({"irradianceCoefficients": coefficients, "intensity": 2.0, "rotation": turn.to_array(),
        "specularImageSize": 32});
    for mirrored in [true, false] {
        let scene = load(surroundings(&faces(32, mirrored, |w| expand(&radiance, w)), light.clone())).expect("good");
        let codes: Vec<_> = scene.warnings.iter().map(|w| w.code).collect();
        assert_eq!(codes, if mirrored { vec![] } else { vec!["sky-mirrored"] }, "{:?}", scene.warnings);
        let sky = scene.sky.expect("surroundings");
        for n in [Vec3::X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::new(-1.0, 0.5, -2.0).normalize()] {
            let expected = expand(&coefficients, turn.conjugate() * n).map(|e| 2.0 * e);
            for (found, expected) in irradiance(&sky, n).into_iter().zip(expected) {
                assert!((found / expected - 1.0).abs() < 0.01, "{n}: {found}, not {expected}");
            }
        }
    }
}

/// Each face of a cube has its radiance. From the middle of a cube, the view factor of the face that a surface looks
/// at is that of a square at half its edge (Howell C-11), and the four beside it share the rest.
#[test]
fn faces_light_what_looks_at_them() {
    let levels = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0];
    let face = |w: Vec3| {
        let k = (0..3).max_by(|&a, &b| w[a].abs().total_cmp(&w[b].abs())).expect("three axes");
        2 * k + usize::from(w[k] < 0.0)
    };
    let light = json!({"intensity": 10.0, "rotation": [0.0, FRAC_1_SQRT_2, 0.0, FRAC_1_SQRT_2]});
    let from_file = load(surroundings(&faces(4, true, |w| [levels[face(w)]; 3]), light)).expect("good");
    let codes: Vec<_> = from_file.warnings.iter().map(|w| w.code).collect();
    assert_eq!(codes, ["sky-size", "sky-irradiance"], "{:?}", from_file.warnings);

    let mut b = Builder::new(64);
    let black = b.diffuse(0.0, 0.0);
    b.solid(Vec3::splat(-1.0), Vec3::splat(1.0), black, 8);
    let mut scene = b.finish();
    scene.sky = from_file.sky;
    let bake = run(&scene, &plain(64, 1.0));
    // A quarter turn about +Y takes +Z to +X, -X to +Z, and so on.
    let around = [4, 5, 2, 3, 1, 0].map(|f| 10.0 * levels[f]);
    let [ahead, beside] = {
        let a = 2.0 / PI * 2.0 * FRAC_1_SQRT_2 * FRAC_1_SQRT_2.atan();
        [a, (1.0 - a) / 4.0]
    };
    assert!((ahead - 0.554).abs() < 1e-3);
    // The order of the solid's faces, -x first, and of the cube's, +x first.
    for (node, at) in [1usize, 0, 3, 2, 5, 4].into_iter().enumerate() {
        let found = mean_where(&bake, node, |_| true).0;
        let others: f64 = (0..6).filter(|f| f / 2 != at / 2).map(|f| around[f]).sum();
        let expected = PI * (ahead * around[at] + beside * others);
        assert!((found / expected - 1.0).abs() < 0.02, "face {at}: {found}, not {expected}");
    }
}

/// Turned and dimmed, a sky looks so in every direction.
#[test]
fn skies_of_a_file_can_be_turned_and_dimmed() {
    let bright = |w: Vec3| [0.5 + 0.4 * f64::from(w.x), 0.5 + 0.4 * f64::from(w.y), 0.5 + 0.4 * f64::from(w.z)];
    let scene = load(surroundings(&faces(64, true, bright), json!({}))).expect("a good scene");
    let cube = scene.sky.clone().expect("surroundings");
    let radiance: Vec<Vec3> = (0..32).map(|i| Vec3::splat((i % 8) as f32)).collect();
    let image = Sky::Image { width: 8, height: 4, radiance: radiance.into(), rotation: 0.3 };
    let turn = Quat::from_rotation_y(40f32.to_radians());
    for (sky, step) in [(cube, 0.05), (image, 0.0), (Sky::Constant(Vec3::ONE), 0.0)] {
        let changed = sky.clone().changed(40.0, 0.5);
        let mut same = 0;
        for k in 0..200 {
            let (z, phi) = (1.0 - (k as f32 + 0.5) / 100.0, k as f32 * 2.399_963);
            let w = Vec3::new(phi.cos() * (1.0 - z * z).sqrt(), z, phi.sin() * (1.0 - z * z).sqrt());
            same += usize::from((changed.radiance(turn * w) - 0.5 * sky.radiance(w)).abs().max_element() <= step);
        }
        // Next to the borders of texels rounding decides.
        assert!(same >= 195, "{same} of 200");
    }
    let options = |sky_scale| BakeOptions { sky_scale, uv: UvSource::Generate, ..plain(32, 1e6) };
    let mean = |sky_scale| run(&scene, &options(sky_scale)).report.mean_irradiance;
    assert!((mean(0.25) / mean(1.0) - 0.25).abs() < 1e-3);
    let bare = load(SceneBuilder::new().material("floor", [0.5; 3]).quad("floor", FLOOR)).expect("a good scene");
    let said = evenlight::bake(&bare, &options(0.25), &mut NoObserver).expect_err("refused").to_string();
    assert!(said.contains("neither the file nor --sky has a sky"), "{said}");
}

#[test]
fn faults_of_surroundings_are_named() {
    let even = |size: u32| png(RgbImage::from_pixel(size, size, image::Rgb([255; 3])));
    let six: Vec<Vec<u8>> = (0..6).map(|_| even(2)).collect();
    // Three channels are not divided by anything; a constant cube gives pi L.
    let coefficients = |e: f64| {
        json!({"specularImageSize": 2, "irradianceCoefficients":
        (0..9).map(|k| [if k == 0 { e / 0.282_095 } else { 0.0 }; 3]).collect::<Vec<_>>()})
    };
    let good = load(surroundings(&six, coefficients(PI))).expect("good");
    assert!(good.warnings.is_empty(), "{:?}", good.warnings);
    assert!((irradiance(&good.sky.expect("a sky"), Vec3::Y)[1] / PI - 1.0).abs() < 1e-3);
    let odd = load(surroundings(&six, coefficients(1.0))).expect("odd, but good");
    assert!(odd.warnings.iter().any(|w| w.code == "sky-irradiance"), "{:?}", odd.warnings);

    let with = |k: usize, face: Vec<u8>| {
        let mut faces = six.clone();
        faces[k] = face;
        surroundings(&faces, json!({}))
    };
    let light = |light: Value| surroundings(&six, light);
    let wide = png(RgbImage::new(2, 3));
    let huge = {
        // Only the size in the header of a PNG is looked at before it is refused.
        let mut bytes = even(2);
        bytes[16..24].copy_from_slice(&[0, 0, 0x40, 0, 0, 0, 0x40, 0]);
        let crc = crc32(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&crc.to_be_bytes());
        bytes
    };
    let cases = [
        (with(1, b"GIF89a".to_vec()), "images[1] of EXT_lights_image_based.lights[0] 'yard' is neither PNG nor JPEG"),
        (with(2, wide), "images[2] of EXT_lights_image_based.lights[0] 'yard' has 2 x 3 texels"),
        (with(3, huge), "has 16384 x 16384 texels; a face is square, with 1 to 2048"),
        (with(4, even(4)), "images[4] of EXT_lights_image_based.lights[0] 'yard' has 4 x 4 texels, but the first"),
        (with(0, [&even(2)[..33], &[0; 9]].concat()), "is damaged"),
        (light(json!({"specularImages": [[0, 1, 2, 3, 4]]})), "no specularImages with six indices"),
        (light(json!({"specularImages": [[0, 1, 2, 3, 4, 99]]})), "refers to images[99]"),
        (light(json!({"intensity": -1})), "has the intensity -1"),
        (light(json!({"rotation": [0, 0, 0, 0]})), "no quaternion"),
        (light(json!({})).patch(|j| j["scenes"][0]["extensions"]["EXT_lights_image_based"] = json!({})), "no `light`"),
        (
            light(json!({})).patch(|j| j["scenes"][0]["extensions"]["EXT_lights_image_based"]["light"] = json!(3)),
            "scenes[0] refers to EXT_lights_image_based.lights[3]",
        ),
        (light(json!({})).patch(|j| j["images"][5] = json!({"uri": "lost.png"})), "cannot read lost.png"),
        (light(json!({})).patch(|j| j["images"][5] = json!({})), "neither a uri nor a bufferView"),
    ];
    for (builder, expected) in cases {
        let error = load(builder).expect_err(expected);
        assert!(error.contains(expected), "{error}, not {expected}");
    }
}

/// The checksum of PNG chunks.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, &b| {
        (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 })
    })
}

/// From the command line: inspected, baked, replaced by `--sky`, kept and removed.
#[test]
fn surroundings_are_shown_baked_and_removed() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let even = faces(2, true, |_| [3.0; 3]);
    std::fs::write(folder.path().join("yard.glb"), surroundings(&even, json!({"specularImageSize": 2})).glb())
        .expect("written");
    let said = text(&evenlight(folder.path(), &["inspect", "yard.glb"]).stdout);
    assert!(said.contains("sky         cube of 2 x 2 texels a face, 3"), "{said}");

    let quick = ["--max-texture", "64", "--density", "even", "--target-percent", "5", "--audit", "off", "--no-preview"];
    let bake = |more: &[&str]| {
        expect(&evenlight(folder.path(), &[&["bake", "yard.glb", "-o", "out"][..], &quick, more].concat()), 0);
        let mean = read_json(&folder.path().join("out/report.json"))["mean_irradiance"].as_f64().expect("a number");
        let manifest = read_json(&folder.path().join("out/lightmap.json"));
        let sky = [&manifest["sky_baked"], &manifest["sky_of_scene"]].map(|v| v.as_bool().expect("a truth"));
        (mean, sky, Scene::from_gltf(folder.path().join("out/scene.glb")).expect("a good scene"))
    };
    let near = |found: f64, expected: f64| assert!((found / expected - 1.0).abs() < 0.02, "{found}, not {expected}");
    let (mean, sky, scene) = bake(&[]);
    near(mean, 3.0 * PI);
    assert!(sky == [true, true] && scene.sky.is_some());
    let (mean, sky, scene) = bake(&["--remove-baked-lights"]);
    near(mean, 3.0 * PI);
    assert!(sky == [true, true] && scene.sky.is_none());
    assert!(!scene.source.json.to_string().contains("EXT_lights_image_based"));
    let (mean, sky, scene) = bake(&["--sky", "7,7,7", "--remove-baked-lights"]);
    near(mean, 7.0 * PI);
    assert!(sky == [true, false] && scene.sky.is_some(), "what is not baked stays");
}

/// A floor under a node with the first of `lights`.
fn panels(lights: Value, node: Value) -> SceneBuilder {
    SceneBuilder::new().material("black", [0.0; 3]).quad("floor", FLOOR).node(node).patch(move |j| {
        j["extensionsUsed"] = json!(["EXT_lights_area"]);
        j["extensionsRequired"] = json!(["EXT_lights_area"]);
        j["extensions"] = json!({"EXT_lights_area": {"lights": lights}});
        j["nodes"][1]["extensions"] = json!({"EXT_lights_area": {"light": 0}});
    })
}

/// -Z turned to point along `direction`.
fn aim(direction: Vec3) -> [f32; 4] {
    Quat::from_rotation_arc(Vec3::NEG_Z, direction.normalize()).to_array()
}

/// Irradiance of small squares at `points`, facing up, under the first light of a file: its own place and shape.
fn measured(file: SceneBuilder, points: &[Vec3]) -> Vec<f64> {
    let lights = load(file).expect("a good scene").lights;
    let mut b = Builder::new(64);
    let black = b.diffuse(0.0, 0.0);
    for &p in points {
        let side = 1e-3;
        b.quad("square", p - Vec3::new(0.5, 0.0, 0.5) * side, Vec3::Z * side, Vec3::X * side, black, [2, 2]);
    }
    let mut scene = b.finish();
    scene.lights = lights;
    let bake = run(&scene, &plain(64, 0.1));
    (0..points.len()).map(|i| mean_where(&bake, i, |_| true).0).collect()
}

/// A rectangle, sized by the largest scale of its node and tilted, against Lambert's formula for polygons.
#[test]
fn rectangles_light_as_lambert_says() {
    let tilt = Quat::from_rotation_arc(Vec3::NEG_Z, Vec3::new(0.3, -1.0, 0.2).normalize());
    let light = json!([{"type": "rect", "intensity": 500.0, "color": [1.0, 0.5, 0.25], "size": 0.4,
        "rect": {"aspect": 2.0}}]);
    let node = json!({"translation": [0.1, 1.5, -0.2], "rotation": tilt.to_array(), "scale": [1.0, -1.5, 0.5]});
    let points = [Vec3::ZERO, Vec3::new(0.7, 0.0, 0.3), Vec3::new(-1.0, 0.4, 0.9), Vec3::new(0.1, 2.5, -0.2)];
    let found = measured(panels(light, node), &points);
    let corner = |x: f32, y: f32| Vec3::new(0.1, 1.5, -0.2) + tilt * Vec3::new(x * 0.6, y * 0.3, 0.0);
    // Counter-clockwise as seen from -Z.
    let corners = [corner(-1.0, 1.0), corner(1.0, 1.0), corner(1.0, -1.0), corner(-1.0, -1.0)].map(Vec3::as_dvec3);
    let mean_radiance = 500.0 * 1.75 / 3.0;
    for (p, found) in points.iter().zip(&found).take(3) {
        let expected = polygon_irradiance(p.as_dvec3(), DVec3::Y, &corners, mean_radiance);
        assert!(expected > 1.0 && (found / expected - 1.0).abs() < 2e-3, "{p}: {found}, not {expected}");
    }
    assert_eq!(found[3], 0.0, "nothing goes backwards");
}

/// A disc on its axis, near and far.
#[test]
fn discs_light_as_the_formula_says() {
    let light = json!([{"type": "disk", "intensity": 2000.0, "size": 0.5}]);
    let node = json!({"translation": [0, 1, 0], "rotation": aim(Vec3::NEG_Y), "scale": [2, 2, 2]});
    let points = [Vec3::ZERO, Vec3::new(0.0, 0.9, 0.0), Vec3::new(0.0, -4.0, 0.0)];
    // One at a time: they would shade each other.
    for p in points {
        let found = measured(panels(light.clone(), node.clone()), &[p])[0];
        let expected = disc_irradiance(0.5, f64::from(1.0 - p.y), 2000.0);
        assert!((found / expected - 1.0).abs() < 2e-3, "{p}: {found}, not {expected}");
    }
}

/// Neither seen nor in the way; hidden by what is; switched and scaled by name, without a profile.
#[test]
fn area_lights_are_lights() {
    let light = json!([{"name": "panel", "type": "rect", "rect": {}}]);
    let up = json!({"translation": [0, 1, 0], "rotation": aim(Vec3::NEG_Y)});
    let scene = load(panels(light.clone(), up.clone())).expect("a good scene");
    assert_eq!(scene.triangle_count(), 2);
    let panel = &scene.lights[0];
    assert_eq!((panel.name.as_str(), panel.node, panel.intensity), ("panel", Some(1), Vec3::splat(1000.0)));
    assert_eq!(panel.kind, LightKind::Area(AreaShape::Rectangle { width: 1.0, height: 1.0 }));

    // A second lamp above shines through the first; a lid between hides both.
    let mut b = Builder::new(64);
    let black = b.diffuse(0.0, 0.0);
    b.quad("square", Vec3::new(-5e-4, 0.0, -5e-4), Vec3::Z * 1e-3, Vec3::X * 1e-3, black, [2, 2]);
    let mut built = b.finish();
    let mut above = scene.lights[0].clone();
    above.position.y = 2.0;
    let mut lit = |lights: Vec<_>| {
        built.lights = lights;
        mean_where(&run(&built, &plain(64, 0.1)), 0, |_| true).0
    };
    let [one, other] = [lit(vec![scene.lights[0].clone()]), lit(vec![above.clone()])];
    let both = lit(vec![scene.lights[0].clone(), above]);
    assert!(other > 100.0 && (both / (one + other) - 1.0).abs() < 2e-3, "{both}, not {one} + {other}");

    let named = |change: LightChange| {
        let mut scene = load(panels(light.clone(), up.clone())).expect("a good scene");
        scene.change(&Changes { lights: vec![("panel".into(), change)], nodes: Vec::new() }).map(|()| scene)
    };
    let off = named(LightChange { bake: Some(BakeMode::Off), scale: Some(0.5), ..LightChange::default() });
    let off = off.expect("a light");
    assert_eq!((off.lights[0].bake, off.lights[0].intensity), (BakeMode::Off, Vec3::splat(500.0)));
    let profiled = named(LightChange { ies: Some("lamp.ies".into()), ..LightChange::default() });
    assert!(profiled.expect_err("no profile").to_string().contains("is no point or spot light"));

    for (lights, expected) in [
        (json!([{"type": "sphere"}]), "EXT_lights_area.lights[0] has the type 'sphere', neither rect nor disk"),
        (json!([{"type": "rect", "size": "x"}]), "EXT_lights_area.lights[0]: invalid type"),
        (json!([]), "nodes[1] refers to EXT_lights_area.lights[0]"),
    ] {
        let error = load(panels(lights, up.clone())).expect_err(expected);
        assert!(error.contains(expected), "{error}");
    }
    for odd in [json!({"size": 0}), json!({"rect": {"aspect": -1}}), json!({"intensity": 1e39})] {
        let mut light = json!({"type": "rect"});
        light.as_object_mut().expect("an object").extend(odd.as_object().cloned().expect("an object"));
        match load(panels(json!([light]), up.clone())) {
            Ok(scene) => assert!(scene.lights.is_empty() && scene.warnings.iter().any(|w| w.code == "odd-light")),
            Err(error) => assert!(error.contains("EXT_lights_area.lights[0]"), "{error}"),
        }
    }
}
