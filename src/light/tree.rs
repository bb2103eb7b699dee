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
    /// Left child (the right one follows at `right`), or the light where `right` is 0.
    left: u32,
    right: u32,
}

/// The tree. An empty one picks nothing.
#[derive(Debug, Default)]
pub struct LightTree {
    nodes: Vec<Node>,
}

impl LightTree {
    /// Builds over `lights`; what [`pick`](Self::pick) returns are indices into it.
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
        self.nodes.push(Node { bounds, left: order[0], right: 0 });
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

    /// A light for the point `p` with unit normal `n`, and the probability of that pick; `None` where no light
    /// can reach the point. `u` in [0, 1).
    pub fn pick(&self, p: Vec3, n: Vec3, u: f32) -> Option<(u32, f32)> {
        let mut node = self.nodes.first()?;
        if importance(&node.bounds, p, n) <= 0.0 {
            return None;
        }
        let (mut probability, mut u) = (1.0f32, u);
        while node.right != 0 {
            let (l, r) = (&self.nodes[node.left as usize], &self.nodes[node.right as usize]);
            let (a, b) = (importance(&l.bounds, p, n), importance(&r.bounds, p, n));
            if a + b <= 0.0 {
                return None;
            }
            let share = a / (a + b);
            if u < share {
                u /= share;
                probability *= share;
                node = l;
            } else {
                u = (u - share) / (1.0 - share);
                probability *= 1.0 - share;
                node = r;
            }
            u = u.clamp(0.0, 0.999_999_94);
        }
        (probability > 0.0).then_some((node.left, probability))
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
fn importance(l: &LightBounds, p: Vec3, n: Vec3) -> f32 {
    let centre = (l.lo + l.hi) * 0.5;
    let radius = (l.hi - l.lo).length() * 0.5;
    let to = centre - p;
    let d2 = to.length_squared();
    // A hair larger than the box, so that nothing at its border is judged unreachable.
    let bound = radius * 1.001 + 1e-6;
    let distance2 = d2.max(radius * radius).max(1e-12);
    if d2 <= bound * bound {
        return l.power / distance2;
    }
    let w = to / d2.sqrt();
    let sin_b = (bound / d2.sqrt()).min(1.0);
    let cos_b = (1.0 - sin_b * sin_b).max(0.0).sqrt();
    let cos_i = minus_angle(n.dot(w), sin_b, cos_b);
    if cos_i <= 0.0 {
        return 0.0;
    }
    let cos_e = if l.all_around {
        1.0
    } else {
        let c = -l.axis.dot(w);
        let c = if l.two_sided { c.abs() } else { c };
        let sin_o = (1.0 - l.cos_spread * l.cos_spread).max(0.0).sqrt();
        let x = minus_angle(c, sin_o, l.cos_spread);
        minus_angle(x, sin_b, cos_b)
    };
    if cos_e <= 0.0 { 0.0 } else { l.power * cos_e * cos_i / distance2 }
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
