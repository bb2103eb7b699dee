//! The light of every texel as it stands after a round: direct light from samples, the soft part of it and that of
//! photons smoothed over cells, or gathered.

use super::shots::FluxScale;
use super::{LightPath, Solver, Surface};
use crate::accuracy::{Caustics, Halves};
use crate::cell::{Caught, Compared, Element, Node, Reconstruction, Samples, SurfaceTree, refined};
use crate::options::{Smoothing, TexelValue};
use glam::Vec3;
use rayon::prelude::*;

impl Solver<'_, '_> {
    /// Direct light by the samples of each texel alone, without the soft part of it where that is smoothed.
    pub(super) fn direct_halves(&self, smoothed: bool) -> Halves {
        let (direct, open) = (&self.direct, &self.path.surface.open);
        let whole = self.options.texel_value == TexelValue::Mean;
        let light = |h, i| direct.stored(h, i) - if smoothed { direct.soft(h, i) } else { Vec3::ZERO };
        let half = |h| {
            (0..open.len())
                .into_par_iter()
                .map(|i| light(h, i).max(Vec3::ZERO) * if whole { 1.0 } else { per_open(open[i]) })
                .collect()
        };
        Halves { odd: half(0), even: half(1) }
    }

    /// Light of surfaces and of the sky, smoothed over cells as if photons had brought it; `None` where it has no noise.
    pub(super) fn soft_light(&self) -> Option<Smooth> {
        let LightPath { surface: Surface { tree, texels, .. }, visibility, .. } = self.path;
        if self.options.smoothing != Smoothing::Cells {
            return None;
        }
        let direct = &self.direct;
        let area = |e: &Element| texels.texels[e.texel as usize].area;
        let caught = [0, 1].map(|h| {
            let flux = |e: &Element| (direct.soft(h, e.texel as usize) * area(e)).to_array();
            let variance = |e: &Element| {
                let (shown, likely) = direct.soft_variance(h, e.texel as usize);
                let square = f64::from(area(e)).powi(2);
                (shown * square, likely * square)
            };
            let (scatter, variance) = tree.elements.par_iter().map(variance).unzip();
            let grain = |e: &Element| area(e) / direct.samples(h, e.texel as usize).max(1) as f32;
            let elements = tree.elements.par_iter();
            Caught {
                flux: elements.clone().map(flux).collect(),
                variance,
                samples: Some(Samples { scatter, grain: elements.map(grain).collect() }),
            }
        });
        let noisy = caught[0].flux != caught[1].flux;
        noisy.then(|| {
            let found = Reconstruction::new(tree, [&caught[0], &caught[1]], visibility.accel);
            Smooth { caught, found }
        })
    }

    /// All light that is smoothed: that of the photons where nothing is gathered, and of `others` everywhere.
    pub(super) fn smoothed(&self, caught: &[Caught; 2], found: &Reconstruction, others: &[&Smooth]) -> Smoothed {
        let elements = &self.path.surface.tree.elements;
        let by_photons = |k: usize| {
            let instance = self.weights.instance[elements[k].texel as usize];
            if self.has_gathered(instance as usize) { 0.0 } else { 1.0 }
        };
        let values = [0, 1].map(|h| {
            let of = |k| others.iter().fold(found.values[h][k] * by_photons(k), |sum, o| sum + o.found.values[h][k]);
            (0..elements.len()).into_par_iter().map(of).collect()
        });
        let caught = [0, 1].map(|h| {
            let of = |k: usize| {
                let photons = Vec3::from(caught[h].flux[k]) * by_photons(k);
                others.iter().fold(photons, |sum, o| sum + Vec3::from(o.caught[h].flux[k])).to_array()
            };
            (0..elements.len()).into_par_iter().map(of).collect()
        });
        let blocks = others.iter().fold(found.blocks.clone(), |blocks, o| refined(&blocks, &o.found.blocks));
        Smoothed { values, caught, blocks }
    }

    /// Flux that each element caught of diffusely reflected light, in two halves.
    pub(super) fn caught(&self) -> [Caught; 2] {
        self.caught_flux(&self.diffuse.scale(), |h, texel| self.bins.flux(h, texel))
    }

    /// Light that came from lamps over mirrors and through glass alone, smoothed over cells of its own, for it has sharp
    /// edges where all else is smooth; `None` where there is none.
    pub(super) fn caustic_light(&self) -> Option<Smooth> {
        self.bins.has_caustics().then(|| {
            let caught = self.caught_flux(&self.caustics.scale(), |h, texel| self.bins.caustic_flux(h, texel));
            let found = self.reconstruct(&caught);
            Smooth { caught, found }
        })
    }

    /// Caustics as the map has them, and as surface anywhere reflects them.
    pub(super) fn caustics(&self, smooth: &Smooth) -> Caustics {
        let LightPath { surface: Surface { tree, texels, open, .. }, .. } = self.path;
        let scale = self.caustics.scale();
        let [odd, even] = [0, 1].map(|h| {
            let mut light = scattered(&tree.elements, &smooth.found.values[h], open.len(), Vec3::ZERO);
            // What has no place on the map is not smoothed.
            light.extend((open.len()..texels.texels.len()).map(|texel| {
                let flux = self.bins.caustic_flux(h, texel).map(|f| (f as f64 * scale.step) as f32);
                Vec3::from(flux) / texels.texels[texel].area.max(f32::MIN_POSITIVE)
            }));
            light
        });
        Caustics { stored: self.texel_halves(&smooth.found), everywhere: Halves { odd, even } }
    }

