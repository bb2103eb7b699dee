//! The flags, and options from them.

use clap::{Args, Parser, Subcommand};
use evenlight::BakeError;
use evenlight::options::{
    Audits, BakeOptions, Density, DoubleSided, Lights, Normals, Quantity, SkySource, Smoothing, Sun, TexelValue,
    Unwrapper, UvSource,
};
use evenlight::output::lightmap_exr::Layer;
use evenlight::scene::{BakeMode, Changes, LightChange};
use evenlight::solve::Shard;
use glam::Vec3;
use std::path::PathBuf;

/// A lightmap baker that takes an error, not a sample count.
#[derive(Debug, Parser)]
#[command(version, about, arg_required_else_help = true)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
#[allow(clippy::large_enum_variant)]
pub enum Command {
    /// Bake lightmaps: EXR maps, the scene with lightmap UVs, a manifest and a report as JSON and HTML.
    Bake(BakeArgs),
    /// Say what is in a scene, what would be baked, and what is wrong with it.
    Inspect {
        /// A .glb or .gltf file.
        scene: PathBuf,
        /// The variant of the file's materials to look at (KHR_materials_variants).
        #[arg(long, value_name = "NAME")]
        variant: Option<String>,
        /// As JSON.
        #[arg(long)]
        json: bool,
    },
    /// (not built yet) Check the lightmap UVs of a scene.
    Check { scene: PathBuf },
    /// Plan a bake for several machines: look at the light until it is known what more it takes, and write texels and
    /// work down in the folder --out. Takes what `bake` does.
    Plan(PlanArgs),
    /// Bake from what the shards of a plan did: `bake --plan P --shard 1/8 -o FILE`, and so on.
    Merge(MergeArgs),
    /// (not built yet) Look at a finished bake.
    View { folder: PathBuf },
    /// (not built yet) Check this build on this machine.
    Selftest,
    /// Unwrap one mesh from stdin to stdout (a child process of `bake --unwrapper xatlas`).
    #[command(hide = true, name = "unwrap-worker")]
    UnwrapWorker,
}

/// Most shards of a plan.
const MOST_SHARDS: u32 = 1_000_000;

#[derive(Debug, Args)]
pub struct PlanArgs {
    /// At most about so many shards there will be: photons are shot in as many nets at least, if there are enough.
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_SHARDS)))]
    pub shards: u32,
    #[command(flatten)]
    pub bake: BakeArgs,
}

#[derive(Debug, Args)]
pub struct MergeArgs {
    /// Files of the shards, one of each at most. Without some, the light is as unbiased as with all, and less accurate.
    #[arg(required = true)]
    pub shards: Vec<PathBuf>,
    /// The folder of the plan.
    #[arg(long)]
    pub plan: PathBuf,
    /// Folder for the results; made if absent.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Where the scene is, if not where it was planned.
    #[arg(long)]
    pub scene: Option<PathBuf>,
    /// Worker threads; 0: one per core. The result is the same.
    #[arg(long, default_value_t = 0)]
    pub threads: usize,
    #[command(flatten)]
    pub files: FileArgs,
}

/// Which files are written besides maps, scene, manifest and report.
#[derive(Debug, Clone, Copy, Args)]
pub struct FileArgs {
    /// Print the report to stdout as JSON.
    #[arg(long, help_heading = "Run")]
    pub json: bool,
    /// Write no preview pictures.
    #[arg(long, help_heading = "Run")]
    pub no_preview: bool,
    /// Write no report.html.
    #[arg(long, help_heading = "Run")]
    pub no_html: bool,
}

#[derive(Debug, Args)]
pub struct BakeArgs {
    /// A .glb or .gltf file.
    #[arg(required_unless_present = "plan")]
    pub scene: Vec<PathBuf>,
    /// Folder for the results; made if absent. With --shard, the file for what the shard did; of `plan`, the folder of the
    /// plan.
    #[arg(short, long)]
    pub out: PathBuf,
    /// The variant of the file's materials to bake (KHR_materials_variants) [default: the file's own materials].
    #[arg(long, value_name = "NAME")]
    pub variant: Option<String>,

    /// A TOML file that says what these flags would: each by its long name, and tables [light.NAME] with bake, scale,
    /// ies and group, [node.NAME] with weight, density, bake, casts and receives. What is said here wins. Paths in it are relative
    /// to it.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,

