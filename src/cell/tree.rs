//! All surface in one binary tree: texels near in place and alike in direction stand near in it.
//!
//! The tree knows nothing of charts. A wall cut into ten charts, a sphere of a thousand facets and a shelf of
//! small boxes are all split the same way: first by normal, until what is left faces one way, then in the
//! middle of the longest side, or in a gap near the middle, where no surface is.

use crate::accel::{Accel, Ray, offset_origin};
use crate::atlas::{TexelSampler, Texels};
use crate::light::{Visibility, cover_height};
use crate::sampling::orthonormal_basis;
use glam::Vec3;
use rayon::prelude::*;
use std::ops::Range;

/// A texel as a piece of surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Element {
    /// Centroid of the surface mapped to the texel [frame units].
    pub position: Vec3,
    /// Unit mean normal of the receiving side.
    pub normal: Vec3,
    /// Open surface area [frame units squared], > 0.
    pub area: f32,
    /// Index into [`Texels::texels`].
    pub texel: u32,
    /// What surrounds it.
    pub setting: Setting,
}

/// What surrounds a texel. Those of different settings have nothing to do with each other's light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Setting {
    /// Open space.
    Free,
    /// Another surface just above.
    Under,
    /// A wall that stands on it.
    Astride,
}

/// A node with more spread of normals than this, along any axis, is split by normal: 0.7 parts the sides of a
/// box but not the facets of a smooth shape of 40 degrees.
const MAX_NORMAL_EXTENT: f32 = 0.7;

/// Surface at two heights over its own plane is split there first where they are further apart than this many sides
/// of a texel, ...
const LEAST_STEP: f32 = 1.5;

/// ... than this share of the node's width, ...
const THICK: f32 = 0.1;

/// ... and the gap is at least this share of its thickness.
const LEAST_GAP: f32 = 0.2;

/// Of the side of a whole texel; its border is at 0.5.
const REACH: f32 = 0.4;

/// Coverage from which on a texel is whole.
const WHOLE: f32 = 0.999;

/// Subtrees of more elements than this are worked on in parallel.
const PARALLEL: usize = 4096;

/// A binary tree over the open surface of the map, down to single texels.
///
/// Nodes stand in preorder. Node `n` of `k` elements has its left child, of the first `m` of them, at `n + 1` and
/// its right child at `n + 2 m`, for a subtree of `m` elements takes `2 m - 1` nodes.
#[derive(Debug, Clone, Default)]
pub struct SurfaceTree {
    /// The elements in the order of the leaves.
    pub elements: Vec<Element>,
    /// First element of the right child per node; its own for leaves.
    middle: Vec<u32>,
}

/// A node and the elements under it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// Index in preorder.
    pub index: usize,
    /// Elements under it.
    pub elements: Range<usize>,
}

impl SurfaceTree {
    /// The tree over the texels of the map with open surface. `open` is the open share of each texel's area.
    ///
    /// The root's first child has the surface that is open to its surroundings, its second child what is not. A
    /// texel that a wall stands on has light of both sides and belongs to neither. Nor has a sheet that lies just
    /// under another anything to do with that one's light, though it is as near as the next texel.
    pub fn new(texels: &Texels, open: &[f32], visibility: &Visibility) -> SurfaceTree {
        let elements: Vec<Element> = (0..texels.mapped)
            .into_par_iter()
            .map_init(TexelSampler::default, |sampler, i| {
                let t = &texels.texels[i];
                sampler.load(texels, i);
                let (position, normal) = sampler.centre(visibility.world);
                let normal = if t.back { -normal } else { normal };
                let setting = Setting::Free;
                let mut e = Element { position, normal, area: t.area * open[i], texel: i as u32, setting };
                // Where a border cuts a texel it is not known how far it reaches.
                if open[i] == 1.0 && t.coverage > WHOLE && astride(&e, visibility.accel) {
                    e.setting = Setting::Astride;
                } else if under(&e, visibility) {
                    e.setting = Setting::Under;
                }
                e
            })
            .filter(|e| e.area > 0.0)
            .collect();
        SurfaceTree::of(elements)
    }

