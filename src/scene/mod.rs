//! 1. What is baked: plain data with every reference, default and unit resolved.
//!
//! In: a glTF file ([`Scene::from_gltf`], the only place that sees glTF types is [`mod@gltf`]). Out: a
//! [`Scene`] of meshes in object space, instances that place them in the world (right-handed, +Y up,
//! metres), materials as linear Rec. 709 reflectances, and lights in the units of the file (candela, lux,
//! nit). [`World`] is the same geometry flattened to world-space triangles in the normalised frame that all
//! later stages compute in.
//!
//! Nothing here knows of texels, rays or photons.

mod change;
mod clear_sky;
mod cube_map;
mod fingerprint;
pub mod gltf;
mod ies;
mod light;
mod material;
mod mesh;
mod profile;
mod sky;
mod specular;
mod texture;
mod world;

pub use change::{Changes, LightChange, NodeChange};
pub(crate) use change::{fits, listed};
pub use clear_sky::ClearSky;
pub use cube_map::CubeMap;
pub use light::{AreaShape, BakeMode, Camera, Light, LightKind, Projection};
pub use material::{Alpha, Material, TextureRef};
pub use mesh::{Instance, Mesh, Primitive};
pub use profile::IesProfile;
pub use sky::Sky;
pub(crate) use sky::sky_pixel;
pub use specular::{Bounce, Specular};
pub(crate) use texture::srgb_table;
pub use texture::{ColorSpace, Texture, Wrap};
pub use world::{Frame, Met, SurfaceFlags, SurfacePoint, TriangleRef, World};

use crate::error::{SceneError, Warning};
use std::path::Path;

/// A scene ready to bake: every reference resolved, every default filled in.
#[derive(Debug)]
pub struct Scene {
    /// File stem of the source, used in messages.
    pub name: String,
    /// Meshes drawn by at least one instance, in the order of the file.
    pub meshes: Vec<Mesh>,
    /// One entry per node that draws a mesh, in depth-first order of the scene's node tree.
    pub instances: Vec<Instance>,
    /// Materials; primitives without one use the last entry, the glTF default material.
    pub materials: Vec<Material>,
    /// Textures that materials refer to; images are decoded on first use.
    pub textures: Vec<Texture>,
    /// Point, spot and directional lights, and those with an area that are no surface.
    pub lights: Vec<Light>,
    /// Cameras, for previews.
    pub cameras: Vec<Camera>,
    /// Light from everywhere beyond the geometry, if any.
    pub sky: Option<Sky>,
    /// What is odd but usable in the source.
    pub warnings: Vec<Warning>,
    /// What [`Scene::change`] changed, for the report.
    pub changed: Vec<String>,
    /// The document as read and unpacked, for writing it back with lightmap UVs.
    pub source: gltf::Document,
}

impl Scene {
    /// Loads a `.glb` or `.gltf` file with its buffers; images are found but not decoded.
    ///
    /// # Errors
    /// [`SceneError`] names the file, the object and the cure.
    pub fn from_gltf(path: impl AsRef<Path>) -> Result<Scene, SceneError> {
        Scene::from_gltf_with(path, &gltf::LoadOptions::default())
    }

    /// The same with a choice of what of the file is loaded.
    ///
    /// # Errors
    /// [`SceneError`] names the file, the object and the cure.
    pub fn from_gltf_with(path: impl AsRef<Path>, options: &gltf::LoadOptions) -> Result<Scene, SceneError> {
        gltf::load(path.as_ref(), options)
    }

    /// Number of triangles over all instances, degenerate ones included.
    pub fn triangle_count(&self) -> usize {
        self.instances.iter().map(|i| self.meshes[i.mesh].triangle_count()).sum()
    }
}
