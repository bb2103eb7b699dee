//! `evenlight plan`, `bake --plan` and `merge`: one bake on several machines.

use super::args::{BakeArgs, Cli, FileArgs, MergeArgs, PlanArgs};
use super::bake::{inputs, load, write};
use super::config::Config;
use super::terminal::Terminal;
use clap::parser::ValueSource;
use clap::{ArgMatches, CommandFactory};
use evenlight::options::Unwrapper;
use evenlight::output::Staging;
use evenlight::output::plan_folder::{PlanFolder, PlanInputs};
use evenlight::output::words::seconds;
use evenlight::solve::{PlanOutlook, Shards};
use evenlight::{BakeError, Observer, Warning};
use std::path::{Path, PathBuf};

/// Flags of `bake` that go with --plan: all others are the plan's.
const WITH_PLAN: [&str; 8] = ["scene", "out", "plan", "shard", "threads", "json", "no_preview", "no_html"];

/// Makes a plan; the exit status.
pub fn plan(args: &PlanArgs, config: Config) -> Result<u8, BakeError> {
    let BakeArgs { out, files, .. } = &args.bake;
    let FileArgs { json, no_preview, no_html } = *files;
    let beside = [
        (no_preview, "--no-preview: give it to `merge`"),
        (no_html, "--no-html: give it to `merge`"),
        (args.bake.cache()?.is_some(), "--cache, --resume: a plan keeps its charts itself"),
        (
            args.bake.time_limit.is_some(),
            "--time-limit: all machines are to find the same; raise --target-percent instead",
        ),
        (args.bake.plan.is_some(), "--plan: give it to `bake`; the folder of a new plan is --out"),
    ];
    if let Some((_, what)) = beside.iter().find(|b| b.0) {
        return Err(BakeError::Options((*what).into()));
    }
    let inputs = inputs(&args.bake, config)?.with_whole_paths()?;
    let scene = load(&inputs)?;
    let mut folder = PlanFolder::create(out)?;
    let mut terminal = Terminal::new();
    let outlook = evenlight::plan(&scene, &inputs.options, args.shards, &mut folder, &mut terminal);
    terminal.finish();
    let outlook = outlook?;
    folder.finish(inputs, outlook.clone())?;
    if json {
        super::print(&(serde_json::to_string_pretty(&outlook).unwrap_or_default() + "\n"))?;
    }
    eprintln!("{}", summary(&outlook, out));
    Ok(0)
}

/// Bakes by a plan, all of it or one shard; the exit status.
pub fn bake(args: &BakeArgs, given: &ArgMatches) -> Result<u8, BakeError> {
    let all = Cli::command();
    let flags =
        all.find_subcommand("bake").into_iter().flat_map(clap::Command::get_arguments).map(|a| a.get_id().as_str());
    for id in flags.filter(|id| !WITH_PLAN.contains(id)) {
        if given.value_source(id) == Some(ValueSource::CommandLine) {
            let flag = id.replace('_', "-");
            return Err(BakeError::Options(format!("--{flag}: is as the plan has it; give it to `plan`")));
        }
    }
    if args.scene.len() > 1 {
        return Err(BakeError::Options("more than one scene: a plan is of one".into()));
    }
    let shard = args.shard()?;
    let Some(plan) = &args.plan else { return Err(BakeError::Options("--plan is missing".into())) };
    let (mut folder, inputs) = open(plan, args.scene.first(), args.threads)?;
    let scene = load(&inputs)?;
    let mut terminal = Terminal::new();
    let options = &inputs.options;
    if let Some(shard) = shard {
        if args.files.json || args.files.no_preview || args.files.no_html {
            return Err(BakeError::Options(
                "--json, --no-preview, --no-html: a shard has none of them; give them to `merge`".into(),
            ));
        }
        PlanFolder::try_shard(&args.out)?;
        let work = evenlight::bake_shard(&scene, options, shard, &mut folder, &mut terminal);
        terminal.finish();
        let work = work.map_err(|e| folder.explain(e))?;
        folder.write_shard(&args.out, shard, &work)?;
        eprintln!("shard {} of {} written to {}", shard.number, shard.count, args.out.display());
        return Ok(0);
    }
    let staging = Staging::new(&args.out)?;
    let bake = evenlight::bake_by_plan(&scene, options, &mut folder, &mut terminal);
    terminal.finish();
    let bake = bake.map_err(|e| folder.explain(e))?;
    write(staging, &args.out, &scene, bake, &inputs, args.files)
}

/// Bakes from shards; the exit status.
pub fn merge(args: &MergeArgs) -> Result<u8, BakeError> {
    let (mut folder, inputs) = open(&args.plan, args.scene.as_ref(), args.threads)?;
    let shards = folder.shards(&args.shards)?;
    let scene = load(&inputs)?;
    let staging = Staging::new(&args.out)?;
    let mut terminal = Terminal::new();
    let mut warnings = Vec::new();
    for path in &shards.twice {
        warnings
            .push(Warning::new("shard-twice", format!("{}: counts once, for another file is of it", path.display())));
    }
    if !shards.are_complete() {
        let (count, missing) = shards.count();
        let named: Vec<String> = shards.missing().take(8).map(|n| n.to_string()).collect();
        let more = if missing as usize > named.len() { ", ..." } else { "" };
        let what = format!("of {count} shards {missing} are missing: {}{more}", named.join(", "));
        warnings.push(Warning::new("shards-missing", what + "; the light is as unbiased, and noisier"));
    }
    warnings.iter().for_each(|w| terminal.warn(w));
    let bake = evenlight::merge(&scene, &inputs.options, &shards, &mut folder, &mut terminal);
    terminal.finish();
    let mut bake = bake.map_err(|e| folder.explain(e))?;
    bake.report.warnings.extend(warnings);
    write(staging, &args.out, &scene, bake, &inputs, args.files)
}

fn open(plan: &Path, scene: Option<&PathBuf>, threads: usize) -> Result<(PlanFolder, PlanInputs), BakeError> {
    let (folder, mut inputs) = PlanFolder::open(plan)?;
    if let Some(scene) = scene {
        inputs.scene.clone_from(scene);
    }
    inputs.options.threads = threads;
    if let Unwrapper::Xatlas { worker } = &mut inputs.options.unwrapper {
        *worker = std::env::current_exe().unwrap_or_default();
    }
    Ok((folder, inputs))
}

/// What a plan foretells, in a few lines.
fn summary(outlook: &[PlanOutlook], folder: &Path) -> String {
    let sum = |of: fn(&PlanOutlook) -> f64| outlook.iter().map(of).sum::<f64>();
    let photons: u64 = outlook.iter().map(|o| o.photons).sum();
    let samples: u64 = outlook.iter().map(|o| o.direct_samples).sum();
    let nets = outlook.iter().map(|o| o.nets).max().unwrap_or_default();
    format!(
        "{:.1} M photons in {nets} nets and {:.1} M direct samples to go: {} here, then {} of merging\nplan written to {}",
        photons as f64 / 1e6,
        samples as f64 / 1e6,
        seconds(sum(|o| o.shard_seconds)),
        seconds(sum(|o| o.merge_seconds)),
        folder.display(),
    )
}