    /// Bake until the upper 95 % limit of the texel error is under this [% of the mean].
    #[arg(long, default_value_t = 2.0, help_heading = "Targets and limits")]
    target_percent: f64,
    /// ... and until 95 % of the nodes are under this, each relative to its own mean [default: 3 x target].
    #[arg(long, help_heading = "Targets and limits")]
    target_mesh_percent: Option<f64>,
    /// Texels until what filtering shows, texel error and texel grid together, is under this [percent of the mean
    /// irradiance]; no more than that takes, and at most a page.
    #[arg(long, help_heading = "Targets and limits")]
    target_shown_percent: Option<f64>,
    /// End after this many seconds with what is there (exit status 3). Half of them are for the lightmap UVs; what is
    /// not unwrapped by then is flattened plane by plane, in more charts, and a warning says so.
    #[arg(long, value_name = "SECONDS", help_heading = "Targets and limits")]
    pub time_limit: Option<f64>,
    /// End after this many photons with what is there (exit status 3).
    #[arg(long, help_heading = "Targets and limits")]
    max_photons: Option<f64>,
    /// Refuse to take more memory than this [MiB].
    #[arg(long, default_value_t = 4096, value_name = "MIB", help_heading = "Targets and limits")]
    memory_limit: u64,

    /// Page width and height [texels].
    #[arg(long, default_value_t = 2048, help_heading = "Atlas")]
    max_texture: u32,
    /// Most pages.
    #[arg(long, default_value_t = 16, help_heading = "Atlas")]
    max_pages: u32,
    /// `auto`: more where light changes quickly, as a short pilot finds, on one page at most; `even`: the same
    /// everywhere, the highest that fits one page; or texels per metre, on as many pages as that takes.
    #[arg(long, default_value = "auto", help_heading = "Atlas")]
    density: String,
    /// Empty texels around each chart.
    #[arg(long, default_value_t = 4, help_heading = "Atlas")]
    gutter: u32,
    /// Make lightmap UVs, or keep TEXCOORD_1 texel for texel on one page of --max-texture squared.
    #[arg(long, default_value = "generate", value_parser = ["generate", "keep"], help_heading = "Atlas")]
    uv: String,
    /// What cuts and flattens meshes.
    #[arg(long, default_value = "uvunwrap", value_parser = ["uvunwrap", "xatlas"], help_heading = "Atlas")]
    unwrapper: String,

