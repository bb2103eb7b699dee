//! Materials and the textures they use. A material or image that nothing uses is not looked at.

use super::extension;
use super::primitive::has_tex_coord;
use super::reader::{REPAIR, Reader};
use crate::error::SceneError;
use crate::scene::{Alpha, Material, Mesh, Texture, TextureRef, Wrap};
use glam::{Affine2, Mat2, Vec2, Vec3, Vec4};
use gltf::json;
use json::material::AlphaMode;
use json::texture::{Info, MagFilter, WrappingMode};
use json::validation::Checked;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::sync::Arc;

/// Reads the materials that `meshes` use, and resolves the references: what has none gets the default
/// material, which stands behind those of the file.
pub(super) fn read_all(reader: &mut Reader, meshes: &mut [Mesh]) -> Result<(Vec<Material>, Vec<Texture>), SceneError> {
    let count = reader.list("materials")?.len();
    let mut used = vec![false; count];
    for mesh in &mut *meshes {
        for primitive in &mut mesh.primitives {
            if primitive.material == usize::MAX {
                primitive.material = count;
                continue;
            }
            let by = format!("{} primitive {}", reader.label("meshes", mesh.source), primitive.source);
            reader.value("materials", primitive.material, &by)?;
            used[primitive.material] = true;
        }
    }
    let mut textures = Textures::default();
    let mut materials = Vec::with_capacity(count + 1);
    for (i, used) in used.iter().enumerate() {
        let name = reader.name("materials", i).map_or_else(|| format!("material {i}"), str::to_owned);
        materials.push(match used {
            true => read_material(reader, &mut textures, i, name)?,
            false => Material { name, ..Material::default() },
        });
    }
    materials.push(Material::default());
    warn_missing_tex_coords(reader, meshes, &materials);
    Ok((materials, textures.all))
}

fn read_material(
    reader: &mut Reader,
    textures: &mut Textures,
    index: usize,
    name: String,
) -> Result<Material, SceneError> {
    let raw: json::Material = reader.object("materials", index, "the scene")?;
    let label = reader.label("materials", index);
    let extensions = raw.extensions.unwrap_or_default();
    let pbr = &raw.pbr_metallic_roughness;
    let mut material = Material {
        name,
        base_color: unit(reader, Vec4::from(pbr.base_color_factor.0), &label),
        base_color_texture: textures.read(reader, pbr.base_color_texture.as_ref(), &label)?,
        metallic: unit(reader, Vec4::splat(pbr.metallic_factor.0), &label).x,
        roughness: unit(reader, Vec4::splat(pbr.roughness_factor.0), &label).x,
        metallic_texture: textures.read(reader, pbr.metallic_roughness_texture.as_ref(), &label)?,
        double_sided: raw.double_sided,
        unlit: extensions.unlit.is_some(),
        ..Material::default()
    };
    if let Some(old) = &extensions.pbr_specular_glossiness {
        // As the extension says, the diffuse part is what the strongest specular channel leaves. Its texture
        // is not looked at.
        let left = 1.0 - unit(reader, Vec3::from(old.specular_factor.0).extend(0.0), &label).max_element();
        let diffuse = unit(reader, Vec4::from(old.diffuse_factor.0), &label);
        material.base_color = (diffuse.truncate() * left).extend(diffuse.w);
        material.base_color_texture = textures.read(reader, old.diffuse_texture.as_ref(), &label)?;
        (material.metallic, material.metallic_texture) = (0.0, None);
    } else if material.metallic_texture.is_none() && !material.unlit && !states_metallic(reader, index) {
        reader.warn(
            "metal-by-default",
            format!("{label} does not say its metallicFactor, so it is a metal and reflects no diffuse light; set it"),
        );
    }
    let strength = extensions.emissive_strength.map_or(1.0, |s| s.emissive_strength.0);
    let emission = Vec3::from(raw.emissive_factor.0) * strength;
    if !emission.is_finite() || emission.min_element() < 0.0 {
        reader
            .warn("odd-material", format!("{label} emits {emission}; channels below 0 or without end are taken as 0"));
    }
    material.emission = Vec3::from(emission.to_array().map(|e| if e.is_finite() { e.max(0.0) } else { 0.0 }));
    material.emission_texture = textures.read(reader, raw.emissive_texture.as_ref(), &label)?;
    if let Some(t) = &extensions.transmission {
        material.transmission = unit(reader, Vec4::splat(t.transmission_factor.0), &label).x;
        material.transmission_texture = textures.read(reader, t.transmission_texture.as_ref(), &label)?;
    }
    if let Some(t) = extensions.others.get("KHR_materials_diffuse_transmission") {
        let t = DiffuseTransmission::deserialize(t)
            .map_err(|e| reader.invalid(format!("{label}: KHR_materials_diffuse_transmission: {e}; {REPAIR}")))?;
        material.diffuse_transmission = unit(reader, Vec4::splat(t.factor), &label).x;
        material.diffuse_transmission_texture = textures.read(reader, t.texture.as_ref(), &label)?;
        material.diffuse_transmission_color = unit(reader, Vec3::from(t.color).extend(0.0), &label).truncate();
        material.diffuse_transmission_color_texture = textures.read(reader, t.color_texture.as_ref(), &label)?;
    }
    if let Some(ior) = &extensions.ior {
        material.ior = ior.ior.0;
        if !(1.0..=MOST_IOR).contains(&material.ior) {
            reader.warn("odd-material", format!("{label} has the index of refraction {}; 1.5 is used", material.ior));
            material.ior = Material::default().ior;
        }
    }
    if let Some(volume) = extensions.volume.as_ref().filter(|v| v.thickness_factor.0 > 0.0) {
        material.solid = true;
        let distance = volume.attenuation_distance.0;
        if distance > 0.0 && distance.is_finite() {
            // Beer's law; a colour of 0 would need an absorption without end.
            let color = Vec3::from(volume.attenuation_color.0).clamp(Vec3::splat(1e-6), Vec3::ONE);
            material.absorption = color.map(|c| -libm::logf(c) / distance);
        }
    }
    material.alpha = match raw.alpha_mode {
        Checked::Valid(AlphaMode::Opaque) => Alpha::Opaque,
        Checked::Valid(AlphaMode::Mask) => Alpha::Mask { cutoff: raw.alpha_cutoff.unwrap_or_default().0 },
        Checked::Valid(AlphaMode::Blend) => Alpha::Blend,
        Checked::Invalid => {
            reader.warn("odd-material", format!("{label} has an unknown alphaMode; taken as OPAQUE"));
            Alpha::Opaque
        }
    };
    Ok(material)
}

