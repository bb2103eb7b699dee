//! One bake on several machines: the same bytes, whatever their number.

mod common;

use common::glb::SceneBuilder;
use common::program::{evenlight, expect, read_json, text};
use evenlight::cache::{Cache, Key, Writing};
use evenlight::scene::Scene;
use evenlight::solve::{Shard, ShardWork, Shards};
use evenlight::{Bake, BakeError, BakeOptions, NoObserver, bake_shard, merge, plan};
use serde_json::json;
use std::collections::BTreeMap;
use std::io::{Cursor, Read};
use std::path::Path;

/// A plan in memory, which is not written to once it is made.
#[derive(Debug, Clone, Default)]
struct Plan {
    files: BTreeMap<String, Vec<u8>>,
    made: bool,
}

impl Cache for Plan {
    fn load(&mut self, key: &Key) -> Option<Box<dyn Read>> {
        Some(Box::new(Cursor::new(self.files.get(&key.to_string())?.clone())))
    }

    fn keep(&mut self, key: &Key, writing: &Writing) {
        assert!(!self.made, "{key} of a plan that is made");
        let mut bytes = Vec::new();
        writing(&mut bytes).expect("memory can be written to");
        self.files.insert(key.to_string(), bytes);
    }

    fn is_due(&self) -> bool {
        true
    }
}

/// What shards did, by shard and part of the light.
struct Done {
    shards: Vec<Vec<ShardWork>>,
    complete: bool,
}

impl Shards for Done {
    fn visit(&self, part: usize, take: &mut dyn FnMut(&ShardWork) -> Result<(), BakeError>) -> Result<(), BakeError> {
        self.shards.iter().try_for_each(|shard| take(&shard[part]))
    }

    fn are_complete(&self) -> bool {
        self.complete
    }
}

/// Two rooms without a door, each with a lamp, and a metal block that throws light in one of them.
fn builder() -> SceneBuilder {
    let metal = json!({ "name": "metal", "pbrMetallicRoughness": {
        "baseColorFactor": [0.9, 0.9, 0.9, 1.0], "metallicFactor": 1.0, "roughnessFactor": 0.2 } });
    SceneBuilder::new()
        .material("wall", [0.6; 3])
        .room("first", [0.0; 3], [4.0, 3.0, 4.0])
        .room("second", [6.0, 0.0, 0.0], [9.0, 3.0, 4.0])
        .material_json(metal)
        .cuboid("block", [0.5, 0.0, 0.5], [1.0, 1.0, 1.0])
        .point_light("bulb", [3.0, 2.5, 3.0], [100.0; 3])
        .point_light("candle", [7.0, 1.5, 2.0], [40.0, 30.0, 20.0])
}

fn scene() -> Scene {
    evenlight::scene::gltf::load_bytes(Path::new("rooms.glb"), &builder().glb()).expect("a good scene")
}

fn options() -> BakeOptions {
    BakeOptions { target_percent: 2.0, max_texture: 64, seed: 5, ..BakeOptions::default() }
}

fn planned(scene: &Scene, options: &BakeOptions) -> Plan {
    let mut made = Plan::default();
    let outlook = plan(scene, options, 16, &mut made, &mut NoObserver).expect("a plan");
    assert!(outlook.iter().all(|o| o.nets >= 4), "there is work for all: {outlook:?}");
    made.made = true;
    made
}

fn worked(scene: &Scene, options: &BakeOptions, plan: &Plan, count: u32) -> Vec<Vec<ShardWork>> {
    let shard = |number: u32| {
        // Every machine has as many threads as it has.
        let options = BakeOptions { threads: 1 + number as usize % 3, ..options.clone() };
        bake_shard(scene, &options, Shard { number, count }, &mut plan.clone(), &mut NoObserver).expect("a shard")
    };
    (1..=count).map(shard).collect()
}

fn merged<'s>(scene: &'s Scene, options: &BakeOptions, plan: &Plan, done: &Done) -> Bake<'s> {
    merge(scene, options, done, &mut plan.clone(), &mut NoObserver).expect("the shards fit together")
}

/// All of the maps, and the work that they took.
fn bits(bake: &Bake) -> (Vec<u32>, String) {
    let values = bake.lightmap.pages.iter().flat_map(|p| p.irradiance.iter().chain(&p.half_difference));
    let history = format!("{:?} {:?} {:?}", bake.report.history, bake.report.work, bake.report.audit);
    (values.flatten().map(|v| v.to_bits()).collect(), history)
}

