//! What a bake says about itself.

use crate::accuracy::{Audit, MeshError, TexelError};
use crate::atlas::{Atlas, Texels};
use crate::error::Warning;
use crate::light::{Emitters, Lighting};
use crate::lightmap::Shown;
use crate::observer::{Progress, Remaining};
use crate::options::{BakeOptions, Quantity};
use crate::photon::EnergyLedger;
use crate::scene::{Scene, World};
use crate::solve::{GroupSolution, Solution};
use serde::{Deserialize, Serialize};

/// The convergence report. Errors are in percent of the mean irradiance, as the README defines them.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// Version of the program.
    pub evenlight: &'static str,
    /// Name of the scene.
    pub scene: String,
    /// Seed of every random stream.
    pub seed: u64,
    /// What the maps hold.
    pub quantity: Quantity,
    /// Asked for: upper 95 % limit of the texel error.
    pub target_percent: f64,
    /// Asked for: error per mesh that 95 % of the meshes must meet.
    pub target_mesh_percent: f64,
    /// Asked for: what filtering may show.
    pub target_shown_percent: Option<f64>,
    /// All targets are met.
    pub target_met: bool,
    /// What ended the bake where a target is not met: `time-limit`, `max-photons`, `samples`, `texels`, and with groups of
    /// lights `audit`, where that of all together finds what theirs did not, or `meshes`, where only their sum misses.
    pub limit: Option<&'static str>,
    /// Noise of the stored mean: sqrt( sum a (E_odd - E_even)^2 / (4 sum a) ) over the mean.
    pub sigma: f64,
    /// Distance of the two halves, as the founding paper states it: twice `sigma`.
    pub sigma_paper: f64,
    /// What smoothing the indirect light over cells adds; 0 where the halves show none.
    pub cell_bias: f64,
    /// Bias that could not be told from none: the root of the standard error of its square.
    pub cell_bias_resolution: f64,
    /// What an audit found beyond both; 0 where it found no more than they tell.
    pub unseen_error: f64,
    /// What smoothing changed in the sum of all light that is smoothed (%).
    pub cell_energy_change: f64,
    /// sqrt(sigma^2 + cell_bias^2 + unseen_error^2).
    pub texel_error_percent: f64,
    /// 95 % interval of the texel error.
    pub texel_error_interval: [f64; 2],
    /// The same for luminance.
    pub luminance_error_percent: f64,
    /// What path tracing says of the texel error; `null` where it was not asked.
    pub audit: Option<Audit>,
    /// RMS of bilinear filtering of texels without noise against the irradiance inside them.
    pub texel_grid_error: f64,
    /// A grid error that could not be told from none: the root of the standard error of its square.
    pub texel_grid_resolution: f64,
    /// What a filter shows: grid error, the noise that filtering leaves, bias and what the audit found.
    pub shown_error_percent: f64,
    /// Share of the area whose error is at most the target times max(E there, 1 % of the mean).
    pub area_within_target: f64,
    /// Error that 95 % of the meshes are under.
    pub mesh_error_percent_95: f64,
    /// Share of the squared error in the worst thousandth of the texels.
    pub outlier_share: f64,
    /// Noise of the direct part and of the indirect part, relative to the whole mean.
    pub split: Split,
    /// Area-weighted mean irradiance (lux) over channels.
    pub mean_irradiance: f64,
    /// Per node.
    pub meshes: Vec<MeshError>,
    /// Per group of lights that is kept apart, in the order of the layers.
    pub groups: Vec<GroupReport>,
    /// One entry per round; with groups, one for all of them.
    pub history: Vec<HistoryEntry>,
    /// What was traced.
    pub work: Work,
    /// Where the light went, in the integer unit; `imbalance` must be 0.
    pub energy: Energy,
    /// Texels and areas.
    pub atlas: AtlasSummary,
    /// What was skipped, and what that saved.
    pub skips: Vec<String>,
    /// What was changed of the scene before, by name.
    pub changed: Vec<String>,
    /// What is odd but usable.
    pub warnings: Vec<Warning>,
    /// Largest memory of the process so far (bytes), where the system tells.
    pub peak_memory_bytes: Option<u64>,
    /// Seconds per stage: with the memory the only part that differs between runs.
    pub seconds: Seconds,
}

