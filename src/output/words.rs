//! Numbers as a person says them, and text from strangers made safe for HTML.

use crate::accuracy::{Audit, Verdict};
use crate::report::GroupReport;

/// Seconds with their unit, or minutes, or hours.
pub fn seconds(s: f64) -> String {
    match s {
        s if s < 9.95 => format!("{s:.1} s"),
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min {:02.0} s", (s / 60.0).floor(), s % 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

/// A number in three figures.
pub fn figures(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return format!("{x}");
    }
    let decimals = (2.0 - x.abs().log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{x:.decimals$}")
}

/// A count: exact while it is short.
pub fn count(n: u64) -> String {
    match n {
        n if n < 1_000 => format!("{n}"),
        n if n < 1_000_000 => format!("{},{:03}", n / 1_000, n % 1_000),
        n if n < 1_000_000_000 => format!("{} M", figures(n as f64 / 1e6)),
        n => format!("{} G", figures(n as f64 / 1e9)),
    }
}

/// Bytes with their unit.
pub fn bytes(n: u64) -> String {
    match n {
        n if n < 10 << 30 => format!("{} MiB", count(n >> 20)),
        n => format!("{:.1} GiB", n as f64 / f64::from(1 << 30)),
    }
}

/// What an audit found, in a sentence.
pub fn audit(a: &Audit) -> String {
    let texels = count(a.texels as u64);
    let verdict = match a.verdict {
        Verdict::NotResolved => {
            let coarse = figures(a.resolution_percent);
            return format!("path tracing of {texels} texels shows errors from {coarse} % on: --audit N takes more");
        }
        Verdict::Agrees => "path tracing agrees",
        Verdict::Raised => "path tracing finds more than the halves, and is believed",
    };
    let [low, high] = a.error_interval.map(figures);
    format!("{verdict}: {} % ({low} to {high}) in {texels} texels", figures(a.error_percent))
}

/// What is known of the light of a group, in a sentence.
pub fn group(g: &GroupReport) -> String {
    let [low, high] = g.texel_error_interval.map(figures);
    let limit = g.limit.map_or(String::new(), |limit| format!(", NOT met: ended by {limit}"));
    format!(
        "{} % ({low} to {high}), 95 % of the meshes under {} %, mean {} lux{limit}",
        figures(g.texel_error_percent),
        figures(g.mesh_error_percent_95),
        figures(g.mean_irradiance)
    )
}

/// Text for HTML, between tags or in a quoted attribute, cut after `most` characters. Control characters, which no
/// HTML file may hold, become U+FFFD.
pub fn escape(text: &str, most: usize) -> String {
    let mut out = String::with_capacity(text.len().min(most));
    for (i, c) in text.chars().enumerate() {
        if i == most {
            out.push('…');
            break;
        }
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c if c.is_control() && c != '\n' && c != '\t' => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let said = [0.0, 0.01234, 1.8349, 17.25, 999.6, 123456.0].map(figures);
        assert_eq!(said, ["0", "0.0123", "1.83", "17.2", "1000", "123456"]);
        let said = [7, 1_002, 999_999, 1_234_567, 20_000_000_000].map(count);
        assert_eq!(said, ["7", "1,002", "999,999", "1.23 M", "20.0 G"]);
        assert_eq!([300 << 20, 12 << 30].map(bytes), ["300 MiB", "12.0 GiB"]);
    }

    #[test]
    fn nothing_of_a_name_is_markup() {
        assert_eq!(escape("<b a='\"'>&\0", 99), "&lt;b a=&#39;&quot;&#39;&gt;&amp;\u{fffd}");
        assert_eq!(escape("äöü", 2), "äö…");
    }
}
