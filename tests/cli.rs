//! The program as a build step sees it: exit status, messages, files, JSON.

mod common;

use assert_cmd::Command;
use common::glb::SceneBuilder;
use common::program::{evenlight, expect, read_json, text};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Output;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures").join(name)
}

/// Bakes a fixture with small maps.
fn bake(folder: &Path, name: &str, more: &[&str]) -> Output {
    let scene = fixture(name);
    let mut arguments = vec!["bake", scene.to_str().expect("a path in UTF-8"), "-o", "out"];
    if !more.contains(&"--max-texture") {
        arguments.extend(["--max-texture", "64"]);
    }
    arguments.extend(more);
    evenlight(folder, &arguments)
}

fn temporary() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

/// Names of all files below `folder`, sorted.
fn files(folder: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let name = |e: std::io::Result<std::fs::DirEntry>| e.expect("an entry").file_name().to_string_lossy().into_owned();
    let mut names: Vec<String> = entries.map(name).collect();
    names.sort();
    names
}

#[test]
fn a_bake_that_meets_its_targets_writes_everything_and_returns_0() {
    let folder = temporary();
    let output = bake(
        folder.path(),
        "furnace.glb",
        &["--target-percent", "10", "--target-mesh-percent", "100", "--layers", "coverage,area", "--json"],
    );
    let message = expect(&output, 0);
    assert!(message.contains("target 10 % met"), "{message}");
    let out = folder.path().join("out");
    let expected =
        ["lightmap-0.exr", "lightmap-0.png", "lightmap.json", "report.html", "report.json", "scene.glb", "view-0.png"];
    assert_eq!(files(&out), expected);

    let printed: Value = serde_json::from_slice(&output.stdout).expect("stdout is the report alone");
    assert_eq!(printed, read_json(&out.join("report.json")));
    for key in [
        "sigma",
        "sigma_paper",
        "cell_bias",
        "texel_error_percent",
        "texel_grid_error",
        "texel_grid_resolution",
        "luminance_error_percent",
    ] {
        assert!(printed[key].is_number(), "{key}: {}", printed[key]);
    }
    assert!(printed["shown_error_percent"].as_f64() > printed["texel_grid_error"].as_f64());
    let interval = &printed["texel_error_interval"];
    assert!(interval[1].as_f64().is_some_and(|high| high <= 10.0), "{interval}");
    let (sigma, paper) = (printed["sigma"].as_f64(), printed["sigma_paper"].as_f64());
    assert_eq!(sigma.map(|s| 2.0 * s), paper);
    assert_eq!((&printed["target_met"], &printed["limit"]), (&Value::Bool(true), &Value::Null));
    assert!(printed["area_within_target"].as_f64().is_some_and(|share| (0.0..=1.0).contains(&share)));
    assert_eq!(printed["meshes"].as_array().map(Vec::len), Some(8), "six walls, block and wedge");
    assert_eq!(printed["energy"]["imbalance"], serde_json::json!([0, 0, 0]));

    let manifest = read_json(&out.join("lightmap.json"));
    assert_eq!((&manifest["quantity"], &manifest["unit"]), (&"irradiance-over-pi".into(), &"cd/m2".into()));
    assert_eq!(manifest["pages"][0]["file"], "lightmap-0.exr");
    assert_eq!(manifest["nodes"].as_array().map(Vec::len), Some(8));
}

/// E / pi = B_e / (1 - rho) = 3 / 0.5 nit in the furnace, straight from the file.
#[test]
fn the_exr_can_be_read_back() {
    use exr::prelude::*;
    let folder = temporary();
    let output =
        bake(folder.path(), "furnace.glb", &["--target-percent", "0.01", "--max-photons", "2e5", "--no-preview"]);
    expect(&output, 3);
    assert!(!files(&folder.path().join("out")).iter().any(|f| f.ends_with(".png")));
    let image = read_first_rgba_layer_from_file(
        folder.path().join("out/lightmap-0.exr"),
        |size, _| (size, Vec::<f32>::new()),
        |(_, values), _, (r, g, b, _): (f32, f32, f32, f32)| values.extend([r, g, b]),
    )
    .expect("an EXR file");
    let (size, values) = &image.layer_data.channel_data.pixels;
    assert!(size.0 <= 64 && size.1 <= 64 && values.len() == 3 * size.area());
    let covered: Vec<f32> = values.iter().copied().filter(|v| *v > 0.0).collect();
    let mean = covered.iter().sum::<f32>() / covered.len() as f32;
    assert!((mean / 6.0 - 1.0).abs() < 0.1, "mean {mean} nit");
}

