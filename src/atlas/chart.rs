//! Charts ready to pack: turned into the smallest box, sized in whole texels, and their footprint on the
//! texel grid.

use super::NO_CHART;
use super::check::{extent_in_strip, signed_area};
use super::unwrap::Unwrapped;
use glam::DVec2;

/// A chart in its own plane, with the smallest bounding box at the origin.
#[derive(Debug, Clone)]
pub(super) struct Chart {
    /// Vertices of the unwrapped mesh that belong to the chart, ascending.
    pub vertices: Vec<u32>,
    /// Where they lie [m], in [0, size].
    pub places: Vec<DVec2>,
    /// Triangles as indices into `places`.
    pub triangles: Vec<[u32; 3]>,
    /// Width and height of the box [m].
    pub size: DVec2,
    /// Area of the chart [m2].
    pub area: f64,
}

/// The charts of an unwrapped mesh in the order of their ids, each turned so that its bounding box is as small
/// as it gets: the smallest box has a side along an edge of the convex hull (Freeman and Shapira 1975), so the
/// long straight edges of a chart land on texel edges.
pub(super) fn charts_of(mesh: &Unwrapped) -> Vec<Chart> {
    let mut charts: Vec<Chart> = (0..mesh.chart_count)
        .map(|_| Chart {
            vertices: Vec::new(),
            places: Vec::new(),
            triangles: Vec::new(),
            size: DVec2::ZERO,
            area: 0.0,
        })
        .collect();
    let mut chart_of_vertex = vec![NO_CHART; mesh.vertices.len()];
    for (t, &c) in mesh.triangles.iter().zip(&mesh.charts) {
        if c != NO_CHART {
            t.iter().for_each(|&v| chart_of_vertex[v as usize] = c);
        }
    }
    let mut local = vec![0u32; mesh.vertices.len()];
    for (v, &c) in chart_of_vertex.iter().enumerate() {
        if c != NO_CHART {
            let chart = &mut charts[c as usize];
            local[v] = chart.vertices.len() as u32;
            chart.vertices.push(v as u32);
            chart.places.push(mesh.vertices[v].uv);
        }
    }
    for (t, &c) in mesh.triangles.iter().zip(&mesh.charts) {
        if c != NO_CHART {
            charts[c as usize].triangles.push(t.map(|v| local[v as usize]));
        }
    }
    charts.iter_mut().for_each(Chart::turn_into_smallest_box);
    charts
}

impl Chart {
    fn turn_into_smallest_box(&mut self) {
        let hull = convex_hull(&self.places);
        let mut best = (f64::INFINITY, DVec2::X);
        for k in 0..hull.len() {
            let along = (hull[(k + 1) % hull.len()] - hull[k]).normalize_or_zero();
            if along == DVec2::ZERO {
                continue;
            }
            let (lo, hi) = bounds(hull.iter().map(|&p| turned(p, along)));
            let size = hi - lo;
            // Edges of one straight line differ in the last digits only: take the first of them.
            if size.x * size.y < best.0 * (1.0 - 1e-9) {
                best = (size.x * size.y, along);
            }
        }
        for p in &mut self.places {
            *p = turned(*p, best.1);
        }
        let (lo, hi) = bounds(self.places.iter().copied());
        for p in &mut self.places {
            *p -= lo;
        }
        self.size = hi - lo;
        self.area = self.triangles.iter().map(|t| signed_area(&t.map(|v| self.places[v as usize])).abs()).sum();
    }

    /// Width and height in texels at `density` [texels/m]: whole texels, at least one. The chart is stretched
    /// to fill them, so that its straight sides lie on texel edges and strips thinner than a texel still
    /// cover the texels they get.
    pub fn texels(&self, density: f64) -> [u32; 2] {
        self.size.to_array().map(|s| (s * density).round().clamp(1.0, 1e9) as u32)
    }

    /// Texels of the chart's box that its triangles touch, at the size given in texels.
    pub fn footprint(&self, texels: [u32; 2]) -> Mask {
        let scale = scale_to(self.size, texels);
        let mut mask = Mask::new(texels[0], texels[1]);
        for t in &self.triangles {
            mask.cover(&t.map(|v| self.places[v as usize] * scale));
        }
        mask
    }

