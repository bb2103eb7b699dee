//! Irradiance between cells: a plane fitted around each, blended where they meet.

use super::index::CellIndex;
use super::links::{Cells, middle_of};
use super::tree::{Element, SurfaceTree};
use super::{Caught, Samples};
use crate::accel::Accel;
use glam::{DMat3, DVec3, Vec3};
use rayon::prelude::*;
use std::ops::Range;

/// A plane is fitted to its cell and those around it whose centres are nearer than this many sides of the cell,
/// with a weight that falls linearly to 0 there.
pub(super) const FIT_REACH: f32 = 1.2;

/// A plane counts up to this many sides of its cell away from the centre.
pub(super) const BLEND_REACH: f32 = 1.2;

/// What cells caught and their planes do not tell is added back where its square is this many times its variance.
const SURE: f64 = 4.0;

/// Detail within a cell of n texels is told where its square is more than 1 + this / sqrt(n) times that of its noise.
const DETAIL_DOUBT: f64 = 3.0;

/// So many samples that found light in one element say nothing yet.
const CHANCE: f64 = 3.0;

/// Elements in a part of a cell over those in its parts.
const DETAIL_STEP: usize = 8;

/// Each cell is put right in so many steps, each of which finds most of what is left.
const STEPS: usize = 2;

/// Regions of so many cells then are put right as a whole.
const REGIONS: [usize; 4] = [usize::MAX, 1024, 128, 16];

/// Cells whose normals are further apart than this have nothing to do with each other.
pub(super) const LEAST_COSINE: f32 = 0.7;

/// Nor cells that lie above each other: by more than this share of their distance, along the mean of their normals,
/// in which cells of an arc are level.
const MOST_STEEP: f32 = 0.25;

/// A cell with the moments that fits need. All about `centre`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cell {
    area: f64,
    /// Centroid of its area [frame units].
    pub(super) centre: Vec3,
    /// The element nearest to it.
    pub(super) middle: Element,
    pub(super) normal: Vec3,
    /// Side of the square with the same variance [frame units].
    pub(super) side: f32,
    /// Largest distance of an element's centroid from the centre [frame units].
    radius: f32,
    /// Second moment of the area, over the area.
    covariance: DMat3,
    flux: DVec3,
    /// Variance of the flux, for all channels.
    variance: f64,
    /// First moment of the flux per channel.
    moment: [DVec3; 3],
}

/// E(x) = value + gradient . (x - centre) per channel.
#[derive(Debug, Clone, Copy)]
struct Plane {
    value: Vec3,
    gradient: [Vec3; 3],
}

/// Irradiance (lux) of every element and the side of its cell [frame units], in the order of the tree. `caught` is that
/// of one half, `cells` its cells; the variance of a cell's flux, for all channels, is that of its elements times the
/// `dispersion` there, and what samples of one element show of theirs is to be taken times `scatter` there.
pub fn reconstruct(
    tree: &SurfaceTree,
    cells: &Cells,
    caught: &Caught,
    [dispersion, scatter]: [&[f32]; 2],
    accel: &Accel,
) -> (Vec<Vec3>, Vec<f32>) {
    let moments: Vec<Cell> =
        cells.ranges.par_iter().map(|r| Cell::new(tree, &cells.order[r.clone()], caught, dispersion)).collect();
    let index = CellIndex::new(&moments);
    let around: Vec<Vec<u32>> = (0..moments.len()).into_par_iter().map(|i| index.around(&moments, i, accel)).collect();
    let planes: Vec<Plane> = (0..moments.len()).into_par_iter().map(|i| fit(&moments, i, &around[i])).collect();
    let fitted = Fitted { tree, cells, moments: &moments, around: &around, caught, scatter };
    let mut parts: Vec<Vec<Vec3>> =
        (0..moments.len()).into_par_iter().map(|i| fitted.blend(i, |j, d| planes[j].at(d))).collect();
    (0..STEPS).for_each(|_| fitted.give_back(&mut parts));
    if let Some(samples) = &caught.samples {
        fitted.give_detail_back(&mut parts, samples);
    }
    REGIONS.iter().for_each(|&size| fitted.keep_energy(&mut parts, size));
    let mut out = vec![Vec3::ZERO; tree.elements.len()];
    cells.order.iter().zip(parts.iter().flatten()).for_each(|(&k, &e)| out[k as usize] = e);
    let mut sides = vec![0.0; tree.elements.len()];
    for (range, cell) in cells.ranges.iter().zip(&moments) {
        cells.order[range.clone()].iter().for_each(|&k| sides[k as usize] = cell.side);
    }
    (out, sides)
}

