//! The surface of the map: all that depends on where charts lie.

use super::LightPath;
use crate::atlas::{Atlas, Texels};
use crate::cell::SurfaceTree;
use crate::light::{COVER, Emitters, Visibility, open_shares, shown_texels};
use crate::options::BakeOptions;

/// What light falls on.
#[derive(Debug)]
pub struct Surface {
    /// All texels.
    pub texels: Texels,
    /// Open share of the area of each texel of the map.
    pub open: Vec<f32>,
    /// The texel whose light each texel of the map shows: its own, or that of a sheet that lies upon it.
    pub shown: Vec<u32>,
    /// The open surface as a tree.
    pub tree: SurfaceTree,
    /// Width below which a gap between surfaces is none [frame units].
    pub crevice: f32,
    /// Rays that looked for buried surface.
    pub probe_rays: u64,
}

impl Surface {
    /// What of `texels`, those of `atlas`, is open, and what of it is near what.
    pub fn new(texels: Texels, atlas: &Atlas, visibility: &Visibility, options: &BakeOptions) -> Surface {
        let (open, probe_rays) = open_shares(&texels, visibility, options.seed);
        let shown = shown_texels(&texels, visibility, &open);
        let tree = SurfaceTree::new(&texels, &open, visibility);
        let pitch = 1.0 / (atlas.texels_per_metre * visibility.world.frame.metres);
        Surface { texels, open, shown, tree, crevice: pitch as f32 * COVER, probe_rays }
    }

    /// The inputs of a solution.
    pub fn path<'a>(&'a self, emitters: &'a Emitters, visibility: &'a Visibility<'a>) -> LightPath<'a> {
        LightPath { surface: self, emitters, visibility }
    }
}
