//! Lights and nodes changed by name, from the command line and from a file: what is baked then, and what is said.

mod common;

use common::exr_reader::Picture;
use common::glb::SceneBuilder;
use common::program::{evenlight, expect, read_json};
use evenlight::options::{Audits, Density};
use evenlight::scene::{BakeMode, Changes, LightChange, LightKind, NodeChange, Scene};
use evenlight::{BakeOptions, NoObserver, bake};
use glam::Vec3;
use serde_json::{Value, json};
use std::path::Path;

/// A room of 4 x 3 x 4 m with the lamps "bulb" (of the node "pendant") and "spot", the sun "sun" and a tube that emits.
fn room(albedo: f32) -> SceneBuilder {
    SceneBuilder::new()
        .material("wall", [albedo; 3])
        .room("walls", [0.0; 3], [4.0, 3.0, 4.0])
        .cuboid("box", [1.0, 0.0, 1.0], [2.0, 1.0, 2.0])
        .emitter("tube", [albedo; 3], [20.0; 3])
        .cuboid("lamp", [0.5, 2.5, 1.0], [0.75, 2.75, 3.0])
        .point_light("bulb", [3.0, 2.0, 3.0], [40.0, 20.0, 10.0])
        .with("name", json!("pendant"))
        .spot_light("spot", [3.0, 2.5, 1.0], [0.0, -1.0, 0.0], [60.0; 3], 0.2, 0.5)
}

fn load(builder: SceneBuilder) -> Scene {
    evenlight::scene::gltf::load_bytes(Path::new("room.glb"), &builder.glb()).expect("a good scene")
}

fn options() -> BakeOptions {
    BakeOptions {
        target_percent: 1e6,
        target_mesh_percent: Some(1e9),
        max_texture: 64,
        density: Density::Even,
        audit: Audits::Off,
        seed: 5,
        ..BakeOptions::default()
    }
}

/// Irradiance of all texels of the first page.
fn baked(scene: &Scene) -> Vec<Vec3> {
    let bake = bake(scene, &options(), &mut NoObserver).expect("the bake succeeds");
    (0..bake.texels.mapped).map(|i| bake.solution.total.mean(i)).collect()
}

fn light(name: &str, change: LightChange) -> Changes {
    Changes { lights: vec![(name.into(), change)], nodes: Vec::new() }
}

fn mode(name: &str, bake: BakeMode) -> Changes {
    light(name, LightChange { bake: Some(bake), ..LightChange::default() })
}

fn scale(name: &str, scale: f32) -> Changes {
    light(name, LightChange { scale: Some(scale), ..LightChange::default() })
}

/// The room after changes.
fn changed(changes: &[Changes]) -> Scene {
    let mut scene = load(room(0.5));
    changes.iter().for_each(|c| scene.change(c).expect("the names are there"));
    scene
}

#[test]
fn a_light_is_found_by_its_name_by_its_node_and_by_how_the_name_begins() {
    for name in ["bulb", "pendant", "pend*", "b*"] {
        let scene = changed(&[mode(name, BakeMode::Off)]);
        assert_eq!(scene.lights[0].bake, BakeMode::Off, "{name}");
        assert_eq!((scene.lights[1].bake, scene.materials[1].bake), (BakeMode::Full, BakeMode::Full), "{name}");
        assert_eq!(scene.changed, ["light bulb: baked off, not full"]);
    }
    let scene = changed(&[mode("*", BakeMode::Indirect), scale("spot", 0.5)]);
    assert!(scene.lights.iter().all(|l| l.bake == BakeMode::Indirect));
    assert_eq!((scene.materials[0].bake, scene.materials[1].bake), (BakeMode::Full, BakeMode::Indirect), "wall, tube");
    assert_eq!(scene.lights[1].intensity, Vec3::splat(30.0));
}

#[test]
fn what_is_said_last_holds_and_what_stays_is_not_said() {
    let mut scene = load(room(0.5));
    let of = |bake, scale| LightChange { bake, scale, ies: None };
    let lights = vec![
        ("*".to_owned(), of(Some(BakeMode::Off), Some(3.0))),
        ("bulb".to_owned(), of(Some(BakeMode::Full), None)),
        ("spot".to_owned(), of(None, Some(1.0))),
    ];
    scene.change(&Changes { lights, nodes: Vec::new() }).expect("the names are there");
    let said =
        ["light bulb: times 3", "light spot: baked off, not full", "material tube: baked off, not full, times 3"];
    assert_eq!(scene.changed, said);
}

