//! glTF input: the only place that sees the crate gltf.
//!
//! In: a `.glb` or `.gltf` file. Out: a [`Scene`], and the file as read ([`Document`]) for writing it back. Geometry
//! that extensions pack is unpacked in between, so that neither is told of it.
//! The crate gives the types of single JSON objects; its validation and its accessor readers panic on some
//! damaged files, so references, bounds and extensions are checked here, object by object and only for what
//! the scene uses.
//!
//! The values are photometric as glTF defines them: candela, lux, nit.

mod accessor;
mod area;
mod container;
mod extension;
mod faults;
mod ies;
mod image_based;
mod light;
mod material;
mod node;
mod primitive;
mod reader;
mod unpack;
mod variant;

pub(crate) use unpack::{drop_extension, take_extension};

use super::{Mesh, Scene};
use crate::error::SceneError;
use reader::Reader;
use std::path::{Path, PathBuf};

/// The document as read and unpacked, kept so that it can be written back with lightmap UVs and nothing else
/// changed.
#[derive(Debug, Clone, Default)]
pub struct Document {
    /// The file it was read from.
    pub path: PathBuf,
    /// The whole JSON, unknown properties and their order included; without extensions that only pack its data.
    pub json: serde_json::Value,
    /// Contents of each buffer, in order, each as long as its `byteLength`; empty for a buffer without data
    /// (what stood for a compressed one). Unpacked data is in the last one.
    pub buffers: Vec<Vec<u8>>,
}

/// What of a file is loaded.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LoadOptions {
    /// The variant of KHR_materials_variants whose materials are used. Default: none, the materials that primitives
    /// name themselves.
    pub variant: Option<String>,
}

/// Loads a `.glb` or `.gltf` file: its default scene, else its first one, else all root nodes.
///
/// # Errors
/// [`SceneError`] names the file, the object and the cure.
pub fn load(path: &Path, options: &LoadOptions) -> Result<Scene, SceneError> {
    load_document(path, &container::read_file(path)?, options)
}

/// Loads the contents of a `.glb` or `.gltf` file. `path` names it in messages, and its folder is where the
/// files it refers to are read from.
///
/// # Errors
/// As [`load`].
pub fn load_bytes(path: &Path, bytes: &[u8]) -> Result<Scene, SceneError> {
    load_document(path, bytes, &LoadOptions::default())
}

fn load_document(path: &Path, bytes: &[u8], options: &LoadOptions) -> Result<Scene, SceneError> {
    let (mut document, warnings) = container::read(path, bytes)?;
    let mut reader = Reader::new(&document, warnings);
    extension::check(&mut reader)?;
    let faults = faults::find(reader.document);
    let mut warnings = reader.warnings;
    unpack::unpack(&mut document, &mut warnings)?;
    let mut reader = Reader::new(&document, warnings);
    reader.variant = options.variant.as_ref().map(|name| variant::find(&reader, name)).transpose()?;
    let mut tree = node::walk(&mut reader)?;

    let mut drawn: Vec<usize> = tree.instances.iter().map(|i| i.mesh).collect();
    drawn.sort_unstable();
    drawn.dedup();
    let mut meshes: Vec<Mesh> = Vec::with_capacity(drawn.len());
    for &source in &drawn {
        let mesh = primitive::read_mesh(&mut reader, source)?;
        if mesh.primitives.is_empty() {
            let label = reader.label("meshes", source);
            reader.warn("mesh-without-triangles", format!("{label} has no triangles and is left out"));
        } else {
            meshes.push(mesh);
        }
    }
    // From here on an instance's mesh is an index into `meshes`.
    tree.instances.retain_mut(|instance| match meshes.binary_search_by_key(&instance.mesh, |m| m.source) {
        Ok(mesh) => {
            instance.mesh = mesh;
            true
        }
        Err(_) => false,
    });
    let total: u64 = tree.instances.iter().map(|i| meshes[i.mesh].triangle_count() as u64).sum();
    if total > u64::from(u32::MAX) {
        return Err(reader.invalid(format!(
            "its nodes draw {total} triangles, more than the {} that can be numbered; bake it in parts",
            u32::MAX
        )));
    }
    let (materials, textures) = material::read_all(&mut reader, &mut meshes)?;
    let mut warnings = reader.warnings;
    warnings.extend(faults);
    Ok(Scene {
        name: path.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
        meshes,
        instances: tree.instances,
        materials,
        textures,
        lights: tree.lights,
        cameras: tree.cameras,
        sky: tree.sky,
        warnings,
        changed: Vec::new(),
        source: document,
    })
}
