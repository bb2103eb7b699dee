//! Points of a texel, drawn evenly over the surface that it stands for.

use super::Texels;
use super::texels::{clip_columns, row_of};
use crate::scene::World;
use glam::{DVec2, Vec2, Vec3};

/// Draws points of one texel, uniform in surface area.
#[derive(Debug, Clone, Default)]
pub struct TexelSampler {
    fans: Vec<Fan>,
    square: Option<Fan>,
    /// Share of a piece's size that stays free along its border.
    margin: f32,
}

/// Points stay away from the border of a texel's pieces by some roundings [frame units]: a wall that stands there is
/// never between a point and where rounding puts it, ...
const AWAY: f32 = 1.6e-5;

/// ... but for no more than this share of the texel's side.
const MOST_MARGIN: f32 = 0.01;

/// A triangle of barycentric coordinates, or a parallelogram where it stands for a whole cell.
#[derive(Debug, Clone, Copy)]
struct Fan {
    triangle: u32,
    corner: Vec2,
    edges: [Vec2; 2],
    /// Middle of the piece that it is a part of.
    middle: Vec2,
    /// Share of the texel's area up to and including this one.
    cumulative: f32,
}

impl TexelSampler {
    /// Prepares to draw from a texel.
    pub fn load(&mut self, texels: &Texels, texel: usize) {
        self.fans.clear();
        self.square = None;
        let t = &texels.texels[texel];
        self.margin = (AWAY / t.area.sqrt()).min(MOST_MARGIN);
        let total: f64 = texels.pieces_of(texel).iter().map(|p| f64::from(p.area)).sum();
        let mut cumulative = 0.0f64;
        for piece in texels.pieces_of(texel) {
            let grid = &texels.triangles[piece.triangle as usize];
            let local = t.cell - grid.base;
            let (x, y) = (local % grid.width, local / grid.width);
            let q = grid.corners.map(|c| c.as_dvec2());
            let det = (q[1] - q[0]).perp_dot(q[2] - q[0]);
            let barycentric = |p: DVec2| {
                let d = p - q[0];
                DVec2::new(d.perp_dot(q[2] - q[0]) / det, (q[1] - q[0]).perp_dot(d) / det)
            };
            let cell = clip_columns(&row_of(&q, y), x);
            let area = cell.area();
            if area <= 1e-9 || det == 0.0 {
                // A piece thinner than rounding: its triangle's centre stands for it.
                cumulative += f64::from(piece.area) / total;
                let corner = Vec2::splat(1.0 / 3.0);
                self.fans.push(Fan {
                    triangle: piece.triangle,
                    corner,
                    edges: [Vec2::ZERO; 2],
                    middle: corner,
                    cumulative: cumulative as f32,
                });
                continue;
            }
            if area > 1.0 - 1e-9 && t.piece_count == 1 {
                let p = DVec2::new(f64::from(x), f64::from(y));
                let corner = barycentric(p);
                let edges = [barycentric(p + DVec2::X) - corner, barycentric(p + DVec2::Y) - corner];
                self.square = Some(Fan {
                    triangle: piece.triangle,
                    corner: corner.as_vec2(),
                    edges: edges.map(|e| e.as_vec2()),
                    middle: (corner + (edges[0] + edges[1]) * 0.5).as_vec2(),
                    cumulative: 1.0,
                });
                return;
            }
            let points = cell.points();
            let middle = barycentric(points.iter().sum::<DVec2>() / points.len() as f64).as_vec2();
            for i in 2..points.len() {
                let share = 0.5 * (points[i - 1] - points[0]).perp_dot(points[i] - points[0]).abs() / area;
                cumulative += share * f64::from(piece.area) / total;
                let corner = barycentric(points[0]);
                let edges = [barycentric(points[i - 1]) - corner, barycentric(points[i]) - corner];
                self.fans.push(Fan {
                    triangle: piece.triangle,
                    corner: corner.as_vec2(),
                    edges: edges.map(|e| e.as_vec2()),
                    middle,
                    cumulative: cumulative as f32,
                });
            }
        }
    }

    /// Centroid of the texel's surface [frame units] and its unit mean normal on the front; the normal of one of
    /// its triangles where they cancel. [`load`](Self::load) must have been called.
    pub fn centre(&self, world: &World) -> (Vec3, Vec3) {
        if let Some(s) = &self.square {
            return (world.position(s.triangle, inside(s.middle)), world.normals[s.triangle as usize]);
        }
        let (mut position, mut normal, mut below) = (Vec3::ZERO, Vec3::ZERO, 0.0);
        for f in &self.fans {
            let share = f.cumulative - below;
            below = f.cumulative;
            let middle = inside(f.corner + (f.edges[0] + f.edges[1]) / 3.0);
            position += share * world.position(f.triangle, middle);
            normal += share * world.normals[f.triangle as usize];
        }
        let normal = normal.try_normalize().unwrap_or(world.normals[self.fans[0].triangle as usize]);
        (position / below, normal)
    }

    /// Triangle and barycentric weights of the point at `u` of the unit square. [`load`](Self::load) must
    /// have been called.
    pub fn sample(&self, u: Vec2) -> (u32, Vec2) {
        if let Some(s) = &self.square {
            let u = u * (1.0 - 2.0 * self.margin) + self.margin;
            return (s.triangle, inside(s.corner + s.edges[0] * u.x + s.edges[1] * u.y));
        }
        let last = self.fans.len() - 1;
        let i = self.fans.partition_point(|f| f.cumulative <= u.x).min(last);
        let below = if i == 0 { 0.0 } else { self.fans[i - 1].cumulative };
        let f = &self.fans[i];
        let x = ((u.x - below) / (f.cumulative - below).max(1e-20)).clamp(0.0, 1.0);
        let w = crate::sampling::uniform_triangle(Vec2::new(x, u.y));
        let point = f.corner + f.edges[0] * w.x + f.edges[1] * w.y;
        // A third of a triangle's height lies below its middle.
        (f.triangle, inside(point + (f.middle - point) * (3.0 * self.margin).min(2.0 * MOST_MARGIN)))
    }
}

/// Weights pushed back into the triangle where rounding put them outside.
fn inside(w: Vec2) -> Vec2 {
    let w = w.clamp(Vec2::ZERO, Vec2::ONE);
    let sum = w.x + w.y;
    if sum > 1.0 { w / sum } else { w }
}