#[test]
fn names_that_nothing_has_are_refused_with_those_that_there_are() {
    let refused = |changes: Changes| load(room(0.5)).change(&changes).expect_err("refused").to_string();
    let error = refused(mode("bulbs", BakeMode::Off));
    assert!(
        error.contains("`bulbs`") && error.contains("`bulb`, `pendant`, `spot`") && error.contains("`tube`"),
        "{error}"
    );
    assert!(refused(mode("bulbs*", BakeMode::Off)).contains("`bulbs*`"));
    assert!(refused(scale("bulb", -1.0)).contains("scale -1 must be"));
    assert!(refused(scale("bulb", f32::NAN)).contains("must be"));
    let node = |name: &str, change| Changes { lights: Vec::new(), nodes: vec![(name.into(), change)] };
    let error = refused(node("wall", NodeChange { weight: Some(0.5), ..NodeChange::default() }));
    assert!(error.contains("`wall`") && error.contains("`box`, `lamp`, `walls`"), "{error}");
    assert!(refused(node("walls", NodeChange { density: Some(0.0), ..NodeChange::default() })).contains("density 0"));
}

/// The texels are those of a file that says the same itself.
#[test]
fn a_changed_light_bakes_as_if_the_file_said_so() {
    let patched = |patch: fn(&mut Value)| baked(&load(room(0.5).patch(patch)));
    let all = baked(&load(room(0.5)));
    type Patch = fn(&mut Value);
    let cases: [(Changes, Patch); 4] = [
        (mode("bulb", BakeMode::Off), |j| {
            j["extensions"]["KHR_lights_punctual"]["lights"][0]["extras"] = json!({"evenlight": {"bake": "off"}});
        }),
        (mode("bulb", BakeMode::Indirect), |j| {
            j["extensions"]["KHR_lights_punctual"]["lights"][0]["extras"] = json!({"evenlight": {"bake": "indirect"}});
        }),
        (scale("spot", 2.0), |j| j["extensions"]["KHR_lights_punctual"]["lights"][1]["intensity"] = json!(120.0)),
        (mode("tube", BakeMode::Off), |j| j["materials"][1]["emissiveFactor"] = json!([0, 0, 0])),
    ];
    for (changes, patch) in cases {
        let here = baked(&changed(std::slice::from_ref(&changes)));
        assert_eq!(here, patched(patch), "{changes:?}");
        assert_ne!(here, all, "{changes:?}");
    }
    // Twice as much of everything is twice as much.
    let double: Vec<Vec3> = all.iter().map(|e| *e * 2.0).collect();
    assert_eq!(baked(&changed(&[scale("*", 2.0)])), double);
}

/// The direct light of a lamp of which only the rest is baked is left out; where nothing reflects, that is all of it.
#[test]
fn an_emissive_material_can_be_baked_indirectly() {
    let only_tube = |albedo, bake| {
        let mut scene = load(room(albedo));
        scene.lights.clear();
        scene.change(&mode("tube", bake)).expect("it is there");
        scene
    };
    assert!(baked(&only_tube(0.0, BakeMode::Full)).iter().any(|e| e.x > 1.0));
    assert!(baked(&only_tube(0.0, BakeMode::Indirect)).iter().all(|e| *e == Vec3::ZERO));
    // Of what falls on walls of 0.5 in a closed room, half is reflected: as much again in all. The lamp itself has an
    // albedo of 0.5 as well.
    let sum = |bake| {
        let scene = only_tube(0.5, bake);
        let bake = evenlight::bake(&scene, &options(), &mut NoObserver).expect("the bake succeeds");
        common::rooms::received(&bake)
    };
    let share = sum(BakeMode::Indirect) / sum(BakeMode::Full);
    assert!((share - 0.5).abs() < 0.02, "{share}");
}

const UNIFORM: &str = "IESNA:LM-63-2002\nTILT=NONE\n1 -1 1 2 1 1 2 0 0 0\n1 1 0\n0 180\n0\n100 100\n";

