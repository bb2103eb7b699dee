//! Charts by projection: what always works, and what suffices for surface of less than a texel a triangle.
//!
//! Triangles are grouped over shared edges as long as their normals stay close to an axis, that of the group's
//! largest triangle first and then the group's own mean (the step of Cohen-Steiner, Alliez and Desbrun,
//! "Variational shape approximation", 2004), and projected along it. A group that overlaps itself is halved
//! until it does not; a single triangle is laid flat as it is, so every triangle with an area ends in a chart.

use super::check;
use super::unwrap::{FlatChart, JoinedMesh, surface_area};
use glam::{DVec2, DVec3};

/// How far triangles may lean from the plane that they are projected on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Lean {
    /// 30 degrees: areas shrink to 87 % at most.
    Little,
    /// 60 degrees: areas shrink to 50 %, within one chart by a factor of 2, in fewer charts.
    Much,
}

impl Lean {
    /// Cosine of the largest angle between a triangle's normal and the axis.
    fn min_cosine(self) -> f64 {
        match self {
            Lean::Little => 0.866_025_403_784_438_6,
            Lean::Much => 0.5,
        }
    }
}

/// How often a group is grown anew around its mean normal.
const REFINEMENTS: u32 = 3;

/// Overlap relative to a chart's extent that is put down to rounding.
const OVERLAP_TOLERANCE: f64 = 1e-9;

/// Marks the place of a missing neighbour.
const NONE: u32 = u32::MAX;

/// Charts of the given triangles of `mesh` [m]. The triangles must have an area. `welded` names for each
/// position the first one at the same place.
pub(super) fn flatten(mesh: &JoinedMesh, welded: &[u32], triangles: &[u32], lean: Lean) -> Vec<FlatChart> {
    let patch = Patch::new(mesh, welded, triangles);
    let mut by_area: Vec<u32> = (0..triangles.len() as u32).collect();
    by_area.sort_by(|&a, &b| patch.areas[b as usize].total_cmp(&patch.areas[a as usize]).then(a.cmp(&b)));
    let mut state = vec![FREE; triangles.len()];
    let mut charts = Vec::new();
    for seed in by_area {
        if state[seed as usize] == TAKEN {
            continue;
        }
        let (axis, mut group) = patch.grow(seed, lean.min_cosine(), &mut state);
        group.iter().for_each(|&i| state[i as usize] = TAKEN);
        group.sort_unstable();
        let mut open = vec![group];
        while let Some(group) = open.pop() {
            let chart = patch.project(&group, axis);
            match overlap(&chart) {
                Some((a, b)) => {
                    let (a, b) = patch.parted(&group, [a, b], &mut state);
                    open.push(b);
                    open.push(a);
                }
                None => charts.push(chart),
            }
        }
    }
    charts
}

/// States of a triangle: in no chart, in a chart; numbers below stand for the flood that reached it last.
const FREE: u32 = u32::MAX;
const TAKEN: u32 = u32::MAX - 1;
const LEFT: u32 = u32::MAX - 2;
const FIRST: u32 = u32::MAX - 3;
const SECOND: u32 = u32::MAX - 4;

/// Some triangles of a mesh.
struct Patch<'a> {
    triangles: &'a [u32],
    /// Face group of each.
    groups: Vec<u32>,
    corners: Vec<[DVec3; 3]>,
    normals: Vec<DVec3>,
    areas: Vec<f64>,
    /// Those that share an edge and run the other way along it, or [`NONE`]. Edges of more than two triangles
    /// join nothing.
    neighbours: Vec<[u32; 3]>,
}

