//! A path tracer of the tests' own: irradiance at a point with all reflections, without texels, photons, the
//! library's ray tracing or its sampling. Brute force over all triangles in f64, for scenes of a few dozen.
//!
//! E(x) = E_direct(x) + rho(y) E(y) for a y seen from x in a cosine-distributed direction, and so on from y.

use super::random::Random;
use evenlight::scene::{Alpha, LightKind, Scene, Sky};
use glam::DVec3;
use std::f64::consts::PI;

/// A fault planted into the estimate, for the tests of the tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// None.
    None,
    /// 1 % too much of everything.
    Gain,
    /// Directions of reflection uniform over the hemisphere, as if they were cosine-distributed.
    MissingCosine,
    /// Points on lamps chosen by area, taken as if chosen by solid angle: the cosine at the lamp is left out.
    AreaForSolidAngle,
    /// The first reflection counted one and a half times, as when a half is added instead of averaged.
    HalfTwice,
}

struct Triangle {
    corner: DVec3,
    edges: [DVec3; 2],
    normal: DVec3,
    area: f64,
    albedo: DVec3,
    /// Share of light per channel that leaves diffusely on the far side.
    transmitted: DVec3,
    emission: DVec3,
    double_sided: bool,
    /// Share of light per channel that passes straight through.
    passed: DVec3,
}

/// A scene ready to trace.
pub struct PathTracer<'s> {
    scene: &'s Scene,
    triangles: Vec<Triangle>,
    /// Emissive triangles and the sum of their areas up to and including each.
    lamps: Vec<(usize, f64)>,
    fault: Fault,
}

/// Smallest distance along a ray [m]: nothing in the scenes is nearer, and rounding in f64 is far below.
const NEAR: f64 = 1e-7;

