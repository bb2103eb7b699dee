//! The loader against good, odd and damaged files: a scene or an error that names its cause, never a panic.

// A test says on standard error what it skipped.
#![allow(clippy::print_stderr)]

mod common;

use common::glb::SceneBuilder;
use evenlight::Scene;
use evenlight::scene::{Alpha, BakeMode, LightKind, Projection, Sky, Wrap};
use glam::{DVec3, Vec2, Vec3};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const FLOOR: [[f32; 3]; 4] = [[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]];

fn load_bytes(name: &str, bytes: &[u8]) -> Result<Scene, evenlight::SceneError> {
    evenlight::scene::gltf::load_bytes(Path::new(name), bytes)
}

fn load(builder: SceneBuilder) -> Scene {
    load_bytes("test.glb", &builder.glb()).expect("the scene is good")
}

fn codes(scene: &Scene) -> Vec<&str> {
    scene.warnings.iter().map(|w| w.code).collect()
}

/// A scene with one of everything.
fn everything() -> SceneBuilder {
    let mut builder = SceneBuilder::new()
        .material("grey", [0.5; 3])
        .quad("floor", FLOOR)
        .extras(json!({"weight": 2.0, "density": 0.5}))
        .emitter("lamp", [0.0; 3], [17.0, 12.0, 4.0])
        .cuboid("block", [-0.5; 3], [0.5; 3])
        .instance("mirrored")
        .with("scale", json!([-1, 2, 3]))
        .with("rotation", json!([0.0, 0.6, 0.0, 0.8]))
        .point_light("bulb", [0.0, 1.0, 0.0], [100.0, 50.0, 25.0])
        .spot_light("spot", [0.0, 2.0, 0.0], [0.0, -1.0, 0.0], [300.0; 3], 0.2, 0.5)
        .sun("sun", [1.0, -1.0, 0.0], [1000.0; 3])
        .extras(json!({"bake": "indirect"}))
        .camera("eye", [0.0, 1.0, 5.0], [0.0, 0.0, -1.0], 0.8)
        .sky([1.0, 2.0, 3.0]);
    let texture = builder.texture(&png(), "image/png");
    builder
        .patch(|json| json["samplers"] = json!([{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}]))
        .patch(|json| json["textures"][0]["sampler"] = json!(0))
        .material_json(json!({"name": "glass", "alphaMode": "MASK", "alphaCutoff": 0.25, "doubleSided": true,
            "emissiveTexture": {"index": texture, "texCoord": 0},
            "pbrMetallicRoughness": {"metallicFactor": 0, "baseColorTexture": {"index": texture, "extensions":
                {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [2, 2]}}}},
            "extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.5},
                "KHR_materials_diffuse_transmission": {"diffuseTransmissionFactor": 0.25,
                    "diffuseTransmissionColorFactor": [1, 0.5, 0.25],
                    "diffuseTransmissionTexture": {"index": texture},
                    "diffuseTransmissionColorTexture": {"index": texture, "extensions":
                        {"KHR_texture_transform": {"offset": [0.5, 0]}}}}}}))
        .quad("pane", FLOOR)
}

fn png() -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::RgbaImage::from_pixel(2, 2, image::Rgba([255, 0, 0, 255]))
        .write_to(&mut bytes, image::ImageFormat::Png)
        .expect("a PNG can be written to memory");
    bytes.into_inner()
}

