//! Scenes whose geometry is packed: they hold what the same scenes hold unpacked, are written back as plain glTF,
//! and damage to them is an error.

mod common;
#[path = "common/glb_reader.rs"]
mod glb_reader;

use common::glb::SceneBuilder;
use common::packed::DRACO;
use common::random::Random;
use evenlight::options::Density;
use evenlight::output::glb::{GlbOptions, write};
use evenlight::scene::gltf::LoadOptions;
use evenlight::{BakeOptions, Scene};
use glb_reader::{Parsed, parse};
use serde_json::{Value, json};
use std::path::Path;

const FLOOR: [[f32; 3]; 4] = [[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]];

fn load_bytes(bytes: &[u8]) -> Result<Scene, evenlight::SceneError> {
    evenlight::scene::gltf::load_bytes(Path::new("packed.glb"), bytes)
}

fn load(builder: SceneBuilder) -> Scene {
    load_bytes(&builder.glb()).expect("the scene is good")
}

fn error(builder: SceneBuilder) -> String {
    load_bytes(&builder.glb()).expect_err("the scene is not good").to_string()
}

/// A floor, and two nodes that draw one box.
fn plain() -> SceneBuilder {
    SceneBuilder::new()
        .material("grey", [0.5; 3])
        .quad("floor", FLOOR)
        .cuboid("box", [-0.5, 0.0, -0.5], [0.5, 1.0, 0.5])
        .instance("box again")
        .with("translation", json!([3, 0, 0]))
}

/// All instances with the world positions of their corners.
fn corners(scene: &Scene) -> Vec<(String, Vec<[f32; 3]>)> {
    let of = |i: &evenlight::scene::Instance| {
        let primitives = scene.meshes[i.mesh].primitives.iter();
        let corners = primitives.flat_map(|p| p.triangles.iter().flatten().map(|&v| p.positions[v as usize]));
        corners.map(|p| i.world_from_object.transform_point3(p.as_dvec3()).as_vec3().to_array()).collect()
    };
    scene.instances.iter().map(|i| (i.name.clone(), of(i))).collect()
}

/// The scene as the bake of a small map would write it, checked by another reader.
fn written(scene: &Scene) -> (Parsed, Scene) {
    let options = BakeOptions { max_texture: 256, density: Density::Even, ..BakeOptions::default() };
    let atlas = evenlight::atlas::build(scene, &options, &|| false).expect("an atlas");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("scene.glb");
    let info = write(&path, &scene.source, scene, &atlas, &GlbOptions::default()).expect("the scene can be written");
    assert!(info.warnings.is_empty(), "{:?}", info.warnings);
    let parsed = parse(&std::fs::read(&path).expect("the file is there"));
    parsed.check();
    (parsed, Scene::from_gltf(&path).expect("what is written can be read"))
}

/// Loads damaged copies of a file: errors and odd scenes are fine, panics and hangs are not.
fn damage(good: &[u8], rounds: usize) {
    let mut random = Random::new(11);
    let mut random = |n: usize| random.below(n);
    let binary = good.windows(4).rposition(|w| w == b"BIN\0").expect("a binary chunk") + 4;
    for _ in 0..rounds {
        let mut bytes = good.to_vec();
        for _ in 0..1 + random(4) {
            // Most often the stream itself; else digits of the JSON.
            let at = if random(4) > 0 { binary + random(good.len() - binary) } else { random(binary) };
            if at >= binary {
                bytes[at] = if random(2) == 0 { random(256) as u8 } else { bytes[at] ^ 1 << random(8) };
            } else if let Some(b) = bytes[at..binary].iter_mut().find(|b| b.is_ascii_digit()) {
                *b = b'0' + random(10) as u8;
            }
        }
        if let Ok(scene) = load_bytes(&bytes) {
            for primitive in scene.meshes.iter().flat_map(|m| &m.primitives) {
                let n = primitive.positions.len();
                assert!(primitive.triangles.iter().flatten().all(|&v| (v as usize) < n));
                assert!(primitive.positions.iter().all(|p| p.is_finite()));
            }
        }
    }
}

