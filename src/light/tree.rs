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

#[derive(Debug, Clone, Copy)]
struct Node {
    bounds: LightBounds,
    centre: Vec3,
    /// Radius of the sphere around the box, a hair more, and the square of that.
    radius: f32,
    bound: f32,
    bound2: f32,
    sin_spread: f32,
    /// Left child (the right one follows at `right`), or the light where `right` is 0.
    left: u32,
    right: u32,
}

impl Node {
    fn new(bounds: LightBounds, light: u32) -> Node {
        let radius = (bounds.hi - bounds.lo).length() * 0.5;
        // A hair larger than the box, so that nothing at its border is judged unreachable.
        let bound = radius * 1.001 + 1e-6;
        let sin_spread = (1.0 - bounds.cos_spread * bounds.cos_spread).max(0.0).sqrt();
        let centre = (bounds.lo + bounds.hi) * 0.5;
        Node { bounds, centre, radius, bound, bound2: bound * bound, sin_spread, left: light, right: 0 }
    }
}

/// A group's box says little where its sphere is nearer than its radius: its squared distance in squared radii.
const NEAR: f32 = 4.0;

/// Groups that draws are taken from at most.
const MOST_GROUPS: usize = 64;

/// The tree. An empty one draws nothing.
#[derive(Debug, Default)]
pub struct LightTree {
    nodes: Vec<Node>,
}

impl LightTree {
    /// Builds over `lights`; what [`draw`](Self::draw) finds are indices into it.
    pub fn new(lights: &[LightBounds]) -> LightTree {
        let mut tree = LightTree { nodes: Vec::with_capacity(lights.len() * 2) };
        let mut order: Vec<u32> = (0..lights.len() as u32).collect();
        if !order.is_empty() {
            tree.build(lights, &mut order);
        }
        tree
    }

    fn build(&mut self, lights: &[LightBounds], order: &mut [u32]) -> u32 {
        let me = self.nodes.len() as u32;
        let bounds = order.iter().map(|&i| lights[i as usize]).reduce(|a, b| merge(&a, &b)).expect("not empty");
        self.nodes.push(Node::new(bounds, order[0]));
        if order.len() == 1 {
            return me;
        }
        let centre = |i: u32| lights[i as usize].lo + lights[i as usize].hi;
        let (lo, hi) = order
            .iter()
            .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), &i| (lo.min(centre(i)), hi.max(centre(i))));
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
        let left = self.build(lights, a);
        let right = self.build(lights, b);
        self.nodes[me as usize].left = left;
        self.nodes[me as usize].right = right;
        me
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
        // Draw k stands at k of the interval [0, count) of all groups, moved by u.
        let mut from = 0.0;
        for &(node, importance) in groups.iter() {
            let width = f64::from(count) * (f64::from(importance) / total);
            self.descend(node, (from, width), f64::from(u), (p, n), &mut visit);
            from += width;
        }
    }

    /// Groups that hold all lights that can reach a point, with about the irradiance that each sends, > 0. In a group near
    /// or around the point may be a lamp at arm's length, or none: its children are looked at in its place.
    fn groups<'a>(&self, at: (Vec3, Vec3), groups: &'a mut [(u32, f32); MOST_GROUPS]) -> &'a [(u32, f32)] {
        // Those at the end of the array are still to be looked at.
        let (mut found, mut open) = (0, MOST_GROUPS - 1);
        groups[open].0 = 0;
        while open < MOST_GROUPS {
            let (node, _) = groups[open];
            open += 1;
            let n = &self.nodes[node as usize];
            let importance = importance(n, at.0, at.1);
            let near = n.centre.distance_squared(at.0) <= NEAR * n.bound2;
            if importance > 0.0 && near && n.right != 0 && open >= found + 2 {
                open -= 2;
                (groups[open].0, groups[open + 1].0) = (n.left, n.right);
            } else if importance > 0.0 {
                groups[found] = (node, importance);
                found += 1;
            }
        }
        &groups[..found]
    }

    /// Draws in the part [`from`, `from + width`) of a node: its probability is `width` over the number of draws.
    fn descend(
        &self,
        node: u32,
        (from, width): (f64, f64),
        u: f64,
        at: (Vec3, Vec3),
        visit: &mut impl FnMut(u32, f64),
    ) {
        let drawn = above(from + width - u) - above(from - u);
        if drawn <= 0 {
            return;
        }
        let Node { left, right, .. } = self.nodes[node as usize];
        if right == 0 {
            visit(left, f64::from(drawn) / width);
            return;
        }
        let [a, b] = [left, right].map(|c| f64::from(importance(&self.nodes[c as usize], at.0, at.1)));
        if a + b > 0.0 {
            let share = width * (a / (a + b));
            self.descend(left, (from, share), u, at, visit);
            self.descend(right, (from + share, width - share), u, at, visit);
        }
    }
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

/// About the irradiance that a group sends to `p`; 0 only where it can send none.
#[inline]
fn importance(node: &Node, p: Vec3, n: Vec3) -> f32 {
    let l = &node.bounds;
    let to = node.centre - p;
    let d2 = to.length_squared();
    let distance2 = d2.max(node.radius * node.radius).max(1e-12);
    if d2 <= node.bound2 {
        return l.power / distance2;
    }
    // Half of all are wholly below the horizon, which needs no angles.
    let height = n.dot(to);
    if height < 0.0 && height * height >= node.bound2 {
        return 0.0;
    }
    let d = d2.sqrt();
    let w = to / d;
    let sin2_b = node.bound2 / d2;
    let (sin_b, cos_b) = (node.bound / d, (1.0 - sin2_b).sqrt());
    let cos_i = minus_angle(height / d, sin_b, cos_b);
    if cos_i <= 0.0 {
        return 0.0;
    }
    let cos_e = if l.all_around {
        1.0
    } else {
        let c = -l.axis.dot(w);
        let c = if l.two_sided { c.abs() } else { c };
        let x = minus_angle(c, node.sin_spread, l.cos_spread);
        minus_angle(x, sin_b, cos_b)
    };
    if cos_e <= 0.0 { 0.0 } else { l.power * cos_e * cos_i / distance2 }
}

/// The least whole number that is not below `x`.
fn above(x: f64) -> i32 {
    let whole = x as i32;
    whole + i32::from(x > f64::from(whole))
}

/// cos(max(0, x - b)) from cos(x) and sin(b), cos(b).
fn minus_angle(cos_x: f32, sin_b: f32, cos_b: f32) -> f32 {
    if cos_x >= cos_b {
        return 1.0;
    }
    let sin_x = (1.0 - cos_x * cos_x).max(0.0).sqrt();
    // 1e-4: near the cut-off rounding must not make a reachable light unreachable.
    cos_x * cos_b + sin_x * sin_b + 1e-4
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