#[test]
fn a_scene_with_everything() {
    let scene = load(everything());
    assert_eq!(codes(&scene), [""; 0]);
    assert_eq!(scene.triangle_count(), 2 + 12 + 12 + 2);
    let names: Vec<&str> = scene.instances.iter().map(|i| i.name.as_str()).collect();
    assert_eq!(names, ["floor", "block", "mirrored", "pane"]);
    assert_eq!((scene.instances[0].weight, scene.instances[0].density), (2.0, 0.5));
    assert!(scene.instances[2].world_from_object.matrix3.determinant() < 0.0);
    assert_eq!(scene.materials.len(), 4, "three and the default");
    assert!(scene.materials[1].emission.distance(Vec3::new(17.0, 12.0, 4.0)) < 1e-4);
    let glass = &scene.materials[2];
    assert_eq!((glass.alpha, glass.transmission, glass.double_sided), (Alpha::Mask { cutoff: 0.25 }, 0.5, true));
    assert_eq!(glass.diffuse_transmission, 0.25);
    assert_eq!(glass.diffuse_transmission_color, Vec3::new(1.0, 0.5, 0.25));
    assert!(glass.diffuse_transmission_texture.is_some());
    let reference = glass.diffuse_transmission_color_texture.expect("a texture");
    assert_eq!(reference.transform.transform_point2(Vec2::ONE), Vec2::new(1.5, 1.0));
    let reference = glass.base_color_texture.expect("a texture");
    assert_eq!(reference.transform.transform_point2(Vec2::ONE), Vec2::new(2.5, 2.0));
    let texture = &scene.textures[reference.texture];
    assert_eq!((texture.wrap, texture.nearest), ([Wrap::Clamp, Wrap::Mirror], true));
    assert_eq!(texture.decode_error(), None);

    let [bulb, spot, sun] = &scene.lights[..] else { panic!("three lights") };
    assert_eq!((bulb.kind, bulb.position), (LightKind::Point, DVec3::Y));
    assert!(bulb.intensity.distance(Vec3::new(100.0, 50.0, 25.0)) < 1e-3);
    assert!(spot.direction.distance(Vec3::NEG_Y) < 1e-6);
    assert!(matches!(spot.kind, LightKind::Spot { inner, outer } if inner == 0.2 && outer == 0.5));
    assert!(sun.direction.distance(Vec3::new(1.0, -1.0, 0.0).normalize()) < 1e-6);
    assert_eq!((bulb.bake, sun.bake), (BakeMode::Full, BakeMode::Indirect));
    let eye = &scene.cameras[0];
    assert!(eye.forward.distance(Vec3::NEG_Z) < 1e-6 && eye.up.distance(Vec3::Y) < 1e-6);
    assert!(matches!(eye.projection, Projection::Perspective { vertical_fov, .. } if vertical_fov == 0.8));
    assert!(matches!(scene.sky, Some(Sky::Constant(c)) if c == Vec3::new(1.0, 2.0, 3.0)));
}

#[test]
fn glb_and_gltf_hold_the_same_scene() {
    let glb = load(everything());
    let gltf = load_bytes("test.gltf", everything().gltf().as_bytes()).expect("the scene is good");
    assert_eq!(glb.source.buffers, gltf.source.buffers);
    assert_eq!(glb.meshes[0].primitives[0].positions, gltf.meshes[0].primitives[0].positions);
    let text = format!("\u{feff}{}", everything().gltf());
    let with_mark = load_bytes("test.gltf", text.as_bytes()).expect("a byte order mark is no error");
    assert_eq!(codes(&with_mark), ["byte-order-mark"]);
}

#[test]
fn unknown_properties_stay_in_the_document() {
    let scene = load(everything().patch(|json| json["nodes"][0]["strange"] = json!({"b": 1, "a": [2]})));
    assert_eq!(scene.source.json["nodes"][0]["strange"].to_string(), r#"{"b":1,"a":[2]}"#);
}

#[test]
fn files_beside_the_scene() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("sub folder")).expect("the folder can be written");
    let mut json: Value = serde_json::from_str(&everything().gltf()).expect("JSON");
    let data = load(everything()).source.buffers.remove(0);
    std::fs::write(at("sub folder/da ta.bin"), &data).expect("the folder can be written");
    std::fs::write(at("100%.png"), png()).expect("the folder can be written");
    json["images"][0] = json!({"uri": "100%.png"});
    let mut with = |uri: &str| {
        json["buffers"][0]["uri"] = json!(uri);
        std::fs::write(at("scene.gltf"), json.to_string()).expect("the folder can be written");
        Scene::from_gltf(at("scene.gltf")).map_err(|e| e.to_string())
    };
    for good in ["sub%20folder/da%20ta.bin", "sub folder/da ta.bin", "./sub folder/../sub folder\\da ta.bin"] {
        let scene = with(good).expect(good);
        assert_eq!(scene.textures[0].decode_error(), None);
    }
    for bad in ["../x.bin", "%2e%2e/x.bin", "/etc/hostname", "file:///etc/hostname", "https://a.org/b", "C:\\b"] {
        let error = with(bad).expect_err(bad);
        assert!(error.contains("not allowed") && error.contains("buffers[0]"), "{bad}: {error}");
    }
    assert!(with("absent.bin").expect_err("no such file").contains("absent.bin"));
    assert!(with("sub folder").expect_err("a folder").contains("is not a file"));
}

