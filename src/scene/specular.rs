//! Light that a surface reflects or refracts in one direction: metals and glass.

use crate::sampling::orthonormal_basis;
use glam::{Vec2, Vec3};

/// Rougher than this [GGX alpha], a lobe has a width; below it is a mirror's.
const SMOOTH: f32 = 1e-3;

/// The specular part of a surface at a point. Shares have alpha applied.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Specular {
    /// Share of the surface that is metal, in [0, 1].
    pub metal: f32,
    /// Reflectance of the metal at normal incidence.
    pub metal_color: Vec3,
    /// Share that is glass, in [0, 1].
    pub glass: f32,
    /// What of the light that enters the glass comes through.
    pub tint: Vec3,
    /// Index of refraction of the glass.
    pub ior: f32,
    /// The glass bounds a solid, which refracts: else it is a thin pane, and light passes straight.
    pub solid: bool,
    /// Absorption in the solid (1/m).
    pub absorption: Vec3,
    /// Width of the lobes: GGX alpha, the square of glTF's roughness.
    pub alpha: f32,
}

/// One way that light leaves a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounce {
    /// Unit direction of travel.
    pub direction: Vec3,
    /// It leaves on the side that it did not come from.
    pub through: bool,
    /// Share per channel of the arriving light, in [0, 1]: in expectation over the random numbers, all that the specular
    /// part sends out.
    pub share: Vec3,
    /// Factor on the radiance that a ray finds that goes against the light: in a medium of index n it is n^2 times that in
    /// air, for refraction narrows its cone (Veach 1997, section 5.2).
    pub narrowing: f32,
}

impl Bounce {
    /// Share per channel of the radiance found beyond that a ray brings back which goes against the light.
    pub fn importance(&self) -> Vec3 {
        self.share * self.narrowing
    }
}

/// Where light arrives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arrival {
    /// Unit direction of travel.
    pub direction: Vec3,
    /// Unit geometric normal of the side that is met.
    pub facing: Vec3,
    /// Unit shading normal of that side.
    pub shading: Vec3,
    /// It is the back: of a solid, the inside.
    pub back: bool,
    /// Free way that it came (m).
    pub way: f32,
}

impl Arrival {
    /// The same on a surface as flat as its triangle: where the shading normal sends light into it.
    fn flat(&self) -> Arrival {
        Arrival { shading: self.facing, ..*self }
    }
}

impl Specular {
    /// One way that light leaves, drawn by three random numbers in [0, 1); `None` where none does.
    ///
    /// The lobe is that of the glTF specification, appendix B: GGX with Smith's height-correlated masking, Schlick's
    /// Fresnel term for metals; glass has the exact one. It is drawn in proportion to the visible normals (Heitz, JCGT
    /// 2018; Dupuy and Benyoub, CGF 2023), and light that a second facet would get is lost, as in that specification.
    pub(super) fn bounce(&self, at: &Arrival, u: [f32; 3]) -> Option<Bounce> {
        let most = self.metal + self.glass;
        let v = -at.direction;
        if most <= 0.0 || at.facing.dot(v) <= 0.0 {
            return None;
        }
        if at.shading.dot(v) <= 0.0 {
            return self.bounce(&at.flat(), u);
        }
        let smooth = self.alpha < SMOOTH;
        let facet = if smooth { at.shading } else { self.visible_facet(at.shading, v, Vec2::new(u[1], u[2])) };
        let cosine = facet.dot(v).clamp(0.0, 1.0);
        let by_metal = || self.metal_color + (Vec3::ONE - self.metal_color) * (1.0 - cosine).powi(5);
        let mut through = false;
        let mut share = if self.solid {
            // One of the ways is taken, by its share.
            let pick = u[0] * most;
            let beyond = if at.back { 1.0 / self.ior } else { self.ior };
            through = pick >= self.metal + self.glass * reflectance(cosine, beyond);
            most * if pick < self.metal {
                by_metal()
            } else if through {
                self.tint
            } else {
                Vec3::ONE
            }
        } else {
            // What passes straight is told by the geometric normal, and both are to be all of it.
            let by_pane = pane_reflectance(at.facing.dot(v).min(1.0), self.ior);
            self.metal * by_metal() + Vec3::splat(self.glass * by_pane)
        };
        // Index before over that beyond.
        let indices = if at.back { self.ior } else { 1.0 / self.ior };
        let (direction, narrowing) = if through {
            (refracted(at.direction, facet, indices)?, indices * indices)
        } else {
            (at.direction + facet * (2.0 * cosine), 1.0)
        };
        let direction = direction.normalize();
        let side = if through { -1.0 } else { 1.0 };
        let leaves = |n: Vec3| side * n.dot(direction) > 0.0;
        if !leaves(at.shading) {
            return None;
        }
        if !leaves(at.facing) {
            return if at.shading == at.facing { None } else { self.bounce(&at.flat(), u) };
        }
        if !smooth {
            let [seen, lit] = [v, direction].map(|w| masking(at.shading.dot(w).abs(), self.alpha));
            share *= (1.0 + seen) / (1.0 + seen + lit);
        }
        if at.back && self.solid && self.absorption != Vec3::ZERO {
            share *= self.absorption.map(|a| libm::expf(-a * at.way));
        }
        Some(Bounce { direction, through, share, narrowing })
    }