/// Loads copies of a scene in which values of the JSON are of another kind than they should be.
fn confuse(builder: SceneBuilder, rounds: usize) {
    fn pointers(value: &Value, at: &str, found: &mut Vec<String>) {
        found.push(at.to_owned());
        match value {
            Value::Object(o) => o.iter().for_each(|(k, v)| pointers(v, &format!("{at}/{k}"), found)),
            Value::Array(a) => a.iter().enumerate().for_each(|(k, v)| pointers(v, &format!("{at}/{k}"), found)),
            _ => {}
        }
    }
    let good: Value = serde_json::from_str(&builder.gltf()).expect("JSON");
    let mut all = Vec::new();
    pointers(&good, "", &mut all);
    let odd = [
        json!(null),
        json!(0),
        json!(5),
        json!(-1),
        json!(1e300),
        json!("x"),
        json!([]),
        json!({}),
        json!(true),
        json!([5, {}]),
    ];
    let mut random = Random::new(3);
    for _ in 0..rounds {
        let mut json = good.clone();
        for _ in 0..1 + random.below(2) {
            if let Some(value) = json.pointer_mut(&all[random.below(all.len())]) {
                *value = odd[random.below(odd.len())].clone();
            }
        }
        let _ = load_bytes(json.to_string().as_bytes());
    }
}

