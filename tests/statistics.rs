//! The statistical tests against tables, and that they reject and accept as often as they say.

mod common;

use common::random::Random;
use common::statistics::*;

fn near(what: &str, found: f64, expected: f64) {
    assert!((found / expected - 1.0).abs() < 1e-4, "{what}: {found} for {expected}");
}

#[test]
fn quantiles_and_tails_agree_with_tables() {
    for (p, z) in [(0.025, 1.959964), (5e-7, 4.891638), (1e-10, 6.361341)] {
        near("normal quantile", normal_upper_quantile(p), z);
    }
    near("sidak", normal_upper_quantile(0.5 * sidak(1e-6, 4096)), 6.330_644);
    for (t, nu, p) in [(12.7062, 1.0, 0.05), (2.228139, 10.0, 0.05), (3.645959, 30.0, 0.001), (4.5868942, 10.0, 0.001)]
    {
        near("student", student_two_sided(t, nu), p);
    }
    for (x, nu, upper) in [(3.841459, 1.0, 0.05), (18.30704, 10.0, 0.05), (124.3421, 100.0, 0.05)] {
        near("chi-square", chi_square_tails(x, nu).1, upper);
    }
    near("chi-square", chi_square_tails(77.92947, 100.0).0, 0.05);
}

/// Counts of a test at the 5 % point: 20,000 trials of 8 samples each, binomial within five standard errors.
#[test]
fn scores_are_normal() {
    let mut random = Random::new(1);
    let trials = 20_000;
    let mut beyond = 0;
    let mut sum = 0.0;
    for _ in 0..trials {
        let samples: Vec<f64> = (0..8).map(|_| 3.0 + random.normal()).collect();
        let z = score(&samples, 3.0);
        beyond += usize::from(z.abs() > 1.959964);
        sum += z * z;
    }
    let share = beyond as f64 / trials as f64;
    assert!((share - 0.05).abs() < 5.0 * (0.05 * 0.95 / trials as f64).sqrt(), "{share}");
    chi_square_test(sum, trials as f64).expect("squares of scores are chi-square");
}

#[test]
fn each_score_test_finds_its_fault() {
    let mut random = Random::new(2);
    let good: Vec<f64> = (0..400).map(|_| random.normal()).collect();
    score_tests(&good).expect("normal scores pass");
    let mut local = good.clone();
    local[17] = 7.0;
    let biased: Vec<f64> = good.iter().map(|z| z + 0.4).collect();
    let narrow: Vec<f64> = good.iter().map(|z| z * 0.7).collect();
    for (faulty, word) in [(local, "score 17"), (biased, "mean"), (narrow, "squares")] {
        let e = score_tests(&faulty).expect_err("the fault is found");
        assert!(e.contains(word), "{e}");
    }
}
