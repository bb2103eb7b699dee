//! Which extensions are understood, which do not matter to light, and how to get rid of the others.

use super::reader::{REPAIR, Reader};
use crate::error::SceneError;
use serde_json::Value;

/// Read by this loader.
const SUPPORTED: &[&str] = &[
    "EXT_lights_ies",
    "EXT_texture_webp",
    "KHR_lights_punctual",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
];

/// These change only what a diffuse bake leaves out (highlights, animation, metadata), so a file that requires
/// them is baked all the same.
const HARMLESS: &[&str] = &[
    "KHR_animation_pointer",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_dispersion",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_variants",
    "KHR_materials_volume",
    "KHR_xmp_json_ld",
];

/// Refuses a file that requires what is not supported; warns of optional extensions that are ignored.
pub(super) fn check(reader: &mut Reader) -> Result<(), SceneError> {
    let required = names(reader, "extensionsRequired")?;
    let known = |name: &str| SUPPORTED.contains(&name) || HARMLESS.contains(&name);
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
pub(super) fn unsupported(reader: &Reader, name: &str) -> SceneError {
    let cure = match name {
        "KHR_draco_mesh_compression" => {
            "`gltf-transform copy in.glb out.glb` writes the same scene without the compression"
        }
        "EXT_meshopt_compression" | "KHR_meshopt_compression" => {
            "`gltfpack -i in.glb -o out.glb -noq` writes the same scene without the compression"
        }
        "KHR_texture_basisu" => "`gltf-transform ktxdecompress in.glb out.glb` turns its textures into PNG",
        "EXT_mesh_gpu_instancing" => "export it with one node per instance",
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