fn leafy(values: Value) -> Value {
    json!({"KHR_materials_diffuse_transmission": values})
}

#[test]
fn warnings_for_odd_but_usable_scenes() {
    let quad = || SceneBuilder::new().material("grey", [0.5; 3]).quad("floor", FLOOR);
    type Change = fn(&mut Value);
    let cases: [(&str, Change); 10] = [
        ("no-scene", |j| j.as_object_mut().into_iter().for_each(|o| o.retain(|k, _| !k.starts_with("scene")))),
        ("metal-by-default", |j| j["materials"][0] = json!({"name": "m"})),
        ("odd-material", |j| j["materials"][0]["extensions"] = leafy(json!({"diffuseTransmissionFactor": 1.5}))),
        ("extension-ignored", |j| j["extensionsUsed"] = json!(["ACME_anything"])),
        ("morph-targets", |j| j["meshes"][0]["primitives"][0]["targets"] = json!([{"POSITION": 0}])),
        ("skin", |j| j["nodes"][0]["skin"] = json!(0)),
        ("odd-transform", |j| j["nodes"][0]["scale"] = json!([0, 0, 1])),
        ("no-triangles", |j| j["meshes"][0]["primitives"][0]["mode"] = json!(1)),
        ("attribute-count", |j| j["accessors"][1]["count"] = json!(3)),
        ("incomplete-triangle", |j| j["accessors"][3]["count"] = json!(5)),
    ];
    for (code, change) in cases {
        let scene = load(quad().patch(change));
        assert!(codes(&scene).contains(&code), "{code}: {:?}", scene.warnings);
    }
}

#[test]
fn errors_name_object_and_cure() {
    let quad = || SceneBuilder::new().material("grey", [0.5; 3]).quad("floor", FLOOR);
    type Change = fn(&mut Value);
    let cases: [(&str, &str, Change); 11] = [
        ("nodes[0] 'floor'", "meshes[9]", |j| j["nodes"][0]["mesh"] = json!(9)),
        ("meshes[0] 'floor'", "materials[7]", |j| j["meshes"][0]["primitives"][0]["material"] = json!(7)),
        ("meshes[0] 'floor'", "accessors[44]", |j| j["meshes"][0]["primitives"][0]["indices"] = json!(44)),
        ("accessors[0]", "bufferViews[0]", |j| j["accessors"][0]["count"] = json!(5)),
        ("bufferViews[0]", "buffers[0]", |j| j["bufferViews"][0]["byteOffset"] = json!(u64::MAX)),
        ("meshes[0] 'floor'", "index", |j| j["accessors"][0]["count"] = json!(3)),
        ("ACME_must", "extension", |j| j["extensionsRequired"] = json!(["ACME_must"])),
        ("KHR_texture_basisu", "gltf-transform", |j| j["extensionsRequired"] = json!(["KHR_texture_basisu"])),
        ("glTF 1.0", "convert", |j| j["asset"]["version"] = json!("1.0")),
        ("materials[0] 'grey'", "KHR_materials_diffuse_transmission", |j| {
            j["materials"][0]["extensions"] = leafy(json!({"diffuseTransmissionColorFactor": [1, 1]}));
        }),
        ("scene", "4", |j| j["scene"] = json!(4)),
    ];
    for (object, detail, change) in cases {
        let error = load_bytes("test.glb", &quad().patch(change).glb()).expect_err(detail).to_string();
        assert!(error.contains("test.glb") && error.contains(object) && error.contains(detail), "{error}");
    }
}

