//! Charts by projection: the fallback that always works.
//!
//! Triangles are grouped over shared edges as long as their normals stay close to that of the group's largest
//! one, and projected along it. A group that overlaps itself is halved until it does not; a single triangle is
//! laid flat as it is, so every triangle with an area ends in a chart.

use super::check;
use super::unwrap::{FlatChart, JoinedMesh, surface_area, weld};
use glam::{DVec2, DVec3};

/// Cosine of the largest angle between a triangle and the plane it is projected on, 30 degrees: areas shrink
/// to 87 % at most.
const MIN_COSINE: f64 = 0.866_025_403_784_438_6;

/// Overlap relative to a chart's extent that is put down to rounding.
const OVERLAP_TOLERANCE: f64 = 1e-9;

/// Charts of the given triangles of `mesh` [m]. The triangles must have an area.
pub(super) fn flatten(mesh: &JoinedMesh, triangles: &[u32]) -> Vec<FlatChart> {
    let neighbours = neighbours(mesh, triangles);
    let corners: Vec<[DVec3; 3]> =
        triangles.iter().map(|&t| mesh.triangles[t as usize].map(|v| mesh.positions[v as usize])).collect();
    let normals: Vec<DVec3> = corners.iter().map(|c| unit_cross(c[1] - c[0], c[2] - c[0])).collect();
    let mut by_area: Vec<u32> = (0..triangles.len() as u32).collect();
    let areas: Vec<f64> = corners.iter().map(|&c| surface_area(c)).collect();
    by_area.sort_by(|&a, &b| areas[b as usize].total_cmp(&areas[a as usize]).then(a.cmp(&b)));
    let mut taken = vec![false; triangles.len()];
    let mut charts = Vec::new();
    for seed in by_area {
        if taken[seed as usize] {
            continue;
        }
        taken[seed as usize] = true;
        let axis = normals[seed as usize];
        let group_id = mesh.groups[triangles[seed as usize] as usize];
        let mut group = vec![seed];
        let mut next = 0;
        while next < group.len() {
            for &n in &neighbours[group[next] as usize] {
                let fits = normals[n as usize].dot(axis) >= MIN_COSINE
                    && mesh.groups[triangles[n as usize] as usize] == group_id;
                if fits && !taken[n as usize] {
                    taken[n as usize] = true;
                    group.push(n);
                }
            }
            next += 1;
        }
        group.sort_unstable();
        let mut open = vec![group];
        while let Some(group) = open.pop() {
            let chart = project(&group, triangles, &corners, &normals, axis);
            if group.len() > 1 && overlaps(&chart) {
                let (a, b) = halve(group, &chart);
                open.push(b);
                open.push(a);
            } else {
                charts.push(chart);
            }
        }
    }
    charts
}

/// For each of `triangles` the others that share an edge with it, running the other way along it. Edges of
/// more than two triangles join nothing.
fn neighbours(mesh: &JoinedMesh, triangles: &[u32]) -> Vec<Vec<u32>> {
    let mut positions = Vec::with_capacity(triangles.len() * 3);
    for &t in triangles {
        positions.extend(mesh.triangles[t as usize].map(|v| mesh.positions[v as usize]));
    }
    let welded = weld(&positions);
    let mut edges: Vec<(u32, u32, bool, u32)> = Vec::with_capacity(triangles.len() * 3);
    for (i, t) in welded.chunks_exact(3).enumerate() {
        for k in 0..3 {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            edges.push((a.min(b), a.max(b), a < b, i as u32));
        }
    }
    edges.sort_unstable();
    let mut neighbours = vec![Vec::new(); triangles.len()];
    for run in edges.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        if let [a, b] = run
            && a.2 != b.2
        {
            neighbours[a.3 as usize].push(b.3);
            neighbours[b.3 as usize].push(a.3);
        }
    }
    neighbours
}

/// The group projected along `axis`; a single triangle along its own normal.
fn project(group: &[u32], triangles: &[u32], corners: &[[DVec3; 3]], normals: &[DVec3], axis: DVec3) -> FlatChart {
    let axis = if let [only] = group { normals[*only as usize] } else { axis };
    let u = axis.any_orthonormal_vector();
    let v = axis.cross(u);
    // Relative to a corner of the group, so that no digits are lost far from the origin.
    let origin = corners[group[0] as usize][0];
    let flat = |p: DVec3| DVec2::new((p - origin).dot(u), (p - origin).dot(v));
    FlatChart {
        triangles: group.iter().map(|&i| triangles[i as usize]).collect(),
        corners: group.iter().map(|&i| corners[i as usize].map(flat)).collect(),
    }
}

fn overlaps(chart: &FlatChart) -> bool {
    let (mut lo, mut hi) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for p in chart.corners.iter().flatten() {
        lo = lo.min(*p);
        hi = hi.max(*p);
    }
    let tolerance = (hi - lo).max_element() * OVERLAP_TOLERANCE;
    chart.corners.iter().any(|c| check::signed_area(c) <= 0.0)
        || !check::find_overlaps(&chart.corners, tolerance, 1).is_empty()
}

/// Halves of a group, cut at the median centroid along the longer axis of its chart.
fn halve(group: Vec<u32>, chart: &FlatChart) -> (Vec<u32>, Vec<u32>) {
    let centroids: Vec<DVec2> = chart.corners.iter().map(|c| (c[0] + c[1] + c[2]) / 3.0).collect();
    let lo = centroids.iter().fold(DVec2::INFINITY, |a, &b| a.min(b));
    let hi = centroids.iter().fold(DVec2::NEG_INFINITY, |a, &b| a.max(b));
    let axis = usize::from((hi - lo).y > (hi - lo).x);
    let mut order: Vec<usize> = (0..group.len()).collect();
    order.sort_by(|&a, &b| centroids[a][axis].total_cmp(&centroids[b][axis]).then(a.cmp(&b)));
    let second = order.split_off(order.len() / 2);
    let take = |mut o: Vec<usize>| {
        o.sort_unstable();
        o.into_iter().map(|i| group[i]).collect()
    };
    (take(order), take(second))
}

/// Unit vector along a x b, exact for vectors of any length and for needles.
fn unit_cross(a: DVec3, b: DVec3) -> DVec3 {
    a.normalize_or_zero().cross(b.normalize_or_zero()).normalize_or(DVec3::Z)
}
