//! Emissive triangles as a point sees them: their exact irradiance, and directions in proportion to it.

use super::receiver::Receiver;
use super::spherical::SphericalTriangle;
use crate::sampling::{Stream, uniform_triangle};
use glam::{DVec3, Vec2};

/// A triangle's longest edge over its distance up to which directions are drawn from its area.
const FAR: f64 = 0.25;

/// Tries for a direction before the last one is taken as it is: at a chance of at least 1 / 8 each this happens in
/// one of 10^15 samples.
const MAX_TRIES: u32 = 256;

/// A triangle cut by the horizons of two normals has up to this many corners.
const MOST_CORNERS: usize = 5;

/// The part of a triangle above the horizon of a point, relative to that point. A convex polygon.
#[derive(Debug, Clone, Copy)]
pub struct SeenPolygon {
    corners: [DVec3; MOST_CORNERS],
    len: usize,
    /// Unit normal of the receiving surface, and the shading normal where it is another.
    normal: DVec3,
    shading: Option<DVec3>,
    /// Integral of [`Self::cosine`] over the solid angle [sr].
    projected: f64,
}

impl SeenPolygon {
    /// What `at` sees of a triangle with `corners` relative to its origin; `None` where that is nothing.
    pub fn new(corners: [DVec3; 3], at: &Receiver) -> Option<SeenPolygon> {
        let normal = at.geometric_normal.as_dvec3();
        let (corners, len) = clip(&corners, normal);
        let shading = (at.shading_normal != at.geometric_normal).then(|| at.shading_normal.as_dvec3());
        let mut seen = SeenPolygon { corners, len, normal, shading, projected: 0.0 };
        let on_surface = projected_solid_angle(seen.corners(), normal);
        seen.projected = match shading {
            None => on_surface,
            Some(shading) => {
                let (both, len) = clip(seen.corners(), shading);
                0.5 * (on_surface + projected_solid_angle(&both[..len], shading))
            }
        };
        (seen.projected > 0.0).then_some(seen)
    }

    fn corners(&self) -> &[DVec3] {
        &self.corners[..self.len]
    }

    /// Integral of the cosine with the receiver's normal over the solid angle [sr]: irradiance over radiance.
    /// Where the shading normal is another, of the mean of both cosines.
    pub fn projected(&self) -> f64 {
        self.projected
    }

    /// Cosine of the unit direction `w` with the receiver's normal, or the mean of both cosines.
    pub fn cosine(&self, w: DVec3) -> f64 {
        let on_surface = self.normal.dot(w).max(0.0);
        self.shading.map_or(on_surface, |s| 0.5 * (on_surface + s.dot(w).max(0.0)))
    }

    /// `weight` over the density of [`sample`](Self::sample) at `w`, times the cosine there: what the radiance from there is
    /// to be multiplied by.
    pub fn share(&self, w: DVec3, weight: f32) -> f32 {
        weight * (self.projected() / self.cosine(w)) as f32
    }

    /// Unit direction to the polygon with density [`cosine`](Self::cosine) / [`projected`](Self::projected) per
    /// solid angle, by rejection: `u` is the first try, `more` gives all others.
    pub fn sample(&self, u: Vec2, more: &mut Stream) -> Option<DVec3> {
        let (nearest, longest) = self.extent();
        if longest < FAR * nearest {
            Some(self.sample_area(u, more, nearest - longest / f64::sqrt(3.0)))
        } else {
            self.sample_angle(u, more)
        }
    }

    /// Distance of the nearest corner, and length of the longest side or diagonal.
    fn extent(&self) -> (f64, f64) {
        let (mut nearest2, mut longest2) = (f64::INFINITY, 0.0f64);
        for (i, a) in self.corners().iter().enumerate() {
            nearest2 = nearest2.min(a.length_squared());
            longest2 = self.corners[..i].iter().fold(longest2, |l, b| l.max(a.distance_squared(*b)));
        }
        (nearest2.sqrt(), longest2.sqrt())
    }