#[test]
fn limits_that_bind_are_named_and_return_3() {
    for (flag, value, name) in [("--max-photons", "1000", "max-photons"), ("--time-limit", "0.01", "time-limit")] {
        let folder = temporary();
        let output = bake(folder.path(), "cube.glb", &["--target-percent", "0.001", flag, value, "--no-preview"]);
        let message = expect(&output, 3);
        assert!(message.contains(&format!("NOT met: ended by {name}")), "{message}");
        let report = read_json(&folder.path().join("out/report.json"));
        assert_eq!((&report["target_met"], &report["limit"]), (&Value::Bool(false), &name.into()));
        assert!(files(&folder.path().join("out")).contains(&"lightmap-0.exr".into()));
    }
}

#[test]
fn wrong_usage_returns_2_and_writes_nothing() {
    let cases: [(&[&str], &str); 9] = [
        (&["--no-such-flag"], "--no-such-flag"),
        (&["--target-percent", "0"], "--target-percent 0"),
        (&["--target-percent", "NaN"], "--target-percent NaN"),
        (&["--max-texture", "99999"], "--max-texture 99999"),
        (&["--density", "dense"], "--density dense"),
        (&["--sun", "45"], "--sun 45"),
        (&["--layers", "depth"], "\"depth\""),
        (&["--sky=-1"], "--sky -1"),
        (&["--max-photons", "many"], "--max-photons"),
    ];
    for (flags, named) in cases {
        let folder = temporary();
        let scene = fixture("cube.glb");
        let mut arguments = vec!["bake", scene.to_str().expect("a path in UTF-8"), "-o", "out"];
        arguments.extend(flags);
        let message = expect(&evenlight(folder.path(), &arguments), 2);
        assert!(message.contains(named), "{flags:?}: {message}");
        assert_eq!(files(folder.path()), [""; 0], "{flags:?}");
    }
    expect(&evenlight(temporary().path(), &[]), 2);
    expect(&evenlight(temporary().path(), &["bake", "scene.glb"]), 2);
    expect(&evenlight(temporary().path(), &["bake", "scene.glb", "--shard", "1/2", "-o", "out"]), 2);
    expect(&evenlight(temporary().path(), &["merge", "shard", "-o", "out"]), 2);
    expect(&evenlight(temporary().path(), &["plan", "scene.glb"]), 2);
}

#[test]
fn what_is_not_built_is_refused_not_ignored() {
    let flags: [&[&str]; 2] = [&["--texel-value", "fit"], &["other.glb"]];
    for flags in flags {
        let folder = temporary();
        let message = expect(&bake(folder.path(), "cube.glb", flags), 2);
        assert!(message.contains("is not built yet"), "{flags:?}: {message}");
        assert_eq!(files(folder.path()), [""; 0], "{flags:?}");
    }
    for command in [&["check", "s.glb"][..], &["view", "out"], &["selftest"]] {
        let message = expect(&evenlight(temporary().path(), command), 2);
        assert!(message.contains("is not built yet"), "{command:?}: {message}");
    }
}

#[test]
fn input_that_cannot_be_read_returns_1_and_names_the_file() {
    let folder = temporary();
    let whole = std::fs::read(fixture("cube.glb")).expect("the fixture is there");
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).expect("a file");
    write("empty.glb", b"");
    write("garbage.glb", b"this is no glTF file, only words");
    write("cut.glb", &whole[..whole.len() / 2]);
    write("text.gltf", b"{\"asset\": {\"version\": \"2.0\"}, ");
    write("version.gltf", b"{\"asset\": {\"version\": \"3.0\"}}");
    write("nothing.gltf", b"{\"asset\": {\"version\": \"2.0\"}, \"scenes\": [{}], \"scene\": 0}");
    std::fs::create_dir(folder.path().join("folder.glb")).expect("a folder");
    for name in ["missing.glb", "empty.glb", "garbage.glb", "cut.glb", "text.gltf", "version.gltf", "folder.glb"] {
        for command in [&["bake", name, "-o", "out"][..], &["inspect", name]] {
            let message = expect(&evenlight(folder.path(), command), 1);
            assert!(message.contains("error: ") && message.contains(name), "{command:?}: {message}");
        }
    }
    let message = expect(&evenlight(folder.path(), &["bake", "nothing.gltf", "-o", "out"]), 1);
    assert!(message.contains("error: "), "{message}");
    assert!(!folder.path().join("out").exists(), "nothing half-written");
}

