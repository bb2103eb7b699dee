//! Which surface each texel covers, by exact clipping of triangles against the texel grid.
//!
//! A texel stands for the whole surface mapped to its square: one [`Piece`] per triangle that meets it, with
//! the piece's world area. Summed over texels the areas are the surface area, whatever the UVs. A
//! double-sided surface has a second texel for its back at the same place.
//!
//! Reflecting triangles without a place on the map (not baked, or dropped by the unwrapper) get *transport
//! texels* on a small grid of their own, so that the light they send out is known like that of all others.

use super::Atlas;
use super::transport::{TransportGrid, reflects};
use crate::scene::{SurfaceFlags, World};
use glam::{DVec2, Vec2};
use rayon::prelude::*;

/// Marks a grid cell or triangle without a texel.
pub const NO_TEXEL: u32 = u32::MAX;

/// The part of a triangle inside a texel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Piece {
    /// Triangle id in the [`World`].
    pub triangle: u32,
    /// Surface area of the part [frame units squared], > 0.
    pub area: f32,
}

/// A texel: the surface it stands for. Texels are ordered by chart and, inside a chart, along a Morton curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Texel {
    /// Index of the grid cell; see [`Texels::page_position`].
    pub cell: u32,
    /// First of its pieces in [`Texels::pieces`].
    pub first_piece: u32,
    /// Number of its pieces, >= 1.
    pub piece_count: u32,
    /// Global chart id, or [`NO_CHART`](super::NO_CHART) for transport texels.
    pub chart: u32,
    /// Surface area mapped to it [frame units squared], > 0.
    pub area: f32,
    /// Share of its square inside charts, in (0, 1].
    pub coverage: f32,
    /// The back of a double-sided surface.
    pub back: bool,
}

/// Where a triangle lies on the grid.
#[derive(Debug, Clone, Copy)]
pub(super) struct GridTriangle {
    /// Corners in cells, relative to the grid's first cell.
    pub(super) corners: [Vec2; 3],
    /// Index of the grid's first cell; `NO_TEXEL` if the triangle has none.
    pub(super) base: u32,
    /// Grid width and height in cells.
    pub(super) width: u32,
    height: u32,
    /// The cell that holds most of the triangle, for points that rounding puts into an empty cell.
    home: u32,
}

/// All texels of a scene, and the way from a point on a triangle to its texel.
#[derive(Debug, Clone, Default)]
pub struct Texels {
    /// Texels on the map first, then transport texels.
    pub texels: Vec<Texel>,
    /// Pieces of all texels.
    pub pieces: Vec<Piece>,
    /// How many of `texels` are on the map.
    pub mapped: usize,
    pub(super) triangles: Vec<GridTriangle>,
    front: Vec<u32>,
    back: Vec<u32>,
    page_base: Vec<u32>,
    mapped_cells: u32,
    page_width: Vec<u32>,
}

/// Where a texel lies on its page, and the texels of its side there, row by row.
struct Beside<'a> {
    x: u32,
    y: u32,
    width: u32,
    height: u32,
    ids: &'a [u32],
}

/// A piece found by the rasteriser.
#[derive(Clone, Copy)]
struct Fragment {
    cell: u32,
    triangle: u32,
    area: f32,
    coverage: f32,
}

/// Rows of a triangle that are clipped together. Sums over a triangle run block by block, on any number of threads.
const ROWS: usize = 64;

/// Triangles that are clipped together.
const TRIANGLES: usize = 128;

impl Texels {
    /// Clips every triangle of `world` against the grid of `atlas`.
    pub fn new(world: &World, atlas: &Atlas) -> Texels {
        let mut out = Texels::default();
        let mut cells = 0u32;
        for page in &atlas.pages {
            out.page_base.push(cells);
            out.page_width.push(page.width);
            cells += page.width * page.height;
        }
        out.mapped_cells = cells;
        out.triangles = place_triangles(world, atlas, &out.page_base, &mut cells);

        let chunks: Vec<Vec<Fragment>> = (0..world.len())
            .into_par_iter()
            .chunks(TRIANGLES)
            .map(|ids| {
                let mut fragments = Vec::new();
                for id in ids {
                    rasterise(world, id as u32, &out.triangles[id], &mut fragments);
                }
                fragments
            })
            .collect();
        let fragments = group_by_cell(&chunks, cells as usize);
        drop(chunks);
        out.home_cells(&fragments);

        let double_sided = |f: &Fragment| world.flags[f.triangle as usize].has(SurfaceFlags::DOUBLE_SIDED);
        let any_double = fragments.par_iter().any(double_sided);
        out.collect(world, atlas, &fragments, cells as usize, any_double);
        out
    }

