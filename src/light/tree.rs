//! A tree over area lights that picks one in proportion to about what it sends to a point.
//!
//! Bounds and importance as Conty Estevez and Kulla, "Importance sampling of many lights with adaptive tree
//! splitting", 2018, in the form of pbrt-v4's light bounds.

use glam::Vec3;

/// What the tree knows of one light or a group.
#[derive(Debug, Clone, Copy)]
pub struct LightBounds {
    /// Lower corner of the box around it.
    pub lo: Vec3,
    /// Upper corner.
    pub hi: Vec3,
    /// Power, in any unit, > 0.
    pub power: f32,
    /// Axis of the cone that holds all its normals.
    pub axis: Vec3,
    /// Cosine of that cone's half angle.
    pub cos_spread: f32,
    /// Emits to both sides.
    pub two_sided: bool,
    /// Emits to all directions (a point).
    pub all_around: bool,
}

/// A node of the binary tree that is built first.
#[derive(Debug, Clone, Copy)]
struct Node {
    bounds: LightBounds,
    /// Left child (the right one follows at `right`), or the light where `right` is 0.
    left: u32,
    right: u32,
}

/// Children of a node.
const WIDTH: usize = 4;

/// A number of each child, side by side: what is done to one is done to all at once.
type Lanes = [f32; WIDTH];

/// The children of a node of the tree that is drawn from; those that are not there have no power.
#[derive(Debug, Clone, Copy)]
struct Wide {
    centre: [Lanes; 3],
    axis: [Lanes; 3],
    power: Lanes,
    /// Squared radius of the sphere around the box, ...
    radius2: Lanes,
    /// ... and its radius and the square of that, a hair more, so that nothing at its border is judged unreachable.
    bound: Lanes,
    bound2: Lanes,
    cos_spread: Lanes,
    sin_spread: Lanes,
    /// 1 where it emits to both sides, or to all directions.
    two_sided: Lanes,
    all_around: Lanes,
    /// Where the children are: index of a [`Wide`], or of a light with [`LIGHT`] set.
    child: [u32; WIDTH],
}

/// Marks a child that is a light.
const LIGHT: u32 = 1 << 31;

impl Wide {
    const EMPTY: Wide = Wide {
        centre: [[0.0; WIDTH]; 3],
        axis: [[0.0; WIDTH]; 3],
        power: [0.0; WIDTH],
        radius2: [1.0; WIDTH],
        bound: [1.0; WIDTH],
        bound2: [1.0; WIDTH],
        cos_spread: [1.0; WIDTH],
        sin_spread: [0.0; WIDTH],
        two_sided: [0.0; WIDTH],
        all_around: [1.0; WIDTH],
        child: [0; WIDTH],
    };

    fn set(&mut self, lane: usize, bounds: &LightBounds, child: u32) {
        let radius = (bounds.hi - bounds.lo).length() * 0.5;
        let bound = radius * 1.001 + 1e-6;
        let centre = (bounds.lo + bounds.hi) * 0.5;
        for c in 0..3 {
            self.centre[c][lane] = centre[c];
            self.axis[c][lane] = bounds.axis[c];
        }
        self.power[lane] = bounds.power;
        self.radius2[lane] = (radius * radius).max(1e-12);
        (self.bound[lane], self.bound2[lane]) = (bound, bound * bound);
        self.cos_spread[lane] = bounds.cos_spread;
        self.sin_spread[lane] = (1.0 - bounds.cos_spread * bounds.cos_spread).max(0.0).sqrt();
        self.two_sided[lane] = f32::from(u8::from(bounds.two_sided));
        self.all_around[lane] = f32::from(u8::from(bounds.all_around));
        self.child[lane] = child;
    }
}

/// A group's box says little where its sphere is nearer than its radius: its squared distance in squared radii.
const NEAR: f32 = 4.0;

/// Groups that draws are taken from at most.
const MOST_GROUPS: usize = 64;

/// The tree. An empty one draws nothing.
#[derive(Debug, Default)]
pub struct LightTree {
    /// The first is the root.
    nodes: Vec<Wide>,
}

impl LightTree {
    /// Builds over `lights`; what [`draw`](Self::draw) finds are indices into it.
    pub fn new(lights: &[LightBounds]) -> LightTree {
        let mut tree = LightTree::default();
        let mut order: Vec<u32> = (0..lights.len() as u32).collect();
        if !order.is_empty() {
            let mut nodes = Vec::with_capacity(lights.len() * 2);
            build(&mut nodes, lights, &mut order);
            tree.widen(&nodes, 0);
        }
        tree
    }

