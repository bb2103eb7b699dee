//! The command line: thin.

// Until the commands are wired.
#[allow(dead_code)]
mod cli;

fn main() {
    if std::env::args().nth(1).as_deref() == Some(evenlight::atlas::WORKER_COMMAND) {
        std::process::exit(evenlight::atlas::worker_main());
    }
}