    /// Light from everywhere: cd/m2, R,G,B, an equirectangular .hdr or .exr file (1.0 = 1 cd/m2), or a clear day with the
    /// sun of --sun: `clear:3`, turbidity 1 to 10, and after a comma the reflectance of the ground [default: 0.2].
    #[arg(long, value_name = "CD/M2|R,G,B|FILE|clear:TURBIDITY", help_heading = "Light")]
    sky: Option<String>,
    /// Turn the picture of a sky, of --sky or of the file, about the vertical [degrees, counter-clockwise from above].
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true, help_heading = "Light")]
    sky_rotation: f32,
    /// Factor on the sky, of --sky or of the file.
    #[arg(long, default_value_t = 1.0, help_heading = "Light")]
    sky_scale: f32,
    /// ELEVATION,AZIMUTH,LUX[,DIAMETER]: lux on a plane facing it; azimuth from -Z towards +X [degrees].
    #[arg(long, allow_hyphen_values = true, help_heading = "Light")]
    sun: Option<String>,
    /// Bake all light, or only what punctual lights reflect.
    #[arg(long, default_value = "all", value_parser = ["all", "indirect"], help_heading = "Light")]
    lights: String,
    /// NAME=full|indirect|off or NAME=SCALE: which part of a light is baked, or a factor on it. By name of a light, of
    /// its node, or of a material that emits; `*` at the end stands for any end. May be repeated.
    #[arg(long, value_name = "NAME=WHAT", help_heading = "Light")]
    light: Vec<String>,
    /// NAME=FILE: let a point or spot light shine as an IES file says, with the intensity of the file and the hue of the
    /// light. Names as of --light. May be repeated.
    #[arg(long, value_name = "NAME=FILE", help_heading = "Light")]
    ies: Vec<String>,
    /// GROUP=NAME: keep the light of these lights apart, as a layer `GROUP.R`, `.G`, `.B` of the maps beside their sum, to dim
    /// or colour it later. Names as of --light, `sun` and `sky`; what is in no group is the layer `rest`. Each meets the
    /// targets by itself. May be repeated.
    #[arg(long, value_name = "GROUP=NAME", help_heading = "Light")]
    group: Vec<String>,
    /// Leave lights out of scene.glb whose direct light is in the maps, surroundings of the file (EXT_lights_image_based)
    /// among them.
    #[arg(long, help_heading = "Light")]
    remove_baked_lights: bool,

    /// Receive light on the file's normals or on flat triangles.
    #[arg(long, default_value = "smooth", value_parser = ["smooth", "geometric"], help_heading = "Maps")]
    normals: String,
    /// Side of double-sided surfaces: per chart the one that receives more, the front, or both.
    #[arg(long, default_value = "auto", value_parser = ["auto", "front", "split"], help_heading = "Maps")]
    double_sided: String,
    /// Mean over a texel's open part, or over all of it; `fit` is not built yet.
    #[arg(long, default_value = "open", value_parser = ["open", "mean", "fit"], help_heading = "Maps")]
    texel_value: String,
    /// Smooth light of photons and of the sky over cells as large as its noise asks for, or leave every texel its own.
    #[arg(long, default_value = "cells", value_parser = ["cells", "indirect", "none"], help_heading = "Maps")]
    smoothing: String,
    /// What the maps hold: E / pi [cd/m2], or E [lux].
    #[arg(long, default_value = "irradiance-over-pi", value_parser = ["irradiance-over-pi", "irradiance"], help_heading = "Maps")]
    quantity: String,
    /// More layers in the EXR files: half_difference, coverage, area, back.
    #[arg(long, value_delimiter = ',', help_heading = "Maps")]
    layers: Vec<String>,
    /// 32-bit float instead of half.
    #[arg(long, help_heading = "Maps")]
    pub float: bool,
    /// Bake these nodes alone; the others still block and reflect. `*` at the end of a name stands for any end.
    #[arg(long, value_delimiter = ',', help_heading = "Maps")]
    only: Vec<String>,
    /// Do not bake these nodes; names as for --only.
    #[arg(long, value_delimiter = ',', help_heading = "Maps")]
    exclude: Vec<String>,

    /// Path-trace random texels to check the stated error: `auto` (3 % of the bake's rays, or two million), `off`,
    /// or how many texels.
    #[arg(long, default_value = "auto", help_heading = "Run")]
    audit: String,
    /// Seed of every random number.
    #[arg(long, default_value_t = 0, help_heading = "Run")]
    seed: u64,
    /// Worker threads; 0: one per core. The result is the same.
    #[arg(long, default_value_t = 0, help_heading = "Run")]
    pub threads: usize,
    /// Keep charts and light in this folder, and use what is there: a bake that was stopped or killed goes on where it was
    /// (work is kept every two minutes), and one with a lower target from what the last one found, its texels where they
    /// were.
    #[arg(long, value_name = "DIR", help_heading = "Run")]
    cache: Option<PathBuf>,
    /// Most that this folder may hold; what was not used for longest goes [GiB].
    #[arg(long, default_value_t = 16.0, help_heading = "Run")]
    cache_limit: f64,
    /// The same as --cache with the folder `.cache` among the results: give it from the first run on.
    #[arg(long, conflicts_with = "cache", help_heading = "Run")]
    resume: bool,
    /// Bake as this plan says: scene, targets and all else are its own.
    #[arg(long, value_name = "DIR", help_heading = "Run")]
    pub plan: Option<PathBuf>,
    /// Do one part of the work of --plan, number I of N from 1, for `merge`.
    #[arg(long, value_name = "I/N", requires = "plan", help_heading = "Run")]
    shard: Option<String>,
    #[command(flatten)]
    pub files: FileArgs,
}

impl BakeArgs {
    /// The cache and the most bytes that it may hold, if there is to be one.
    ///
    /// # Errors
    /// [`BakeError::Options`] where that is no size.
    pub fn cache(&self) -> Result<Option<(PathBuf, u64)>, BakeError> {
        let limit = self.cache_limit;
        if !(limit >= 0.0 && limit.is_finite()) {
            return Err(BakeError::Options(format!("--cache-limit {limit}: must be a number of GiB from 0")));
        }
        let folder = if self.resume { Some(self.out.join(".cache")) } else { self.cache.clone() };
        Ok(folder.map(|folder| (folder, (limit * f64::from(1 << 30)) as u64)))
    }

