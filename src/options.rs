//! What a bake is asked for.

use crate::cache::Digest;
use crate::error::BakeError;
use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Everything a bake can be asked for. Fields map one to one to the flags of the command line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BakeOptions {
    /// Upper 95 % limit of the texel error at which the bake ends. Unit: percent of the mean. Default: 2.
    pub target_percent: f64,
    /// Target per mesh, which 95 % of the meshes must meet. Unit: percent. Default: 3 times `target_percent`.
    pub target_mesh_percent: Option<f64>,
    /// What filtering may show, noise and texel grid together: with no more texels than that takes. Unit: percent. Default:
    /// none.
    pub target_shown_percent: Option<f64>,
    /// End after this time with what is there. Half of it is for the lightmap UVs: what is not unwrapped by then is
    /// flattened plane by plane, in more charts, so that light is traced in any case. Unit: seconds. Default: none.
    pub time_limit: Option<f64>,
    /// End after this many photons with what is there. Default: none.
    pub max_photons: Option<u64>,
    /// Refuse to take more memory than this. Unit: bytes. Default: 4 GiB.
    pub memory_limit: u64,
    /// Page width and height. Unit: texels. Default: 2048.
    pub max_texture: u32,
    /// Most pages the atlas may have. Default: 16.
    pub max_pages: u32,
    /// Texel density. Default: automatic.
    pub density: Density,
    /// Empty texels around each chart. Unit: texels. Default: 4.
    pub gutter: u32,
    /// Where the lightmap UVs come from. Default: generated.
    pub uv: UvSource,
    /// What cuts and flattens meshes. Default: uvunwrap.
    pub unwrapper: Unwrapper,
    /// Light from beyond the geometry. Default: none.
    pub sky: Option<SkySource>,
    /// Rotation of a sky about +Y, that of the scene's file as well. Unit: degrees. Default: 0.
    pub sky_rotation: f32,
    /// Factor on the sky's radiance. Default: 1.
    pub sky_scale: f32,
    /// A sun besides the lights of the file. Default: none.
    pub sun: Option<Sun>,
    /// Which part of the light is baked. Default: all of it.
    pub lights: Lights,
    /// Groups of lights whose light is kept apart: the name of a group, and a name of lights that are in it, as
    /// [`Changes`](crate::scene::Changes) takes it, `sun` and `sky` for those of these options. Of several that fit, the
    /// last holds; what is in none is the group `rest`. Default: none.
    pub groups: Vec<(String, String)>,
    /// Which normals receive light. Default: smooth.
    pub normals: Normals,
    /// Which side of a double-sided surface is stored. Default: automatic.
    pub double_sided: DoubleSided,
    /// What a stored texel is. Default: the mean over its open part.
    pub texel_value: TexelValue,
    /// What indirect light and that of the sky are smoothed over. Default: cells.
    pub smoothing: Smoothing,
    /// What the maps hold. Default: irradiance over pi.
    pub quantity: Quantity,
    /// Nodes to bake, by name, `*` at its end for any end; empty: all. Others still occlude and bounce. Default: all.
    pub only: Vec<String>,
    /// Nodes not to bake, by such names. Default: none.
    pub exclude: Vec<String>,
    /// How much of the map is path-traced to check the stated error. Default: automatic.
    pub audit: Audits,
    /// Seed of every random stream. Default: 0.
    pub seed: u64,
    /// Worker threads; 0: one per core. The result does not depend on it. Default: 0.
    pub threads: usize,
}

impl Default for BakeOptions {
    fn default() -> Self {
        BakeOptions {
            target_percent: 2.0,
            target_mesh_percent: None,
            target_shown_percent: None,
            time_limit: None,
            max_photons: None,
            memory_limit: 4 << 30,
            max_texture: 2048,
            max_pages: 16,
            density: Density::Auto,
            gutter: 4,
            uv: UvSource::Generate,
            unwrapper: Unwrapper::Uvunwrap,
            sky: None,
            sky_rotation: 0.0,
            sky_scale: 1.0,
            sun: None,
            lights: Lights::All,
            groups: Vec::new(),
            normals: Normals::Smooth,
            double_sided: DoubleSided::Auto,
            texel_value: TexelValue::Open,
            smoothing: Smoothing::Cells,
            quantity: Quantity::IrradianceOverPi,
            only: Vec::new(),
            exclude: Vec::new(),
            audit: Audits::Auto,
            seed: 0,
            threads: 0,
        }
    }
}

/// Texel density.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Density {
    /// Where light needs them, as a pilot finds: on one page of `max_texture` squared, or less where that makes little
    /// difference.
    Auto,
    /// The same everywhere, the highest at which everything fits on one page of `max_texture` squared.
    Even,
    /// Texels per metre, on as many pages as that takes (`max_pages` at most).
    TexelsPerMetre(f64),
}

