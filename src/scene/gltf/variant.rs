//! KHR_materials_variants: other materials for the same primitives, chosen by name.

use super::Document;
use super::reader::{REPAIR, Reader};
use crate::error::SceneError;
use gltf::json;
use serde_json::Value;

const NAME: &str = "KHR_materials_variants";

impl Document {
    /// Names of the variants of its materials, in the order of the file; one without a name is `variant N`.
    pub fn variants(&self) -> Vec<String> {
        let all = self.json.pointer("/extensions/KHR_materials_variants/variants").and_then(Value::as_array);
        let name = |(i, variant): (usize, &Value)| {
            let name = variant.get("name").and_then(Value::as_str).filter(|n| !n.is_empty());
            name.map_or_else(|| format!("variant {i}"), str::to_owned)
        };
        all.into_iter().flatten().enumerate().map(name).collect()
    }
}

/// Index of a variant.
///
/// # Errors
/// [`SceneError::Invalid`] lists the variants there are.
pub(super) fn find(reader: &Reader, name: &str) -> Result<usize, SceneError> {
    let all = reader.document.variants();
    all.iter().position(|n| n == name).ok_or_else(|| {
        let known = match &all[..] {
            [] => "it has none; leave the choice of a variant out".to_owned(),
            _ => format!("choose one of: {}", all.join(", ")),
        };
        reader.invalid(format!("its materials have no variant '{name}'; {known}"))
    })
}

/// The material of a primitive under the variant that is chosen; `None` where that does not change it.
pub(super) fn material(
    reader: &Reader,
    primitive: &json::mesh::Primitive,
    label: &str,
) -> Result<Option<usize>, SceneError> {
    let Some(variant) = reader.variant else { return Ok(None) };
    let extension = primitive.extensions.as_ref().and_then(|e| e.others.get(NAME));
    let mappings = extension.and_then(|e| e.get("mappings")).and_then(Value::as_array);
    let is_chosen = |mapping: &&Value| {
        let variants = mapping.get("variants").and_then(Value::as_array);
        variants.is_some_and(|v| v.iter().any(|v| v.as_u64() == Some(variant as u64)))
    };
    let Some(mapping) = mappings.into_iter().flatten().find(is_chosen) else { return Ok(None) };
    let material = mapping.get("material").and_then(Value::as_u64).and_then(|m| usize::try_from(m).ok());
    // The largest index stands for no material at all.
    let material = material.filter(|&m| m < usize::MAX);
    material
        .map(Some)
        .ok_or_else(|| reader.invalid(format!("{label}: variant {variant} has no material for it; {REPAIR}")))
}