    /// Options out of flags.
    ///
    /// # Errors
    /// [`BakeError::Options`] names the flag and what it takes.
    pub fn options(&self) -> Result<BakeOptions, BakeError> {
        self.refuse_what_is_not_built()?;
        let options = BakeOptions {
            target_percent: self.target_percent,
            target_mesh_percent: self.target_mesh_percent,
            target_shown_percent: self.target_shown_percent,
            time_limit: self.time_limit,
            max_photons: self.max_photons.map(photons).transpose()?,
            memory_limit: self.memory_limit.saturating_mul(1 << 20),
            max_texture: self.max_texture,
            max_pages: self.max_pages,
            density: density(&self.density)?,
            gutter: self.gutter,
            uv: if self.uv == "keep" { UvSource::Keep } else { UvSource::Generate },
            unwrapper: self.unwrapper()?,
            sky: self.sky.as_deref().map(sky).transpose()?,
            sky_rotation: self.sky_rotation,
            sky_scale: self.sky_scale,
            sun: self.sun.as_deref().map(sun).transpose()?,
            lights: if self.lights == "indirect" { Lights::Indirect } else { Lights::All },
            groups: self.group.iter().map(|text| group(text)).collect::<Result<_, _>>()?,
            normals: if self.normals == "geometric" { Normals::Geometric } else { Normals::Smooth },
            double_sided: match self.double_sided.as_str() {
                "front" => DoubleSided::Front,
                "split" => DoubleSided::Split,
                _ => DoubleSided::Auto,
            },
            texel_value: if self.texel_value == "mean" { TexelValue::Mean } else { TexelValue::Open },
            smoothing: match self.smoothing.as_str() {
                "none" => Smoothing::None,
                "indirect" => Smoothing::Indirect,
                _ => Smoothing::Cells,
            },
            quantity: if self.quantity == "irradiance" { Quantity::Irradiance } else { Quantity::IrradianceOverPi },
            only: self.only.clone(),
            exclude: self.exclude.clone(),
            audit: audits(&self.audit)?,
            seed: self.seed,
            threads: self.threads,
        };
        options.validate()?;
        Ok(options)
    }

    /// Changes to the scene out of flags.
    ///
    /// # Errors
    /// [`BakeError::Options`] names the flag and what it takes.
    pub fn changes(&self) -> Result<Changes, BakeError> {
        let lights = self.light.iter().map(|text| light(text));
        let profiles = self.ies.iter().map(|text| profile(text));
        Ok(Changes { lights: profiles.chain(lights).collect::<Result<_, _>>()?, nodes: Vec::new() })
    }

    /// Extra layers of the EXR files.
    ///
    /// # Errors
    /// [`BakeError::Options`] lists the layers there are.
    pub fn layers(&self) -> Result<Vec<Layer>, BakeError> {
        self.layers.iter().map(|l| l.parse()).collect()
    }

    /// Which part of a plan is to be done; `None` for all of it.
    ///
    /// # Errors
    /// [`BakeError::Options`] says what the flag takes.
    pub fn shard(&self) -> Result<Option<Shard>, BakeError> {
        let Some(text) = &self.shard else { return Ok(None) };
        let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parts {
            Some((number, count)) if (1..=count).contains(&number) && count <= MOST_SHARDS => {
                Ok(Some(Shard { number, count }))
            }
            _ => Err(BakeError::Options(format!("--shard {text}: takes I/N, from 1/N to N/N, such as 3/8"))),
        }
    }

    /// True where lights whose direct light is baked leave scene.glb.
    pub fn removes_baked_lights(&self) -> bool {
        self.remove_baked_lights
    }

    /// A flag that would do nothing is an error, never ignored.
    fn refuse_what_is_not_built(&self) -> Result<(), BakeError> {
        let asked = [(self.texel_value == "fit", "--texel-value fit"), (self.scene.len() > 1, "more than one scene")];
        match asked.iter().find(|a| a.0) {
            Some((_, flag)) => Err(BakeError::Options(format!("{flag} is not built yet; leave it out"))),
            None => Ok(()),
        }
    }

    fn unwrapper(&self) -> Result<Unwrapper, BakeError> {
        if self.unwrapper != "xatlas" {
            return Ok(Unwrapper::Uvunwrap);
        }
        let worker = std::env::current_exe()
            .map_err(|e| BakeError::Options(format!("--unwrapper xatlas: cannot find this program's own file: {e}")))?;
        Ok(Unwrapper::Xatlas { worker })
    }
}