    /// Texel under a point of a triangle, on its front or back; `None` where the triangle has none.
    pub fn at(&self, triangle: u32, back: bool, uv: Vec2) -> Option<u32> {
        let t = &self.triangles[triangle as usize];
        if t.base == NO_TEXEL {
            return None;
        }
        let table = if back { &self.back } else { &self.front };
        if table.is_empty() {
            return None;
        }
        // In f64: a point just before a texel's border stays there.
        let (uv, [a, b, c]) = (uv.as_dvec2(), t.corners.map(|c| c.as_dvec2()));
        let p = a + (b - a) * uv.x + (c - a) * uv.y;
        let x = (p.x.max(0.0) as u32).min(t.width - 1);
        let y = (p.y.max(0.0) as u32).min(t.height - 1);
        let id = table[(t.base + y * t.width + x) as usize];
        let id = if id == NO_TEXEL { table[t.home as usize] } else { id };
        (id != NO_TEXEL).then_some(id)
    }

    /// Page, column and row of a texel on the map.
    pub fn page_position(&self, texel: usize) -> (usize, u32, u32) {
        let cell = self.texels[texel].cell;
        let page = self.page_base.partition_point(|&b| b <= cell) - 1;
        let local = cell - self.page_base[page];
        (page, local % self.page_width[page], local / self.page_width[page])
    }

    /// Where a point of a triangle lies on its page (texels); `None` where the triangle has no texel.
    pub fn on_page(&self, triangle: u32, uv: Vec2) -> Option<DVec2> {
        let t = &self.triangles[triangle as usize];
        let (uv, [a, b, c]) = (uv.as_dvec2(), t.corners.map(|c| c.as_dvec2()));
        (t.base != NO_TEXEL).then(|| a + (b - a) * uv.x + (c - a) * uv.y)
    }

    /// The texel of the same chart and side so many columns and rows beside a texel on the map.
    pub fn beside(&self, texel: usize, [right, down]: [i32; 2]) -> Option<usize> {
        let Beside { x, y, width, height, ids } = self.page_of(texel);
        let (x, y) = (x.checked_add_signed(right)?, y.checked_add_signed(down)?);
        let id = if x < width && y < height { ids[(y * width + x) as usize] } else { NO_TEXEL };
        (id != NO_TEXEL && self.texels[id as usize].chart == self.texels[texel].chart).then_some(id as usize)
    }

