//! The eight-wide hierarchy as it lies in memory: nodes of eight boxes, leaves of up to eight triangles.
//!
//! Both are stored by component (all eight minima in x, then all eight maxima in x, ...), so that one vector
//! instruction serves eight children. Boxes are plain f32 and not widened: the padding that makes traversal
//! conservative depends on the ray and is added there.

use glam::Vec3;

/// Children of a node, and triangles of a leaf.
pub(super) const WIDTH: usize = 8;

/// Deepest path from the root to a leaf, in nodes. The builder keeps to it, so a traversal never holds more
/// than `(WIDTH - 1) * MAX_DEPTH` postponed children.
pub(super) const MAX_DEPTH: usize = 32;

/// Eight boxes with what lies in them; 256 bytes.
#[repr(C, align(64))]
#[derive(Debug, Clone)]
pub(super) struct Node {
    /// Rows min x, max x, min y, max y, min z, max z; the box of an empty slot is inside out.
    pub bounds: [[f32; WIDTH]; 6],
    /// What is in each box.
    pub children: [Child; WIDTH],
}

impl Node {
    /// A node all of whose slots are empty.
    pub fn empty() -> Node {
        let (lo, hi) = ([f32::INFINITY; WIDTH], [f32::NEG_INFINITY; WIDTH]);
        Node { bounds: [lo, hi, lo, hi, lo, hi], children: [Child::node(0); WIDTH] }
    }

    /// Puts `child` with its box into a slot.
    pub fn set(&mut self, slot: usize, bounds: &Bounds, child: Child) {
        for axis in 0..3 {
            self.bounds[2 * axis][slot] = bounds.min[axis];
            self.bounds[2 * axis + 1][slot] = bounds.max[axis];
        }
        self.children[slot] = child;
    }
}

/// Reference to a node or a leaf: the top bit says which; a leaf also holds its number of triangles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Child(u32);

impl Child {
    const LEAF: u32 = 1 << 31;

    /// The node at `index`.
    pub fn node(index: usize) -> Child {
        assert!(index < 1 << 31, "a hierarchy of {index} nodes is beyond its 31 bits");
        Child(index as u32)
    }

    /// The leaf of `count` triangles (1 to [`WIDTH`]) at `packet`.
    pub fn leaf(packet: usize, count: usize) -> Child {
        assert!(packet < 1 << 28, "a hierarchy of {packet} leaves is beyond its 28 bits");
        debug_assert!((1..=WIDTH).contains(&count), "a leaf of {count} triangles");
        Child(Child::LEAF | (packet as u32) << 3 | (count as u32 - 1))
    }

    /// Index of the node, unless this is a leaf.
    #[inline(always)]
    pub fn as_node(self) -> Option<usize> {
        (self.0 & Child::LEAF == 0).then_some(self.0 as usize)
    }

    /// Index of the packet of a leaf.
    #[inline(always)]
    pub fn packet(self) -> usize {
        ((self.0 & !Child::LEAF) >> 3) as usize
    }

    /// Bit mask of the packet's lanes that hold a triangle.
    #[inline(always)]
    pub fn lanes(self) -> u32 {
        (2 << (self.0 & 7)) - 1
    }
}

/// Up to eight triangles of a leaf; 320 bytes.
#[repr(C, align(64))]
#[derive(Debug, Clone)]
pub(super) struct Packet {
    /// Coordinates by corner, axis, lane; zero in unused lanes.
    pub corners: [[[f32; WIDTH]; 3]; 3],
    /// Triangle ids, ascending; 0 in unused lanes.
    pub ids: [u32; WIDTH],
}

impl Packet {
    /// The triangles `ids` (at most [`WIDTH`], ascending).
    pub fn new(triangles: &[[Vec3; 3]], ids: &[u32]) -> Packet {
        let mut packet = Packet { corners: [[[0.0; WIDTH]; 3]; 3], ids: [0; WIDTH] };
        for (lane, &id) in ids.iter().enumerate() {
            packet.ids[lane] = id;
            for (corner, p) in triangles[id as usize].iter().enumerate() {
                for axis in 0..3 {
                    packet.corners[corner][axis][lane] = p[axis];
                }
            }
        }
        packet
    }
}

/// An axis-aligned box.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    pub min: Vec3,
    pub max: Vec3,
}

impl Bounds {
    /// The box around nothing.
    pub const EMPTY: Bounds = Bounds { min: Vec3::INFINITY, max: Vec3::NEG_INFINITY };

    /// The box around a triangle.
    pub fn of(triangle: &[Vec3; 3]) -> Bounds {
        let [a, b, c] = *triangle;
        Bounds { min: a.min(b).min(c), max: a.max(b).max(c) }
    }

    /// Lower and upper corner as bits, to sort and to compare by.
    pub fn bits(&self) -> [[u32; 3]; 2] {
        [self.min, self.max].map(|p| p.to_array().map(f32::to_bits))
    }

    /// The box around both.
    pub fn union(self, other: Bounds) -> Bounds {
        Bounds { min: self.min.min(other.min), max: self.max.max(other.max) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layout_is_whole_cache_lines() {
        assert_eq!(size_of::<Node>(), 256);
        assert_eq!(size_of::<Packet>(), 320);
    }

    #[test]
    fn children_keep_what_they_were_given() {
        assert_eq!(Child::node(12345).as_node(), Some(12345));
        for count in 1..=WIDTH {
            let leaf = Child::leaf((1 << 28) - 1, count);
            assert_eq!(leaf.as_node(), None);
            assert_eq!(leaf.packet(), (1 << 28) - 1);
            assert_eq!(leaf.lanes().count_ones() as usize, count);
            assert_eq!(leaf.lanes().trailing_ones() as usize, count);
        }
    }
}
