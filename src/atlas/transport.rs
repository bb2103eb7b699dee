//! Grids of the triangles that reflect light but have no place on the map.

use super::Atlas;
use crate::scene::{SurfaceFlags, World};
use glam::{DVec2, Vec2};
use rayon::prelude::*;

/// Cells per transport triangle at most; larger ones get coarser cells.
const MAX_TRANSPORT_CELLS: f64 = 4096.0;

/// Cells of all transport triangles together, but for one of each: all get coarser cells where there are more.
const ALL_TRANSPORT_CELLS: f64 = (1 << 20) as f64;

/// How finely triangles without a place on the map are divided.
pub(super) struct TransportGrid {
    /// Cells per frame unit.
    density: f64,
    /// Cells of all.
    pub(super) cells: u64,
}

/// Whether light goes on from a triangle, so that it needs a grid where it has no place on the map.
pub(super) fn reflects(world: &World, id: usize) -> bool {
    let flags = world.flags[id];
    let seen = !flags.has(SurfaceFlags::UNSEEN) && !flags.has(SurfaceFlags::UNLIT);
    seen && (flags.has(SurfaceFlags::SPECULAR) || world.material(id as u32).shows_diffuse_light())
}

impl TransportGrid {
    /// The density of the map, or coarser.
    pub(super) fn new(world: &World, atlas: &Atlas) -> TransportGrid {
        let ids: Vec<usize> = (0..world.len())
            .into_par_iter()
            .filter(|&id| reflects(world, id) && atlas.texel_coordinates(world.scene, world.refs[id]).is_none())
            .collect();
        // Transport texels are twice as long as the map's: they only steer where light starts.
        let density = (atlas.texels_per_metre * world.frame.metres * 0.5).max(1.0);
        let mut grid = TransportGrid { density, cells: 0 };
        let all = |grid: &TransportGrid| -> u64 {
            let cells = |&id: &usize| {
                let (_, width, height) = grid.place(world, id);
                u64::from(width) * u64::from(height)
            };
            ids.par_iter().map(cells).sum()
        };
        grid.cells = all(&grid);
        while grid.cells as f64 > ALL_TRANSPORT_CELLS + ids.len() as f64 {
            grid.density *= 0.5;
            grid.cells = all(&grid);
        }
        grid
    }

    /// Corners of a triangle in cells, and the width and height of its grid: its first corner on the first row, its
    /// second on the x axis.
    pub(super) fn place(&self, world: &World, id: usize) -> ([Vec2; 3], u32, u32) {
        let [a, b, c] = world.positions[id].map(|p| p.as_dvec3());
        let (e1, e2) = (b - a, c - a);
        let length = e1.length();
        let x = e1.dot(e2) / length;
        let y = (e2.length_squared() - x * x).max(0.0).sqrt();
        let shift = (-x).max(0.0);
        let (w, h) = (length.max(x) + shift, y);
        let scale =
            self.density.min((MAX_TRANSPORT_CELLS / (w * h).max(1e-30)).sqrt()).min(MAX_TRANSPORT_CELLS / w.max(h));
        let (width, height) = ((w * scale).ceil().max(1.0) as u32, (h * scale).ceil().max(1.0) as u32);
        let at = |x: f64, y: f64| (DVec2::new(x + shift, y) * scale).as_vec2();
        ([at(0.0, 0.0), at(length, 0.0), at(x, y)], width, height)
    }
}
