//! Hypothesis tests with a fixed budget of false alarms.
//!
//! Seeds are fixed, so a test either always passes or always fails; but every change of the sampling code draws
//! anew. With [`ALPHA`] = 1e-6 per test and at most 100 tests the whole suite raises a false alarm once in 10,000
//! such changes: a red test is a bug, and running it again is never an answer.
//!
//! Power is fixed too: [`expect_mean`] is told the deviation that it must be able to see with probability
//! [`POWER`], and fails where the samples are too noisy for that.

/// Probability that one test rejects what is right.
pub const ALPHA: f64 = 1e-6;

/// Probability that a test rejects a deviation of the size it is meant to see.
pub const POWER: f64 = 0.99;

/// Relative deviation that f32 arithmetic may leave in a figure without any noise.
const ROUNDING: f64 = 1e-5;

/// Probability that a standard normal variable exceeds `z`.
pub fn normal_upper_tail(z: f64) -> f64 {
    0.5 * libm::erfc(z * std::f64::consts::FRAC_1_SQRT_2)
}

/// The z that a standard normal variable exceeds with probability `p`, by bisection.
pub fn normal_upper_quantile(p: f64) -> f64 {
    bisect(-38.0, 38.0, |z| normal_upper_tail(z) > p)
}

/// Level of each of `tests` independent tests so that all together have the level `alpha` (Sidak 1967).
pub fn sidak(alpha: f64, tests: usize) -> f64 {
    -libm::expm1(libm::log1p(-alpha) / tests as f64)
}

/// Probability that Student's t with `nu` degrees of freedom exceeds `t` in absolute value.
pub fn student_two_sided(t: f64, nu: f64) -> f64 {
    incomplete_beta(nu / (nu + t * t), 0.5 * nu, 0.5)
}

/// Probabilities that chi-square with `nu` degrees of freedom lies below and above `x`.
pub fn chi_square_tails(x: f64, nu: f64) -> (f64, f64) {
    let (a, x) = (0.5 * nu, 0.5 * x.max(0.0));
    let front = libm::exp(a * libm::log(x.max(1e-300)) - x - libm::lgamma(a));
    if x < a + 1.0 {
        // Series of the lower incomplete gamma function (Abramowitz and Stegun 6.5.29).
        let (mut term, mut sum, mut n) = (1.0 / a, 1.0 / a, a);
        while term > sum * 1e-16 {
            n += 1.0;
            term *= x / n;
            sum += term;
        }
        (front * sum, 1.0 - front * sum)
    } else {
        let upper = front * continued_fraction(|k| (-k * (k - a), x + 2.0 * k + 1.0 - a), x + 1.0 - a);
        (1.0 - upper, upper)
    }
}

/// Regularised incomplete beta function I_x(a, b) (Abramowitz and Stegun 26.5.8).
fn incomplete_beta(x: f64, a: f64, b: f64) -> f64 {
    if x > (a + 1.0) / (a + b + 2.0) {
        return 1.0 - incomplete_beta(1.0 - x, b, a);
    }
    if x <= 0.0 {
        return 0.0;
    }
    let front =
        libm::exp(libm::lgamma(a + b) - libm::lgamma(a) - libm::lgamma(b) + a * libm::log(x) + b * libm::log1p(-x)) / a;
    let term = |k: f64| {
        let m = (k / 2.0).floor();
        let numerator = if k % 2.0 == 0.0 {
            m * (b - m) * x / ((a + k - 1.0) * (a + k))
        } else {
            -(a + m) * (a + b + m) * x / ((a + k - 1.0) * (a + k))
        };
        (numerator, 1.0)
    };
    front * continued_fraction(term, 1.0)
}

/// 1 / (b0 + a1 / (b1 + a2 / (b2 + ...))) with (a_k, b_k) = `term(k)`, by Lentz's method.
fn continued_fraction(term: impl Fn(f64) -> (f64, f64), b0: f64) -> f64 {
    let nonzero = |x: f64| if x.abs() < 1e-300 { 1e-300 } else { x };
    let (mut c, mut d) = (1e300, 1.0 / nonzero(b0));
    let mut value = d;
    for k in 1..10_000 {
        let (a, b) = term(f64::from(k));
        d = 1.0 / nonzero(b + a * d);
        c = nonzero(b + a / c);
        value *= c * d;
        if (c * d - 1.0).abs() < 1e-15 {
            break;
        }
    }
    value
}

/// Where `above` turns from true to false.
fn bisect(mut lo: f64, mut hi: f64, above: impl Fn(f64) -> bool) -> f64 {
    for _ in 0..80 {
        let middle = 0.5 * (lo + hi);
        if above(middle) {
            lo = middle;
        } else {
            hi = middle;
        }
    }
    0.5 * (lo + hi)
}

