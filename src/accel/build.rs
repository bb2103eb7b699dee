//! Builds the eight-wide hierarchy: obvhs makes a binary one, which is collapsed.
//!
//! obvhs is given boxes alone, one for all triangles of the same box (the halves of an axis-aligned quad; a thousand
//! copies of a mesh at one place, over which it would spend quadratic time), scaled by a power of two so that no
//! area over- or underflows. It decides the topology; the boxes of the result are those of the triangles.

use super::wide::{Bounds, Child, MAX_DEPTH, Node, Packet, WIDTH};
use glam::Vec3;
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::{Bvh2, builder::build_bvh2};
use obvhs::ploc::{PlocSearchDistance, SortPrecision};
use rayon::prelude::*;
use std::time::Duration;

/// No triangle is split, since each must be met once; leaves are made here. A search distance of 24 from the first
/// round on: with that of 1 for the first two rounds, as in the presets, rays took up to 1.6 times the steps on regular
/// meshes. Reinserting more than 0.1 of the nodes saves rays 1 to 5 % and doubles the time on a million triangles.
const PARAMETERS: BvhBuildParams = BvhBuildParams {
    pre_split: false,
    ploc_search_distance: PlocSearchDistance::High,
    search_depth_threshold: 0,
    reinsertion_batch_ratio: 0.1,
    post_collapse_reinsertion_batch_ratio_multiplier: 0.0,
    sort_precision: SortPrecision::U64,
    max_prims_per_leaf: 1,
    collapse_traversal_cost: 1.0,
};

/// Nodes (root first), leaves and the largest |coordinate| of the triangles that are finite and not skipped. Without
/// any such triangle there is no node.
pub(super) fn build(triangles: &[[Vec3; 3]], skip: impl Fn(u32) -> bool) -> (Vec<Node>, Vec<Packet>, f32) {
    let bounds: Vec<Bounds> = triangles.par_iter().map(Bounds::of).collect();
    let mut order: Vec<u32> = (0..triangles.len() as u32)
        .filter(|&id| triangles[id as usize].iter().all(|p| p.is_finite()) && !skip(id))
        .collect();
    if order.is_empty() {
        return (Vec::new(), Vec::new(), 0.0);
    }
    let extent = order.iter().fold(0.0f32, |m, &id| {
        m.max(triangles[id as usize].map(|p| p.abs().max_element()).into_iter().fold(0.0, f32::max))
    });

    let bits = |id: u32| bounds[id as usize].bits();
    order.par_sort_unstable_by_key(|&id| (bits(id), id));
    let groups: Vec<&[u32]> = order.chunk_by(|&a, &b| bits(a) == bits(b)).collect();
    // The exponent bits alone are the power of two below; a subnormal extent has none and is scaled like the least.
    let unit = f64::from(f32::from_bits(extent.to_bits() & 0x7f80_0000).max(f32::MIN_POSITIVE));
    let scaled = |p: Vec3| (p.as_dvec3() / unit).as_vec3a();
    let boxes: Vec<Aabb> =
        groups.iter().map(|group| bounds[group[0] as usize]).map(|b| Aabb::new(scaled(b.min), scaled(b.max))).collect();
    let binary = build_bvh2(&boxes, PARAMETERS, &mut Duration::default());

    let mut collapse = Collapse {
        triangles,
        bounds: &bounds,
        groups: &groups,
        counts: Vec::new(),
        binary: &binary,
        nodes: Vec::new(),
        packets: Vec::new(),
    };
    collapse.count();
    collapse.emit_root();
    let Collapse { nodes, packets, .. } = collapse;
    (nodes, packets, extent)
}

/// What is to become a child: a part of the binary hierarchy, or a list of triangles.
enum Part {
    Binary(u32),
    List(Vec<u32>),
}

struct Collapse<'a> {
    triangles: &'a [[Vec3; 3]],
    bounds: &'a [Bounds],
    /// Triangle ids of each primitive of the binary hierarchy.
    groups: &'a [&'a [u32]],
    binary: &'a Bvh2,
    /// Triangles under each node of the binary hierarchy.
    counts: Vec<u32>,
    nodes: Vec<Node>,
    packets: Vec<Packet>,
}