impl Patch<'_> {
    fn new<'a>(mesh: &JoinedMesh, welded: &[u32], triangles: &'a [u32]) -> Patch<'a> {
        let corners: Vec<[DVec3; 3]> =
            triangles.iter().map(|&t| mesh.triangles[t as usize].map(|v| mesh.positions[v as usize])).collect();
        let mut edges: Vec<(u32, u32, u32)> = Vec::with_capacity(triangles.len() * 3);
        for (i, &t) in triangles.iter().enumerate() {
            let t = mesh.triangles[t as usize].map(|v| welded[v as usize]);
            for k in 0..3 {
                let (a, b) = (t[k], t[(k + 1) % 3]);
                edges.push((a.min(b), a.max(b), 6 * i as u32 + 2 * k as u32 + u32::from(a < b)));
            }
        }
        edges.sort_unstable();
        let mut neighbours = vec![[NONE; 3]; triangles.len()];
        for run in edges.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
            if let &[(.., a), (.., b)] = run
                && a % 2 != b % 2
            {
                neighbours[a as usize / 6][a as usize % 6 / 2] = b / 6;
                neighbours[b as usize / 6][b as usize % 6 / 2] = a / 6;
            }
        }
        Patch {
            triangles,
            groups: triangles.iter().map(|&t| mesh.groups[t as usize]).collect(),
            normals: corners.iter().map(|c| unit_cross(c[1] - c[0], c[2] - c[0])).collect(),
            areas: corners.iter().map(|&c| surface_area(c)).collect(),
            corners,
            neighbours,
        }
    }

    /// The largest group found around `seed`, and the axis that its normals are close to.
    fn grow(&self, seed: u32, min_cosine: f64, state: &mut [u32]) -> (DVec3, Vec<u32>) {
        let area = |group: &[u32]| group.iter().map(|&i| self.areas[i as usize]).sum::<f64>();
        let mut axis = self.normals[seed as usize];
        let mut group = self.flood(seed, axis, min_cosine, REFINEMENTS, state);
        for round in 0..REFINEMENTS {
            let sum: DVec3 = group.iter().map(|&i| self.normals[i as usize] * self.areas[i as usize]).sum();
            let mean = sum.normalize_or(axis);
            if self.normals[seed as usize].dot(mean) < min_cosine {
                break;
            }
            let larger = self.flood(seed, mean, min_cosine, round, state);
            if area(&larger) <= area(&group) {
                break;
            }
            (axis, group) = (mean, larger);
        }
        (axis, group)
    }

    /// Triangles in reach of `seed` that are not taken and whose normals are close to `axis`. `mark` must differ
    /// from that of the last flood.
    fn flood(&self, seed: u32, axis: DVec3, min_cosine: f64, mark: u32, state: &mut [u32]) -> Vec<u32> {
        let mark = seed * (REFINEMENTS + 1) + mark;
        state[seed as usize] = mark;
        let mut group = vec![seed];
        let mut next = 0;
        while next < group.len() {
            for n in self.neighbours[group[next] as usize] {
                if n != NONE
                    && state[n as usize] != TAKEN
                    && state[n as usize] != mark
                    && self.normals[n as usize].dot(axis) >= min_cosine
                    && self.groups[n as usize] == self.groups[seed as usize]
                {
                    state[n as usize] = mark;
                    group.push(n);
                }
            }
            next += 1;
        }
        group
    }

    /// The triangles of a connected group nearer to one of two of them, counted in steps over edges, and those
    /// nearer to the other.
    fn parted(&self, group: &[u32], seeds: [usize; 2], state: &mut [u32]) -> (Vec<u32>, Vec<u32>) {
        group.iter().for_each(|&i| state[i as usize] = LEFT);
        let mut reached = seeds.map(|s| group[s]).to_vec();
        let mut halves = (Vec::new(), Vec::new());
        state[reached[0] as usize] = FIRST;
        state[reached[1] as usize] = SECOND;
        let mut next = 0;
        while next < reached.len() {
            let i = reached[next];
            let half = state[i as usize];
            for n in self.neighbours[i as usize] {
                if n != NONE && state[n as usize] == LEFT {
                    state[n as usize] = half;
                    reached.push(n);
                }
            }
            if half == FIRST {
                halves.0.push(i)
            } else {
                halves.1.push(i)
            }
            next += 1;
        }
        group.iter().for_each(|&i| state[i as usize] = TAKEN);
        halves.0.sort_unstable();
        halves.1.sort_unstable();
        halves
    }

    /// The group projected along `axis`, a single triangle along its own normal, and scaled to the area of its
    /// surface.
    fn project(&self, group: &[u32], axis: DVec3) -> FlatChart {
        let axis = if let [only] = group { self.normals[*only as usize] } else { axis };
        let u = axis.any_orthonormal_vector();
        let v = axis.cross(u);
        // Relative to a corner of the group, so that no digits are lost far from the origin.
        let origin = self.corners[group[0] as usize][0];
        let flat = |p: DVec3| DVec2::new((p - origin).dot(u), (p - origin).dot(v));
        let mut corners: Vec<_> = group.iter().map(|&i| self.corners[i as usize].map(flat)).collect();
        let mapped: f64 = corners.iter().map(check::signed_area).sum();
        let surface: f64 = group.iter().map(|&i| self.areas[i as usize]).sum();
        let scale = (surface / mapped).sqrt();
        if scale.is_finite() {
            corners.iter_mut().flatten().for_each(|p| *p *= scale);
        }
        FlatChart { triangles: group.iter().map(|&i| self.triangles[i as usize]).collect(), corners }
    }
}

/// Two places in a chart whose triangles must not stay in one chart.
fn overlap(chart: &FlatChart) -> Option<(usize, usize)> {
    let count = chart.corners.len();
    if count == 1 {
        return None;
    }
    if let Some(turned) = chart.corners.iter().position(|c| check::signed_area(c) <= 0.0) {
        return Some((turned, (turned + 1) % count));
    }
    let (mut lo, mut hi) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for p in chart.corners.iter().flatten() {
        lo = lo.min(*p);
        hi = hi.max(*p);
    }
    let tolerance = (hi - lo).max_element() * OVERLAP_TOLERANCE;
    let &(a, b) = check::find_overlaps(&chart.corners, tolerance, 1).first()?;
    Some((a as usize, b as usize))
}

/// Unit vector along a x b, exact for vectors of any length and for needles.
fn unit_cross(a: DVec3, b: DVec3) -> DVec3 {
    a.normalize_or_zero().cross(b.normalize_or_zero()).normalize_or(DVec3::Z)
}