    /// Points uniform on the area, kept in proportion to cosine / distance^3: the cosine at the emitter is the
    /// distance of its plane over that of the point. No point is nearer than `nearest`.
    fn sample_area(&self, u: Vec2, more: &mut Stream, nearest: f64) -> DVec3 {
        let [a, b, c, d, _] = self.corners;
        let split = if self.len == 4 {
            let (first, second) = ((b - a).cross(c - a).length(), (c - a).cross(d - a).length());
            first / (first + second)
        } else {
            1.0
        };
        // The highest corner is over every point of the polygon; the smallest distance bounds the rest.
        let height = |n: DVec3| self.corners().iter().fold(0.0, |h: f64, p| h.max(n.dot(*p)));
        let bound = match self.shading {
            None => height(self.normal),
            Some(s) => 0.5 * (height(self.normal) + height(s)),
        } / nearest.powi(4);
        let mut u = u;
        for _ in 0..MAX_TRIES {
            let x = f64::from(u.x);
            let (p, q, x) = if x < split { (b, c, x / split) } else { (c, d, (x - split) / (1.0 - split)) };
            let w = uniform_triangle(Vec2::new((x as f32).min(1.0), u.y));
            let point = a + (p - a) * f64::from(w.x) + (q - a) * f64::from(w.y);
            let d2 = point.length_squared();
            let direction = point / d2.sqrt();
            if f64::from(more.unit()) * bound <= self.cosine(direction) / (d2 * d2.sqrt()) {
                return direction;
            }
            u = Vec2::new(more.unit(), more.unit());
        }
        (a + b + c).normalize()
    }

    /// Directions uniform in solid angle, kept in proportion to the cosine.
    fn sample_angle(&self, u: Vec2, more: &mut Stream) -> Option<DVec3> {
        let [a, b, c, d, _] = self.corners;
        let first = SphericalTriangle::new([a, b, c]);
        let second = if self.len == 4 { SphericalTriangle::new([a, c, d]) } else { None };
        let area = |t: &Option<SphericalTriangle>| t.as_ref().map_or(0.0, |t| t.solid_angle());
        let total = area(&first) + area(&second);
        if total <= 0.0 {
            return None;
        }
        let split = area(&first) / total;
        let bound = self.largest_cosine();
        let mut u = u;
        let mut direction = None;
        for _ in 0..MAX_TRIES {
            let x = f64::from(u.x);
            let (triangle, x) =
                if x < split { (&first, x / split) } else { (&second, (x - split) / (1.0 - split).max(1e-300)) };
            let w = triangle.as_ref().or(first.as_ref()).or(second.as_ref())?.direction([x, f64::from(u.y)]);
            direction = w.or(direction);
            if w.is_some_and(|w| f64::from(more.unit()) * bound <= self.cosine(w)) {
                return w;
            }
            u = Vec2::new(more.unit(), more.unit());
        }
        direction
    }

    /// Bound of [`cosine`](Self::cosine) over the polygon, from the cone about it.
    fn largest_cosine(&self) -> f64 {
        let mut units = self.corners;
        units[..self.len].iter_mut().for_each(|p| *p = p.normalize_or_zero());
        let axis = units[..self.len].iter().sum::<DVec3>().normalize_or_zero();
        let cos_radius = units[..self.len].iter().fold(1.0, |c: f64, p| c.min(axis.dot(*p)));
        let largest = |n: DVec3| {
            let c = n.dot(axis);
            if cos_radius <= 0.0 || c >= cos_radius {
                return 1.0;
            }
            let (sin, sin_radius) = ((1.0 - c * c).max(0.0).sqrt(), (1.0 - cos_radius * cos_radius).max(0.0).sqrt());
            (c * cos_radius + sin * sin_radius + 1e-9).clamp(0.0, 1.0)
        };
        match self.shading {
            None => largest(self.normal),
            Some(s) => 0.5 * (largest(self.normal) + largest(s)),
        }
    }
}

/// The part of a triangle or quadrangle where `normal` . p > 0 (Sutherland and Hodgman 1974).
fn clip(corners: &[DVec3], normal: DVec3) -> ([DVec3; MOST_CORNERS], usize) {
    let mut out = ([DVec3::ZERO; MOST_CORNERS], 0);
    let mut push = |p: DVec3| {
        out.0[out.1] = p;
        out.1 += 1;
    };
    for (i, &a) in corners.iter().enumerate() {
        let b = corners[(i + 1) % corners.len()];
        let (ha, hb) = (normal.dot(a), normal.dot(b));
        if ha > 0.0 {
            push(a);
        }
        if (ha > 0.0) != (hb > 0.0) {
            push(a + (b - a) * (ha / (ha - hb)));
        }
    }
    out
}

