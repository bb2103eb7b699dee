//! A path tracer for real scenes: irradiance at a point with all reflections, on the library's ray tracing (which has
//! tests of its own against brute force) and its materials, and on nothing else of it: no texels, no photons, no
//! sampling of the library.
//!
//! Every vertex of a path takes one shadow ray to a point on a lamp, one to each light without area, and sends on one
//! cosine-distributed ray, which finds lamps and the sky as well. The two ways to find a lamp are combined by the
//! balance heuristic (Veach 1997), so that a lamp that touches a wall makes no spikes.

use super::random::Random;
use evenlight::Bake;
use evenlight::accel::{Accel, Ray, offset_origin};
use evenlight::scene::{BakeMode, Light, LightKind, Sky, SurfaceFlags, SurfacePoint, World};
use glam::{DVec3, Vec2, Vec3};
use std::f32::consts::PI;
use std::ops::ControlFlow;

/// The scene of a bake, ready to trace.
pub struct SceneTracer<'b> {
    world: &'b World<'b>,
    accel: &'b Accel,
    lights: &'b [Light],
    sky: Option<&'b Sky>,
    /// Emissive triangles and the sum of area times emission factor up to and including each.
    lamps: Vec<(u32, f64)>,
}

/// A point on one side of a surface.
#[derive(Clone, Copy)]
pub struct Point {
    /// Position off the surface, in the frame.
    pub origin: Vec3,
    /// Unit geometric normal of the side.
    pub normal: Vec3,
}

/// Vertices after which a path goes on with this probability, besides the roulette by the albedo: real files have
/// white cavities that no path would leave.
const FREE_VERTICES: u32 = 12;
const SURVIVAL: f32 = 0.9;

/// Rays that must all meet backs for a point to count as buried.
const LOOKS: u32 = 48;

