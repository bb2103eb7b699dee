//! `lightmap.json`: which node finds its light where, in a form that one importer per engine can read.
//!
//! In: the scene, its atlas and what was measured. Out: plain data with every convention said in words, so
//! that nobody has to guess an orientation or a unit.

use super::lightmap_exr::unit_of;
use super::{NodeRect, node_rects, write_atomically};
use crate::atlas::{Atlas, NO_CHART};
use crate::error::BakeError;
use crate::light::Lighting;
use crate::lightmap::Lightmap;
use crate::options::{Lights, Quantity};
use crate::scene::{BakeMode, Scene};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Version of the layout of the file; grows when a reader of the old layout would go wrong.
pub const FORMAT_VERSION: u32 = 1;

/// The manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Always `evenlight lightmap`.
    pub format: String,
    /// [`FORMAT_VERSION`].
    pub format_version: u32,
    /// Program and version.
    pub generator: String,
    /// File of the scene with its lightmap UVs, relative to the manifest; `None` if it was not written.
    pub scene: Option<String>,
    /// The variant of the file's materials (KHR_materials_variants) that was baked; `None`: those of the file itself.
    pub variant: Option<String>,
    /// `irradiance-over-pi` or `irradiance`.
    pub quantity: String,
    /// Unit of the texels: `cd/m2` or `lux`.
    pub unit: String,
    /// True where the texels were divided by pi.
    pub divided_by_pi: bool,
    /// The maps.
    pub pages: Vec<ManifestPage>,
    /// Baked nodes, in the order of the scene.
    pub nodes: Vec<ManifestNode>,
    /// Lights of the file and what of each is in the maps.
    pub lights: Vec<ManifestLight>,
    /// The light of the sky is in the maps.
    pub sky_baked: bool,
    /// And it is that of the scene file (EXT_lights_image_based or extras), not one given to the bake.
    #[serde(default)]
    pub sky_of_scene: bool,
    /// Groups of lights that have layers of their own in the maps, `name.R`, `name.G` and `name.B`; the main layer is
    /// their sum.
    #[serde(default)]
    pub groups: Vec<ManifestGroup>,
    /// What the numbers mean, in words.
    pub conventions: Conventions,
}

/// A map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ManifestPage {
    /// File, relative to the manifest.
    pub file: String,
    /// Width in texels.
    pub width: u32,
    /// Height in texels.
    pub height: u32,
    /// Share of the page that charts cover, in [0, 1].
    pub coverage: f64,
}

/// A group of lights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ManifestGroup {
    /// Its name and that of its layer.
    pub name: String,
    /// Names of its lights, of materials that emit, and `sky`.
    pub lights: Vec<String>,
}

/// A baked node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ManifestNode {
    /// Index of the node in the scene file.
    pub node: usize,
    /// Name of the node.
    pub name: String,
    /// Index of its mesh in the scene file.
    pub mesh: usize,
    /// Index into `pages`.
    pub page: u32,
    /// x, y, width, height in [0, 1] from the top left: page UV = rect.xy + TEXCOORD_1 * rect.wh.
    pub rect: [f32; 4],
    /// The part of the page that the node occupies, likewise.
    pub occupied: [f32; 4],
    /// Mean texel density [texels/m] over the node's charts; 0 without any.
    pub texel_density: f64,
    /// Measured error of the node's texels [percent of max(their mean, 1 % of the scene's mean)].
    pub error_percent: Option<f64>,
}

/// A light of the file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ManifestLight {
    /// Name of the light.
    pub name: String,
    /// Index of its node in the scene file; `None` for a light that is not from the file.
    pub node: Option<usize>,
    /// File of its IES profile, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub profile: Option<String>,
    /// What of it is in the maps.
    pub bake: BakedPart,
}

/// Which part of a light is in the maps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BakedPart {
    /// Direct and reflected light: an engine must not light baked surfaces with it again.
    Full,
    /// Reflected light: the engine adds the direct part.
    Indirect,
    /// Nothing.
    Off,
}

/// What the numbers mean, in words.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Conventions {
    /// How a texel becomes light on screen.
    pub texel: String,
    /// Colour space.
    pub color: String,
    /// Orientation of images and UVs.
    pub orientation: String,
    /// How UVs find their place on a page.
    pub rect: String,
    /// How to avoid lighting twice.
    pub lights: String,
}

/// What the manifest needs beside scene and atlas.
#[derive(Debug, Clone, Default)]
pub struct ManifestInputs {
    /// File of the scene, relative to the manifest.
    pub scene_file: Option<String>,
    /// File of each page, relative to the manifest.
    pub page_files: Vec<String>,
    /// The variant of the materials that was baked.
    pub variant: Option<String>,
    /// Measured error per scene instance (percent); may be shorter than the instances.
    pub error_percent: Vec<Option<f64>>,
}

