//! How a bake is watched and stopped.

use crate::error::Warning;

/// Stages of a bake, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Cutting and flattening meshes, packing charts.
    Unwrap,
    /// Clipping triangles against texels, building the hierarchy.
    Prepare,
    /// Looking where texels are needed.
    Pilot,
    /// Direct light and photons.
    Light,
    /// Checking the stated error by path tracing.
    Audit,
    /// Making the maps.
    Finish,
}

/// Where a bake stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Texel error now, in percent; infinite before the first round ends.
    pub percent: f64,
    /// The target in percent.
    pub target: f64,
    /// Rays traced so far.
    pub rays: u64,
    /// Rays per second of the light stage.
    pub rays_per_second: f64,
    /// Seconds since the bake began.
    pub elapsed: f64,
    /// How long until all targets are met; `None` before the first round ends.
    pub remaining: Option<Remaining>,
}

/// How long until all targets are met, by the fall of the error with the work and the speed of that so far, in seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Remaining {
    /// Most likely.
    pub seconds: f64,
    /// Lower end of the band that it should be in.
    pub low: f64,
    /// Its upper end.
    pub high: f64,
}

/// Watches a bake.
pub trait Observer: Send + Sync {
    /// A stage begins.
    fn stage(&mut self, _stage: Stage) {}

    /// The light of a group of lights is traced from now on: number `_number` of `_count`, from 1.
    fn group(&mut self, _name: &str, _number: usize, _count: usize) {}

    /// Called between units of work.
    fn progress(&mut self, _progress: &Progress) {}

    /// Asked often, from any thread: true ends the bake with [`BakeError::Cancelled`](crate::BakeError).
    fn cancelled(&self) -> bool {
        false
    }

    /// Something is odd but usable.
    fn warn(&mut self, _warning: &Warning) {}
}

/// Watches nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoObserver;

impl Observer for NoObserver {}
