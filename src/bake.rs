//! The pipeline on one page.

use crate::accel::{Accel, coincident_warning, part_coincident};
use crate::accuracy::{TexelWeights, add_illuminances};
use crate::atlas::{self, Atlas, Texels, Unwrapping};
use crate::backs::LitBacks;
use crate::cache::{Cache, Digest, Keeping};
use crate::error::{BakeError, SceneError};
use crate::light::{Emitters, LightGroup, LightSettings, Lighting, MOST_IRRADIANCE, Visibility};
use crate::lightmap::{GridPoints, Lightmap, shown_error};
use crate::observer::{Observer, Stage};
use crate::options::{BakeOptions, Lights, UvSource};
use crate::pilot::{Pilot, adapt_density};
use crate::report::{Report, Seconds};
use crate::scene::{Scene, SurfaceFlags, World};
use crate::skips::Skips;
use crate::solve::{
    LightSeconds, Parts, PlanOutlook, Shard, ShardWork, Shards, Solution, Surface, merge_groups, plan_groups,
    shard_groups, solve_groups,
};
use glam::Vec3;
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
    bake_with_cache(scene, options, None, observer)
}

/// [`bake`] with a `cache`: takes from it what is there, goes on from the light that it has, and keeps there what is done.
///
/// # Errors
/// As [`bake`].
pub fn bake_with_cache<'s>(
    scene: &'s Scene,
    options: &BakeOptions,
    cache: Option<&mut dyn Cache>,
    observer: &mut dyn Observer,
) -> Result<Bake<'s>, BakeError> {
    in_pool(options, || {
        let (mut prepared, mut keeping) = Prepared::new(scene, options, cache, observer)?;
        let solution = prepared.with_parts(options, |parts| solve_groups(parts, keeping.as_mut(), observer))?;
        prepared.finish(options, solution, observer)
    })
}

/// Makes a plan of the bake of `scene` in `plan`: charts, texels, and for each group of lights what more its light takes.
/// At most about `shards` may then do a part of that each.
///
/// # Errors
/// As [`bake`].
pub fn plan(
    scene: &Scene,
    options: &BakeOptions,
    shards: u32,
    plan: &mut dyn Cache,
    observer: &mut dyn Observer,
) -> Result<Vec<PlanOutlook>, BakeError> {
    in_pool(options, || {
        let (mut prepared, mut keeping) = Prepared::new(scene, options, Some(plan), observer)?;
        prepared.with_parts(options, |parts| plan_groups(parts, shards, keeping.as_mut(), observer))
    })
}

/// Does what is `shard`'s of a plan that [`plan()`] made of the same scene and options.
///
/// # Errors
/// As [`bake`]; [`BakeError::Plan`] where the plan is of something else.
pub fn bake_shard(
    scene: &Scene,
    options: &BakeOptions,
    shard: Shard,
    plan: &mut dyn Cache,
    observer: &mut dyn Observer,
) -> Result<Vec<ShardWork>, BakeError> {
    in_pool(options, || {
        let (mut prepared, mut keeping) = Prepared::new(scene, options, Some(plan), observer)?;
        prepared.with_parts(options, |parts| shard_groups(parts, shard, keeping.as_mut(), observer))
    })
}

/// Bakes by a plan, all of it here: the same bytes as [`merge`] of any shards.
///
/// # Errors
/// As [`bake_shard`].
pub fn bake_by_plan<'s>(
    scene: &'s Scene,
    options: &BakeOptions,
    plan: &mut dyn Cache,
    observer: &mut dyn Observer,
) -> Result<Bake<'s>, BakeError> {
    in_pool(options, || {
        let (mut prepared, mut keeping) = Prepared::new(scene, options, Some(plan), observer)?;
        let solution = prepared.with_parts(options, |parts| {
            let work = shard_groups(parts.clone(), Shard::WHOLE, keeping.as_mut(), observer)?;
            merge_groups(parts, &work, keeping.as_mut(), observer)
        })?;
        prepared.finish(options, solution, observer)
    })
}

