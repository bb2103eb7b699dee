//! The packer: puts shapes on a page so that none meets another.
//!
//! A page is a bitmap of cells. Shapes are tried from large to small, in all quarter turns they allow, and go
//! to the first free place in reading order at which their lower edge ends highest. A row of a shape that hits
//! something jumps behind it, and equal rectangles go on searching where the last one was found, so a full
//! page of 30,000 charts takes a fraction of a second.

use super::chart::{Mask, for_words};
use std::collections::HashMap;

/// A shape in one orientation, in cells.
#[derive(Debug, Clone)]
pub(super) struct Shape {
    pub width: u32,
    pub height: u32,
    /// Runs (row, x0, x1), the widest first: it is the likeliest to be blocked.
    spans: Vec<(u32, u32, u32)>,
    /// True for a full rectangle.
    full: bool,
}

impl Shape {
    /// A full rectangle.
    pub fn rectangle(width: u32, height: u32) -> Shape {
        Shape { width, height, spans: (0..height).map(|y| (y, 0, width)).collect(), full: true }
    }

    /// The set cells of a mask.
    pub fn from_mask(mask: &Mask) -> Shape {
        let mut spans: Vec<(u32, u32, u32)> =
            (0..mask.height).flat_map(|y| mask.spans(y).into_iter().map(move |(a, b)| (y, a, b))).collect();
        spans.sort_by_key(|&(y, a, b)| (std::cmp::Reverse(b - a), y));
        let full = spans.len() == mask.height as usize && spans.iter().all(|&(_, a, b)| b - a == mask.width);
        Shape { width: mask.width, height: mask.height, spans, full }
    }

    /// Number of cells.
    pub fn cells(&self) -> u64 {
        self.spans.iter().map(|&(_, a, b)| u64::from(b - a)).sum()
    }
}

/// Something to pack: its shape in each allowed orientation.
#[derive(Debug, Clone)]
pub(super) struct Item {
    /// Quarter turns and the shape after them.
    pub turns: Vec<(u32, Shape)>,
}

impl Item {
    /// Sort key: large first.
    pub fn order(&self) -> impl Ord + use<> {
        let s = &self.turns[0].1;
        (std::cmp::Reverse(s.width.max(s.height)), std::cmp::Reverse(s.width.min(s.height)))
    }
}

/// Where an item went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Spot {
    /// Quarter turns.
    pub turns: u32,
    /// Left column of the turned shape [cells].
    pub x: u32,
    /// Top row of the turned shape [cells].
    pub y: u32,
}

/// A page being filled.
#[derive(Debug, Clone)]
pub(super) struct Bitmap {
    width: u32,
    height: u32,
    words: usize,
    bits: Vec<u64>,
    /// Longest free run of each row: where a shape's widest run is longer, the row needs no look.
    longest_free: Vec<u32>,
    /// Where the last rectangle of a size was found. All earlier places are taken for good.
    searched: HashMap<(u32, u32), (u32, u32)>,
    /// Cells still free.
    pub free: u64,
    /// Rows in use.
    pub used_height: u32,
    /// Columns in use.
    pub used_width: u32,
}

impl Bitmap {
    /// An empty page of the given size [cells].
    pub fn new(width: u32, height: u32) -> Bitmap {
        let words = (width as usize).div_ceil(64);
        Bitmap {
            width,
            height,
            words,
            bits: vec![0; words * height as usize],
            longest_free: vec![width; height as usize],
            searched: HashMap::new(),
            free: u64::from(width) * u64::from(height),
            used_height: 0,
            used_width: 0,
        }
    }

    /// Places `item` where its lower edge ends highest; `None` where it does not fit any more.
    pub fn place(&mut self, item: &Item) -> Option<Spot> {
        let mut best: Option<(u32, Spot, &Shape)> = None;
        for (turns, shape) in &item.turns {
            let limit = best.map_or(self.height, |(end, ..)| end);
            if let Some((x, y)) = self.search(shape, limit) {
                let end = y + shape.height;
                if best.is_none_or(|(e, s, _)| (end, x) < (e, s.x)) {
                    best = Some((end, Spot { turns: *turns, x, y }, shape));
                }
            }
        }
        let (_, spot, shape) = best?;
        self.fill(shape, spot);
        Some(spot)
    }

    /// First place in reading order where the shape is free and ends at row `limit` or above.
    fn search(&mut self, shape: &Shape, limit: u32) -> Option<(u32, u32)> {
        if shape.width > self.width || shape.height > limit {
            return None;
        }
        let class = (shape.width, shape.height);
        let start = if shape.full { self.searched.get(&class).copied().unwrap_or((0, 0)) } else { (0, 0) };
        let (mut x, mut y) = start;
        let found = loop {
            if y + shape.height > limit {
                break None;
            }
            if let Some(x) = self.search_row(shape, x, y) {
                break Some((x, y));
            }
            (x, y) = (0, y + 1);
        };
        if shape.full {
            self.searched.insert(class, found.unwrap_or((x, y)));
        }
        found
    }

