//! The program as a child process.

use assert_cmd::Command;
use serde_json::Value;
use std::path::Path;
use std::process::Output;

/// Runs the program in `folder` and waits at most a minute.
pub fn evenlight(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_evenlight"))
        .current_dir(folder)
        .args(arguments)
        .timeout(std::time::Duration::from_secs(60))
        .output()
        .expect("the program starts")
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("output in UTF-8")
}

/// What the program says, where it ends with `status`; all output, where it does not.
#[track_caller]
pub fn expect(output: &Output, status: i32) -> String {
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "stderr: {message}\nstdout: {}", text(&output.stdout));
    message
}

pub fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("the file is there")).expect("valid JSON")
}