    /// A facet of the rough surface as seen from `v`: a unit normal.
    fn visible_facet(&self, n: Vec3, v: Vec3, u: Vec2) -> Vec3 {
        let (t, b) = orthonormal_basis(n);
        let v = Vec3::new(t.dot(v) * self.alpha, b.dot(v) * self.alpha, n.dot(v)).normalize();
        let (sin, cos) = libm::sincosf(std::f32::consts::TAU * u.x);
        let z = (1.0 - u.y) * (1.0 + v.z) - v.z;
        let r = (1.0 - z * z).max(0.0).sqrt();
        let h = Vec3::new(r * cos, r * sin, z) + v;
        let facet = t * (h.x * self.alpha) + b * (h.y * self.alpha) + n * h.z.max(0.0);
        facet.try_normalize().unwrap_or(n)
    }
}

/// Smith's Lambda of GGX for a direction with this cosine to the normal.
fn masking(cosine: f32, alpha: f32) -> f32 {
    let c2 = (cosine * cosine).clamp(1e-12, 1.0);
    0.5 * ((1.0 + alpha * alpha * (1.0 - c2) / c2).sqrt() - 1.0)
}

/// Share of unpolarised light that a dielectric reflects; `eta` is the index beyond over that before.
fn reflectance(cosine: f32, eta: f32) -> f32 {
    let sin2 = (1.0 - cosine * cosine) / (eta * eta);
    if sin2 >= 1.0 {
        return 1.0;
    }
    let beyond = (1.0 - sin2).sqrt();
    let parallel = (eta * cosine - beyond) / (eta * cosine + beyond);
    let perpendicular = (cosine - eta * beyond) / (cosine + eta * beyond);
    let share = 0.5 * (parallel * parallel + perpendicular * perpendicular);
    if share.is_finite() { share } else { 0.0 }
}

/// Share that both faces of a clear thin pane reflect together, all ways to and fro summed up.
pub(super) fn pane_reflectance(cosine: f32, ior: f32) -> f32 {
    let r = reflectance(cosine, ior);
    2.0 * r / (1.0 + r)
}

