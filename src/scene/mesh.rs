//! Meshes in object space and the nodes that place them.

use glam::{DAffine3, Vec2, Vec3, Vec4};

/// A mesh of the file: the unit that is unwrapped once and shared by its instances.
#[derive(Debug, Clone)]
pub struct Mesh {
    /// Name in the file, or `mesh N`.
    pub name: String,
    /// Index of the mesh in the source document.
    pub source: usize,
    /// Triangle primitives; others are skipped by the loader with a warning.
    pub primitives: Vec<Primitive>,
}

impl Mesh {
    /// Triangles over all primitives.
    pub fn triangle_count(&self) -> usize {
        self.primitives.iter().map(|p| p.triangles.len()).sum()
    }
}

/// One primitive as a triangle list. All per-vertex arrays have the length of `positions` or are empty.
#[derive(Debug, Clone, Default)]
pub struct Primitive {
    /// Index of the primitive inside its mesh in the source document.
    pub source: usize,
    /// Object-space positions, finite.
    pub positions: Vec<Vec3>,
    /// Object-space unit normals; empty where the file gives none (flat shading, as glTF defines it).
    pub normals: Vec<Vec3>,
    /// `tex_coords[n]` is TEXCOORD_n; a set the file lacks is an empty vector.
    pub tex_coords: Vec<Vec<Vec2>>,
    /// Linear vertex colours (COLOR_0), or empty.
    pub colors: Vec<Vec4>,
    /// Triangles, wound counter-clockwise as seen from the front in object space. Strips, fans and
    /// unindexed lists are already resolved; every index is in range.
    pub triangles: Vec<[u32; 3]>,
    /// Index into [`Scene::materials`](super::Scene::materials).
    pub material: usize,
}

/// A node that draws a mesh.
#[derive(Debug, Clone)]
pub struct Instance {
    /// Index of the node in the source document.
    pub node: usize,
    /// Name of the node, or `node N`.
    pub name: String,
    /// Index into [`Scene::meshes`](super::Scene::meshes).
    pub mesh: usize,
    /// World transform of the node. A negative determinant mirrors: the front is still the side that glTF
    /// says it is (the winding is taken as flipped).
    pub world_from_object: DAffine3,
    /// Weight of this node's texels in every error figure, >= 0 (extras `evenlight.weight`). Default: 1.
    pub weight: f32,
    /// Factor on the texel density, > 0 (extras `evenlight.density`). Default: 1.
    pub density: f32,
    /// False: casts shadows and bounces light, but gets no lightmap (extras `evenlight.bake` or
    /// `evenlight.receives`).
    pub bake: bool,
    /// False: gets a lightmap, but neither blocks nor reflects light: something that moves (extras
    /// `evenlight.casts`).
    pub casts: bool,
}

impl Instance {
    /// Whether it takes part in the bake: what neither casts nor is baked is as if it were not there, its own light
    /// included.
    pub fn takes_part(&self) -> bool {
        self.casts || self.bake
    }
}