impl Collapse<'_> {
    /// Fills `counts`, without recursion: a binary hierarchy can be as deep as it has leaves.
    fn count(&mut self) {
        self.counts = vec![0; self.binary.nodes.len()];
        let mut below = Vec::with_capacity(self.binary.nodes.len());
        let mut open = vec![0u32];
        while let Some(index) = open.pop() {
            below.push(index);
            let node = &self.binary.nodes[index as usize];
            if !node.is_leaf() {
                open.extend([node.first_index, node.first_index + 1]);
            }
        }
        // Parents were met before their children.
        for &index in below.iter().rev() {
            let node = &self.binary.nodes[index as usize];
            let first = node.first_index as usize;
            self.counts[index as usize] = if node.is_leaf() {
                self.leaf_groups(index).map(|group| group.len() as u32).sum()
            } else {
                self.counts[first] + self.counts[first + 1]
            };
        }
    }

    /// The groups in a leaf of the binary hierarchy.
    fn leaf_groups(&self, index: u32) -> impl Iterator<Item = &[u32]> {
        let node = &self.binary.nodes[index as usize];
        let first = node.first_index as usize;
        self.binary.primitive_indices[first..first + node.prim_count as usize].iter().map(|&g| self.groups[g as usize])
    }

    /// All triangles under a node of the binary hierarchy, in its order.
    fn list(&self, index: u32) -> Vec<u32> {
        let mut ids = Vec::with_capacity(self.counts[index as usize] as usize);
        let mut open = vec![index];
        while let Some(index) = open.pop() {
            let node = &self.binary.nodes[index as usize];
            if node.is_leaf() {
                self.leaf_groups(index).for_each(|group| ids.extend_from_slice(group));
            } else {
                open.extend([node.first_index + 1, node.first_index]);
            }
        }
        ids
    }

    fn emit_root(&mut self) {
        if self.counts[0] as usize <= WIDTH {
            let (child, bounds) = self.emit_leaf(self.list(0));
            let mut root = Node::empty();
            root.set(0, &bounds, child);
            self.nodes.push(root);
        } else {
            self.emit(Part::Binary(0), 1);
        }
    }

    /// Writes the node of a part of more than [`WIDTH`] triangles, and all below. `depth` counts nodes from the root,
    /// which has depth 1.
    fn emit(&mut self, part: Part, depth: usize) -> (Child, Bounds) {
        let parts = match part {
            Part::Binary(index) => self.open(index),
            Part::List(ids) => split(&ids),
        };
        let mut whole = Bounds::EMPTY;
        let at = self.nodes.len();
        self.nodes.push(Node::empty());
        for (slot, part) in parts.into_iter().enumerate() {
            let (child, bounds) = match part {
                Part::List(ids) if ids.len() <= WIDTH => self.emit_leaf(ids),
                Part::List(ids) => self.emit(Part::List(ids), depth + 1),
                Part::Binary(index) => {
                    let count = self.counts[index as usize] as usize;
                    if count <= WIDTH {
                        self.emit_leaf(self.list(index))
                    } else if self.is_single(index) || depth + list_depth(count) >= MAX_DEPTH {
                        self.emit(Part::List(self.list(index)), depth + 1)
                    } else {
                        self.emit(Part::Binary(index), depth + 1)
                    }
                }
            };
            self.nodes[at].set(slot, &bounds, child);
            whole = whole.union(bounds);
        }
        (Child::node(at), whole)
    }

    fn is_single(&self, index: u32) -> bool {
        self.binary.nodes[index as usize].is_leaf()
    }

    /// Up to [`WIDTH`] parts of the binary hierarchy that together are the one at `index`: the largest that is more
    /// than a leaf is opened again and again (Wald, Benthin and Boulos, Getting Rid of Packets, 2008).
    fn open(&self, index: u32) -> Vec<Part> {
        if self.is_single(index) {
            return split(&self.list(index));
        }
        let mut parts = vec![index];
        while parts.len() < WIDTH {
            let mut largest: Option<(usize, f32)> = None;
            for (k, &part) in parts.iter().enumerate() {
                let area = self.binary.nodes[part as usize].aabb().half_area();
                let opens = !self.is_single(part) && self.counts[part as usize] as usize > WIDTH;
                if opens && largest.is_none_or(|(_, best)| area > best) {
                    largest = Some((k, area));
                }
            }
            let Some((k, _)) = largest else { break };
            let first = self.binary.nodes[parts[k] as usize].first_index;
            parts[k] = first;
            parts.insert(k + 1, first + 1);
        }
        parts.into_iter().map(Part::Binary).collect()
    }

    fn emit_leaf(&mut self, mut ids: Vec<u32>) -> (Child, Bounds) {
        ids.sort_unstable();
        let bounds = ids.iter().fold(Bounds::EMPTY, |b, &id| b.union(self.bounds[id as usize]));
        let child = Child::leaf(self.packets.len(), ids.len());
        self.packets.push(Packet::new(self.triangles, &ids));
        (child, bounds)
    }
}

/// Depth in nodes of a list of `count` triangles split evenly.
fn list_depth(count: usize) -> usize {
    let mut depth = 0;
    let mut held = WIDTH;
    while held < count {
        held = held.saturating_mul(WIDTH);
        depth += 1;
    }
    depth
}

