//! The written scene: every case of input geometry comes through with lightmap UVs and nothing else changed.

#[path = "common/glb_reader.rs"]
mod glb_reader;

use evenlight::atlas::{Atlas, MeshLayout, Page, Placement, PrimitiveLayout};
use evenlight::light::Lighting;
use evenlight::lightmap::{Lightmap, LightmapPage};
use evenlight::options::{Lights, Quantity};
use evenlight::output::glb::{GlbInfo, GlbOptions, write};
use evenlight::output::manifest::{BakedPart, Manifest, ManifestInputs};
use evenlight::scene::gltf::Document;
use evenlight::scene::{BakeMode, Instance, Light, LightKind, Mesh, Primitive, Scene};
use glam::{DAffine3, DVec3, Mat3, Vec2, Vec3};
use glb_reader::{Parsed, parse};
use serde_json::{Value, json};
use std::path::PathBuf;

/// A document under construction: views and accessors in the order in which they are added.
#[derive(Default)]
struct Builder {
    buffers: [Vec<u8>; 2],
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Builder {
    fn view(&mut self, buffer: usize, bytes: &[u8], stride: Option<usize>) -> usize {
        let data = &mut self.buffers[buffer];
        data.resize(data.len().next_multiple_of(4), 0xEE);
        let mut view = json!({ "buffer": buffer, "byteOffset": data.len(), "byteLength": bytes.len() });
        if let Some(stride) = stride {
            view["byteStride"] = stride.into();
        }
        data.extend_from_slice(bytes);
        self.views.push(view);
        self.views.len() - 1
    }

    fn accessor(&mut self, accessor: Value) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    /// A float accessor in a view of its own, with bounds where it has three components.
    fn floats(&mut self, buffer: usize, kind: &str, values: &[f32]) -> usize {
        let view = self.view(buffer, bytemuck::cast_slice(values), None);
        let n = if kind == "VEC3" { 3 } else { 2 };
        let mut accessor =
            json!({ "bufferView": view, "componentType": 5126, "count": values.len() / n, "type": kind });
        if n == 3 {
            let bound = |pick: fn(f32, f32) -> f32| {
                (0..3).map(|c| values[c..].iter().step_by(3).copied().reduce(pick)).collect::<Vec<_>>()
            };
            accessor["min"] = json!(bound(f32::min));
            accessor["max"] = json!(bound(f32::max));
        }
        self.accessor(accessor)
    }

    fn indices(&mut self, indices: &[u16]) -> usize {
        let view = self.view(0, bytemuck::cast_slice(indices), None);
        self.accessor(json!({ "bufferView": view, "componentType": 5123, "count": indices.len(), "type": "SCALAR" }))
    }
}

const SQUARE: [f32; 12] = [0., 0., 0., 1., 0., 0., 1., 1., 0., 0., 1., 0.];
const SQUARE_UV: [f32; 8] = [0., 0., 1., 0., 1., 1., 0., 1.];
const TWO_TRIANGLES: [u16; 6] = [0, 1, 2, 0, 2, 3];

/// One mesh per case; node n draws mesh n, and one more node draws the last mesh again.
fn fixture() -> Document {
    let mut b = Builder::default();
    let indices = b.indices(&TWO_TRIANGLES);
    let square = b.floats(0, "VEC3", &SQUARE);
    let square_uv = b.floats(0, "VEC2", &SQUARE_UV);

    // Interleaved position, normal and UV, and bytes of a kind that nobody here knows.
    let mut bytes = Vec::new();
    for v in 0..4 {
        bytes.extend_from_slice(bytemuck::cast_slice(&SQUARE[3 * v..3 * v + 3]));
        bytes.extend_from_slice(bytemuck::cast_slice(&[0.0f32, 0.0, 1.0]));
        bytes.extend_from_slice(bytemuck::cast_slice(&SQUARE_UV[2 * v..2 * v + 2]));
        bytes.extend_from_slice(&[v as u8, 200, 7, 0]);
    }
    let view = b.view(0, &bytes, Some(36));
    let interleaved = |b: &mut Builder, offset: usize, component: u32, kind: &str| {
        b.accessor(json!({ "bufferView": view, "byteOffset": offset, "componentType": component, "count": 4,
            "type": kind, "name": "kept name" }))
    };
    let (p, n) = (interleaved(&mut b, 0, 5126, "VEC3"), interleaved(&mut b, 12, 5126, "VEC3"));
    b.accessors[p]["min"] = json!([0, 0, 0]);
    b.accessors[p]["max"] = json!([1, 1, 0]);
    let (uv, odd) = (interleaved(&mut b, 24, 5126, "VEC2"), interleaved(&mut b, 32, 5121, "VEC3"));
    let interleaved = json!({ "attributes": { "POSITION": p, "NORMAL": n, "TEXCOORD_0": uv, "_ODD": odd },
        "indices": indices });

    // A strip with normalised 16-bit UVs.
    let corners = b.floats(1, "VEC3", &[0., 0., 0., 1., 0., 0., 0., 1., 0., 1., 1., 0.]);
    let strip_uv = b.view(1, bytemuck::cast_slice(&[0u16, 0, 65535, 0, 0, 65535, 65535, 65535]), None);
    let strip_uv = b.accessor(json!({ "bufferView": strip_uv, "componentType": 5123, "normalized": true,
        "count": 4, "type": "VEC2" }));
    let strip = json!({ "attributes": { "POSITION": corners, "TEXCOORD_0": strip_uv }, "mode": 5 });

    // A position accessor whose third vertex is replaced.
    let base = b.view(0, bytemuck::cast_slice(&SQUARE), None);
    let at = b.view(0, &[2], None);
    let values = b.view(0, bytemuck::cast_slice(&[2.0f32, 2.0, 0.5]), None);
    let sparse = b.accessor(json!({ "bufferView": base, "componentType": 5126, "count": 4, "type": "VEC3",
        "min": [0, 0, 0], "max": [2, 2, 0.5], "sparse": { "count": 1,
            "indices": { "bufferView": at, "componentType": 5121 }, "values": { "bufferView": values } } }));
    let sparse = json!({ "attributes": { "POSITION": sparse }, "indices": indices });

    // Two primitives on the same vertices, and a fan.
    let (first, second) = (b.indices(&[0, 1, 2]), b.indices(&[0, 2, 3]));
    let shared = |indices: usize| {
        json!({ "attributes": { "POSITION": square, "TEXCOORD_0": square_uv },
        "indices": indices, "material": 1 })
    };
    let fan = json!({ "attributes": { "POSITION": square }, "mode": 6 });

    // Second UVs that a material reads, and a mesh that is not baked with the same material.
    let second_uv = b.floats(1, "VEC2", &[0.5; 8]);
    let conflict = json!({ "attributes": { "POSITION": square, "TEXCOORD_0": square_uv, "TEXCOORD_1": second_uv },
        "indices": indices, "material": 0 });
    let unused_second = json!({ "attributes": { "POSITION": square, "TEXCOORD_0": square_uv,
        "TEXCOORD_1": second_uv }, "indices": indices, "material": 1 });

    // Morph targets, one of them sparse over zeros.
    let moved = b.floats(0, "VEC3", &[0., 0., 1., 0., 0., 2., 0., 0., 3., 0., 0., 4.]);
    let (at, values) = (b.view(0, &[1, 0], None), b.view(0, bytemuck::cast_slice(&[9.0f32, 8.0, 7.0]), None));
    let sparse_target = b.accessor(json!({ "componentType": 5126, "count": 4, "type": "VEC3",
        "min": [0, 0, 0], "max": [9, 8, 7], "sparse": { "count": 1,
            "indices": { "bufferView": at, "componentType": 5123 }, "values": { "bufferView": values } } }));
    let morph = json!({ "attributes": { "POSITION": square }, "indices": indices,
        "targets": [{ "POSITION": moved }, { "POSITION": sparse_target }] });

    let meshes = [
        json!([interleaved]),
        json!([strip]),
        json!([sparse]),
        json!([shared(first), shared(second), fan]),
        json!([conflict]),
        json!([conflict]),
        json!([unused_second]),
        json!([morph]),
        json!([{ "attributes": { "POSITION": square, "TEXCOORD_0": square_uv }, "indices": indices }]),
    ];
    let mut nodes: Vec<Value> = (0..meshes.len()).map(|m| json!({ "mesh": m })).collect();
    nodes.push(json!({ "mesh": meshes.len() - 1, "extras": { "mine": 1, "evenlight": { "weight": 2 } },
        "extensions": { "KHR_lights_punctual": { "light": 0 } } }));
    let info = |extra: Value| {
        let mut info = json!({ "index": 0, "texCoord": 1 });
        info.as_object_mut().unwrap().extend(extra.as_object().unwrap().clone());
        info
    };
    let json = json!({
        "asset": { "version": "2.0", "generator": "by hand" },
        "extensionsUsed": ["KHR_lights_punctual", "KHR_texture_transform", "EXT_nobody_knows"],
        "extensions": { "KHR_lights_punctual": { "lights": [{ "type": "point" }] } },
        "scene": 0,
        "scenes": [{ "nodes": (0..nodes.len()).collect::<Vec<_>>() }],
        "nodes": nodes,
        "meshes": meshes.iter().map(|p| json!({ "primitives": p })).collect::<Vec<_>>(),
        "materials": [
            { "name": "second set",
              "pbrMetallicRoughness": { "baseColorTexture": info(json!({})) },
              "emissiveTexture": { "index": 0, "extensions": { "KHR_texture_transform": { "texCoord": 1 } } },
              "extensions": { "EXT_nobody_knows": { "oddTexture": info(json!({ "strength": 3 })) } },
              "extras": { "index": 1, "texCoord": 1 } },
            { "name": "first set", "occlusionTexture": { "index": 0 } },
        ],
        "textures": [{ "source": 0 }],
        "images": [{ "uri": "a%20picture.png" }, { "uri": "missing.png" }],
        "buffers": [{ "byteLength": b.buffers[0].len() }, { "byteLength": b.buffers[1].len(), "uri": "b.bin" }],
        "bufferViews": b.views,
        "accessors": b.accessors,
        "extras": { "order": ["z", "a"], "odd": 1.5e-7 },
    });
    Document { path: "fixture.gltf".into(), json, buffers: b.buffers.into() }
}

/// Meshes that the fixture does not bake.
const UNBAKED: usize = 5;

/// The fixture as a scene; positions are not needed for writing.
fn scene_of(document: &Document) -> Scene {
    let list = |value: &Value| value.as_array().unwrap().clone();
    let meshes = list(&document.json["meshes"]);
    let nodes = list(&document.json["nodes"]);
    Scene {
        name: "fixture".into(),
        meshes: meshes
            .iter()
            .enumerate()
            .map(|(source, mesh)| Mesh {
                name: format!("mesh {source}"),
                source,
                primitives: (0..list(&mesh["primitives"]).len())
                    .map(|source| Primitive { source, ..Default::default() })
                    .collect(),
            })
            .collect(),
        instances: nodes
            .iter()
            .enumerate()
            .map(|(node, json)| Instance {
                node,
                name: format!("node {node}"),
                mesh: json["mesh"].as_u64().unwrap() as usize,
                world_from_object: DAffine3::IDENTITY,
                weight: 1.0,
                density: 1.0,
                bake: json["mesh"] != UNBAKED,
                casts: true,
            })
            .collect(),
        materials: Vec::new(),
        textures: Vec::new(),
        lights: vec![Light {
            name: "lamp".into(),
            node: Some(nodes.len() - 1),
            position: DVec3::ZERO,
            direction: Vec3::NEG_Z,
            axes: Mat3::IDENTITY,
            intensity: Vec3::ONE,
            kind: LightKind::Point,
            profile: None,
            bake: BakeMode::Full,
        }],
        cameras: Vec::new(),
        sky: None,
        warnings: Vec::new(),
        changed: Vec::new(),
        source: document.clone(),
    }
}

/// Files of the shared scenes, or none with a line that says so.
#[allow(clippy::print_stderr)]
fn shared_scenes() -> Vec<PathBuf> {
    let shared = std::env::var_os("EVENLIGHT_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared")), PathBuf::from);
    let folders = ["scenes", "scenes/loader", "scenes/loader/external-uri/CubeImageUriSpaces"];
    let files = folders.iter().filter_map(|f| std::fs::read_dir(shared.join(f)).ok()).flatten().flatten();
    let is_scene = |p: &PathBuf| p.extension().is_some_and(|e| e == "glb" || e == "gltf");
    let mut scenes: Vec<PathBuf> = files.map(|f| f.path()).filter(is_scene).collect();
    scenes.sort();
    if scenes.is_empty() {
        eprintln!("skipped: no scenes beside the repository");
    }
    scenes
}