#[test]
fn a_small_file_cannot_take_all_memory() {
    let zeros = json!({"componentType": 5126, "type": "VEC3", "count": 1u64 << 40});
    let error =
        load_bytes("bomb.glb", &SceneBuilder::new().quad("floor", FLOOR).patch(|j| j["accessors"][0] = zeros).glb());
    assert!(error.expect_err("too much").to_string().contains("split the scene"));
    // The same data many times.
    let many = SceneBuilder::new().quad("floor", FLOOR).patch(|j| {
        j["accessors"][0] = json!({"componentType": 5126, "type": "VEC3", "count": 1 << 24});
        let primitive = j["meshes"][0]["primitives"][0].clone();
        j["meshes"][0]["primitives"] = json!(vec![primitive; 1000]);
    });
    let start = Instant::now();
    assert!(load_bytes("many.glb", &many.glb()).is_err());
    assert!(start.elapsed() < Duration::from_secs(10));
}

#[test]
fn vertices_without_a_place_keep_their_triangles() {
    let mut corners = FLOOR;
    corners[3][0] = f32::NAN;
    let scene = load(SceneBuilder::new().quad("floor", corners).patch(|j| {
        j["accessors"][0].as_object_mut().into_iter().for_each(|a| a.retain(|k, _| k != "min" && k != "max"));
    }));
    let primitive = &scene.meshes[0].primitives[0];
    assert_eq!(primitive.triangles, [[0, 1, 2], [0, 0, 0]]);
    assert!(primitive.positions.iter().all(|p| p.is_finite()));
    assert!(codes(&scene).contains(&"non-finite-position"));
}

/// Damages good files in many ways; only panics (and hangs) fail.
#[test]
fn damaged_files_never_panic() {
    let attempt = |bytes: &[u8]| {
        if let Ok(scene) = load_bytes("damaged", bytes) {
            // What later stages rely on.
            for primitive in scene.meshes.iter().flat_map(|m| &m.primitives) {
                let n = primitive.positions.len();
                assert!(primitive.triangles.iter().flatten().all(|&v| (v as usize) < n));
                assert!(primitive.normals.is_empty() || primitive.normals.len() == n);
                assert!(primitive.colors.is_empty() || primitive.colors.len() == n);
                assert!(primitive.tex_coords.iter().all(|t| t.is_empty() || t.len() == n));
                assert!(primitive.positions.iter().all(|p| p.is_finite()));
                assert!(primitive.material < scene.materials.len());
            }
            assert!(scene.instances.iter().all(|i| i.mesh < scene.meshes.len()));
            assert!(scene.instances.iter().all(|i| i.world_from_object.is_finite()));
        }
    };
    let small = SceneBuilder::new().quad("floor", FLOOR).glb();
    let files = [everything().glb(), everything().gltf().into_bytes(), small];
    // SplitMix64, fixed seed (Steele, Lea, Flood, Fast splittable pseudorandom number generators, 2014).
    let mut state = 7u64;
    let mut random = |n: usize| {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) % n as u64) as usize
    };
    for good in &files {
        for _ in 0..10_000 {
            let mut bytes = good.clone();
            for _ in 0..1 + random(4) {
                let at = random(bytes.len());
                match random(5) {
                    0 => bytes[at] ^= 1 << random(8),
                    1 => bytes[at] = random(256) as u8,
                    // Most harm is done by numbers that are still numbers.
                    2 | 3 => {
                        if let Some(b) = bytes[at..].iter_mut().find(|b| b.is_ascii_digit()) {
                            *b = b'0' + random(10) as u8;
                        }
                    }
                    _ => {
                        let end = (at + 1 + random(8)).min(bytes.len());
                        bytes.drain(at..end);
                    }
                }
                if bytes.is_empty() {
                    break;
                }
            }
            attempt(&bytes);
        }
        for cut in 0..good.len().min(600) {
            attempt(&good[..cut * good.len() / good.len().min(600)]);
        }
    }
}

