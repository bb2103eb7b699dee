//! What a bake will take, before it is taken.

use super::Atlas;
use crate::error::BakeError;
use crate::scene::Scene;

/// Bytes per cell of a page: the table from cells to texels, of both sides, and the finished maps.
const BYTES_PER_CELL: u64 = 8 + 60;

/// Bytes per triangle: world corners, normals, grid placement, hierarchy.
const BYTES_PER_TRIANGLE: u64 = 250;

/// Bytes per covered cell: texel, pieces, both halves of direct light and photons, surface tree, estimates (measured).
const BYTES_PER_TEXEL: u64 = 900;

/// Memory that a bake of `scene` on `atlas` takes at most (bytes), taking every cell as covered.
pub fn memory_bytes(scene: &Scene, atlas: &Atlas) -> u64 {
    let cells: u64 = atlas.pages.iter().map(|p| u64::from(p.width) * u64::from(p.height)).sum();
    // Charts fill about two thirds of a page.
    cells * BYTES_PER_CELL + cells * 2 / 3 * BYTES_PER_TEXEL + scene.triangle_count() as u64 * BYTES_PER_TRIANGLE
}

/// Refuses what would take more than `limit` bytes.
///
/// # Errors
/// [`BakeError::Limit`] says how much, and how to get under it.
pub fn check_memory(scene: &Scene, atlas: &Atlas, limit: u64) -> Result<(), BakeError> {
    let asked = memory_bytes(scene, atlas);
    if asked <= limit {
        return Ok(());
    }
    let mib = |b: u64| format!("{} MiB", b >> 20);
    Err(BakeError::Limit {
        what: "the bake",
        asked: mib(asked),
        allowed: mib(limit),
        cure: "lower --max-texture or --density, or raise --memory-limit".into(),
    })
}
