//! Lights in groups: each a layer by itself, and the maps their sum.

mod common;

use common::exr_reader::Picture;
use common::glb::SceneBuilder;
use common::program::{evenlight, expect, read_json};
use evenlight::options::{Audits, Density, SkySource, Sun};
use evenlight::scene::{BakeMode, Changes, LightChange, Scene};
use evenlight::{Bake, BakeOptions, NoObserver, bake};
use glam::Vec3;
use serde_json::{Value, json};
use std::f32::consts::PI;
use std::path::Path;

/// A closed room of 4 x 3 x 4 m and albedo 0.5, with the lamps "bulb" (of the node "pendant") and "spot", and a tube of
/// 2.125 m2 that emits.
fn room() -> SceneBuilder {
    SceneBuilder::new()
        .material("wall", [0.5; 3])
        .room("walls", [0.0; 3], [4.0, 3.0, 4.0])
        .emitter("tube", [0.5; 3], [20.0; 3])
        .cuboid("lamp", [0.5, 2.25, 1.0], [0.75, 2.5, 3.0])
        .point_light("bulb", [3.0, 2.0, 3.0], [40.0, 20.0, 10.0])
        .with("name", json!("pendant"))
        .spot_light("spot", [3.0, 2.5, 1.0], [0.0, -1.0, 0.0], [60.0; 3], 0.2, 0.5)
}

fn scene() -> Scene {
    evenlight::scene::gltf::load_bytes(Path::new("room.glb"), &room().glb()).expect("a good scene")
}

fn options(groups: &[(&str, &str)]) -> BakeOptions {
    BakeOptions {
        target_percent: 3.0,
        target_mesh_percent: Some(1e9),
        max_texture: 64,
        density: Density::Even,
        seed: 5,
        groups: groups.iter().map(|(group, name)| ((*group).into(), (*name).into())).collect(),
        ..BakeOptions::default()
    }
}

fn baked<'s>(scene: &'s Scene, options: &BakeOptions) -> Bake<'s> {
    bake(scene, options, &mut NoObserver).expect("the bake succeeds")
}

const TWO: [(&str, &str); 2] = [("warm", "pendant"), ("cold", "tube")];

/// Of a lamp in a closed room of albedo 0.5, walls receive twice its flux; so they do of each group by itself.
#[test]
fn each_group_has_the_flux_of_its_lights_and_the_maps_are_their_sum() {
    let scene = scene();
    let bake = baked(&scene, &options(&TWO));
    let groups = &bake.solution.groups;
    assert_eq!(groups.iter().map(|g| g.group.name.as_str()).collect::<Vec<_>>(), ["warm", "cold", "rest"]);
    let metres2 = bake.world.frame.metres.powi(2) as f32;
    let received = |light: &[Vec3]| -> Vec3 {
        bake.texels.texels.iter().zip(light).map(|(t, e)| *e * (t.area * metres2)).fold(Vec3::ZERO, |a, b| a + b)
    };
    let flux = [Vec3::new(40.0, 20.0, 10.0) * (4.0 * PI), Vec3::splat(20.0 * PI * 2.125)];
    for (group, flux) in groups.iter().zip(flux) {
        let share = received(&group.light) / (2.0 * flux);
        assert!((share - 1.0).abs().max_element() < 0.02, "{}: {share}", group.group.name);
    }
    for i in 0..bake.texels.mapped {
        let sum = groups.iter().fold(Vec3::ZERO, |sum, g| sum + g.light[i]);
        assert!((bake.solution.total.mean(i) - sum).abs().max_element() <= 1e-6 * sum.max_element());
    }
    // Every layer is as good as was asked, and path tracing by all lights together agrees with the sum.
    let report = &bake.report;
    assert!(report.target_met && report.groups.iter().all(|g| g.target_met && g.texel_error_interval[1] <= 3.0));
    assert!(report.texel_error_percent < 3.0 && report.audit.is_some());
    assert_eq!(report.energy.imbalance, [0; 3]);
    let mean: f64 = report.groups.iter().map(|g| g.mean_irradiance).sum();
    assert!((mean / report.mean_irradiance - 1.0).abs() < 1e-9);
}