/// Each breaks one rule of glTF 2.0 in an object that nothing uses.
#[test]
fn faults_that_stand_in_nobodys_way_are_warned_of_by_their_place() {
    let cases: [(Value, &str); 17] = [
        (json!({"cameras": []}), "/cameras is empty"),
        (json!({"samplers": {}}), "/samplers is no array"),
        (json!({"skins": [1]}), "/skins/0 is no object"),
        (json!({"extensions": {"EXT_new": {}}}), "/extensions/EXT_new is not declared"),
        (
            json!({"extensionsUsed": ["KHR_xmp_json_ld", "KHR_xmp_json_ld"]}),
            "/extensionsUsed/1 names KHR_xmp_json_ld again",
        ),
        (
            json!({"extensionsUsed": ["KHR_materials_ior"], "samplers": [{"extensions": {"KHR_materials_ior": {}}}]}),
            "/samplers/0/extensions/KHR_materials_ior means nothing there",
        ),
        (json!({"textures": [{"source": 7}]}), "/textures/0/source refers to images[7], of 0"),
        (
            json!({"materials": [{"emissiveTexture": {"index": 3}}]}),
            "/materials/0/emissiveTexture/index refers to textures[3], of 0",
        ),
        (
            json!({"materials": [{"pbrMetallicRoughness": {"metallicFactor": 2}}]}),
            "/materials/0/pbrMetallicRoughness/metallicFactor is 2, outside of 0 to 1",
        ),
        (json!({"images": [{}]}), "/images/0 has to have one of uri and bufferView"),
        (json!({"images": [{"uri": ":"}]}), "/images/0/uri is no URI"),
        (json!({"images": [{"uri": "absent.png"}]}), "/images/0/uri cannot be read"),
        (json!({"images": [{"uri": "data:text/plain,a"}]}), "/images/0/uri is of the type `text/plain`"),
        (
            json!({"accessors": [{"byteOffset": 0, "componentType": 5126, "count": 1, "type": "SCALAR"}]}),
            "byteOffset has no",
        ),
        (
            json!({"accessors": [{"componentType": 5126, "count": 1, "type": "VEC2", "normalized": true}]}),
            "normalized is for",
        ),
        (
            json!({"bufferViews": [{"buffer": 4, "byteLength": 4, "byteStride": 6}]}),
            "byteStride is 6, not a multiple of 4",
        ),
        (json!({"bufferViews": [{"byteLength": 4}]}), "/bufferViews/0 has no buffer"),
    ];
    for (what, fault) in cases {
        let mut file = json!({"asset": {"version": "2.0"}});
        file.as_object_mut().expect("an object").extend(what.as_object().expect("an object").clone());
        let scene = load_bytes("test.gltf", &serde_json::to_vec(&file).expect("JSON")).expect("it does not matter");
        let found = |w: &evenlight::Warning| w.code == "fault-in-file" && w.message.contains(fault);
        assert!(scene.warnings.iter().any(found), "{fault}: {:?}", scene.warnings);
    }
    // Bounds of data are those of the data.
    let with_max = |max: f64| {
        let data = json!({
            "asset": {"version": "2.0"}, "buffers": [{"byteLength": 8, "uri": "data:application/octet-stream;base64,AACAPwAAAEA="}],
            "bufferViews": [{"buffer": 0, "byteLength": 8}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 2, "type": "SCALAR", "min": [1], "max": [max]}],
        });
        load_bytes("test.gltf", &serde_json::to_vec(&data).expect("JSON")).expect("it does not matter").warnings
    };
    let said = |warnings: &[evenlight::Warning]| warnings.iter().any(|w| w.message.contains("holds 1 values outside"));
    assert!(!said(&with_max(2.0)) && said(&with_max(1.5)));
    let many = json!({"asset": {"version": "2.0"}, "textures": vec![json!({"source": 9}); 30]});
    let scene = load_bytes("test.gltf", &serde_json::to_vec(&many).expect("JSON")).expect("it does not matter");
    assert!(
        scene.warnings.len() == 9 && scene.warnings[8].message.starts_with("22 more faults"),
        "{:?}",
        scene.warnings
    );
    assert!(codes(&load(everything())).iter().all(|code| *code != "fault-in-file"));
}

