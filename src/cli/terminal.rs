//! Progress on a terminal, or as lines in a log.

use evenlight::observer::{Progress, Remaining, Stage};
use evenlight::output::words::seconds;
use evenlight::{Observer, Warning};
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Instant;

/// Seconds between lines where stderr is not a terminal.
const LINE_EVERY: f64 = 10.0;

/// Shows progress on stderr; Ctrl-C and SIGTERM cancel.
pub struct Terminal {
    bar: Option<ProgressBar>,
    interrupted: Arc<AtomicBool>,
    last_line: Option<Instant>,
}

impl Terminal {
    /// Takes over Ctrl-C and SIGTERM.
    pub fn new() -> Terminal {
        let interrupted = Arc::new(AtomicBool::new(false));
        let flag = interrupted.clone();
        // Without a handler Ctrl-C still ends the program, only less kindly.
        let _ = ctrlc::set_handler(move || {
            if flag.swap(true, Relaxed) {
                std::process::exit(130);
            }
        });
        // SIGTERM alone besides: a hang-up is for the terminal and nohup to decide.
        #[cfg(unix)]
        let _ = signal_hook::flag::register(signal_hook::consts::SIGTERM, interrupted.clone());
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new_spinner();
            bar.set_style(ProgressStyle::with_template("{spinner} {msg}").expect("a fixed template"));
            bar.enable_steady_tick(std::time::Duration::from_millis(200));
            bar
        });
        Terminal { bar, interrupted, last_line: None }
    }

    /// Removes the bar.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }

    fn say(&self, text: String) {
        match &self.bar {
            Some(bar) => bar.set_message(text),
            None => eprintln!("{text}"),
        }
    }
}

/// `41 s +- 2 s`, or both ends of a wide band.
fn until(r: &Remaining) -> String {
    if r.high <= r.low {
        seconds(r.seconds)
    } else if r.high > 1.5 * r.seconds {
        format!("{} to {}", seconds(r.low), seconds(r.high))
    } else {
        format!("{} +- {}", seconds(r.seconds), seconds(0.5 * (r.high - r.low)))
    }
}

impl Observer for Terminal {
    fn stage(&mut self, stage: Stage) {
        let text = match stage {
            Stage::Unwrap => "unwrapping",
            Stage::Prepare => "preparing texels and rays",
            Stage::Pilot => "looking where texels are needed",
            Stage::Light => "tracing light",
            Stage::Audit => "checking the error by path tracing",
            Stage::Finish => "making maps",
        };
        self.say(text.into());
    }

    fn group(&mut self, name: &str, number: usize, count: usize) {
        self.say(format!("group {name} ({number} of {count})"));
    }

    fn progress(&mut self, p: &Progress) {
        if self.bar.is_none() {
            if self.last_line.is_some_and(|t| t.elapsed().as_secs_f64() < LINE_EVERY) {
                return;
            }
            self.last_line = Some(Instant::now());
        }
        let now = if p.percent.is_finite() { format!("{:.2} % now, ", p.percent) } else { String::new() };
        let left = p.remaining.map_or(String::new(), |r| format!(" in {}", until(&r)));
        self.say(format!(
            "{now}{} %{left} | {:.1} M rays, {:.2} M/s, {} so far",
            p.target,
            p.rays as f64 / 1e6,
            p.rays_per_second / 1e6,
            seconds(p.elapsed),
        ));
    }

    fn warn(&mut self, warning: &Warning) {
        let text = format!("warning: {} [{}]", warning.message, warning.code);
        match &self.bar {
            Some(bar) => bar.println(text),
            None => eprintln!("{text}"),
        }
    }

    fn cancelled(&self) -> bool {
        self.interrupted.load(Relaxed)
    }
}
