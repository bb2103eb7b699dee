//! 5. Indirect light: photons that start where direct light is reflected.
//!
//! In: the direct light of every texel. Out: for every texel of the map the flux of light reflected at least
//! once, as exact integers in two halves. The parity of a path decides the half for all its bounces, and each
//! half is a set of independently scrambled low-discrepancy nets.
//!
//! All photons weigh the same: the largest channel of a photon's flux stays what it was at its start, however
//! often it is reflected. Weights are integers, so sums do not depend on their order and the energy balance
//! closes exactly.

mod bins;
mod ledger;
mod net;
mod start;
mod walk;

pub use bins::{Bins, Deposit, DepositSink, Sums, Trail};
pub use ledger::EnergyLedger;
pub use net::{Flux, NetPart, Shooting};
pub use start::StartTable;
pub use walk::{MAX_SURFACES, MOST_CREVICE_STEPS, Photon, PhotonKind, walk};
