//! Which part a node takes in the bake: whether it casts, and whether it receives.

mod common;

use common::formulas::point_irradiance;
use common::glb::SceneBuilder;
use common::rooms::{Builder, run};
use common::runs::{self, node_mean, one_round};
use evenlight::options::{Audits, Density};
use evenlight::output::lightmap_exr::{self, ExrSettings};
use evenlight::scene::Scene;
use evenlight::{Bake, BakeOptions, NoObserver, bake};
use glam::{DVec3, Vec3};
use serde_json::{Value, json};
use std::path::Path;

const PAGE: u32 = 64;

/// A floor of albedo `floor` under a point light of 100 cd, and a board of albedo 0.8, instance 1: between them, or one
/// that stands on the floor and throws light back on it.
fn board(floor: f32, stands: bool) -> (Scene, DVec3) {
    let mut b = Builder::new(PAGE);
    let (grey, white) = (b.diffuse(floor, 0.0), b.diffuse(0.8, 0.0));
    b.quad("floor", Vec3::new(-2.0, 0.0, -2.0), Vec3::Z * 4.0, Vec3::X * 4.0, grey, [16; 2]);
    if stands {
        b.quad("board", Vec3::new(1.0, 0.0, -1.0), Vec3::Z * 2.0, Vec3::Y, white, [8; 2]);
    } else {
        b.quad("board", Vec3::new(-0.5, 0.5, -0.5), Vec3::Z, Vec3::X, white, [8; 2]);
    }
    let at = DVec3::new(0.25, 1.5, 0.0);
    b.point_light(at.as_vec3(), 100.0);
    (b.finish(), at)
}

/// What casts nothing throws no shadow and reflects nothing; its own map is as bright as it would be.
#[test]
fn what_casts_nothing_only_receives() {
    let (mut scene, at) = board(0.0, false);
    scene.instances[1].casts = false;
    runs::expect_texels("floor", &scene, PAGE, 16, |p, n| point_irradiance(p, n, at, 100.0));
    let apart = run(&scene, &one_round(PAGE));
    assert_eq!((apart.report.work.deposits, apart.report.atlas.transport_texels), (0, 0));
    let (scene, _) = board(0.0, false);
    let there = run(&scene, &one_round(PAGE));
    let mean = |bake: &Bake, i| node_mean(bake, &bake.solution.total.odd, i);
    let (one, other) = (mean(&apart, 1), mean(&there, 1));
    assert!((one / other - 1.0).abs() < 0.02, "{one} lux apart, {other} there");
    assert!(mean(&there, 0) < 0.9 * mean(&apart, 0), "with the board the floor is in its shadow");
}

/// What receives nothing has no map, but shadows and reflects as it did.
#[test]
fn what_receives_nothing_still_casts() {
    let (mut scene, _) = board(0.5, true);
    let mean = |scene: &Scene| {
        let means: Vec<f64> = (0..8)
            .map(|seed| {
                let bake = run(scene, &BakeOptions { seed, ..one_round(PAGE) });
                node_mean(&bake, &bake.solution.total.odd, 0)
            })
            .collect();
        means.iter().sum::<f64>() / 8.0
    };
    let there = mean(&scene);
    scene.instances[1].bake = false;
    let bake = run(&scene, &one_round(PAGE));
    assert!(bake.report.meshes.iter().all(|m| m.name == "floor"));
    assert!(bake.report.atlas.transport_texels > 0 && bake.report.work.deposits > 0);
    // A name may leave its end open.
    scene.instances[1].bake = true;
    for (only, exclude) in [(vec!["flo*".to_string()], vec![]), (vec![], vec![format!("{}*", scene.instances[1].name)])]
    {
        let bake = run(&scene, &BakeOptions { only, exclude, ..one_round(PAGE) });
        assert!(bake.report.meshes.iter().all(|m| m.name == "floor"));
    }
    scene.instances[1].bake = false;
    let unreceived = mean(&scene);
    assert!((unreceived / there - 1.0).abs() < 0.02, "{unreceived} lux, {there} with a map");
}

