//! The walk through the hierarchy, one for every question and every kernel.

use super::Hit;
use super::kernel::{Kernel, Lanes, ScalarLanes};
use super::ray::{FAR_FACTOR, PreparedRay};
use super::triangle::{Crossing, intersect};
use super::wide::{Child, MAX_DEPTH, Node, Packet, WIDTH};
use std::mem::MaybeUninit;
use std::ops::ControlFlow;

/// A question asked of all triangles along a ray.
pub(super) trait Query {
    /// True if near boxes should come first.
    const NEAREST_FIRST: bool;

    /// Boxes entered beyond this distance cannot matter any more.
    fn limit(&self) -> f32;

    /// Takes a crossing; `Break` ends the walk.
    fn cross(&mut self, crossing: Crossing) -> ControlFlow<()>;
}

/// The nearest crossing.
pub(super) struct Closest {
    end: f32,
    best: Option<Crossing>,
}

impl Closest {
    pub fn new(ray: &PreparedRay) -> Closest {
        Closest { end: ray.end, best: None }
    }

    pub fn hit(&self, ray: &PreparedRay) -> Option<Hit> {
        self.best.map(|crossing| crossing.hit(ray))
    }
}

impl Query for Closest {
    const NEAREST_FIRST: bool = true;

    #[inline(always)]
    fn limit(&self) -> f32 {
        // A box entered at this very distance may hold a triangle of lower id.
        self.end
    }

    #[inline(always)]
    fn cross(&mut self, crossing: Crossing) -> ControlFlow<()> {
        if self.best.is_none_or(|best| crossing.precedes(&best)) {
            self.end = crossing.t;
            self.best = Some(crossing);
        }
        ControlFlow::Continue(())
    }
}

/// Whether there is any crossing.
pub(super) struct Any {
    pub end: f32,
}

impl Query for Any {
    const NEAREST_FIRST: bool = false;

    #[inline(always)]
    fn limit(&self) -> f32 {
        self.end
    }

    #[inline(always)]
    fn cross(&mut self, _: Crossing) -> ControlFlow<()> {
        ControlFlow::Break(())
    }
}

/// Every crossing, in no order.
pub(super) struct Each<'r, F> {
    pub ray: &'r PreparedRay,
    pub visit: F,
}

impl<F: FnMut(Hit) -> ControlFlow<()>> Query for Each<'_, F> {
    const NEAREST_FIRST: bool = false;

    #[inline(always)]
    fn limit(&self) -> f32 {
        self.ray.end
    }

    #[inline(always)]
    fn cross(&mut self, crossing: Crossing) -> ControlFlow<()> {
        (self.visit)(crossing.hit(self.ray))
    }
}

/// Asks `query` of the triangles along `ray`. True if the query broke the walk off.
#[inline]
pub(super) fn trace<Q: Query>(
    kernel: Kernel,
    nodes: &[Node],
    packets: &[Packet],
    ray: &PreparedRay,
    query: &mut Q,
) -> bool {
    match kernel {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: this kernel is only ever set after its instructions were found.
        #[allow(unsafe_code)]
        Kernel::Avx2 => unsafe { walk_avx2(nodes, packets, ray, query) },
        _ => walk(&ScalarLanes(ray), nodes, packets, ray, query),
    }
}

/// [`walk`] compiled for AVX2 as a whole: a call across the boundary in the loop would cost more than it gains.
///
/// # Safety
/// The processor must have AVX2 and BMI1.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,bmi1")]
#[allow(unsafe_code)]
unsafe fn walk_avx2<Q: Query>(nodes: &[Node], packets: &[Packet], ray: &PreparedRay, query: &mut Q) -> bool {
    // SAFETY: AVX2 is promised by the caller.
    let lanes = unsafe { super::kernel::Avx2Lanes::new(ray) };
    walk(&lanes, nodes, packets, ray, query)
}

#[inline(always)]
fn walk<L: Lanes, Q: Query>(lanes: &L, nodes: &[Node], packets: &[Packet], ray: &PreparedRay, query: &mut Q) -> bool {
    if nodes.is_empty() {
        return false;
    }
    let mut postponed = Stack::new();
    let mut next = Child::node(0);
    loop {
        if let Some(index) = next.as_node() {
            let node = &nodes[index];
            let (mask, distances) = lanes.enter(node, query.limit());
            if mask != 0 {
                next = postpone::<Q>(&mut postponed, node, mask, &distances);
                continue;
            }
        } else {
            let packet = &packets[next.packet()];
            let mut mask = lanes.may_hit(packet) & next.lanes();
            while mask != 0 {
                let crossing = intersect(ray, packet, take_lowest(&mut mask));
                if let Some(crossing) = crossing
                    && query.cross(crossing).is_break()
                {
                    return true;
                }
            }
        }
        let limit = query.limit() * FAR_FACTOR;
        next = loop {
            match postponed.pop() {
                None => return false,
                Some((distance, child)) if distance <= limit => break child,
                Some(_) => {}
            }
        };
    }
}

/// Puts the children in `mask` (not 0) on the stack but for one, which is returned: the nearest, if that is asked.
#[inline(always)]
fn postpone<Q: Query>(postponed: &mut Stack, node: &Node, mut mask: u32, distances: &[f32; WIDTH]) -> Child {
    let first = take_lowest(&mut mask);
    let mut nearest = (distances[first], node.children[first]);
    if mask == 0 {
        return nearest.1;
    }
    let base = postponed.len;
    while mask != 0 {
        let slot = take_lowest(&mut mask);
        let mut entry = (distances[slot], node.children[slot]);
        if Q::NEAREST_FIRST {
            if entry.0 < nearest.0 {
                std::mem::swap(&mut entry, &mut nearest);
            }
            postponed.insert(base, entry);
        } else {
            postponed.push(entry);
        }
    }
    nearest.1
}

/// Index of the lowest bit of `mask` (not 0), which is cleared.
#[inline(always)]
fn take_lowest(mask: &mut u32) -> usize {
    let lowest = mask.trailing_zeros() as usize;
    *mask &= *mask - 1;
    lowest
}

/// Children still to be visited, with their entry distances. The builder bounds the depth of the hierarchy, so
/// the array never overflows; it is not cleared, which would cost as much as a short ray.
struct Stack {
    len: usize,
    entries: [MaybeUninit<(f32, Child)>; (WIDTH - 1) * MAX_DEPTH],
}

#[allow(unsafe_code)]
impl Stack {
    #[inline(always)]
    fn new() -> Stack {
        Stack { len: 0, entries: [const { MaybeUninit::uninit() }; (WIDTH - 1) * MAX_DEPTH] }
    }

    #[inline(always)]
    fn push(&mut self, entry: (f32, Child)) {
        self.entries[self.len].write(entry);
        self.len += 1;
    }

    /// Inserts into the part from `base` on, which is sorted with the nearest on top.
    #[inline(always)]
    fn insert(&mut self, base: usize, entry: (f32, Child)) {
        let mut at = self.len;
        while at > base {
            // SAFETY: entries below `len` have been written.
            let below = unsafe { self.entries[at - 1].assume_init() };
            if below.0 >= entry.0 {
                break;
            }
            self.entries[at].write(below);
            at -= 1;
        }
        self.entries[at].write(entry);
        self.len += 1;
    }

    #[inline(always)]
    fn pop(&mut self) -> Option<(f32, Child)> {
        self.len = self.len.checked_sub(1)?;
        // SAFETY: entries below the former `len` have been written.
        Some(unsafe { self.entries[self.len].assume_init() })
    }
}
