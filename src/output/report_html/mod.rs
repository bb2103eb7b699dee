//! The report to look at: one HTML file that needs nothing else, on a phone or a desk, by day or by night.
//!
//! In: a finished bake. Out: what was reached, error against time as the founding paper draws it, where the error
//! lies on the pages, what it is made of and which meshes have most of it. Names come from a stranger's file: all
//! are escaped, and the file forbids itself scripts and the network.

mod graph;
mod maps;

use super::preview::render_backs;
use super::words::{audit, bytes, count, escape, figures, group, seconds};
use super::write_atomically;
use crate::accel::Ray;
use crate::accuracy::{Illuminance, MeshError};
use crate::backs::LitNode;
use crate::bake::Bake;
use crate::error::BakeError;
use crate::report::{GroupReport, Report, Seconds};
use maps::{ERROR_RANGE, Maps, PageMaps, data_uri, density_gradient, error_gradient, maps};
use std::path::Path;

/// Meshes with a line of their own, at most.
const MOST_MESHES: usize = 200;

/// Warnings that are listed, at most.
const MOST_WARNINGS: usize = 100;

/// Pictures of nodes that are lit from behind, at most, and their size (pixels).
const MOST_BACKS: usize = 4;
const BACKS_SIZE: [u32; 2] = [480, 270];

/// Characters of a name and of a sentence, at most.
const NAME: usize = 80;
const SENTENCE: usize = 600;

/// Writes the report of a bake as an HTML file.
///
/// # Errors
/// As [`html`], and [`BakeError::Io`] where the file cannot be written.
pub fn write(path: &Path, bake: &Bake) -> Result<(), BakeError> {
    write_atomically(path, html(bake)?.as_bytes())
}

/// The report of a bake as an HTML file in memory: at most about 4 MB.
///
/// # Errors
/// [`BakeError::Options`] where a page has no texels.
pub fn html(bake: &Bake) -> Result<String, BakeError> {
    let report = &bake.report;
    let maps = maps(bake, report.target_percent / 100.0)?;
    let parts = [
        headline(report),
        history(report),
        groups(report),
        pages(report, &maps),
        split(report),
        meshes(report),
        warnings(report),
        backs(bake)?,
        stages(&report.seconds),
    ];
    Ok(format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; style-src \
         'unsafe-inline'\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <title>{} - evenlight report</title>\n<style>\n{}</style>\n</head>\n<body>\n{}</body>\n</html>\n",
        escape(&report.scene, NAME),
        include_str!("style.css"),
        parts.concat()
    ))
}

/// What was reached, and with what.
fn headline(r: &Report) -> String {
    let reached = format!(
        "{} % (95 %: {} to {})",
        figures(r.texel_error_percent),
        figures(r.texel_error_interval[0]),
        figures(r.texel_error_interval[1])
    );
    let verdict = match r.limit {
        None => format!("<span class=\"good\">target {} % met:</span> {reached}", r.target_percent),
        Some("texels") => format!(
            "<span class=\"bad\">target {} % of what filtering shows not met:</span> {} %; error of the texels {reached}",
            r.target_shown_percent.unwrap_or_default(),
            figures(r.shown_error_percent)
        ),
        Some(limit) => {
            format!("<span class=\"bad\">target {} % not met, ended by {limit}:</span> {reached}", r.target_percent)
        }
    };
    let audit = r.audit.as_ref().map_or(String::new(), |a| format!("<p>{}.</p>\n", audit(a)));
    let w = &r.work;
    let facts = [
        ("time", seconds(r.seconds.total)),
        ("photons", count(w.photons)),
        ("rays", count(w.rays())),
        ("texels", count(r.atlas.texels as u64)),
        ("pages", count(r.atlas.pages as u64)),
        ("triangles", count(r.atlas.triangles as u64)),
        ("mean irradiance", format!("{} lux", figures(r.mean_irradiance))),
        ("memory", r.peak_memory_bytes.map_or("not known".into(), bytes)),
    ];
    let facts: String = facts.iter().map(|(k, v)| format!("<div><dt>{k}</dt><dd>{v}</dd></div>\n")).collect();
    format!(
        "<h1>{}</h1>\n<p class=\"verdict\">{verdict}</p>\n{audit}\
         <p>95 % of the meshes are under {} % (target {} %); {} % of the area meets the target texel by \
         texel.</p>\n\
         <dl>\n{facts}</dl>\n<p class=\"soft\">evenlight {}, seed {}</p>\n",
        escape(&r.scene, NAME),
        figures(r.mesh_error_percent_95),
        figures(r.target_mesh_percent),
        figures(100.0 * r.area_within_target),
        r.evenlight,
        r.seed
    )
}