#[test]
fn values_of_the_wrong_kind_never_panic() {
    let place = ("TRANSLATION", 5126, "VEC3", floats(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
    confuse(plain().meshopt(MESHOPT[0]), 5_000);
    confuse(SceneBuilder::new().draco("grid", DRACO[0]).draco("other", DRACO[1]), 20_000);
    confuse(instanced(&[place]), 5_000);
    confuse(variants(), 2_000);
}

const MESHOPT: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];

#[test]
fn meshopt_streams_hold_the_same_scene() {
    let expected = load(plain());
    for name in MESHOPT {
        let scene = load(plain().meshopt(name));
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        assert_eq!(corners(&scene), corners(&expected));
        let (a, b) = (&scene.meshes[1].primitives[0], &expected.meshes[1].primitives[0]);
        assert_eq!((&a.normals, &a.tex_coords), (&b.normals, &b.tex_coords));
        let (parsed, again) = written(&scene);
        assert!(!parsed.json.to_string().contains("meshopt"), "{}", parsed.json);
        assert_eq!(parsed.json["buffers"].as_array().map(Vec::len), Some(1));
        assert_eq!(corners(&again), corners(&expected));
    }
}

#[test]
fn meshopt_placeholders_need_no_mark_and_may_come_first() {
    let unmarked = |packed: SceneBuilder| {
        let text = packed.gltf();
        let mut json: Value = serde_json::from_str(&text).expect("JSON");
        json["buffers"][1].as_object_mut().expect("a placeholder").remove("extensions");
        json
    };
    let json = unmarked(plain().meshopt(MESHOPT[0]));
    let scene = load_bytes(json.to_string().as_bytes()).expect("the scene is good");
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    // The other way round.
    let mut json = json;
    let buffers = json["buffers"].as_array_mut().expect("buffers");
    buffers.swap(0, 1);
    for view in json["bufferViews"].as_array_mut().expect("views") {
        view["buffer"] = json!(0);
        view["extensions"][MESHOPT[0]]["buffer"] = json!(1);
    }
    let swapped = load_bytes(json.to_string().as_bytes()).expect("the scene is good");
    assert_eq!(corners(&swapped), corners(&scene));
    let (parsed, _) = written(&swapped);
    assert_eq!(parsed.json["buffers"].as_array().map(Vec::len), Some(1));
}

#[test]
fn meshopt_faults_are_named() {
    type Change = fn(&mut Value);
    let with = |change: Change| {
        error(plain().meshopt(MESHOPT[1]).patch(|j| change(&mut j["bufferViews"][0]["extensions"][MESHOPT[1]])))
    };
    let cases: [(&str, Change); 9] = [
        ("mode", |e| e["mode"] = json!("POINTS")),
        ("filter", |e| e["filter"] = json!("ROT13")),
        ("fit", |e| e["filter"] = json!("QUATERNION")),
        ("fit", |e| e["byteStride"] = json!(3)),
        ("count", |e| e["count"] = json!(-1)),
        ("byteLength", |e| e["count"] = json!(5)),
        ("outside", |e| e["byteLength"] = json!(u64::MAX)),
        ("outside", |e| e["byteOffset"] = json!("x")),
        ("decoded", |e| e["byteLength"] = json!(40)),
    ];
    for (what, change) in cases {
        let error = with(change);
        assert!(error.contains("packed.glb: bufferViews[0]") && error.contains(what), "{what}: {error}");
    }
    let bomb = error(plain().meshopt(MESHOPT[0]).patch(|j| {
        let view = &mut j["bufferViews"][0];
        view["byteLength"] = json!(12u64 << 40);
        view["extensions"][MESHOPT[0]]["count"] = json!(1u64 << 40);
    }));
    assert!(bomb.contains("MiB"), "{bomb}");
}

#[test]
fn damaged_meshopt_streams_never_panic() {
    damage(&plain().meshopt(MESHOPT[0]).glb(), 20_000);
}

/// The grid of [`DRACO`], with positions to half a step of 12 bits.
fn check_grid(scene: &Scene) {
    let grid = scene.meshes.iter().find(|m| m.name == "grid").expect("the mesh");
    let p = &grid.primitives[0];
    assert_eq!((p.positions.len(), p.triangles.len()), (9, 8));
    let mut above = 0.0;
    for t in &p.triangles {
        let [a, b, c] = t.map(|v| p.positions[v as usize]);
        above += 0.5 * (b - a).cross(c - a).y;
    }
    assert!((above - 4.0).abs() < 0.01, "area seen from above: {above}");
    let mut seen = Vec::new();
    for (at, uv) in p.positions.iter().zip(&p.tex_coords[0]) {
        let [x, z] = [2.0 * uv.x, 2.0 * uv.y];
        assert!(at.distance(glam::Vec3::new(x, x * z / 4.0, z)) < 1.5 * 2.0 / 4096.0, "{at} at {uv}");
        seen.push([x as i32, z as i32]);
    }
    seen.sort_unstable();
    seen.dedup();
    assert_eq!(seen.len(), 9);
}

#[test]
fn draco_streams_hold_what_was_encoded() {
    for stream in DRACO {
        let scene = load(plain().draco("grid", stream));
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        check_grid(&scene);
        let (parsed, again) = written(&scene);
        assert!(!parsed.json.to_string().contains("draco"), "{}", parsed.json);
        assert!(parsed.buffers.iter().all(|b| b.windows(5).all(|w| w != b"DRACO")), "the stream is still there");
        assert_eq!(parsed.json.get("extensionsRequired"), None);
        assert_eq!(corners(&again), corners(&scene));
    }
}

#[test]
fn draco_streams_may_be_shared_and_lie_in_packed_views() {
    // Two primitives with the same accessors, one with accessors of its own, and one whose accessors are taken.
    let shared = plain().draco("grid", DRACO[0]).draco("other", DRACO[1]).patch(|j| {
        let primitives = [0, 0, 1, 1].map(|i| j["meshes"][2 + i]["primitives"][0].clone());
        let mut primitives = json!(primitives);
        primitives[3]["attributes"] = primitives[0]["attributes"].clone();
        j["meshes"][2]["primitives"] = primitives;
    });
    let scene = load(shared);
    let positions: Vec<_> = scene.meshes[2].primitives.iter().map(|p| &p.positions).collect();
    assert_eq!(positions[0], positions[1]);
    assert_eq!(positions[2], positions[3]);
    assert_ne!(positions[0], positions[2], "the streams have their vertices in different orders");
    written(&scene);

    let nested = plain().draco("grid", DRACO[0]).meshopt(MESHOPT[0]);
    check_grid(&load(nested));
}

#[test]
fn uncompressed_data_beside_draco_is_used_where_it_may_be() {
    let fallback = |required: bool| {
        plain().draco("grid", DRACO[0]).patch(move |j| {
            let floor = j["meshes"][0]["primitives"][0].clone();
            j["meshes"][2]["primitives"][0]["attributes"] = json!({"POSITION": floor["attributes"]["POSITION"]});
            j["meshes"][2]["primitives"][0]["indices"] = floor["indices"].clone();
            if !required {
                j.as_object_mut().expect("an object").remove("extensionsRequired");
            }
        })
    };
    let scene = load(fallback(false));
    assert_eq!(scene.meshes[2].primitives[0].positions, scene.meshes[0].primitives[0].positions);
    let scene = load(fallback(true));
    assert_eq!(scene.meshes[2].primitives[0].positions.len(), 9);
    assert_eq!(scene.meshes[0].primitives[0].positions.len(), 4, "the floor keeps its accessor");
}

#[test]
fn draco_faults_are_named() {
    type Change = fn(&mut Value);
    let with = |change: Change| error(plain().draco("grid", DRACO[0]).patch(change));
    const AT: &str = "/meshes/2/primitives/0/extensions/KHR_draco_mesh_compression";
    let cases: [(&str, Change); 7] = [
        ("bufferViews[99]", |j| *j.pointer_mut(AT).unwrap() = json!({"bufferView": 99})),
        ("bufferView", |j| *j.pointer_mut(AT).unwrap() = json!({})),
        ("attribute 7", |j| j.pointer_mut(AT).unwrap()["attributes"]["POSITION"] = json!(7)),
        ("2 components", |j| j.pointer_mut(AT).unwrap()["attributes"]["POSITION"] = json!(0)),
        ("accessors", |j| j["meshes"][2]["primitives"][0]["indices"] = json!(1u64 << 40)),
        ("componentType", |j| {
            j["accessors"].as_array_mut().unwrap().iter_mut().for_each(|a| {
                a["componentType"] = json!(1);
            })
        }),
        ("decoded", |j| j["bufferViews"].as_array_mut().unwrap().iter_mut().for_each(|v| v["byteLength"] = json!(20))),
    ];
    for (what, change) in cases {
        let error = with(change);
        assert!(error.contains("packed.glb: meshes[2] primitive 0") && error.contains(what), "{what}: {error}");
    }
}

#[test]
fn damaged_draco_streams_never_panic() {
    for stream in DRACO {
        damage(&SceneBuilder::new().draco("grid", stream).glb(), 10_000);
    }
}

/// `plain()` with its last node drawn at three places more than once turned, by whichever attributes are given.
fn instanced(attributes: &[(&str, u32, &str, Vec<u8>)]) -> SceneBuilder {
    let mut builder = plain();
    let mut accessors = json!({});
    for (key, component, kind, bytes) in attributes {
        let size = match component {
            5126 => 4,
            5122 => 2,
            _ => 1,
        };
        let components = if *kind == "VEC4" { 4 } else { 3 };
        let index = builder.accessor(bytes, *component, kind, bytes.len() / (size * components));
        accessors[key] = json!(index);
    }
    builder.with("extensions", json!({"EXT_mesh_gpu_instancing": {"attributes": accessors}}))
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

#[test]
fn instances_become_nodes() {
    let attributes = [
        ("TRANSLATION", 5126, "VEC3", floats(&[0.0, 0.0, 2.0, 0.0, 4.0, 0.0, -6.0, 0.0, 0.0])),
        // A quarter turn about y, in whole numbers: not quite of length 1.
        (
            "ROTATION",
            5120,
            "VEC4",
            [[0i8, 90, 0, 90], [0, 0, 0, 127], [127, 0, 0, 0]].concat().iter().map(|&c| c as u8).collect(),
        ),
        ("SCALE", 5126, "VEC3", floats(&[2.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, 1.0])),
        ("_ID", 5126, "VEC3", floats(&[0.0; 9])),
    ];
    let scene = load(instanced(&attributes).with("extras", json!({"mine": 1, "evenlight": {"weight": 2}})));
    let codes: Vec<&str> = scene.warnings.iter().map(|w| w.code).collect();
    assert_eq!(codes, ["attribute-dropped"]);
    let names: Vec<&str> = scene.instances.iter().map(|i| i.name.as_str()).collect();
    assert_eq!(names, ["floor", "box", "box again_0", "box again_1", "box again_2"]);
    // The node is moved by (3, 0, 0). Translation * rotation * scale, by hand.
    let world = |i: usize, p: [f64; 3]| scene.instances[i].world_from_object.transform_point3(p.into());
    for (i, from, to) in [
        (2, [0.5, 1.0, 0.25], [3.25, 1.0, 1.0]),
        (3, [0.5, 1.0, 0.25], [3.5, 5.0, 0.25]),
        (4, [0.5, 1.0, 0.25], [-3.5, -1.0, -0.25]),
    ] {
        assert!(world(i, from).distance(to.into()) < 1e-6, "{i}: {}", world(i, from));
        assert_eq!((scene.instances[i].mesh, scene.instances[i].weight), (1, 2.0));
    }
    assert!(scene.instances[4].world_from_object.matrix3.determinant() < 0.0);

    let (parsed, again) = written(&scene);
    assert!(!parsed.json.to_string().contains("instancing"), "{}", parsed.json);
    assert_eq!(corners(&again), corners(&scene));
    let group = &parsed.json["nodes"][2];
    assert_eq!((group.get("mesh"), &group["children"], &group["extras"]["mine"]), (None, &json!([3, 4, 5]), &json!(1)));
    // A rectangle each, none of which overlap.
    let rects: Vec<Vec<f64>> = [1, 3, 4, 5]
        .iter()
        .map(|&n| {
            serde_json::from_value(parsed.json["nodes"][n]["extras"]["evenlight"]["rect"].clone()).expect("a rect")
        })
        .collect();
    for (i, a) in rects.iter().enumerate() {
        for b in &rects[i + 1..] {
            let apart = |k: usize| a[k] + a[k + 2] <= b[k] || b[k] + b[k + 2] <= a[k];
            assert!(apart(0) || apart(1), "{a:?} {b:?}");
        }
    }
}

#[test]
fn odd_instances_are_told() {
    let place = |values: &[f32]| ("TRANSLATION", 5126, "VEC3", floats(values));
    let scene = load(instanced(&[place(&[0.0, 0.0, 0.0, f32::NAN, 0.0, 0.0])]));
    assert_eq!((scene.instances.len(), scene.warnings[0].code), (3, "odd-transform"));
    written(&scene);
    let scene = load(instanced(&[]));
    assert_eq!((scene.instances.len(), scene.warnings[0].code), (3, "gpu-instancing"));
    let scene =
        load(instanced(&[place(&[0.0; 3])]).patch(|j| _ = j["nodes"][2].as_object_mut().unwrap().remove("mesh")));
    assert_eq!((scene.instances.len(), scene.warnings[0].code), (2, "gpu-instancing"));
    written(&scene);

    let differ = instanced(&[place(&[0.0; 6]), ("SCALE", 5126, "VEC3", floats(&[1.0; 9]))]);
    assert!(error(differ).contains("nodes[2] 'box again' SCALE has 3 values for 2 instances"));
    let flat = instanced(&[("TRANSLATION", 5126, "VEC4", floats(&[0.0; 8]))]);
    assert!(error(flat).contains("4 components"));
    let many = instanced(&[place(&[0.0; 3])]).patch(|j| {
        j["accessors"].as_array_mut().unwrap().last_mut().unwrap().as_object_mut().unwrap().remove("bufferView");
        j["accessors"].as_array_mut().unwrap().last_mut().unwrap()["count"] = json!(1 << 20);
    });
    assert!(error(many).contains("split the scene"));
    // Long extras, many times.
    let long = instanced(&[place(&[0.0; 30_000])]).with("extras", json!({"evenlight": {"note": "x".repeat(40_000)}}));
    assert!(error(long).contains("256 MiB"));
}

#[test]
fn animated_morph_targets_of_instances_stay_animated() {
    let scene = load(instanced(&[("TRANSLATION", 5126, "VEC3", floats(&[0.0, 0.0, 0.0, 5.0, 0.0, 0.0]))]).patch(|j| {
        let sampler = json!({"input": 0, "output": 0});
        j["animations"] = json!([{"samplers": [sampler], "channels": [
            {"sampler": 0, "target": {"node": 2, "path": "translation"}},
            {"sampler": 0, "target": {"node": 2, "path": "weights"}}]}]);
    }));
    let targets: Vec<Value> = scene.source.json["animations"][0]["channels"]
        .as_array()
        .unwrap()
        .iter()
        .map(|c| c["target"].clone())
        .collect();
    let target = |node: u32, path: &str| json!({"node": node, "path": path});
    assert_eq!(targets, [target(2, "translation"), target(3, "weights"), target(4, "weights")]);
}

#[test]
fn damaged_instances_never_panic() {
    let place = ("TRANSLATION", 5126, "VEC3", floats(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
    let turn = ("ROTATION", 5126, "VEC4", floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0]));
    damage(&instanced(&[place, turn]).glb(), 10_000);
}

#[test]
fn hidden_nodes_are_not_baked_but_kept() {
    let hide = |visible: bool| json!({"KHR_node_visibility": {"visible": visible}});
    let scene = |visible: bool| {
        plain()
            .point_light("lamp", [0.0, 2.0, 0.0], [100.0; 3])
            .camera("eye", [0.0, 1.0, 5.0], [0.0, 0.0, -1.0], 0.8)
            .node(json!({"name": "group", "extensions": hide(visible), "children": [1, 3, 4]}))
            .patch(|j| {
                j["extensionsUsed"] = json!(["KHR_lights_punctual", "KHR_node_visibility"]);
                j["extensionsRequired"] = j["extensionsUsed"].clone();
                j["scenes"][0]["nodes"] = json!([0, 5, 2]);
                // A child that says of itself that it is visible is not, below one that is not.
                j["nodes"][1]["extensions"] = hide(true);
            })
    };
    let all = load(scene(true));
    assert_eq!((all.instances.len(), all.lights.len(), all.cameras.len(), all.warnings.len()), (3, 1, 1, 0));
    let some = load(scene(false));
    assert_eq!((some.instances.len(), some.lights.len(), some.cameras.len()), (2, 0, 1));
    let warnings: Vec<_> = some.warnings.iter().map(|w| (w.code, w.message.starts_with("2 nodes"))).collect();
    assert_eq!(warnings, [("hidden-nodes", true)]);
    assert!(some.instances.iter().all(|i| i.name != "box"));

    let (parsed, again) = written(&some);
    assert_eq!(parsed.json["nodes"][5]["extensions"], hide(false));
    assert_eq!(parsed.json["extensionsRequired"], some.source.json["extensionsRequired"]);
    assert_eq!(again.instances.len(), 2);
}

/// A floor that is red, or green, or has no material, and a box that is always red.
fn variants() -> SceneBuilder {
    plain().material("red", [0.8, 0.1, 0.1]).material("green", [0.1, 0.8, 0.1]).patch(|j| {
        j["extensionsUsed"] = json!(["KHR_materials_variants", "KHR_xmp_json_ld"]);
        j["extensionsRequired"] = json!(["KHR_materials_variants"]);
        let names = json!([{"name": "Summer"}, {"name": "Autumn"}, {}]);
        j["extensions"] = json!({"KHR_materials_variants": {"variants": names},
            "KHR_xmp_json_ld": {"packets": [{"dc:title": "a floor"}]}});
        j["asset"]["extensions"] = json!({"KHR_xmp_json_ld": {"packet": 0}});
        let mappings = json!([{"material": 2, "variants": [0]}, {"material": 1, "variants": [1]}]);
        j["meshes"][0]["primitives"][0]["extensions"] = json!({"KHR_materials_variants": {"mappings": mappings}});
        j["meshes"][1]["primitives"][0]["material"] = json!(1);
    })
}

#[test]
fn variants_of_materials_are_chosen_by_name() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("shop.glb");
    std::fs::write(&path, variants().glb()).expect("the folder can be written");
    let load =
        |variant: Option<&str>| Scene::from_gltf_with(&path, &LoadOptions { variant: variant.map(str::to_owned) });
    for (variant, floor) in
        [(None, "grey"), (Some("Summer"), "green"), (Some("Autumn"), "red"), (Some("variant 2"), "grey")]
    {
        let scene = load(variant).expect("the scene is good");
        let material = |m: usize| scene.materials[scene.meshes[m].primitives[0].material].name.as_str();
        assert_eq!((material(0), material(1)), (floor, "red"), "{variant:?}");
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        let (parsed, _) = written(&scene);
        for key in ["extensions", "extensionsUsed", "extensionsRequired", "asset"] {
            assert_eq!(parsed.json[key], scene.source.json[key], "{key}");
        }
        let extensions = |j: &Value| j["meshes"][0]["primitives"][0]["extensions"].clone();
        assert_eq!(extensions(&parsed.json), extensions(&scene.source.json));
    }
    let error = load(Some("summer")).expect_err("no such variant").to_string();
    assert!(error.contains("'summer'") && error.contains("Summer, Autumn, variant 2"), "{error}");

    let run = |arguments: &[&str]| {
        let program =
            assert_cmd::Command::new(env!("CARGO_BIN_EXE_evenlight")).current_dir(&folder).args(arguments).output();
        let output = program.expect("the program starts");
        let text = |b: &[u8]| String::from_utf8_lossy(b).into_owned();
        (output.status.code(), text(&output.stdout), text(&output.stderr))
    };
    let bake =
        ["bake", "shop.glb", "-o", "out", "--sky", "1", "--max-texture", "64", "--max-photons", "1e4", "--variant"];
    let (status, _, message) = run(&[&bake[..], &["Winter"]].concat());
    assert!(status == Some(1) && message.contains("Summer, Autumn"), "{status:?} {message}");
    let (status, _, message) = run(&[&bake[..], &["Summer"]].concat());
    assert!(matches!(status, Some(0 | 3)), "{status:?} {message}");
    let manifest = std::fs::read(folder.path().join("out/lightmap.json")).expect("a manifest");
    assert_eq!(serde_json::from_slice::<Value>(&manifest).expect("JSON")["variant"], "Summer");
    let (status, text, _) = run(&["inspect", "shop.glb", "--variant", "Autumn"]);
    assert!(status == Some(0) && text.contains("variants    Summer, Autumn, variant 2"), "{text}");
}

#[test]
fn a_variant_without_a_material_is_a_fault() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("shop.glb");
    let broken = variants().patch(|j| {
        j["meshes"][0]["primitives"][0]["extensions"]["KHR_materials_variants"]["mappings"][0]["material"] = json!("x");
    });
    std::fs::write(&path, broken.glb()).expect("the folder can be written");
    assert!(Scene::from_gltf(&path).is_ok(), "nobody asked for a variant");
    let error = Scene::from_gltf_with(&path, &LoadOptions { variant: Some("Summer".into()) }).expect_err("broken");
    assert!(error.to_string().contains("meshes[0] 'floor' primitive 0"), "{error}");
}

#[test]
fn textures_in_ktx2_alone_are_told_with_the_cure() {
    let textured = |texture: Value| {
        plain().patch(move |j| {
            j["textures"] = json!([texture]);
            j["images"] = json!([{"uri": "a.ktx2"}, {"uri": "data:image/png;base64,"}]);
            j["extensionsUsed"] = json!(["KHR_texture_basisu"]);
            j["materials"][0]["emissiveTexture"] = json!({"index": 0});
        })
    };
    let basisu = json!({"KHR_texture_basisu": {"source": 0}});
    let scene = load(textured(json!({"extensions": basisu})));
    let told = scene.warnings.iter().find(|w| w.code == "image-not-found").expect("a warning");
    assert!(told.message.contains("materials[0] 'grey'") && told.message.contains("ktxdecompress"), "{}", told.message);
    // With another image for readers without KTX2, that one is taken.
    let scene = load(textured(json!({"source": 1, "extensions": basisu})));
    assert_eq!(scene.textures.len(), 1);
    let required =
        textured(json!({"extensions": basisu})).patch(|j| j["extensionsRequired"] = json!(["KHR_texture_basisu"]));
    assert!(error(required).contains("ktxdecompress"));
}
