//! Bakes the demo room through the library and prints what was reached.

use evenlight::output::lightmap_exr::{self, ExrSettings};
use evenlight::{BakeOptions, NoObserver, Scene, bake};
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let scene = Scene::from_gltf(Path::new("fixtures/room.glb"))?;
    let options = BakeOptions { target_percent: 10.0, max_texture: 256, ..BakeOptions::default() };
    let baked = bake(&scene, &options, &mut NoObserver)?;
    for (i, page) in baked.lightmap.pages.iter().enumerate() {
        lightmap_exr::write(Path::new(&format!("room-{i}.exr")), page, &ExrSettings::default())?;
    }
    let [low, high] = baked.report.texel_error_interval;
    println!("texel error {:.1} % ({low:.1} to {high:.1})", baked.report.texel_error_percent);
    Ok(())
}