/// Splits more than [`WIDTH`] triangles into up to [`WIDTH`] runs of full leaves, as even as that allows.
fn split(ids: &[u32]) -> Vec<Part> {
    let leaves_per_part = WIDTH.pow(list_depth(ids.len()) as u32 - 1);
    ids.chunks(leaves_per_part * WIDTH).map(|run| Part::List(run.to_vec())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Small triangles at given places.
    fn triangles_at(places: impl Iterator<Item = Vec3>, size: f32) -> Vec<[Vec3; 3]> {
        places.map(|p| [p, p + Vec3::X * size, p + Vec3::Y * size]).collect()
    }

    /// Depth; checks on the way that every triangle is there once, within all boxes above it.
    fn checked_depth(triangles: &[[Vec3; 3]], nodes: &[Node], packets: &[Packet]) -> usize {
        let mut met = vec![0; triangles.len()];
        let mut deepest = 0;
        let everywhere = Bounds { min: Vec3::NEG_INFINITY, max: Vec3::INFINITY };
        let mut open = vec![(Child::node(0), 0, everywhere)];
        while let Some((child, depth, within)) = open.pop() {
            if let Some(index) = child.as_node() {
                let node = &nodes[index];
                deepest = deepest.max(depth + 1);
                for slot in 0..WIDTH {
                    let row = |k: usize| node.bounds[k][slot];
                    let bounds =
                        Bounds { min: Vec3::new(row(0), row(2), row(4)), max: Vec3::new(row(1), row(3), row(5)) };
                    if bounds.min.x <= bounds.max.x {
                        assert!(bounds.min.cmpge(within.min).all() && bounds.max.cmple(within.max).all());
                        open.push((node.children[slot], depth + 1, bounds));
                    }
                }
            } else {
                let packet = &packets[child.packet()];
                for lane in 0..child.lanes().count_ones() as usize {
                    let id = packet.ids[lane] as usize;
                    met[id] += 1;
                    for p in triangles[id] {
                        assert!(p.cmpge(within.min).all() && p.cmple(within.max).all());
                    }
                }
            }
        }
        assert!(met.iter().all(|&n| n == 1), "every triangle must be in one leaf");
        deepest
    }

    fn checked_build(triangles: &[[Vec3; 3]]) -> usize {
        let (nodes, packets, _) = build(triangles, |_| false);
        checked_depth(triangles, &nodes, &packets)
    }

    #[test]
    fn depth_stays_bounded() {
        for count in [1, 2, 8, 9, 64, 65, 512, 513] {
            assert_eq!(checked_build(&triangles_at((0..count).map(|_| Vec3::ONE), 0.5)), list_depth(count).max(1));
        }
        // Copies at ten places; triangles nested into each other, over which obvhs builds a chain.
        assert!(checked_build(&triangles_at((0..20_000).map(|i| Vec3::X * (i % 10) as f32), 0.5)) <= MAX_DEPTH);
        let nested: Vec<_> = (1..2000).map(|i| [Vec3::ZERO, Vec3::X * i as f32, Vec3::Y * i as f32]).collect();
        assert!(checked_build(&nested) <= MAX_DEPTH);
    }

    #[test]
    fn hierarchy_does_not_depend_on_threads() {
        let mut x = 1u32;
        let mut random = move || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (x >> 8) as f32 / (1 << 24) as f32
        };
        let triangles = triangles_at((0..30_000).map(|_| Vec3::new(random(), random(), random())), 0.01);
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            let (nodes, packets, _) = pool.install(|| build(&triangles, |_| false));
            let children: Vec<_> = nodes.iter().map(|n| n.children).collect();
            let ids: Vec<_> = packets.iter().map(|p| p.ids).collect();
            (children, ids)
        };
        let one = run(1);
        assert!(one == run(2) && one == run(5));
    }

    #[test]
    fn sizes_at_the_ends_of_f32_are_built() {
        for scale in [1e-44f32, 1e-30, 1e30, 1e38] {
            let places = (0..100).map(|i| Vec3::new((i % 10) as f32, (i / 10) as f32, 0.0) * (0.1 * scale));
            checked_build(&triangles_at(places, 0.1 * scale));
        }
    }

    #[test]
    fn triangles_that_are_skipped_or_not_finite_are_left_out() {
        let mut triangles = triangles_at((0..20).map(|i| Vec3::X * i as f32), 0.5);
        triangles[3][1].y = f32::NAN;
        triangles[4][2].z = f32::INFINITY;
        let (_, packets, extent) = build(&triangles, |id| id == 19);
        let held: usize = packets.iter().map(|p| p.ids.iter().filter(|&&id| id != 0).count()).sum();
        assert_eq!((held, extent), (16, 18.5));
        assert!(build(&triangles, |_| true).0.is_empty());
        assert!(build(&[], |_| false).0.is_empty());
    }
}
