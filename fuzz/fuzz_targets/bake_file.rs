//! Bake files (`--config`): arguments for the command line, or an error that names the file.

#![no_main]
#![allow(dead_code)]

#[path = "../../src/cli/args.rs"]
mod args;
#[path = "../../src/cli/config.rs"]
mod config;

use libfuzzer_sys::fuzz_target;
use std::ffi::OsString;
use std::sync::LazyLock;

static FOLDER: LazyLock<tempfile::TempDir> = LazyLock::new(|| tempfile::tempdir().expect("a temporary folder"));

fuzz_target!(|text: &str| {
    let path = FOLDER.path().join("bake.toml");
    std::fs::write(&path, text).expect("the folder can be written");
    let arguments = ["evenlight", "bake", "--config"].map(OsString::from).into_iter().chain([path.into()]);
    match config::expand(arguments.collect()) {
        Ok((all, config)) => assert!(all.len() >= 4 && config.is_some()),
        Err(e) => assert!(e.to_string().contains("bake.toml"), "{e}"),
    }
});
