//! What of a scene its light depends on, for the name of what is kept of a bake.

use super::{Mesh, Scene, Sky};
use crate::cache::Digest;

impl Scene {
    /// Adds all that a bake computes with: not names of files, cameras, warnings, or the document.
    pub(crate) fn feed(&self, digest: &mut Digest) {
        let Scene { meshes, instances, materials, textures, lights, sky, .. } = self;
        digest.debug(&(meshes.len(), textures.len(), sky.is_some()));
        meshes.iter().for_each(|mesh| mesh.feed(digest));
        digest.debug(instances);
        digest.debug(materials);
        for t in textures {
            digest.bytes(&t.encoded);
            digest.debug(&(t.wrap, t.nearest));
        }
        digest.debug(lights);
        sky.iter().for_each(|sky| sky.feed(digest));
    }
}

impl Mesh {
    fn feed(&self, digest: &mut Digest) {
        let Mesh { name, primitives, .. } = self;
        digest.bytes(name.as_bytes());
        digest.debug(&primitives.len());
        for p in primitives {
            digest.values(&p.positions);
            digest.values(&p.normals);
            p.tex_coords.iter().for_each(|set| digest.values(set));
            digest.values(&p.colors);
            digest.values(&p.triangles);
            digest.debug(&(p.material, p.tex_coords.len()));
        }
    }
}

impl Sky {
    /// Adds its radiance and how it is turned.
    pub(crate) fn feed(&self, digest: &mut Digest) {
        match self {
            Sky::Constant(radiance) => digest.debug(radiance),
            Sky::Image { width, height, radiance, rotation } => {
                digest.debug(&(width, height, rotation));
                digest.values(radiance);
            }
            Sky::Cube(map) => map.feed(digest),
        }
    }
}