/// The worst that charts can do to real files, and the best. With EVENLIGHT_TEST_OUTPUT set, the files are
/// kept there for other validators.
#[test]
fn real_scenes_stay_valid() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = std::env::var_os("EVENLIGHT_TEST_OUTPUT").map_or(temporary.path().into(), PathBuf::from);
    for file in shared_scenes() {
        // Files that cannot be loaded are the loader's affair.
        let Ok(scene) = Scene::from_gltf(&file) else { continue };
        let name = file.file_stem().unwrap().to_string_lossy().into_owned();
        for split in [false, true] {
            let atlas = scattered_atlas(&scene, split);
            let path = folder.join(format!("{name}{}.glb", if split { "-split" } else { "" }));
            let info = write(&path, &scene.source, &scene, &atlas, &GlbOptions::default()).unwrap();
            let layouts = atlas.meshes.iter().flatten().flat_map(|m| &m.primitives);
            let loaded = scene.meshes.iter().flat_map(|m| &m.primitives);
            let splits = layouts.zip(loaded).map(|(l, p)| l.source_vertices.len() - p.positions.len()).sum::<usize>();
            assert_eq!(info.split_vertices, splits, "{name}");
            assert!(info.warnings.is_empty(), "{name}: {:?}", info.warnings);
            parse(&std::fs::read(&path).unwrap()).check();
            let again = Scene::from_gltf(&path).unwrap();
            assert_eq!(again.triangle_count(), scene.triangle_count(), "{name}");
            let sets = again.meshes.iter().flat_map(|m| &m.primitives).map(|p| &p.tex_coords);
            assert!(sets.into_iter().all(|s| s.get(1).is_some_and(|uvs| !uvs.is_empty())), "{name}");
            for (a, b) in scene.meshes.iter().zip(&again.meshes) {
                for (a, b) in a.primitives.iter().zip(&b.primitives) {
                    let corners = |p: &Primitive| -> Vec<Vec3> {
                        p.triangles.iter().flatten().map(|&v| p.positions[v as usize]).collect()
                    };
                    assert_eq!(corners(a), corners(b), "{name}");
                }
            }
        }
    }
}