/// How well the light of a group of lights is known, relative to its own mean.
#[derive(Debug, Clone, Serialize)]
pub struct GroupReport {
    /// Name of the group and of its layer in the maps.
    pub name: String,
    /// Names of its lights, of materials that emit, and `sky`.
    pub lights: Vec<String>,
    /// Its targets are met.
    pub target_met: bool,
    /// What ended it where they are not.
    pub limit: Option<&'static str>,
    /// Error of the texels of its layer.
    pub texel_error_percent: f64,
    /// 95 % interval of that.
    pub texel_error_interval: [f64; 2],
    /// Error that 95 % of the meshes are under, each relative to its light of this group.
    pub mesh_error_percent_95: f64,
    /// Area-weighted mean irradiance (lux) over channels.
    pub mean_irradiance: f64,
    /// What path tracing says of the texel error; `null` where it was not asked.
    pub audit: Option<Audit>,
    /// One entry per round.
    pub history: Vec<HistoryEntry>,
}

impl GroupReport {
    /// What is known of a solved group.
    pub fn new(solved: &GroupSolution) -> GroupReport {
        GroupReport {
            name: solved.group.name.clone(),
            lights: solved.group.members.clone(),
            target_met: solved.limit.is_none(),
            limit: solved.limit,
            texel_error_percent: solved.error.percent,
            texel_error_interval: [solved.error.low, solved.error.high],
            mesh_error_percent_95: solved.mesh_percent,
            mean_irradiance: solved.error.mean,
            audit: solved.audit.ok(),
            history: solved.history.clone(),
        }
    }
}

/// Noise by source.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Split {
    /// Direct light.
    pub direct: f64,
    /// Indirect light.
    pub indirect: f64,
}

/// State at the end of a round.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct HistoryEntry {
    /// Direct samples of all texels and both halves.
    pub direct_samples: u64,
    /// Photons of both halves.
    pub photons: u64,
    /// Rays of all kinds.
    pub rays: u64,
    /// Texel error.
    pub percent: f64,
    /// Lower end of its 95 % interval.
    pub low: f64,
    /// Upper end of its 95 % interval.
    pub high: f64,
    /// Rays from the start until all targets are met, as foretold.
    pub forecast_rays: f64,
}

/// What was traced.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Work {
    /// Direct samples of all texels and both halves.
    pub direct_samples: u64,
    /// Shadow rays of the direct light.
    pub direct_rays: u64,
    /// Photons of both halves.
    pub photons: u64,
    /// Rays of photons.
    pub photon_rays: u64,
    /// Deposits of photons.
    pub deposits: u64,
    /// Photons for caustics alone, of both halves.
    pub caustic_photons: u64,
    /// Rays of these.
    pub caustic_rays: u64,
    /// Rays that gathered indirect light for meshes that photons are too slow for.
    pub gather_rays: u64,
    /// Number of such meshes.
    pub gathered_meshes: usize,
    /// Rays that look for buried surface.
    pub probe_rays: u64,
    /// Emissive triangles, and lights without area.
    pub emissive_triangles: usize,
    /// Point, spot and directional lights, suns included.
    pub lights: usize,
}

impl Work {
    /// Rays of all kinds.
    pub fn rays(&self) -> u64 {
        self.direct_rays + self.photon_rays + self.caustic_rays + self.gather_rays + self.probe_rays
    }
}

/// The energy balance.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Energy {
    /// Flux of one integer step [lux m2].
    pub unit: f64,
    /// Where the flux went.
    #[serde(flatten)]
    pub ledger: LedgerNumbers,
    /// emitted + roulette - absorbed - back_absorbed - escaped - cut.
    pub imbalance: [i64; 3],
}

/// The ledger as numbers JSON readers can hold.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct LedgerNumbers {
    emitted: [f64; 3],
    roulette: [f64; 3],
    absorbed: [f64; 3],
    back_absorbed: [f64; 3],
    escaped: [f64; 3],
    cut: [f64; 3],
}

impl Energy {
    /// From the exact ledger.
    pub fn new(ledger: &EnergyLedger, unit: f64) -> Energy {
        let f = |v: [i128; 3]| v.map(|x| x as f64);
        Energy {
            unit,
            ledger: LedgerNumbers {
                emitted: f(ledger.emitted),
                roulette: f(ledger.roulette),
                absorbed: f(ledger.absorbed),
                back_absorbed: f(ledger.back_absorbed),
                escaped: f(ledger.escaped),
                cut: f(ledger.cut),
            },
            imbalance: ledger.imbalance().map(|x| x as i64),
        }
    }
}

