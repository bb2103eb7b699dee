//! What a bake left out because the scene does not need it, in words for the report.

use crate::atlas::{Atlas, Texels};
use crate::light::{Lighting, Visibility};
use crate::pilot::Pilot;
use crate::scene::{BakeMode, Scene};

/// What decides what is skipped.
pub(crate) struct Skips<'a> {
    pub(crate) visibility: &'a Visibility<'a>,
    pub(crate) lighting: &'a Lighting,
    pub(crate) atlas: &'a Atlas,
    pub(crate) texels: &'a Texels,
    /// Open share of each texel of the map.
    pub(crate) open: &'a [f32],
    pub(crate) pilot: Option<Pilot>,
    /// Charts were those of an earlier bake.
    pub(crate) charts_from_cache: bool,
    /// Rays of earlier bakes.
    pub(crate) kept_rays: u64,
}

impl Skips<'_> {
    /// One line for each, with what it saved.
    pub(crate) fn lines(&self) -> Vec<String> {
        let scene = self.visibility.world.scene;
        [
            self.kept_charts(),
            self.kept_light(),
            self.spare_texels(),
            self.unseen_nodes(scene),
            self.buried_charts(),
            images(scene),
            self.lights(),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    fn kept_charts(&self) -> Option<String> {
        let looked = self.pilot.is_some_and(|p| p.from_cache);
        let places = if looked { ", and where texels are needed," } else { "" };
        self.charts_from_cache.then(|| format!("unwrapping: the charts{places} are those of an earlier bake"))
    }

    fn kept_light(&self) -> Option<String> {
        let rays = self.kept_rays as f64 / 1e6;
        (self.kept_rays > 0).then(|| format!("light: {rays:.1} M rays are those of earlier bakes"))
    }

    fn spare_texels(&self) -> Option<String> {
        let pilot = self.pilot.filter(|p| p.share < 1.0)?;
        Some(format!(
            "texels: {:.1} % of those that fit on a page were thought enough; --density even takes all",
            100.0 * pilot.share
        ))
    }

    /// Nodes on which nobody would see a map.
    fn unseen_nodes(&self, scene: &Scene) -> Option<String> {
        let unseen = &self.atlas.unseen;
        let first = &scene.instances[*unseen.first()?].name;
        Some(format!(
            "maps: {} of {} nodes are metal, glass or black all over, {first} for one, and would not show any; --only \
             bakes what it names",
            unseen.len(),
            scene.instances.len(),
        ))
    }

    /// Charts that neither light nor eye gets to.
    fn buried_charts(&self) -> Option<String> {
        let on_map = &self.texels.texels[..self.texels.mapped];
        let charts = self.atlas.first_chart.last().copied().unwrap_or(0) as usize;
        let (mut open, mut count) = (vec![false; charts], vec![0usize; charts]);
        for (t, share) in on_map.iter().zip(self.open) {
            open[t.chart as usize] |= *share > 0.0;
            count[t.chart as usize] += 1;
        }
        let buried: Vec<usize> = (0..charts).filter(|&c| count[c] > 0 && !open[c]).collect();
        let texels: usize = buried.iter().map(|&c| count[c]).sum();
        (!buried.is_empty()).then(|| {
            format!(
                "light: {} of {charts} charts are inside solids or covered all over; their {texels} of {} texels take no \
                 part in targets",
                buried.len(),
                on_map.len()
            )
        })
    }

    /// Lights that nothing is sampled for.
    fn lights(&self) -> Option<String> {
        let lights = &self.lighting.lights;
        let off = lights.iter().filter(|l| l.bake == BakeMode::Off || l.intensity.max_element() <= 0.0).count();
        (off > 0).then(|| format!("lights: {off} of {} are off or send nothing, and took no shadow rays", lights.len()))
    }
}

/// Images that nobody looked at.
fn images(scene: &Scene) -> Option<String> {
    let all = scene.textures.len();
    let left = scene.textures.iter().filter(|t| !t.is_decoded()).count();
    (left > 0).then(|| format!("images: {left} of {all} were not decoded, for no ray and no texel looked at them"))
}
