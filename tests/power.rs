//! Tests of the tests: a planted fault must be found, by the very tests that the suite trusts.

mod common;

use common::agreement::scores;
use common::path_tracer::Fault;
use common::rooms::{Builder, cornell, plain};
use common::runs::{flux, one_round, samples};
use common::statistics::{mean_test, score_tests};
use evenlight::BakeOptions;
use std::f64::consts::PI;

/// Faults in the path tracer are found by the comparison on 200 texels; without one it passes.
#[test]
fn faults_of_the_path_tracer_are_found() {
    let scene = cornell(64);
    let options = BakeOptions { max_photons: Some(1 << 17), ..plain(64, 0.5) };
    score_tests(&scores(&scene, &options, 16, 3000, Fault::None).0).expect("agreement without a fault");
    // A gain of 1 % is a third of a texel's noise, and takes more paths.
    for (fault, paths) in [
        (Fault::Gain, 12_000),
        (Fault::MissingCosine, 3000),
        (Fault::AreaForSolidAngle, 3000),
        (Fault::HalfTwice, 3000),
    ] {
        let (z, _) = scores(&scene, &options, 16, paths, fault);
        println!("{fault:?}: {:?}", score_tests(&z));
        assert!(score_tests(&z).is_err(), "{fault:?} is not found");
    }
}

/// The balance of a closed room finds a gain of 1 % and a half that is counted twice.
#[test]
fn faults_of_the_bake_are_found_in_a_closed_room() {
    let mut b = Builder::new(64);
    let wall = b.diffuse(0.7, 0.0);
    b.room(glam::Vec3::ZERO, glam::Vec3::new(3.0, 2.0, 4.0), wall, 8);
    b.point_light(glam::Vec3::new(1.0, 1.0, 1.0), 10.0);
    let scene = b.finish();
    let [received] = samples(&scene, &one_round(64), 0..64, |bake, e| [flux(bake, e)]);
    let source = 4.0 * PI * 10.0;
    mean_test(&received, source / 0.3, 1).expect("the balance holds");
    let planted = |what: &str, change: &dyn Fn(f64) -> f64| {
        let faulty: Vec<f64> = received.iter().map(|&e| change(e)).collect();
        assert!(mean_test(&faulty, source / 0.3, 1).is_err(), "{what} is not found");
    };
    planted("a gain of 1 %", &|e| e * 1.01);
    planted("a loss of 1 %", &|e| e * 0.99);
    planted("a half counted twice", &|e| e + 0.5 * (e - source));
    planted("direct light only", &|_| source);
}