/// Cells and what their planes must agree with.
struct Fitted<'a> {
    tree: &'a SurfaceTree,
    cells: &'a Cells,
    moments: &'a [Cell],
    around: &'a [Vec<u32>],
    caught: &'a Caught,
    scatter: &'a [f32],
}

impl Fitted<'_> {
    fn elements(&self, i: usize) -> impl Iterator<Item = &Element> {
        self.cells.order[self.cells.ranges[i].clone()].iter().map(|&k| &self.tree.elements[k as usize])
    }

    /// Flux that each cell caught and that `parts`, the irradiance of its elements, do not tell.
    fn missing(&self, parts: &[Vec<Vec3>]) -> Vec<DVec3> {
        let told = |i: usize| -> DVec3 {
            self.elements(i).zip(&parts[i]).map(|(e, v)| f64::from(e.area) * v.as_dvec3()).sum()
        };
        (0..parts.len()).into_par_iter().map(|i| self.moments[i].flux - told(i)).collect()
    }

    /// Scales the light of regions of `size` cells to what they caught. Planes that are cut off at 0 or reach into darker
    /// cells add light; large dark cells, which reach further into small bright ones than these into them, take some.
    /// All of what is missing is given back, for its noise is little beside that of the cells themselves.
    fn keep_energy(&self, parts: &mut [Vec<Vec3>], size: usize) {
        let missing = self.missing(parts);
        let size = size.min(parts.len().max(1));
        parts.par_chunks_mut(size).enumerate().for_each(|(region, parts)| {
            let (mut caught, mut lost) = (DVec3::ZERO, DVec3::ZERO);
            let cells = region * size..region * size + parts.len();
            for (cell, missing) in self.moments[cells.clone()].iter().zip(&missing[cells]) {
                caught += cell.flux;
                lost += *missing;
            }
            let told = (caught - lost).max(DVec3::splat(1e-300));
            let factor = DVec3::ONE + lost / told;
            let factor = factor.clamp(DVec3::splat(0.5), DVec3::splat(2.0)).as_vec3();
            if factor != Vec3::ONE {
                parts.iter_mut().flatten().for_each(|v| *v *= factor);
            }
        });
    }

    /// What `value(j, x - centre of j)` gives for the cells j around each element of cell `i`, its centroid being x, by a
    /// partition of unity.
    fn blend(&self, i: usize, value: impl Fn(usize, Vec3) -> Vec3) -> Vec<Vec3> {
        let own = &self.moments[i];
        // Side by side, for every element looks at all of them.
        let near: Vec<(Vec3, f32, f32, u32)> = self.around[i]
            .iter()
            .map(|&j| (&self.moments[j as usize], j))
            .map(|(c, j)| (c.centre, BLEND_REACH * c.side, if j as usize == i { 1.0 } else { c.fill() }, j))
            .filter(|&(centre, reach, _, j)| j as usize == i || centre.distance(own.centre) < reach + own.radius)
            .collect();
        let blended = |e: &Element| {
            let (mut sum, mut weight) = (Vec3::ZERO, 0.0);
            for &(centre, reach, fill, j) in &near {
                let d = e.position - centre;
                let square = d.length_squared();
                if square >= reach * reach && j as usize != i {
                    continue;
                }
                let mut w = 1.0 - square.sqrt() / reach;
                if j as usize == i {
                    w = w.max(0.01);
                }
                w = w * w * fill;
                sum += w * value(j as usize, d);
                weight += w;
            }
            sum / weight
        };
        self.elements(i).map(blended).collect()
    }

    /// Adds the detail within each cell that is more than noise: edges of shadows that planes do not tell. First as far
    /// as the whole cell shows it, then parts of it, then single elements.
    fn give_detail_back(&self, parts: &mut [Vec<Vec3>], samples: &Samples) {
        // Sums over each cell of the scatter, and of flux, mean over the channels, times grain.
        let sums: Vec<(f64, f64)> = self.cells.ranges.par_iter().map(|r| self.noise_sums(r.clone(), samples)).collect();
        parts.par_iter_mut().enumerate().for_each(|(i, values)| {
            let elements = &self.cells.order[self.cells.ranges[i].clone()];
            let around = self.around[i].iter().map(|&j| sums[j as usize]);
            let (scatter, grains) = around.fold((0.0, 0.0), |s, c| (s.0 + c.0, s.1 + c.1));
            let noise = if grains > 0.0 { scatter / grains } else { 0.0 };
            let mut details: Vec<Detail> =
                elements.iter().zip(&*values).map(|(&k, &v)| self.detail(k, v, noise, samples)).collect();
            let mut size = elements.len();
            details.chunks_mut(size).for_each(Detail::tell);
            while size > 1 {
                size = size.div_ceil(DETAIL_STEP);
                details.chunks_mut(size).for_each(Detail::tell);
            }
            if details.iter().any(|d| d.left < 1.0) {
                let told = details.iter().map(|d| d.raw - d.difference);
                values.iter_mut().zip(told).for_each(|(v, told)| *v = told.max(Vec3::ZERO));
            }
        });
    }

    /// What element `k` caught beside `value`, its irradiance so far, where `noise` is the variance of flux over the
    /// flux times the grain.
    fn detail(&self, k: u32, value: Vec3, noise: f64, samples: &Samples) -> Detail {
        let k = k as usize;
        let area = self.tree.elements[k].area;
        let expected = noise * f64::from(samples.grain[k]) * f64::from(value.element_sum() / 3.0 * area);
        let channels = f64::from(self.scatter[k]) / f64::from(area);
        let raw = Vec3::from(self.caught.flux[k]) / area;
        Detail {
            raw,
            difference: raw - value,
            area: f64::from(area),
            seen: samples.scatter[k] * channels,
            expected: expected * channels,
            chance: 3.0 * (CHANCE * noise * f64::from(samples.grain[k])).powi(2) / f64::from(area),
            left: 1.0,
        }
    }

    fn noise_sums(&self, range: Range<usize>, samples: &Samples) -> (f64, f64) {
        self.cells.order[range].iter().map(|&k| k as usize).fold((0.0, 0.0), |(scatter, grains), k| {
            let flux = f64::from(self.caught.flux[k].iter().sum::<f32>()) / 3.0;
            (scatter + samples.scatter[k], grains + flux * f64::from(samples.grain[k]))
        })
    }

    /// Adds what cells miss for sure, blended as their planes are: those no larger than what they show would stay
    /// smoothed however many photons there are.
    fn give_back(&self, parts: &mut [Vec<Vec3>]) {
        let missing = self.missing(parts).into_iter().enumerate();
        let back: Vec<Vec3> =
            missing.map(|(i, m)| (m * (sure(m, self.moments[i].variance) / self.moments[i].area)).as_vec3()).collect();
        parts.par_iter_mut().enumerate().for_each(|(i, values)| {
            if self.around[i].iter().all(|&j| back[j as usize] == Vec3::ZERO) {
                return;
            }
            let more = self.blend(i, |j, _| back[j]);
            values.iter_mut().zip(more).for_each(|(v, m)| *v = (*v + m).max(Vec3::ZERO));
        });
    }
}

