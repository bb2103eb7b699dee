//! How many texels everything gets, and on how many pages it goes.
//!
//! In: the charts of each mesh in metres. Out: a [`Layout`] with the place of every chart and of every
//! instance's rectangle in whole texels. Automatic density is the highest at which the packer gets everything
//! on one page, found by bracketing; a fixed density takes the pages it needs.

use super::Page;
use super::chart::{Chart, scale_to};
use super::pack::{Bitmap, Item, Shape, Spot};
use crate::error::BakeError;
use crate::options::{BakeOptions, Density};
use glam::DVec2;
use rayon::prelude::*;
use std::time::Instant;

/// Charts that share a layout: those of one mesh.
#[derive(Debug)]
pub(super) struct Unit {
    /// Node or mesh, for messages.
    pub name: String,
    /// Its charts [m].
    pub charts: Vec<Chart>,
    /// Factor on the density of all of them.
    pub density: f64,
    /// Factor on that of each, besides.
    pub factors: Vec<f64>,
    /// Empty: the charts go straight into the atlas, all on one page. Else one rectangle per entry holds the
    /// mesh's layout, scaled by the entry, in (0, 1] with 1 among them.
    pub instances: Vec<f64>,
}

/// The place of every unit.
#[derive(Debug)]
pub(super) struct Layout {
    /// Texels per metre for a unit of density 1.
    pub density: f64,
    /// The pages, cropped in height.
    pub pages: Vec<Page>,
    /// One per unit.
    pub units: Vec<UnitLayout>,
}

/// The place of a unit.
#[derive(Debug, Clone)]
pub(super) struct UnitLayout {
    /// Texels per metre.
    pub density: f64,
    /// Page of the charts; meaningless with rectangles.
    pub page: u32,
    /// Size of what the charts lie in: the unit's own rectangle; meaningless without rectangles [texels].
    pub size: [u32; 2],
    /// Place of each chart.
    pub charts: Vec<ChartSpot>,
    /// Place of each instance.
    pub rectangles: Vec<Rectangle>,
}

/// Where a chart lies.
#[derive(Debug, Clone, Copy)]
pub(super) struct ChartSpot {
    /// Texels of the chart's box.
    pub texels: [u32; 2],
    /// The padded box around it, before turning: the margin on the left and on top, whole cells in all.
    padded: [u32; 2],
    margin: u32,
    turns: u32,
    /// Top left texel of the turned padded box.
    origin: [i64; 2],
}

impl ChartSpot {
    /// Texel coordinates of a place in the chart's box of `size` [m].
    pub fn texel(&self, place: DVec2, size: DVec2) -> DVec2 {
        self.turned(place * scale_to(size, self.texels))
    }

    /// Corners of the chart's box in texels, lower and upper.
    pub fn bounds(&self) -> (DVec2, DVec2) {
        let a = self.turned(DVec2::ZERO);
        let b = self.turned(DVec2::new(f64::from(self.texels[0]), f64::from(self.texels[1])));
        (a.min(b), a.max(b))
    }

    fn turned(&self, p: DVec2) -> DVec2 {
        let q = p + f64::from(self.margin);
        let [w, h] = self.padded.map(f64::from);
        let q = match self.turns {
            0 => q,
            1 => DVec2::new(h - q.y, q.x),
            2 => DVec2::new(w - q.x, h - q.y),
            _ => DVec2::new(q.y, w - q.x),
        };
        q + DVec2::new(self.origin[0] as f64, self.origin[1] as f64)
    }
}

/// A rectangle of an instance, without the gutter around it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Rectangle {
    /// Page index.
    pub page: u32,
    /// Top left texel.
    pub origin: [u32; 2],
    /// Width and height [texels].
    pub size: [u32; 2],
}

