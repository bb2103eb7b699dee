//! A point of view for scenes that bring none.

use crate::accel::{Hit, Ray};
use crate::scene::{Camera, Projection, SurfaceFlags, World};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::f32::consts::{PI, TAU};

/// Vertical field of view of a chosen camera [rad]: 55 degrees, between a wide lens and the eye.
const VERTICAL_FOV: f32 = 0.96;
/// Width over height of the view that is judged.
const ASPECT: f32 = 16.0 / 9.0;
/// Points tried inside.
const POINTS: u32 = 512;
/// Directions tried at each point.
const DIRECTIONS: u32 = 12;
/// Rays per direction.
const RAYS: u32 = 64;
/// A view from inside in which more than this share of rays leaves the scene is no interior.
const MAX_ESCAPED: f32 = 0.08;
/// Likewise for backs of surfaces: some leaves and cloths have no other side.
const MAX_BACKS: f32 = 0.2;
/// Share of all directions in which a room has to have a wall.
const MIN_CLOSED: f32 = 0.95;
/// A room is worth a view from this mean distance on, as a share of the diagonal of the scene: smaller ones are
/// hollows in walls and roofs.
const MIN_DISTANCE: f32 = 0.08;

/// Chooses a view that shows the scene. In closed rooms: of many points in free space and level directions
/// the view with the largest mean logarithm of distance, seeing fronts only. In the open: the whole scene
/// from outside, from the side that shows the most fronts. The same scene always gives the same camera.
///
/// `closest` traces a ray through the triangles of `world`, in its frame.
pub fn choose_camera(world: &World, closest: &(impl Fn(&Ray) -> Option<Hit> + Sync)) -> Camera {
    let (low, high) = bounds(world);
    let inside = (0..POINTS * DIRECTIONS)
        .into_par_iter()
        .filter_map(|i| {
            // Below the middle of the scene's height, as a visitor would stand.
            let place = r3(i / DIRECTIONS) * Vec3::new(0.9, 0.5, 0.9) + Vec3::new(0.05, 0.1, 0.05);
            let azimuth = (i % DIRECTIONS) as f32 / DIRECTIONS as f32 * TAU;
            let view = Frustum::level(low + (high - low) * place, azimuth, -0.08);
            let score = score_inside(world, closest, &view)?;
            (score > (MIN_DISTANCE * (high - low).length()).ln()).then_some((score, i, view))
        })
        // The index decides between equals, so that the order of threads does not.
        .max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)))
        .map(|(_, _, view)| view);
    let view = inside.unwrap_or_else(|| view_from_outside(world, closest, low, high));
    Camera {
        name: "chosen".into(),
        position: world.frame.to_world(view.origin),
        forward: view.forward,
        up: Vec3::Y,
        projection: Projection::Perspective { vertical_fov: VERTICAL_FOV, aspect: None },
    }
}

/// A candidate view, in the frame.
struct Frustum {
    origin: Vec3,
    forward: Vec3,
}

impl Frustum {
    /// A view from `origin`, azimuth from -Z towards +X, pitch upwards [rad].
    fn level(origin: Vec3, azimuth: f32, pitch: f32) -> Frustum {
        let forward = Vec3::new(azimuth.sin() * pitch.cos(), pitch.sin(), -azimuth.cos() * pitch.cos());
        Frustum { origin, forward }
    }

    /// Rays spread evenly over the image.
    fn rays(&self) -> impl Iterator<Item = Ray> + '_ {
        let right = self.forward.cross(Vec3::Y).normalize_or(Vec3::X);
        let up = right.cross(self.forward);
        let tan = (VERTICAL_FOV * 0.5).tan();
        (0..RAYS).map(move |k| {
            let at = r2(k) * 2.0 - 1.0;
            let direction = self.forward + (right * at.x * ASPECT + up * at.y) * tan;
            Ray { origin: self.origin, direction: direction.normalize(), t_max: f32::INFINITY }
        })
    }
}