/// The share of a difference that is not noise of this variance (James and Stein).
fn sure(difference: DVec3, variance: f64) -> f64 {
    (1.0 - SURE * variance / difference.length_squared().max(1e-300)).max(0.0)
}

/// Whether two cells may be parts of one smooth surface: turned to the same side, and neither above the other.
pub(super) fn alike(a: &Cell, b: &Cell) -> bool {
    let d = b.centre - a.centre;
    let above = (a.normal + b.normal).normalize_or_zero().dot(d).abs();
    a.normal.dot(b.normal) >= LEAST_COSINE && above <= MOST_STEEP * d.length()
}

/// What one element caught beside what is told of it.
struct Detail {
    /// Irradiance by what it caught alone (lux).
    raw: Vec3,
    /// That above what is told.
    difference: Vec3,
    area: f64,
    /// Area times squared difference by noise alone while nothing is told, as the samples show it; none shows in what
    /// caught nothing.
    seen: f64,
    /// The same as it is where so much light falls.
    expected: f64,
    /// The same by a few samples that chance brought together.
    chance: f64,
    /// Share of the first difference that is left.
    left: f32,
}

impl Detail {
    /// Tells as much of the differences of some elements as is more than noise.
    fn tell(details: &mut [Detail]) {
        let square: f64 = details.iter().map(|d| d.area * f64::from(d.difference.length_squared())).sum();
        let noise = |of: fn(&Detail) -> f64| details.iter().map(|d| of(d) * f64::from(d.left).powi(2)).sum::<f64>();
        let chance = details.iter().map(|d| d.chance).fold(0.0, f64::max);
        let noise = noise(|d| d.seen).max(noise(|d| d.expected)) + chance;
        let doubt = 1.0 + DETAIL_DOUBT / (details.len() as f64).sqrt();
        if square <= doubt * noise {
            return;
        }
        let keep = (doubt * noise / square) as f32;
        details.iter_mut().for_each(|d| (d.difference, d.left) = (d.difference * keep, d.left * keep));
    }
}

