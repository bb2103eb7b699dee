//! From the unit square to directions and triangles.

use glam::{Vec2, Vec3};

/// Two unit vectors that make an orthonormal frame with the unit vector `n` (Duff et al., "Building an
/// orthonormal basis, revisited", 2017).
pub fn orthonormal_basis(n: Vec3) -> (Vec3, Vec3) {
    let sign = 1f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    (Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x), Vec3::new(b, sign + n.y * n.y * a, -n.y))
}

/// Direction on the hemisphere about the unit vector `n` with density cos(theta) / pi per solid angle, from a
/// point of the unit square (Shirley and Chiu's concentric map, then Malley's lift). Never exactly grazing.
pub fn cosine_hemisphere(n: Vec3, u: Vec2) -> Vec3 {
    let p = concentric_disk(u);
    let z = (1.0 - p.length_squared()).max(1e-10).sqrt();
    let (t, b) = orthonormal_basis(n);
    (t * p.x + b * p.y + n * z).normalize()
}

/// Direction within `cos_max` of the unit vector `axis`, uniform in solid angle.
pub fn uniform_cone(axis: Vec3, cos_max: f32, u: Vec2) -> Vec3 {
    let p = concentric_disk(u);
    let r2 = p.length_squared();
    // r^2 uniform in [0, 1]; z falls linearly from 1 to cos_max.
    let h = r2 * (1.0 - cos_max);
    let s = (h * (2.0 - h)).max(0.0).sqrt() / r2.sqrt().max(1e-20);
    let (t, b) = orthonormal_basis(axis);
    (t * (p.x * s) + b * (p.y * s) + axis * (1.0 - h)).normalize()
}

/// Barycentric weights of the second and third corner of a point uniform on a triangle (Heitz, "A
/// low-distortion map between triangle and square", 2019).
pub fn uniform_triangle(u: Vec2) -> Vec2 {
    if u.y > u.x {
        let x = u.x * 0.5;
        Vec2::new(x, u.y - x)
    } else {
        let y = u.y * 0.5;
        Vec2::new(u.x - y, y)
    }
}

/// Uniform point on the unit disk (Shirley and Chiu, "A low distortion map between disk and square", 1997).
fn concentric_disk(u: Vec2) -> Vec2 {
    let o = u * 2.0 - Vec2::ONE;
    if o == Vec2::ZERO {
        return Vec2::ZERO;
    }
    const QUARTER: f32 = std::f32::consts::FRAC_PI_4;
    if o.x.abs() > o.y.abs() {
        let (s, c) = sin_cos_octant(QUARTER * (o.y / o.x));
        Vec2::new(c, s) * o.x
    } else {
        let (s, c) = sin_cos_octant(QUARTER * (o.x / o.y));
        Vec2::new(s, c) * o.y
    }
}

/// Sine and cosine of an angle in [-pi/4, pi/4] to 1e-7: Taylor polynomials, enough terms there.
fn sin_cos_octant(x: f32) -> (f32, f32) {
    let q = x * x;
    let s = x * (1.0 + q * (-1.0 / 6.0 + q * (1.0 / 120.0 + q * (-1.0 / 5040.0 + q * (1.0 / 362_880.0)))));
    let c = 1.0 + q * (-0.5 + q * (1.0 / 24.0 + q * (-1.0 / 720.0 + q * (1.0 / 40320.0))));
    (s, c)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_are_sine_and_cosine() {
        for i in -100..=100 {
            let x = i as f32 / 100.0 * std::f32::consts::FRAC_PI_4;
            let (s, c) = sin_cos_octant(x);
            assert!((s - x.sin()).abs() < 2e-7 && (c - x.cos()).abs() < 2e-7, "{x}");
        }
    }

    /// Means of cos and cos^2 under the density cos / pi are 2/3 and 1/2; a regular grid of k x k points
    /// integrates them to about k^-1.5 (1.5e-5 here), since the cosine ends steeply at the rim.
    #[test]
    fn cosine_hemisphere_has_its_moments() {
        let n = Vec3::new(0.3, -0.5, 0.81).normalize();
        let (mut m1, mut m2, k) = (0.0f64, 0.0f64, 1024);
        for i in 0..k {
            for j in 0..k {
                let u = Vec2::new((i as f32 + 0.5) / k as f32, (j as f32 + 0.5) / k as f32);
                let c = cosine_hemisphere(n, u).dot(n) as f64;
                m1 += c;
                m2 += c * c;
            }
        }
        let total = f64::from(k * k);
        assert!((m1 / total - 2.0 / 3.0).abs() < 1e-4 && (m2 / total - 0.5).abs() < 1e-4);
    }

    #[test]
    fn cone_is_uniform_in_height() {
        let axis = Vec3::new(-0.2, 0.9, 0.1).normalize();
        let (cos_max, k) = (0.8f32, 64);
        let mut mean = 0.0;
        for i in 0..k * k {
            let u = Vec2::new(((i % k) as f32 + 0.5) / k as f32, ((i / k) as f32 + 0.5) / k as f32);
            let c = uniform_cone(axis, cos_max, u).dot(axis);
            assert!(c >= cos_max - 1e-5);
            mean += c / (k * k) as f32;
        }
        assert!((mean - 0.9).abs() < 1e-3);
    }

    #[test]
    fn triangle_is_uniform() {
        let (mut m, k) = (Vec2::ZERO, 128);
        for i in 0..k * k {
            let p = uniform_triangle(Vec2::new(((i % k) as f32 + 0.5) / k as f32, ((i / k) as f32 + 0.5) / k as f32));
            assert!(p.min_element() >= 0.0 && p.x + p.y <= 1.0 + 1e-6);
            m += p / (k * k) as f32;
        }
        assert!((m - Vec2::splat(1.0 / 3.0)).length() < 1e-3);
    }
}
