//! Irradiance in closed form, and its mean over a texel.

use evenlight::scene::Scene;
use glam::DVec3;
use std::f64::consts::PI;

/// A parallelogram of [`Builder::quad`](super::rooms::Builder::quad) with its place on the page, from its mesh.
#[derive(Debug, Clone, Copy)]
pub struct QuadMap {
    pub corner: DVec3,
    pub u: DVec3,
    pub v: DVec3,
    /// Unit normal of the front.
    pub normal: DVec3,
    /// First column and row on the page, columns along u and rows along v.
    pub origin: [u32; 2],
    pub texels: [u32; 2],
}

impl QuadMap {
    /// The map of a node that is one quad on a page of `page` texels squared.
    pub fn of(scene: &Scene, instance: usize, page: u32) -> QuadMap {
        let primitive = &scene.meshes[scene.instances[instance].mesh].primitives[0];
        let p: Vec<DVec3> = primitive.positions.iter().map(|p| p.as_dvec3()).collect();
        let at = |k: usize| (primitive.tex_coords[1][k] * page as f32).round().as_uvec2().to_array();
        let (lo, hi) = (at(0), at(2));
        let (u, v) = (p[1] - p[0], p[3] - p[0]);
        QuadMap {
            corner: p[0],
            u,
            v,
            normal: u.cross(v).normalize(),
            origin: lo,
            texels: [hi[0] - lo[0], hi[1] - lo[1]],
        }
    }

    /// World position of the point (s, t) in [0, 1]^2 of the texel in `column` and `row` of the page.
    pub fn point(&self, column: u32, row: u32, s: f64, t: f64) -> DVec3 {
        let x = (f64::from(column - self.origin[0]) + s) / f64::from(self.texels[0]);
        let y = (f64::from(row - self.origin[1]) + t) / f64::from(self.texels[1]);
        self.corner + self.u * x + self.v * y
    }

    /// Mean of `e` over the square at `corner`, `side` wide, of the quad taken as the unit square, by n x n midpoints.
    pub fn mean(&self, corner: [f64; 2], side: f64, n: i32, e: impl Fn(DVec3) -> f64) -> f64 {
        let at = |start: f64, i: i32| start + side * (f64::from(i) + 0.5) / f64::from(n);
        let midpoint = |i: i32| e(self.corner + self.u * at(corner[0], i % n) + self.v * at(corner[1], i / n));
        (0..n * n).map(midpoint).sum::<f64>() / f64::from(n * n)
    }

    /// Mean of `e` over a texel by 4 x 4 points of Gauss and Legendre.
    pub fn texel_mean(&self, column: u32, row: u32, e: impl Fn(DVec3) -> f64) -> f64 {
        let mut sum = 0.0;
        for (s, ws) in GAUSS {
            for (t, wt) in GAUSS {
                sum += 0.25 * ws * wt * e(self.point(column, row, 0.5 + 0.5 * s, 0.5 + 0.5 * t));
            }
        }
        sum
    }
}

/// Points and weights of Gauss and Legendre on [-1, 1].
const GAUSS: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    (-0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
];

/// I cos(theta) / d^2 at `p` with `normal`, of a point light.
pub fn point_irradiance(p: DVec3, normal: DVec3, light: DVec3, candela: f64) -> f64 {
    let to = light - p;
    candela * normal.dot(to).max(0.0) / to.length().powi(3)
}

/// Irradiance of a polygon of radiance `radiance` wholly above the horizon of `p` (Lambert 1760): half the sum
/// over the edges of the angle they span times the cosine between `normal` and the normal of their plane with p.
/// Corners counter-clockwise as seen from its front.
pub fn polygon_irradiance(p: DVec3, normal: DVec3, corners: &[DVec3], radiance: f64) -> f64 {
    let sum: f64 = (0..corners.len())
        .map(|i| {
            let (a, b) = ((corners[i] - p).normalize(), (corners[(i + 1) % corners.len()] - p).normalize());
            let across = b.cross(a);
            across.length().atan2(a.dot(b)) * across.normalize_or_zero().dot(normal)
        })
        .sum();
    0.5 * radiance * sum
}

/// Irradiance of a disc of `radius` at the point `height` over its centre, facing it.
pub fn disc_irradiance(radius: f64, height: f64, radiance: f64) -> f64 {
    PI * radiance * radius * radius / (radius * radius + height * height)
}
