//! The audit by path tracing: right where the truth is known, sharp where an error is planted, silent of honest bakes.

mod common;

use common::rooms::{Builder, cornell, plain, run};
use common::stage::Stage;
use evenlight::accuracy::{Audit, Auditor, Effort, Halves, TexelError, TexelWeights, Verdict};
use evenlight::light::Visibility;
use evenlight::options::Audits;
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
    let stated = TexelError { mean, low: 0.9, high: 1.1, ..TexelError::default() };
    let auditor = Auditor {
        seed: 7,
        light: stage.light(&visibility, &open),
        total: &Halves { odd: map.clone(), even: map },
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
    assert_eq!(rough.verdict, Verdict::AboveTarget, "{rough:?}");
    let [low, high] = rough.error_interval;
    assert!(low < 5.0 && 5.0 < high && high - low < 1.0, "{rough:?}");
    let off = rough.mean_difference_percent;
    assert!(off.abs() < 3.0 * rough.mean_difference_deviation, "{rough:?}");

    // Above the target by five standard errors is above it.
    let just = audit_furnace(Effort::Texels(400), |i| if i % 2 == 0 { 0.024 } else { -0.024 });
    assert_eq!(just.verdict, Verdict::AboveTarget, "{just:?}");

    // 2 % too little everywhere: the halves agree, and nothing but an audit can tell.
    let dark = audit_furnace(Effort::Texels(400), |_| -0.02);
    assert!((dark.mean_difference_percent + 2.0).abs() < 3.0 * dark.mean_difference_deviation, "{dark:?}");
    assert_eq!(dark.verdict, Verdict::Understated, "{dark:?}");
}

#[test]
fn as_many_rays_as_allowed_are_spent() {
    for rays in [300_000, 3_000_000] {
        let audit = audit_furnace(Effort::Rays(rays), |_| 0.0);
        let share = audit.rays as f64 / rays as f64;
        assert!((0.7..1.5).contains(&share), "{audit:?}");
    }
}

/// Bakes whose error is as stated are called understated by chance in one of forty: more than two of twenty come up
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
