//! Materials as the light transport sees them.

use super::BakeMode;
use glam::{Affine2, Vec3, Vec4};

/// What happens to light at a surface. All colours are linear Rec. 709.
#[derive(Debug, Clone)]
pub struct Material {
    /// Name in the file, or `material N`.
    pub name: String,
    /// Base colour factor, RGB reflectance in [0, 1] and alpha.
    pub base_color: Vec4,
    /// sRGB texture multiplied with the base colour.
    pub base_color_texture: Option<TextureRef>,
    /// Metalness in [0, 1]; a metal reflects no diffuse light, but by its base colour in the direction of a mirror.
    pub metallic: f32,
    /// Roughness in [0, 1] of what metal and glass reflect.
    pub roughness: f32,
    /// Linear texture whose blue channel multiplies the metalness, and whose green one the roughness.
    pub metallic_texture: Option<TextureRef>,
    /// Emitted radiance (nit): emissive factor times emissive strength.
    pub emission: Vec3,
    /// Which part of the emitted light is baked; [`BakeMode::Off`] leaves the surface dark.
    pub bake: BakeMode,
    /// sRGB texture multiplied with the emission.
    pub emission_texture: Option<TextureRef>,
    /// Coverage by alpha.
    pub alpha: Alpha,
    /// Share that is glass, in [0, 1], tinted by the base colour (KHR_materials_transmission).
    pub transmission: f32,
    /// Linear texture whose red channel multiplies the transmission.
    pub transmission_texture: Option<TextureRef>,
    /// Share of the diffuse light that leaves on the far side, in [0, 1] (KHR_materials_diffuse_transmission).
    pub diffuse_transmission: f32,
    /// Linear texture whose alpha channel multiplies that share.
    pub diffuse_transmission_texture: Option<TextureRef>,
    /// Colour of that light, in [0, 1]: the base colour does not multiply it.
    pub diffuse_transmission_color: Vec3,
    /// sRGB texture multiplied with that colour.
    pub diffuse_transmission_color_texture: Option<TextureRef>,
    /// Index of refraction of the glass, at least 1 (KHR_materials_ior).
    pub ior: f32,
    /// The glass is a solid, which refracts (KHR_materials_volume): else thin, and light passes straight.
    pub solid: bool,
    /// Absorption in the solid (1/m).
    pub absorption: Vec3,
    /// Both sides reflect and emit; otherwise the back absorbs, but for glass and what transmits diffusely.
    pub double_sided: bool,
    /// KHR_materials_unlit: blocks light, but neither emits nor reflects.
    pub unlit: bool,
}

impl Default for Material {
    /// The glTF default material, with metalness 0: a surface that nobody described is taken as diffuse
    /// white rather than as a black metal.
    fn default() -> Self {
        Material {
            name: "default".into(),
            base_color: Vec4::ONE,
            base_color_texture: None,
            metallic: 0.0,
            roughness: 1.0,
            metallic_texture: None,
            emission: Vec3::ZERO,
            bake: BakeMode::Full,
            emission_texture: None,
            alpha: Alpha::Opaque,
            transmission: 0.0,
            transmission_texture: None,
            diffuse_transmission: 0.0,
            diffuse_transmission_texture: None,
            diffuse_transmission_color: Vec3::ONE,
            diffuse_transmission_color_texture: None,
            ior: 1.5,
            solid: false,
            absorption: Vec3::ZERO,
            double_sided: false,
            unlit: false,
        }
    }
}

/// How alpha makes a surface pass light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Alpha {
    /// Alpha is ignored.
    Opaque,
    /// Present where alpha is at least the cutoff, absent elsewhere.
    Mask {
        /// Smallest alpha that is still surface.
        cutoff: f32,
    },
    /// A share alpha of the light meets the surface, the rest passes straight.
    Blend,
}

/// A use of a texture by a material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TextureRef {
    /// Index into [`Scene::textures`](super::Scene::textures).
    pub texture: usize,
    /// Which TEXCOORD_n it reads (KHR_texture_transform's override applied).
    pub tex_coord: usize,
    /// KHR_texture_transform, identity by default: texture UV from vertex UV.
    pub transform: Affine2,
}

impl Material {
    /// True where a straight ray may pass some of its points: such surfaces need a look at the material on every hit.
    pub fn passes_light(&self) -> bool {
        !self.unlit && self.transmission > 0.0 && !self.solid || self.alpha != Alpha::Opaque
    }

    /// True where some light leaves as from a mirror or through a lens.
    pub fn is_specular(&self) -> bool {
        !self.unlit && (self.metallic > 0.0 || self.transmission > 0.0 && (self.solid || self.ior > 1.0))
    }

    /// True where some diffuse light may leave on the side that it did not come from.
    pub fn transmits_diffusely(&self) -> bool {
        !self.unlit && self.diffuse_transmission > 0.0 && self.diffuse_transmission_color.max_element() > 0.0
    }

    /// True where some point may send on light diffusely: else nobody would see a lightmap on it.
    pub fn shows_diffuse_light(&self) -> bool {
        let all = |factor: f32, texture: &Option<TextureRef>| factor >= 1.0 && texture.is_none();
        let specular = all(self.metallic, &self.metallic_texture) || all(self.transmission, &self.transmission_texture);
        let colored = self.base_color.truncate().max_element() > 0.0 || self.transmits_diffusely();
        !self.unlit && !specular && colored
    }

    /// True where light arrives from both sides: glass has no back, nor has what light passes diffusely.
    pub fn is_two_sided(&self) -> bool {
        self.double_sided || self.transmits_diffusely() || self.transmission > 0.0 && self.is_specular()
    }
}