/// Packs `units` as `options` ask (`density`, `max_texture`, `max_pages`, `gutter`, which must be valid). After
/// `deadline` an automatic density is taken as soon as it fits.
///
/// # Errors
/// [`BakeError::Limit`] where the pages do not suffice, [`BakeError::Cancelled`].
pub(super) fn lay_out(
    units: &[Unit],
    options: &BakeOptions,
    deadline: Option<Instant>,
    cancelled: &(dyn Fn() -> bool + Sync),
) -> Result<Layout, BakeError> {
    let late = || deadline.is_some_and(|d| Instant::now() >= d);
    let packer = Packer { units, exact: exact_charts(units), gutter: options.gutter.div_ceil(2) };
    let side = options.max_texture;
    let area = |u: &Unit| u.charts.iter().zip(&u.factors).map(|(c, f)| c.area * f * f).sum();
    let full = full_density(units.iter().map(|u| (u, area(u))), side);
    let room = packer.most_charts(side);
    if let Some(u) = units.iter().position(|u| u.charts.len() as u64 > room) {
        return Err(refused(NoFit::Unit(u), units, options));
    }
    let try_pages = |density: f64, side: u32, pages: u32| {
        if cancelled() { Err(NoFit::Cancelled) } else { packer.pack(density, side, pages) }
    };
    let found = match options.density {
        Density::TexelsPerMetre(density) => {
            let small = (4..14).map(|k| 1u32 << k).filter(|&s| s < side);
            let one = small.chain([side]).find_map(|s| try_pages(density, s, 1).ok());
            one.map_or_else(|| try_pages(density, side, options.max_pages), Ok)
        }
        Density::Auto | Density::Even => (1..=options.max_pages)
            .find_map(|pages| {
                let full = full * f64::from(pages).sqrt();
                search(full, &late, &|density| try_pages(density, side, pages).ok())
            })
            // So many charts that their gutters fill the pages: as dense as one texel each allows.
            .map_or_else(|| try_pages(full * 1e-3, side, options.max_pages), Ok),
    };
    found.map_err(|e| if cancelled() { BakeError::Cancelled } else { refused(e, units, options) })
}

fn refused(why: NoFit, units: &[Unit], options: &BakeOptions) -> BakeError {
    let page = format!("{0} x {0} texels", options.max_texture);
    let charts: usize = units.iter().map(|u| u.charts.len() * u.instances.len().max(1)).sum();
    match why {
        NoFit::Unit(u) => BakeError::Limit {
            what: "the lightmap of one mesh",
            asked: format!("more than a page for the {} charts of {}", units[u].charts.len(), units[u].name),
            allowed: format!("one page of {page}"),
            cure: "raise --max-texture, lower --gutter, or split the mesh".into(),
        },
        NoFit::Pages | NoFit::Cancelled => BakeError::Limit {
            what: "the lightmap atlas",
            asked: format!("more than {} pages of {page} for {charts} charts", options.max_pages),
            allowed: format!("{} pages", options.max_pages),
            cure: "lower --density or --gutter, raise --max-texture or --max-pages, or exclude nodes".into(),
        },
    }
}

/// Texels per metre for a unit of density 1 at which the given areas [m2] of the units' charts would tile a page of
/// `side` squared without gaps.
pub(super) fn full_density<'u>(units: impl Iterator<Item = (&'u Unit, f64)>, side: u32) -> f64 {
    let area: f64 = units
        .map(|(u, area)| {
            let copies: f64 = if u.instances.is_empty() { 1.0 } else { u.instances.iter().map(|k| k * k).sum() };
            area * u.density * u.density * copies
        })
        .sum();
    (f64::from(side) / area.max(f64::MIN_POSITIVE).sqrt()).min(1e12)
}

/// Share of the density at full use of a page below which more pages are taken instead: surface then has only
/// a sixteenth of the texels, gutters the rest.
const LEAST_SHARE: f64 = 0.25;

/// The highest density found at which `fit` succeeds, looked for between [`LEAST_SHARE`] of `full` and a little
/// above `full`, at which charts would have to tile the pages without gaps. Two densities are tried at a time.
fn search(full: f64, late: &dyn Fn() -> bool, fit: &(dyn Fn(f64) -> Option<Layout> + Sync)) -> Option<Layout> {
    let (mut low, mut high) = (0.64, 0.84);
    let mut ceiling = 1.02;
    let mut best = loop {
        match rayon::join(|| fit(full * low), || fit(full * high)) {
            (_, Some(found)) => break found,
            (Some(found), None) => {
                ceiling = high;
                break found;
            }
            (None, None) if low <= LEAST_SHARE => return None,
            (None, None) => {
                ceiling = low;
                high = low * 0.75;
                low = (low * 0.5).max(LEAST_SHARE);
            }
        }
    };
    for _ in 0..3 {
        if late() {
            break;
        }
        let floor = best.density / full;
        let third = (ceiling - floor) / 3.0;
        let (a, b) = (floor + third, floor + 2.0 * third);
        match rayon::join(|| fit(full * a), || fit(full * b)) {
            (_, Some(found)) => best = found,
            (Some(found), None) => (best, ceiling) = (found, b),
            (None, None) => ceiling = a,
        }
    }
    Some(best)
}