/// An atlas whose charts are single triangles where `split`, all in the unit square.
fn scattered_atlas(scene: &Scene, split: bool) -> Atlas {
    let placement = Placement { page: 0, origin: Vec2::new(1.0, 2.0), size: Vec2::new(3.0, 4.0) };
    let primitive = |p: &Primitive| {
        let mut layout =
            PrimitiveLayout { source_vertices: (0..p.positions.len() as u32).collect(), ..Default::default() };
        let mut taken = vec![false; p.positions.len()];
        for corners in &p.triangles {
            layout.charts.push(0);
            layout.triangles.push(corners.map(|v| {
                if split && std::mem::replace(&mut taken[v as usize], true) {
                    layout.source_vertices.push(v);
                    layout.source_vertices.len() as u32 - 1
                } else {
                    v
                }
            }));
        }
        layout.uvs = vec![Vec2::splat(0.25); layout.source_vertices.len()];
        layout
    };
    let mesh = |m: &Mesh| MeshLayout { primitives: m.primitives.iter().map(primitive).collect(), chart_count: 1 };
    Atlas {
        pages: vec![Page { width: 64, height: 32 }],
        meshes: scene.meshes.iter().map(|m| Some(mesh(m))).collect(),
        placements: vec![Some(placement); scene.instances.len()],
        first_chart: vec![0; scene.instances.len() + 1],
        ..Default::default()
    }
}