/// A layer is what a bake of its lights alone gives, within what both say of their errors, and so is the sum.
#[test]
fn a_layer_is_a_bake_of_its_lights_alone() {
    let scene = scene();
    let groups = baked(&scene, &BakeOptions { audit: Audits::Off, ..options(&[("tube", "tube")]) });
    let mut alone = self::scene();
    let off = LightChange { bake: Some(BakeMode::Off), ..LightChange::default() };
    let lights = ["bulb", "spot"].map(|name| (name.into(), off.clone())).to_vec();
    alone.change(&Changes { lights, nodes: Vec::new() }).expect("the names are there");
    let alone = baked(&alone, &BakeOptions { audit: Audits::Off, ..options(&[]) });
    let whole = baked(&scene, &BakeOptions { audit: Audits::Off, ..options(&[]) });
    let texels = &groups.texels.texels[..groups.texels.mapped];
    let apart = |a: &dyn Fn(usize) -> Vec3, b: &dyn Fn(usize) -> Vec3| {
        let (mut square, mut mean, mut area) = (0.0, 0.0, 0.0);
        for (i, t) in texels.iter().enumerate() {
            square += t.area * (a(i) - b(i)).length_squared() / 3.0;
            mean += t.area * b(i).element_sum() / 3.0;
            area += t.area;
        }
        100.0 * f64::from((square / area).sqrt() / (mean / area))
    };
    let tube = &groups.solution.groups[0];
    let off = apart(&|i| tube.light[i], &|i| alone.solution.total.mean(i));
    let stated = tube.error.high.hypot(alone.solution.error.high);
    assert!(off < stated, "{off} %, stated {stated} %");
    let off = apart(&|i| groups.solution.total.mean(i), &|i| whole.solution.total.mean(i));
    let stated = groups.solution.error.high.hypot(whole.solution.error.high);
    assert!(off < stated, "{off} %, stated {stated} %");
}

/// Lit by lamps on its two sides, a screen stores one side, and the figures of the sum are those of that side.
#[test]
fn groups_agree_on_the_side_that_is_stored() {
    let scene = SceneBuilder::new()
        .two_sided("screen", [0.5; 3])
        .quad("screen", [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 4.0, 0.0], [0.0, 4.0, 0.0]])
        .point_light("front", [2.0, 2.0, 2.0], [100.0; 3])
        .point_light("behind", [2.0, 2.0, -2.0], [90.0; 3]);
    let scene = evenlight::scene::gltf::load_bytes(Path::new("screen.glb"), &scene.glb()).expect("a good scene");
    let bake = baked(&scene, &options(&[("a", "front"), ("b", "behind")]));
    let alone = baked(&scene, &options(&[]));
    let share = bake.report.mean_irradiance / alone.report.mean_irradiance;
    assert!((share - 1.0).abs() < 0.01, "{share}");
    let [a, b] = [0, 1].map(|i| bake.report.groups[i].mean_irradiance);
    assert!(a > 1.0 && b == 0.0, "{a} {b}: the lamp behind does not reach the front");
    assert_eq!(bake.solution.weights.stored, alone.solution.weights.stored);
}

