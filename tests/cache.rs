//! What is kept of a bake: nothing but time tells whether it was interrupted, and nothing stale is ever used.

mod common;

use common::glb::SceneBuilder;
use common::program::{evenlight, expect, read_json};
use evenlight::cache::{Cache, Key, Writing};
use evenlight::observer::Progress;
use evenlight::options::{Audits, Density};
use evenlight::scene::{Changes, LightChange, Scene};
use evenlight::{Bake, BakeError, BakeOptions, NoObserver, Observer, bake, bake_with_cache};
use serde_json::json;
use std::collections::BTreeMap;
use std::io::{Cursor, Read};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Keeps all that it is asked to in memory, as often as it can, for so many times.
#[derive(Debug, Clone)]
struct Memory {
    files: BTreeMap<String, Vec<u8>>,
    kept: usize,
    most: usize,
    found: Vec<&'static str>,
}

impl Memory {
    fn new() -> Memory {
        Memory { files: BTreeMap::new(), kept: 0, most: usize::MAX, found: Vec::new() }
    }

    /// Kinds of what was found since the last call, in order.
    fn found(&mut self) -> Vec<&'static str> {
        std::mem::take(&mut self.found)
    }
}

impl Cache for Memory {
    fn load(&mut self, key: &Key) -> Option<Box<dyn Read>> {
        let bytes = self.files.get(&key.to_string())?.clone();
        self.found.push(key.kind);
        Some(Box::new(Cursor::new(bytes)))
    }

    fn keep(&mut self, key: &Key, writing: &Writing) {
        if self.kept < self.most {
            let mut bytes = Vec::new();
            writing(&mut bytes).expect("memory can be written to");
            self.files.insert(key.to_string(), bytes);
        }
        self.kept += 1;
    }

    fn is_due(&self) -> bool {
        true
    }
}

/// Stops a bake at a call.
struct StopAt {
    calls: AtomicUsize,
    last: usize,
}

impl StopAt {
    fn call(last: usize) -> StopAt {
        StopAt { calls: AtomicUsize::new(0), last }
    }
}

impl Observer for StopAt {
    fn progress(&mut self, _progress: &Progress) {
        self.calls.fetch_add(1, Relaxed);
    }

    fn cancelled(&self) -> bool {
        self.calls.load(Relaxed) >= self.last
    }
}

/// A room with a lamp, a metal block that throws light, and a box on a table that is dim enough to gather its own.
fn scene() -> Scene {
    let metal = json!({ "name": "metal", "pbrMetallicRoughness": {
        "baseColorFactor": [0.9, 0.9, 0.9, 1.0], "metallicFactor": 1.0, "roughnessFactor": 0.2 } });
    let room = SceneBuilder::new()
        .material("wall", [0.6; 3])
        .room("walls", [0.0; 3], [4.0, 3.0, 4.0])
        .cuboid("table", [2.5, 1.0, 2.5], [3.5, 1.25, 3.5])
        .cuboid("box", [2.9, 0.0, 2.9], [3.1, 0.2, 3.1])
        .material_json(metal)
        .cuboid("block", [0.5, 0.0, 0.5], [1.0, 1.0, 1.0])
        .point_light("bulb", [3.0, 2.5, 3.0], [100.0; 3]);
    evenlight::scene::gltf::load_bytes(Path::new("room.glb"), &room.glb()).expect("a good scene")
}

fn options() -> BakeOptions {
    BakeOptions {
        target_percent: 4.0,
        target_mesh_percent: Some(6.0),
        max_texture: 48,
        seed: 3,
        ..BakeOptions::default()
    }
}

/// All of the maps, and the work that they took.
fn bits(bake: &Bake) -> (Vec<u32>, String) {
    let values = bake.lightmap.pages.iter().flat_map(|p| p.irradiance.iter().chain(&p.half_difference));
    let history = format!("{:?} {:?} {:?}", bake.report.history, bake.report.work, bake.report.audit);
    (values.flatten().map(|v| v.to_bits()).collect(), history)
}

fn cached<'s>(scene: &'s Scene, options: &BakeOptions, cache: &mut Memory) -> Bake<'s> {
    bake_with_cache(scene, options, Some(cache), &mut NoObserver).expect("the bake succeeds")
}