/// Where the lightmap UVs come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum UvSource {
    /// Cut, flattened and packed here.
    Generate,
    /// TEXCOORD_1 of the file as it is, on one page of `max_texture` squared.
    Keep,
}

/// What cuts and flattens meshes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Unwrapper {
    /// The crate uvunwrap, in this process.
    Uvunwrap,
    /// xatlas, in a child process of the given evenlight binary.
    Xatlas {
        /// Path of an evenlight binary built with the feature `xatlas`.
        worker: PathBuf,
    },
}

impl Unwrapper {
    /// Its name, wherever its program lies.
    pub fn name(&self) -> &'static str {
        match self {
            Unwrapper::Uvunwrap => "uvunwrap",
            Unwrapper::Xatlas { .. } => "xatlas",
        }
    }
}

/// Light from beyond the geometry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum SkySource {
    /// The same radiance from everywhere. Unit: nit per channel.
    Constant(Vec3),
    /// An equirectangular .hdr or .exr file; 1.0 = 1 nit, the centre looks along -Z.
    File(PathBuf),
    /// A clear day with the sun where [`BakeOptions::sun`] has it; dark below the horizon.
    Clear {
        /// Haze, in [1, 10].
        turbidity: f32,
        /// Reflectance of the ground all around, in [0, 1].
        ground: f32,
    },
}

/// A sun given on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sun {
    /// Height above the horizon. Unit: degrees.
    pub elevation: f32,
    /// From -Z towards +X. Unit: degrees.
    pub azimuth: f32,
    /// Illuminance on a plane facing it. Unit: lux.
    pub illuminance: f32,
    /// Angular diameter. Unit: degrees. Default: 0.53.
    pub diameter: f32,
}

impl Sun {
    /// Unit direction towards it.
    pub fn towards(&self) -> DVec3 {
        let (e, a) = (f64::from(self.elevation).to_radians(), f64::from(self.azimuth).to_radians());
        let ((se, ce), (sa, ca)) = (libm::sincos(e), libm::sincos(a));
        DVec3::new(sa * ce, se, -ca * ce)
    }
}

/// Which part of the light is baked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Lights {
    /// Direct and reflected light.
    All,
    /// Reflected light of punctual lights only, so that the engine can add their direct part at run time.
    Indirect,
}

/// Which normals receive light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Normals {
    /// The interpolated normals of the file.
    Smooth,
    /// The plane of each triangle.
    Geometric,
}

/// Which side of a double-sided surface is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum DoubleSided {
    /// Per chart, the side that receives more; the front of what is drawn from there alone.
    Auto,
    /// The front.
    Front,
    /// Both, as two layers.
    Split,
}

/// What a stored texel is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum TexelValue {
    /// The mean over the part of the texel's footprint that is not buried in solids.
    Open,
    /// The mean over the whole footprint, buried area included: for comparison with other renderers.
    Mean,
}

/// What indirect light and that of the sky are smoothed over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Smoothing {
    /// Cells of many texels, as large as the noise asks for; what that blurs is part of the stated error.
    Cells,
    /// The same, but for direct light: of that every texel has its own samples.
    Indirect,
    /// Nothing: every texel has the photons that it caught itself. Unbiased, and slow.
    None,
}

/// What the maps hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quantity {
    /// E / pi: the luminance of a white diffuse surface. Unit: nit.
    IrradianceOverPi,
    /// E. Unit: lux.
    Irradiance,
}

/// How much of the map is audited.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Audits {
    /// Random texels for about 3 % of the bake's rays, or two million where that is more.
    Auto,
    /// Nothing.
    Off,
    /// So many random texels, each with noise about as large as the target.
    Texels(usize),
}

impl BakeOptions {
    /// The target per mesh in force. Unit: percent.
    pub fn mesh_target(&self) -> f64 {
        self.target_mesh_percent.unwrap_or(3.0 * self.target_percent)
    }

    /// Most groups of lights that are kept apart.
    pub fn most_groups(&self) -> usize {
        let names: std::collections::BTreeSet<&str> = self.groups.iter().map(|(group, _)| group.as_str()).collect();
        if names.is_empty() { 0 } else { names.len() + 1 }
    }

    /// Adds all that the light of a bake depends on, but for where its sky comes from: not what only says when to stop, how
    /// it is checked, or what is written of it.
    pub(crate) fn feed(&self, digest: &mut Digest) {
        let apart = BakeOptions::default();
        digest.debug(&self.unwrapper.name());
        digest.debug(&BakeOptions {
            target_percent: apart.target_percent,
            target_mesh_percent: None,
            time_limit: None,
            max_photons: None,
            quantity: apart.quantity,
            audit: apart.audit,
            threads: 0,
            sky: None,
            unwrapper: apart.unwrapper,
            ..self.clone()
        });
    }