/// Bakes by a plan from what its `shards` did: the same bytes, however many these are. Some may be missing.
///
/// # Errors
/// As [`bake_shard`], and where a shard cannot be read.
pub fn merge<'s>(
    scene: &'s Scene,
    options: &BakeOptions,
    shards: &(dyn Shards + Sync),
    plan: &mut dyn Cache,
    observer: &mut dyn Observer,
) -> Result<Bake<'s>, BakeError> {
    in_pool(options, || {
        let (mut prepared, mut keeping) = Prepared::new(scene, options, Some(plan), observer)?;
        let solution = prepared.with_parts(options, |parts| merge_groups(parts, shards, keeping.as_mut(), observer))?;
        prepared.finish(options, solution, observer)
    })
}

fn in_pool<T: Send>(options: &BakeOptions, work: impl FnOnce() -> Result<T, BakeError> + Send) -> Result<T, BakeError> {
    options.validate()?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(options.threads)
        .build()
        .map_err(|e| BakeError::Options(format!("cannot start {} threads: {e}", options.threads)))?;
    pool.install(work)
}

/// A scene with its texels in their places, and all that light needs.
struct Prepared<'s> {
    scene: &'s Scene,
    lighting: Lighting,
    world: World<'s>,
    /// Triangles that coincided with others.
    parted: Vec<u32>,
    accel: Accel,
    emitters: Emitters,
    pilot: Option<Pilot>,
    atlas: Atlas,
    charts_from_cache: bool,
    surface: Surface,
    clock: Clock,
    seconds: Seconds,
}

impl<'s> Prepared<'s> {
    /// Everything up to the light, and where that may be kept.
    fn new<'c>(
        scene: &'s Scene,
        options: &BakeOptions,
        cache: Option<&'c mut dyn Cache>,
        observer: &mut dyn Observer,
    ) -> Result<(Prepared<'s>, Option<Keeping<'c>>), BakeError> {
        let mut clock = Clock::new();
        let mut seconds = Seconds::default();
        let lighting = Lighting::new(scene, options)?;
        let mut keeping = cache.map(|cache| Keeping { cache, digest: inputs(scene, &lighting, options) });

        observer.stage(Stage::Unwrap);
        let generates = options.uv == UvSource::Generate;
        let mut unwrapping = if generates {
            let cache = keeping.as_mut().map(|k| &mut *k.cache as &mut dyn Cache);
            Some(Unwrapping::new(scene, options, cache, &|| observer.cancelled())?)
        } else {
            None
        };
        seconds.atlas = clock.lap();

        observer.stage(Stage::Prepare);
        let mut world = World::new(scene);
        let parted = part_coincident(&mut world);
        let accel = Accel::build(&world.positions, |t| world.flags[t as usize].has(SurfaceFlags::UNSEEN));
        seconds.accel = clock.lap();
        let visibility = Visibility::new(&world, &accel);
        let emitters = Emitters::new(&world, &lighting, light_settings(options, None));
        let mut pilot = None;
        if let Some(unwrapping) = unwrapping.as_mut().filter(|_| options.adapts_density()) {
            observer.stage(Stage::Pilot);
            pilot = Some(adapt_density(
                unwrapping,
                &visibility,
                &emitters,
                options,
                clock.began,
                keeping.as_mut(),
                observer,
            )?);
            seconds.pilot = clock.lap();
        }
        let density = pilot.map_or(options.density, |p| p.density);
        let atlas = match &unwrapping {
            Some(unwrapping) => unwrapping.place(&world, density, options, &|| observer.cancelled())?,
            None => atlas::build(scene, options, &|| observer.cancelled())?,
        };
        let charts_from_cache = unwrapping.is_some_and(|u| u.from_cache);
        keeping.iter_mut().for_each(|keeping| atlas.feed(&mut keeping.digest));
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
        let prepared = Prepared {
            scene,
            lighting,
            world,
            parted,
            accel,
            emitters,
            pilot,
            atlas,
            charts_from_cache,
            surface,
            clock,
            seconds,
        };
        Ok((prepared, keeping))
    }

    /// Does `work` on the light in its parts.
    fn with_parts<T>(
        &mut self,
        options: &BakeOptions,
        work: impl FnOnce(Parts) -> Result<T, BakeError>,
    ) -> Result<T, BakeError> {
        let Prepared { lighting, world, accel, emitters, surface, clock, .. } = self;
        let visibility = Visibility::new(world, accel);
        let apart = |group: &LightGroup| Emitters::new(world, lighting, light_settings(options, Some(group)));
        let done = work(Parts {
            path: surface.path(emitters, &visibility),
            groups: &lighting.groups,
            emitters: &apart,
            weights: TexelWeights::of_values(world, &surface.texels, &surface.open, options.texel_value),
            options,
            began: clock.began,
        });
        clock.lap();
        done
    }

    /// Maps and report of the light that was found.
    fn finish(
        self,
        options: &BakeOptions,
        solution: Solution,
        observer: &mut dyn Observer,
    ) -> Result<Bake<'s>, BakeError> {
        check_irradiance(self.scene, &solution)?;
        let Prepared { scene, lighting, world, parted, accel, emitters, pilot, atlas, charts_from_cache, .. } = self;
        let Prepared { surface, mut clock, mut seconds, .. } = self;
        let visibility = Visibility::new(&world, &accel);
        let path = surface.path(&emitters, &visibility);
        LightSeconds {
            direct: seconds.direct,
            photons: seconds.photons,
            gather: seconds.gather,
            estimate: seconds.estimate,
            audit: seconds.audit,
        } = solution.seconds;
        seconds.rounds.clone_from(&solution.rounds);

        observer.stage(Stage::Finish);
        let lightmap = Lightmap::new(&world, &atlas, &surface.texels, &surface.shown, &solution, options);
        let points = GridPoints::new(&path, &solution, options);
        let late = solution.limit == Some("time-limit");
        let samples = if late { 0 } else { (GRID_SHARE * solution.direct_samples as f64) as u64 };
        let on_screen = shown_error(&points, &lightmap.pages, &solution.error, samples);
        let Surface { texels, open, probe_rays, .. } = surface;
        let mut report = Report::new(&world, &atlas, &texels, &open, &solution, &lighting, options);
        report.set_shown(&on_screen);
        let light = [&solution.total, &solution.unsmoothed];
        add_illuminances(&world, &texels, light, &solution.weights, &mut report.meshes);
        let skips = Skips {
            visibility: &visibility,
            lighting: &lighting,
            atlas: &atlas,
            texels: &texels,
            open: &open,
            pilot,
            charts_from_cache,
            kept_rays: solution.kept_rays,
        };
        report.skips.extend(skips.lines());
        let backs = LitBacks::new(&visibility, &emitters, &solution, options.seed);
        report.warnings.extend(backs.warnings(scene));
        report.warnings.extend(coincident_warning(&world, &parted));
        report.set_emitters(&emitters);
        report.work.probe_rays = probe_rays;
        seconds.finish = clock.lap();
        seconds.total = clock.began.elapsed().as_secs_f64();
        report.seconds = seconds;
        report.warnings.iter().for_each(|w| observer.warn(w));
        Ok(Bake { atlas, lightmap, report, lighting, world, accel, texels, solution, backs })
    }
}