#[test]
fn any_number_of_shards_gives_the_same_bytes() {
    let (scene, options) = (scene(), options());
    let plan = planned(&scene, &options);
    let whole = merged(&scene, &options, &plan, &Done { shards: worked(&scene, &options, &plan, 1), complete: true });
    assert!(whole.solution.caustic_photons > 0, "the scene has caustics");
    assert_eq!(whole.solution.ledger.imbalance(), [0; 3]);
    assert!(whole.report.target_met, "{:?}: {} %", whole.report.limit, whole.report.texel_error_percent);
    for count in [3, 16] {
        let mut shards = worked(&scene, &options, &plan, count);
        // They come in as they end.
        shards.reverse();
        let parts = merged(&scene, &options, &plan, &Done { shards, complete: true });
        assert!(bits(&parts) == bits(&whole), "{count} shards");
    }
}

#[test]
fn groups_of_lights_are_shared_out_as_well() {
    let grouped = BakeOptions { groups: vec![("warm".into(), "candle".into())], ..options() };
    let scene = scene();
    let plan = planned(&scene, &grouped);
    let whole = merged(&scene, &grouped, &plan, &Done { shards: worked(&scene, &grouped, &plan, 1), complete: true });
    assert_eq!(whole.solution.groups.len(), 2);
    let parts = merged(&scene, &grouped, &plan, &Done { shards: worked(&scene, &grouped, &plan, 3), complete: true });
    assert!(bits(&parts) == bits(&whole));
}

/// A lamp beyond the walls lights nothing, alone or as a group of its own.
#[test]
fn light_that_reaches_nothing_is_planned_as_well() {
    let room = SceneBuilder::new().material("wall", [0.6; 3]).room("walls", [0.0; 3], [4.0, 3.0, 4.0]);
    let beyond = |room: SceneBuilder| room.point_light("star", [50.0, 0.0, 0.0], [100.0; 3]);
    let load = |room: SceneBuilder| {
        evenlight::scene::gltf::load_bytes(Path::new("room.glb"), &room.glb()).expect("a good scene")
    };
    let options = BakeOptions { max_texture: 32, ..options() };
    let grouped = BakeOptions { groups: vec![("far".into(), "star".into())], ..options.clone() };
    let lit = room.clone().point_light("bulb", [2.0, 1.5, 2.0], [100.0; 3]);
    for (scene, options) in [(load(beyond(room)), options), (load(beyond(lit)), grouped)] {
        let alone = evenlight::bake(&scene, &options, &mut NoObserver).expect("a bake");
        let mut plan = Plan::default();
        evenlight::plan(&scene, &options, 4, &mut plan, &mut NoObserver).expect("a plan");
        plan.made = true;
        let shards = worked(&scene, &options, &plan, 2);
        let bake = merged(&scene, &options, &plan, &Done { shards, complete: true });
        // So small a plan may foresee too little.
        assert!(
            bake.report.limit == alone.report.limit || bake.report.limit == Some("plan") && alone.solution.photons > 0
        );
        let mean = |bake: &Bake| bake.report.mean_irradiance;
        assert!((mean(&bake) - mean(&alone)).abs() <= 0.02 * mean(&alone), "{} {}", mean(&bake), mean(&alone));
    }
}

/// A shard is photons from everywhere: without it, no place is darker. Were one of four all of a room, that room would
/// lose all of its reflected light.
#[test]
fn a_missing_shard_costs_accuracy_and_no_light() {
    let (scene, options) = (scene(), options());
    let plan = planned(&scene, &options);
    let mut shards = worked(&scene, &options, &plan, 4);
    let means = |done: &Done| -> Vec<(f64, f64)> {
        let bake = merged(&scene, &options, &plan, done);
        let solution = &bake.solution;
        let mut sums = vec![(0.0, 0.0); scene.instances.len()];
        for (i, weight) in solution.weights.weight.iter().enumerate() {
            let of = &mut sums[solution.weights.instance[i] as usize];
            of.0 += weight * f64::from(solution.total.mean(i).element_sum());
            of.1 += weight * f64::from(solution.indirect.mean(i).element_sum());
        }
        assert!(done.complete || bake.report.limit.is_none_or(|limit| limit == "shards"), "{:?}", bake.report.limit);
        sums
    };
    let mut done = Done { shards: std::mem::take(&mut shards), complete: true };
    let all = means(&done);
    done.complete = false;
    for k in 0..4 {
        let left_out = done.shards.remove(k);
        // The block of metal has no map.
        for (i, (less, whole)) in means(&done).iter().zip(&all).enumerate().filter(|(_, (_, whole))| whole.0 > 0.0) {
            // A quarter less photons change means by their noise alone, which is far below that of texels (2 %).
            assert!((less.0 / whole.0 - 1.0).abs() < 0.01, "without shard {k}, node {i}: {less:?} for {whole:?}");
            assert!((less.1 / whole.1 - 1.0).abs() < 0.02, "without shard {k}, node {i}: {less:?} for {whole:?}");
        }
        done.shards.insert(k, left_out);
    }
}

