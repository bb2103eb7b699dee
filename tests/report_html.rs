//! The HTML report: whole, harmless, and about the bake.

mod common;

use common::glb::SceneBuilder;
use evenlight::output::report_html;
use evenlight::{Bake, BakeOptions, NoObserver, Scene, bake};
use std::process::Command;

const EVIL: &str = "</td><script src=\"http://evil\">alert('1')</script> & \u{0}co";

/// A floor under a lamp and a wall, with names that want to be markup.
fn scene() -> tempfile::TempDir {
    let bytes = SceneBuilder::new()
        .material("grey", [0.5; 3])
        .quad(EVIL, [[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]])
        .quad("wall & \"more\"", [[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 2.0, -1.0], [-1.0, 2.0, -1.0]])
        .point_light("lamp", [0.0, 1.0, 0.0], [100.0; 3])
        .glb();
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("a <b> & c.glb"), bytes).expect("a file");
    folder
}

fn options() -> BakeOptions {
    BakeOptions { target_percent: 3.0, max_texture: 64, ..BakeOptions::default() }
}

fn with_bake<T>(of: impl Fn(&mut Bake) -> T) -> T {
    let folder = scene();
    let scene = Scene::from_gltf(folder.path().join("a <b> & c.glb")).expect("a scene");
    of(&mut bake(&scene, &options(), &mut NoObserver).expect("a bake"))
}

/// Names of the tags in order, with the text between them dropped; fails where tags do not nest.
#[track_caller]
fn tags(html: &str) -> Vec<String> {
    let (mut found, mut open) = (Vec::new(), Vec::new());
    let mut rest = html.strip_prefix("<!DOCTYPE html>").expect("a document type");
    while let Some(start) = rest.find('<') {
        assert!(!rest[..start].contains('>'), "a > outside of tags: {}", &rest[..start]);
        rest = &rest[start + 1..];
        // No attribute holds a > or a <.
        let end = rest.find('>').expect("an end of the tag");
        let tag = &rest[..end];
        assert!(!tag.contains('<') && tag.matches('"').count().is_multiple_of(2), "<{tag}>");
        rest = &rest[end + 1..];
        let name = tag.trim_matches('/').split_whitespace().next().expect("a name").to_string();
        if tag.starts_with('/') {
            assert_eq!(open.pop(), Some(name));
        } else {
            if !tag.ends_with('/') && !["meta", "img"].contains(&&*name) {
                open.push(name.clone());
            }
            found.push(name);
        }
    }
    assert_eq!(open, [""; 0], "tags left open");
    found
}

#[test]
fn it_is_well_formed_and_names_are_text() {
    let html = with_bake(|b| report_html::html(b).expect("a report"));
    let tags = tags(&html);
    let count = |name: &str| tags.iter().filter(|t| *t == name).count();
    assert_eq!((count("script"), count("link"), count("svg"), count("img")), (0, 0, 1, 3));
    assert!(!html.contains("<b>") && !html.contains('\0'));
    for name in ["a &lt;b&gt; &amp; c", "&lt;script src=&quot;http://evil&quot;&gt;", "wall &amp; &quot;more&quot;"] {
        assert!(html.contains(name), "{name}");
    }
}

#[test]
fn it_refers_to_nothing_outside() {
    let html = with_bake(|b| report_html::html(b).expect("a report")).replace("http://evil", "");
    for word in ["://", "url(", "@import", "href", "src=\"/"] {
        assert!(!html.contains(word), "{word}");
    }
    assert_eq!(html.matches("src=\"").count(), 3);
    assert_eq!(html.matches("src=\"data:image/png;base64,").count(), 3);
}

#[test]
fn it_says_what_was_reached() {
    with_bake(|bake| {
        let html = report_html::html(bake).expect("a report");
        assert!(html.contains("target 3 % met:"));
        for what in [
            "Error against time",
            "noise of direct light",
            "texel grid",
            "texels per metre",
            "lightmap UVs",
            "U<sub>0</sub>",
            " ± ",
        ] {
            assert!(html.contains(what), "{what}");
        }
        let rounds = bake.report.history.len();
        assert_eq!(html.matches("<circle").count(), rounds);
        assert_eq!(html.matches("class=\"forecast\"").count(), rounds);

        bake.report.audit = None;
        bake.report.limit = Some("time-limit");
        bake.report.history.clear();
        bake.report.warnings.push(evenlight::Warning::new("odd", "a <i> & b"));
        let html = report_html::html(bake).expect("a report");
        tags(&html);
        assert!(html.contains("target 3 % not met, ended by time-limit:"));
        assert!(html.contains("not estimated"), "without an audit");
        assert!(html.contains("<li>a &lt;i&gt; &amp; b"));
        assert!(!html.contains("<svg"));
    });
}