/// Every file that the glTF validator finds an error in is refused, or warned of.
#[test]
fn faults_that_the_validator_finds_are_found() {
    let Some(folder) = shared() else { return };
    let mut files = Vec::new();
    scenes_below(&folder.join("loader/invalid"), &mut files);
    let mut wrong = 0;
    for file in files {
        let mut report = file.clone().into_os_string();
        report.push(".report.json");
        let Ok(report) = std::fs::read(&report) else { continue };
        let report: Value = serde_json::from_slice(&report).expect("a report");
        if report["issues"]["numErrors"].as_u64().is_some_and(|n| n > 0) {
            wrong += 1;
            let found = Scene::from_gltf(&file).map_or(true, |scene| !scene.warnings.is_empty());
            assert!(found, "{}", file.display());
        }
    }
    assert!(wrong > 90, "{wrong} files");
}

/// The folder of real scenes that is not part of this repository, if it is there.
fn shared() -> Option<PathBuf> {
    let beside = || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared"));
    let folder = std::env::var_os("EVENLIGHT_SHARED").map_or_else(beside, PathBuf::from).join("scenes");
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("skipped: no folder of shared scenes");
    None
}

fn scenes_below(folder: &Path, found: &mut Vec<PathBuf>) {
    let mut entries: Vec<PathBuf> =
        std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect();
    entries.sort();
    for path in entries {
        if path.is_dir() {
            scenes_below(&path, found);
        } else if path.extension().is_some_and(|e| e == "glb" || e == "gltf") {
            found.push(path);
        }
    }
}

#[test]
fn every_shared_file_loads_or_says_why() {
    let Some(folder) = shared() else { return };
    let mut files = Vec::new();
    scenes_below(&folder, &mut files);
    assert!(files.len() > 100, "{} files", files.len());
    for file in files {
        let start = Instant::now();
        let result = Scene::from_gltf(&file);
        let seconds = start.elapsed().as_secs_f64();
        assert!(seconds < 10.0, "{}: {seconds} s", file.display());
        if std::env::var_os("EVENLIGHT_TABLE").is_some() {
            let name = file.strip_prefix(&folder).unwrap_or(&file).display();
            match result {
                Ok(s) => {
                    eprintln!("{name} | {} tri | {seconds:.2} s", s.triangle_count());
                    s.warnings.iter().for_each(|w| eprintln!("    {}: {}", w.code, w.message));
                }
                Err(e) => eprintln!("{name} | ERROR {e}"),
            }
        }
    }
}

