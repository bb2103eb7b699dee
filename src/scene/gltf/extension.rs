//! Which extensions are understood, which do not matter to light, and how to get rid of the others.

use super::reader::{REPAIR, Reader};
use super::unpack;
use crate::error::SceneError;
use serde_json::Value;

/// Textures in KTX2, which are not read.
pub(super) const BASISU: &str = "KHR_texture_basisu";

/// How to have them read all the same.
pub(super) const BASISU_CURE: &str = "`gltf-transform ktxdecompress in.glb out.glb` turns textures in KTX2 into PNG";

/// Read by this loader.
const SUPPORTED: &[&str] = &[
    "EXT_lights_area",
    "EXT_lights_ies",
    "EXT_lights_image_based",
    "EXT_texture_webp",
    "KHR_lights_punctual",
    "KHR_materials_diffuse_transmission",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_variants",
    "KHR_materials_volume",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
];

/// These change only what a diffuse bake leaves out (highlights, animation, metadata), so a file that requires
/// them is baked all the same.
const HARMLESS: &[&str] = &[
    "KHR_animation_pointer",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_dispersion",
    "KHR_materials_iridescence",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_xmp_json_ld",
];

/// Refuses a file that requires what is not supported; warns of optional extensions that are ignored.
pub(super) fn check(reader: &mut Reader) -> Result<(), SceneError> {
    let required = names(reader, "extensionsRequired")?;
    let known = |name: &str| [SUPPORTED, unpack::SUPPORTED, HARMLESS].iter().any(|list| list.contains(&name));
    if let Some(name) = required.iter().find(|n| !known(n)) {
        return Err(unsupported(reader, name));
    }
    for name in names(reader, "extensionsUsed")? {
        if !known(name) {
            reader.warn("extension-ignored", format!("the extension {name} is kept in the file but not baked"));
        }
    }
    Ok(())
}

/// The error for an extension without which the file cannot be read.
fn unsupported(reader: &Reader, name: &str) -> SceneError {
    let cure = match name {
        BASISU => BASISU_CURE,
        _ => "export it without this extension",
    };
    SceneError::Extension { path: reader.document.path.clone(), extension: name.into(), cure: cure.into() }
}

fn names<'d>(reader: &Reader<'d>, list: &str) -> Result<Vec<&'d str>, SceneError> {
    reader
        .list(list)?
        .iter()
        .map(|v: &Value| v.as_str().ok_or_else(|| reader.invalid(format!("`{list}` holds {v}, not a name; {REPAIR}"))))
        .collect()
}