    /// The tree over some elements.
    pub fn of(mut elements: Vec<Element>) -> SurfaceTree {
        elements.sort_by_key(|e| e.setting);
        let count = |of: Setting| elements.iter().filter(|e| e.setting == of).count();
        let parts = [Setting::Free, Setting::Under, Setting::Astride].map(count);
        let mut middle = vec![0; (2 * elements.len()).saturating_sub(1)];
        build_parts(&mut elements, &mut middle, 0, &parts);
        SurfaceTree { elements, middle }
    }

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.middle.len()
    }

    /// True without any surface.
    pub fn is_empty(&self) -> bool {
        self.middle.is_empty()
    }

    /// The node over all elements; the tree must not be empty.
    pub fn root(&self) -> Node {
        Node { index: 0, elements: 0..self.elements.len() }
    }

    /// The two children; `None` for a single element.
    pub fn children(&self, node: &Node) -> Option<[Node; 2]> {
        let Range { start, end } = node.elements;
        (end - start > 1).then(|| {
            let middle = self.middle[node.index] as usize;
            [
                Node { index: node.index + 1, elements: start..middle },
                Node { index: node.index + 2 * (middle - start), elements: middle..end },
            ]
        })
    }

    /// Folds the tree from its leaves up: `leaf` of an element, `join` of a node and its children's values. In
    /// parallel, but always in the same order.
    pub fn fold<T: Send>(
        &self,
        node: &Node,
        leaf: &(impl Fn(usize) -> T + Sync),
        join: &(impl Fn(&Node, T, T) -> T + Sync),
    ) -> T {
        let Some([a, b]) = self.children(node) else { return leaf(node.elements.start) };
        let (x, y) = if node.elements.len() > PARALLEL {
            rayon::join(|| self.fold(&a, leaf, join), || self.fold(&b, leaf, join))
        } else {
            (self.fold(&a, leaf, join), self.fold(&b, leaf, join))
        };
        join(node, x, y)
    }

    /// The topmost nodes for which `stop` holds, or single elements, in order.
    pub fn cut(&self, stop: impl Fn(&Node) -> bool) -> Vec<Node> {
        let mut found = Vec::new();
        let mut open: Vec<Node> = if self.is_empty() { Vec::new() } else { vec![self.root()] };
        while let Some(node) = open.pop() {
            match self.children(&node) {
                Some([a, b]) if !stop(&node) => open.extend([b, a]),
                _ => found.push(node),
            }
        }
        found
    }
}

/// Whether another surface, which light does not pass, lies less than a texel's side above the middle of a texel, and
/// not upon it: then the middle is buried, and light falls on what is open beside it.
fn under(e: &Element, visibility: &Visibility) -> bool {
    let above = visibility.opaque_above(offset_origin(e.position, e.normal, 1.0), e.normal, e.area.sqrt());
    above.is_some_and(|hit| hit.t > cover_height(e.area))
}

/// Whether something stands on the middle of a texel, which reaches at least [`REACH`] of its side to all sides.
fn astride(e: &Element, accel: &Accel) -> bool {
    let middle = offset_origin(e.position, e.normal, 1.0);
    let reach = REACH * e.area.sqrt();
    let (t, b) = orthonormal_basis(e.normal);
    let lifted = middle + e.normal * reach * 0.1;
    [t, b].iter().any(|&axis| {
        accel.occluded(&Ray { origin: lifted - axis * reach, direction: axis * (2.0 * reach), t_max: 1.0 })
    })
}

/// Writes the nodes of `elements`, which consist of `parts` that are to have subtrees for themselves.
fn build_parts(elements: &mut [Element], middle: &mut [u32], start: u32, parts: &[usize]) {
    match parts {
        _ if elements.is_empty() => {}
        [0, rest @ ..] => build_parts(elements, middle, start, rest),
        [first, rest @ ..] if *first < elements.len() => {
            middle[0] = start + *first as u32;
            let (a, b) = elements.split_at_mut(*first);
            let (left, right) = middle[1..].split_at_mut(2 * first - 1);
            build(a, left, start);
            build_parts(b, right, start + *first as u32, rest);
        }
        _ => build(elements, middle, start),
    }
}

/// Writes the nodes of `elements`, which begin at `start` of all, to `middle`.
fn build(elements: &mut [Element], middle: &mut [u32], start: u32) {
    match elements.len() {
        1 => middle[0] = start,
        n => {
            let m = partition(elements);
            let end = start + m as u32;
            middle[0] = end;
            let (a, b) = elements.split_at_mut(m);
            let (left, right) = middle[1..].split_at_mut(2 * m - 1);
            if n > PARALLEL {
                rayon::join(|| build(a, left, start), || build(b, right, end));
            } else {
                build(a, left, start);
                build(b, right, end);
            }
        }
    }
}