impl Plane {
    fn at(&self, d: Vec3) -> Vec3 {
        (self.value + Vec3::from(self.gradient.map(|g| g.dot(d)))).max(Vec3::ZERO)
    }
}

impl Cell {
    /// How much of the square of its side it fills: a strip along a wall knows nothing of the floor around its middle.
    fn fill(&self) -> f32 {
        (self.area as f32 / (self.side * self.side)).min(1.0)
    }

    pub(super) fn new(tree: &SurfaceTree, elements: &[u32], caught: &Caught, dispersion: &[f32]) -> Cell {
        let variance = elements.iter().map(|&k| caught.variance[k as usize] * f64::from(dispersion[k as usize])).sum();
        let parts = || elements.iter().map(|&k| (&tree.elements[k as usize], &caught.flux[k as usize]));
        let (mut area, mut centre, mut normal) = (0.0, DVec3::ZERO, DVec3::ZERO);
        for (e, _) in parts() {
            let a = f64::from(e.area);
            area += a;
            centre += a * e.position.as_dvec3();
            normal += a * e.normal.as_dvec3();
        }
        let centre = (centre / area).as_vec3();
        let (mut covariance, mut total, mut moment) = (DMat3::ZERO, DVec3::ZERO, [DVec3::ZERO; 3]);
        for (e, f) in parts() {
            let (d, f) = ((e.position - centre).as_dvec3(), DVec3::from(f.map(f64::from)));
            // A texel is a small square itself.
            let own = DMat3::from_diagonal(DVec3::splat(f64::from(e.area) / 12.0));
            covariance += f64::from(e.area) * (outer(d, d) + own);
            total += f;
            (0..3).for_each(|c| moment[c] += f[c] * d);
        }
        let covariance = covariance * (1.0 / area);
        let trace = covariance.x_axis.x + covariance.y_axis.y + covariance.z_axis.z;
        Cell {
            area,
            centre,
            middle: *middle_of(parts().map(|(e, _)| e)),
            normal: normal.as_vec3().normalize_or_zero(),
            side: (6.0 * trace).sqrt() as f32,
            radius: parts().map(|(e, _)| e.position.distance(centre)).fold(0.0, f32::max),
            covariance,
            flux: total,
            variance,
            moment,
        }
    }
}

fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

/// Weighted least squares over the cell and those around it.
fn fit(cells: &[Cell], i: usize, around: &[u32]) -> Plane {
    let own = &cells[i];
    let reach = FIT_REACH * own.side;
    // Sums of w A, w A x, w A x x, w F, w F x.
    let (mut area, mut first, mut second) = (0.0, DVec3::ZERO, DMat3::ZERO);
    let (mut flux, mut moment) = (DVec3::ZERO, [DVec3::ZERO; 3]);
    let mut variance = 0.0;
    for &j in around {
        let c = &cells[j as usize];
        let d = c.centre - own.centre;
        let w = f64::from(1.0 - d.length() / reach);
        if w <= 0.0 {
            continue;
        }
        let d = d.as_dvec3();
        area += w * c.area;
        variance += w * w * c.variance;
        first += w * c.area * d;
        second += (c.covariance + outer(d, d)) * (w * c.area);
        flux += w * c.flux;
        (0..3).for_each(|k| moment[k] += w * (c.moment[k] + c.flux[k] * d));
    }
    let (mean, middle) = (flux / area, first / area);
    let scatter = second * (1.0 / area) - outer(middle, middle);
    let trace = scatter.x_axis.x + scatter.y_axis.y + scatter.z_axis.z;
    if trace <= 0.0 || mean.max_element() <= 0.0 {
        return Plane { value: mean.as_vec3(), gradient: [Vec3::ZERO; 3] };
    }
    // Across the surface there is no extent: the ridge keeps the gradient within it.
    let inverse = (scatter + DMat3::from_diagonal(DVec3::splat(1e-3 * trace))).inverse();
    let slope: [DVec3; 3] = std::array::from_fn(|k| inverse * (moment[k] / area - middle * mean[k]));
    // Shrunk by the share of its own explained square that noise explains (James and Stein), two directions for
    // each channel.
    let explained: f64 = (0..3).map(|k| slope[k].dot(scatter * slope[k])).sum::<f64>() * area;
    let by_noise = 2.0 * variance / area;
    let keep = if explained > 0.0 { (1.0 - by_noise / explained).max(0.0) } else { 0.0 };
    let slope = slope.map(|s| s * keep);
    let value: DVec3 = DVec3::from(std::array::from_fn::<f64, 3, _>(|k| mean[k] - slope[k].dot(middle)));
    Plane { value: value.as_vec3(), gradient: slope.map(|s| s.as_vec3()) }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::cell::Setting;

    pub fn elements(normals: impl Fn(u32) -> Vec3) -> Vec<Element> {
        let at = |i: u32| Vec3::new((i % 16) as f32, 0.0, (i / 16) as f32);
        let element = |i| Element { position: at(i), normal: normals(i), area: 1.0, texel: i, setting: Setting::Free };
        (0..256).map(element).collect()
    }

    pub fn cells_of(tree: &SurfaceTree, size: usize) -> (Cells, Caught) {
        let n = tree.elements.len();
        let ranges = (0..n).step_by(size).map(|i| i..(i + size).min(n)).collect();
        let cells = Cells { order: (0..n as u32).collect(), ranges };
        (cells, Caught { flux: vec![[1.0, 2.0, 3.0]; n], variance: vec![1e-4; n], samples: None })
    }

    /// A cell on both sides of a thin sheet has no normal, and yet its own light.
    #[test]
    fn a_cell_of_all_directions_keeps_its_light() {
        let tree = SurfaceTree::of(elements(|i| if i % 2 == 0 { Vec3::Y } else { -Vec3::Y }));
        let (cells, caught) = cells_of(&tree, 256);
        let (light, _) = reconstruct(&tree, &cells, &caught, [&[1.0; 256], &[]], &Accel::build(&[], |_| false));
        assert!(light.iter().all(|e| (*e - Vec3::new(1.0, 2.0, 3.0)).length() < 1e-4), "{:?}", light[0]);
    }
}
