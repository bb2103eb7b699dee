//! 6. From photons in texels to irradiance: cells as large as the noise asks for, and planes over them.
//!
//! In: the flux that each texel of the map caught of photons, or of lamps and the sky by samples of its own, in two
//! halves. Out: its irradiance, in two halves, each with cells chosen by its own data; both share one number alone, how far counts
//! scatter. Their difference then holds all of the noise, and the product of what both smooth away, their
//! [bias](Compared::bias). Meshes that photons are too slow for [`Gather`].

mod bias;
mod choose;
mod fit;
mod gather;
mod index;
mod links;
mod tree;

pub use bias::{Bias, Compared};
pub use gather::{Gather, Gathered};
pub use tree::{Element, Node, Setting, SurfaceTree};

use crate::accel::Accel;
use choose::{choose, dispersion, scatter};
use fit::reconstruct;
use glam::Vec3;
use links::Cells;

/// What one half caught, per element in the order of the tree.
#[derive(Debug, Clone, Default)]
pub struct Caught {
    /// Arriving flux per channel [lux x frame units squared].
    pub flux: Vec<[f32; 3]>,
    /// Its variance by what is known of the element alone, mean over the channels; > 0 where there is flux. Only its
    /// course over the surface matters: how large it is follows from the halves.
    pub variance: Vec<f64>,
    /// Where every element has samples of its own: what they say beside that. Photons come where they come: what single
    /// elements caught of them tells nothing (measured: told where it is beyond noise, errors grow by 1 to 10 %).
    pub samples: Option<Samples>,
}

/// Samples that elements took for themselves.
#[derive(Debug, Clone, Default)]
pub struct Samples {
    /// What of the variance is seen in them, not only thought likely.
    pub scatter: Vec<f64>,
    /// What the flux of one of them is in proportion to: noise has a variance of this times flux, all else being equal.
    pub grain: Vec<f32>,
}

/// Irradiance of all elements in two independent halves.
#[derive(Debug, Clone, Default)]
pub struct Reconstruction {
    /// Irradiance (lux) of each element, in the order of the tree.
    pub values: [Vec<Vec3>; 2],
    /// Side of the cell of each element [frame units]: how far around it is smoothed.
    pub sides: [Vec<f32>; 2],
    /// Nodes with no border of a cell inside, of either half: what is in one of them errs together.
    pub blocks: Vec<Node>,
    /// Number of cells.
    pub cells: [usize; 2],
    /// Cell of the odd half that each element is in, in the order of the tree; empty where none are made.
    pub cell_of: Vec<u32>,
}

/// The common refinement of two ways to part the tree into nodes, both in order.
pub fn refined(a: &[Node], b: &[Node]) -> Vec<Node> {
    let (mut i, mut j, mut out) = (0, 0, Vec::with_capacity(a.len().max(b.len())));
    // Of two nodes with a common element one holds the other.
    while i < a.len() && j < b.len() {
        let (left, right) = (&a[i].elements, &b[j].elements);
        out.push(if left.len() <= right.len() { a[i].clone() } else { b[j].clone() });
        let done = left.end.min(right.end);
        i += usize::from(left.end == done);
        j += usize::from(right.end == done);
    }
    out
}

/// Marks a texel that no cell holds.
pub const NO_CELL: u32 = u32::MAX;

/// Elements in a block where every element is on its own.
const RAW_BLOCK: usize = 64;

impl Reconstruction {
    /// Reconstructs both halves.
    pub fn new(tree: &SurfaceTree, caught: [&Caught; 2], accel: &Accel) -> Reconstruction {
        let dispersion = dispersion(tree, caught);
        let chosen = caught.map(|caught| choose(tree, caught, &dispersion));
        let cells = [0, 1].map(|h| Cells::new(tree, &chosen[h], accel));
        let scatter = scatter(tree, caught);
        let [odd, even] = [0, 1].map(|h| reconstruct(tree, &cells[h], caught[h], [&dispersion, &scatter], accel));
        let mut starts: Vec<usize> = chosen.iter().flat_map(|c| c.cells.iter().map(|n| n.elements.start)).collect();
        starts.sort_unstable();
        let border_inside = |n: &Node| {
            let after = starts.partition_point(|&s| s <= n.elements.start);
            starts.get(after).is_some_and(|&s| s < n.elements.end)
        };
        let blocks = tree.cut(|n| !border_inside(n));
        Reconstruction {
            values: [odd.0, even.0],
            sides: [odd.1, even.1],
            blocks,
            cells: [0, 1].map(|h| cells[h].len()),
            cell_of: cells[0].by_element(),
        }
    }

    /// Every element by its own photons alone: unbiased, and as noisy as that.
    pub fn raw(tree: &SurfaceTree, caught: [&Caught; 2]) -> Reconstruction {
        let values =
            caught.map(|c| tree.elements.iter().zip(&c.flux).map(|(e, f)| Vec3::from(*f) / e.area).collect::<Vec<_>>());
        let blocks = tree.cut(|n| n.elements.len() <= RAW_BLOCK);
        Reconstruction {
            values,
            sides: [0, 1].map(|_| vec![0.0; tree.elements.len()]),
            blocks,
            cells: [tree.elements.len(); 2],
            cell_of: Vec::new(),
        }
    }
}