/// Groups of lights, each relative to its own light.
fn groups(r: &Report) -> String {
    let item = |g: &GroupReport| {
        let lights = escape(&g.lights.join(", "), SENTENCE);
        format!("<li><b>{}</b> (<bdi>{lights}</bdi>): {}</li>\n", escape(&g.name, NAME), group(g))
    };
    if r.groups.is_empty() {
        return String::new();
    }
    let items: String = r.groups.iter().map(item).collect();
    format!(
        "<h2>Light groups</h2>\n<p class=\"soft\">Each is a layer of the maps, which are their sum.</p>\n<ul>\n{items}</ul>\n"
    )
}

/// The graph, and its numbers as a table. Groups have a history each, and there is none of their sum.
fn history(r: &Report) -> String {
    if !r.groups.is_empty() {
        return String::new();
    }
    let Some(graph) = graph::graph(r) else { return String::new() };
    let rows: String = r
        .history
        .iter()
        .zip(&r.seconds.rounds)
        .map(|(h, s)| {
            row(&[
                seconds(s.at),
                figures(h.percent),
                format!("{} to {}", figures(h.low), figures(h.high)),
                graph::foretold(s),
                count(h.photons),
                count(h.rays),
            ])
        })
        .collect();
    let head = head(&["after", "error %", "95 % interval", "forecast", "photons", "rays"]);
    format!(
        "<h2>Error against time</h2>\n{graph}\
         <p class=\"soft\">Dots: error measured after each round, with its 95 % interval; the upper end must meet the \
         target. Ticks on the line of the target: when each round foretold that all targets would be met, \
         and the bands around that.</p>\n\
         <details>\n<summary>as numbers</summary>\n\
         <div class=\"wide\"><table>\n{head}{rows}</table></div>\n</details>\n"
    )
}

/// Maps of the pages with their legends.
fn pages(r: &Report, maps: &Maps) -> String {
    let mut out = String::from("<h2>Pages</h2>\n");
    for (i, page) in maps.pages.iter().enumerate() {
        let each = match page.step {
            1 => String::new(),
            n => format!(" <span class=\"soft\">a pixel is {n} x {n} texels</span>"),
        };
        out += &format!("<h3>Page {i}{each}</h3>\n<div class=\"maps\">\n");
        let target = r.target_percent;
        let scale =
            [format!("{} %", target / ERROR_RANGE), format!("{target} %"), format!("{} %", target * ERROR_RANGE)];
        out += &figure(page, &page.error, "error of the texels, relative to E", Some((&error_gradient(), &scale)));
        let [low, high] = maps.density;
        let scale = [low, (low * high).sqrt(), high].map(figures);
        out += &figure(page, &page.density, "texels per metre", Some((&density_gradient(), &scale)));
        if let Some(cells) = &page.cells {
            let what = "cells of the indirect light, odd half; white: gathered or buried";
            out += &figure(page, cells, what, None);
        }
        out += "</div>\n";
    }
    let left = r.atlas.pages - maps.pages.len();
    if left > 0 {
        out += &format!("<p>{left} more pages are not shown.</p>\n");
    }
    out + "<p class=\"soft\">The error of a texel is half the difference of its halves over the larger of E and 1 % of \
           the mean: a random number with the right spread, not the error itself.</p>\n"
}