    /// Adds the wide node over a binary one.
    fn widen(&mut self, nodes: &[Node], node: u32) -> u32 {
        let me = self.nodes.len();
        self.nodes.push(Wide::EMPTY);
        let mut children = vec![node];
        // The most powerful group is looked into first.
        let inner = |n: &u32| nodes[*n as usize].right != 0;
        while children.len() < WIDTH {
            let power = |&k: &usize| nodes[children[k] as usize].bounds.power;
            let groups = (0..children.len()).filter(|&k| inner(&children[k]));
            let Some(k) = groups.max_by(|a, b| power(a).total_cmp(&power(b)).then(b.cmp(a))) else { break };
            let Node { left, right, .. } = nodes[children[k] as usize];
            children.splice(k..=k, [left, right]);
        }
        for (lane, child) in children.into_iter().enumerate() {
            let at = if inner(&child) { self.widen(nodes, child) } else { nodes[child as usize].left | LIGHT };
            self.nodes[me].set(lane, &nodes[child as usize].bounds, at);
        }
        me as u32
    }

    /// Draws `count` lights for the point `p` with unit normal `n`, each in proportion to its probability but evenly
    /// spread (one in each of `count` strata, all moved by `u` in [0, 1)). Calls `visit` once for each light drawn,
    /// with one over the number of times that it is drawn on average, times how often it was.
    pub fn draw(&self, p: Vec3, n: Vec3, count: u32, u: f32, mut visit: impl FnMut(u32, f64)) {
        if self.nodes.is_empty() {
            return;
        }
        let mut groups = [(0, 0.0); MOST_GROUPS];
        let groups = self.groups((p, n), &mut groups);
        let total: f64 = groups.iter().map(|g| f64::from(g.1)).sum();
        // Draw k stands at k of the interval [0, count) of all groups, moved by u: those before a place are known there.
        let u = f64::from(u);
        let (mut from, mut before) = (0.0, 0);
        for &(node, importance) in groups.iter() {
            let width = f64::from(count) * (f64::from(importance) / total);
            let after = above(from + width - u);
            if after > before {
                self.descend(node, (from, width), (before, after), u, (p, n), &mut visit);
            }
            (from, before) = (from + width, after);
        }
    }

    /// Groups that hold all lights that can reach a point, with about the irradiance that each sends, > 0. In a group near
    /// or around the point may be a lamp at arm's length, or none: its children are looked at in its place.
    fn groups<'a>(&self, at: (Vec3, Vec3), groups: &'a mut [(u32, f32); MOST_GROUPS]) -> &'a [(u32, f32)] {
        // Those at the end of the array are still to be looked at.
        let (mut found, mut open) = (0, MOST_GROUPS - 1);
        groups[open].0 = 0;
        while open < MOST_GROUPS {
            let n = &self.nodes[groups[open].0 as usize];
            open += 1;
            let (importance, distance2) = importance(n, at.0, at.1);
            for lane in (0..WIDTH).filter(|&lane| importance[lane] > 0.0) {
                let child = n.child[lane];
                let near = distance2[lane] <= NEAR * n.bound2[lane];
                // Each of those still open may turn out to be so many.
                let room = open - found >= WIDTH * (MOST_GROUPS - open + 1) + WIDTH - lane;
                if near && child & LIGHT == 0 && room {
                    open -= 1;
                    groups[open].0 = child;
                } else {
                    groups[found] = (child, importance[lane]);
                    found += 1;
                }
            }
        }
        &groups[..found]
    }

    /// Draws `before` to `after` are in the part [`from`, `from + width`) of a node: its probability is `width` over the
    /// number of draws.
    fn descend(
        &self,
        node: u32,
        (mut from, width): (f64, f64),
        (mut before, after): (i32, i32),
        u: f64,
        at: (Vec3, Vec3),
        visit: &mut impl FnMut(u32, f64),
    ) {
        if node & LIGHT != 0 {
            visit(node & !LIGHT, f64::from(after - before) / width);
            return;
        }
        let n = &self.nodes[node as usize];
        let importance = importance(n, at.0, at.1).0.map(f64::from);
        let scale = width / ((importance[0] + importance[1]) + (importance[2] + importance[3]));
        for lane in (0..WIDTH).filter(|&lane| importance[lane] > 0.0) {
            let share = importance[lane] * scale;
            let end = above(from + share - u).min(after);
            if end > before {
                self.descend(n.child[lane], (from, share), (before, end), u, at, visit);
            }
            (from, before) = (from + share, end);
        }
    }
}