    /// Whether a pilot says where texels go.
    pub fn adapts_density(&self) -> bool {
        self.density == Density::Auto && self.uv == UvSource::Generate
    }

    /// Checks ranges and contradictions.
    ///
    /// # Errors
    /// [`BakeError::Options`] names the option, its value and what it may be.
    pub fn validate(&self) -> Result<(), BakeError> {
        let fail = |what: String| Err(BakeError::Options(what));
        let percent = |name: &str, v: f64| {
            if v > 0.0 && v.is_finite() { Ok(()) } else { fail(format!("{name} {v}: must be a number above 0")) }
        };
        percent("--target-percent", self.target_percent)?;
        self.target_mesh_percent.map_or(Ok(()), |v| percent("--target-mesh-percent", v))?;
        self.target_shown_percent.map_or(Ok(()), |v| percent("--target-shown-percent", v))?;
        if self.target_shown_percent.is_some_and(|shown| shown <= self.target_percent) {
            return fail(format!(
                "--target-shown-percent {}: must be above --target-percent {}, which is a part of it",
                self.target_shown_percent.unwrap_or_default(),
                self.target_percent
            ));
        }
        self.time_limit.map_or(Ok(()), |v| percent("--time-limit", v))?;
        if !(1..=MAX_TEXTURE).contains(&self.max_texture) {
            return fail(format!("--max-texture {}: must lie in 1 to {MAX_TEXTURE}", self.max_texture));
        }
        if !(1..=MAX_PAGES).contains(&self.max_pages) {
            return fail(format!("--max-pages {}: must lie in 1 to {MAX_PAGES}", self.max_pages));
        }
        if self.gutter > 64 || 2 * self.gutter >= self.max_texture.max(2) {
            return fail(format!("--gutter {}: must be at most 64 and leave room on the page", self.gutter));
        }
        if let Density::TexelsPerMetre(d) = self.density
            && !(d > 0.0 && d.is_finite())
        {
            return fail(format!("--density {d}: must be a number of texels per metre above 0"));
        }
        if !(self.sky_scale >= 0.0 && self.sky_scale.is_finite() && self.sky_rotation.is_finite()) {
            return fail("--sky-scale must be 0 or more, --sky-rotation a number".into());
        }
        if self.double_sided == DoubleSided::Split && !self.groups.is_empty() {
            return fail("--double-sided split: the backs have no layers of groups; leave out --group".into());
        }
        if let Some(SkySource::Constant(l)) = &self.sky
            && !((*l * self.sky_scale).is_finite() && l.min_element() >= 0.0)
        {
            return fail(format!("--sky {},{},{}: radiance times --sky-scale must be a number from 0", l.x, l.y, l.z));
        }
        if let Some(SkySource::Clear { turbidity, ground }) = self.sky {
            if !(1.0..=10.0).contains(&turbidity) || !(0.0..=1.0).contains(&ground) {
                return fail(format!(
                    "--sky clear:{turbidity},{ground}: turbidity lies in 1 to 10, the ground in 0 to 1"
                ));
            }
            let Some(sun) = self.sun else {
                return fail(
                    "--sky clear: needs --sun ELEVATION,AZIMUTH,LUX; with 0 lux it only says where the sun is".into(),
                );
            };
            if !(0.0..=90.0).contains(&sun.elevation) {
                return fail(format!("--sky clear: the sun must stand 0 to 90 degrees high, not {}", sun.elevation));
            }
            if self.sky_rotation != 0.0 {
                return fail("--sky-rotation turns an image; a clear sky turns with --sun".into());
            }
        }
        if let Audits::Texels(n) = self.audit
            && !(2..=MAX_AUDITED).contains(&n)
        {
            return fail(format!("--audit {n}: must lie in 2 to {MAX_AUDITED} texels"));
        }
        if let Some(s) = self.sun {
            let finite = s.elevation.is_finite() && s.azimuth.is_finite() && s.illuminance.is_finite();
            if !finite || s.illuminance < 0.0 || !(0.0..=90.0).contains(&s.diameter) {
                return fail("--sun: illuminance must be 0 or more, the diameter 0 to 90 degrees".into());
            }
        }
        Ok(())
    }
}

/// Largest page (texels).
pub const MAX_TEXTURE: u32 = 16384;

/// Most texels that are audited.
pub const MAX_AUDITED: usize = 1 << 20;

/// Most pages.
pub const MAX_PAGES: u32 = 256;