/// Snell's law: the direction beyond, where `eta` is the index before over that beyond; `None` in total reflection.
fn refracted(d: Vec3, n: Vec3, eta: f32) -> Option<Vec3> {
    let cosine = -n.dot(d);
    let sin2 = eta * eta * (1.0 - cosine * cosine);
    (sin2 < 1.0).then(|| d * eta + n * (eta * cosine - (1.0 - sin2).sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::Stream;
    use glam::DVec3;

    const METAL: Specular = Specular {
        metal: 1.0,
        metal_color: Vec3::new(0.95, 0.6, 0.2),
        glass: 0.0,
        tint: Vec3::ONE,
        ior: 1.5,
        solid: false,
        absorption: Vec3::ZERO,
        alpha: 0.0,
    };

    fn arrival(cosine: f32) -> Arrival {
        let direction = Vec3::new((1.0 - cosine * cosine).sqrt(), 0.0, -cosine);
        Arrival { direction, facing: Vec3::Z, shading: Vec3::Z, back: false, way: 0.0 }
    }

    /// Mean share of `n` bounces.
    fn albedo(s: &Specular, at: &Arrival, n: u32) -> DVec3 {
        let mut stream = Stream::new(7);
        let mut share = |_| s.bounce(at, [(); 3].map(|()| stream.unit())).map_or(Vec3::ZERO, |b| b.share);
        (0..n).map(|k| share(k).as_dvec3()).sum::<DVec3>() / f64::from(n)
    }

    /// The same by quadrature of the glTF specification's microfacet formula over the hemisphere of light.
    fn albedo_by_quadrature(s: &Specular, cosine: f64) -> [f64; 3] {
        let a2 = f64::from(s.alpha).powi(2);
        let v = [(1.0 - cosine * cosine).sqrt(), 0.0, cosine];
        let lambda = |c: f64| 0.5 * ((1.0 + a2 * (1.0 - c * c) / (c * c)).sqrt() - 1.0);
        // Over half vectors, where the integrand is smooth, however narrow the lobe: dl = 4 (v h) dh.
        let (n, m) = (2000, 400);
        let mut sum = [0.0; 3];
        for i in 0..n {
            // Uniform in the cumulative distribution of D cos, so that all of the lobe is looked at.
            let x = (f64::from(i) + 0.5) / f64::from(n);
            let c2 = (1.0 - x) / (x * (a2 - 1.0) + 1.0);
            let (c, sin) = (c2.sqrt(), (1.0 - c2).sqrt());
            for j in 0..m {
                let phi = std::f64::consts::TAU * (f64::from(j) + 0.5) / f64::from(m);
                let h = [sin * phi.cos(), sin * phi.sin(), c];
                let vh = v[0] * h[0] + v[2] * h[2];
                let l = 2.0 * vh * c - cosine;
                if vh <= 0.0 || l <= 0.0 {
                    continue;
                }
                let g = 1.0 / (1.0 + lambda(cosine) + lambda(l));
                // D cos dh is the measure; f l dl = D G F / (4 l v) l 4 (v h) dh.
                let weight = g * vh / (cosine * c) / f64::from(n * m);
                for (k, sum) in sum.iter_mut().enumerate() {
                    let f0 = f64::from(s.metal_color[k]);
                    *sum += weight * (f0 + (1.0 - f0) * (1.0 - vh).powi(5));
                }
            }
        }
        sum
    }

    #[test]
    fn metals_reflect_what_the_microfacet_formula_says() {
        for alpha in [0.01f32, 0.1, 0.36, 1.0] {
            for cosine in [1.0f32, 0.7, 0.2] {
                let metal = Specular { alpha, ..METAL };
                let found = albedo(&metal, &arrival(cosine), 1 << 21);
                let expected = albedo_by_quadrature(&metal, f64::from(cosine));
                for k in 0..3 {
                    // One deviation of the mean is below 3e-4.
                    let off = (found[k] - expected[k]).abs();
                    assert!(off < 1e-3, "alpha {alpha}, cosine {cosine}: {found} for {expected:?}");
                }
            }
        }
    }

    #[test]
    fn mirrors_reflect_as_schlick_says() {
        let b = METAL.bounce(&arrival(0.5), [0.3, 0.1, 0.9]).expect("a mirror reflects");
        assert!(b.direction.distance(Vec3::new(0.75f32.sqrt(), 0.0, 0.5)) < 1e-6 && !b.through);
        assert!((b.share - (METAL.metal_color + (Vec3::ONE - METAL.metal_color) / 32.0)).length() < 1e-6);
    }

    #[test]
    fn dielectrics_follow_fresnel_and_snell() {
        assert!((reflectance(1.0, 1.5) - 0.04).abs() < 1e-6);
        // By Brewster's angle only perpendicular light is reflected: half of ((1 - n^2) / (1 + n^2))^2.
        let brewster = 1.0 / (1.0f32 + 1.5 * 1.5).sqrt();
        let expected = 0.5 * ((1.0f32 - 2.25) / (1.0 + 2.25)).powi(2);
        assert!((reflectance(brewster, 1.5) - expected).abs() < 1e-6);
        // Beyond the critical angle, all.
        assert_eq!(reflectance(0.5, 1.0 / 1.5), 1.0);
        assert!((pane_reflectance(1.0, 1.5) - 0.08 / 1.04).abs() < 1e-6);
        assert!(pane_reflectance(0.3, 1.0) < 1e-9);

        let glass = Specular { metal: 0.0, glass: 1.0, solid: true, ..METAL };
        let at = arrival(0.5);
        let b = glass.bounce(&at, [0.9, 0.0, 0.0]).expect("passes");
        assert!(b.through && (b.direction.x * 1.5 - at.direction.x).abs() < 1e-6 && b.share == Vec3::ONE);
        // And out again, after half a metre.
        let inside = Arrival { direction: b.direction, facing: Vec3::Z, shading: Vec3::Z, back: true, way: 0.5 };
        let tinted = Specular { absorption: Vec3::new(2.0, 0.0, 0.0), ..glass };
        let out = tinted.bounce(&inside, [0.9, 0.0, 0.0]).expect("passes");
        assert!(out.through && out.direction.distance(at.direction) < 1e-6);
        assert!((out.share.x - (-1.0f32).exp()).abs() < 1e-6 && out.share.y == 1.0);
        // Reflected and refracted together, nothing is lost.
        assert!((albedo(&glass, &arrival(0.2), 1 << 12) - DVec3::ONE).length() < 1e-6);
    }
}