/// Of several rules the last holds; `sun` and `sky` are those of the options; what is empty is no group.
#[test]
fn every_light_is_in_one_group() {
    let scene = scene();
    let quick = BakeOptions { target_percent: 1e6, audit: Audits::Off, ..options(&[]) };
    let members = |groups: &[(&str, &str)], sky: bool| {
        let sun = Sun { elevation: 40.0, azimuth: 0.0, illuminance: 100.0, diameter: 0.5 };
        let bake = baked(
            &scene,
            &BakeOptions {
                sky: sky.then_some(SkySource::Constant(Vec3::ONE)),
                sun: sky.then_some(sun),
                groups: options(groups).groups,
                ..quick.clone()
            },
        );
        bake.report.groups.iter().map(|g| format!("{}: {}", g.name, g.lights.join(" "))).collect::<Vec<_>>()
    };
    assert_eq!(members(&[("all", "*"), ("key", "s*")], false), ["all: bulb tube", "key: spot"]);
    assert_eq!(members(&[("key", "s*"), ("all", "*")], false), ["all: bulb spot tube"]);
    assert_eq!(members(&[("day", "sun"), ("day", "sky")], true), ["day: sun sky", "rest: bulb spot tube"]);
    assert!(members(&[], true).is_empty());
    let refused =
        |groups: &[(&str, &str)]| bake(&scene, &options(groups), &mut NoObserver).expect_err("refused").to_string();
    let said = refused(&[("lamps", "bulbs")]);
    assert!(said.contains("--group lamps=bulbs") && said.contains("`bulb`, `pendant`, `spot`, `tube`"), "{said}");
    assert!(refused(&[("day", "sky")]).contains("no light that is baked is called `sky`"));
    assert!(refused(&[("a.b", "bulb")]).contains("letters, digits"));
    assert!(refused(&[("area", "bulb")]).contains("another layer has this name"));
    let many: Vec<(String, String)> = (0..16).map(|i| (format!("g{i}"), "bulb".into())).collect();
    let said = bake(&scene, &BakeOptions { groups: many, ..quick.clone() }, &mut NoObserver).expect_err("refused");
    assert!(said.to_string().contains("more than 16 groups"), "{said}");
}

#[test]
fn groups_are_layers_of_the_files() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("room.glb"), room().glb()).expect("written");
    let config =
        "group = [\"warm=bulb\"]\n\n[light.sky]\ngroup = \"day\"\n\n[light.\"tu*\"]\nscale = 2\ngroup = \"cold\"\n";
    std::fs::write(folder.path().join("bake.toml"), config).expect("written");
    let flags =
        ["--max-texture=64", "--density=even", "--target-percent=500", "--audit=off", "--no-preview", "--float"];
    let arguments = [&["bake", "room.glb", "-o", "out", "--config", "bake.toml", "--sky", "9"][..], &flags].concat();
    let said = expect(&evenlight(folder.path(), &arguments), 0);
    for line in ["group warm: ", "group day: ", "group cold: ", "group rest: "] {
        assert!(said.contains(line), "{line}: {said}");
    }
    let picture = Picture::read(&folder.path().join("out/lightmap-0.exr"));
    let names = ["warm", "day", "cold", "rest"];
    for channel in ["R", "G", "B"] {
        let layers = names.map(|name| picture.channel(&format!("{name}.{channel}")));
        for (i, &whole) in picture.channel(channel).iter().enumerate() {
            let sum: f32 = layers.iter().map(|l| l[i]).sum();
            assert!((sum - whole).abs() <= 1e-5 * whole, "{channel} {i}: {sum}, {whole}");
        }
    }
    // A closed room: nothing of the sky comes in. The bulb is warm.
    assert!(picture.channel("day.R").iter().all(|&e| e == 0.0));
    let light = |name: &str| picture.channel(name).iter().map(|&e| f64::from(e)).sum::<f64>();
    assert!(
        (light("warm.R") / light("warm.B") - 4.0).abs() < 0.2 && (light("cold.R") / light("cold.B") - 1.0).abs() < 0.1
    );
    let groups = &read_json(&folder.path().join("out/lightmap.json"))["groups"];
    assert_eq!(groups[1], json!({"name": "day", "lights": ["sky"]}));
    assert_eq!(groups[2], json!({"name": "cold", "lights": ["tube"]}));
    let report = read_json(&folder.path().join("out/report.json"));
    assert_eq!(report["groups"].as_array().map(Vec::len), Some(4));
    assert_eq!(report["changed"], json!(["material tube: times 2"]));
    let html = std::fs::read_to_string(folder.path().join("out/report.html")).expect("written");
    assert!(html.contains("Light groups") && html.contains("<b>cold</b>"));
    assert_eq!(report["groups"][0]["limit"], Value::Null);
    let said = expect(&evenlight(folder.path(), &["bake", "room.glb", "-o", "new", "--group", "lamps"]), 2);
    assert!(said.contains("takes GROUP=NAME"), "{said}");
}
