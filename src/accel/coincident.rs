//! Surfaces at the same place, parted before any ray meets them.
//!
//! Two sheets in one plane (a tile modelled onto a wall, a face that stands in the file twice) are one surface to the
//! eye, and which of the two a ray meets is decided by rounding: photons would reach one alone, or stripes of both,
//! while both are lit. Renderers draw decals with a small offset for the same reason. Here, the one that is to be in
//! front moves forward by a few millionths of the scene: it covers the other there, whose texels show its light. What
//! moves is the smaller of the two as a rule, so that nothing comes apart that stood together.

use super::wide::Bounds;
use crate::error::Warning;
use crate::scene::{SurfaceFlags, World};
use glam::{DVec2, DVec3, Vec3};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::{Bvh2, builder::build_bvh2};
use rayon::prelude::*;
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::time::Duration;

/// Surfaces nearer than this are at the same place [frame units]: 16 times what f32 coordinates of files near the
/// origin are rounded to.
const TOLERANCE: f64 = 1e-6;

/// How far one moves in front of the other [frame units]: 4 times the height at which rays start over a surface.
pub const PARTING: f32 = 128.0 * f32::EPSILON;

/// Sheets upon each other that are told apart.
pub const LAYERS: u8 = 7;

/// Of more triangles with the same box than this, only so many are looked at, and as many others in the plane of one.
const MOST_COPIES: usize = 2 * LAYERS as usize;
const MOST_BEHIND: usize = 256;

/// Cosine between the normals of one plane's triangles.
const PARALLEL: f64 = 0.9999;

/// Overlaps of less than this share of the smaller triangle are rounding along a common edge.
const LEAST_OVERLAP: f64 = 1e-3;

/// Moves each triangle that lies in the plane of another, and is seen from the same side, in front of it. Returns
/// the triangles that moved, in order.
///
/// In front are emitters, then surfaces with one side (those with two are also seen from behind), then the smaller
/// instance, then the earlier triangle. What light passes stays where it is.
pub fn part_coincident(world: &mut World) -> Vec<u32> {
    let area: Vec<f64> = world.first_triangle.windows(2).map(|t| (t[0]..t[1]).map(|t| world.area(t)).sum()).collect();
    let has = |t: u32, f| world.flags[t as usize].has(f);
    let rank = |t: u32| {
        let instance = world.refs[t as usize].instance as usize;
        (!has(t, SurfaceFlags::EMITS), has(t, SurfaceFlags::DOUBLE_SIDED), area[instance].to_bits(), t)
    };
    let solid = |&t: &u32| !has(t, SurfaceFlags::UNSEEN) && !has(t, SurfaceFlags::PASSES_LIGHT);
    let mut seen: Vec<u32> = (0..world.len() as u32).filter(solid).collect();
    let bounds = |t: u32| Bounds::of(&world.positions[t as usize]);
    seen.par_sort_by_cached_key(|&t| (bounds(t).bits(), rank(t)));
    let same_box = |a: &u32, b: &u32| bounds(*a).bits() == bounds(*b).bits();
    let seen: Vec<u32> = seen.chunk_by(same_box).flat_map(|copies| copies.iter().take(MOST_COPIES).copied()).collect();
    if seen.is_empty() {
        return Vec::new();
    }
    let pad = Vec3::splat(TOLERANCE as f32);
    let padded = |b: Bounds| Aabb::new((b.min - pad).to_vec3a(), (b.max + pad).to_vec3a());
    let boxes: Vec<Aabb> = seen.iter().map(|&t| padded(bounds(t))).collect();
    let tree: Bvh2 = build_bvh2(&boxes, BvhBuildParams::fastest_build(), &mut Duration::default());
    // For each triangle those behind it.
    let mut pairs: Vec<(u32, Vec<u32>)> = seen
        .par_iter()
        .zip(&boxes)
        .map(|(&t, around)| {
            let (own, mut behind) = (rank(t), Vec::new());
            tree.aabb_traverse(*around, |tree, node| {
                let node = &tree.nodes[node as usize];
                for k in node.first_index..node.first_index + node.prim_count {
                    let other = seen[tree.primitive_indices[k as usize] as usize];
                    if own < rank(other) && coincide(world, t, other) {
                        behind.push(other);
                    }
                }
                behind.len() < MOST_BEHIND
            });
            behind.sort_unstable();
            (t, behind)
        })
        .filter(|(_, behind)| !behind.is_empty())
        .collect();
    // From the back to the front: each lies one layer above the highest behind it.
    pairs.sort_by_key(|p| Reverse(rank(p.0)));
    let mut layers = vec![0u8; world.len()];
    for (t, behind) in &pairs {
        let highest = behind.iter().map(|&b| layers[b as usize]).max().unwrap_or(0);
        layers[*t as usize] = (highest + 1).min(LAYERS);
    }
    let mut moves: Vec<(u32, Vec3)> = pairs
        .iter()
        .map(|(t, behind)| {
            // A sheet with two sides goes to its own front, but before a surface with one, and a lamp before any.
            let two_sided = |t: &u32| has(*t, SurfaceFlags::DOUBLE_SIDED);
            let shows = |b: &&u32| two_sided(t) && (has(*t, SurfaceFlags::EMITS) || !two_sided(b));
            let base = behind.iter().filter(shows).min_by_key(|b| (two_sided(b), **b)).unwrap_or(t);
            let forward = world.normals[*base as usize];
            (*t, forward * (PARTING * f32::from(layers[*t as usize])))
        })
        .collect();
    moves.sort_by_key(|m| m.0);
    for &(t, by) in &moves {
        world.positions[t as usize].iter_mut().for_each(|p| *p += by);
    }
    moves.into_iter().map(|m| m.0).collect()
}

/// Says of which nodes [`part_coincident`] moved triangles.
pub fn coincident_warning(world: &World, parted: &[u32]) -> Option<Warning> {
    const NAMED: usize = 4;
    let mut counts = BTreeMap::<u32, usize>::new();
    parted.iter().for_each(|&t| *counts.entry(world.refs[t as usize].instance).or_default() += 1);
    let mut nodes: Vec<(u32, usize)> = counts.into_iter().collect();
    nodes.sort_by_key(|n| (Reverse(n.1), n.0));
    let name = |n: &(u32, usize)| format!("{} ({})", world.scene.instances[n.0 as usize].name, n.1);
    let named: Vec<String> = nodes.iter().take(NAMED).map(name).collect();
    let more = if nodes.len() > NAMED { ", ..." } else { "" };
    (!parted.is_empty()).then(|| {
        let what = format!(
            "{} triangles lie in the plane of others and were moved in front of them by a hair: of node {}{more}; move \
             such surfaces apart, or delete what is hidden",
            parted.len(),
            named.join(", ")
        );
        Warning::new("coincident-surfaces", what)
    })
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