#[test]
fn a_bake_stopped_at_any_moment_ends_as_if_it_never_had_been() {
    let scene = scene();
    let whole = bake(&scene, &options(), &mut NoObserver).expect("the bake succeeds");
    let (work, caustics) = (&whole.report.work, whole.solution.caustic_photons);
    assert!(work.gathered_meshes > 0 && caustics > 0, "the scene has all kinds of light: {work:?}");
    let mut counts = StopAt::call(usize::MAX);
    bake(&scene, &options(), &mut counts).expect("the bake succeeds");
    let calls = counts.calls.into_inner();
    assert!(calls >= 9, "{calls} calls");
    // Stopped once, at each call.
    let mut charts = Memory::new();
    for last in 1..=calls {
        let mut cache = Memory { files: charts.files.clone(), ..Memory::new() };
        cache.files.retain(|name, _| !name.starts_with("light"));
        let stopped = bake_with_cache(&scene, &options(), Some(&mut cache), &mut StopAt::call(last));
        assert!(matches!(stopped, Err(BakeError::Cancelled)), "call {last} of {calls}");
        charts = cache.clone();
        let resumed = cached(&scene, &options(), &mut cache);
        assert!(resumed.solution.kept_rays > 0, "call {last} of {calls}");
        assert!(bits(&resumed) == bits(&whole), "call {last} of {calls}");
    }
    // Stopped again and again, after three pieces of work each time.
    let mut cache = Memory::new();
    let mut stops = 0;
    let end = loop {
        match bake_with_cache(&scene, &options(), Some(&mut cache), &mut StopAt::call(3)) {
            Ok(bake) => break bake,
            Err(BakeError::Cancelled) => stops += 1,
            Err(e) => panic!("{e}"),
        }
        assert!(stops <= calls, "it gets on");
    };
    assert!(stops >= 2 && bits(&end) == bits(&whole), "{stops} stops");
}

/// As after a kill, when what was kept last is older than what was done.
#[test]
fn work_that_was_kept_earlier_leads_to_the_same_end() {
    let scene = scene();
    let mut cache = Memory::new();
    let whole = cached(&scene, &options(), &mut cache);
    for most in [2, 3, 5, 8, cache.kept / 2, cache.kept - 1] {
        let mut old = Memory { most, ..Memory::new() };
        cached(&scene, &options(), &mut old);
        old.found();
        let resumed = cached(&scene, &options(), &mut old);
        assert!(bits(&resumed) == bits(&whole), "{most} times");
        let light: &[&str] = if most > 2 { &["light"] } else { &[] };
        assert_eq!(old.found(), [&["charts", "density"], light].concat(), "{most} times");
    }
}

/// Time runs out in direct samples of a round whose photons were not shot: what those before brought still counts.
#[test]
fn a_resumed_bake_without_time_states_the_error_of_what_is_there() {
    let scene = scene();
    let whole = bake(&scene, &options(), &mut NoObserver).expect("the bake succeeds");
    let mut told = Vec::new();
    for last in 4..=7 {
        let mut cache = Memory::new();
        let stopped = bake_with_cache(&scene, &options(), Some(&mut cache), &mut StopAt::call(last));
        assert!(matches!(stopped, Err(BakeError::Cancelled)), "call {last}");
        let hurried = BakeOptions { time_limit: Some(1e-3), ..options() };
        let late = cached(&scene, &hurried, &mut cache);
        assert_eq!(late.report.limit, Some("time-limit"), "call {last}");
        let error = late.report.texel_error_percent;
        assert!(error > 0.9 * whole.report.texel_error_percent, "call {last}: {error}");
        told.push(error);
        assert!(bits(&cached(&scene, &options(), &mut cache)).0.iter().all(|v| f32::from_bits(*v).is_finite()));
    }
    assert!(told.iter().all(|e| *e < 100.0), "{told:?}");
}

