//! Surfaces at the same place, parted before any ray meets them.
//!
//! Two sheets in one plane (a tile modelled onto a wall, a decal, a face that stands in the file twice) are one
//! surface to the eye, and which of the two a ray meets is decided by rounding: photons would reach one alone, or
//! stripes of both, while both are lit. Renderers draw decals with a small offset for the same reason. Here, the
//! one that is to be behind moves back by a few millionths of the scene, so that it lies under the other: it is
//! covered there, and its texels show the light of what covers it.

use crate::scene::{SurfaceFlags, World};
use glam::{DVec2, DVec3};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::{Bvh2, builder::build_bvh2};
use rayon::prelude::*;
use std::time::Duration;

/// Surfaces nearer than this are at the same place [frame units]: 16 times what f32 coordinates of files near the
/// origin are rounded to.
const TOLERANCE: f64 = 1e-6;

/// How far one moves behind the other [frame units]: 4 times the height at which rays start over a surface.
pub const PARTING: f32 = 128.0 * f32::EPSILON;

/// Sheets upon each other that are told apart.
const LAYERS: u8 = 7;

/// Cosine between the normals of one plane's triangles.
const PARALLEL: f64 = 0.9999;

/// Overlaps of less than this share of the smaller triangle are rounding along a common edge.
const LEAST_OVERLAP: f64 = 1e-3;

/// Moves each triangle that lies in the plane of another, and is seen from the same side, behind it. Returns the
/// triangles that moved, in order.
///
/// In front are surfaces with one side (those with two are also seen from behind), then emitters, then what light
/// passes (decals), then the smaller instance, then the earlier triangle.
pub fn part_coincident(world: &mut World) -> Vec<u32> {
    let seen: Vec<u32> =
        (0..world.len() as u32).filter(|&t| !world.flags[t as usize].has(SurfaceFlags::UNSEEN)).collect();
    let area: Vec<f64> = world.first_triangle.windows(2).map(|t| (t[0]..t[1]).map(|t| world.area(t)).sum()).collect();
    let rank = |t: u32| {
        let (flags, instance) = (world.flags[t as usize], world.refs[t as usize].instance as usize);
        let has = |f| flags.has(f);
        let kind = (has(SurfaceFlags::DOUBLE_SIDED), !has(SurfaceFlags::EMITS), !has(SurfaceFlags::PASSES_LIGHT));
        (kind, area[instance].to_bits(), t)
    };
    let boxes: Vec<Aabb> = seen.iter().map(|&t| bounds(world, t)).collect();
    if boxes.is_empty() {
        return Vec::new();
    }
    let tree: Bvh2 = build_bvh2(&boxes, BvhBuildParams::fastest_build(), &mut Duration::default());
    // For each triangle the ones in front of it.
    let above: Vec<Vec<u32>> = seen
        .par_iter()
        .zip(&boxes)
        .map(|(&t, bounds)| {
            let mut found = Vec::new();
            tree.aabb_traverse(*bounds, |tree, node| {
                let node = &tree.nodes[node as usize];
                for k in node.first_index..node.first_index + node.prim_count {
                    let other = seen[tree.primitive_indices[k as usize] as usize];
                    if rank(other) < rank(t) && coincide(world, t, other) {
                        found.push(other);
                    }
                }
                found.len() < usize::from(LAYERS)
            });
            found
        })
        .collect();
    let mut below: Vec<(u32, Vec<u32>)> = seen.into_iter().zip(above).filter(|(_, a)| !a.is_empty()).collect();
    below.sort_by_key(|b| rank(b.0));
    let mut depth = std::collections::HashMap::new();
    let mut moves = Vec::with_capacity(below.len());
    for (t, above) in below {
        let of = |o: &u32| depth.get(o).copied().unwrap_or(0u8);
        let deepest = above.iter().max_by_key(|o| (of(o), **o)).copied().unwrap_or(t);
        let layer = (of(&deepest) + 1).min(LAYERS);
        depth.insert(t, layer);
        moves.push((t, world.normals[deepest as usize] * -(PARTING * f32::from(layer))));
    }
    moves.sort_by_key(|m| m.0);
    for &(t, by) in &moves {
        world.positions[t as usize].iter_mut().for_each(|p| *p += by);
    }
    moves.into_iter().map(|m| m.0).collect()
}