#[test]
fn a_profile_has_the_candela_of_its_file_and_the_hue_of_the_light() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("even.ies");
    std::fs::write(&file, UNIFORM).expect("written");
    let ies = |name: &str| light(name, LightChange { ies: Some(file.clone()), ..LightChange::default() });
    let scene = changed(&[ies("pendant"), scale("bulb", 0.5)]);
    let bulb = &scene.lights[0];
    // 40, 20, 10 cd have a luminance of 23.53: 100 cd of that hue, and half.
    let luminance = bulb.intensity.dot(Vec3::new(0.2126, 0.7152, 0.0722));
    assert!((luminance - 50.0).abs() < 1e-3 && (bulb.intensity.x / bulb.intensity.z - 4.0).abs() < 1e-5, "{bulb:?}");
    assert!(scene.changed[0].starts_with("light bulb: shines as ") && scene.changed[0].ends_with("even.ies, 1257 lm"));
    // A cone gives way to the profile.
    assert_eq!(changed(&[ies("spot")]).lights[1].kind, LightKind::Point);
    let refused = |name: &str| {
        let mut scene = load(room(0.5).sun("noon", [0.0, -1.0, 0.0], [1e5; 3]));
        scene.change(&ies(name)).expect_err("refused").to_string()
    };
    assert!(refused("noon").contains("`noon` is no point or spot light"), "{}", refused("noon"));
    assert!(refused("tube").contains("`tube` is no point or spot light"));
}

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("room.glb"), room(0.5).glb()).expect("written");
    std::fs::write(folder.path().join("even.ies"), UNIFORM).expect("written");
    folder
}

const QUICK: [&str; 10] = [
    "--max-texture",
    "64",
    "--density",
    "even",
    "--target-percent",
    "500",
    "--audit",
    "off",
    "--no-preview",
    "--no-html",
];

#[test]
fn the_command_line_changes_lights_and_says_so() {
    let folder = folder();
    let flags = ["--light", "spot=off", "--light", "pend*=0.5", "--light=tube=indirect", "--ies", "bulb=even.ies"];
    let arguments = [&["bake", "room.glb", "-o", "out"][..], &QUICK, &flags, &["--remove-baked-lights"]].concat();
    let said = expect(&evenlight(folder.path(), &arguments), 0);
    assert!(said.contains("changed: light spot: baked off, not full"), "{said}");
    let report = read_json(&folder.path().join("out/report.json"));
    let changed = [
        "light bulb: shines as even.ies, 1257 lm, times 0.5",
        "light spot: baked off, not full",
        "material tube: baked indirect, not full",
    ];
    assert_eq!(report["changed"], json!(changed));
    let lights = &read_json(&folder.path().join("out/lightmap.json"))["lights"];
    assert_eq!(lights[0], json!({"name": "bulb", "node": 3, "profile": "even.ies", "bake": "full"}));
    assert_eq!(lights[1], json!({"name": "spot", "node": 4, "bake": "off"}));
    let written = Scene::from_gltf(folder.path().join("out/scene.glb")).expect("a good scene");
    assert_eq!(written.lights.len(), 1, "only the spot is left to the engine");

    for (flag, what) in [
        ("--sky=clear:3", "--sky clear: needs --sun"),
        ("--sky=clear:hazy", "takes clear:TURBIDITY[,GROUND]"),
        ("--sky=clear:0.5", "turbidity lies in 1 to 10"),
        ("--light=spot", "takes NAME=full"),
        ("--light=spot=bright", "takes NAME=full"),
        ("--light==off", "takes NAME=full"),
        ("--light=spots=off", "`bulb`, `pendant`, `spot`"),
        ("--ies=bulb", "takes NAME=FILE"),
        ("--ies=tube=even.ies", "is no point or spot light"),
    ] {
        let said = expect(&evenlight(folder.path(), &["bake", "room.glb", "-o", "new", flag]), 2);
        assert!(said.contains(what), "{flag}: {said}");
    }
    for (sun, what) in [("--sun=-5,0,0", "0 to 90 degrees high"), ("--sun=5,0,0", "--sky-rotation turns an image")] {
        let flags = ["bake", "room.glb", "-o", "new", "--sky=clear:3", "--sky-rotation=5", sun];
        let said = expect(&evenlight(folder.path(), &flags), 2);
        assert!(said.contains(what), "{sun}: {said}");
    }
    let said = expect(&evenlight(folder.path(), &["bake", "room.glb", "-o", "new", "--ies=bulb=room.glb"]), 1);
    assert!(said.contains("room.glb: line") && said.contains("no line TILT="), "{said}");
    assert!(!folder.path().join("new").exists());
}

