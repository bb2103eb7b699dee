//! All that light of single texels is found with, without a bake.

use super::rooms::plain;
use evenlight::accel::Accel;
use evenlight::atlas::{self, Texels};
use evenlight::light::{Emitters, LightSettings, Lighting, TexelLight, Visibility};
use evenlight::scene::{Scene, SurfaceFlags, World};

pub struct Stage<'s> {
    pub world: World<'s>,
    pub texels: Texels,
    pub accel: Accel,
    pub emitters: Emitters,
}

impl Stage<'_> {
    pub fn new(scene: &Scene, page: u32) -> Stage<'_> {
        let options = plain(page, 1.0);
        let atlas = atlas::build(scene, &options, &|| false).expect("the scene has its UVs");
        let world = World::new(scene);
        let texels = Texels::new(&world, &atlas);
        let accel = Accel::build(&world.positions, |t| world.flags[t as usize].has(SurfaceFlags::UNSEEN));
        let lighting = Lighting::new(scene, &options).expect("no sky file");
        let emitters = Emitters::new(&world, &lighting, LightSettings::default());
        Stage { world, texels, accel, emitters }
    }

    /// `open` as in [`TexelLight`].
    pub fn light<'a>(&'a self, visibility: &'a Visibility, open: &'a [f32]) -> TexelLight<'a> {
        TexelLight { texels: &self.texels, open, emitters: &self.emitters, visibility, smooth: false }
    }
}