/// Why a density does not do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum NoFit {
    /// More pages are needed than allowed.
    Pages,
    /// This unit does not even fit on an empty page with one texel a chart.
    Unit(usize),
    /// Asked to stop.
    Cancelled,
}

/// At most this many charts are packed by their shape, the largest first; the others by their box.
const MAX_SHAPES: usize = 1000;

/// A chart that fills this share of its box is packed as the box.
const NEARLY_FULL: f64 = 0.9;

/// Which charts are packed by their shape.
fn exact_charts(units: &[Unit]) -> Vec<Vec<bool>> {
    let mut order: Vec<(f64, usize, usize)> = Vec::new();
    let mut exact: Vec<Vec<bool>> = units.iter().map(|u| vec![false; u.charts.len()]).collect();
    for (u, unit) in units.iter().enumerate() {
        for (c, chart) in unit.charts.iter().enumerate().filter(|(_, c)| c.fill() < NEARLY_FULL) {
            order.push((chart.size.x * chart.size.y * (unit.density * unit.factors[c]).powi(2), u, c));
        }
    }
    order.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    for &(_, u, c) in order.iter().take(MAX_SHAPES) {
        exact[u][c] = true;
    }
    exact
}

/// Cells of the packer's bitmaps are as small as gives at most this many across a page.
const MAX_CELLS: u32 = 1024;

/// A unit's density falls by this factor until it fits on a page.
const SHRINK: f64 = 0.85;

struct Packer<'a> {
    units: &'a [Unit],
    exact: Vec<Vec<bool>>,
    /// Texels by which footprints are grown on each side.
    gutter: u32,
}

/// A unit at some density, before it has a place on a page.
struct Sized {
    layout: UnitLayout,
    /// What has to go on one page together: the charts, or one rectangle.
    groups: Vec<Vec<Item>>,
}

/// A group on its way to a page.
struct Group<'a> {
    unit: usize,
    index: usize,
    items: &'a [Item],
    cells: u64,
}