/// KHR_materials_diffuse_transmission, which the crate does not know.
#[derive(Deserialize)]
#[serde(default)]
struct DiffuseTransmission {
    #[serde(rename = "diffuseTransmissionFactor")]
    factor: f32,
    #[serde(rename = "diffuseTransmissionTexture")]
    texture: Option<Info>,
    #[serde(rename = "diffuseTransmissionColorFactor")]
    color: [f32; 3],
    #[serde(rename = "diffuseTransmissionColorTexture")]
    color_texture: Option<Info>,
}

impl Default for DiffuseTransmission {
    fn default() -> Self {
        DiffuseTransmission { factor: 0.0, texture: None, color: [1.0; 3], color_texture: None }
    }
}

/// No glass refracts as much.
const MOST_IOR: f32 = 10.0;

/// True where the file itself gives the metallicFactor, whose default is 1.
fn states_metallic(reader: &Reader, index: usize) -> bool {
    const KEY: &str = "/pbrMetallicRoughness/metallicFactor";
    reader.list("materials").is_ok_and(|all| all.get(index).is_some_and(|m| m.pointer(KEY).is_some()))
}

/// `v` clamped to [0, 1], with a warning where that changes it.
fn unit(reader: &mut Reader, v: Vec4, label: &str) -> Vec4 {
    let clamped = v.clamp(Vec4::ZERO, Vec4::ONE);
    if clamped != v {
        reader.warn("odd-material", format!("{label}: factors {v} lie outside 0 to 1 and are clamped"));
    }
    clamped
}

/// An image as the file has it.
#[derive(Clone)]
struct EncodedImage {
    name: String,
    bytes: Arc<[u8]>,
}

/// Textures read so far.
#[derive(Default)]
struct Textures {
    all: Vec<Texture>,
    /// Place in `all` by index in the document; `None` where its image cannot be had.
    by_source: BTreeMap<usize, Option<usize>>,
    /// Encoded images by index in the document.
    images: BTreeMap<usize, Option<EncodedImage>>,
}

impl Textures {
    fn read(
        &mut self,
        reader: &mut Reader,
        info: Option<&Info>,
        label: &str,
    ) -> Result<Option<TextureRef>, SceneError> {
        let Some(info) = info else { return Ok(None) };
        let source = info.index.value();
        let texture = match self.by_source.get(&source) {
            Some(&known) => known,
            None => {
                let texture = self.read_texture(reader, source, label)?;
                let place = texture.map(|t| {
                    self.all.push(t);
                    self.all.len() - 1
                });
                self.by_source.insert(source, place);
                place
            }
        };
        let Some(texture) = texture else { return Ok(None) };
        let transform = info.extensions.as_ref().and_then(|e| e.texture_transform.as_ref());
        Ok(Some(match transform {
            None => TextureRef { texture, tex_coord: info.tex_coord as usize, transform: Affine2::IDENTITY },
            Some(t) => TextureRef {
                texture,
                tex_coord: t.tex_coord.unwrap_or(info.tex_coord) as usize,
                transform: texture_transform(t.offset.0.into(), t.rotation.0, t.scale.0.into()),
            },
        }))
    }

