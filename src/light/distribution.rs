//! Texels drawn in proportion to a weight.

/// A distribution over the texels of a grid: a row, then a texel in it.
#[derive(Debug, Clone)]
pub(super) struct Distribution {
    width: usize,
    height: usize,
    /// Cumulative weight of rows, then of the texels of each row, each normalised to end at 1.
    rows: Vec<f64>,
    columns: Vec<f32>,
    /// Sum of all weights.
    pub(super) total: f64,
}

/// What [`Distribution::sample`] draws: a texel, and a place in it that is uniform in [0, 1]^2.
pub(super) struct Drawn {
    pub(super) x: usize,
    pub(super) y: usize,
    pub(super) within: [f64; 2],
}

impl Distribution {
    /// The weight of a texel is `texel(x, y)` times `row(y)`, both from 0.
    pub(super) fn new(
        width: usize,
        height: usize,
        texel: impl Fn(usize, usize) -> f64,
        row: impl Fn(usize) -> f64,
    ) -> Distribution {
        let mut rows = Vec::with_capacity(height);
        let mut columns = Vec::with_capacity(width * height);
        let mut total = 0.0;
        for y in 0..height {
            let mut sum = 0.0f64;
            let first = columns.len();
            for x in 0..width {
                sum += texel(x, y);
                columns.push(sum as f32);
            }
            if sum > 0.0 {
                columns[first..].iter_mut().for_each(|c| *c = (f64::from(*c) / sum) as f32);
            }
            total += sum * row(y);
            rows.push(total);
        }
        if total > 0.0 {
            rows.iter_mut().for_each(|r| *r /= total);
        }
        Distribution { width, height, rows, columns, total }
    }

    /// A texel drawn in proportion to its weight, by random numbers in [0, 1).
    pub(super) fn sample(&self, [u, v]: [f32; 2]) -> Drawn {
        let v = f64::from(v);
        let y = self.rows.partition_point(|&r| r <= v).min(self.height - 1);
        let below = if y == 0 { 0.0 } else { self.rows[y - 1] };
        let fy = ((v - below) / (self.rows[y] - below).max(1e-300)).clamp(0.0, 1.0);
        let row = &self.columns[y * self.width..(y + 1) * self.width];
        let x = row.partition_point(|&c| c <= u).min(self.width - 1);
        let left = if x == 0 { 0.0 } else { row[x - 1] };
        let fx = f64::from(((u - left) / (row[x] - left).max(1e-30)).clamp(0.0, 1.0));
        Drawn { x, y, within: [fx, fy] }
    }
}
