//! The audit by path tracing: right where the truth is known, sharp where an error is planted, silent of honest bakes.

mod common;

use common::rooms::{Builder, cornell, plain, run};
use common::stage::Stage;
use evenlight::accuracy::{Audit, Auditor, Effort, Halves, TexelError, TexelWeights, Verdict};
use evenlight::light::Visibility;
use evenlight::options::{Audits, Lights, Smoothing};
use evenlight::{BakeOptions, Scene};
use glam::Vec3;
use std::f64::consts::PI;

const PAGE: u32 = 64;
const ALBEDO: f64 = 0.6;
const RADIANCE: f64 = 10.0;

/// A closed room whose every wall emits the same: E = pi L / (1 - albedo) everywhere.
fn furnace() -> Scene {
    let mut b = Builder::new(PAGE);
    let material = b.diffuse(ALBEDO as f32, RADIANCE as f32);
    b.room(Vec3::ZERO, Vec3::new(2.0, 1.0, 3.0), material, 12);
    b.finish()
}

/// Audits a map of the furnace that is its true irradiance times 1 + `planted(texel)`.
fn audit_furnace(effort: Effort, planted: impl Fn(usize) -> f64) -> Audit {
    let scene = furnace();
    let stage = Stage::new(&scene, PAGE);
    let (texels, visibility) = (&stage.texels, Visibility::new(&stage.world, &stage.accel));
    let open = vec![1.0; texels.mapped];
    let truth = PI * RADIANCE / (1.0 - ALBEDO);
    let map: Vec<Vec3> = (0..texels.mapped).map(|i| Vec3::splat((truth * (1.0 + planted(i))) as f32)).collect();
    let weights = TexelWeights::new(&stage.world, texels, &open);
    let area: f64 = weights.weight.iter().sum();
    let mean = map.iter().zip(&weights.weight).map(|(e, w)| w * f64::from(e.x)).sum::<f64>() / area;
    let stated = TexelError { mean, percent: 1.0, low: 0.9, high: 1.1, ..TexelError::default() };
    let auditor = Auditor {
        seed: 7,
        light: stage.light(&visibility, &open),
        total: &Halves { odd: map.clone(), even: map },
        caustics: None,
        weights: &weights,
        whole: true,
        crevice: 0.0,
    };
    auditor.run(effort, &stated, 2.0, &|| true).expect("nothing stops it")
}

/// Two-sided 95 % intervals at fixed seeds: each holds what it should.
#[test]
fn a_true_map_has_no_error_and_a_planted_error_is_found() {
    let right = audit_furnace(Effort::Texels(400), |_| 0.0);
    assert_eq!((right.verdict, right.error_interval[0]), (Verdict::Agrees, 0.0), "{right:?}");
    assert!(right.mean_difference_percent.abs() < 3.0 * right.mean_difference_deviation, "{right:?}");
    assert!(right.resolution_percent < 1.0 && right.texels == 400, "{right:?}");

    // 5 % too much here, 5 % too little there: the mean is right.
    let rough = audit_furnace(Effort::Texels(400), |i| if i % 2 == 0 { 0.05 } else { -0.05 });
    assert_eq!(rough.verdict, Verdict::Raised, "{rough:?}");
    let [low, high] = rough.error_interval;
    assert!(low < 5.0 && 5.0 < high && high - low < 1.0, "{rough:?}");
    let off = rough.mean_difference_percent;
    assert!(off.abs() < 3.0 * rough.mean_difference_deviation, "{rough:?}");

    // What is stated is raised to it, and what the halves did not show falls as photons get more.
    let stated = TexelError { percent: 1.0, low: 0.9, high: 1.1, mean: 1.0, ..TexelError::default() };
    let unseen = rough.unseen(&stated, 0.0, 1000).expect("more than stated");
    let raised = stated.raised(&unseen);
    for (is, expected) in [(raised.percent, rough.error_percent), (raised.low, low), (raised.high, high)] {
        assert!((is / expected - 1.0).abs() < 1e-9, "{raised:?}");
    }
    let later = stated.with(&unseen, 8000);
    assert!((later.unseen / unseen.square.sqrt() - 8f64.powf(-0.3)).abs() < 1e-9, "{later:?}");
    assert!(later.low < later.percent && later.percent < later.high && later.high < raised.high, "{later:?}");
    assert_eq!(right.unseen(&stated, 0.0, 1000), None);

    // 2 % too little everywhere: the halves agree, and nothing but an audit can tell.
    let dark = audit_furnace(Effort::Texels(400), |_| -0.02);
    assert!((dark.mean_difference_percent + 2.0).abs() < 3.0 * dark.mean_difference_deviation, "{dark:?}");
    assert_eq!(dark.verdict, Verdict::Raised, "{dark:?}");
}

