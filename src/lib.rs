//! A lightmap baker that takes an error, not a sample count.
//!
//! The modules stand in the order in which data flows:
//!
//! ```text
//! glTF -> scene -> atlas (charts, texels) -> accel
//!      -> light: direct light per texel, two halves
//!      -> photon: starts at lit surface, walks, deposits (triangle, barycentric, flux)
//!      -> cell: cells, planes over them, gathered texels, two halves
//!      -> accuracy: noise and bias from the halves -> { more | done }
//!      -> lightmap -> output: EXR, GLB, manifest, report, previews
//! ```
//!
//! Units: metres, candela, lux, nit as glTF defines them; colours are linear Rec. 709. A texel holds the mean
//! irradiance E (lux) of the surface mapped to it.
//!
//! # Example
//!
//! ```
//! use evenlight::output::lightmap_exr::{self, ExrSettings};
//! use evenlight::{BakeOptions, NoObserver, Scene, bake};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = tempfile::tempdir()?;
//! let scene = Scene::from_gltf("fixtures/cube.glb")?;
//! let options = BakeOptions { target_percent: 20.0, max_texture: 64, ..BakeOptions::default() };
//! let baked = bake(&scene, &options, &mut NoObserver)?;
//! assert!(baked.report.target_met);
//! for (i, page) in baked.lightmap.pages.iter().enumerate() {
//!     let path = folder.path().join(format!("lightmap-{i}.exr"));
//!     lightmap_exr::write(&path, page, &ExrSettings::default())?;
//! }
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod bake;

pub mod scene;
pub mod atlas;
pub mod accel;
pub mod light;
pub mod photon;
pub mod cell;
pub mod accuracy;
pub mod solve;
pub mod pilot;
pub mod backs;
pub mod lightmap;
pub mod output;

mod bisect;
pub mod cache;
mod skips;
pub mod error;
pub mod observer;
pub mod options;
pub mod report;
pub mod sampling;

pub use bake::{Bake, bake, bake_by_plan, bake_shard, bake_with_cache, merge, plan};
pub use cache::Cache;
pub use error::{BakeError, SceneError, Warning};
pub use observer::{NoObserver, Observer};
pub use options::BakeOptions;
pub use scene::Scene;
