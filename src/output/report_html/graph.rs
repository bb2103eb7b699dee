//! Error against time, as in the founding paper (Voloboy et al., "Analysis of accuracy of global illumination
//! simulation"), with what was foretold: an SVG picture.

use crate::output::words::{figures, seconds};
use crate::report::{HistoryEntry, Report, RoundSeconds};

/// Size in units of the picture, which are pixels on a narrow phone.
const WIDTH: f64 = 360.0;
const HEIGHT: f64 = 270.0;

/// The plot inside it.
const LEFT: f64 = 36.0;
const RIGHT: f64 = 350.0;
const TOP: f64 = 22.0;
const BOTTOM: f64 = 232.0;

/// An axis spans at least this factor, so that it has three numbers.
const LEAST_SPAN: f64 = 10.0;

/// An axis of more than this factor has only powers of ten.
const MOST_SPAN: f64 = 300.0;

/// Room around what is shown, as a factor.
const ROOM: f64 = 1.3;

/// Times foretold are shown up to this many times the time that was taken; those beyond stand at the border.
const MOST_FORECAST: f64 = 10.0;

/// Ends of intervals are shown up to this many times the error, and down to its inverse.
const MOST_INTERVAL: f64 = 4.0;

/// A logarithmic axis.
struct Axis {
    low: f64,
    high: f64,
    /// Places of both ends.
    ends: [f64; 2],
}

impl Axis {
    /// An axis with room for all values.
    fn new(values: impl Iterator<Item = f64> + Clone, ends: [f64; 2]) -> Axis {
        let (mut low, mut high) = (values.clone().fold(f64::INFINITY, f64::min), values.fold(0.0, f64::max));
        let missing = (LEAST_SPAN / (high / low * ROOM * ROOM)).max(1.0).sqrt();
        low /= ROOM * missing;
        high *= ROOM * missing;
        Axis { low, high, ends }
    }

    /// Place of a value; that of the nearer end for what is beyond.
    fn at(&self, value: f64) -> f64 {
        let t = ((value / self.low).ln() / (self.high / self.low).ln()).clamp(0.0, 1.0);
        self.ends[0] + t * (self.ends[1] - self.ends[0])
    }

    /// Round numbers on it.
    fn ticks(&self) -> Vec<f64> {
        let steps: &[u32] = if self.high / self.low > MOST_SPAN { &[1] } else { &[1, 2, 5] };
        let decades = self.low.log10().floor() as i32..=self.high.log10().ceil() as i32;
        // Through text, since powers of ten are not exact.
        let tick = |e: i32, m: &u32| format!("{m}e{e}").parse::<f64>().expect("a number");
        let all = decades.flat_map(|e| steps.iter().map(move |m| tick(e, m)));
        all.filter(|v| (self.low..=self.high).contains(v)).collect()
    }
}

