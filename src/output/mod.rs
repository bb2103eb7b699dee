//! 9. Files: lightmaps, the scene with its lightmap UVs, manifest, report, previews.
//!
//! In: a finished bake. Out: files, each written beside its final name and renamed when complete; a staging
//! does the same for all of a folder. A cache keeps what other bakes may use. The only place below the command line that writes.

pub mod cache_folder;
mod files;
pub mod glb;
pub mod lightmap_exr;
pub mod manifest;
pub mod plan_folder;
pub mod preview;
mod rects;
pub mod report_html;
pub mod words;

pub use files::{Staging, write_atomically};
pub use rects::{NodeRect, node_rects};