#[test]
fn a_sky_or_node_that_is_not_there_is_an_error() {
    let folder = temporary();
    let message = bake(folder.path(), "cube.glb", &["--sky", "no-such-sky.hdr"]);
    assert!(expect(&message, 1).contains("no-such-sky.hdr"));
    let message = bake(folder.path(), "cube.glb", &["--only", "no-such-node"]);
    assert_ne!(message.status.code(), Some(0));
    assert!(text(&message.stderr).contains("no-such-node"), "{}", text(&message.stderr));
}

#[test]
fn results_that_cannot_be_written_return_1_and_leave_nothing_behind() {
    let folder = temporary();
    // A file where the folder should be.
    std::fs::write(folder.path().join("out"), b"in the way").expect("a file");
    let message = expect(&bake(folder.path(), "cube.glb", &[]), 1);
    assert!(message.contains("cannot write out"), "{message}");
    assert_eq!(files(folder.path()), ["out"]);

    // A folder where a result should be: what was there survives, no part of a file stays.
    let folder = temporary();
    let blocked = folder.path().join("out").join("lightmap.json");
    std::fs::create_dir_all(&blocked).expect("a folder");
    let message = expect(&bake(folder.path(), "cube.glb", &["--max-photons", "1000"]), 1);
    assert!(message.contains("lightmap.json"), "{message}");
    assert!(blocked.is_dir());
    assert_eq!(files(&folder.path().join("out")), ["lightmap.json"]);
}

#[cfg(unix)]
#[test]
fn a_smaller_bake_leaves_nothing_of_a_larger_one_and_all_that_is_not_ours() {
    let folder = temporary();
    let out = folder.path().join("out");
    let options = ["--target-percent", "50", "--target-mesh-percent", "100", "--no-html", "--no-preview"];
    let expect_files = |expected: &[&str]| {
        expect(&bake(folder.path(), "furnace.glb", &options), 0);
        assert_eq!(files(&out), expected);
    };
    std::fs::create_dir(&out).expect("a folder");
    let put = |name: &&str| std::fs::write(out.join(name), "old").expect("a file");
    ["report.html", "notes.txt"].iter().for_each(put);
    let written = ["lightmap-0.exr", "lightmap.json", "report.json", "scene.glb"];
    expect_files(&["lightmap-0.exr", "lightmap.json", "notes.txt", "report.html", "report.json", "scene.glb"]);
    // With a report of an earlier bake beside them, pages and views are known to be of that one.
    ["lightmap-1.exr", "lightmap-12.png", "view-3.png", "lightmap-x.exr"].iter().for_each(put);
    let mut expected = [&written[..], &["lightmap-x.exr", "notes.txt"]].concat();
    expected.sort_unstable();
    expect_files(&expected);
}

/// A ceiling turned upwards is named, shown and, once it is turned down, no longer shown.
#[test]
fn a_face_lit_from_behind_has_a_picture() {
    let folder = temporary();
    let out = folder.path().join("out");
    let write = |ceiling: [[f32; 3]; 4]| {
        let bytes = SceneBuilder::new()
            .material("grey", [0.5; 3])
            .quad("floor", [[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]])
            .quad("ceiling", ceiling)
            .point_light("lamp", [0.0, 1.0, 0.0], [100.0; 3])
            .glb();
        std::fs::write(folder.path().join("scene.glb"), bytes).expect("a file");
    };
    let run = || {
        let options = ["--target-percent", "20", "--target-mesh-percent", "100", "--max-texture", "64"];
        let arguments = [&["bake", "scene.glb", "-o", "out"][..], &options].concat();
        let said = expect(&evenlight(folder.path(), &arguments), 0);
        let report = read_json(&out.join("report.json"));
        let html = std::fs::read_to_string(out.join("report.html")).expect("a report");
        let pictures = files(&out).into_iter().filter(|f| f.starts_with("backs-")).collect::<Vec<_>>();
        (said, report["warnings"].to_string(), html.contains("Lit from behind"), pictures)
    };
    let up = [[-1.0, 2.0, 1.0], [1.0, 2.0, 1.0], [1.0, 2.0, -1.0], [-1.0, 2.0, -1.0]];
    write(up);
    let (said, warnings, html, pictures) = run();
    assert!(said.contains("backs-0.png shows where node ceiling is lit from behind"), "{said}");
    assert!(warnings.contains("backs-0.png") && warnings.contains("node ceiling: "), "{warnings}");
    assert!(html);
    assert_eq!(pictures, ["backs-0.png"]);

    write([up[3], up[2], up[1], up[0]]);
    let (_, warnings, html, pictures) = run();
    assert!(!warnings.contains("lit-from-behind") && !html && pictures.is_empty(), "{warnings}");
}

#[test]
fn a_reader_that_has_seen_enough_is_no_fault() {
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_evenlight"))
        .args(["inspect", "--json"])
        .arg(fixture("room.glb"))
        .stdout(std::process::Stdio::piped())
        .spawn()
        .expect("the program starts");
    drop(child.stdout.take());
    assert!(child.wait().expect("it ends").success());
}