/// A scene whose lamp stands beside it as an IES file: inspected, baked, and written as one file.
#[test]
fn profiles_of_a_scene_are_shown_and_embedded() {
    let folder = folder();
    let lamp = json!({"name": "street", "translation": [3, 2, 3], "extensions": {"EXT_lights_ies": {"light": 0}}});
    let scene = room(0.5).node(lamp).patch(|j| {
        j["extensions"]["EXT_lights_ies"] = json!({"lights": [{"uri": "even.ies"}]});
        j["extensionsUsed"].as_array_mut().expect("a list").push(json!("EXT_lights_ies"));
    });
    std::fs::write(folder.path().join("street.glb"), scene.glb()).expect("written");
    let said = evenlight(folder.path(), &["inspect", "street.glb", "--json"]);
    expect(&said, 0);
    let inspection: Value = serde_json::from_slice(&said.stdout).expect("JSON");
    let street = &inspection["lights"][2];
    assert_eq!(
        (&street["name"], &street["kind"], &street["intensity"]),
        (&json!("street"), &json!("point"), &json!([100.0, 100.0, 100.0]))
    );
    assert_eq!((&street["profile"]["file"], &street["profile"]["lamp_lumens"]), (&json!("even.ies"), &Value::Null));
    let lumens = street["profile"]["lumens"].as_f64().expect("a number");
    assert!((lumens - 400.0 * std::f64::consts::PI).abs() < 1e-2, "{lumens}");
    let text = evenlight(folder.path(), &["inspect", "street.glb"]).stdout;
    assert!(String::from_utf8_lossy(&text).contains("1257 lm by even.ies"));

    let bake = |more: &[&str]| {
        expect(&evenlight(folder.path(), &[&["bake", "street.glb", "-o", "out"][..], &QUICK, more].concat()), 0);
        // Moved to where no file lies beside it.
        let alone = folder.path().join("alone");
        std::fs::create_dir_all(&alone).expect("made");
        std::fs::copy(folder.path().join("out/scene.glb"), alone.join("scene.glb")).expect("copied");
        Scene::from_gltf(alone.join("scene.glb")).expect("a good scene")
    };
    let kept = bake(&[]);
    assert_eq!((kept.lights.len(), kept.lights[2].intensity), (3, Vec3::splat(100.0)));
    assert!(kept.lights[2].profile.is_some());
    let left = bake(&["--remove-baked-lights"]);
    assert!(left.lights.is_empty() && !left.source.json.to_string().contains("EXT_lights_ies"));
}

#[test]
fn a_file_says_what_the_flags_would() {
    let folder = folder();
    std::fs::create_dir(folder.path().join("settings")).expect("made");
    let config = r#"
# Paths are relative to this file.
scene = "../room.glb"
out = "../out"
max-texture = 64
density = "even"
target-percent = 500.0
audit = "off"
no-preview = true
no-html = true
float = false
layers = ["coverage", "area"]
sky = "clear:3"
sun = "40,90,0"
seed = 7

[light]
spot = "off"
"tu*" = 0.5

[light.bulb]
bake = "indirect"
scale = 2
ies = "../even.ies"

[node."box"]
weight = 0.5
density = 2.0

[node.lamp]
bake = false
"#;
    let file = folder.path().join("settings/bake.toml");
    std::fs::write(&file, config).expect("written");
    expect(&evenlight(folder.path(), &["bake", "--config", "settings/bake.toml"]), 0);
    let report = read_json(&folder.path().join("out/report.json"));
    let said: Vec<&str> = report["changed"].as_array().expect("a list").iter().filter_map(Value::as_str).collect();
    assert_eq!(said.len(), 5, "{said:?}");
    assert!(said[0].starts_with("light bulb: baked indirect, not full, shines as settings/../even.ies"), "{}", said[0]);
    assert_eq!(
        said[1..4],
        [
            "light spot: baked off, not full",
            "material tube: times 0.5",
            "node box: weight 0.5, not 1, density 2, not 1"
        ]
    );
    assert_eq!(said[4], "node lamp: bake false");
    assert_eq!((&report["seed"], &report["target_percent"]), (&json!(7), &json!(500.0)));
    let from_file = Picture::read(&folder.path().join("out/lightmap-0.exr"));
    assert!(from_file.channels.keys().any(|c| c.contains("area")), "{:?}", from_file.channels.keys());

    // The same by flags, but for what only the file can say.
    let flags = [
        "--light=spot=off",
        "--light=tu*=0.5",
        "--light=bulb=indirect",
        "--light=bulb=2",
        "--ies=bulb=even.ies",
        "--sky=clear:3,0.2",
        "--sun=40,90,0",
        "--seed=7",
        "--exclude=lamp",
        "--layers=coverage,area",
    ];
    let arguments = [&["bake", "room.glb", "-o", "flags"][..], &QUICK, &flags].concat();
    std::fs::write(&file, "[node.box]\nweight = 0.5\ndensity = 2.0\n").expect("written");
    expect(&evenlight(folder.path(), &[&arguments[..], &["--config", "settings/bake.toml"]].concat()), 0);
    let by_flags = Picture::read(&folder.path().join("flags/lightmap-0.exr"));
    assert_eq!(from_file.channels, by_flags.channels);
}

