//! A lightmap baker that takes an error, not a sample count.
//!
//! The modules stand in the order in which data flows:
//!
//! ```text
//! glTF -> scene -> atlas (charts, texels) -> accel
//!      -> light: direct light per texel, two halves
//!      -> photon: starts at lit surface, walks, deposits (triangle, barycentric, flux)
//!      -> accuracy: error from the halves -> { more | done }
//!      -> lightmap -> output: EXR, GLB, manifest, report, previews
//! ```
//!
//! Units: metres, candela, lux, nit as glTF defines them; colours are linear Rec. 709. A texel holds the mean
//! irradiance E (lux) of the surface mapped to it.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod bake;

pub mod scene;
pub mod atlas;
pub mod accel;
pub mod light;
pub mod photon;
pub mod accuracy;
pub mod solve;
pub mod lightmap;
pub mod output;

pub mod error;
pub mod observer;
pub mod options;
pub mod report;
pub mod sampling;

pub use bake::{Bake, bake};
pub use error::{BakeError, SceneError, Warning};
pub use observer::{NoObserver, Observer};
pub use options::BakeOptions;
pub use scene::Scene;