impl Manifest {
    /// Collects the manifest. `lightmap` gives the coverage of each page.
    pub fn new(
        scene: &Scene,
        atlas: &Atlas,
        lightmap: &Lightmap,
        quantity: Quantity,
        lighting: &Lighting,
        lights: Lights,
        inputs: &ManifestInputs,
    ) -> Manifest {
        let over_pi = quantity == Quantity::IrradianceOverPi;
        Manifest {
            format: "evenlight lightmap".into(),
            format_version: FORMAT_VERSION,
            generator: concat!("evenlight ", env!("CARGO_PKG_VERSION")).into(),
            scene: inputs.scene_file.clone(),
            variant: inputs.variant.clone(),
            quantity: if over_pi { "irradiance-over-pi" } else { "irradiance" }.into(),
            unit: unit_of(quantity).into(),
            divided_by_pi: over_pi,
            pages: pages(atlas, lightmap, &inputs.page_files),
            nodes: nodes(scene, atlas, &inputs.error_percent),
            lights: lighting
                .lights
                .iter()
                .map(|light| ManifestLight {
                    name: light.name.clone(),
                    node: light.node,
                    profile: light.profile.as_ref().map(|profile| profile.name.clone()),
                    bake: match (light.bake, lights) {
                        (BakeMode::Off, _) => BakedPart::Off,
                        (BakeMode::Full, Lights::All) => BakedPart::Full,
                        _ => BakedPart::Indirect,
                    },
                })
                .collect(),
            sky_baked: lighting.sky.is_some(),
            groups: lighting
                .groups
                .iter()
                .map(|g| ManifestGroup { name: g.name.clone(), lights: g.members.clone() })
                .collect(),
            sky_of_scene: lighting.sky_of_scene,
            conventions: conventions(over_pi),
        }
    }

    /// Writes the manifest as indented JSON.
    ///
    /// # Errors
    /// [`BakeError::Io`] names the file.
    pub fn write(&self, path: &Path) -> Result<(), BakeError> {
        let mut text = serde_json::to_vec_pretty(self)
            .map_err(|e| BakeError::Io { path: path.into(), source: std::io::Error::other(e) })?;
        text.push(b'\n');
        write_atomically(path, &text)
    }
}

fn pages(atlas: &Atlas, lightmap: &Lightmap, files: &[String]) -> Vec<ManifestPage> {
    let page = |(i, page): (usize, &crate::atlas::Page)| {
        let coverage = lightmap.pages.get(i).map_or(&[][..], |p| p.coverage.as_slice());
        let covered: f64 = coverage.iter().map(|&c| f64::from(c)).sum();
        ManifestPage {
            file: files.get(i).cloned().unwrap_or_default(),
            width: page.width,
            height: page.height,
            coverage: covered / coverage.len().max(1) as f64,
        }
    };
    atlas.pages.iter().enumerate().map(page).collect()
}

fn nodes(scene: &Scene, atlas: &Atlas, errors: &[Option<f64>]) -> Vec<ManifestNode> {
    let node = |(i, rect): (usize, Option<NodeRect>)| {
        let rect = rect?;
        let instance = &scene.instances[i];
        Some(ManifestNode {
            node: instance.node,
            name: instance.name.clone(),
            mesh: scene.meshes[instance.mesh].source,
            page: rect.page,
            rect: rect.rect,
            occupied: rect.occupied,
            texel_density: texel_density(scene, atlas, i),
            error_percent: errors.get(i).copied().flatten(),
        })
    };
    node_rects(scene, atlas).into_iter().enumerate().filter_map(node).collect()
}

/// Square root of (area on the map [texels^2] / area in the world [m2]) over the charts of an instance.
fn texel_density(scene: &Scene, atlas: &Atlas, instance: usize) -> f64 {
    let placed = &scene.instances[instance];
    let (Some(layout), Some(placement)) = (&atlas.meshes[placed.mesh], atlas.placements[instance]) else { return 0.0 };
    let (mut texels, mut metres) = (0.0, 0.0);
    for (primitive, layout) in scene.meshes[placed.mesh].primitives.iter().zip(&layout.primitives) {
        let triangles = primitive.triangles.iter().zip(&layout.triangles).zip(&layout.charts);
        for ((corners, on_map), _) in triangles.filter(|(_, chart)| **chart != NO_CHART) {
            let [a, b, c] =
                corners.map(|v| placed.world_from_object.transform_point3(primitive.positions[v as usize].as_dvec3()));
            metres += 0.5 * (b - a).cross(c - a).length();
            let [a, b, c] = on_map.map(|v| (layout.uvs[v as usize] * placement.size).as_dvec2());
            texels += 0.5 * (b - a).perp_dot(c - a).abs();
        }
    }
    if metres > 0.0 { (texels / metres).sqrt() } else { 0.0 }
}

fn conventions(over_pi: bool) -> Conventions {
    let texel = if over_pi {
        "E / pi: the luminance of a white diffuse surface. Light leaving a surface = albedo * texel."
    } else {
        "E: irradiance. Light leaving a diffuse surface = albedo * texel / pi."
    };
    Conventions {
        texel: texel.into(),
        color: "Linear Rec. 709 primaries, white point D65, no tone curve, no exposure; direct light of baked \
                lights and all reflected light included, albedo of the surface itself not."
            .into(),
        orientation: "UV (0, 0) is the top left of the image and row 0 of the EXR is the top row, as in glTF: no \
                      flip. For engines whose UV origin is the bottom left, y = 1 - y - height."
            .into(),
        rect: "x, y, width, height in [0, 1] of the page from its top left. page UV = (x, y) + TEXCOORD_1 * \
               (width, height). Use bilinear filtering; the gutters are filled."
            .into(),
        lights: "A light with bake = full must not light baked surfaces again; indirect: the engine adds its \
                 direct light; off: the light is not in the maps."
            .into(),
    }
}
