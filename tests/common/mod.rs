//! What several tests share.
#![allow(dead_code)]

pub mod agreement;
pub mod exr_reader;
pub mod formulas;
pub mod glb;
pub mod packed;
pub mod path_tracer;
pub mod program;
pub mod random;
pub mod rooms;
pub mod runs;
pub mod scene_tracer;
pub mod stage;
pub mod statistics;