    /// The texels of the same side at the eight cells around a texel on the map.
    pub fn around(&self, texel: usize) -> impl Iterator<Item = usize> + '_ {
        let Beside { x, y, width, height, ids } = self.page_of(texel);
        let columns = x.saturating_sub(1)..(x + 2).min(width);
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        rows.flat_map(move |y| columns.clone().map(move |x| ids[(y * width + x) as usize]))
            .filter(move |&t| t != NO_TEXEL && t as usize != texel)
            .map(|t| t as usize)
    }

    /// The page around a texel on the map.
    fn page_of(&self, texel: usize) -> Beside<'_> {
        let (page, x, y) = self.page_position(texel);
        let (base, width) = (self.page_base[page], self.page_width[page]);
        let end = self.page_base.get(page + 1).copied().unwrap_or(self.mapped_cells);
        let table = if self.texels[texel].back { &self.back } else { &self.front };
        Beside { x, y, width, height: (end - base) / width, ids: &table[base as usize..end as usize] }
    }

    /// The pieces of a texel.
    pub fn pieces_of(&self, texel: usize) -> &[Piece] {
        let t = &self.texels[texel];
        &self.pieces[t.first_piece as usize..(t.first_piece + t.piece_count) as usize]
    }

    /// Bytes held.
    pub fn memory_bytes(&self) -> usize {
        use std::mem::size_of_val;
        size_of_val(&*self.texels)
            + size_of_val(&*self.pieces)
            + size_of_val(&*self.triangles)
            + size_of_val(&*self.front)
            + size_of_val(&*self.back)
    }

    fn home_cells(&mut self, fragments: &[Fragment]) {
        let mut best = vec![0f32; self.triangles.len()];
        for f in fragments {
            let t = f.triangle as usize;
            if f.area > best[t] {
                best[t] = f.area;
                self.triangles[t].home = f.cell;
            }
        }
        for t in &mut self.triangles {
            if t.home == NO_TEXEL {
                t.base = NO_TEXEL;
            }
        }
    }

    fn collect(&mut self, world: &World, atlas: &Atlas, fragments: &[Fragment], cells: usize, any_double: bool) {
        // (sort key, cell, range of fragments) of every covered cell.
        let mut order: Vec<(u64, u32, u32, u32)> = Vec::new();
        let mut start = 0;
        while start < fragments.len() {
            let cell = fragments[start].cell;
            let mut end = start + 1;
            while end < fragments.len() && fragments[end].cell == cell {
                end += 1;
            }
            order.push((0, cell, start as u32, end as u32));
            start = end;
        }
        let charts: Vec<u32> = world
            .refs
            .par_iter()
            .map(|&r| atlas.texel_coordinates(world.scene, r).map_or(super::NO_CHART, |(_, _, chart)| chart))
            .collect();
        let chart_of = |from: u32, to: u32| {
            fragments[from as usize..to as usize]
                .iter()
                .map(|f| charts[f.triangle as usize])
                .min()
                .unwrap_or(super::NO_CHART)
        };
        order.par_iter_mut().for_each(|(key, cell, from, to)| {
            *key = if *cell < self.mapped_cells {
                let page = self.page_base.partition_point(|&b| b <= *cell) - 1;
                let local = *cell - self.page_base[page];
                let (x, y) = (local % self.page_width[page], local / self.page_width[page]);
                // 16 bits a side are interleaved into 32; page order is implied by the chart's.
                u64::from(chart_of(*from, *to)) << 32 | u64::from(morton(x, y))
            } else {
                1 << 63 | u64::from(*cell)
            };
        });
        order.par_sort_unstable();
        self.front = vec![NO_TEXEL; cells];
        if any_double {
            self.back = vec![NO_TEXEL; cells];
        }
        for &(key, cell, from, to) in &order {
            let mapped = key >> 63 == 0;
            let chart = if mapped { chart_of(from, to) } else { super::NO_CHART };
            let range = &fragments[from as usize..to as usize];
            self.front[cell as usize] = self.push(cell, chart, range.iter(), false);
            if any_double {
                let sided = range.iter().filter(|f| world.flags[f.triangle as usize].has(SurfaceFlags::DOUBLE_SIDED));
                if sided.clone().next().is_some() {
                    self.back[cell as usize] = self.push(cell, chart, sided, true);
                }
            }
            if mapped {
                self.mapped = self.texels.len();
            }
        }
    }

    fn push<'f>(&mut self, cell: u32, chart: u32, fragments: impl Iterator<Item = &'f Fragment>, back: bool) -> u32 {
        let first_piece = self.pieces.len() as u32;
        let (mut area, mut coverage) = (0f64, 0f64);
        for f in fragments {
            area += f64::from(f.area);
            coverage += f64::from(f.coverage);
            self.pieces.push(Piece { triangle: f.triangle, area: f.area });
        }
        self.texels.push(Texel {
            cell,
            first_piece,
            piece_count: self.pieces.len() as u32 - first_piece,
            chart,
            area: area as f32,
            coverage: coverage.min(1.0) as f32,
            back,
        });
        self.texels.len() as u32 - 1
    }
}

/// Grid placement of every triangle; transport triangles get grids after the pages', counted into `cells`.
fn place_triangles(world: &World, atlas: &Atlas, page_base: &[u32], cells: &mut u32) -> Vec<GridTriangle> {
    let none = GridTriangle { corners: [Vec2::ZERO; 3], base: NO_TEXEL, width: 0, height: 0, home: NO_TEXEL };
    let transport = TransportGrid::new(world, atlas);
    (0..world.len())
        .map(|id| {
            let flags = world.flags[id];
            if flags.has(SurfaceFlags::DEGENERATE) {
                return none;
            }
            if let Some((page, corners, _)) = atlas.texel_coordinates(world.scene, world.refs[id]) {
                let p = atlas.pages[page as usize];
                return GridTriangle {
                    corners,
                    base: page_base[page as usize],
                    width: p.width,
                    height: p.height,
                    home: NO_TEXEL,
                };
            }
            if !reflects(world, id) {
                return none;
            }
            let (corners, width, height) = transport.place(world, id);
            let base = *cells;
            *cells += width * height;
            GridTriangle { corners, base, width, height, home: NO_TEXEL }
        })
        .collect()
}