/// Texels and areas.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct AtlasSummary {
    /// Pages.
    pub pages: usize,
    /// Charts of all instances.
    pub charts: u32,
    /// Texels with surface.
    pub texels: usize,
    /// Texels of surfaces without a place on the map, which only reflect.
    pub transport_texels: usize,
    /// Cells that the indirect light of each half is smoothed over.
    pub cells: [usize; 2],
    /// Share of the pages' texels that hold surface.
    pub utilization: f64,
    /// Density where nothing asks for another.
    pub texels_per_metre: f64,
    /// Surface on the map (m2).
    pub area: f64,
    /// Of it inside closed solids.
    pub buried_area: f64,
    /// Triangles in the scene.
    pub triangles: usize,
}

/// Seconds per stage.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Seconds {
    /// Cutting, flattening, packing.
    pub atlas: f64,
    /// Finding out where texels are needed.
    pub pilot: f64,
    /// Clipping triangles against texels.
    pub texels: f64,
    /// Building the hierarchy.
    pub accel: f64,
    /// Looking for buried surface.
    pub open: f64,
    /// Direct light.
    pub direct: f64,
    /// Photons.
    pub photons: f64,
    /// Rays that gather their light.
    pub gather: f64,
    /// Estimating errors.
    pub estimate: f64,
    /// Auditing.
    pub audit: f64,
    /// Making the maps.
    pub finish: f64,
    /// From the call to the result.
    pub total: f64,
    /// One entry per entry of the history.
    pub rounds: Vec<RoundSeconds>,
}

/// When a round ended, and when it foretold the end. Apart from the history, which is the same for every run.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct RoundSeconds {
    /// Seconds from the call to the end of the round, with those of earlier bakes whose light was kept.
    pub at: f64,
    /// Seconds from the call until all targets would be met, by the work foretold and its speed so far.
    pub forecast: f64,
    /// Lower end of the band that it should be in.
    pub forecast_low: f64,
    /// Its upper end.
    pub forecast_high: f64,
}

impl RoundSeconds {
    /// What was known at the end of a round.
    pub fn new(now: &Progress) -> RoundSeconds {
        let until = |of: fn(&Remaining) -> f64| now.elapsed + now.remaining.as_ref().map_or(0.0, of);
        RoundSeconds {
            at: now.elapsed,
            forecast: until(|r| r.seconds),
            forecast_low: until(|r| r.low),
            forecast_high: until(|r| r.high),
        }
    }
}

/// The error that 95 % of the meshes are under (0 without meshes).
pub fn percentile_95(meshes: &[MeshError]) -> f64 {
    let mut errors: Vec<f64> = meshes.iter().map(|m| m.error_percent).collect();
    errors.sort_unstable_by(f64::total_cmp);
    let k = (errors.len() as f64 * 0.95).ceil() as usize;
    if k == 0 { 0.0 } else { errors[k - 1] }
}