/// A picture over a scale with numbers from its first to its last colour.
fn figure(page: &PageMaps, uri: &str, what: &str, scale: Option<(&str, &[String])>) -> String {
    let [width, height] = page.size;
    let scale = scale.map_or(String::new(), |(gradient, numbers)| {
        let numbers: String = numbers.iter().map(|n| format!("<span>{n}</span>")).collect();
        format!("<span class=\"scale\" style=\"background:{gradient}\"></span><span class=\"ends\">{numbers}</span>")
    });
    format!(
        "<figure><img src=\"{uri}\" width=\"{width}\" height=\"{height}\" alt=\"{what}\">\
         <figcaption>{scale}{what}</figcaption></figure>\n"
    )
}

/// What the error is made of.
fn split(r: &Report) -> String {
    let parts = [
        ("noise of direct light", Some(r.split.direct)),
        ("noise of indirect light", Some(r.split.indirect)),
        ("cell bias", Some(r.cell_bias)),
        ("found by the audit alone", r.audit.map(|_| r.unseen_error)),
        ("texel grid", Some(r.texel_grid_error)),
    ];
    let most = parts.iter().filter_map(|p| p.1).fold(1e-9, f64::max);
    let bar = |(what, value): &(&str, Option<f64>)| match value {
        Some(v) => row(&[
            (*what).into(),
            format!("{} %", figures(*v)),
            format!("<span class=\"bar\" style=\"width:{:.1}%\"></span>", 100.0 * v / most),
        ]),
        None => row(&[(*what).into(), "not estimated".into(), String::new()]),
    };
    format!(
        "<h2>What the error is made of</h2>\n<table class=\"bars\">\n{}</table>\n\
         <p class=\"soft\">In percent of the mean irradiance; squares add up. A cell bias under {} % and a grid error \
         under {} % could not be told from none. The texel grid is what bilinear filtering adds between texels: it is no part \
         of the texel error. A filter shows {} % in all.</p>\n",
        parts.iter().map(bar).collect::<String>(),
        figures(r.cell_bias_resolution),
        figures(r.texel_grid_resolution),
        figures(r.shown_error_percent)
    )
}

/// The meshes, worst first.
fn meshes(r: &Report) -> String {
    let mut sorted: Vec<&MeshError> = r.meshes.iter().collect();
    sorted.sort_by(|a, b| b.error_percent.total_cmp(&a.error_percent).then(a.instance.cmp(&b.instance)));
    let met = |m: &MeshError| m.error_percent <= r.target_mesh_percent;
    let (shown, rest) = sorted.split_at(sorted.len().min(MOST_MESHES));
    let rows: String = shown
        .iter()
        .map(|m| {
            row(&[
                format!("<bdi>{}</bdi>", escape(&m.name, NAME)),
                count(m.texels as u64),
                lux(m, |l| Some((l.mean, l.mean_error))),
                lux(m, |l| Some((l.minimum, l.minimum_error))),
                lux(m, |l| Some((l.maximum, l.maximum_error))),
                lux(m, |l| l.uniformity.zip(l.uniformity_error)),
                figures(m.error_percent),
                (if met(m) { "<span class=\"good\">yes</span>" } else { "<span class=\"bad\">no</span>" }).into(),
            ])
        })
        .collect();
    let rest = rest.first().map_or(String::new(), |worst| {
        format!(
            "<p>{} more meshes with {} texels: none above {} %, {} of them met.</p>\n",
            rest.len(),
            count(rest.iter().map(|m| m.texels as u64).sum()),
            figures(worst.error_percent),
            rest.iter().filter(|m| met(m)).count()
        )
    });
    format!(
        "<h2>Meshes</h2>\n<p class=\"soft\">{} of {} meet the target of {} %, each relative to the larger of its own \
         mean and 1 % of the scene's. Worst first. Lux: illuminance with one standard error; least and largest of \
         patches as wide as the measuring grid of EN 12464-1; U<sub>0</sub> is least over mean.</p>\n\
         <div class=\"wide\"><table class=\"meshes\">\n{}{rows}</table></div>\n{rest}",
        r.meshes.iter().filter(|m| met(m)).count(),
        r.meshes.len(),
        figures(r.target_mesh_percent),
        head(&["node", "texels", "mean lux", "least lux", "largest lux", "U<sub>0</sub>", "error %", "met"])
    )
}