/// Integral of the cosine with `normal` over the solid angle of a polygon wholly above the horizon [sr]: Lambert's
/// contour sum (Photometria, 1760), half the sum over the edges of their angle times the cosine between `normal`
/// and the edge's plane.
pub fn projected_solid_angle(corners: &[DVec3], normal: DVec3) -> f64 {
    let mut sum = 0.0;
    for (i, &a) in corners.iter().enumerate() {
        let b = corners[(i + 1) % corners.len()];
        let across = a.cross(b);
        let (sin2, cos) = (across.length_squared(), a.dot(b));
        if sin2 > 0.0 {
            let sin = sin2.sqrt();
            sum += libm::atan2(sin, cos) * across.dot(normal) / sin;
        }
    }
    0.5 * sum.abs()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn receiver(geometric_normal: Vec3, shading_normal: Vec3) -> Receiver {
        Receiver { triangle: 0, uv: Vec2::ZERO, origin: Vec3::ZERO, geometric_normal, shading_normal }
    }

    /// Integral over a triangle of `f`(direction) times the solid angle, by midpoints of `m`^2 parts.
    fn quadrature(corners: [DVec3; 3], m: i32, f: impl Fn(DVec3) -> f64) -> f64 {
        let [a, b, c] = corners;
        let normal = (b - a).cross(c - a) * 0.5 / f64::from(m * m);
        let mut sum = 0.0;
        for i in 0..m {
            for j in 0..m - i {
                for k in 0..if j < m - i - 1 { 2 } else { 1 } {
                    let third = f64::from(1 + k) / 3.0;
                    let (x, y) = ((f64::from(i) + third) / f64::from(m), (f64::from(j) + third) / f64::from(m));
                    let p = a + (b - a) * x + (c - a) * y;
                    sum += normal.dot(p).abs() / p.length().powi(3) * f(p.normalize());
                }
            }
        }
        sum
    }

    /// Near and far, above the horizon, cut by one corner or by two, and cut by a second horizon.
    fn cases() -> Vec<([DVec3; 3], Receiver)> {
        let near = [DVec3::new(-1.0, 0.2, 1.0), DVec3::new(1.5, -0.3, 0.8), DVec3::new(0.3, 1.4, 1.7)];
        let far = near.map(|p| p * 0.1 + DVec3::new(1.0, -2.0, 3.0));
        let up = Vec3::Z;
        let tilted = Vec3::new(0.3, 0.9, 0.2).normalize();
        let side = Vec3::new(-1.0, 0.1, 0.1).normalize();
        let mut out = Vec::new();
        for corners in [near, far] {
            for (g, s) in [(up, up), (tilted, tilted), (side, side), (up, tilted), (tilted, up)] {
                out.push((corners, receiver(g, s)));
            }
        }
        out
    }

    fn cosine(at: &Receiver, w: DVec3) -> f64 {
        let (g, s) = (at.geometric_normal.as_dvec3().dot(w), at.shading_normal.as_dvec3().dot(w));
        if g > 0.0 { 0.5 * (g + s.max(0.0)) } else { 0.0 }
    }

    #[test]
    fn contour_sum_is_the_integral() {
        for (corners, at) in cases() {
            let expected = quadrature(corners, 600, |w| cosine(&at, w));
            let found = SeenPolygon::new(corners, &at).map_or(0.0, |p| p.projected());
            assert!((found - expected).abs() <= 2e-4 * expected + 1e-9, "{found} for {expected}: {at:?}");
        }
        // A square seen from straight below its corner (Siegel and Howell, factor from an element to a rectangle).
        let square = [DVec3::Z, DVec3::new(1.0, 0.0, 1.0), DVec3::ONE, DVec3::new(0.0, 1.0, 1.0)];
        let factor = libm::atan(f64::sqrt(0.5)) * f64::sqrt(0.5);
        assert!((projected_solid_angle(&square, DVec3::Z) - factor).abs() < 1e-12);
    }

    /// The mean direction of the samples is that of the density.
    #[test]
    fn samples_have_the_density_of_the_cosine() {
        for (corners, at) in cases() {
            let Some(polygon) = SeenPolygon::new(corners, &at) else { continue };
            let n = 40_000;
            let mut more = Stream::new(1);
            let mut mean = DVec3::ZERO;
            for k in 0..n {
                let u = Vec2::new((k as f32 + 0.5) / n as f32, more.unit());
                mean += polygon.sample(u, &mut more).expect("a direction") / f64::from(n);
            }
            let expected = [DVec3::X, DVec3::Y, DVec3::Z]
                .map(|axis| quadrature(corners, 300, |w| cosine(&at, w) * axis.dot(w)) / polygon.projected());
            // A coordinate scatters by at most 1 / 2: 0.01 is four standard errors of the widest, and seeds are fixed.
            assert!(mean.distance(DVec3::from_array(expected)) < 0.01, "{mean} for {expected:?}: {at:?}");
        }
    }

    /// Far and tiny: area times cosines over distance squared.
    #[test]
    fn far_triangles_keep_their_digits() {
        let corners = [DVec3::new(0.0, 0.0, 1e3), DVec3::new(1e-3, 0.0, 1e3), DVec3::new(0.0, 1e-3, 1e3)];
        let polygon = SeenPolygon::new(corners, &receiver(Vec3::Z, Vec3::Z)).expect("it is seen");
        assert!((polygon.projected() / 5e-13 - 1.0).abs() < 1e-3, "{}", polygon.projected());
    }
}
