//! What several tests share.

pub mod glb;