#[test]
fn a_disk_that_fills_up_leaves_the_folder_as_it_was() {
    let folder = temporary();
    let out = folder.path().join("out");
    expect(&bake(folder.path(), "cube.glb", &[]), 0);
    let read = |name: &String| std::fs::read(out.join(name)).expect("a file");
    let before: Vec<_> = files(&out).iter().map(read).collect();
    let largest = before.iter().map(Vec::len).max().expect("files");

    // Half of the largest file is room for smaller ones alone; another seed would change them.
    let command = format!(
        "trap '' XFSZ; ulimit -f {}; exec '{}' bake '{}' -o out --max-texture 64 --seed 7",
        largest / 2 / 1024,
        env!("CARGO_BIN_EXE_evenlight"),
        fixture("cube.glb").display(),
    );
    let shell = Command::new("bash").current_dir(folder.path()).args(["-c", &command]).output().expect("bash");
    let message = expect(&shell, 1);
    assert!(message.contains("cannot write"), "{message}");
    assert_eq!(files(&out).iter().map(read).collect::<Vec<_>>(), before);
}

#[test]
fn the_same_bake_gives_the_same_bytes_on_any_number_of_threads() {
    let [a, b] = ["1", "3"].map(|threads| {
        let folder = temporary();
        let output = bake(
            folder.path(),
            "instances.glb",
            &["--max-texture", "128", "--max-photons", "1e4", "--threads", threads],
        );
        assert!(matches!(output.status.code(), Some(0 | 3)), "{}", text(&output.stderr));
        let read = |name: &str| std::fs::read(folder.path().join("out").join(name)).expect("a result");
        ["lightmap-0.exr", "lightmap.json", "scene.glb", "view-0.png"].map(read)
    });
    assert!(a == b);
}

#[test]
fn inspect_speaks_text_and_json() {
    let folder = temporary();
    let room = fixture("room.glb");
    let room = room.to_str().expect("a path in UTF-8");
    let output = evenlight(folder.path(), &["inspect", room]);
    expect(&output, 0);
    let words = text(&output.stdout);
    for word in ["triangles", "picture-spot", "bulb", "floor", "sky"] {
        assert!(words.contains(word), "{word} is missing in\n{words}");
    }
    let output = evenlight(folder.path(), &["inspect", room, "--json"]);
    expect(&output, 0);
    let inspection: Value = serde_json::from_slice(&output.stdout).expect("valid JSON");
    assert_eq!(inspection["name"], "room");
    assert_eq!(inspection["cameras"], serde_json::json!(["view"]));
    assert_eq!(inspection["warnings"], serde_json::json!([]));
    assert!(inspection["triangles"].as_u64().is_some_and(|n| (1000..5000).contains(&n)));
    assert_eq!(files(folder.path()), [""; 0], "inspect writes nothing");
}

/// A white leaf that lets half the light through in a dark colour is not too white.
#[test]
fn inspect_finds_what_is_whiter_than_any_surface() {
    let folder = temporary();
    let corners = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, 0.0]];
    let leaf = |name: &str, share: f32| {
        let values =
            serde_json::json!({"diffuseTransmissionFactor": share, "diffuseTransmissionColorFactor": [0.1, 0.2, 0.1]});
        serde_json::json!({"name": name, "pbrMetallicRoughness": {"metallicFactor": 0},
            "extensions": {"KHR_materials_diffuse_transmission": values}})
    };
    let scene = SceneBuilder::new()
        .material("white", [1.0; 3])
        .quad("a", corners)
        .material("grey", [0.5; 3])
        .quad("b", corners)
        .material_json(leaf("leaf", 0.5))
        .quad("c", corners)
        .material_json(leaf("white leaf", 0.01))
        .quad("d", corners);
    let path = folder.path().join("scene.glb");
    std::fs::write(&path, scene.glb()).expect("the folder can be written");
    let output = evenlight(folder.path(), &["inspect", "scene.glb", "--json"]);
    expect(&output, 0);
    let inspection: Value = serde_json::from_slice(&output.stdout).expect("valid JSON");
    let warnings = inspection["warnings"].as_array().expect("a list");
    let white: Vec<&str> =
        warnings.iter().filter(|w| w["code"] == "very-white").filter_map(|w| w["message"].as_str()).collect();
    let [wall, leaf] = white[..] else { panic!("{white:?}") };
    assert!(wall.contains("'white' reflects 100 %") && leaf.contains("'white leaf' reflects and transmits 99 %"));
}