/// Appends the pieces of a triangle.
fn rasterise(world: &World, triangle: u32, grid: &GridTriangle, out: &mut Vec<Fragment>) {
    if grid.base == NO_TEXEL {
        return;
    }
    let q = grid.corners.map(|c| c.as_dvec2());
    let area = world.area(triangle);
    let first = out.len();
    let lo = q[0].min(q[1]).min(q[2]).floor().max(DVec2::ZERO);
    let hi = q[0].max(q[1]).max(q[2]).ceil();
    let (x1, y1) = (hi.x.min(f64::from(grid.width)) as u32, hi.y.min(f64::from(grid.height)) as u32);
    let columns = lo.x as u32..x1;
    let cover = |rows: std::ops::Range<u32>, out: &mut Vec<Fragment>| {
        let mut total = 0.0;
        for y in rows {
            cover_row(&q, y, columns.clone(), |x, share| {
                total += share;
                let cell = grid.base + y * grid.width + x;
                out.push(Fragment { cell, triangle, area: share as f32, coverage: share as f32 });
            });
        }
        total
    };
    let rows = lo.y as u32..y1;
    let total = if rows.len() <= ROWS {
        cover(rows, out)
    } else {
        let blocks: Vec<_> = rows.step_by(ROWS).map(|y| y..y1.min(y + ROWS as u32)).collect();
        let covered: Vec<(f64, Vec<Fragment>)> = blocks
            .into_par_iter()
            .map(|rows| {
                let mut fragments = Vec::new();
                (cover(rows, &mut fragments), fragments)
            })
            .collect();
        covered.iter().for_each(|(_, fragments)| out.extend_from_slice(fragments));
        covered.iter().map(|(total, _)| total).sum()
    };
    if total > 0.0 {
        let scale = area / total;
        out[first..].iter_mut().for_each(|f| f.area = (f64::from(f.area) * scale) as f32);
        out.retain_from(first, |f| f.area > 0.0);
    }
    if out.len() == first && area > 0.0 {
        // Thinner than rounding: all of it goes to the cell of its centre.
        let c = (q[0] + q[1] + q[2]) / 3.0;
        let x = (c.x.max(0.0) as u32).min(grid.width - 1);
        let y = (c.y.max(0.0) as u32).min(grid.height - 1);
        let cell = grid.base + y * grid.width + x;
        out.push(Fragment { cell, triangle, area: (area as f32).max(f32::MIN_POSITIVE), coverage: 1e-6 });
    }
}

/// Calls `cover` with each of `columns` of row `y` that the triangle `q` [cells] meets, and the share of the cell
/// that it covers. Cells that it covers whole are found from where it crosses the row's upper and lower line: only
/// its rim is clipped.
fn cover_row(q: &[DVec2; 3], y: u32, columns: std::ops::Range<u32>, mut cover: impl FnMut(u32, f64)) {
    let row = row_of(q, y);
    let Some((left, right)) = row.extent_x() else { return };
    let columns = (left.floor() as u32).max(columns.start)..(right.ceil() as u32).min(columns.end);
    let whole = whole_columns(&row, y);
    for x in columns {
        let share = if whole.contains(&x) { 1.0 } else { clip_columns(&row, x).area() };
        if share > 1e-9 {
            cover(x, share);
        }
    }
}

/// The part of a triangle in row `y`.
pub(super) fn row_of(q: &[DVec2; 3], y: u32) -> Polygon {
    clip(&clip(&Polygon::triangle(*q), 1, f64::from(y), 1.0), 1, f64::from(y + 1), -1.0)
}

/// The columns whose cells a row's part of a triangle fills: by convexity those between its corners on both lines.
fn whole_columns(row: &Polygon, y: u32) -> std::ops::Range<u32> {
    let on = |line: f64| {
        let on_it = row.points().iter().filter(|p| p.y == line);
        on_it.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), p| (a.min(p.x), b.max(p.x)))
    };
    let (upper, lower) = (on(f64::from(y)), on(f64::from(y + 1)));
    upper.0.max(lower.0).ceil() as u32..upper.1.min(lower.1).floor().max(0.0) as u32
}

trait RetainFrom<T> {
    fn retain_from(&mut self, first: usize, keep: impl Fn(&T) -> bool);
}

impl<T: Copy> RetainFrom<T> for Vec<T> {
    /// Drops elements from index `first` on that `keep` refuses.
    fn retain_from(&mut self, first: usize, keep: impl Fn(&T) -> bool) {
        let mut write = first;
        for read in first..self.len() {
            if keep(&self[read]) {
                self[write] = self[read];
                write += 1;
            }
        }
        self.truncate(write);
    }
}

