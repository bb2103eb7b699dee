//! A picture of what is lit from behind.

use super::RgbImage;
use super::render::CameraRays;
use crate::accel::{Hit, Ray};
use crate::accuracy::spread;
use crate::backs::{LitBacks, ends_light};
use crate::sampling::{cosine_hemisphere, sobol, uniform_triangle, unit_f32};
use crate::scene::{Camera, Projection, World};
use glam::{Vec2, Vec3};
use rayon::prelude::*;

/// Vertical field of view [rad], as that of a chosen view, but wider: culprits are close in small rooms.
const VERTICAL_FOV: f32 = 1.2;

/// Lit points of a node that a camera should see.
const POINTS: usize = 64;

/// Points that cameras are looked for in front of, and directions at each.
const PLACES: usize = 8;
const DIRECTIONS: u32 = 32;

/// A camera stays within this share of the free way, and this many times the extent of the lit points.
const FREE_SHARE: f32 = 0.85;
const FARTHEST: f32 = 2.5;

/// The scene from where the lit backs of `node`, an index into the nodes of `backs`, are seen: fronts grey, backs that light
/// ends on red, the brighter the more; other backs dark blue. Every surface is solid. `closest` traces a ray through the
/// triangles of `world`, in its frame. The result does not depend on the number of threads.
pub fn render_backs(
    world: &World,
    closest: &(impl Fn(&Ray) -> Option<Hit> + Sync),
    backs: &LitBacks,
    node: usize,
    [width, height]: [u32; 2],
) -> RgbImage {
    let instance = backs.nodes.get(node).map(|n| n.instance);
    let of_node = |t: &u32| Some(world.refs[*t as usize].instance as usize) == instance;
    let light = |t: u32| backs.irradiance.get(t as usize).copied().unwrap_or(0.0);
    let lit: Vec<u32> = (0..world.len() as u32).filter(of_node).filter(|&t| light(t) > 0.0).collect();
    let camera = camera(world, closest, &lit, &light);
    let rays = CameraRays::new(world, &camera, width as f32 / height.max(1) as f32);
    let most = lit.iter().map(|&t| light(t)).fold(f32::MIN_POSITIVE, f32::max);
    let colour = |i: usize| {
        let pixel = Vec2::new((i % width as usize) as f32, (i / width as usize) as f32) + 0.5;
        let ray = rays.ray(pixel / Vec2::new(width as f32, height as f32) * 2.0 - 1.0);
        let Some(hit) = closest(&ray) else { return [24, 24, 24] };
        let cosine = world.normals[hit.triangle as usize].dot(ray.direction);
        let shade = 0.4 + 0.6 * cosine.abs();
        let [r, g, b] = if cosine <= 0.0 || !ends_light(world, hit.triangle) {
            [190.0; 3]
        } else if light(hit.triangle) > 0.0 {
            // The square root shows weak light, too.
            [120.0 + 135.0 * (light(hit.triangle) / most).min(1.0).sqrt(), 24.0, 24.0]
        } else {
            [50.0, 55.0, 90.0]
        };
        [r * shade, g * shade, b * shade].map(|c| c as u8)
    };
    let pixels: Vec<[u8; 3]> = (0..width as usize * height as usize).into_par_iter().map(colour).collect();
    RgbImage { width, height, rgb: pixels.into_flattened() }
}

/// From where most of the light on the backs of `lit` is seen, and most squarely.
fn camera(
    world: &World,
    closest: &(impl Fn(&Ray) -> Option<Hit> + Sync),
    lit: &[u32],
    light: &impl Fn(u32) -> f32,
) -> Camera {
    let flux: Vec<f64> = lit.iter().map(|&t| f64::from(light(t)) * world.area(t)).collect();
    let random = |k: usize, d: usize| unit_f32(sobol(k as u32, d, 0));
    // Position and unit normal of the back.
    let points: Vec<(Vec3, Vec3)> = if lit.is_empty() { Vec::new() } else { spread(&flux, POINTS, 0.5) }
        .into_iter()
        .enumerate()
        .map(|(k, j)| {
            let uv = uniform_triangle(Vec2::new(random(k, 0), random(k, 1)));
            (world.position(lit[j], uv), -world.normals[lit[j] as usize])
        })
        .collect();
    let centre = points.iter().map(|p| p.0).sum::<Vec3>() / points.len().max(1) as f32;
    let radius = points.iter().map(|p| p.0.distance(centre)).fold(1e-3, f32::max);
    let score = |eye: Vec3, forward: Vec3| {
        let least = (0.5 * VERTICAL_FOV).cos();
        let seen = points.iter().map(|&(p, normal)| {
            let to = p - eye;
            let (way, length) = (to.normalize_or_zero(), to.length());
            let squarely = -normal.dot(way);
            let ray = Ray { origin: eye, direction: way, t_max: length * 0.999 };
            if squarely > 0.0 && forward.dot(way) > least && closest(&ray).is_none() { squarely } else { 0.0 }
        });
        seen.sum::<f32>()
    };
    let candidate = |k: u32| {
        let (at, normal) = *points.get(k as usize % PLACES * (POINTS / PLACES))?;
        let direction = cosine_hemisphere(normal, Vec2::new(random(k as usize, 0), random(k as usize, 1)));
        let origin = at + normal * 1e-4;
        let free = closest(&Ray { origin, direction, t_max: f32::INFINITY }).map_or(f32::INFINITY, |hit| hit.t);
        let eye = origin + direction * (FREE_SHARE * free).min(FARTHEST * radius);
        let forward = (centre - eye).try_normalize()?;
        Some((score(eye, forward), k, eye, forward))
    };
    let best = (0..PLACES as u32 * DIRECTIONS)
        .into_par_iter()
        .filter_map(candidate)
        // The index decides between equals, so that the order of threads does not.
        .max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
    let (eye, forward) = best.map_or((Vec3::ZERO, Vec3::NEG_Z), |b| (b.2, b.3));
    Camera {
        name: "lit backs".into(),
        position: world.frame.to_world(eye),
        forward,
        up: Vec3::Y,
        projection: Projection::Perspective { vertical_fov: VERTICAL_FOV, aspect: None },
    }
}
