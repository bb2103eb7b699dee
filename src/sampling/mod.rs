//! Random numbers, low-discrepancy points and warps.
//!
//! Every number is a function of (seed, index): no thread, time or order of work enters. Trigonometry is done
//! by our own polynomials or the crate libm, never by the platform's library, so that every machine draws the
//! same samples.

mod hash;
mod sobol;
mod warp;

pub use hash::{Stream, hash_mix, hash_seed};
pub use sobol::{DIMENSIONS, scrambled_stratum, sobol, sobol_index_of_stratum};
pub use warp::{cosine_hemisphere, orthonormal_basis, uniform_cone, uniform_triangle};

/// A number in [0, 1) from 32 random bits, with 24 bits of resolution.
pub fn unit_f32(bits: u32) -> f32 {
    (bits >> 8) as f32 * (1.0 / 16_777_216.0)
}