/// GROUP=NAME.
fn group(text: &str) -> Result<(String, String), BakeError> {
    let parts = text.split_once('=').filter(|(group, name)| !group.is_empty() && !name.is_empty());
    parts
        .map(|(group, name)| (group.into(), name.into()))
        .ok_or_else(|| BakeError::Options(format!("--group {text}: takes GROUP=NAME, such as lamps=spot*")))
}

/// NAME=full|indirect|off|SCALE.
fn light(text: &str) -> Result<(String, LightChange), BakeError> {
    let fail = || {
        BakeError::Options(format!(
            "--light {text}: takes NAME=full, NAME=indirect, NAME=off or NAME=SCALE, such as 0.5"
        ))
    };
    let (name, what) = text.rsplit_once('=').filter(|(name, _)| !name.is_empty()).ok_or_else(fail)?;
    let change = match light_word(what.trim()) {
        Some(mode) => LightChange { bake: Some(mode), ..LightChange::default() },
        None => LightChange { scale: Some(what.trim().parse().map_err(|_| fail())?), ..LightChange::default() },
    };
    Ok((name.into(), change))
}

/// Which part of a light is baked.
pub fn light_word(word: &str) -> Option<BakeMode> {
    [BakeMode::Full, BakeMode::Indirect, BakeMode::Off].into_iter().find(|mode| mode.word() == word)
}

/// NAME=FILE.
fn profile(text: &str) -> Result<(String, LightChange), BakeError> {
    match text.split_once('=') {
        Some((name, file)) if !name.is_empty() && !file.is_empty() => {
            Ok((name.into(), LightChange { ies: Some(file.into()), ..LightChange::default() }))
        }
        _ => Err(BakeError::Options(format!("--ies {text}: takes NAME=FILE, such as pendant=downlight.ies"))),
    }
}

fn density(text: &str) -> Result<Density, BakeError> {
    match text {
        "auto" => Ok(Density::Auto),
        "even" => Ok(Density::Even),
        _ => text.parse().map(Density::TexelsPerMetre).map_err(|_| {
            BakeError::Options(format!("--density {text}: takes `auto`, `even` or texels per metre, such as 32"))
        }),
    }
}

fn photons(most: f64) -> Result<u64, BakeError> {
    if most > 0.0 && most.is_finite() {
        return Ok(most as u64);
    }
    Err(BakeError::Options(format!("--max-photons {most}: must be a number above 0, such as 1e9")))
}

fn audits(text: &str) -> Result<Audits, BakeError> {
    match text {
        "auto" => Ok(Audits::Auto),
        "off" => Ok(Audits::Off),
        _ => text.parse().map(Audits::Texels).map_err(|_| {
            BakeError::Options(format!("--audit {text}: takes `auto`, `off` or a number of texels, such as 1000"))
        }),
    }
}

/// A number, three numbers, a clear day, or else a file.
fn sky(text: &str) -> Result<SkySource, BakeError> {
    let numbers = |text: &str| -> Option<Vec<f32>> { text.split(',').map(|n| n.trim().parse().ok()).collect() };
    if let Some(clear) = text.strip_prefix(CLEAR) {
        return match numbers(clear).as_deref() {
            Some(&[turbidity]) => Ok(SkySource::Clear { turbidity, ground: 0.2 }),
            Some(&[turbidity, ground]) => Ok(SkySource::Clear { turbidity, ground }),
            _ => Err(BakeError::Options(format!("--sky {text}: takes clear:TURBIDITY[,GROUND], such as clear:3"))),
        };
    }
    Ok(match numbers(text).as_deref() {
        Some(&[l]) => SkySource::Constant(Vec3::splat(l)),
        Some(&[r, g, b]) => SkySource::Constant(Vec3::new(r, g, b)),
        _ => SkySource::File(text.into()),
    })
}

/// How a clear sky begins.
pub const CLEAR: &str = "clear:";

fn sun(text: &str) -> Result<Sun, BakeError> {
    let numbers: Option<Vec<f32>> = text.split(',').map(|n| n.trim().parse().ok()).collect();
    let (elevation, azimuth, illuminance, diameter) = match numbers.as_deref() {
        Some(&[e, a, l]) => (e, a, l, 0.53),
        Some(&[e, a, l, d]) => (e, a, l, d),
        _ => {
            let what = "takes ELEVATION,AZIMUTH,LUX[,DIAMETER], such as 45,120,100000";
            return Err(BakeError::Options(format!("--sun {text}: {what}")));
        }
    };
    Ok(Sun { elevation, azimuth, illuminance, diameter })
}