/// True where a ray meets the front of a surface, double-sided or not: inside a solid there are only backs.
fn sees_front(world: &World, ray: &Ray, hit: &Hit) -> bool {
    ray.direction.dot(world.normals[hit.triangle as usize]) <= 0.0
}

/// Mean logarithm of distance; `None` for a view that leaves the scene, stands in a solid or is blocked.
fn score_inside(world: &World, closest: &impl Fn(&Ray) -> Option<Hit>, view: &Frustum) -> Option<f32> {
    let (mut sum, mut escaped, mut backs) = (0.0, 0, 0);
    for ray in view.rays() {
        match closest(&ray) {
            None => escaped += 1,
            Some(hit) if !sees_front(world, &ray, &hit) => backs += 1,
            Some(hit) => sum += hit.t.max(1e-4).ln(),
        }
        if escaped as f32 > MAX_ESCAPED * RAYS as f32 || backs as f32 > MAX_BACKS * RAYS as f32 {
            return None;
        }
    }
    // A room is closed behind the camera too, but for doors and windows.
    let around = (0..RAYS).map(r2).filter(|at| {
        let (y, azimuth) = (2.0 * at.x - 1.0, TAU * at.y);
        let level = (1.0 - y * y).max(0.0).sqrt();
        let direction = Vec3::new(level * azimuth.cos(), y, level * azimuth.sin());
        let ray = Ray { origin: view.origin, direction, t_max: f32::INFINITY };
        closest(&ray).is_some()
    });
    let closed = around.count() as f32 >= MIN_CLOSED * RAYS as f32;
    closed.then(|| sum / (RAYS - escaped - backs) as f32)
}

/// The whole scene from one of eight sides, slightly from above.
fn view_from_outside(world: &World, closest: &impl Fn(&Ray) -> Option<Hit>, low: Vec3, high: Vec3) -> Frustum {
    let centre = (low + high) * 0.5;
    // The sphere around the box fits the smaller angle of view with a little air.
    let radius = ((high - low).length() * 0.5).max(1e-6);
    let distance = 0.85 * radius / (VERTICAL_FOV * 0.5).sin();
    let view = |k: u32| {
        let turned = Frustum::level(Vec3::ZERO, (k as f32 + 0.4) / 8.0 * TAU, -PI / 9.0);
        Frustum { origin: centre - turned.forward * distance, forward: turned.forward }
    };
    let fronts = |view: &Frustum| {
        let seen = |ray: &Ray| closest(ray).is_some_and(|hit| sees_front(world, ray, &hit));
        view.rays().filter(seen).count()
    };
    let best = (0..8).max_by_key(|&k| (fronts(&view(k)), std::cmp::Reverse(k))).unwrap_or(0);
    view(best)
}

/// Box around all triangles that rays can meet.
fn bounds(world: &World) -> (Vec3, Vec3) {
    let met = world.positions.iter().zip(&world.flags).filter(|(_, f)| !f.has(SurfaceFlags::DEGENERATE));
    let (low, high) = met
        .flat_map(|(corners, _)| corners)
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), &p| (low.min(p), high.max(p)));
    if low.x > high.x { (Vec3::NEG_ONE, Vec3::ONE) } else { (low, high) }
}

/// Points of M. Roberts' R2 sequence ("The Unreasonable Effectiveness of Quasirandom Sequences", 2018).
fn r2(i: u32) -> Vec2 {
    ((f64::from(i) + 0.5) * glam::DVec2::new(0.754_877_666_246_692_7, 0.569_840_290_998_053_2)).fract().as_vec2()
}

/// The same in three dimensions.
fn r3(i: u32) -> Vec3 {
    let step = glam::DVec3::new(0.819_172_513_396_164_4, 0.671_043_606_703_789_2, 0.549_700_477_901_970_3);
    ((f64::from(i) + 0.5) * step).fract().as_vec3()
}
