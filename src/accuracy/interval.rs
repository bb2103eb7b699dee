//! Quantiles, and means with their standard errors.

/// Half the 95 % interval of a normal distribution, in standard deviations.
pub const TWO_SIDED_95: f64 = 1.96;

/// Quantile of the standard normal distribution (Acklam's rational approximation; relative error 1.2e-9).
pub fn normal_quantile(p: f64) -> f64 {
    const A: [f64; 6] = [
        -3.969683028665376e1,
        2.209460984245205e2,
        -2.759285104469687e2,
        1.38357751867269e2,
        -3.066479806614716e1,
        2.506628277459239,
    ];
    const B: [f64; 5] =
        [-5.447609879822406e1, 1.615858368580409e2, -1.556989798598866e2, 6.680131188771972e1, -1.328068155288572e1];
    const C: [f64; 6] = [
        -7.784894002430293e-3,
        -3.223964580411365e-1,
        -2.400758277161838,
        -2.549732539343734,
        4.374664141464968,
        2.938163982698783,
    ];
    const D: [f64; 4] = [7.784695709041462e-3, 3.224671290700398e-1, 2.445134137142996, 3.754408661907416];
    let tail = |q: f64| {
        (((((C[0] * q + C[1]) * q + C[2]) * q + C[3]) * q + C[4]) * q + C[5])
            / ((((D[0] * q + D[1]) * q + D[2]) * q + D[3]) * q + 1.0)
    };
    if p <= 0.0 {
        return f64::NEG_INFINITY;
    }
    if p >= 1.0 {
        return f64::INFINITY;
    }
    if p < 0.02425 {
        tail((-2.0 * libm::log(p)).sqrt())
    } else if p > 1.0 - 0.02425 {
        -tail((-2.0 * libm::log(1.0 - p)).sqrt())
    } else {
        let q = p - 0.5;
        let r = q * q;
        (((((A[0] * r + A[1]) * r + A[2]) * r + A[3]) * r + A[4]) * r + A[5]) * q
            / (((((B[0] * r + B[1]) * r + B[2]) * r + B[3]) * r + B[4]) * r + 1.0)
    }
}

/// Quantile of the chi-square distribution with `nu` degrees of freedom (Wilson and Hilferty 1931; within 1 %
/// for nu >= 5).
pub fn chi_square_quantile(p: f64, nu: f64) -> f64 {
    let a = 2.0 / (9.0 * nu);
    let t = 1.0 - a + normal_quantile(p) * a.sqrt();
    nu * t.max(0.0).powi(3)
}

/// Sums for a mean and its standard error.
#[derive(Debug, Clone, Copy, Default)]
pub struct Moments {
    n: f64,
    sum: f64,
    squares: f64,
}

impl Moments {
    /// One more value.
    pub fn add(&mut self, x: f64) {
        self.n += 1.0;
        self.sum += x;
        self.squares += x * x;
    }

    /// All the values of another.
    pub fn append(&mut self, other: &Moments) {
        self.n += other.n;
        self.sum += other.sum;
        self.squares += other.squares;
    }

    /// Number of values.
    pub fn count(&self) -> f64 {
        self.n
    }

    /// Sum of their squares.
    pub fn squares(&self) -> f64 {
        self.squares
    }

    /// Mean of the values; 0 without any.
    pub fn mean(&self) -> f64 {
        self.sum / self.n.max(1.0)
    }

    /// The root (%) of the mean square, and so many standard errors of that.
    pub fn percent(&self, deviations: f64) -> f64 {
        100.0 * (self.mean() + deviations * self.deviation()).max(0.0).sqrt()
    }

    /// Standard error of the mean.
    pub fn deviation(&self) -> f64 {
        (self.variance() / self.n.max(1.0)).sqrt()
    }

    /// Variance of the values.
    pub fn variance(&self) -> f64 {
        (self.squares - self.sum * self.mean()).max(0.0) / (self.n - 1.0).max(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_agree_with_tables() {
        for (p, z) in [(0.975, 1.959964), (0.5, 0.0), (0.0005, -3.290527), (0.999999, 4.753424)] {
            assert!((normal_quantile(p) - z).abs() < 1e-5, "{p}");
        }
        for (p, nu, x) in [(0.025, 10.0, 3.24697), (0.975, 10.0, 20.4832), (0.025, 1000.0, 914.257)] {
            assert!((chi_square_quantile(p, nu) / x - 1.0).abs() < 0.01, "{p} {nu}");
        }
    }
}