/// Files of the shared loader tests that are refused, and what the message says. All others load.
const REFUSED: &[(&str, &str)] = &[
    ("ag_Compatibility_04.glb", "glTF 2.1"),
    ("invalid/IndexOutOfRange/IndexOutOfRange.gltf", "meshes[0] 'Mesh' primitive 0 has the index 255"),
    ("invalid/MissingBin/BoxTextured.gltf", "BoxTextured0.bin"),
    ("invalid/NoScene/NoScene.gltf", "`scene` is 0"),
    ("invalid/RecursiveNodes/RecursiveNodes.gltf", "its own ancestor"),
    ("invalid/badExtension/badExtension.gltf", "materials[0] 'Texture'"),
    ("invalid/badNumber/badNumber.gltf", "materials[0] 'Texture'"),
    ("invalid/badObject/badObject.gltf", "materials[0] 'Texture'"),
    ("invalid/sceneWrongType/sceneWrongType.gltf", "BoxTextured0.bin"),
    ("invalid/tinygltf-BoundsChecking/integer-out-of-bounds.gltf", "bufferViews[0]"),
    ("invalid/tinygltf_integer-out-of-bounds.glb", "bufferViews[0]"),
    ("buffer/empty_object.gltf", "buffers[0] has no byteLength"),
    ("buffer/invalid_object.gltf", "buffers[0] has no byteLength"),
    ("buffer/invalid_uri_data.glb", "no comma"),
    ("buffer/invalid_uri_data_bytelength.gltf", "buffers[0] is cut off"),
    ("buffer/invalid_uri_scheme.gltf", "cannot read"),
    ("buffer/non_relative_uri.gltf", "not allowed"),
    ("buffer/not_found.gltf", "not_found.bin"),
    ("buffer/wrong_bytelength.glb", "buffers[0] is cut off"),
    ("node/infinite_transform.gltf", "JSON"),
    ("node/node_loop.gltf", "circular"),
    ("node/node_loop_scene.gltf", "its own ancestor"),
    ("node/node_parent_override.gltf", "twice"),
    ("node/unresolved_camera.gltf", "cameras[0]"),
    ("node/unresolved_child_node.gltf", "nodes[1]"),
    ("node/unresolved_mesh.gltf", "meshes[0]"),
    ("root/named_objects.gltf", "bufferViews[1]"),
    ("root/undefined_used_extensions.gltf", "KHR_extension"),
    ("root/unused_objects.gltf", "bufferViews[1]"),
];

/// Every file for tests of loaders has the triangles that the list of the collection says it has, by a reader that
/// is not this one, or is refused by name.
#[test]
fn every_loader_file_has_its_outcome() {
    let Some(folder) = shared() else { return };
    let list = std::fs::read_to_string(folder.join("SOURCES.md")).expect("the list of the collection");
    let folder = folder.join("loader");
    let mut files = Vec::new();
    scenes_below(&folder, &mut files);
    let (mut counted, mut refused) = (0, 0);
    for file in files {
        let name = file.strip_prefix(&folder).expect("a file in the folder").to_string_lossy().replace('\\', "/");
        let result = Scene::from_gltf(&file);
        if let Some((_, says)) = REFUSED.iter().find(|(refused, _)| name.ends_with(refused)) {
            let error = result.map(|_| ()).expect_err(&name).to_string();
            assert!(error.contains(says), "{name}: {error}");
            refused += 1;
            continue;
        }
        let scene = result.unwrap_or_else(|e| panic!("{name}: {e}"));
        let row = list.lines().find(|row| row.starts_with(&format!("| {name} |")));
        let cells = row.into_iter().flat_map(|row| row.split('|'));
        let triangles = cells.flat_map(|cell| cell.split(", ")).find_map(|fact| fact.trim().strip_suffix(" tri"));
        // The list counts the meshes of instanced nodes once.
        if let Some(triangles) = triangles.filter(|_| name != "bio_24_gpu_instancing.glb") {
            assert_eq!(scene.triangle_count().to_string(), triangles, "{name}");
            counted += 1;
        }
    }
    assert_eq!(refused, REFUSED.len());
    assert!(counted > 60, "{counted} files with a count");
}

