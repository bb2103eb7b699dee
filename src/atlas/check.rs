//! The checker of UV layouts: overlaps, flips, collapsed and stretched triangles.
//!
//! In: triangles in any plane unit (metres of a chart, texels of a page). Out: which triangles are at fault.
//! It trusts no unwrapper: every layout, our own included, passes here before a texel is made of it.

use glam::DVec2;
use rayon::prelude::*;

/// A triangle in the plane.
pub type PlaneTriangle = [DVec2; 3];

/// Largest factor between the area of a triangle on the map and its surface, relative to its chart, in either
/// direction. uvunwrap promises 4; beyond twice that the texels of one chart differ too much to share a filter.
pub const MAX_AREA_DISTORTION: f64 = 8.0;

/// What is wrong with a triangle of a chart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    /// A coordinate is NaN or infinite.
    NonFinite,
    /// No area on the map although the surface has some.
    Collapsed,
    /// Turned the other way than most of its chart.
    Flipped,
    /// Area on the map over surface area differs from the chart's by more than [`MAX_AREA_DISTORTION`].
    Stretched,
}

/// Signed area of a plane triangle, positive when its corners turn from +x to +y.
pub fn signed_area(t: &PlaneTriangle) -> f64 {
    0.5 * (t[1] - t[0]).perp_dot(t[2] - t[0])
}

/// Faults of the triangles of one chart: `faults[i]` belongs to `triangles[i]`, whose surface area is
/// `surface[i]` > 0 in the square of the plane's unit.
pub fn triangle_faults(triangles: &[PlaneTriangle], surface: &[f64]) -> Vec<Option<Fault>> {
    let areas: Vec<f64> = triangles.iter().map(signed_area).collect();
    let finite = |i: &usize| areas[*i].is_finite();
    let signed: f64 = (0..areas.len()).filter(finite).map(|i| areas[i]).sum();
    let sign = if signed < 0.0 { -1.0 } else { 1.0 };
    let mapped: f64 = (0..areas.len()).filter(finite).map(|i| areas[i].abs()).sum();
    let total: f64 = (0..areas.len()).filter(finite).map(|i| surface[i]).sum();
    let expected = mapped / total.max(f64::MIN_POSITIVE);
    areas
        .iter()
        .zip(surface)
        .map(|(&area, &surface)| {
            let ratio = area.abs() / (surface * expected);
            if !area.is_finite() {
                Some(Fault::NonFinite)
            } else if area == 0.0 {
                Some(Fault::Collapsed)
            } else if area * sign < 0.0 {
                Some(Fault::Flipped)
            } else if !(1.0 / MAX_AREA_DISTORTION..=MAX_AREA_DISTORTION).contains(&ratio) {
                Some(Fault::Stretched)
            } else {
                None
            }
        })
        .collect()
}

/// Pairs of triangles whose interiors meet by more than `tolerance` (in the plane's unit), in ascending order
/// with the lower index first; at most `limit` of them. Triangles thinner than `tolerance`, and non-finite
/// ones, overlap nothing. Neighbours that share an edge meet by nothing and are never listed.
///
/// A uniform grid finds the candidates and the separating axis theorem decides.
pub fn find_overlaps(triangles: &[PlaneTriangle], tolerance: f64, limit: usize) -> Vec<(u32, u32)> {
    let solid: Vec<u32> = (0..triangles.len() as u32)
        .filter(|&i| {
            let t = &triangles[i as usize];
            t.iter().all(|p| p.is_finite()) && thickness(t) > tolerance
        })
        .collect();
    if solid.len() < 2 || limit == 0 {
        return Vec::new();
    }
    if solid.len() <= BRUTE_FORCE {
        return overlaps_among(&solid, triangles, tolerance, limit);
    }
    let grid = Grid::new(&solid, triangles);
    let mut pairs: Vec<(u32, u32)> = (0..grid.cells())
        .into_par_iter()
        .flat_map_iter(|c| overlaps_among(grid.cell(c), triangles, tolerance, limit))
        .collect();
    pairs.sort_unstable();
    pairs.dedup();
    pairs.truncate(limit);
    pairs
}