/// The graph; `None` where no round had an error to show.
pub fn graph(report: &Report) -> Option<String> {
    let all = report.history.iter().zip(&report.seconds.rounds);
    let rounds: Vec<(&HistoryEntry, &RoundSeconds)> =
        all.filter(|(h, s)| h.percent > 0.0 && h.percent.is_finite() && s.at > 0.0).collect();
    let (first, last) = (rounds.first()?, rounds.last()?);
    let target = report.target_percent;
    let interval = |h: &HistoryEntry| {
        [h.low.max(h.percent / MOST_INTERVAL), h.percent, h.high.clamp(h.percent, h.percent * MOST_INTERVAL)]
    };
    // What was foretold, with its band.
    let forecast = |s: &RoundSeconds| {
        [s.forecast_low, s.forecast, s.forecast_high].map(|f| f.clamp(s.at, last.1.at * MOST_FORECAST))
    };
    let x = Axis::new(rounds.iter().flat_map(|(_, s)| [s.at, forecast(s)[1]]), [LEFT, RIGHT]);
    let y = Axis::new(rounds.iter().flat_map(|(h, _)| interval(h)).chain([target]), [BOTTOM, TOP]);

    let mut svg = format!(
        "<svg class=\"graph\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"Error against time: {} % after \
         {}, {} % after {}\">\n",
        figures(first.0.percent),
        seconds(first.1.at),
        figures(last.0.percent),
        seconds(last.1.at)
    );
    for v in x.ticks() {
        let at = x.at(v);
        svg += &line("grid", [at, TOP], [at, BOTTOM]);
        svg += &text("middle", [at, BOTTOM + 14.0], &v.to_string());
    }
    for v in y.ticks() {
        let at = y.at(v);
        svg += &line("grid", [LEFT, at], [RIGHT, at]);
        svg += &text("end", [LEFT - 4.0, at + 4.0], &v.to_string());
    }
    svg += &text("start", [4.0, 12.0], "error (% of the mean)");
    svg += &text("middle", [0.5 * (LEFT + RIGHT), HEIGHT - 6.0], "seconds since the bake began");
    let level = y.at(target);
    svg += &line("target", [LEFT, level], [RIGHT, level]);
    // On the right, where the error is under it by then.
    svg += &text("end", [RIGHT, level - 9.0], &format!("target {target} %"));
    for (i, (_, s)) in rounds.iter().enumerate() {
        let [from, at, to] = forecast(s).map(|f| x.at(f));
        let what = format!("said after {}: target met at {}", seconds(s.at), foretold(s));
        let tick = line("forecast", [at, level - 6.0], [at, level + 6.0]);
        // One above the other, the first on top.
        let height = level - 6.0 + 12.0 * (i as f64 + 0.5) / rounds.len() as f64;
        let band = line("band", [from, height], [to, height]);
        svg += &format!("<g>{tick}{band}<title>{what}</title></g>\n");
    }
    let points: Vec<String> = rounds.iter().map(|(h, s)| format!("{:.1},{:.1}", x.at(s.at), y.at(h.percent))).collect();
    svg += &format!("<polyline class=\"error\" points=\"{}\"/>\n", points.join(" "));
    for (h, s) in &rounds {
        let (at, [low, middle, high]) = (x.at(s.at), interval(h).map(|v| y.at(v)));
        let what = format!(
            "after {}: {} % (95 %: {} to {})",
            seconds(s.at),
            figures(h.percent),
            figures(h.low),
            figures(h.high)
        );
        svg += &format!(
            "<g>{}<circle cx=\"{at:.1}\" cy=\"{middle:.1}\" r=\"3\"/><title>{what}</title></g>\n",
            line("interval", [at, low], [at, high])
        );
    }
    svg += "</svg>\n";
    Some(svg)
}

/// When the targets would be met, with the band.
pub fn foretold(s: &RoundSeconds) -> String {
    if s.forecast_high > s.forecast_low {
        format!("{} ({} to {})", seconds(s.forecast), seconds(s.forecast_low), seconds(s.forecast_high))
    } else {
        seconds(s.forecast)
    }
}

fn line(class: &str, a: [f64; 2], b: [f64; 2]) -> String {
    let ([x1, y1], [x2, y2]) = (a, b);
    format!("<line class=\"{class}\" x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"/>\n")
}

fn text(anchor: &str, [x, y]: [f64; 2], what: &str) -> String {
    format!("<text text-anchor=\"{anchor}\" x=\"{x:.1}\" y=\"{y:.1}\">{what}</text>\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_have_round_numbers_and_hold_all_values() {
        let axis = Axis::new([3.1, 3.2].into_iter(), [0.0, 100.0]);
        assert!(axis.ticks().len() >= 3 && axis.at(3.1) > 10.0 && axis.at(3.2) < 90.0);
        assert_eq!(axis.at(1e9), 100.0);
        let axis = Axis::new([0.03, 900.0].into_iter(), [0.0, 100.0]);
        assert_eq!(axis.ticks(), [0.1, 1.0, 10.0, 100.0, 1000.0]);
    }
}
