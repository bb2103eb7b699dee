//! What a bake will take, before it is taken.

use super::Atlas;
use super::texels::NO_TEXEL;
use super::transport::TransportGrid;
use crate::error::BakeError;
use crate::options::BakeOptions;
use crate::scene::{Scene, TriangleRef, World};

/// Bytes per cell of a page: the table from cells to texels, of both sides, and the finished maps.
const BYTES_PER_CELL: u64 = 8 + 60;

/// Bytes per triangle: world corners, normals, grid placement, hierarchy, light on its back.
const BYTES_PER_TRIANGLE: u64 = 280;

/// Bytes per texel of one side: pieces, both halves of direct light and photons, surface tree, estimates (measured: 650 to
/// 750), and as many again for texels at the borders of charts, which count here by the part that is covered.
const BYTES_PER_TEXEL: f64 = 900.0;

/// ... and those of light over mirrors and through glass, where something is specular: bins, a smoothing of their own.
const SPECULAR_BYTES_PER_TEXEL: f64 = 250.0;

/// ... and those of lights in groups: their sum so far, and for each group its light, also on the pages.
const SUM_BYTES_PER_TEXEL: f64 = 120.0;
const GROUP_BYTES: u64 = 12;

/// Memory that a bake of `world` on `atlas` takes with `options` (bytes); all there is and more where its texels have no
/// numbers left.
pub fn memory_bytes(world: &World, atlas: &Atlas, options: &BakeOptions) -> u64 {
    let cells: u64 = atlas.pages.iter().map(|p| u64::from(p.width) * u64::from(p.height)).sum();
    let transport = TransportGrid::new(world, atlas).cells;
    if cells + transport >= u64::from(NO_TEXEL) {
        return u64::MAX;
    }
    let texels = covered(world.scene, atlas).min(2.0 * cells as f64) + transport as f64;
    let groups = options.most_groups() as u64 * GROUP_BYTES;
    let per_texel = BYTES_PER_TEXEL
        + if world.is_specular() { SPECULAR_BYTES_PER_TEXEL } else { 0.0 }
        + if groups > 0 { SUM_BYTES_PER_TEXEL + groups as f64 } else { 0.0 };
    (cells + transport) * (BYTES_PER_CELL + groups)
        + (texels * per_texel) as u64
        + world.len() as u64 * BYTES_PER_TRIANGLE
}

/// Covered area of the pages in texels; twice that of double-sided surfaces, each side of which has its own.
fn covered(scene: &Scene, atlas: &Atlas) -> f64 {
    let placed = (0u32..).zip(&scene.instances).filter(|(i, _)| atlas.placements[*i as usize].is_some());
    placed
        .flat_map(|(instance, i)| (0u32..).zip(&scene.meshes[i.mesh].primitives).map(move |p| (instance, p)))
        .map(|(instance, (primitive, p))| {
            let sides = if scene.materials[p.material].is_two_sided() { 2.0 } else { 1.0 };
            let area = |index: u32| {
                let at = atlas.texel_coordinates(scene, TriangleRef { instance, primitive, index });
                at.map_or(0.0, |(_, [a, b, c], _)| 0.5 * f64::from((b - a).perp_dot(c - a).abs()))
            };
            sides * (0..p.triangles.len() as u32).map(area).sum::<f64>()
        })
        .sum()
}

/// Refuses what would take more memory than `options` allow.
///
/// # Errors
/// [`BakeError::Limit`] says how much, and how to get under it.
pub fn check_memory(world: &World, atlas: &Atlas, options: &BakeOptions) -> Result<(), BakeError> {
    let (asked, limit) = (memory_bytes(world, atlas, options), options.memory_limit);
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