/// A figure of a mesh's illuminance with its error.
fn lux(mesh: &MeshError, of: impl Fn(&Illuminance) -> Option<(f64, f64)>) -> String {
    let known = mesh.illuminance.as_ref().and_then(of);
    known.map_or("not known".into(), |(value, error)| format!("{} ± {}", figures(value), figures(error)))
}

/// What is odd, and what was left out.
fn warnings(r: &Report) -> String {
    let mut items: Vec<String> = r
        .warnings
        .iter()
        .take(MOST_WARNINGS)
        .map(|w| format!("{} <span class=\"soft\">[{}]</span>", escape(&w.message, SENTENCE), escape(w.code, NAME)))
        .collect();
    items.extend(r.changed.iter().take(MOST_WARNINGS).map(|s| format!("changed: {}", escape(s, SENTENCE))));
    items.extend(r.skips.iter().take(MOST_WARNINGS).map(|s| format!("skipped: {}", escape(s, SENTENCE))));
    let left = r.warnings.len() + r.changed.len() + r.skips.len() - items.len();
    if left > 0 {
        items.push(format!("{left} more in report.json"));
    }
    let list: String = items.iter().map(|i| format!("<li>{i}</li>\n")).collect();
    let list = if items.is_empty() { "<p>None.</p>\n".into() } else { format!("<ul>\n{list}</ul>\n") };
    format!("<h2>Warnings, changes and skips</h2>\n{list}")
}

/// Where light meets backs.
fn backs(bake: &Bake) -> Result<String, BakeError> {
    if bake.backs.nodes.is_empty() {
        return Ok(String::new());
    }
    let closest = |ray: &Ray| bake.accel.closest(ray);
    let picture = |(i, node): (usize, &LitNode)| {
        let picture = render_backs(&bake.world, &closest, &bake.backs, i, BACKS_SIZE);
        let uri = data_uri(&picture.to_png()?);
        let [width, height] = BACKS_SIZE;
        let name = escape(&bake.world.scene.instances[node.instance].name, NAME);
        Ok(format!(
            "<figure><img src=\"{uri}\" width=\"{width}\" height=\"{height}\" alt=\"lit backs\">\
             <figcaption>{name}</figcaption></figure>\n"
        ))
    };
    let pictures: Vec<String> =
        bake.backs.nodes.iter().enumerate().take(MOST_BACKS).map(picture).collect::<Result<_, BakeError>>()?;
    Ok(format!(
        "<h2>Lit from behind</h2>\n<div class=\"maps\">\n{}</div>\n<p class=\"soft\">Red: backs of one-sided surfaces \
         that light ends on. Grey: fronts. Blue: other backs.</p>\n",
        pictures.concat()
    ))
}

/// Seconds of the stages, and their share.
fn stages(s: &Seconds) -> String {
    let stages = [
        ("lightmap UVs", s.atlas),
        ("pilot", s.pilot),
        ("texels", s.texels),
        ("hierarchy", s.accel),
        ("buried surface", s.open),
        ("direct light", s.direct),
        ("photons", s.photons),
        ("gathering", s.gather),
        ("errors", s.estimate),
        ("audit", s.audit),
        ("maps", s.finish),
        ("all, without writing files", s.total),
    ];
    let line = |(what, spent): &(&str, f64)| {
        let share = if s.total > 0.0 { 100.0 * spent / s.total } else { 0.0 };
        row(&[(*what).into(), format!("{spent:.2}"), format!("{share:.1} %")])
    };
    let rows: String = stages.iter().map(line).collect();
    format!("<h2>Seconds</h2>\n<table>\n{}{rows}</table>\n", head(&["stage", "seconds", "share"]))
}

fn row(cells: &[String]) -> String {
    let cells: String = cells.iter().map(|c| format!("<td>{c}</td>")).collect();
    format!("<tr>{cells}</tr>\n")
}

fn head(cells: &[&str]) -> String {
    let cells: String = cells.iter().map(|c| format!("<th>{c}</th>")).collect();
    format!("<tr>{cells}</tr>\n")
}