/// Every triangle a chart of its own where `split`, so that all shared vertices are split.
fn layout_of(source: &Parsed, primitive: &Value, split: bool) -> PrimitiveLayout {
    let triangles = source.triangles(primitive);
    let count = source.elements(primitive["attributes"]["POSITION"].as_u64().unwrap() as usize).len();
    let mut layout = PrimitiveLayout { source_vertices: (0..count as u32).collect(), ..Default::default() };
    let mut taken = vec![false; count];
    for (t, corners) in triangles.iter().enumerate() {
        layout.charts.push(t as u32);
        layout.triangles.push(corners.map(|v| {
            if split && std::mem::replace(&mut taken[v], true) {
                layout.source_vertices.push(v as u32);
                layout.source_vertices.len() as u32 - 1
            } else {
                v as u32
            }
        }));
    }
    let n = layout.source_vertices.len();
    layout.uvs = (0..n).map(|i| Vec2::new(i as f32 / n as f32, 1.0 - i as f32 / n as f32)).collect();
    layout
}

fn atlas_of(source: &Parsed, scene: &Scene, split: bool) -> Atlas {
    let mut atlas = Atlas { pages: vec![Page { width: 64, height: 32 }], ..Default::default() };
    for (i, instance) in scene.instances.iter().enumerate() {
        let (origin, size) = (Vec2::new(4.0 * i as f32, 2.0), Vec2::new(4.0, 8.0));
        atlas.placements.push(instance.bake.then_some(Placement { page: 0, origin, size }));
        atlas.first_chart.push(0);
    }
    for mesh in &scene.meshes {
        let primitives = source.json["meshes"][mesh.source]["primitives"].as_array().unwrap();
        let primitives = primitives.iter().map(|p| layout_of(source, p, split)).collect();
        atlas.meshes.push((mesh.source != UNBAKED).then_some(MeshLayout { primitives, chart_count: 1 }));
    }
    atlas
}