impl<'b> SceneTracer<'b> {
    pub fn new(bake: &'b Bake) -> SceneTracer<'b> {
        let world = &bake.world;
        let mut sum = 0.0;
        let emits = |&t: &u32| {
            let flags = world.flags[t as usize];
            flags.has(SurfaceFlags::EMITS) && !flags.has(SurfaceFlags::DEGENERATE)
        };
        let lamps = (0..world.len() as u32)
            .filter(emits)
            .map(|t| {
                sum += world.area(t) * emission_factor(world, t);
                (t, sum)
            })
            .collect();
        let lighting = &bake.lighting;
        SceneTracer { world, accel: &bake.accel, lights: &lighting.lights, sky: lighting.sky.as_ref(), lamps }
    }

    /// The point of `triangle` at barycentric weights `uv`, on its front or back.
    pub fn point(&self, triangle: u32, uv: Vec2, back: bool) -> Point {
        let normal = self.world.normals[triangle as usize] * if back { -1.0 } else { 1.0 };
        let origin = offset_origin(self.world.position(triangle, uv), normal, self.world.extent(triangle));
        Point { origin, normal }
    }

    /// True if a surface lies upon the point, nearer than `cover` [frame units], or all that the point sees is backs
    /// that absorb: it lies inside a solid.
    pub fn buried(&self, at: &Point, cover: f32, random: &mut Random) -> bool {
        let up = Ray { origin: at.origin, direction: at.normal, t_max: cover };
        let blocks = |t: u32| !self.world.flags[t as usize].has(SurfaceFlags::PASSES_LIGHT);
        if self.accel.closest(&up).is_some_and(|hit| blocks(hit.triangle)) {
            return true;
        }
        (0..LOOKS).all(|_| {
            let direction = cosine_direction(at.normal, random);
            let ray = Ray { origin: at.origin, direction, t_max: f32::INFINITY };
            self.accel.closest(&ray).is_some_and(|hit| {
                let flags = self.world.flags[hit.triangle as usize];
                self.world.normals[hit.triangle as usize].dot(direction) > 0.0
                    && !flags.has(SurfaceFlags::DOUBLE_SIDED)
                    && !flags.has(SurfaceFlags::PASSES_LIGHT)
            })
        })
    }

    /// Other triangles at the place of a point, nearer than rays start off their surface.
    pub fn coincident(&self, triangle: u32, uv: Vec2) -> Vec<u32> {
        let (above, below) = (self.point(triangle, uv, false).origin, self.point(triangle, uv, true).origin);
        let mut found = Vec::new();
        self.accel.visit_hits(&Ray { origin: above, direction: below - above, t_max: 1.0 }, |hit| {
            found.push(hit.triangle);
            ControlFlow::Continue(())
        });
        found.retain(|&t| t != triangle);
        found.sort_unstable();
        found
    }

    /// One unbiased sample of the stored irradiance [lux] at a point, all reflections included.
    pub fn irradiance(&self, mut at: Point, random: &mut Random) -> DVec3 {
        let (mut weight, mut sum, mut vertices) = (Vec3::ONE, DVec3::ZERO, 0);
        loop {
            for light in self.lights {
                let counts = light.bake == BakeMode::Full || light.bake == BakeMode::Indirect && vertices > 0;
                if counts {
                    sum += (weight * self.punctual(light, &at, random)).as_dvec3();
                }
            }
            sum += (weight * self.lamp(&at, random)).as_dvec3();
            vertices += 1;
            if vertices > FREE_VERTICES {
                if random.unit() as f32 >= SURVIVAL {
                    return sum;
                }
                weight /= SURVIVAL;
            }

            let w = cosine_direction(at.normal, random);
            let mut origin = at.origin;
            // Sheets that pass light are crossed or met by chance.
            at = loop {
                let Some(hit) = self.accel.closest(&Ray { origin, direction: w, t_max: f32::INFINITY }) else {
                    let sky = self.sky.map_or(Vec3::ZERO, |s| s.radiance(w));
                    return sum + (weight * sky * PI).as_dvec3();
                };
                let (triangle, uv) = (hit.triangle, Vec2::new(hit.u, hit.v));
                let flags = self.world.flags[triangle as usize];
                let normal = self.world.normals[triangle as usize];
                let back = normal.dot(w) > 0.0;
                let s = self.world.surface(triangle, uv);
                let (mut reflected, mut transmitted) = (Vec3::ZERO, Vec3::ZERO);
                if !back || flags.has(SurfaceFlags::DOUBLE_SIDED) {
                    let d2 = (self.world.position(triangle, uv) - at.origin).length_squared();
                    let share = self.share_of_scattered_ray(triangle, at.normal.dot(w), normal.dot(w).abs(), d2);
                    sum += (weight * s.emission * (s.alpha * PI * share)).as_dvec3();
                    (reflected, transmitted) = (s.albedo * s.alpha, s.diffuse_transmittance * s.alpha);
                }
                let passed = if flags.has(SurfaceFlags::PASSES_LIGHT) { passed(&s) } else { Vec3::ZERO };
                let (to_reflect, to_pass) = (reflected.max_element(), passed.max_element());
                let chance = random.unit() as f32;
                if chance < to_reflect {
                    weight *= reflected / to_reflect;
                    break self.point(triangle, uv, back);
                }
                if chance >= to_reflect + to_pass {
                    let to_transmit = transmitted.max_element();
                    if chance >= to_reflect + to_pass + to_transmit {
                        return sum;
                    }
                    weight *= transmitted / to_transmit;
                    break self.point(triangle, uv, !back);
                }
                weight *= passed / to_pass;
                origin = self.point(triangle, uv, !back).origin;
            };
        }
    }

    /// Irradiance by a light without area.
    fn punctual(&self, light: &Light, at: &Point, random: &mut Random) -> Vec3 {
        if let LightKind::Directional { angular_diameter } = light.kind {
            // Lux count on a plane facing the light: a disc seen under an angle has a mean cosine below 1 there.
            let radius = (0.5 * f64::from(angular_diameter)).cos();
            let height = 1.0 - random.unit() * (1.0 - radius);
            let w = about(-light.direction, height, random);
            let scale = (2.0 / (1.0 + radius)) as f32;
            let cosine = at.normal.dot(w);
            if cosine <= 0.0 {
                return Vec3::ZERO;
            }
            return light.intensity * (scale * cosine) * self.passed(at.origin, w, f32::INFINITY);
        }
        let to = self.world.frame.from_world(light.position) - at.origin;
        let distance = to.length();
        let w = to / distance;
        let cone = match light.kind {
            LightKind::Spot { inner, outer } => {
                ((light.direction.dot(-w) - outer.cos()) / (inner.cos() - outer.cos())).clamp(0.0, 1.0).powi(2)
            }
            _ => light.profile.as_ref().map_or(1.0, |profile| profile.share(light.axes.transpose() * -w)),
        };
        let cosine = at.normal.dot(w);
        if distance <= 0.0 || cosine <= 0.0 || cone <= 0.0 {
            return Vec3::ZERO;
        }
        let metres = distance * self.world.frame.metres as f32;
        // The ray ends just before the light, which may stand on a surface.
        light.intensity * (cone * cosine / (metres * metres)) * self.passed(at.origin, to, 1.0 - 1e-5)
    }

    /// Irradiance by lamps, from one point on one of them, weighted by the balance heuristic.
    fn lamp(&self, at: &Point, random: &mut Random) -> Vec3 {
        let Some(&(last, total)) = self.lamps.last() else { return Vec3::ZERO };
        let pick = random.unit() * total;
        let triangle = self.lamps.get(self.lamps.partition_point(|l| l.1 <= pick)).map_or(last, |l| l.0);
        let (a, b) = (random.unit().sqrt(), random.unit());
        let uv = Vec2::new((a * (1.0 - b)) as f32, (a * b) as f32);
        let flags = self.world.flags[triangle as usize];
        let side = self.world.normals[triangle as usize].dot(at.origin - self.world.position(triangle, uv));
        if side == 0.0 || side < 0.0 && !flags.has(SurfaceFlags::DOUBLE_SIDED) {
            return Vec3::ZERO;
        }
        let target = self.point(triangle, uv, side < 0.0);
        let to = target.origin - at.origin;
        let d2 = to.length_squared();
        let w = to / d2.sqrt();
        let (here, there) = (at.normal.dot(w), -target.normal.dot(w));
        if d2 == 0.0 || here <= 0.0 || there <= 0.0 {
            return Vec3::ZERO;
        }
        let s = self.world.surface(triangle, uv);
        let share = 1.0 - self.share_of_scattered_ray(triangle, here, there, d2);
        let geometry = here * there / d2 / self.lamp_density(triangle);
        s.emission * (s.alpha * geometry * share) * self.passed(at.origin, to, 1.0)
    }

    /// Density per area with which [`lamp`](Self::lamp) picks the points of a triangle.
    fn lamp_density(&self, triangle: u32) -> f32 {
        self.lamps.last().map_or(0.0, |&(_, total)| (emission_factor(self.world, triangle) / total) as f32)
    }

    /// Weight of a lamp found by a scattered ray, against the same point found by [`lamp`](Self::lamp), with the
    /// cosines at both ends and the square of the distance.
    fn share_of_scattered_ray(&self, triangle: u32, here: f32, there: f32, d2: f32) -> f32 {
        if self.world.flags[triangle as usize].has(SurfaceFlags::UNSEEN) {
            return 0.0;
        }
        let scattered = here * there / PI;
        scattered / (scattered + self.lamp_density(triangle) * d2).max(f32::MIN_POSITIVE)
    }

    /// Share of light per channel that passes along a segment.
    fn passed(&self, origin: Vec3, direction: Vec3, t_max: f32) -> Vec3 {
        let mut share = Vec3::ONE;
        let blocked = self.accel.visit_hits(&Ray { origin, direction, t_max }, |hit| {
            if !self.world.flags[hit.triangle as usize].has(SurfaceFlags::PASSES_LIGHT) {
                return ControlFlow::Break(());
            }
            share *= passed(&self.world.surface(hit.triangle, Vec2::new(hit.u, hit.v)));
            ControlFlow::Continue(())
        });
        if blocked { Vec3::ZERO } else { share }
    }
}

/// Share of light per channel that passes straight through a surface.
fn passed(s: &SurfacePoint) -> Vec3 {
    Vec3::splat(1.0 - s.alpha) + s.transmittance * s.alpha
}

/// Sum over the channels of a triangle's emission before its texture.
fn emission_factor(world: &World, triangle: u32) -> f64 {
    f64::from(world.material(triangle).emission.element_sum())
}

/// Direction about `normal` in proportion to the cosine.
fn cosine_direction(normal: Vec3, random: &mut Random) -> Vec3 {
    let height = (1.0 - random.unit()).sqrt();
    about(normal, height, random)
}

/// Direction whose cosine with `axis` is `height`, uniform around it.
fn about(axis: Vec3, height: f64, random: &mut Random) -> Vec3 {
    let axis = axis.as_dvec3();
    let x = axis.any_orthonormal_vector();
    let y = axis.cross(x);
    let (sin, cos) = (random.unit() * std::f64::consts::TAU).sin_cos();
    let radius = (1.0 - height * height).max(0.0).sqrt();
    (axis * height + (x * cos + y * sin) * radius).normalize().as_vec3()
}