/// What shines: all lights, or those of a group.
fn light_settings<'g>(options: &BakeOptions, group: Option<&'g LightGroup>) -> LightSettings<'g> {
    LightSettings { indirect_only: options.lights == Lights::Indirect, group }
}

/// Refuses texels that no error can be stated of, such as those beside a lamp of a quintillion candela.
fn check_irradiance(scene: &Scene, solution: &Solution) -> Result<(), BakeError> {
    const MOST: Vec3 = Vec3::splat(MOST_IRRADIANCE);
    let halves = solution.total.odd.iter().zip(&solution.total.even);
    // What is no number is not below it either.
    let too_bright = |(odd, even): (&Vec3, &Vec3)| !(odd.cmple(MOST).all() && even.cmple(MOST).all());
    let Some((_, &instance)) = halves.zip(&solution.weights.instance).find(|((odd, even), _)| too_bright((odd, even)))
    else {
        return Ok(());
    };
    let node = &scene.instances[instance as usize].name;
    let what = format!(
        "node '{node}' receives more than {MOST_IRRADIANCE:e} lux; dim the lights in the file or by --light NAME=SCALE, or \
         move them away"
    );
    Err(SceneError::Invalid { path: scene.source.path.clone(), what }.into())
}

/// All that the light of a bake depends on, but for where its texels are.
fn inputs(scene: &Scene, lighting: &Lighting, options: &BakeOptions) -> Digest {
    let mut digest = Digest::default();
    scene.feed(&mut digest);
    lighting.feed(&mut digest);
    options.feed(&mut digest);
    digest
}

/// Direct samples, relative to those of the bake, that may tell what filtering shows.
const GRID_SHARE: f64 = 0.03;

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