    fn search_row(&self, shape: &Shape, mut x: u32, y: u32) -> Option<u32> {
        let &(row, a, b) = shape.spans.first()?;
        if self.longest_free[(y + row) as usize] < b - a {
            return None;
        }
        'next: while x + shape.width <= self.width {
            for &(row, a, b) in &shape.spans {
                if let Some(blocked) = self.last_set(y + row, x + a, x + b) {
                    x = blocked + 1 - a;
                    continue 'next;
                }
            }
            return Some(x);
        }
        None
    }

    /// The last taken cell of [x0, x1) in a row.
    fn last_set(&self, y: u32, x0: u32, x1: u32) -> Option<u32> {
        let row = &self.bits[y as usize * self.words..][..self.words];
        let (first, last) = (x0 as usize / 64, (x1 as usize - 1) / 64);
        for w in (first..=last).rev() {
            let mut word = row[w];
            if w == last {
                word &= u64::MAX >> (63 - (x1 - 1) % 64);
            }
            if w == first {
                word &= u64::MAX << (x0 % 64);
            }
            if word != 0 {
                return Some(w as u32 * 64 + 63 - word.leading_zeros());
            }
        }
        None
    }

    fn fill(&mut self, shape: &Shape, spot: Spot) {
        for &(row, a, b) in &shape.spans {
            let start = (spot.y + row) as usize * self.words;
            for_words((spot.x + a) as usize, (spot.x + b) as usize, |w, bits| self.bits[start + w] |= bits);
        }
        for y in spot.y..spot.y + shape.height {
            self.longest_free[y as usize] = self.longest_free_run(y);
        }
        self.free -= shape.cells();
        self.used_height = self.used_height.max(spot.y + shape.height);
        self.used_width = self.used_width.max(spot.x + shape.width);
    }

    fn longest_free_run(&self, y: u32) -> u32 {
        let row = &self.bits[y as usize * self.words..][..self.words];
        let (mut longest, mut run) = (0, 0);
        for (w, &word) in row.iter().enumerate() {
            // Bits beyond the page end every run.
            let valid = (self.width as usize - 64 * w).min(64) as u32;
            let (mut rest, mut left) = (word, valid);
            while left > 0 {
                let free = rest.trailing_zeros().min(left);
                run += free;
                longest = longest.max(run);
                left -= free;
                rest = if free == 64 { 0 } else { rest >> free };
                let taken = rest.trailing_ones().min(left);
                if taken > 0 {
                    run = 0;
                    left -= taken;
                    rest = if taken == 64 { 0 } else { rest >> taken };
                }
            }
        }
        longest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rectangle(w: u32, h: u32) -> Item {
        Item { turns: vec![(0, Shape::rectangle(w, h)), (1, Shape::rectangle(h, w))] }
    }

    #[test]
    fn rectangles_fill_a_page_to_the_last_cell() {
        let mut page = Bitmap::new(100, 90);
        for _ in 0..90 {
            assert!(page.place(&rectangle(10, 10)).is_some());
        }
        assert_eq!(page.free, 0);
        assert_eq!(page.place(&rectangle(1, 1)), None);
    }

    #[test]
    fn a_shape_goes_into_the_hole_of_another() {
        let mut ring = Mask::new(9, 9);
        for y in 0..9 {
            for x in 0..9 {
                if !(3..6).contains(&x) || !(3..6).contains(&y) {
                    let (x, y) = (f64::from(x), f64::from(y));
                    ring.cover(&[[x, y], [x + 1.0, y], [x, y + 1.0]].map(Into::into));
                }
            }
        }
        let mut page = Bitmap::new(9, 9);
        assert!(page.place(&Item { turns: vec![(0, Shape::from_mask(&ring))] }).is_some());
        assert_eq!(page.place(&rectangle(3, 3)), Some(Spot { turns: 0, x: 3, y: 3 }));
        assert_eq!(page.free, 0);
    }

    #[test]
    fn a_limit_that_stopped_a_search_does_not_lose_places() {
        let mut page = Bitmap::new(20, 20);
        let tall = Item { turns: vec![(0, Shape::rectangle(20, 2)), (1, Shape::rectangle(2, 20))] };
        for _ in 0..10 {
            assert!(page.place(&tall).is_some());
        }
        assert_eq!(page.free, 0);
    }
}
