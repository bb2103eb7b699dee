//! The pipeline on one page.

use crate::accel::{Accel, coincident_warning, part_coincident};
use crate::accuracy::{TexelWeights, add_illuminances};
use crate::atlas::{self, Atlas, Texels, Unwrapping};
use crate::backs::LitBacks;
use crate::error::{BakeError, Warning};
use crate::light::{Emitters, LightGroup, LightSettings, Lighting, Visibility};
use crate::lightmap::{GridPoints, Lightmap, shown_error};
use crate::observer::{Observer, Stage};
use crate::options::{BakeOptions, Lights, UvSource};
use crate::pilot::adapt_density;
use crate::report::{AtlasSummary, Energy, GroupReport, Report, Seconds, Split, Work};
use crate::scene::{Scene, SurfaceFlags, World};
use crate::skips::Skips;
use crate::solve::{LightSeconds, Solution, Surface, solve_groups};
use std::time::Instant;

/// A finished bake.
#[derive(Debug)]
pub struct Bake<'s> {
    /// Where the charts are.
    pub atlas: Atlas,
    /// The maps.
    pub lightmap: Lightmap,
    /// What was reached and how.
    pub report: Report,
    /// The lights that were baked.
    pub lighting: Lighting,
    /// World triangles.
    pub world: World<'s>,
    /// What rays meet.
    pub accel: Accel,
    /// What each texel covers.
    pub texels: Texels,
    /// Irradiance of each texel in two halves.
    pub solution: Solution,
    /// Light that ends on backs.
    pub backs: LitBacks,
}

/// Bakes `scene`: unwraps, traces until the target is met or a limit binds, and makes the maps. Reads no files
/// but a sky image named in the options, writes and prints nothing. The result depends on the scene, the
/// options and the seed alone; on time only where a time limit binds.
///
/// # Errors
/// [`BakeError`] names the object and the cure.
pub fn bake<'s>(scene: &'s Scene, options: &BakeOptions, observer: &mut dyn Observer) -> Result<Bake<'s>, BakeError> {
    options.validate()?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(options.threads)
        .build()
        .map_err(|e| BakeError::Options(format!("cannot start {} threads: {e}", options.threads)))?;
    pool.install(|| bake_here(scene, options, observer))
}