/// Adds the binary tree over the lights of `order`, its root first; where that is.
fn build(nodes: &mut Vec<Node>, lights: &[LightBounds], order: &mut [u32]) -> u32 {
    let me = nodes.len() as u32;
    let bounds = order.iter().map(|&i| lights[i as usize]).reduce(|a, b| merge(&a, &b)).expect("not empty");
    nodes.push(Node { bounds, left: order[0], right: 0 });
    if order.len() == 1 {
        return me;
    }
    let centre = |i: u32| lights[i as usize].lo + lights[i as usize].hi;
    let (lo, hi) =
        order.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), &i| (lo.min(centre(i)), hi.max(centre(i))));
    let extent = hi - lo;
    let axis = if extent.x >= extent.y && extent.x >= extent.z {
        0
    } else if extent.y >= extent.z {
        1
    } else {
        2
    };
    let middle = (lo[axis] + hi[axis]) * 0.5;
    order.sort_unstable_by(|&a, &b| centre(a)[axis].total_cmp(&centre(b)[axis]).then(a.cmp(&b)));
    let mut split = order.partition_point(|&i| centre(i)[axis] < middle);
    // A lopsided split is a deep tree; past one eighth the median is taken.
    if split < order.len() / 8 || split > order.len() - order.len() / 8 || split == 0 || split == order.len() {
        split = order.len() / 2;
    }
    let (a, b) = order.split_at_mut(split);
    let left = build(nodes, lights, a);
    let right = build(nodes, lights, b);
    nodes[me as usize].left = left;
    nodes[me as usize].right = right;
    me
}

fn merge(a: &LightBounds, b: &LightBounds) -> LightBounds {
    let (axis, cos_spread) = merge_cones(a, b);
    LightBounds {
        lo: a.lo.min(b.lo),
        hi: a.hi.max(b.hi),
        power: a.power + b.power,
        axis,
        cos_spread,
        two_sided: a.two_sided || b.two_sided,
        all_around: a.all_around || b.all_around,
    }
}

/// The cone around two cones.
fn merge_cones(a: &LightBounds, b: &LightBounds) -> (Vec3, f32) {
    let (ta, tb) = (libm::acosf(a.cos_spread.clamp(-1.0, 1.0)), libm::acosf(b.cos_spread.clamp(-1.0, 1.0)));
    let between = libm::acosf(a.axis.dot(b.axis).clamp(-1.0, 1.0));
    let pi = std::f32::consts::PI;
    if (between + tb).min(pi) <= ta {
        return (a.axis, a.cos_spread);
    }
    if (between + ta).min(pi) <= tb {
        return (b.axis, b.cos_spread);
    }
    let spread = (ta + between + tb) * 0.5;
    if spread >= pi {
        return (a.axis, -1.0);
    }
    let turn = spread - ta;
    let side = (b.axis - a.axis * a.axis.dot(b.axis)).normalize_or_zero();
    if side == Vec3::ZERO {
        return (a.axis, -1.0);
    }
    let axis = (a.axis * libm::cosf(turn) + side * libm::sinf(turn)).normalize();
    // A hair wider, against rounding.
    (axis, (libm::cosf(spread) - 1e-4).max(-1.0))
}

/// About the irradiance that each child sends to `p`, 0 only where it can send none; and its squared distance.
///
/// No branches, so that all are worked out together.
#[inline]
fn importance(node: &Wide, p: Vec3, n: Vec3) -> (Lanes, Lanes) {
    let (mut out, mut distance2) = ([0.0; WIDTH], [0.0; WIDTH]);
    for i in 0..WIDTH {
        let to = [node.centre[0][i] - p.x, node.centre[1][i] - p.y, node.centre[2][i] - p.z];
        let d2 = to[0] * to[0] + to[1] * to[1] + to[2] * to[2];
        let d = d2.max(1e-30).sqrt();
        let height = (n.x * to[0] + n.y * to[1] + n.z * to[2]) / d;
        let along = -(node.axis[0][i] * to[0] + node.axis[1][i] * to[1] + node.axis[2][i] * to[2]) / d;
        let sin_b = (node.bound[i] / d).min(1.0);
        let cos_b = (1.0 - sin_b * sin_b).sqrt();
        let cos_i = minus_angle(height, sin_b, cos_b).max(0.0);
        let along = if node.two_sided[i] > 0.0 { along.abs() } else { along };
        let cos_e = minus_angle(minus_angle(along, node.sin_spread[i], node.cos_spread[i]), sin_b, cos_b).max(0.0);
        let cos_e = if node.all_around[i] > 0.0 { 1.0 } else { cos_e };
        let cosines = if d2 <= node.bound2[i] { 1.0 } else { cos_e * cos_i };
        out[i] = node.power[i] * cosines / d2.max(node.radius2[i]);
        distance2[i] = d2;
    }
    (out, distance2)
}