impl<'s> PathTracer<'s> {
    /// Opaque, unmasked and blended materials without textures; instances without a transform.
    pub fn new(scene: &'s Scene, fault: Fault) -> PathTracer<'s> {
        let mut triangles = Vec::new();
        for instance in &scene.instances {
            for primitive in &scene.meshes[instance.mesh].primitives {
                let m = &scene.materials[primitive.material];
                let alpha = if m.alpha == Alpha::Blend { f64::from(m.base_color.w) } else { 1.0 };
                let base = m.base_color.truncate().as_dvec3();
                let transmission = f64::from(m.transmission);
                let far = f64::from(m.diffuse_transmission);
                let diffuse = (1.0 - transmission) * alpha;
                for t in &primitive.triangles {
                    let [a, b, c] = t.map(|v| primitive.positions[v as usize].as_dvec3());
                    let across = (b - a).cross(c - a);
                    triangles.push(Triangle {
                        corner: a,
                        edges: [b - a, c - a],
                        normal: across.normalize(),
                        area: across.length() / 2.0,
                        albedo: base * diffuse * (1.0 - far),
                        transmitted: m.diffuse_transmission_color.as_dvec3() * diffuse * far,
                        emission: m.emission.as_dvec3() * alpha,
                        double_sided: m.double_sided || far > 0.0,
                        passed: DVec3::splat(1.0 - alpha) + base * transmission * alpha,
                    });
                }
            }
        }
        let mut sum = 0.0;
        let lit = |t: &Triangle| t.emission != DVec3::ZERO;
        let lamps = (0..triangles.len())
            .filter(|&i| lit(&triangles[i]))
            .map(|i| {
                sum += triangles[i].area;
                (i, sum)
            })
            .collect();
        PathTracer { scene, triangles, lamps, fault }
    }

    /// One unbiased sample of the irradiance [lux] at `p` on the side of the unit `normal`, all reflections
    /// included.
    pub fn irradiance(&self, p: DVec3, normal: DVec3, random: &mut Random) -> DVec3 {
        let (mut p, mut normal, mut weight) = (p, normal, DVec3::ONE);
        let mut sum = DVec3::ZERO;
        let mut first = true;
        loop {
            sum += weight * self.direct(p, normal, random);
            let w = self.direction(normal, random);
            let Some((hit, at, passed)) = self.reflecting_hit(p, w, random) else { break };
            let t = &self.triangles[hit];
            let facing = if t.normal.dot(w) > 0.0 { -t.normal } else { t.normal };
            // Roulette by the shares themselves keeps the weight near 1.
            let [reflected, transmitted] = [t.albedo, t.transmitted].map(DVec3::max_element);
            let pick = random.unit();
            if pick < reflected {
                weight *= passed * t.albedo / reflected;
                normal = facing;
            } else if pick < reflected + transmitted {
                weight *= passed * t.transmitted / transmitted;
                normal = -facing;
            } else {
                break;
            }
            if first && self.fault == Fault::HalfTwice {
                weight *= 1.5;
            }
            first = false;
            p = at;
        }
        if self.fault == Fault::Gain { sum * 1.01 } else { sum }
    }

    /// Direction about `normal` in proportion to the cosine (or the fault).
    fn direction(&self, normal: DVec3, random: &mut Random) -> DVec3 {
        let (u, phi) = (random.unit(), random.unit() * 2.0 * PI);
        let cosine = if self.fault == Fault::MissingCosine { u } else { u.sqrt() };
        let x = normal.any_orthonormal_vector();
        let y = normal.cross(x);
        normal * cosine + (x * phi.cos() + y * phi.sin()) * (1.0 - cosine * cosine).sqrt()
    }

    /// The first surface that reflects along the ray, its position, and what it got of the light: sheets that pass
    /// light are crossed or met by chance. `None` where the ray leaves the scene or ends on a black back.
    fn reflecting_hit(&self, p: DVec3, w: DVec3, random: &mut Random) -> Option<(usize, DVec3, DVec3)> {
        let (mut p, mut passed) = (p, DVec3::ONE);
        loop {
            let (hit, t) = self.nearest(p, w)?;
            let triangle = &self.triangles[hit];
            p += w * t;
            let through = triangle.passed.max_element();
            if random.unit() >= through {
                // The albedo is the reflected share of all light: what met the surface is 1 - through of it.
                let front = triangle.normal.dot(w) < 0.0 || triangle.double_sided;
                return front.then_some((hit, p, passed / (1.0 - through)));
            }
            passed *= triangle.passed / through;
        }
    }

    /// One sample of the direct irradiance at `p`.
    fn direct(&self, p: DVec3, normal: DVec3, random: &mut Random) -> DVec3 {
        let mut sum = DVec3::ZERO;
        for light in &self.scene.lights {
            let intensity = light.intensity.as_dvec3();
            let axis = light.direction.as_dvec3();
            if let LightKind::Directional { .. } = light.kind {
                sum += intensity * normal.dot(-axis).max(0.0) * self.passed(p, -axis, f64::INFINITY);
                continue;
            }
            let to = light.position - p;
            let distance = to.length();
            let w = to / distance;
            let cone = match light.kind {
                LightKind::Spot { inner, outer } => {
                    let (inner, outer) = (f64::from(inner).cos(), f64::from(outer).cos());
                    ((axis.dot(-w) - outer) / (inner - outer)).clamp(0.0, 1.0).powi(2)
                }
                _ => 1.0,
            };
            sum += intensity * cone * normal.dot(w).max(0.0) / distance.powi(2) * self.passed(p, w, distance);
        }
        if let Some(&(_, area)) = self.lamps.last() {
            let pick = random.unit() * area;
            let lamp = &self.triangles[self.lamps[self.lamps.partition_point(|l| l.1 <= pick)].0];
            let (a, b) = (random.unit().sqrt(), random.unit());
            let target = lamp.corner + lamp.edges[0] * (a * (1.0 - b)) + lamp.edges[1] * (a * b);
            let to = target - p;
            let distance = to.length();
            let w = to / distance;
            let cosine = -lamp.normal.dot(w);
            let cosine = if lamp.double_sided { cosine.abs() } else { cosine.max(0.0) };
            if cosine > 0.0 && normal.dot(w) > 0.0 {
                let at_lamp = if self.fault == Fault::AreaForSolidAngle { 1.0 } else { cosine };
                let geometry = normal.dot(w) * at_lamp / distance.powi(2);
                sum += lamp.emission * (geometry * area) * self.passed(p, w, distance);
            }
        }
        if let Some(Sky::Constant(radiance)) = &self.scene.sky {
            // Uniform over the hemisphere, so that not even the density is the library's.
            let (z, phi) = (random.unit(), random.unit() * 2.0 * PI);
            let x = normal.any_orthonormal_vector();
            let w = normal * z + (x * phi.cos() + normal.cross(x) * phi.sin()) * (1.0 - z * z).sqrt();
            sum += radiance.as_dvec3() * (2.0 * PI * z) * self.passed(p, w, f64::INFINITY);
        }
        sum
    }

    /// Share of light per channel that passes between `p` and the point at `end` along `w`.
    fn passed(&self, p: DVec3, w: DVec3, end: f64) -> DVec3 {
        let crossed = self.triangles.iter().filter(|t| t.meets(p, w).is_some_and(|d| d > NEAR && d < end - NEAR));
        crossed.map(|t| t.passed).product()
    }

    fn nearest(&self, p: DVec3, w: DVec3) -> Option<(usize, f64)> {
        let mut best: Option<(usize, f64)> = None;
        for (i, t) in self.triangles.iter().enumerate() {
            if let Some(d) = t.meets(p, w)
                && d > NEAR
                && best.is_none_or(|b| d < b.1)
            {
                best = Some((i, d));
            }
        }
        best
    }
}

impl Triangle {
    /// Distance along `w` (Moeller and Trumbore 1997). Watertight enough in f64: a lost ray in 10^12.
    fn meets(&self, p: DVec3, w: DVec3) -> Option<f64> {
        let across = w.cross(self.edges[1]);
        let det = self.edges[0].dot(across);
        if det.abs() < 1e-14 {
            return None;
        }
        let from = p - self.corner;
        let u = from.dot(across) / det;
        if !(0.0..=1.0).contains(&u) {
            return None;
        }
        let q = from.cross(self.edges[0]);
        let v = w.dot(q) / det;
        (v >= 0.0 && u + v <= 1.0).then(|| self.edges[1].dot(q) / det)
    }
}