fn options() -> BakeOptions {
    BakeOptions {
        target_percent: 20.0,
        target_mesh_percent: Some(100.0),
        max_texture: PAGE,
        density: Density::Even,
        audit: Audits::Texels(64),
        sky: None,
        seed: 3,
        ..BakeOptions::default()
    }
}

/// A lit room of coloured walls; `before` and `after` add nodes.
fn room(before: impl FnOnce(SceneBuilder) -> SceneBuilder, after: impl FnOnce(SceneBuilder) -> SceneBuilder) -> Scene {
    let start = SceneBuilder::new().material("wall", [0.6, 0.5, 0.4]);
    let builder = before(start)
        .room("walls", [0.0; 3], [4.0, 3.0, 4.0])
        .cuboid("table", [1.0, 0.0, 1.0], [2.0, 1.0, 2.0])
        .emitter("tube", [0.5; 3], [20.0; 3])
        .cuboid("lamp", [0.5, 2.5, 1.0], [0.75, 2.75, 3.0])
        .point_light("bulb", [3.0, 2.0, 3.0], [40.0, 20.0, 10.0]);
    let builder = after(builder);
    evenlight::scene::gltf::load_bytes(Path::new("room.glb"), &builder.glb()).expect("a good scene")
}

/// The bytes of the map, and the report without times, memory and indices of nodes.
fn written(scene: &Scene) -> (Vec<u8>, Value) {
    let bake = bake(scene, &options(), &mut NoObserver).expect("the bake succeeds");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("map.exr");
    lightmap_exr::write(&path, &bake.lightmap.pages[0], &ExrSettings::default()).expect("written");
    let mut report = serde_json::to_value(&bake.report).expect("JSON");
    let fields = report.as_object_mut().expect("an object");
    fields.remove("seconds");
    for mesh in fields["meshes"].as_array_mut().expect("a list") {
        mesh.as_object_mut().expect("an object").remove("instance");
    }
    (std::fs::read(&path).expect("written"), report)
}

const APART: fn() -> Value = || json!({"casts": false, "receives": false});

/// Before, after and amid the others, inside the room and far out, shining, drawing the mesh of another: as if it were
/// not there.
#[test]
fn what_neither_casts_nor_receives_is_as_if_it_were_not_there() {
    let none = |b: SceneBuilder| b;
    let alone = written(&room(none, none));
    let ghost = |b: SceneBuilder| b.cuboid("ghost", [2.5, 0.1, 2.5], [3.5, 1.5, 3.5]).extras(APART());
    let far = |b: SceneBuilder| b.cuboid("far", [50.0; 3], [70.0; 3]).extras(APART());
    let shining = |b: SceneBuilder| {
        let b = b.emitter("glow", [0.5; 3], [1e4; 3]);
        b.cuboid("shining", [2.5, 0.1, 2.5], [3.5, 1.5, 3.5]).extras(APART())
    };
    let copy = |b: SceneBuilder| b.instance("copy").with("translation", json!([0.5, 0, 0])).extras(APART());
    for (what, scene) in [
        ("before", room(ghost, none)),
        ("after", room(none, ghost)),
        ("far", room(far, none)),
        ("shining", room(none, shining)),
        ("copy", room(none, |b| copy(b.cuboid("table 2", [3.0, 0.0, 0.5], [3.5, 0.5, 1.0]).extras(APART())))),
    ] {
        let with = written(&scene);
        assert_eq!(with.1, alone.1, "{what}");
        assert!(with.0 == alone.0, "{what}: other bytes");
    }
    // Where it casts it is seen.
    let there =
        |b: SceneBuilder| b.cuboid("ghost", [2.5, 0.1, 2.5], [3.5, 1.5, 3.5]).extras(json!({"receives": false}));
    assert!(written(&room(none, there)).0 != alone.0);
}

#[test]
fn bake_false_is_receives_false() {
    let none = |b: SceneBuilder| b;
    let with = |extras: Value| move |b: SceneBuilder| b.cuboid("box", [2.5, 0.0, 1.0], [3.5, 1.0, 2.0]).extras(extras);
    let (one, other) =
        (written(&room(none, with(json!({"bake": false})))), written(&room(none, with(json!({"receives": false})))));
    assert!(one == other);
}