#[test]
fn as_many_rays_as_allowed_are_spent() {
    for rays in [300_000, 3_000_000] {
        let audit = audit_furnace(Effort::Rays(rays), |_| 0.0);
        let share = audit.rays as f64 / rays as f64;
        assert!((0.7..1.5).contains(&share), "{audit:?}");
    }
}

/// The stated error of bakes that are right is raised by chance in one of forty: more than two of twenty come up
/// once in 700.
#[test]
fn honest_bakes_pass() {
    let scene = cornell(PAGE);
    let audits = (0..20).map(|seed| {
        let bake = run(&scene, &BakeOptions { seed, audit: Audits::Texels(300), ..plain(PAGE, 4.0) });
        let audit = bake.report.audit.expect("an audit");
        println!("stated {:.2} %, {audit:?}", bake.report.texel_error_percent);
        audit
    });
    let verdicts: Vec<Verdict> = audits.map(|a| a.verdict).collect();
    assert!(verdicts.iter().filter(|v| **v != Verdict::Agrees).count() <= 2, "{verdicts:?}");
}

#[test]
fn an_audit_that_was_not_made_says_why() {
    let scene = cornell(PAGE);
    let report = run(&scene, &plain(PAGE, 20.0)).report;
    assert!(report.audit.is_none() && report.skips.iter().any(|s| s == "audit: not asked for"), "{:?}", report.skips);

    let mut dark = Builder::new(PAGE);
    let grey = dark.diffuse(0.5, 0.0);
    dark.room(Vec3::ZERO, Vec3::ONE, grey, 4);
    let options = BakeOptions { audit: Audits::Auto, ..plain(PAGE, 20.0) };
    let report = run(&dark.finish(), &options).report;
    assert!(report.audit.is_none() && report.skips.iter().any(|s| s == "audit: the maps are black"));
}

/// A floor of thin slats, lit by what walls reflect: the dark gaps between them, two texels wide, are finer than the cells
/// of so few photons. What those smooth away is stated: path tracing of fixed seeds agrees.
#[test]
fn what_cells_smooth_away_is_stated() {
    let mut b = Builder::new(512);
    let white = b.diffuse(0.7, 0.0);
    b.room(Vec3::ZERO, Vec3::new(2.0, 1.0, 2.0), white, 128);
    for k in 1..32 {
        let x = 0.0625 * k as f32;
        b.solid(Vec3::new(x, 0.0, 0.0), Vec3::new(x + 0.03125, 0.0625, 2.0), white, 2);
    }
    b.point_light(Vec3::new(1.0, 0.8, 1.0), 10.0);
    let scene = b.finish();
    for seed in 0..2 {
        let (lights, smoothing, audit) = (Lights::Indirect, Smoothing::Cells, Audits::Auto);
        let report = run(&scene, &BakeOptions { seed, lights, smoothing, audit, ..plain(512, 12.0) }).report;
        assert!(report.texel_error_percent > 5.0 && report.unseen_error == 0.0, "{report:?}");
        let audit = report.audit.expect("an audit");
        assert_eq!(audit.verdict, Verdict::Agrees, "{audit:?}");
        assert!(audit.resolution_percent < 0.75 * report.texel_error_percent, "{audit:?}");
    }
}