fn bounds(world: &World, t: u32) -> Aabb {
    let [a, b, c] = world.positions[t as usize].map(|p| p.to_vec3a());
    let pad = glam::Vec3A::splat(TOLERANCE as f32);
    Aabb::new(a.min(b).min(c) - pad, a.max(b).max(c) + pad)
}

/// Whether two triangles lie in one plane, overlap there, and are both seen from one of its sides.
fn coincide(world: &World, a: u32, b: u32) -> bool {
    let (na, nb) = (world.normals[a as usize].as_dvec3(), world.normals[b as usize].as_dvec3());
    let cosine = na.dot(nb);
    let two_sided = |t: u32| world.flags[t as usize].has(SurfaceFlags::DOUBLE_SIDED);
    if cosine.abs() < PARALLEL || (cosine < 0.0 && !two_sided(a) && !two_sided(b)) {
        return false;
    }
    let corners = |t: u32| world.positions[t as usize].map(|p| p.as_dvec3());
    let (pa, pb) = (corners(a), corners(b));
    let heights = pb.map(|p| (p - pa[0]).dot(na));
    let least = heights.iter().fold(f64::INFINITY, |m, h| m.min(h.abs()));
    let one_side = heights.iter().all(|h| *h > 0.0) || heights.iter().all(|h| *h < 0.0);
    if one_side && least > TOLERANCE {
        return false;
    }
    // Seen along the largest axis of the normal: the part of one above the other, and how far they are apart there.
    let (flat, axis) = (flatten(na), main_axis(na));
    let overlap = clip(&pb.map(&flat), &pa.map(&flat));
    let smaller = world.area(a).min(world.area(b)) * na[axis].abs();
    if polygon_area(&overlap).abs() < LEAST_OVERLAP * smaller {
        return false;
    }
    let height = |p: &DVec2, at: DVec3, n: DVec3| at[axis] - (*p - flat(at)).dot(flat(n)) / n[axis];
    overlap.iter().all(|p| ((height(p, pa[0], na) - height(p, pb[0], nb)) * na[axis]).abs() < TOLERANCE)
}

/// The coordinates along the two smaller axes of a normal.
fn flatten(n: DVec3) -> impl Fn(DVec3) -> DVec2 {
    let axis = main_axis(n);
    move |p| DVec2::new(p[(axis + 1) % 3], p[(axis + 2) % 3])
}

fn main_axis(n: DVec3) -> usize {
    let a = n.abs();
    (0..3).max_by(|&i, &j| a[i].total_cmp(&a[j])).unwrap_or(0)
}

/// The part of triangle `subject` inside triangle `window` (Sutherland and Hodgman, 1974).
fn clip(subject: &[DVec2; 3], window: &[DVec2; 3]) -> Vec<DVec2> {
    let turn = polygon_area(window).signum();
    let mut polygon = subject.to_vec();
    for k in 0..3 {
        let (a, b) = (window[k], window[(k + 1) % 3]);
        let side = |p: DVec2| (b - a).perp_dot(p - a) * turn;
        let before = std::mem::take(&mut polygon);
        for (i, &p) in before.iter().enumerate() {
            let q = before[(i + 1) % before.len()];
            let (sp, sq) = (side(p), side(q));
            if sp >= 0.0 {
                polygon.push(p);
            }
            if (sp > 0.0 && sq < 0.0) || (sp < 0.0 && sq > 0.0) {
                polygon.push(p + (q - p) * (sp / (sp - sq)));
            }
        }
    }
    polygon
}

/// Signed area of a polygon, positive if counter-clockwise.
fn polygon_area(p: &[DVec2]) -> f64 {
    (1..p.len().saturating_sub(1)).map(|i| 0.5 * (p[i] - p[0]).perp_dot(p[i + 1] - p[0])).sum()
}