#[test]
fn a_finished_bake_gives_its_maps_again_and_goes_on_to_a_lower_target() {
    let scene = scene();
    let mut cache = Memory::new();
    let coarse = BakeOptions { target_percent: 8.0, target_mesh_percent: Some(1e9), ..options() };
    let first = cached(&scene, &coarse, &mut cache);
    let again = cached(&scene, &coarse, &mut cache);
    assert!(bits(&again) == bits(&first));
    let rays = |bake: &Bake| bake.report.history.last().map_or(0, |h| h.rays);
    assert_eq!(again.solution.kept_rays, rays(&first));
    let fine = cached(&scene, &BakeOptions { target_percent: 3.0, ..coarse.clone() }, &mut cache);
    assert!(fine.report.target_met && fine.report.texel_error_percent < 3.0);
    assert_eq!(fine.solution.kept_rays, rays(&first));
    assert!(fine.report.skips.iter().any(|s| s.contains("rays are those of earlier bakes")), "{:?}", fine.report.skips);
    // Texels are where they were.
    let places = |bake: &Bake| format!("{:?}", bake.atlas.placements);
    assert_eq!(places(&fine), places(&first));
    // From there a higher target is met at once.
    let met = cached(&scene, &coarse, &mut cache);
    assert_eq!((met.solution.kept_rays, met.report.target_met), (rays(&fine), true));
}

#[test]
fn what_changed_is_not_taken_from_before_and_what_did_not_is() {
    let original = scene();
    let mut cache = Memory::new();
    let options =
        BakeOptions { density: Density::Even, target_percent: 10.0, target_mesh_percent: Some(1e9), ..options() };
    cached(&original, &options, &mut cache);
    cached(&original, &options, &mut cache);
    assert_eq!(cache.found(), ["charts", "light"]);
    let mut dimmed = scene();
    let half = LightChange { scale: Some(0.5), ..LightChange::default() };
    dimmed.change(&Changes { lights: vec![("bulb".into(), half)], ..Changes::default() }).expect("there is a bulb");
    let mut paler = scene();
    paler.materials[0].base_color.x = 0.5;
    let mut moved = scene();
    moved.instances[2].world_from_object.translation.x += 0.25;
    let mut wider = scene();
    wider.meshes[1].primitives[0].positions[0].x += 0.25;
    let seed = BakeOptions { seed: 4, ..options.clone() };
    let sky = BakeOptions { sky: Some(evenlight::options::SkySource::Constant(glam::Vec3::ONE)), ..options.clone() };
    let group = BakeOptions { groups: vec![("lamps".into(), "bulb".into())], ..options.clone() };
    let larger = BakeOptions { max_texture: 64, ..options.clone() };
    let cases: [(&str, &Scene, &BakeOptions, &[&str]); 8] = [
        ("a light", &dimmed, &options, &["charts"]),
        ("a colour", &paler, &options, &["charts"]),
        ("a place", &moved, &options, &["charts"]),
        ("a mesh", &wider, &options, &[]),
        ("the seed", &original, &seed, &["charts"]),
        ("the sky", &original, &sky, &["charts"]),
        ("groups", &original, &group, &["charts"]),
        // Meshes of many triangles are cut with a look at how many texels they get.
        ("the page", &original, &larger, &[]),
    ];
    for (what, scene, options, found) in cases {
        let mut cache = Memory { files: cache.files.clone(), ..Memory::new() };
        let kept = cached(scene, options, &mut cache);
        assert_eq!(cache.found(), found, "{what}");
        let plain = bake(scene, options, &mut NoObserver).expect("the bake succeeds");
        assert!(bits(&kept) == bits(&plain), "{what}");
        cached(scene, options, &mut cache);
        assert_eq!(cache.found(), ["charts", "light"], "{what}, again");
    }
    // What says when to stop, and what is written, is none of it.
    for options in [
        BakeOptions { target_percent: 9.0, ..options.clone() },
        BakeOptions { threads: 1, ..options.clone() },
        BakeOptions { quantity: evenlight::options::Quantity::Irradiance, ..options.clone() },
        BakeOptions { time_limit: Some(50.0), ..options.clone() },
    ] {
        cached(&original, &options, &mut cache);
        assert_eq!(cache.found(), ["charts", "light"]);
    }
}

