//! Triangles as seen from a point.

use glam::DVec3;

/// A triangle as a point sees it, ready for directions uniform in its solid angle (Arvo, "Stratified sampling of
/// spherical triangles", 1995).
#[derive(Debug, Clone, Copy)]
pub struct SphericalTriangle {
    /// Unit directions of the first two corners; `towards_c` is orthogonal to the first, on the way to the third.
    a: DVec3,
    b: DVec3,
    towards_c: DVec3,
    cos_ab: f64,
    sin_alpha: f64,
    cos_alpha: f64,
    solid_angle: f64,
}

impl SphericalTriangle {
    /// The triangle with `corners` relative to the point; `None` where it is seen edge-on or too small for the
    /// formula.
    pub fn new(corners: [DVec3; 3]) -> Option<SphericalTriangle> {
        let [a, b, c] = corners.map(DVec3::normalize_or_zero);
        let (ab, bc, ca) = (a.cross(b), b.cross(c), c.cross(a));
        if ab.length_squared() < 1e-20 || bc.length_squared() < 1e-20 || ca.length_squared() < 1e-20 {
            return None;
        }
        let (alpha, beta, gamma) = (angle(ab, -ca), angle(bc, -ab), angle(ca, -bc));
        let solid_angle = alpha + beta + gamma - std::f64::consts::PI;
        if solid_angle <= 1e-9 {
            return None;
        }
        let (sin_alpha, cos_alpha) = libm::sincos(alpha);
        let towards_c = orthogonal(c, a)?;
        Some(SphericalTriangle { a, b, towards_c, cos_ab: a.dot(b), sin_alpha, cos_alpha, solid_angle })
    }

    /// Solid angle [sr].
    pub fn solid_angle(&self) -> f64 {
        self.solid_angle
    }

    /// Unit direction at a point `u` of the unit square; `None` where rounding leaves none.
    pub fn direction(&self, u: [f64; 2]) -> Option<DVec3> {
        let SphericalTriangle { a, b, sin_alpha, cos_alpha, .. } = *self;
        let (sin_s, cos_s) = libm::sincos(u[0] * self.solid_angle);
        let sin_phi = cos_s * sin_alpha - sin_s * cos_alpha;
        let cos_phi = -(cos_s * cos_alpha + sin_s * sin_alpha);
        let k1 = cos_phi + cos_alpha;
        let k2 = sin_phi - sin_alpha * self.cos_ab;
        let denominator = (k2 * sin_phi + k1 * cos_phi) * sin_alpha;
        if denominator.abs() < 1e-30 {
            return None;
        }
        let cos_b = ((k2 + (k2 * cos_phi - k1 * sin_phi) * cos_alpha) / denominator).clamp(-1.0, 1.0);
        let c2 = a * cos_b + self.towards_c * (1.0 - cos_b * cos_b).max(0.0).sqrt();
        let z = 1.0 - u[1] * (1.0 - c2.dot(b));
        let direction = b * z + orthogonal(c2, b).unwrap_or(DVec3::ZERO) * (1.0 - z * z).max(0.0).sqrt();
        Some(direction.normalize())
    }
}

fn angle(a: DVec3, b: DVec3) -> f64 {
    libm::atan2(a.cross(b).length(), a.dot(b))
}

fn orthogonal(v: DVec3, to: DVec3) -> Option<DVec3> {
    (v - to * v.dot(to)).try_normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Solid angle [sr] of a triangle seen from the origin (Van Oosterom and Strackee 1983).
    fn solid_angle(corners: [DVec3; 3]) -> f64 {
        let l = corners.map(DVec3::length);
        let numerator = corners[0].dot(corners[1].cross(corners[2])).abs();
        let denominator = l[0] * l[1] * l[2]
            + corners[0].dot(corners[1]) * l[2]
            + corners[1].dot(corners[2]) * l[0]
            + corners[2].dot(corners[0]) * l[1];
        2.0 * libm::atan2(numerator, denominator)
    }

    /// Mean direction over a regular grid equals the mean by quadrature over the flat triangle.
    #[test]
    fn spherical_triangle_is_uniform() {
        let corners = [DVec3::new(-1.0, 0.2, 1.0), DVec3::new(1.5, -0.3, 0.8), DVec3::new(0.3, 1.4, 1.7)];
        let triangle = SphericalTriangle::new(corners).unwrap();
        assert!((triangle.solid_angle() - solid_angle(corners)).abs() < 1e-9);
        let n = 200;
        let mut mean = DVec3::ZERO;
        for i in 0..n * n {
            let u = [f64::from(i % n) + 0.5, f64::from(i / n) + 0.5].map(|x| x / f64::from(n));
            mean += triangle.direction(u).unwrap() / f64::from(n * n);
        }
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
        let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
        let m = 400;
        for i in 0..m {
            for j in 0..m - i {
                for k in 0..if j < m - i - 1 { 2 } else { 1 } {
                    let o = (1 + k) as f64 / 3.0;
                    let (x, y) = ((f64::from(i) + o) / f64::from(m), (f64::from(j) + o) / f64::from(m));
                    let p = corners[0] * (1.0 - x - y) + corners[1] * x + corners[2] * y;
                    let w = normal.dot(p).abs() / p.length().powi(3);
                    sum += p.normalize() * w;
                    weight += w;
                }
            }
        }
        assert!((mean - sum / weight).length() < 1e-4, "{mean} {}", sum / weight);
    }
}