impl Packer<'_> {
    /// How many charts of one texel fit on a page of `side` squared.
    fn most_charts(&self, side: u32) -> u64 {
        let cell = side.div_ceil(MAX_CELLS);
        u64::from(side / cell / (1 + 2 * self.gutter).div_ceil(cell)).pow(2)
    }

    /// Everything at `density` [texels/m] on at most `max_pages` pages of `side` squared.
    fn pack(&self, density: f64, side: u32, max_pages: u32) -> Result<Layout, NoFit> {
        let cell = side.div_ceil(MAX_CELLS);
        let size = |(u, unit): (usize, &Unit)| self.sized(u, density * unit.density, side, cell);
        let mut sized = self.units.par_iter().enumerate().map(size).collect::<Result<Vec<_>, _>>()?;
        loop {
            let mut groups: Vec<Group> = Vec::new();
            for (unit, s) in sized.iter().enumerate() {
                for (index, items) in s.groups.iter().enumerate() {
                    let cells = items.iter().map(|i| i.turns[0].1.cells()).sum();
                    groups.push(Group { unit, index, items, cells });
                }
            }
            groups.sort_by_key(|g| (std::cmp::Reverse(g.cells), g.unit, g.index));
            let packed = match pack_one_page(&groups, side / cell) {
                Some(p) => Ok(p),
                None if max_pages == 1 => return Err(NoFit::Pages),
                None => pack_pages(&groups, side / cell, max_pages),
            };
            let unit = match packed {
                Ok((pages, spots)) => {
                    let place = |(g, (page, spots)): (&Group, _)| Placed { unit: g.unit, index: g.index, page, spots };
                    let placed = groups.iter().zip(spots).map(place).collect();
                    return Ok(finish(density, sized, placed, &pages, side, cell, self.gutter));
                }
                Err(Failure::Pages) => return Err(NoFit::Pages),
                Err(Failure::Group(g)) => groups[g].unit,
            };
            let smaller = sized[unit].layout.density * SHRINK;
            if sized[unit].layout.charts.iter().all(|c| c.texels == [1, 1]) {
                return Err(NoFit::Unit(unit));
            }
            sized[unit] = self.sized(unit, smaller, side, cell)?;
        }
    }

    /// Unit `u` at `density` [texels/m], or at the highest lower one at which its rectangle fits on a page.
    fn sized(&self, u: usize, mut density: f64, side: u32, cell: u32) -> Result<Sized, NoFit> {
        let unit = &self.units[u];
        let inner = (side / cell * cell).saturating_sub(2 * self.gutter).max(1);
        if unit.instances.is_empty() {
            let (spots, items) = self.items(u, density, inner, self.gutter, cell);
            let layout = UnitLayout { density, page: 0, size: [0; 2], charts: spots, rectangles: Vec::new() };
            return Ok(Sized { layout, groups: vec![items] });
        }
        let least = unit.instances.iter().copied().fold(1.0, f64::min);
        // Scaled by k < 1, footprints are no longer aligned: two charts D texels apart keep at least k D - 1.
        let gutter =
            if least == 1.0 { self.gutter } else { (f64::from(2 * self.gutter + 1) / (2.0 * least)).ceil() as u32 };
        loop {
            let (mut spots, items) = self.items(u, density, inner, gutter, 1);
            let size = pack_locally(&mut spots, &items);
            if size[0] > inner || size[1] > inner {
                if spots.iter().all(|c| c.texels == [1, 1]) {
                    return Err(NoFit::Unit(u));
                }
                density *= SHRINK;
                continue;
            }
            let rectangles: Vec<Rectangle> = unit
                .instances
                .iter()
                .map(|k| {
                    let size = size.map(|s| (f64::from(s) * k - 1e-9).ceil().max(1.0) as u32);
                    Rectangle { page: 0, origin: [0; 2], size }
                })
                .collect();
            let groups = rectangles
                .iter()
                .map(|r| {
                    let [w, h] = r.size.map(|s| (s + 2 * self.gutter).div_ceil(cell));
                    vec![Item { turns: vec![(0, Shape::rectangle(w, h))] }]
                })
                .collect();
            let layout = UnitLayout { density, page: 0, size, charts: spots, rectangles };
            return Ok(Sized { layout, groups });
        }
    }

    /// The charts of unit `u` as items, and their sizes with places still open.
    fn items(&self, u: usize, density: f64, inner: u32, gutter: u32, cell: u32) -> (Vec<ChartSpot>, Vec<Item>) {
        self.units[u]
            .charts
            .par_iter()
            .zip(&self.units[u].factors)
            .zip(&self.exact[u])
            .map(|((chart, factor), &exact)| {
                let texels = chart.texels(density * factor).map(|n| n.min(inner));
                let [w, h] = texels.map(|n| (n + 2 * gutter).div_ceil(cell));
                let turns = if exact {
                    let mask = chart.footprint(texels).dilated(gutter).coarse(cell);
                    (0..4).map(|t| (t, Shape::from_mask(&mask.turned(t)))).collect()
                } else if w == h {
                    vec![(0, Shape::rectangle(w, h))]
                } else {
                    vec![(0, Shape::rectangle(w, h)), (1, Shape::rectangle(h, w))]
                };
                let padded = [w * cell, h * cell];
                (ChartSpot { texels, padded, margin: gutter, turns: 0, origin: [0; 2] }, Item { turns })
            })
            .unzip()
    }
}

/// Packs the charts of a shared mesh into a compact rectangle of their own, (0, 0) at its top left, and returns
/// its size [texels]. The charts touch its border: the gutter around it is the atlas's.
fn pack_locally(spots: &mut [ChartSpot], items: &[Item]) -> [u32; 2] {
    let mut order: Vec<usize> = (0..items.len()).collect();
    order.sort_by_key(|&i| (items[i].order(), i));
    let cells: u64 = items.iter().map(|i| i.turns[0].1.cells()).sum();
    let longest = items.iter().map(|i| i.turns[0].1.width.max(i.turns[0].1.height)).max().unwrap_or(1);
    let mut side = ((cells as f64).sqrt().ceil() as u32).max(longest);
    let placed = loop {
        let mut page = Bitmap::new(side, side);
        let placed: Option<Vec<Spot>> = order.iter().map(|&i| page.place(&items[i])).collect();
        match placed {
            Some(placed) => break placed,
            None => side += side / 16 + 1,
        }
    };
    for (&i, spot) in order.iter().zip(&placed) {
        spots[i].turns = spot.turns;
        spots[i].origin = [i64::from(spot.x), i64::from(spot.y)];
    }
    let lo = spots.iter().fold(DVec2::INFINITY, |lo, s| lo.min(s.bounds().0));
    for s in spots.iter_mut() {
        s.origin = [s.origin[0] - lo.x as i64, s.origin[1] - lo.y as i64];
    }
    let hi = spots.iter().fold(DVec2::ONE, |hi, s| hi.max(s.bounds().1));
    [hi.x as u32, hi.y as u32]
}