    /// Share of the chart's box that it covers.
    pub fn fill(&self) -> f64 {
        self.area / (self.size.x * self.size.y).max(f64::MIN_POSITIVE)
    }
}

/// Factors from a chart of `size` [m] to `texels`.
pub(super) fn scale_to(size: DVec2, texels: [u32; 2]) -> DVec2 {
    DVec2::new(f64::from(texels[0]), f64::from(texels[1])) / size.max(DVec2::splat(f64::MIN_POSITIVE))
}

/// `p` in the frame whose x axis is the unit vector `along`.
fn turned(p: DVec2, along: DVec2) -> DVec2 {
    DVec2::new(along.dot(p), along.perp_dot(p))
}

fn bounds(points: impl Iterator<Item = DVec2>) -> (DVec2, DVec2) {
    points.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)))
}

/// Corners of the convex hull in order (Andrew's monotone chain, 1979).
fn convex_hull(points: &[DVec2]) -> Vec<DVec2> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    sorted.dedup();
    if sorted.len() < 3 {
        return sorted;
    }
    let mut hull: Vec<DVec2> = Vec::new();
    let mut chain = |points: &mut dyn Iterator<Item = DVec2>| {
        let start = hull.len();
        for p in points {
            while hull.len() >= start + 2
                && (hull[hull.len() - 1] - hull[hull.len() - 2]).perp_dot(p - hull[hull.len() - 1]) <= 0.0
            {
                hull.pop();
            }
            hull.push(p);
        }
        hull.pop();
    };
    chain(&mut sorted.iter().copied());
    chain(&mut sorted.iter().rev().copied());
    hull
}

/// A small bitmap, row-major, 64 texels a word.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Mask {
    pub width: u32,
    pub height: u32,
    words: usize,
    bits: Vec<u64>,
}

/// Coordinates within this of a texel edge lie on it [texels].
const ON_EDGE: f64 = 1e-6;

impl Mask {
    pub fn new(width: u32, height: u32) -> Mask {
        let words = (width as usize).div_ceil(64);
        Mask { width, height, words, bits: vec![0; words * height as usize] }
    }

    fn set(&mut self, x: u32, y: u32) {
        self.bits[y as usize * self.words + x as usize / 64] |= 1 << (x % 64);
    }

    fn set_span(&mut self, y: u32, x0: u32, x1: u32) {
        let row = y as usize * self.words;
        for_words(x0 as usize, x1 as usize, |w, bits| self.bits[row + w] |= bits);
    }

    /// Sets every texel whose inside the triangle [texels] touches.
    pub fn cover(&mut self, t: &[DVec2; 3]) {
        let texel = |v: f64, n: u32| v.floor().clamp(0.0, f64::from(n - 1)) as u32;
        let (lo, hi) = bounds(t.iter().copied());
        for y in texel(lo.y + ON_EDGE, self.height)..=texel(hi.y - ON_EDGE, self.height) {
            if let Some((x0, x1)) = extent_in_strip(t, f64::from(y), f64::from(y + 1)) {
                let (x0, x1) = (texel(x0 + ON_EDGE, self.width), texel(x1 - ON_EDGE, self.width));
                self.set_span(y, x0, x1.max(x0) + 1);
            }
        }
    }

    /// The mask grown by `by` texels in all eight directions; its size grows by twice that.
    pub fn dilated(&self, by: u32) -> Mask {
        let mut wide = Mask::new(self.width + 2 * by, self.height);
        for y in 0..self.height {
            for (x0, x1) in self.spans(y) {
                wide.set_span(y, x0, x1 + 2 * by);
            }
        }
        let mut out = Mask::new(wide.width, self.height + 2 * by);
        for y in 0..self.height as usize {
            let row = &wide.bits[y * wide.words..][..wide.words];
            for up in 0..=2 * by as usize {
                for (o, &w) in out.bits[(y + up) * wide.words..].iter_mut().zip(row) {
                    *o |= w;
                }
            }
        }
        out
    }