/// Sorts two or more elements into a first and a second part, both not empty; the length of the first.
fn partition(elements: &mut [Element]) -> usize {
    let (mut lo, mut hi) = ([Vec3::INFINITY; 2], [Vec3::NEG_INFINITY; 2]);
    for e in elements.iter() {
        lo = [lo[0].min(e.position), lo[1].min(e.normal)];
        hi = [hi[0].max(e.position), hi[1].max(e.normal)];
    }
    let sizes = [hi[0] - lo[0], hi[1] - lo[1]];
    let by_normal = sizes[1].max_element() > MAX_NORMAL_EXTENT || sizes[0].max_element() <= 0.0;
    let which = usize::from(by_normal);
    let axis = longest(sizes[which]);
    let step = if by_normal { None } else { step(elements, sizes[0].max_element()) };
    let m = if let Some((normal, plane)) = step {
        to_front(elements, |e| e.position.dot(normal) < plane)
    } else {
        let key = |e: &Element| if by_normal { e.normal[axis] } else { e.position[axis] };
        let plane = dividing_plane(elements, lo[which][axis], hi[which][axis], key).middle;
        to_front(elements, |e| key(e) < plane)
    };
    // Nothing to tell them apart by: halve them as they stand.
    if m == 0 || m == elements.len() { elements.len() / 2 } else { m }
}

/// Moves the elements that `first` holds for to the front; their number.
fn to_front(elements: &mut [Element], first: impl Fn(&Element) -> bool) -> usize {
    let mut m = 0;
    for i in 0..elements.len() {
        if first(&elements[i]) {
            elements.swap(i, m);
            m += 1;
        }
    }
    m
}

/// The plane between two sheets that lie above each other or beside a step, as a normal and a distance, if elements
/// `width` across do.
fn step(elements: &[Element], width: f32) -> Option<(Vec3, f32)> {
    let normal = elements.iter().map(|e| e.normal).sum::<Vec3>().normalize_or_zero();
    let height = |e: &Element| e.position.dot(normal);
    let (lo, hi) =
        elements.iter().map(height).fold((f32::INFINITY, f32::NEG_INFINITY), |r, h| (r.0.min(h), r.1.max(h)));
    let texel = (elements.iter().map(|e| e.area).sum::<f32>() / elements.len() as f32).sqrt();
    if hi - lo < (LEAST_STEP * texel).max(THICK * width) {
        return None;
    }
    let gap = dividing_plane(elements, lo, hi, height);
    (gap.length >= LEAST_STEP * texel && gap.length >= LEAST_GAP * (hi - lo)).then_some((normal, gap.middle))
}

fn longest(size: Vec3) -> usize {
    if size.x >= size.y && size.x >= size.z {
        0
    } else if size.y >= size.z {
        1
    } else {
        2
    }
}

/// An interval without elements.
struct Gap {
    middle: f32,
    length: f32,
}