    fn read_texture(&mut self, reader: &mut Reader, index: usize, label: &str) -> Result<Option<Texture>, SceneError> {
        let raw: json::Texture = reader.object("textures", index, label)?;
        let texture = reader.label("textures", index);
        // EXT_texture_webp names a better image than `source`, which is then for readers without WebP.
        let webp = raw.extensions.as_ref().and_then(|e| e.others.get("EXT_texture_webp")?.get("source")?.as_u64());
        let image = webp.map_or(raw.source.value(), |i| i as usize);
        // What the crate gives for a texture without a source.
        if image == u32::MAX as usize {
            let packed = raw.extensions.as_ref().is_some_and(|e| e.others.contains_key(extension::BASISU));
            let why = if packed { extension::BASISU_CURE } else { "give it a PNG, JPEG or WebP" };
            let message = format!("{texture} has no image that can be read; {label} is baked without; {why}");
            reader.warn("image-not-found", message);
            return Ok(None);
        }
        let encoded = match self.images.entry(image) {
            Entry::Occupied(known) => known.get().clone(),
            Entry::Vacant(new) => new.insert(read_image(reader, image, &texture)?).clone(),
        };
        let Some(EncodedImage { name, bytes }) = encoded else { return Ok(None) };
        let sampler: json::texture::Sampler = match raw.sampler {
            Some(s) => reader.object("samplers", s.value(), &texture)?,
            None => json::texture::Sampler::default(),
        };
        let wrap = |mode| match mode {
            Checked::Valid(WrappingMode::ClampToEdge) => Wrap::Clamp,
            Checked::Valid(WrappingMode::MirroredRepeat) => Wrap::Mirror,
            Checked::Valid(WrappingMode::Repeat) | Checked::Invalid => Wrap::Repeat,
        };
        let nearest = matches!(sampler.mag_filter, Some(Checked::Valid(MagFilter::Nearest)));
        let wrap = [wrap(sampler.wrap_s), wrap(sampler.wrap_t)];
        Ok(Some(Texture::new(name, bytes, wrap, nearest)))
    }
}

/// Name and bytes of an image; `None`, with a warning, where its file cannot be read.
fn read_image(reader: &mut Reader, index: usize, by: &str) -> Result<Option<EncodedImage>, SceneError> {
    // The crate's type demands a MIME type where bytes tell the format just as well: plain JSON then.
    let raw = reader.value("images", index, by)?;
    let label = reader.label("images", index);
    let uri = raw.get("uri").and_then(|u| u.as_str());
    let file = uri.filter(|u| !u.starts_with("data:"));
    let name = reader.name("images", index).or(file).map_or_else(|| format!("image {index}"), str::to_owned);
    match reader.image_bytes(raw, &label) {
        Ok(Some(bytes)) => Ok(Some(EncodedImage { name, bytes: bytes.into() })),
        Ok(None) => {
            reader.warn("image-not-found", format!("{label} has neither a uri nor a bufferView and is taken as white"));
            Ok(None)
        }
        Err(SceneError::Io { path, source }) => {
            let message = format!("{label}: cannot read {} ({source}); it is taken as white", path.display());
            reader.warn("image-not-found", message);
            Ok(None)
        }
        Err(refused) => Err(refused),
    }
}

/// KHR_texture_transform: translation * rotation * scale. With v pointing down, a positive angle turns the
/// coordinates counter-clockwise as one sees them, hence the signs.
fn texture_transform(offset: Vec2, rotation: f32, scale: Vec2) -> Affine2 {
    let (sin, cos) = rotation.sin_cos();
    let turn = Mat2::from_cols(Vec2::new(cos, -sin), Vec2::new(sin, cos));
    Affine2 { matrix2: turn * Mat2::from_diagonal(scale), translation: offset }
}

/// A texture whose coordinates a primitive lacks is left out when the material is looked at.
fn warn_missing_tex_coords(reader: &mut Reader, meshes: &[Mesh], materials: &[Material]) {
    for mesh in meshes {
        for primitive in &mesh.primitives {
            let m = &materials[primitive.material];
            let used = [
                &m.base_color_texture,
                &m.metallic_texture,
                &m.emission_texture,
                &m.transmission_texture,
                &m.diffuse_transmission_texture,
                &m.diffuse_transmission_color_texture,
            ];
            let missing = used.into_iter().flatten().find(|t| !has_tex_coord(primitive, t.tex_coord));
            if let Some(t) = missing {
                let label = reader.label("meshes", mesh.source);
                let message = format!(
                    "{label} primitive {} has no TEXCOORD_{}, so a texture of material '{}' is not used on it",
                    primitive.source, t.tex_coord, m.name
                );
                reader.warn("tex-coord-missing", message);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::FRAC_PI_2;

    #[test]
    fn texture_transforms_scale_then_turn_then_move() {
        let t = texture_transform(Vec2::new(0.5, 0.25), FRAC_PI_2, Vec2::new(2.0, 3.0));
        // (1, 0) is scaled to (2, 0), turned counter-clockwise as seen to (0, -2), moved.
        assert!(t.transform_point2(Vec2::X).distance(Vec2::new(0.5, -1.75)) < 1e-6);
        // (0, 1) is scaled to (0, 3), turned to (3, 0), moved.
        assert!(t.transform_point2(Vec2::Y).distance(Vec2::new(3.5, 0.25)) < 1e-6);
    }
}