/// The least whole number that is not below `x`.
fn above(x: f64) -> i32 {
    let whole = x as i32;
    whole + i32::from(x > f64::from(whole))
}

/// cos(max(0, x - b)) from cos(x) and sin(b), cos(b).
#[inline]
fn minus_angle(cos_x: f32, sin_b: f32, cos_b: f32) -> f32 {
    let sin_x = (1.0 - cos_x * cos_x).max(0.0).sqrt();
    // 1e-4: near the cut-off rounding must not make a reachable light unreachable.
    let less = cos_x * cos_b + sin_x * sin_b + 1e-4;
    if cos_x >= cos_b { 1.0 } else { less }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Lights on a line, each as often as it should be: the mean over u of what `draw` gives is 1 for every light.
    #[test]
    fn draws_are_unbiased() {
        let lights: Vec<LightBounds> = (0..50)
            .map(|i| {
                let at = Vec3::new(i as f32 * 0.1, 1.0, (i * i % 7) as f32);
                LightBounds {
                    lo: at,
                    hi: at + Vec3::splat(0.05),
                    power: 1.0 + i as f32,
                    axis: Vec3::NEG_Y,
                    cos_spread: 1.0,
                    two_sided: false,
                    all_around: i % 3 == 0,
                }
            })
            .collect();
        let tree = LightTree::new(&lights);
        let mut found = [0f64; 50];
        let n = 100_000;
        for k in 0..n {
            tree.draw(Vec3::new(1.0, 0.0, 2.0), Vec3::Y, 4, (k as f32 + 0.5) / n as f32, |i, weight| {
                found[i as usize] += weight / f64::from(n);
            });
        }
        for (i, f) in found.iter().enumerate() {
            assert!((f - 1.0).abs() < 0.02, "light {i}: {f}");
        }
    }

    /// A small lamp close by in the midst of many far ones: it sends most of the light and is drawn as often, however deep
    /// in the tree it is.
    #[test]
    fn a_near_lamp_among_far_ones_is_drawn_by_what_it_sends() {
        near_lamp_is_drawn(8, 0.1, 2.0);
        near_lamp_is_drawn(64, 1e-3, 5e-2);
    }

    /// `side` squared lamps of power 10 overhead, and one of `power` at `height`.
    fn near_lamp_is_drawn(side: i32, height: f32, power: f32) {
        let lamp = |at: Vec3, power: f32| LightBounds {
            lo: at - Vec3::splat(0.1 * height),
            hi: at + Vec3::splat(0.1 * height),
            power,
            axis: Vec3::NEG_Y,
            cos_spread: 1.0,
            two_sided: false,
            all_around: true,
        };
        let middle = 0.5 * (side - 1) as f32;
        let at = |i: i32| Vec3::new((i % side) as f32 - middle, 3.0, (i / side) as f32 - middle) * 2.0;
        let far = (0..side * side).map(|i| lamp(at(i), 10.0));
        let lights: Vec<LightBounds> = far.chain([lamp(Vec3::new(0.0, height, 0.0), power)]).collect();
        let tree = LightTree::new(&lights);
        let p = Vec3::ZERO;
        let sent = |l: &LightBounds| {
            let to = (l.lo + l.hi) * 0.5 - p;
            f64::from(l.power * to.normalize().y / to.length_squared())
        };
        let total: f64 = lights.iter().map(sent).sum();
        let mut chance = 0.0;
        let n = 4096;
        for k in 0..n {
            let near = |i: u32, _| chance += f64::from(u8::from(i as usize == lights.len() - 1));
            tree.draw(p, Vec3::Y, 1, (k as f32 + 0.5) / n as f32, near);
        }
        let (chance, share) = (chance / f64::from(n), sent(&lights[lights.len() - 1]) / total);
        assert!(share > 0.8 && chance > 0.5 * share, "drawn {chance}, sends {share}");
    }
}
