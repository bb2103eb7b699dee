//! The command line: thin.

mod cli;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::run()
}