struct Written {
    before: Parsed,
    after: Parsed,
    atlas: Atlas,
    info: GlbInfo,
}

fn write_fixture(split: bool, options: &GlbOptions) -> Written {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a picture.png"), b"\x89PNG for the test").unwrap();
    let mut document = fixture();
    document.path = folder.path().join("fixture.gltf");
    let before = Parsed { json: document.json.clone(), buffers: document.buffers.clone() };
    let scene = scene_of(&document);
    let atlas = atlas_of(&before, &scene, split);
    let path = folder.path().join("scene.glb");
    let info = write(&path, &document, &scene, &atlas, options).unwrap();
    let file = std::fs::read(&path).unwrap();
    assert_eq!(file.len(), info.bytes);
    let after = parse(&file);
    after.check();
    Written { before, after, atlas, info }
}

/// Attributes of a primitive and its morph targets, by name.
fn streams(primitive: &Value) -> Vec<(String, usize)> {
    let mut streams = Vec::new();
    let mut add = |prefix: String, attributes: &Value| {
        for (name, index) in attributes.as_object().unwrap() {
            streams.push((format!("{prefix}{name}"), index.as_u64().unwrap() as usize));
        }
    };
    add(String::new(), &primitive["attributes"]);
    for (t, target) in primitive["targets"].as_array().into_iter().flatten().enumerate() {
        add(format!("target {t} "), target);
    }
    streams
}

/// Every corner of every triangle has what it had before, and its lightmap UV.
fn check_corners(w: &Written) {
    for (m, layout) in w.atlas.meshes.iter().enumerate() {
        let primitives = |p: &Parsed| p.json["meshes"][m]["primitives"].as_array().unwrap().clone();
        for (p, (old, new)) in primitives(&w.before).iter().zip(&primitives(&w.after)).enumerate() {
            let triangles = (w.before.triangles(old), w.after.triangles(new));
            assert_eq!(triangles.0.len(), triangles.1.len());
            let new_streams = streams(new);
            for (name, accessor) in streams(old) {
                let moved = (m == 4 && name == "TEXCOORD_1").then(|| "TEXCOORD_2".to_owned());
                if m == 6 && name == "TEXCOORD_1" {
                    continue;
                }
                let name = moved.unwrap_or(name);
                let Some(new) = new_streams.iter().find(|s| s.0 == name) else { panic!("mesh {m} lost {name}") };
                let (old, new) = (w.before.elements(accessor), w.after.elements(new.1));
                for (a, b) in triangles.0.iter().flatten().zip(triangles.1.iter().flatten()) {
                    assert_eq!(old[*a], new[*b], "{name} of mesh {m}, primitive {p}");
                }
            }
            let Some(layout) = layout.as_ref().map(|l| &l.primitives[p]) else { continue };
            let uv = w.after.elements(new["attributes"]["TEXCOORD_1"].as_u64().unwrap() as usize);
            for (v, at) in layout.triangles.iter().flatten().zip(triangles.1.iter().flatten()) {
                let local = layout.uvs[*v as usize];
                let place = w.atlas.placements[m].unwrap();
                // The last mesh is drawn twice and keeps local UVs.
                let last = m + 1 == w.atlas.meshes.len();
                let want = if last { local } else { (place.origin + local * place.size) / Vec2::new(64.0, 32.0) };
                assert_eq!(uv[*at], [f64::from(want.x), f64::from(want.y)], "UV of mesh {m}, primitive {p}");
            }
        }
    }
}