/// Up to this many triangles every pair is tested.
const BRUTE_FORCE: usize = 24;

fn overlaps_among(members: &[u32], triangles: &[PlaneTriangle], tolerance: f64, limit: usize) -> Vec<(u32, u32)> {
    let mut pairs = Vec::new();
    for (k, &i) in members.iter().enumerate() {
        for &j in &members[k + 1..] {
            if overlap(&triangles[i as usize], &triangles[j as usize], tolerance) {
                pairs.push((i.min(j), i.max(j)));
                if pairs.len() == limit {
                    return pairs;
                }
            }
        }
    }
    pairs
}

/// True if no axis separates the triangles, where axes on which they meet by at most `tolerance` separate.
fn overlap(a: &PlaneTriangle, b: &PlaneTriangle, tolerance: f64) -> bool {
    let meet = |f: &dyn Fn(DVec2) -> f64| {
        let (a0, a1) = interval(a, f);
        let (b0, b1) = interval(b, f);
        a1.min(b1) - a0.max(b0) > tolerance
    };
    if !meet(&|p| p.x) || !meet(&|p| p.y) {
        return false;
    }
    [a, b].into_iter().all(|t| {
        (0..3).all(|k| {
            let normal = (t[(k + 1) % 3] - t[k]).perp().normalize_or_zero();
            normal == DVec2::ZERO || meet(&|p| normal.dot(p - t[k]))
        })
    })
}

fn interval(t: &PlaneTriangle, f: &dyn Fn(DVec2) -> f64) -> (f64, f64) {
    let v = t.map(f);
    (v[0].min(v[1]).min(v[2]), v[0].max(v[1]).max(v[2]))
}

/// Smallest altitude of a triangle.
fn thickness(t: &PlaneTriangle) -> f64 {
    let longest = (t[1] - t[0]).length().max((t[2] - t[1]).length()).max((t[0] - t[2]).length());
    2.0 * signed_area(t).abs() / longest.max(f64::MIN_POSITIVE)
}

/// Lists of the triangles that meet each cell of a uniform grid.
struct Grid {
    /// First entry of each cell, and the total at the end.
    first: Vec<u32>,
    entries: Vec<u32>,
}

/// Entries per triangle beyond which the grid is made coarser: long needles cross very many cells.
const MAX_ENTRIES_PER_TRIANGLE: usize = 24;

impl Grid {
    fn new(solid: &[u32], triangles: &[PlaneTriangle]) -> Grid {
        let (mut lo, mut hi) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for &i in solid {
            for p in triangles[i as usize] {
                lo = lo.min(p);
                hi = hi.max(p);
            }
        }
        let mut side = (solid.len() as f64).sqrt().ceil().clamp(1.0, 4096.0) as usize;
        loop {
            let to_cells = DVec2::splat(side as f64) / (hi - lo).max(DVec2::splat(f64::MIN_POSITIVE));
            let mut first = vec![0u32; side * side + 1];
            let mut total = 0usize;
            for &i in solid {
                visit_cells(&triangles[i as usize], lo, to_cells, side, |c| {
                    first[c + 1] += 1;
                    total += 1;
                });
            }
            if total > MAX_ENTRIES_PER_TRIANGLE * solid.len() && side > 1 {
                side /= 2;
                continue;
            }
            for c in 0..side * side {
                first[c + 1] += first[c];
            }
            let mut next = first.clone();
            let mut entries = vec![0u32; total];
            for &i in solid {
                visit_cells(&triangles[i as usize], lo, to_cells, side, |c| {
                    entries[next[c] as usize] = i;
                    next[c] += 1;
                });
            }
            return Grid { first, entries };
        }
    }

    fn cells(&self) -> usize {
        self.first.len() - 1
    }