/// Why groups do not fit on the pages.
enum Failure {
    Pages,
    Group(usize),
}

/// Rows and columns in use of each page [cells], and per group the page and the spots of its items.
type Packed = (Vec<[u32; 2]>, Vec<(u32, Vec<Spot>)>);

/// All groups on one page, the largest items first, whatever group they belong to.
fn pack_one_page(groups: &[Group], side: u32) -> Option<Packed> {
    if groups.iter().map(|g| g.cells).sum::<u64>() > u64::from(side) * u64::from(side) {
        return None;
    }
    let mut order: Vec<(usize, usize)> =
        groups.iter().enumerate().flat_map(|(g, group)| (0..group.items.len()).map(move |i| (g, i))).collect();
    order.sort_by_key(|&(g, i)| (groups[g].items[i].order(), g, i));
    let mut page = Bitmap::new(side, side);
    let nowhere = Spot { turns: 0, x: 0, y: 0 };
    let mut spots: Vec<_> = groups.iter().map(|g| (0, vec![nowhere; g.items.len()])).collect();
    for (g, i) in order {
        spots[g].1[i] = page.place(&groups[g].items[i])?;
    }
    Some((vec![[page.used_width, page.used_height]], spots))
}

/// Groups in order, each whole on the first page that takes it.
fn pack_pages(groups: &[Group], side: u32, max_pages: u32) -> Result<Packed, Failure> {
    let mut pages: Vec<Bitmap> = Vec::new();
    let mut spots = Vec::with_capacity(groups.len());
    for (g, group) in groups.iter().enumerate() {
        let mut order: Vec<usize> = (0..group.items.len()).collect();
        order.sort_by_key(|&i| (group.items[i].order(), i));
        let mut k = 0;
        let placed = loop {
            if k == pages.len() {
                if pages.len() == max_pages as usize {
                    return Err(Failure::Pages);
                }
                pages.push(Bitmap::new(side, side));
            }
            if let Some(placed) = place_group(&mut pages[k], group, &order) {
                break placed;
            }
            if pages[k].used_height == 0 {
                return Err(Failure::Group(g));
            }
            k += 1;
        };
        spots.push((k as u32, placed));
    }
    Ok((pages.iter().map(|p| [p.used_width, p.used_height]).collect(), spots))
}

/// Places all items of a group on a page, or leaves the page as it was.
fn place_group(page: &mut Bitmap, group: &Group, order: &[usize]) -> Option<Vec<Spot>> {
    if group.cells > page.free {
        return None;
    }
    let mut trial = page.clone();
    let mut spots = vec![Spot { turns: 0, x: 0, y: 0 }; group.items.len()];
    for &i in order {
        spots[i] = trial.place(&group.items[i])?;
    }
    *page = trial;
    Some(spots)
}

/// Page heights are multiples of this, the block of the common compressed formats.
const BLOCK: u32 = 4;

/// A group with its place.
struct Placed {
    unit: usize,
    index: usize,
    page: u32,
    spots: Vec<Spot>,
}

/// The layout from what the packer found.
fn finish(
    density: f64,
    sized: Vec<Sized>,
    placed: Vec<Placed>,
    pages: &[[u32; 2]],
    side: u32,
    cell: u32,
    gutter: u32,
) -> Layout {
    let pages = pages
        .iter()
        .map(|used| Page { width: side, height: (used[1] * cell).next_multiple_of(BLOCK).clamp(1, side) })
        .collect();
    let mut units: Vec<UnitLayout> = sized.into_iter().map(|s| s.layout).collect();
    for Placed { unit, index, page, spots } in placed {
        let unit = &mut units[unit];
        if unit.rectangles.is_empty() {
            unit.page = page;
            for (chart, spot) in unit.charts.iter_mut().zip(spots) {
                chart.turns = spot.turns;
                chart.origin = [i64::from(spot.x * cell), i64::from(spot.y * cell)];
            }
        } else {
            let rectangle = &mut unit.rectangles[index];
            rectangle.page = page;
            rectangle.origin = [spots[0].x * cell + gutter, spots[0].y * cell + gutter];
        }
    }
    Layout { density, pages, units }
}
