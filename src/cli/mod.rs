//! The command line: arguments in, exit status out. Progress and messages go to stderr.
//!
//! Exit status: 0 targets met; 1 failed; 2 wrong usage; 3 baked and written, but a target was not met.

#![allow(clippy::print_stdout, clippy::print_stderr)]

mod args;
mod bake;
mod config;
mod farm;
pub mod inspect;
mod terminal;

use clap::{CommandFactory, FromArgMatches};
use evenlight::scene::gltf::LoadOptions;
use evenlight::{BakeError, Scene};
use std::io::Write;
use std::process::ExitCode;

/// Baked and written, but a target was not met.
pub const TARGET_MISSED: u8 = 3;

/// Parses the arguments and runs the command.
pub fn run() -> ExitCode {
    let (arguments, config) = match config::expand(std::env::args_os().collect()) {
        Ok(found) => found,
        Err(error) => return failed(&error),
    };
    let matches = args::Cli::command().get_matches_from(arguments);
    let command = match args::Cli::from_arg_matches(&matches) {
        Ok(cli) => cli.command,
        Err(error) => error.exit(),
    };
    evenlight::atlas::silence_unwrapper_panics();
    let result = match command {
        args::Command::Bake(args) if args.plan.is_some() => {
            farm::bake(&args, matches.subcommand_matches("bake").unwrap_or(&matches))
        }
        args::Command::Bake(args) => bake::run(&args, config.unwrap_or_default()),
        args::Command::Plan(args) => farm::plan(&args, config.unwrap_or_default()),
        args::Command::Merge(args) => farm::merge(&args),
        args::Command::Inspect { scene, variant, json } => inspect_scene(&scene, variant, json),
        args::Command::UnwrapWorker => return ExitCode::from(evenlight::atlas::worker_main() as u8),
        args::Command::Check { .. } => not_built("check"),
        args::Command::View { .. } => not_built("view"),
        args::Command::Selftest => not_built("selftest"),
    };
    match result {
        Ok(status) => ExitCode::from(status),
        Err(error) => failed(&error),
    }
}

fn failed(error: &BakeError) -> ExitCode {
    eprintln!("error: {error}");
    ExitCode::from(if matches!(error, BakeError::Options(_)) { 2 } else { 1 })
}

fn not_built(what: &str) -> Result<u8, BakeError> {
    Err(BakeError::Options(format!("`{what}` is not built yet in evenlight {}", env!("CARGO_PKG_VERSION"))))
}

fn inspect_scene(path: &std::path::Path, variant: Option<String>, json: bool) -> Result<u8, BakeError> {
    let scene = Scene::from_gltf_with(path, &LoadOptions { variant })?;
    let inspection = inspect::inspect(&scene);
    let text =
        if json { serde_json::to_string_pretty(&inspection).unwrap_or_default() + "\n" } else { inspection.text() };
    print(&text).map(|()| 0)
}

/// Writes `text` to stdout. A reader that has seen enough and closed its end is no fault.
fn print(text: &str) -> Result<(), BakeError> {
    match std::io::stdout().write_all(text.as_bytes()) {
        Err(source) if source.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(BakeError::Io { path: "standard output".into(), source })
        }
        _ => Ok(()),
    }
}
