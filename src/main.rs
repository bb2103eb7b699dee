//! The command line: thin.

fn main() {
    if std::env::args().nth(1).as_deref() == Some(evenlight::atlas::WORKER_COMMAND) {
        std::process::exit(evenlight::atlas::worker_main());
    }
}