    /// The mask on a grid of `cell` x `cell` texels: a cell is set if any of its texels is.
    pub fn coarse(&self, cell: u32) -> Mask {
        if cell == 1 {
            return self.clone();
        }
        let mut out = Mask::new(self.width.div_ceil(cell), self.height.div_ceil(cell));
        for y in 0..self.height {
            for (x0, x1) in self.spans(y) {
                out.set_span(y / cell, x0 / cell, x1.div_ceil(cell));
            }
        }
        out
    }

    /// The mask after `turns` quarter turns that take +x to +y.
    pub fn turned(&self, turns: u32) -> Mask {
        let [w, h] = if turns.is_multiple_of(2) { [self.width, self.height] } else { [self.height, self.width] };
        let mut out = Mask::new(w, h);
        for y in 0..self.height {
            for (x0, x1) in self.spans(y) {
                for x in x0..x1 {
                    match turns % 4 {
                        0 => out.set(x, y),
                        1 => out.set(self.height - 1 - y, x),
                        2 => out.set(self.width - 1 - x, self.height - 1 - y),
                        _ => out.set(y, self.width - 1 - x),
                    }
                }
            }
        }
        out
    }

    /// The runs [x0, x1) of set texels in a row, in order.
    pub fn spans(&self, y: u32) -> Vec<(u32, u32)> {
        let mut spans: Vec<(u32, u32)> = Vec::new();
        let row = &self.bits[y as usize * self.words..][..self.words];
        for (k, &word) in row.iter().enumerate() {
            let (mut rest, mut at) = (word, 64 * k as u32);
            while rest != 0 {
                let skip = rest.trailing_zeros();
                at += skip;
                rest >>= skip;
                let run = rest.trailing_ones();
                match spans.last_mut() {
                    Some(last) if last.1 == at => last.1 = at + run,
                    _ => spans.push((at, at + run)),
                }
                at += run;
                rest = if run == 64 { 0 } else { rest >> run };
            }
        }
        spans
    }
}

/// Calls `f` with each word that the bits [x0, x1) touch and the bits in it.
pub(super) fn for_words(x0: usize, x1: usize, mut f: impl FnMut(usize, u64)) {
    if x0 >= x1 {
        return;
    }
    let (first, last) = (x0 / 64, (x1 - 1) / 64);
    for w in first..=last {
        let low = if w == first { u64::MAX << (x0 % 64) } else { u64::MAX };
        let high = if w == last { u64::MAX >> (63 - (x1 - 1) % 64) } else { u64::MAX };
        f(w, low & high);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slanted_rectangle_is_turned_upright() {
        let along = DVec2::from_angle(0.4);
        let corner = |x: f64, y: f64| along * x + along.perp() * y;
        let places = vec![corner(0.0, 0.0), corner(3.0, 0.0), corner(3.0, 1.0), corner(0.0, 1.0)];
        let mut chart = Chart {
            vertices: vec![0, 1, 2, 3],
            places,
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            size: DVec2::ZERO,
            area: 0.0,
        };
        chart.turn_into_smallest_box();
        let mut sides = chart.size.to_array();
        sides.sort_by(f64::total_cmp);
        assert!((sides[0] - 1.0).abs() < 1e-9 && (sides[1] - 3.0).abs() < 1e-9, "{sides:?}");
        assert!((chart.fill() - 1.0).abs() < 1e-9);
        let texels = chart.texels(10.0);
        let mask = chart.footprint(texels);
        assert!((0..texels[1]).all(|y| mask.spans(y) == [(0, texels[0])]));
    }

    #[test]
    fn masks_grow_turn_and_coarsen() {
        let mut mask = Mask::new(70, 3);
        mask.set(0, 0);
        mask.set_span(1, 60, 70);
        assert_eq!(mask.spans(1), [(60, 70)]);
        let grown = mask.dilated(2);
        assert_eq!((grown.width, grown.height), (74, 7));
        assert_eq!(grown.spans(1), [(0, 5), (60, 74)]);
        assert_eq!(mask.turned(1).turned(3), mask);
        assert_eq!(mask.turned(2).turned(2), mask);
        assert_eq!(mask.turned(1).spans(0), [(2, 3)]);
        assert_eq!(mask.coarse(4).spans(0), [(0, 1), (15, 18)]);
    }
}