#[test]
fn split_geometry_of_every_kind_comes_through() {
    let w = write_fixture(true, &GlbOptions::default());
    check_corners(&w);
    assert_eq!(w.info.rewritten_primitives, w.info.primitives - 2, "one triangle has nothing to split");
    assert_eq!(w.info.split_vertices, 2 * (w.info.primitives - 2));
    let strip = &w.after.json["meshes"][1]["primitives"][0];
    assert_eq!(strip["mode"], 4);
    let uv = &w.after.json["accessors"][strip["attributes"]["TEXCOORD_0"].as_u64().unwrap() as usize];
    assert_eq!((&uv["componentType"], &uv["normalized"]), (&json!(5123), &json!(true)));
    let odd = &w.after.json["meshes"][0]["primitives"][0]["attributes"]["_ODD"];
    assert_eq!(w.after.json["accessors"][odd.as_u64().unwrap() as usize]["name"], "kept name");
}

#[test]
fn unsplit_geometry_keeps_its_accessors() {
    let w = write_fixture(false, &GlbOptions::default());
    check_corners(&w);
    assert_eq!((w.info.rewritten_primitives, w.info.split_vertices), (0, 0));
    let old = w.before.json["accessors"].as_array().unwrap();
    assert_eq!(w.after.json["accessors"].as_array().unwrap()[..old.len()], old[..]);
    assert_eq!(w.after.json["meshes"][1]["primitives"][0]["mode"], 5);
    assert_eq!(w.after.json["meshes"][0]["primitives"][0]["indices"], 0);
}

#[test]
fn what_is_not_touched_stays_as_it_was() {
    let w = write_fixture(true, &GlbOptions::default());
    for key in ["asset", "extras", "extensions", "extensionsUsed", "scenes", "textures"] {
        assert_eq!(w.after.json[key], w.before.json[key], "{key}");
    }
    let keys = |p: &Parsed| p.json.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    assert_eq!(keys(&w.after), keys(&w.before));
    // The mesh that is not baked reads what it read, although others on the same vertices were split.
    let unbaked = |p: &Parsed| p.json["meshes"][UNBAKED]["primitives"][0].clone();
    assert_eq!(unbaked(&w.after)["material"], unbaked(&w.before)["material"]);
    assert_eq!(w.after.json["materials"][0], w.before.json["materials"][0]);
}

#[test]
fn second_uvs_in_use_move_with_their_textures() {
    let w = write_fixture(true, &GlbOptions::default());
    assert_eq!((w.info.moved_uv_sets, w.info.duplicated_materials), (1, 1));
    let material = w.after.json["meshes"][4]["primitives"][0]["material"].as_u64().unwrap() as usize;
    assert_eq!(material, 2);
    let m = &w.after.json["materials"][material];
    assert_eq!(m["name"], "second set");
    assert_eq!(m["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"], 2);
    assert_eq!(m["emissiveTexture"]["extensions"]["KHR_texture_transform"]["texCoord"], 2);
    assert_eq!(m["extensions"]["EXT_nobody_knows"]["oddTexture"]["texCoord"], 2);
    assert_eq!(m["extras"], json!({ "index": 1, "texCoord": 1 }));
    let unused = w.after.json["meshes"][6]["primitives"][0]["attributes"].as_object().unwrap();
    assert!(!unused.contains_key("TEXCOORD_2"), "a set that nothing reads gives way");
}

#[test]
fn nodes_know_their_place_and_keep_their_extras() {
    let w = write_fixture(true, &GlbOptions::default());
    let extras = |node: usize| &w.after.json["nodes"][node]["extras"];
    assert_eq!(extras(0)["evenlight"], json!({ "lightmap": 0, "rect": [0.0, 0.0, 1.0, 1.0] }));
    assert_eq!(extras(8)["evenlight"], json!({ "lightmap": 0, "rect": [0.5, 0.0625, 0.0625, 0.25] }));
    let last = json!({ "weight": 2, "lightmap": 0, "rect": [0.5625, 0.0625, 0.0625, 0.25] });
    assert_eq!(extras(9), &json!({ "mine": 1, "evenlight": last }));
    assert!(w.after.json["nodes"][UNBAKED].get("extras").is_none());
}

