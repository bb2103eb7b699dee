//! Which cells lie around one.

use super::fit::{BLEND_REACH, Cell, FIT_REACH, LEAST_COSINE, alike};
use super::links::linked;
use crate::accel::Accel;
use glam::Vec3;
use std::collections::BTreeMap;

/// Finds the cells around one: for each size of cells a binary tree of boxes over them in their order, which follows the
/// surface. In one tree of all, every box near a large cell would have to be opened, for it reaches far.
pub(super) struct CellIndex {
    sizes: Vec<SizeIndex>,
}

/// Cells whose sides are within a factor of 2.
struct SizeIndex {
    cells: Vec<u32>,
    /// In preorder, as in [`SurfaceTree`].
    bounds: Vec<Bounds>,
}

/// Least and largest centre and normal of some cells, and their largest side.
#[derive(Clone, Copy)]
struct Bounds {
    centre: [Vec3; 2],
    normal: [Vec3; 2],
    side: f32,
}

impl Bounds {
    fn of(c: &Cell) -> Bounds {
        Bounds { centre: [c.centre; 2], normal: [c.normal; 2], side: c.side }
    }

    fn with(&self, other: &Bounds) -> Bounds {
        let both = |a: [Vec3; 2], b: [Vec3; 2]| [a[0].min(b[0]), a[1].max(b[1])];
        Bounds {
            centre: both(self.centre, other.centre),
            normal: both(self.normal, other.normal),
            side: self.side.max(other.side),
        }
    }

    /// Whether any of the cells may be [near](near) a cell and turned to the same side.
    fn may_touch(&self, own: &Cell) -> bool {
        let nearest = own.centre.clamp(self.centre[0], self.centre[1]);
        let turned = (own.normal * self.normal[0]).max(own.normal * self.normal[1]).element_sum();
        near(own.centre.distance(nearest), own.side, self.side) && turned >= LEAST_COSINE - 1e-5
    }
}

/// Whether a cell `distance` away with a side of at most `side` is of use for the fit of one with side `own`, or reaches
/// into it: by half the diagonal of a square cell, and a little for one that is not.
fn near(distance: f32, own: f32, side: f32) -> bool {
    distance <= (FIT_REACH * own).max(own + BLEND_REACH * side)
}

impl CellIndex {
    pub(super) fn new(cells: &[Cell]) -> CellIndex {
        let mut sizes = BTreeMap::<i32, Vec<u32>>::new();
        let size = |c: &Cell| libm::ilogbf(c.side);
        (0..).zip(cells).for_each(|(i, c)| sizes.entry(size(c)).or_default().push(i));
        CellIndex { sizes: sizes.into_values().map(|of_size| SizeIndex::new(cells, of_size)).collect() }
    }

    /// Cells that a fit of cell `i` needs, or whose planes may reach into it, without a wall between; with `i`
    /// itself, in order.
    pub(super) fn around(&self, cells: &[Cell], i: usize, accel: &Accel) -> Vec<u32> {
        let mut found = Vec::new();
        let own = &cells[i];
        self.sizes.iter().for_each(|size| size.around(own, &mut found));
        found.retain(|&j| {
            let other = &cells[j as usize];
            j as usize != i && alike(own, other) && linked(&own.middle, &other.middle, accel)
        });
        // Whatever its normal: that of a cell of all directions is none.
        found.push(i as u32);
        found.sort_unstable();
        found
    }
}

impl SizeIndex {
    fn new(all: &[Cell], cells: Vec<u32>) -> SizeIndex {
        fn fill(bounds: &mut Vec<Bounds>, all: &[Cell], cells: &[u32]) -> Bounds {
            let (at, first) = (bounds.len(), Bounds::of(&all[cells[0] as usize]));
            bounds.push(first);
            if cells.len() > 1 {
                let (a, b) = cells.split_at(cells.len() / 2);
                bounds[at] = fill(bounds, all, a).with(&fill(bounds, all, b));
            }
            bounds[at]
        }
        let mut bounds = Vec::with_capacity(2 * cells.len() - 1);
        fill(&mut bounds, all, &cells);
        SizeIndex { cells, bounds }
    }

    /// Adds the cells that may be near enough to `own`.
    fn around(&self, own: &Cell, found: &mut Vec<u32>) {
        let mut open = vec![(0, 0, self.cells.len())];
        while let Some((node, from, to)) = open.pop() {
            let m = (to - from) / 2;
            match m {
                _ if !self.bounds[node].may_touch(own) => {}
                0 => found.push(self.cells[from]),
                _ => open.extend([(node + 2 * m, from + m, to), (node + 1, from, from + m)]),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::fit::tests::{cells_of, elements};
    use super::*;
    use crate::cell::SurfaceTree;

    /// The index finds what a look at all cells finds.
    #[test]
    fn cells_around_are_all_found() {
        let turn = |i: u32| Vec3::new(0.3 * (i % 7) as f32, 1.0 - 0.4 * (i % 5) as f32, 0.2).normalize();
        let tree = SurfaceTree::of(elements(turn));
        let accel = Accel::build(&[], |_| false);
        // Cells of 1 to 30 elements.
        let (mut cells, caught) = cells_of(&tree, 1);
        cells.ranges.clear();
        let mut from = 0;
        while from < 256 {
            let to = (from + 1 + 7 * from % 30).min(256);
            cells.ranges.push(from..to);
            from = to;
        }
        let all: Vec<Cell> =
            cells.ranges.iter().map(|r| Cell::new(&tree, &cells.order[r.clone()], &caught, &[1.0; 256])).collect();
        let index = CellIndex::new(&all);
        for (i, own) in all.iter().enumerate() {
            let of_use = |(j, c): &(usize, &Cell)| {
                *j == i || near(own.centre.distance(c.centre), own.side, c.side) && alike(own, c)
            };
            let plain: Vec<u32> = all.iter().enumerate().filter(of_use).map(|(j, _)| j as u32).collect();
            assert_eq!(index.around(&all, i, &accel), plain, "around cell {i}");
        }
    }
}