fn bake_here<'s>(scene: &'s Scene, options: &BakeOptions, observer: &mut dyn Observer) -> Result<Bake<'s>, BakeError> {
    let mut clock = Clock::new();
    let mut seconds = Seconds::default();
    let lighting = Lighting::new(scene, options)?;

    observer.stage(Stage::Unwrap);
    let generates = options.uv == UvSource::Generate;
    let mut unwrapping =
        if generates { Some(Unwrapping::new(scene, options, &|| observer.cancelled())?) } else { None };
    seconds.atlas = clock.lap();

    observer.stage(Stage::Prepare);
    let mut world = World::new(scene);
    let parted = part_coincident(&mut world);
    let accel = Accel::build(&world.positions, |t| world.flags[t as usize].has(SurfaceFlags::UNSEEN));
    seconds.accel = clock.lap();
    let visibility = Visibility::new(&world, &accel);
    let settings = LightSettings { indirect_only: options.lights == Lights::Indirect, group: None };
    let emitters = Emitters::new(&world, &lighting, settings);
    let mut pilot = None;
    if let Some(unwrapping) = unwrapping.as_mut().filter(|_| options.adapts_density()) {
        observer.stage(Stage::Pilot);
        pilot = Some(adapt_density(unwrapping, &visibility, &emitters, options, clock.began, observer)?);
        seconds.pilot = clock.lap();
    }
    let density = pilot.map_or(options.density, |p| p.density);
    let atlas = match &unwrapping {
        Some(unwrapping) => unwrapping.place(&world, density, options, &|| observer.cancelled())?,
        None => atlas::build(scene, options, &|| observer.cancelled())?,
    };
    drop(unwrapping);
    atlas::check_memory(&world, &atlas, options)?;
    seconds.atlas += clock.lap();
    let go_on = |observer: &dyn Observer| if observer.cancelled() { Err(BakeError::Cancelled) } else { Ok(()) };
    let texels = Texels::new(&world, &atlas);
    seconds.texels = clock.lap();
    go_on(observer)?;
    let surface = Surface::new(texels, &atlas, &visibility, options);
    seconds.open = clock.lap();
    go_on(observer)?;

    observer.stage(Stage::Light);
    let path = surface.path(&emitters, &visibility);
    let weights = TexelWeights::of_values(&world, &surface.texels, &surface.open, options.texel_value);
    let apart = |group: &LightGroup| Emitters::new(&world, &lighting, LightSettings { group: Some(group), ..settings });
    let solution = solve_groups(path, &lighting.groups, &apart, weights, options, clock.began, observer)?;
    LightSeconds {
        direct: seconds.direct,
        photons: seconds.photons,
        gather: seconds.gather,
        estimate: seconds.estimate,
        audit: seconds.audit,
    } = solution.seconds;
    seconds.rounds.clone_from(&solution.rounds);
    clock.lap();

    observer.stage(Stage::Finish);
    let lightmap = Lightmap::new(&world, &atlas, &surface.texels, &surface.shown, &solution, options);
    let points = GridPoints::new(&path, &solution, options);
    let late = solution.limit == Some("time-limit");
    let samples = if late { 0 } else { (GRID_SHARE * solution.direct_samples as f64) as u64 };
    let on_screen = shown_error(&points, &lightmap.pages, &solution.error, samples);
    let Surface { texels, open, probe_rays, .. } = surface;
    let mut report = report(&world, &atlas, &texels, &open, &solution, &lighting, options);
    report.set_shown(&on_screen);
    add_illuminances(&world, &texels, &solution, &mut report.meshes);
    let skips =
        Skips { visibility: &visibility, lighting: &lighting, atlas: &atlas, texels: &texels, open: &open, pilot };
    report.skips.extend(skips.lines());
    let backs = LitBacks::new(&visibility, &emitters, &solution, options.seed);
    report.warnings.extend(backs.warnings(scene));
    report.warnings.extend(coincident_warning(&world, &parted));
    (report.work.emissive_triangles, report.work.lights) = emitters.counts();
    report.work.probe_rays = probe_rays;
    if emitters.is_empty() {
        report.warnings.push(Warning::new(
            "no-light",
            "nothing in the scene emits: the maps are black; add a light, an emissive material, --sky or --sun",
        ));
    } else if report.mean_irradiance <= 0.0 {
        report.warnings.push(Warning::new(
            "no-light-arrives",
            "no sample found any light: the maps are black; look whether walls shut the lights in or out",
        ));
    }
    seconds.finish = clock.lap();
    seconds.total = clock.began.elapsed().as_secs_f64();
    report.seconds = seconds;
    report.warnings.iter().for_each(|w| observer.warn(w));
    Ok(Bake { atlas, lightmap, report, lighting, world, accel, texels, solution, backs })
}

/// Direct samples, relative to those of the bake, that may tell what filtering shows.
const GRID_SHARE: f64 = 0.03;

fn report(
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

/// Images that turned out not to be decodable when they were looked at.
fn texture_warnings(scene: &Scene) -> impl Iterator<Item = Warning> + '_ {
    scene.textures.iter().filter_map(|t| {
        let why = t.known_decode_error()?;
        Some(Warning::new("image-not-decoded", format!("image {}: {why}; taken as white", t.name)))
    })
}

/// Seconds between laps.
struct Clock {
    began: Instant,
    lap: Instant,
}

impl Clock {
    fn new() -> Clock {
        Clock { began: Instant::now(), lap: Instant::now() }
    }

    fn lap(&mut self) -> f64 {
        let s = self.lap.elapsed().as_secs_f64();
        self.lap = Instant::now();
        s
    }
}