/// Mean of independent samples, and its standard error.
pub fn mean_and_error(samples: &[f64]) -> (f64, f64) {
    let n = samples.len() as f64;
    let mean = samples.iter().sum::<f64>() / n;
    let square: f64 = samples.iter().map(|x| (x - mean).powi(2)).sum();
    (mean, (square / (n - 1.0) / n).sqrt())
}

/// The normal score of `t` with `nu` degrees of freedom: a standard normal variable if t is Student's.
pub fn normal_score(t: f64, nu: f64) -> f64 {
    normal_upper_quantile(0.5 * student_two_sided(t, nu).max(1e-290)).copysign(t)
}

/// Normal score of the mean of `samples` against `expected` (Student 1908).
pub fn score(samples: &[f64], expected: f64) -> f64 {
    let (mean, error) = mean_and_error(samples);
    let difference = mean - expected;
    if difference.abs() <= ROUNDING * expected.abs() {
        return 0.0;
    }
    normal_score(difference / error, samples.len() as f64 - 1.0)
}

/// Normal score of the difference of two independent means (Welch 1947); `None` where neither has noise.
pub fn welch_score(a: &[f64], b: &[f64]) -> Option<f64> {
    let ((mean_a, error_a), (mean_b, error_b)) = (mean_and_error(a), mean_and_error(b));
    let (va, vb) = (error_a * error_a, error_b * error_b);
    let nu = (va + vb).powi(2) / (va * va / (a.len() as f64 - 1.0) + vb * vb / (b.len() as f64 - 1.0));
    (va + vb > 0.0).then(|| normal_score((mean_a - mean_b) / (va + vb).sqrt(), nu))
}

/// Rejects an `expected` value that the samples' mean contradicts, as one of `tests` such tests.
pub fn mean_test(samples: &[f64], expected: f64, tests: usize) -> Result<(), String> {
    let z = score(samples, expected);
    let limit = normal_upper_quantile(0.5 * sidak(ALPHA, tests));
    let (mean, error) = mean_and_error(samples);
    if z.abs() <= limit {
        return Ok(());
    }
    Err(format!("{mean} +- {error} for {expected} ({:+.3} %): z {z:.2}", 100.0 * (mean / expected - 1.0)))
}

/// The least deviation of the mean that [`mean_test`] sees with probability [`POWER`].
pub fn visible_deviation(samples: &[f64], tests: usize) -> f64 {
    let (_, error) = mean_and_error(samples);
    let nu = samples.len() as f64 - 1.0;
    let t = bisect(0.0, 1e3, |t| student_two_sided(t, nu) > sidak(ALPHA, tests));
    (t + normal_upper_quantile(1.0 - POWER)) * error
}

/// Asserts that the mean of `samples` is `expected`, as one of `tests` comparisons in a test, and that a
/// deviation of the share `visible` of it would be seen.
pub fn expect_mean(what: &str, samples: &[f64], expected: f64, visible: f64, tests: usize) {
    if let Err(e) = mean_test(samples, expected, tests) {
        panic!("{what}: {e}");
    }
    let seen = visible_deviation(samples, tests) / expected.abs();
    assert!(seen <= visible, "{what}: sees only {:.3} %, not {:.3} %", 100.0 * seen, 100.0 * visible);
}

/// Rejects a sum of squares of standard normal variables that is too small or too large.
pub fn chi_square_test(sum: f64, nu: f64) -> Result<(), String> {
    let (lower, upper) = chi_square_tails(sum, nu);
    if lower.min(upper) >= 0.5 * ALPHA { Ok(()) } else { Err(format!("chi-square {sum:.1} for {nu} degrees")) }
}

/// Three tests of independent normal scores, each at [`ALPHA`] / 3: the largest finds a local fault, the mean a
/// global bias, the sum of squares a wrong variance.
pub fn score_tests(z: &[f64]) -> Result<(), String> {
    let n = z.len() as f64;
    let alpha = sidak(ALPHA, 3);
    let (worst, largest) = z.iter().map(|z| z.abs()).enumerate().fold((0, 0.0), |a, b| if b.1 > a.1 { b } else { a });
    if largest > normal_upper_quantile(0.5 * sidak(alpha, z.len())) {
        return Err(format!("score {worst} of {n} is {largest:.2}"));
    }
    let mean = z.iter().sum::<f64>() / n;
    if (mean * n.sqrt()).abs() > normal_upper_quantile(0.5 * alpha) {
        return Err(format!("mean of {n} scores {mean:.3} is {:.2} standard errors off", mean * n.sqrt()));
    }
    let sum: f64 = z.iter().map(|z| z * z).sum();
    let (lower, upper) = chi_square_tails(sum, n);
    if lower.min(upper) < 0.5 * alpha {
        return Err(format!("squares of {n} scores add up to {sum:.1}"));
    }
    Ok(())
}