/// Triangle counts as an independent reader found them.
#[test]
fn shared_files_hold_what_they_should() {
    let Some(folder) = shared() else { return };
    for (file, triangles) in [
        ("cornell-box.glb", 36),
        ("veach-ajar.glb", 4_484),
        ("modern-hall.glb", 28_655),
        ("living-room-2.glb", 400_378),
        ("classroom.glb", 103_830),
        ("breakfast-room.glb", 269_538),
        ("country-kitchen.glb", 1_021_596),
        ("lux-kitchen.glb", 82_742),
        ("map-complex.glb", 12_368),
        ("gazebo.glb", 730),
        ("medieval-building.glb", 16_603),
        ("godot-room.glb", 63_720),
        ("godot-living_room.glb", 5_088),
        ("bevy-CornellBox.glb", 36),
        ("bevy-MixedLightingExample.glb", 40_898),
        ("r3l-tile-game-room6.glb", 88),
        ("loader/khr_2CylinderEngine.glb", 121_496),
        ("loader/khr_SimpleSparseAccessor.glb", 12),
        ("loader/khr_RiggedSimple.glb", 188),
        ("loader/gen_house_quantized_uv1.glb", 10_497),
        ("loader/gen_veach-bidir_quantized.glb", 11_544),
        ("loader/gen_veach-bidir_meshopt.glb", 11_544),
        ("loader/assimp_2CylinderEngine_draco.glb", 110_336),
        ("loader/pc_chess-board_draco.glb", 178_848),
        ("loader/pc_heart_draco.glb", 180),
        ("loader/bio_24_gpu_instancing.glb", 2 + (958 + 941) * 4_032),
        ("loader/gk_japanese-bridge-garden_meshopt.glb", 21_883),
        ("loader/bio_02_shared_mesh.glb", 24),
        ("loader/external-uri/CubeImageUriSpaces/CubeImageUriMultipleSpaces.gltf", 12),
        ("loader/external-uri/CubeImageUriSpaces/CubeImageUriSpaces.gltf", 12),
    ] {
        let scene = Scene::from_gltf(folder.join(file)).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(scene.triangle_count(), triangles, "{file}");
        let undecoded: Vec<String> = scene.textures.iter().filter_map(|t| t.decode_error()).collect();
        assert!(undecoded.is_empty(), "{file}: {undecoded:?}");
    }
    // Strips and fans cover the same square as the list, from the same side.
    let area_vector = |file: &str| {
        let scene = Scene::from_gltf(folder.join(file)).unwrap_or_else(|e| panic!("{e}"));
        let p = &scene.meshes[0].primitives[0];
        let corners = p.triangles.iter().map(|t| t.map(|v| p.positions[v as usize]));
        corners.map(|[a, b, c]| (b - a).cross(c - a) * 0.5).sum::<Vec3>()
    };
    let list = area_vector("loader/ag_Mesh_PrimitiveMode_06.glb");
    for mode in ["07", "08", "10", "11", "12"] {
        let file = format!("loader/ag_Mesh_PrimitiveMode_{mode}.glb");
        if Scene::from_gltf(folder.join(&file)).is_ok_and(|s| s.triangle_count() > 0) {
            assert!(area_vector(&file).distance(list) < 1e-6, "{file}");
        }
    }
    // Compression by meshoptimizer leaves quantised numbers as they are, up to the order of the triangles.
    let area = |file: &str| -> f64 {
        let scene = Scene::from_gltf(folder.join(file)).unwrap_or_else(|e| panic!("{e}"));
        let of = |i: &evenlight::scene::Instance| -> f64 {
            let world = |v: Vec3| i.world_from_object.transform_point3(v.as_dvec3());
            let primitives = scene.meshes[i.mesh].primitives.iter();
            let corners =
                primitives.flat_map(|p| p.triangles.iter().map(|t| t.map(|v| world(p.positions[v as usize]))));
            corners.map(|[a, b, c]| 0.5 * (b - a).cross(c - a).length()).sum()
        };
        scene.instances.iter().map(of).sum()
    };
    let packed = area("loader/gen_veach-bidir_meshopt.glb");
    assert!((packed / area("loader/gen_veach-bidir_quantized.glb") - 1.0).abs() < 1e-6, "{packed} m2");
    assert_eq!(Scene::from_gltf(folder.join("loader/pc_Lights.glb")).map(|s| s.lights.len()).ok(), Some(4));
}

#[test]
fn shared_sky_loads() {
    let Some(folder) = shared() else { return };
    let (sky, warnings) =
        Sky::from_file(&folder.join("env/kloofendal_48d_partly_cloudy_1k.hdr"), 0.0, 1.0).expect("a good file");
    let Sky::Image { width, height, radiance, .. } = sky else { panic!("an image") };
    assert_eq!((width, height, radiance.len()), (1024, 512, 1024 * 512));
    assert!(warnings.is_empty());
}