    fn cell(&self, c: usize) -> &[u32] {
        &self.entries[self.first[c] as usize..self.first[c + 1] as usize]
    }
}

/// Calls `visit` with the index of every cell that the triangle may meet.
fn visit_cells(t: &PlaneTriangle, lo: DVec2, to_cells: DVec2, side: usize, mut visit: impl FnMut(usize)) {
    let t = t.map(|p| (p - lo) * to_cells);
    let last = side as f64 - 1.0;
    let cell = |v: f64| v.floor().clamp(0.0, last) as usize;
    let (y0, y1) = interval(&t, &|p| p.y);
    for row in cell(y0)..=cell(y1) {
        if let Some((x0, x1)) = extent_in_strip(&t, row as f64, row as f64 + 1.0) {
            for column in cell(x0)..=cell(x1) {
                visit(row * side + column);
            }
        }
    }
}

/// Extent in x of the part of a triangle with y in [`y0`, `y1`]; `None` where there is none.
pub(super) fn extent_in_strip(t: &PlaneTriangle, y0: f64, y1: f64) -> Option<(f64, f64)> {
    let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
    for k in 0..3 {
        let (a, b) = (t[k], t[(k + 1) % 3]);
        let (a, b) = if a.y <= b.y { (a, b) } else { (b, a) };
        if b.y < y0 || a.y > y1 {
            continue;
        }
        let at = |y: f64| if b.y > a.y { a.x + (b.x - a.x) * ((y - a.y) / (b.y - a.y)) } else { a.x };
        let (p, q) = (if a.y >= y0 { a.x } else { at(y0) }, if b.y <= y1 { b.x } else { at(y1) });
        lo = lo.min(p.min(q));
        hi = hi.max(p.max(q));
    }
    (lo <= hi).then_some((lo, hi))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle(c: [[f64; 2]; 3]) -> PlaneTriangle {
        c.map(DVec2::from)
    }

    #[test]
    fn neighbours_do_not_overlap_and_copies_do() {
        let a = triangle([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]);
        let b = triangle([[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]);
        assert!(find_overlaps(&[a, b], 1e-9, 9).is_empty());
        assert_eq!(find_overlaps(&[a, b, a], 1e-9, 9), [(0, 2)]);
        let touching = a.map(|p| p + DVec2::new(1.0 - 5e-5, 0.0));
        assert!(find_overlaps(&[a, touching], 1e-4, 9).is_empty());
        assert_eq!(find_overlaps(&[a, touching], 1e-6, 9), [(0, 1)]);
    }

    #[test]
    fn the_grid_finds_what_brute_force_finds() {
        // A regular fan of overlapping triangles, large and small.
        let triangles: Vec<PlaneTriangle> = (0..300)
            .map(|i| {
                let at = DVec2::from_angle(i as f64 * 2.4) * (i as f64).sqrt();
                let size = 0.2 + f64::from(i % 7) * 0.3;
                [at, at + DVec2::from_angle(i as f64) * size, at + DVec2::from_angle(i as f64 + 1.3) * size]
            })
            .collect();
        let all: Vec<u32> = (0..300).collect();
        let mut expected = overlaps_among(&all, &triangles, 1e-6, usize::MAX);
        expected.sort_unstable();
        assert!(expected.len() > 100);
        assert_eq!(find_overlaps(&triangles, 1e-6, usize::MAX), expected);
    }

    #[test]
    fn faults_are_named() {
        let good = triangle([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]);
        let flipped = triangle([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0]]);
        let flat = triangle([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]);
        let broken = triangle([[0.0, f64::NAN], [1.0, 0.0], [2.0, 0.0]]);
        let small = good.map(|p| p * 0.1);
        assert_eq!(
            triangle_faults(&[good, good, flipped, flat, broken, small], &[0.5; 6]),
            [None, None, Some(Fault::Flipped), Some(Fault::Collapsed), Some(Fault::NonFinite), Some(Fault::Stretched)]
        );
    }
}