#[test]
fn a_large_scene_gives_no_large_file() {
    with_bake(|bake| {
        bake.lightmap.pages = vec![bake.lightmap.pages[0].clone(); 12];
        bake.report.atlas.pages = 12;
        let mesh = bake.report.meshes[0].clone();
        bake.report.meshes = (0..1000)
            .map(|i| evenlight::accuracy::MeshError { error_percent: f64::from(i) / 100.0, ..mesh.clone() })
            .collect();
        bake.report.meshes[7].name = "n".repeat(1 << 20);
        bake.report.meshes[7].error_percent = 500.0;
        let html = report_html::html(bake).expect("a report");
        tags(&html);
        assert!(html.len() < 4 << 20, "{} bytes", html.len());
        assert!(html.contains("4 more pages are not shown"));
        assert!(html.contains("800 more meshes with"));
        assert!(html.find("nnnn…").is_some_and(|at| html[..at].matches("<bdi>").count() == 1), "worst first");
    });
}

/// Error map of a bake as pixels: every stored texel has a colour, the gutters have another.
#[test]
fn maps_can_be_decoded() {
    use base64::Engine;
    with_bake(|bake| {
        let html = report_html::html(bake).expect("a report");
        let page = &bake.lightmap.pages[0];
        let maps: Vec<image::RgbImage> = html
            .split("data:image/png;base64,")
            .skip(1)
            .map(|rest| {
                let text = &rest[..rest.find('"').expect("an end")];
                let png = base64::engine::general_purpose::STANDARD.decode(text).expect("base64");
                image::load_from_memory(&png).expect("a PNG").to_rgb8()
            })
            .collect();
        for map in &maps {
            assert_eq!(map.dimensions(), (page.width, page.height));
            let empty = map.pixels().zip(&page.area).find(|(_, a)| **a == 0.0).expect("gutters").0;
            assert!(map.pixels().zip(&page.area).all(|(p, a)| (p == empty) == (*a == 0.0)));
        }
    });
}

/// What the program writes: two runs differ in `seconds`, in memory, and in nothing else.
#[test]
fn the_program_writes_it_and_time_stays_apart() {
    let run = |more: &[&str]| {
        let folder = scene();
        let output = Command::new(env!("CARGO_BIN_EXE_evenlight"))
            .current_dir(folder.path())
            .args(["bake", "a <b> & c.glb", "-o", "out", "--target-percent", "3", "--max-texture", "64"])
            .args(more)
            .output()
            .expect("the program starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let html = std::fs::read_to_string(folder.path().join("out/report.html")).ok();
        let json = std::fs::read(folder.path().join("out/report.json")).expect("a report");
        (html, serde_json::from_slice::<serde_json::Value>(&json).expect("JSON"))
    };
    let [(a, mut left), (b, mut right)] = [run(&[]), run(&["--threads", "1"])];
    tags(&a.expect("report.html"));
    assert!(b.is_some());
    let rounds = left["seconds"]["rounds"].as_array().expect("seconds of the rounds");
    assert_eq!(rounds.len(), left["history"].as_array().map_or(0, Vec::len));
    let total = left["seconds"]["total"].as_f64().expect("a number");
    for round in rounds {
        let (at, forecast) = (round["at"].as_f64(), round["forecast"].as_f64());
        assert!(at > Some(0.0) && at <= Some(total) && forecast >= at, "{round}");
    }
    for report in [&mut left, &mut right] {
        let report = report.as_object_mut().expect("an object");
        assert!(report.remove("seconds").is_some() && report.remove("peak_memory_bytes").is_some());
    }
    assert_eq!(left, right);
    assert!(run(&["--no-html"]).0.is_none());
}