#[test]
fn the_manifest_names_every_baked_node_and_can_be_read_back() {
    let document = fixture();
    let scene = scene_of(&document);
    let atlas = atlas_of(&Parsed { json: document.json.clone(), buffers: document.buffers.clone() }, &scene, false);
    let page = LightmapPage { width: 2, height: 1, coverage: vec![1.0, 0.5], ..Default::default() };
    let inputs = ManifestInputs { error_percent: vec![Some(1.5)], ..Default::default() };
    let quantity = Quantity::IrradianceOverPi;
    let lighting = Lighting::new(&scene, &Default::default()).unwrap();
    let map = Lightmap { pages: vec![page] };
    let manifest = Manifest::new(&scene, &atlas, &map, quantity, &lighting, Lights::Indirect, &inputs);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lightmap.json");
    manifest.write(&path).unwrap();
    let back: Manifest = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    assert_eq!(back, manifest);
    assert_eq!(manifest.nodes.len(), scene.instances.len() - 1);
    assert_eq!(manifest.nodes[0].error_percent, Some(1.5));
    assert_eq!(manifest.nodes[8].rect, [0.5625, 0.0625, 0.0625, 0.25]);
    assert_eq!((manifest.pages[0].coverage, manifest.unit.as_str()), (0.75, "cd/m2"));
    assert_eq!(manifest.lights[0].bake, BakedPart::Indirect);
}

#[test]
fn images_beside_the_document_are_taken_in() {
    let w = write_fixture(true, &GlbOptions::default());
    assert_eq!(w.info.embedded_images, 1);
    assert_eq!(w.info.warnings.len(), 1, "{:?}", w.info.warnings);
    assert_eq!(w.info.warnings[0].code, "image-not-embedded");
    assert_eq!(w.after.json["images"][1], json!({ "uri": "missing.png" }));
    let image = &w.after.json["images"][0];
    assert_eq!(image["mimeType"], "image/png");
    let view = &w.after.json["bufferViews"][image["bufferView"].as_u64().unwrap() as usize];
    let start = view["byteOffset"].as_u64().unwrap() as usize;
    assert_eq!(&w.after.buffers[0][start..start + 17], b"\x89PNG for the test");
}

#[test]
fn baked_lights_go_on_request() {
    let document = fixture();
    let nodes = evenlight::output::glb::fully_baked_lights(&scene_of(&document), Lights::All);
    let w = write_fixture(true, &GlbOptions { remove_baked_lights: nodes, ..GlbOptions::default() });
    assert_eq!(w.info.removed_lights, 1);
    assert!(w.after.json.get("extensions").is_none());
    assert!(w.after.json["nodes"][9].get("extensions").is_none());
    assert_eq!(w.after.json["extensionsUsed"], json!(["KHR_texture_transform", "EXT_nobody_knows"]));
}

#[test]
fn replaced_data_does_not_stay_in_the_file() {
    let w = write_fixture(true, &GlbOptions::default());
    let used: usize = w.after.json["bufferViews"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v["byteLength"].as_u64().unwrap() as usize)
        .sum();
    let views = w.after.json["bufferViews"].as_array().unwrap().len();
    assert!(w.after.buffers[0].len() <= used + 8 * views, "{} bytes for {used} in use", w.after.buffers[0].len());
}

#[test]
fn broken_geometry_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut document = fixture();
    let before = Parsed { json: document.json.clone(), buffers: document.buffers.clone() };
    let scene = scene_of(&document);
    let atlas = atlas_of(&before, &scene, true);
    document.buffers[1].truncate(8);
    let path = folder.path().join("scene.glb");
    let error = write(&path, &document, &scene, &atlas, &GlbOptions::default()).unwrap_err().to_string();
    assert!(error.contains("mesh 1,") || error.contains("mesh 1 ") && error.contains("bufferView"), "{error}");
    assert!(!path.exists());
    let error = write(&path, &document, &scene, &Atlas::default(), &GlbOptions::default()).unwrap_err();
    assert!(error.to_string().contains("another scene"), "{error}");
}
