//! 7. How far the maps are from the truth.
//!
//! In: the irradiance of every texel in two independent halves, and the bias of its cells. Out: the error of their
//! mean, with an interval, for the whole atlas and for each mesh, what it takes to halve it, and what an audit by
//! path tracing says of it; and the illuminance of each mesh with its error.
//!
//! With E = (E_odd + E_even) / 2 the variance of E is the mean of (E_odd - E_even)^2 / 4. Voloboy et al.
//! ("Analysis of accuracy of global illumination simulation") state the distance of the halves instead, twice
//! this; it is reported beside as `sigma_paper`.

mod audit;
mod density;
mod estimate;
mod illuminance;
mod interval;
mod plan;

pub use audit::{Audit, Auditor, Effort, Verdict};
pub use density::{DensityGoal, GridFall, chart_densities};
pub use estimate::{
    Caustics, Halves, Known, MeshError, TexelError, TexelWeights, Unseen, block_variance, mesh_errors, spread,
    texel_error,
};
pub use illuminance::{Illuminance, Part, add_illuminances, grid_spacing};
pub use interval::{Moments, TWO_SIDED_95, chi_square_quantile, normal_quantile};
pub use plan::{
    CAUSTIC_SHARE, Fall, GATHER_AGAIN, GATHER_RAY_COST, MeshPlan, Missed, PhotonCost, Spent, caustic_growth,
    cheapest_growth, gather_rays, plan_meshes,
};
