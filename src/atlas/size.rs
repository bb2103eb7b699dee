//! What charts take of the pages at a density, gutters included.

use super::Atlas;
use super::density::Unit;
use super::layout::Unwrapping;
use crate::bisect::bisected;
use crate::options::BakeOptions;

/// Part of a page that charts and their gutters fill.
const FILL: f64 = 0.85;

/// What a chart takes, all its instances together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChartSize {
    /// Texels of the chart, of the gutters at its sides, and of those at its corners, at the even density.
    pub texels: [f64; 3],
    /// The largest density that fits on a page, relative to the even one.
    pub most: f64,
}

impl ChartSize {
    /// Texels at `factor` times the even density.
    pub fn at(&self, factor: f64) -> f64 {
        let [chart, sides, corners] = self.texels;
        chart * factor * factor + sides * factor + corners
    }
}

fn size(unit: &Unit, chart: usize, density: f64, options: &BakeOptions) -> ChartSize {
    let (c, d, gutter) = (&unit.charts[chart], density * unit.density, f64::from(options.gutter));
    let sum = |power: i32| match unit.instances[..] {
        [] => 1.0,
        _ => unit.instances.iter().map(|k| k.powi(power)).sum::<f64>(),
    };
    let texels = [sum(2) * c.area * d * d, sum(1) * gutter * (c.size.x + c.size.y) * d, sum(0) * gutter * gutter];
    let room = (f64::from(options.max_texture) - gutter).max(1.0);
    ChartSize { texels, most: room / (c.size.max_element() * d).max(1e-9) }
}

impl Unwrapping<'_> {
    /// The density [texels/m] at which charts of one density about fill a page.
    pub fn even_density(&self, options: &BakeOptions) -> f64 {
        let page = FILL * f64::from(options.max_texture).powi(2);
        let short = |density: f64| self.sizes(density, options).iter().map(|s| s.at(1.0)).sum::<f64>() < page;
        let (mut low, mut high) = (0.0, 1.0);
        while short(high) && high < 1e9 {
            (low, high) = (high, 2.0 * high);
        }
        (low, high) = bisected(low, high, 40, short);
        0.5 * (low + high)
    }

    /// What each chart of all meshes takes where the even density is `density` [texels/m].
    pub fn sizes(&self, density: f64, options: &BakeOptions) -> Vec<ChartSize> {
        let of = |u| move |c| size(u, c, density, options);
        self.units.iter().flat_map(|u: &Unit| (0..u.charts.len()).map(of(u))).collect()
    }

    /// For each global chart of `atlas`, which must be laid out from these charts, its place among all of them.
    pub fn places(&self, atlas: &Atlas) -> Vec<usize> {
        let mut out = vec![0; atlas.first_chart.last().map_or(0, |&n| n as usize)];
        let mut before = 0;
        for (unit, instances) in self.units.iter().zip(self.instances()) {
            let charts = unit.charts.len();
            for &i in instances {
                let first = atlas.first_chart[i] as usize;
                (0..charts).for_each(|c| out[first + c] = before + c);
            }
            before += charts;
        }
        out
    }

    /// Sets the density of each chart of all meshes, relative to the even one; whether there are as many of them.
    pub fn set_densities(&mut self, factors: &[f64]) -> bool {
        if factors.len() != self.units.iter().map(|u| u.factors.len()).sum::<usize>() {
            return false;
        }
        let mut factors = factors.iter();
        self.units.iter_mut().for_each(|u| u.factors.iter_mut().zip(&mut factors).for_each(|(to, f)| *to = *f));
        true
    }
}