    fn caught_flux(&self, scale: &FluxScale, flux: impl Fn(usize, usize) -> [i64; 3] + Sync) -> [Caught; 2] {
        let elements = &self.path.surface.tree.elements;
        [0, 1].map(|h| {
            let of = |texel: u32| flux(h, texel as usize).map(|f| (f as f64 * scale.step) as f32);
            let flux: Vec<[f32; 3]> = elements.par_iter().map(|e| of(e.texel)).collect();
            let variance: Vec<f64> =
                flux.iter().map(|f| f64::from(f.iter().sum::<f32>()) / 3.0 * scale.photon).collect();
            Caught { flux, variance, samples: None }
        })
    }

    /// What `total` was before any of it was smoothed: unbiased, and noisier.
    pub(super) fn unsmoothed(&self, caught: &[Caught; 2], caustic: Option<&Smooth>) -> Halves {
        let elements = &self.path.surface.tree.elements;
        let values = [0, 1].map(|h| {
            let of = |(k, e): (usize, &Element)| {
                let gathers = self.has_gathered(self.weights.instance[e.texel as usize] as usize);
                let photons = Vec3::from(caught[h].flux[k]) / e.area;
                let found = if gathers { self.gathering.kept[&e.texel][h].light } else { photons };
                found + caustic.map_or(Vec3::ZERO, |c| Vec3::from(c.caught[h].flux[k]) / e.area)
            };
            elements.par_iter().enumerate().map(of).collect()
        });
        let indirect = Reconstruction { values, ..Reconstruction::default() };
        self.direct_halves(false).plus(&self.texel_halves(&indirect))
    }

    /// Irradiance of the elements from what they caught.
    pub(super) fn reconstruct(&self, caught: &[Caught; 2]) -> Reconstruction {
        let LightPath { surface: Surface { tree, .. }, visibility, .. } = self.path;
        let caught = [&caught[0], &caught[1]];
        match self.options.smoothing {
            Smoothing::Cells | Smoothing::Indirect => Reconstruction::new(tree, caught, visibility.accel),
            Smoothing::None => Reconstruction::raw(tree, caught),
        }
    }

    /// Light of the texels in two halves from that of the elements.
    pub(super) fn texel_halves(&self, found: &Reconstruction) -> Halves {
        let Surface { tree, open, .. } = self.path.surface;
        let whole = self.options.texel_value == TexelValue::Mean;
        let [odd, even] = [0, 1].map(|h| {
            let mut out = scattered(&tree.elements, &found.values[h], open.len(), Vec3::ZERO);
            if whole {
                out.iter_mut().zip(open).for_each(|(e, open)| *e *= *open);
            }
            out
        });
        Halves { odd, even }
    }
}

/// Light that is smoothed over cells of its own: soft direct light, caustics, or what meshes gathered.
pub(super) struct Smooth {
    pub(super) caught: [Caught; 2],
    pub(super) found: Reconstruction,
}

impl Smooth {
    /// Before and after.
    pub(super) fn compared<'a>(&'a self, tree: &'a SurfaceTree) -> Compared<'a> {
        let found = &self.found.values;
        Compared { tree, caught: self.caught.each_ref().map(|c| c.flux.as_slice()), values: [&found[0], &found[1]] }
    }
}

/// Light that is smoothed over cells: in two halves the irradiance (lux) and the flux that was caught of each element.
pub(super) struct Smoothed {
    values: [Vec<Vec3>; 2],
    caught: [Vec<[f32; 3]>; 2],
    /// Nodes with no border of any cell inside.
    pub(super) blocks: Vec<Node>,
}

impl Smoothed {
    /// Before and after.
    pub(super) fn compared<'a>(&'a self, tree: &'a SurfaceTree) -> Compared<'a> {
        Compared { tree, caught: [&self.caught[0], &self.caught[1]], values: [&self.values[0], &self.values[1]] }
    }

    /// Flux before and after, sum of both halves and the channels [lux x frame units squared].
    pub(super) fn energy(&self, tree: &SurfaceTree) -> [f64; 2] {
        let flux = |values: &Vec<Vec3>| -> f64 {
            let of = |(e, v): (&Element, &Vec3)| f64::from(e.area) * f64::from(v.element_sum());
            tree.elements.iter().zip(values).map(of).sum()
        };
        let before = self.caught.iter().flatten().flatten().map(|&f| f64::from(f)).sum();
        [before, self.values.iter().map(flux).sum()]
    }
}

/// Factor from flux over the whole area to flux over the open area; 0 where nothing is open.
fn per_open(open: f32) -> f32 {
    if open > 0.0 { 1.0 / open } else { 0.0 }
}

/// Values of elements at the places of their texels, `none` elsewhere.
pub(super) fn scattered<T: Copy>(elements: &[Element], values: &[T], texels: usize, none: T) -> Vec<T> {
    let mut out = vec![none; texels];
    elements.iter().zip(values).for_each(|(e, v)| out[e.texel as usize] = *v);
    out
}