/// All fragments, ordered by cell and inside a cell by triangle (a counting sort of already ordered chunks).
fn group_by_cell(chunks: &[Vec<Fragment>], cells: usize) -> Vec<Fragment> {
    let mut start = vec![0u32; cells + 1];
    chunks.iter().flatten().for_each(|f| start[f.cell as usize + 1] += 1);
    for i in 0..cells {
        start[i + 1] += start[i];
    }
    let total = start[cells] as usize;
    let mut out = vec![Fragment { cell: 0, triangle: 0, area: 0.0, coverage: 0.0 }; total];
    for f in chunks.iter().flatten() {
        let at = &mut start[f.cell as usize];
        out[*at as usize] = *f;
        *at += 1;
    }
    out
}

/// A convex polygon of at most 9 corners: a triangle cut by four lines has 7.
#[derive(Clone, Copy)]
pub(super) struct Polygon {
    points: [DVec2; 9],
    len: usize,
}

impl Polygon {
    fn triangle(q: [DVec2; 3]) -> Polygon {
        let mut points = [DVec2::ZERO; 9];
        points[..3].copy_from_slice(&q);
        Polygon { points, len: 3 }
    }

    pub(super) fn points(&self) -> &[DVec2] {
        &self.points[..self.len]
    }

    pub(super) fn area(&self) -> f64 {
        let p = self.points();
        (2..p.len()).map(|i| (p[i - 1] - p[0]).perp_dot(p[i] - p[0])).sum::<f64>().abs() * 0.5
    }

    fn extent_x(&self) -> Option<(f64, f64)> {
        let first = self.points().first()?.x;
        Some(self.points().iter().fold((first, first), |(a, b), p| (a.min(p.x), b.max(p.x))))
    }
}

/// The part of `p` where `side * (coordinate - line) >= 0` (Sutherland and Hodgman 1974).
fn clip(p: &Polygon, axis: usize, line: f64, side: f64) -> Polygon {
    let mut out = Polygon { points: [DVec2::ZERO; 9], len: 0 };
    for i in 0..p.len {
        let (a, b) = (p.points[i], p.points[(i + 1) % p.len]);
        let (da, db) = (side * (a[axis] - line), side * (b[axis] - line));
        if da >= 0.0 {
            out.points[out.len] = a;
            out.len += 1;
        }
        if (da >= 0.0) != (db >= 0.0) {
            let mut cut = a + (b - a) * (da / (da - db));
            cut[axis] = line;
            out.points[out.len] = cut;
            out.len += 1;
        }
    }
    out
}

pub(super) fn clip_columns(row: &Polygon, x: u32) -> Polygon {
    clip(&clip(row, 0, f64::from(x), 1.0), 0, f64::from(x + 1), -1.0)
}

fn morton(x: u32, y: u32) -> u32 {
    let spread = |v: u32| {
        let mut v = v & 0xffff;
        v = (v | v << 8) & 0x00ff_00ff;
        v = (v | v << 4) & 0x0f0f_0f0f;
        v = (v | v << 2) & 0x3333_3333;
        (v | v << 1) & 0x5555_5555
    };
    spread(x) | spread(y) << 1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Clipping every cell is the plain way; triangles large and small, thin, and with sides on the grid.
    #[test]
    fn whole_cells_are_those_that_clipping_fills() {
        let wave = |i: usize, k: usize| 20.0 + 20.0 * ((i * 7 + k) as f64 * 1.7).sin();
        let mut triangles: Vec<[DVec2; 3]> =
            (0..200).map(|i| [0, 2, 4].map(|k| DVec2::new(wave(i, k), wave(i, k + 1)))).collect();
        triangles.push([DVec2::ZERO, DVec2::new(32.0, 0.0), DVec2::new(32.0, 32.0)]);
        triangles.push([DVec2::new(3.0, 1.0), DVec2::new(9.0, 7.0), DVec2::new(3.0, 7.0)]);
        triangles.push([DVec2::new(0.0, 5.0), DVec2::new(40.0, 5.0), DVec2::new(17.5, 5.0 + 1e-7)]);
        let mut whole = 0;
        for q in &triangles {
            for y in 0..40 {
                let mut found = vec![0.0; 40];
                cover_row(q, y, 0..40, |x, share| found[x as usize] = share);
                for (x, share) in found.into_iter().enumerate() {
                    let plain = clip_columns(&row_of(q, y), x as u32).area();
                    assert!((share - plain).abs() < 1e-9, "{q:?} {x} {y}: {share}, not {plain}");
                    whole += usize::from(share == 1.0);
                }
            }
        }
        assert!(whole > 10_000, "{whole} whole cells");
    }
}
