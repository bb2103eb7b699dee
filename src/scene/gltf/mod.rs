//! glTF input: the only place that sees the crate gltf.

use super::Scene;
use crate::error::SceneError;
use std::path::{Path, PathBuf};

/// The document as read, kept so that it can be written back with lightmap UVs and nothing else changed.
#[derive(Debug, Clone, Default)]
pub struct Document {
    /// The file it was read from.
    pub path: PathBuf,
    /// The whole JSON, unknown properties and their order included.
    pub json: serde_json::Value,
    /// Contents of each buffer, in order.
    pub buffers: Vec<Vec<u8>>,
}

/// Loads a `.glb` or `.gltf` file.
///
/// # Errors
/// [`SceneError`] names the file, the object and the cure.
pub fn load(path: &Path) -> Result<Scene, SceneError> {
    Err(SceneError::Invalid { path: path.into(), what: "not built yet".into() })
}
