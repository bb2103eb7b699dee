//! 8. The finished maps in memory.

mod grid;
mod gutter;

pub use grid::{Deviation, GridPoints, Shown, coarser, shown_error};
pub use gutter::fill_gutters;

/// The finished lightmaps, one per atlas page.
#[derive(Debug, Clone, Default)]
pub struct Lightmap {
    /// In the order of [`Atlas::pages`](crate::atlas::Atlas::pages).
    pub pages: Vec<LightmapPage>,
}

/// One page. All vectors are row-major, `width * height` long, row 0 at v = 0, texel centres at +0.5.
#[derive(Debug, Clone, Default)]
pub struct LightmapPage {
    /// Width in texels.
    pub width: u32,
    /// Height in texels.
    pub height: u32,
    /// Irradiance E, lux, linear Rec. 709 RGB, as stored: texels without coverage filled by
    /// [`fill_gutters`].
    pub irradiance: Vec<[f32; 3]>,
    /// Half the difference of the two halves, (E_odd - E_even) / 2 (lux): as noisy as E itself; filled likewise.
    pub half_difference: Vec<[f32; 3]>,
    /// Irradiance of the back side where double-sided surfaces are stored as two layers; empty otherwise.
    pub back: Vec<[f32; 3]>,
    /// Irradiance of each group of lights, where they are kept apart: `irradiance` is their sum. Filled likewise.
    pub groups: Vec<GroupLayer>,
    /// Share of the texel's square inside its chart, in [0, 1]; 0 in gutters.
    pub coverage: Vec<f32>,
    /// Surface area mapped to the texel (m2).
    pub area: Vec<f32>,
}

/// Light of a group of lights on a page.
#[derive(Debug, Clone, Default)]
pub struct GroupLayer {
    /// Name of the group.
    pub name: String,
    /// Irradiance (lux), as that of the page.
    pub irradiance: Vec<[f32; 3]>,
}

use crate::atlas::{Atlas, Texels};
use crate::options::BakeOptions;
use crate::scene::World;
use crate::solve::Solution;
use glam::{DVec2, Vec3};

impl LightmapPage {
    /// Gives the texel `at` of the page the light of texel `texel` of the map.
    fn set(&mut self, at: usize, texel: usize, solution: &Solution) {
        self.irradiance[at] = solution.total.mean(texel).to_array();
        self.half_difference[at] = solution.total.difference(texel).to_array();
        for (layer, group) in self.groups.iter_mut().zip(&solution.groups) {
            layer.irradiance[at] = group.light[texel].to_array();
        }
    }

    /// What a bilinear filter shows of `values`, one per texel of this page, at texel coordinates `at`, clamped to the
    /// page; `None` where the page lacks texels or `at` is not finite.
    pub fn filtered(&self, values: &[[f32; 3]], at: DVec2) -> Option<Vec3> {
        let (width, height) = (self.width as usize, self.height as usize);
        if values.is_empty() || values.len() != width * height || !at.is_finite() {
            return None;
        }
        let at = (at - 0.5).clamp(DVec2::ZERO, DVec2::new((width - 1) as f64, (height - 1) as f64));
        let (x, y) = (at.x as usize, at.y as usize);
        let t = (at - at.floor()).as_vec2();
        let fetch = |x: usize, y: usize| Vec3::from(values[y.min(height - 1) * width + x.min(width - 1)]);
        let top = fetch(x, y).lerp(fetch(x + 1, y), t.x);
        let bottom = fetch(x, y + 1).lerp(fetch(x + 1, y + 1), t.x);
        Some(top.lerp(bottom, t.y))
    }
}

impl Lightmap {
    /// The maps of a solution: stored sides on their pages, buried texels and gutters filled from around. `shown` is
    /// the texel whose light each texel shows: another than itself where that lies upon it.
    pub fn new(
        world: &World,
        atlas: &Atlas,
        texels: &Texels,
        shown: &[u32],
        solution: &Solution,
        options: &BakeOptions,
    ) -> Lightmap {
        let split = options.double_sided == crate::options::DoubleSided::Split
            && texels.texels[..texels.mapped].iter().any(|t| t.back);
        let metres2 = world.frame.metres * world.frame.metres;
        let mut pages: Vec<LightmapPage> = atlas
            .pages
            .iter()
            .map(|p| {
                let n = (p.width * p.height) as usize;
                LightmapPage {
                    width: p.width,
                    height: p.height,
                    irradiance: vec![[0.0; 3]; n],
                    half_difference: vec![[0.0; 3]; n],
                    groups: solution
                        .groups
                        .iter()
                        .map(|g| GroupLayer { name: g.group.name.clone(), irradiance: vec![[0.0; 3]; n] })
                        .collect(),
                    back: if split { vec![[0.0; 3]; n] } else { Vec::new() },
                    coverage: vec![0.0; n],
                    area: vec![0.0; n],
                }
            })
            .collect();
        for (i, t) in texels.texels[..texels.mapped].iter().enumerate() {
            if !solution.weights.stored[i] {
                continue;
            }
            let (page, x, y) = texels.page_position(i);
            let page = &mut pages[page];
            let at = (y * page.width + x) as usize;
            if split && t.back {
                page.back[at] = solution.total.mean(i).to_array();
                continue;
            }
            page.set(at, i, solution);
            page.coverage[at] = t.coverage;
            page.area[at] = (f64::from(t.area) * metres2) as f32;
        }
        for (under, &upon) in shown.iter().enumerate().filter(|s| s.0 != *s.1 as usize) {
            let (page, x, y) = texels.page_position(under);
            let page = &mut pages[page];
            let at = (y * page.width + x) as usize;
            let t = &texels.texels[under];
            // What another side of the same place shows is left as it is.
            if (page.coverage[at] == 0.0 || solution.weights.stored[under]) && !(split && t.back) {
                page.set(at, upon as usize, solution);
                page.coverage[at] = t.coverage;
            }
        }
        pages.iter_mut().for_each(|p| fill_gutters(p, atlas.gutter));
        Lightmap { pages }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec2;

    #[test]
    fn filtering_hits_texel_centres_and_clamps_at_the_border() {
        let page = LightmapPage { width: 2, height: 1, ..Default::default() };
        let values = [[0.0; 3], [1.0; 3]];
        let at = |x: f32| page.filtered(&values, Vec2::new(x, 0.7).as_dvec2()).map(|v| v.x);
        assert_eq!([at(-3.0), at(0.5), at(1.0), at(1.5), at(9.0)], [0.0, 0.0, 0.5, 1.0, 1.0].map(Some));
        assert_eq!(at(f32::NAN), None);
    }
}
