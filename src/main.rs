//! The command line: thin.

// Until the commands are wired.
#[allow(dead_code)]
mod cli;

fn main() {}