/// The longest gap whose own middle lies in the middle half of `lo..hi`, the nearest to the middle
/// of equally long ones; none, in the middle, where there is no gap. Planes never run through a sheet of surface that
/// rounding has made uneven, for beside it there is a gap.
fn dividing_plane(elements: &[Element], lo: f32, hi: f32, key: impl Fn(&Element) -> f32) -> Gap {
    const SLOTS: usize = 32;
    let scale = SLOTS as f32 / (hi - lo);
    let mut filled = 0u32;
    for e in elements {
        filled |= 1 << (((key(e) - lo) * scale) as usize).min(SLOTS - 1);
    }
    // (length, minus the distance of its middle from the middle, its middle), in half slots.
    let mut best = (0, i32::MIN, SLOTS as i32);
    let mut k = 0;
    while k < SLOTS {
        let length = (!filled >> k).trailing_ones().min((SLOTS - k) as u32) as usize;
        if length > 0 {
            let middle = (2 * k + length) as i32;
            let off = (middle - SLOTS as i32).abs();
            if off <= SLOTS as i32 / 2 {
                best = best.max((length as i32, -off, middle));
            }
        }
        k += length.max(1);
    }
    Gap { middle: lo + best.2 as f32 * 0.5 / scale, length: best.0 as f32 / scale }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree_of(mut elements: Vec<Element>) -> SurfaceTree {
        let mut middle = vec![0; 2 * elements.len() - 1];
        build(&mut elements, &mut middle, 0);
        SurfaceTree { elements, middle }
    }

    fn element(texel: u32, position: Vec3, normal: Vec3) -> Element {
        Element { position, normal, area: 1.0, texel, setting: Setting::Free }
    }

    #[test]
    fn children_share_out_their_parents_elements() {
        let grid = (0..700).map(|i| element(i, Vec3::new((i % 31) as f32, 0.0, (i / 31) as f32), Vec3::Y)).collect();
        let tree = tree_of(grid);
        let (mut seen, mut leaves) = (0, vec![false; 700]);
        let mut open = vec![tree.root()];
        while let Some(node) = open.pop() {
            seen += 1;
            match tree.children(&node) {
                Some([a, b]) => {
                    assert_eq!((a.elements.start, a.elements.end), (node.elements.start, b.elements.start));
                    assert_eq!(b.elements.end, node.elements.end);
                    assert!(!a.elements.is_empty() && !b.elements.is_empty());
                    open.extend([a, b]);
                }
                None => leaves[tree.elements[node.elements.start].texel as usize] = true,
            }
        }
        assert_eq!(seen, tree.len());
        assert!(leaves.iter().all(|&l| l));
        let count = tree.fold(&tree.root(), &|_| 1, &|node, a, b| {
            assert_eq!(node.elements.len(), a + b);
            a + b
        });
        assert_eq!(count, 700);
    }

    #[test]
    fn faces_of_a_box_come_apart_first() {
        let normals = [Vec3::X, Vec3::Y, Vec3::NEG_X, Vec3::NEG_Y];
        let at = |i: u32| Vec3::new((i % 7) as f32, (i % 5) as f32, (i % 3) as f32);
        // Rounding leaves normals a hair off the axes.
        let tilt = |i: u32| Vec3::splat(1e-7 * (i % 2) as f32 - 5e-8);
        let tree = tree_of((0..400).map(|i| element(i, at(i), normals[i as usize % 4] + tilt(i))).collect());
        let faces = tree.cut(|node| {
            let first = tree.elements[node.elements.start].normal;
            tree.elements[node.elements.clone()].iter().all(|e| e.normal.dot(first) > 0.9)
        });
        assert_eq!(faces.len(), 4);
    }

    #[test]
    fn a_plane_lies_in_a_gap_and_not_in_a_sheet() {
        let at = |x: f32| element(0, Vec3::new(x, 0.0, 0.0), Vec3::Y);
        let sheets: Vec<Element> = [0.0, 0.5 - 1e-7, 0.5 + 1e-7, 1.0].map(at).to_vec();
        let plane = dividing_plane(&sheets, 0.0, 1.0, |e| e.position.x).middle;
        assert!((plane - 0.5).abs() > 0.1, "{plane}");
        let dense: Vec<Element> = (0..1000).map(|i| at(i as f32 / 999.0)).collect();
        assert_eq!(dividing_plane(&dense, 0.0, 1.0, |e| e.position.x).middle, 0.5);
    }

    #[test]
    fn sheets_above_each_other_come_apart_first() {
        // 40 x 40 texels of side 1, and 10 x 10 more 5 above their middle.
        let sheet = |n: u32, corner: f32, height: f32| {
            (0..n * n)
                .map(move |i| element(i, Vec3::new(corner + (i % n) as f32, height, corner + (i / n) as f32), Vec3::Y))
        };
        let tree = tree_of(sheet(40, 0.0, 0.0).chain(sheet(10, 15.0, 5.0)).collect());
        let level = |n: &Node| {
            let first = tree.elements[n.elements.start].position.y;
            tree.elements[n.elements.clone()].iter().all(|e| e.position.y == first)
        };
        assert_eq!(tree.cut(level).len(), 2);
        // What is low for its width, as tiles of a floor are, is split as if it were flat.
        let tree = tree_of(sheet(40, 0.0, 0.0).chain(sheet(10, 15.0, 2.0)).collect());
        let halves = tree.children(&tree.root()).unwrap();
        assert!(halves.iter().all(|n| n.elements.len() > 400));
    }

    #[test]
    fn what_cannot_be_told_apart_is_halved() {
        let tree = tree_of((0..33).map(|i| element(i, Vec3::ONE, Vec3::Z)).collect());
        assert_eq!(tree.len(), 65);
        assert_eq!(tree.cut(|n| n.elements.len() <= 8).len(), 5);
    }
}
