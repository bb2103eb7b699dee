//! 6. How far the maps are from the truth.
//!
//! In: the irradiance of every texel in two independent halves. Out: the error of their mean, with an interval,
//! for the whole atlas and for each mesh.
//!
//! With E = (E_odd + E_even) / 2 the variance of E is the mean of (E_odd - E_even)^2 / 4. Voloboy et al.
//! ("Analysis of accuracy of global illumination simulation") state the distance of the halves instead, twice
//! this; it is reported beside as `sigma_paper`.

mod estimate;
mod interval;
mod pools;

pub use estimate::{ErrorEstimate, Halves, MeshError, TexelWeights, estimate_error, mesh_errors};
pub use interval::{chi_square_quantile, normal_quantile};
pub use pools::Pools;
