//! 2. Where texels are.
//!
//! In: a [`Scene`](crate::scene::Scene). Out: an [`Atlas`] that gives every triangle of every baked instance
//! coordinates in texels on a page, and [`Texels`], which says for every texel what surface it covers.
//! Unwrappers are seen only here.

mod chart;
pub mod check;
mod density;
mod keep;
mod layout;
mod memory;
mod pack;
mod pieces;
mod place;
mod planar;
mod sampler;
mod select;
mod size;
mod texels;
mod transport;
pub mod unwrap;
mod uvunwrap;
mod xatlas;

pub use layout::{Unwrapping, build};
pub use memory::{check_memory, memory_bytes};
pub use sampler::TexelSampler;
pub use size::ChartSize;
pub use texels::{NO_TEXEL, Piece, Texel, Texels};
pub use uvunwrap::{Uvunwrap, silence_unwrapper_panics};
pub use xatlas::{WORKER_COMMAND, XatlasWorker, worker_main};

use crate::cache::Digest;
use crate::error::Warning;
use glam::Vec2;

/// A page of the atlas: one image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Page {
    /// Width in texels.
    pub width: u32,
    /// Height in texels.
    pub height: u32,
}

/// Lightmap UVs of a mesh, shared by its instances.
#[derive(Debug, Clone, Default)]
pub struct MeshLayout {
    /// One entry per primitive of the mesh.
    pub primitives: Vec<PrimitiveLayout>,
    /// Number of charts; chart ids of the primitives are below it.
    pub chart_count: u32,
}

/// Lightmap UVs of a primitive. Vertices are split only where charts need it.
#[derive(Debug, Clone, Default)]
pub struct PrimitiveLayout {
    /// For each vertex of the new primitive the source vertex it copies. The first ones are the source
    /// vertices in order; splits follow.
    pub source_vertices: Vec<u32>,
    /// Lightmap UV of each new vertex in the instance's rectangle, (0, 0) at its top left.
    pub uvs: Vec<Vec2>,
    /// The source's triangles in order, as indices into the new vertices.
    pub triangles: Vec<[u32; 3]>,
    /// Chart of each triangle, or [`NO_CHART`] where it has no place on the map.
    pub charts: Vec<u32>,
}

/// Marks a triangle without a place on the lightmap.
pub const NO_CHART: u32 = u32::MAX;

/// Where an instance lies in the atlas.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// Page index.
    pub page: u32,
    /// Top left corner of the rectangle in texels.
    pub origin: Vec2,
    /// Size of the rectangle in texels: texel coordinates = origin + uv * size.
    pub size: Vec2,
}

/// The layout of all lightmaps.
#[derive(Debug, Clone, Default)]
pub struct Atlas {
    /// The pages.
    pub pages: Vec<Page>,
    /// Layout per scene mesh; `None` where no instance of it is baked.
    pub meshes: Vec<Option<MeshLayout>>,
    /// Rectangle per scene instance; `None` where it is not baked.
    pub placements: Vec<Option<Placement>>,
    /// First global chart id of each instance, and the total at the end.
    pub first_chart: Vec<u32>,
    /// Texels per metre where nothing asks for another density.
    pub texels_per_metre: f64,
    /// Empty texels kept around each chart.
    pub gutter: u32,
    /// What was found and repaired.
    pub warnings: Vec<Warning>,
    /// Scene instances left out because they show no diffuse light: metal, glass, black.
    pub unseen: Vec<usize>,
}

impl Atlas {
    /// Adds where all texels are.
    pub(crate) fn feed(&self, digest: &mut Digest) {
        digest.debug(&(&self.pages, &self.placements, &self.first_chart, self.texels_per_metre));
        for p in self.meshes.iter().flatten().flat_map(|mesh| &mesh.primitives) {
            digest.values(&p.uvs);
            digest.values(&p.triangles);
            digest.values(&p.charts);
        }
    }

    /// Texel coordinates on its page of a triangle's corners and its global chart; `None` where the triangle
    /// has no place on the map. `primitive` and `index` as in [`TriangleRef`](crate::scene::TriangleRef).
    pub fn texel_coordinates(
        &self,
        scene: &crate::scene::Scene,
        r: crate::scene::TriangleRef,
    ) -> Option<(u32, [Vec2; 3], u32)> {
        let placement = self.placements[r.instance as usize]?;
        let layout = self.meshes[scene.instances[r.instance as usize].mesh].as_ref()?;
        let p = &layout.primitives[r.primitive as usize];
        let chart = p.charts[r.index as usize];
        if chart == NO_CHART {
            return None;
        }
        let at = p.triangles[r.index as usize].map(|v| placement.origin + p.uvs[v as usize] * placement.size);
        Some((placement.page, at, self.first_chart[r.instance as usize] + chart))
    }
}