#[test]
fn groups_of_lights_go_on_each_by_itself() {
    let scene = scene();
    let options = BakeOptions {
        groups: vec![("lamps".into(), "bulb".into()), ("day".into(), "sky".into())],
        sky: Some(evenlight::options::SkySource::Constant(glam::Vec3::ONE)),
        target_percent: 10.0,
        target_mesh_percent: Some(1e9),
        ..options()
    };
    let whole = bake(&scene, &options, &mut NoObserver).expect("the bake succeeds");
    let mut cache = Memory::new();
    let mut stops = 0;
    let end = loop {
        match bake_with_cache(&scene, &options, Some(&mut cache), &mut StopAt::call(5)) {
            Ok(bake) => break bake,
            Err(_) => stops += 1,
        }
        assert!(stops < 100, "it gets on");
    };
    let layers = |bake: &Bake| -> Vec<u32> {
        let groups = bake.lightmap.pages.iter().flat_map(|p| &p.groups);
        groups.flat_map(|g| g.irradiance.iter().flatten().map(|v| v.to_bits())).collect()
    };
    assert!(stops > 0 && bits(&end).0 == bits(&whole).0 && layers(&end) == layers(&whole));
}

/// Charts whose hash is right and whose numbers are not, which only intent can make: taken or left, never a panic.
#[test]
fn charts_that_cannot_be_are_left() {
    let scene = Scene::from_gltf(Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/cube.glb")).expect("a scene");
    let quick = BakeOptions { max_texture: 16, target_percent: 50.0, target_mesh_percent: None, ..options() };
    let options = BakeOptions { max_photons: Some(1 << 10), audit: Audits::Off, ..quick };
    let mut good = Memory::new();
    cached(&scene, &options, &mut good);
    let charts = good.files.iter().find(|(name, _)| name.starts_with("charts-")).expect("charts");
    // Those that name the last corner of a quad, or count three.
    for at in (0..charts.1.len()).filter(|&at| charts.1[at] == 3) {
        let mut bytes = charts.1.clone();
        bytes[at] = 0x2a;
        let mut planted = Memory::new();
        planted.files.insert(charts.0.clone(), bytes);
        planted.most = 0;
        let _ = bake_with_cache(&scene, &options, Some(&mut planted), &mut NoObserver);
    }
}

#[test]
fn the_program_keeps_a_cache_and_leaves_out_what_is_damaged() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/cube.glb");
    let run = |out: &str, more: &[&str]| {
        let scene = scene.to_str().expect("a path in UTF-8");
        let mut arguments = vec!["bake", scene, "-o", out, "--max-texture", "64", "--target-percent", "20"];
        arguments.extend(more);
        let said = expect(&evenlight(folder.path(), &arguments), 0);
        let report = read_json(&folder.path().join(out).join("report.json"));
        (said, report, std::fs::read(folder.path().join(out).join("lightmap-0.exr")).expect("a map"))
    };
    let (_, _, plain) = run("plain", &[]);
    let (_, first, map) = run("first", &["--cache", "kept"]);
    assert!(map == plain && first["skips"].to_string().matches("earlier bake").count() == 0);
    let (_, again, map) = run("again", &["--cache", "kept"]);
    assert!(map == plain && again["skips"].to_string().matches("earlier bake").count() == 2, "{}", again["skips"]);
    for entry in std::fs::read_dir(folder.path().join("kept")).expect("a folder") {
        let path = entry.expect("an entry").path();
        let mut bytes = std::fs::read(&path).expect("a file");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 16;
        std::fs::write(&path, bytes).expect("written");
    }
    let (said, damaged, map) = run("damaged", &["--cache", "kept"]);
    assert!(map == plain && said.contains("damaged") && said.contains("charts-"), "{said}");
    assert_eq!(damaged["skips"].to_string().matches("earlier bake").count(), 0);
    // Among the results, out of the way of what a bake removes.
    for bake in 0..2 {
        let (_, report, map) = run("resumed", &["--resume"]);
        assert!(map == plain && report["skips"].to_string().matches("earlier bake").count() == 2 * bake);
    }
    let limited = evenlight(folder.path(), &["bake", "cube.glb", "-o", "x", "--cache", "k", "--cache-limit=-1"]);
    assert!(expect(&limited, 2).contains("--cache-limit -1: must be"));
}