impl Report {
    /// What is known when the light is solved; `open` is the open share of each texel of the map.
    pub(crate) fn new(
        world: &World,
        atlas: &Atlas,
        texels: &Texels,
        open: &[f32],
        solution: &Solution,
        lighting: &Lighting,
        options: &BakeOptions,
    ) -> Report {
        let scene = world.scene;
        let metres2 = world.frame.metres * world.frame.metres;
        let area = |share: &dyn Fn(usize) -> f64| {
            (0..texels.mapped).map(|i| f64::from(texels.texels[i].area) * share(i)).sum::<f64>() * metres2
        };
        let mut warnings = scene.warnings.clone();
        warnings.extend(atlas.warnings.iter().cloned());
        warnings.extend(lighting.warnings.iter().cloned());
        warnings.extend(texture_warnings(scene));
        let mut report = Report {
            evenlight: env!("CARGO_PKG_VERSION"),
            scene: scene.name.clone(),
            seed: options.seed,
            quantity: options.quantity,
            target_percent: options.target_percent,
            target_mesh_percent: options.mesh_target(),
            target_shown_percent: options.target_shown_percent,
            target_met: solution.limit.is_none(),
            limit: solution.limit,
            sigma: 0.0,
            sigma_paper: 0.0,
            cell_bias: 0.0,
            cell_bias_resolution: 0.0,
            unseen_error: 0.0,
            cell_energy_change: match solution.smoothed {
                [before, after] if before > 0.0 => 100.0 * (after / before - 1.0),
                _ => 0.0,
            },
            texel_error_percent: 0.0,
            texel_error_interval: [0.0; 2],
            luminance_error_percent: 0.0,
            audit: solution.audit.ok(),
            texel_grid_error: 0.0,
            texel_grid_resolution: 0.0,
            shown_error_percent: 0.0,
            area_within_target: solution.area_within_target,
            mesh_error_percent_95: solution.mesh_percent,
            outlier_share: 0.0,
            split: Split { direct: 0.0, indirect: 0.0 },
            mean_irradiance: 0.0,
            meshes: solution.meshes.clone(),
            groups: solution.groups.iter().map(GroupReport::new).collect(),
            history: solution.history.clone(),
            work: Work {
                direct_samples: solution.direct_samples,
                direct_rays: solution.direct_rays,
                photons: solution.photons,
                photon_rays: solution.ledger.rays,
                deposits: solution.ledger.deposits,
                caustic_photons: solution.caustic_photons,
                caustic_rays: solution.caustic_rays,
                gather_rays: solution.gather_rays,
                gathered_meshes: solution.gathered_meshes,
                ..Work::default()
            },
            energy: Energy::new(&solution.ledger, solution.unit * metres2),
            atlas: AtlasSummary {
                pages: atlas.pages.len(),
                charts: atlas.first_chart.last().copied().unwrap_or(0),
                texels: texels.texels[..texels.mapped].iter().filter(|t| !t.back).count(),
                transport_texels: texels.texels.len() - texels.mapped,
                cells: solution.cells,
                utilization: texels.texels[..texels.mapped].iter().filter(|t| !t.back).count() as f64
                    / atlas.pages.iter().map(|p| f64::from(p.width) * f64::from(p.height)).sum::<f64>().max(1.0),
                texels_per_metre: atlas.texels_per_metre,
                area: area(&|i| f64::from(u8::from(!texels.texels[i].back))),
                buried_area: area(&|i| if texels.texels[i].back { 0.0 } else { 1.0 - f64::from(open[i]) }),
                triangles: world.len(),
            },
            skips: solution.audit.err().into_iter().map(String::from).collect(),
            changed: scene.changed.clone(),
            warnings,
            peak_memory_bytes: None,
            seconds: Seconds::default(),
        };
        report.set_texel_error(&solution.error);
        report
    }

    /// Counts what shines, and warns where nothing is lit.
    pub(crate) fn set_emitters(&mut self, emitters: &Emitters) {
        (self.work.emissive_triangles, self.work.lights) = emitters.counts();
        if emitters.is_empty() {
            self.warnings.push(Warning::new(
                "no-light",
                "nothing in the scene emits: the maps are black; add a light, an emissive material, --sky or --sun",
            ));
        } else if self.mean_irradiance <= 0.0 {
            self.warnings.push(Warning::new(
                "no-light-arrives",
                "no sample found any light: the maps are black; look whether walls shut the lights in or out",
            ));
        }
    }

    /// Copies a texel error into the report's keys.
    pub fn set_texel_error(&mut self, e: &TexelError) {
        self.sigma = e.sigma;
        self.sigma_paper = 2.0 * e.sigma;
        self.cell_bias = e.cell_bias;
        self.cell_bias_resolution = e.cell_bias_resolution;
        self.unseen_error = e.unseen;
        self.texel_error_percent = e.percent;
        self.texel_error_interval = [e.low, e.high];
        self.luminance_error_percent = e.luminance_percent;
        self.outlier_share = e.outlier_share;
        self.split = Split { direct: e.direct, indirect: e.indirect };
        self.mean_irradiance = e.mean;
    }

    /// Copies what filtering shows into the report's keys.
    pub fn set_shown(&mut self, shown: &Shown) {
        let missed = self.target_shown_percent.is_some_and(|target| shown.percent > target);
        if missed && self.limit.is_none() {
            self.target_met = false;
            self.limit = Some("texels");
        }
        self.texel_grid_error = shown.grid;
        self.texel_grid_resolution = shown.resolution;
        self.shown_error_percent = shown.percent;
    }
}

/// Images that turned out not to be decodable when they were looked at.
fn texture_warnings(scene: &Scene) -> impl Iterator<Item = Warning> + '_ {
    scene.textures.iter().filter_map(|t| {
        let why = t.known_decode_error()?;
        Some(Warning::new("image-not-decoded", format!("image {}: {why}; taken as white", t.name)))
    })
}