#[test]
fn a_plan_of_something_else_is_refused() {
    let (scene, options) = (scene(), options());
    let plan = planned(&scene, &options);
    let other = BakeOptions { seed: 6, ..options };
    let mut plan = Plan { made: false, ..plan };
    let found = bake_shard(&scene, &other, Shard::WHOLE, &mut plan, &mut NoObserver);
    assert!(matches!(found, Err(BakeError::Plan(_))), "{found:?}");
}

#[test]
fn the_program_plans_bakes_shards_and_merges_them() {
    let temporary = tempfile::tempdir().expect("a folder");
    let folder = temporary.path();
    std::fs::write(folder.join("rooms.glb"), builder().glb()).expect("written");
    let run = |arguments: &str, status: i32| {
        let arguments: Vec<&str> = arguments.split(' ').collect();
        expect(&evenlight(folder, &arguments), status)
    };
    let files = || -> Vec<String> {
        let names = std::fs::read_dir(folder).expect("a folder").flatten().map(|e| e.file_name());
        let mut names: Vec<String> = names.map(|n| n.to_string_lossy().into_owned()).collect();
        names.sort();
        names
    };
    let look = "--target-percent 4 --max-texture 48 --float";
    run(&format!("plan rooms.glb -o p {look} --shards 4"), 0);
    run("bake --plan p -o whole --no-preview --no-html", 0);
    for number in 1..=3 {
        run(&format!("bake --plan p --shard {number}/3 -o s{number} --threads {number}"), 0);
    }
    let merged = |shards: &str, out: &str| format!("merge --plan p {shards} -o {out} --no-preview --no-html");
    run(&merged("s3 s1 s2", "merged"), 0);
    for name in ["lightmap-0.exr", "scene.glb"] {
        let [whole, merged] = ["whole", "merged"].map(|out| std::fs::read(folder.join(out).join(name)).expect("a map"));
        assert!(whole == merged, "{name}");
    }
    assert_eq!(files(), ["merged", "p", "rooms.glb", "s1", "s2", "s3", "whole"]);

    // One twice, and one missing.
    std::fs::copy(folder.join("s1"), folder.join("again")).expect("copied");
    let output = evenlight(folder, &merged("s1 again s3", "two").split(' ').collect::<Vec<_>>());
    let told = text(&output.stderr);
    assert!(matches!(output.status.code(), Some(0 | 3)), "{told}");
    assert!(told.contains("again: counts once") && told.contains("of 3 shards 1 are missing: 2;"), "{told}");
    let report = read_json(&folder.join("two/report.json"));
    let codes: Vec<&str> =
        report["warnings"].as_array().into_iter().flatten().filter_map(|w| w["code"].as_str()).collect();
    assert!(codes.contains(&"shards-missing") && codes.contains(&"shard-twice"), "{codes:?}");

    // What does not fit is named, and nothing is written.
    let mut damaged = std::fs::read(folder.join("s2")).expect("a shard");
    let middle = damaged.len() / 2;
    damaged[middle] ^= 1;
    std::fs::write(folder.join("damaged"), damaged).expect("written");
    run("bake --plan p --shard 1/2 -o half", 0);
    run(&format!("plan rooms.glb -o q {look} --seed 9"), 0);
    run("bake --plan q --shard 1/3 -o stranger", 0);
    let before = files();
    for (command, status, what) in [
        (merged("s1 damaged s3", "none").as_str(), 1, "damaged: is damaged, or no shard of this plan"),
        (&merged("s1 stranger s3", "none"), 1, "stranger: is damaged, or no shard of this plan"),
        (&merged("s1 half", "none"), 1, "half: is one of 2 shards, and s1 one of 3"),
        (&merged("s1 absent", "none"), 1, "absent: cannot be read"),
        ("bake --plan p --shard 4/3 -o none", 2, "--shard 4/3: takes I/N"),
        ("bake --plan p --shard 0/3 -o none", 2, "--shard 0/3: takes I/N"),
        ("bake --plan p -o none --target-percent 1", 2, "--target-percent: is as the plan has it"),
        ("bake --plan absent -o none", 1, "plan.json: cannot be read"),
        ("plan rooms.glb -o whole", 1, "whole: holds something already"),
        ("plan rooms.glb -o p", 1, "p: holds something already"),
        ("plan rooms.glb -o none --time-limit 5", 2, "--time-limit: all machines"),
        ("bake --plan p --shard 1/3 -o absent/s1", 1, "absent/s1"),
        ("bake --plan p --shard 1/3 -o rooms.glb", 1, "rooms.glb: is something else than a shard"),
        ("bake --plan p --shard 1/3 -o none --json", 2, "give them to `merge`"),
        ("bake --plan p --shard 1/4294967295 -o none", 2, "takes I/N"),
        ("plan rooms.glb -o none --plan p", 2, "--plan: give it to `bake`"),
        ("plan rooms.glb -o none --sky absent.hdr", 1, "absent.hdr"),
    ] {
        let told = run(command, status);
        assert!(told.contains(what), "{command}: {told}");
        assert_eq!(files(), before, "{command}");
    }
}