#[test]
fn the_command_line_wins_over_the_file() {
    let folder = folder();
    let config = "seed = 7\ntarget-percent = 300\nno-preview = true\nlight = [\"bulb=off\", \"spot=0.5\"]\n";
    std::fs::write(folder.path().join("bake.toml"), config).expect("written");
    let flags = ["--config=bake.toml", "--light=bulb=full", "--light=spot=0.25"];
    expect(&evenlight(folder.path(), &[&["bake", "room.glb", "-o", "out"][..], &QUICK, &flags].concat()), 0);
    let report = read_json(&folder.path().join("out/report.json"));
    assert_eq!((&report["seed"], &report["target_percent"]), (&json!(7), &json!(500.0)));
    assert_eq!(report["changed"], json!(["light spot: times 0.25"]));
}

#[test]
fn what_is_wrong_in_a_file_is_named_with_its_line() {
    let folder = folder();
    for (text, what) in [
        (
            "seed = 1\n\ntarget-precent = 5\n",
            "bake.toml: line 3: `bake` has no option `target-precent`; it has variant, target-percent",
        ),
        ("config = \"other.toml\"\n", "line 1: `bake` has no option `config`"),
        ("\nseed = \"x\"\n", "line 2: invalid value 'x' for '--seed <SEED>'"),
        ("\nlights = \"some\"\n", "line 2: invalid value 'some'"),
        ("float = 1\n", "line 1: `float` takes true or false"),
        ("seed = true\n", "line 1: `seed` takes a text or a number"),
        ("seed = [1]\n", "line 1: `seed` takes a text or a number"),
        ("\n\ngutter = 900\n", "line 3: --gutter 900"),
        ("\ndensity = \"dense\"\n", "line 2: --density dense"),
        ("light = [\"bulb\"]\n", "line 1: --light bulb: takes NAME=full"),
        ("[light.bulb]\nbake = \"half\"\n", "line 2: a light is baked full, indirect or off, not `half`"),
        ("[light.bulb]\nbake = true\nscael = 1\n", "line 3: a light has no `scael`; it has bake, scale, ies and group"),
        ("[light.bulb]\nscale = \"1\"\n", "line 2: `scale` takes a number"),
        ("[light.bulb]\nies = 5\n", "line 2: `ies` takes the name of a file"),
        ("[light]\nbulb = \"dim\"\n", "line 2: a light is baked"),
        ("[node]\nbox = 5\n", "line 2: a node takes a table"),
        ("[node.box]\nweigth = 5\n", "line 2: a node has no `weigth`"),
        ("[node.box]\nbake = 5\n", "line 2: `bake` takes true or false"),
        ("seed = \n", "line 1: "),
        ("seed = 1\nseed = 2\n", "line 2: duplicate key"),
    ] {
        std::fs::write(folder.path().join("bake.toml"), text).expect("written");
        let said = expect(&evenlight(folder.path(), &["bake", "room.glb", "-o", "out", "--config", "bake.toml"]), 2);
        assert!(said.contains(what) && said.contains("bake.toml"), "{text}: {said}, not {what}");
    }
    for (text, what) in [("[light.bulbs]\nbake = true\n", "`bulbs`"), ("[node.boxes]\nbake = true\n", "`boxes`")] {
        std::fs::write(folder.path().join("bake.toml"), text).expect("written");
        let said = expect(&evenlight(folder.path(), &["bake", "room.glb", "-o", "out", "--config", "bake.toml"]), 2);
        assert!(said.contains(what), "{said}");
    }
    let said = expect(&evenlight(folder.path(), &["bake", "room.glb", "-o", "out", "--config", "none.toml"]), 2);
    assert!(said.contains("--config none.toml: cannot read it"), "{said}");
    assert!(!folder.path().join("out").exists());
}
