//! `evenlight bake`: a scene in, a folder of results out.

use super::args::{BakeArgs, FileArgs};
use super::config::Config;
use super::terminal::Terminal;
use evenlight::backs::LIT_FROM_BEHIND;
use evenlight::output::cache_folder::CacheFolder;
use evenlight::output::glb::{self, GlbOptions};
use evenlight::output::lightmap_exr::{self, ExrSettings};
use evenlight::output::manifest::{Manifest, ManifestInputs};
use evenlight::output::plan_folder::PlanInputs;
use evenlight::output::words::{audit, group, seconds};
use evenlight::output::{Staging, preview, report_html, write_atomically};
use evenlight::report::Report;
use evenlight::scene::gltf::LoadOptions;
use evenlight::scene::{Camera, Projection, Scene};
use evenlight::{Bake, BakeError, Cache, Observer, bake_with_cache};
use std::path::{Path, PathBuf};

/// Pixels of the longer side of a view.
const VIEW_SIZE: u32 = 960;

/// Views are made of at most this many cameras of a file.
const MOST_VIEWS: usize = 4;

/// Bakes and writes; the exit status.
pub fn run(args: &BakeArgs, config: Config) -> Result<u8, BakeError> {
    let cached = args.cache().map_err(|error| config.locate(error))?;
    let inputs = inputs(args, config)?;
    let scene = load(&inputs)?;
    // Made before the work, so that a folder which cannot be written is known now. Nothing appears in it
    // until all files are complete.
    let staging = Staging::new(&args.out)?;

    let mut terminal = Terminal::new();
    let mut cache = cached.as_ref().map(|(folder, most)| CacheFolder::open(folder, *most)).transpose()?;
    let lent = cache.as_mut().map(|cache| cache as &mut dyn Cache);
    let result = bake_with_cache(&scene, &inputs.options, lent, &mut terminal);
    terminal.finish();
    if let Some(cache) = &mut cache {
        cache.trim();
        cache.warnings.iter().for_each(|w| terminal.warn(w));
    }
    if let (Err(BakeError::Cancelled), Some(CacheFolder { keeps_light: true, .. })) = (&result, &cache) {
        eprintln!("the light so far is kept; the same command goes on from it");
    }
    let mut bake = result?;
    bake.report.warnings.extend(cache.into_iter().flat_map(|cache| cache.warnings));
    write(staging, &args.out, &scene, bake, &inputs, args.files)
}

/// What is to be baked, and how.
pub fn inputs(args: &BakeArgs, config: Config) -> Result<PlanInputs, BakeError> {
    let located = |error| config.locate(error);
    let (options, layers) = (args.options().map_err(located)?, args.layers().map_err(located)?);
    let more = args.changes().map_err(located)?;
    let mut changes = config.changes;
    changes.lights.extend(more.lights);
    Ok(PlanInputs {
        scene: args.scene.first().cloned().unwrap_or_default(),
        variant: args.variant.clone(),
        changes,
        options,
        float: args.float,
        layers,
        remove_baked_lights: args.removes_baked_lights(),
    })
}

/// The scene with its changes.
pub fn load(inputs: &PlanInputs) -> Result<Scene, BakeError> {
    let mut scene = Scene::from_gltf_with(&inputs.scene, &LoadOptions { variant: inputs.variant.clone() })?;
    scene.change(&inputs.changes)?;
    Ok(scene)
}

/// Writes all files of a bake to the folder `out`; the exit status.
pub fn write(
    mut staging: Staging,
    out: &Path,
    scene: &Scene,
    mut bake: Bake,
    inputs: &PlanInputs,
    files: FileArgs,
) -> Result<u8, BakeError> {
    bake.report.peak_memory_bytes = peak_memory();
    let exr = ExrSettings {
        quantity: inputs.options.quantity,
        float: inputs.float,
        layers: inputs.layers.clone(),
        scene: scene.name.clone(),
        seed: inputs.options.seed,
        texel_error_percent: Some(bake.report.texel_error_percent),
    };
    write_maps(&mut staging, &bake, &exr)?;
    write_scene(&mut staging, scene, &mut bake, inputs)?;
    if !files.no_preview {
        write_previews(&mut staging, scene, &mut bake)?;
    }
    if !files.no_html {
        report_html::write(&staging.file("report.html")?, &bake)?;
    }
    let report = to_json(&staging.file(REPORT)?, &bake.report)?;
    // What an earlier bake left beside would contradict this one: a second page, views from other cameras.
    let earlier = is_report(&out.join(REPORT));
    staging.publish(|name| earlier && is_output(name))?;
    if files.json {
        super::print(&report)?;
    }
    bake.report.changed.iter().for_each(|what| eprintln!("changed: {what}"));
    eprintln!("{}", summary(&bake.report, out));
    Ok(if bake.report.target_met { 0 } else { super::TARGET_MISSED })
}

/// Written last.
const REPORT: &str = "report.json";

/// Whether a file is a report of this program.
fn is_report(path: &Path) -> bool {
    let text = std::fs::read(path).unwrap_or_default();
    serde_json::from_slice::<serde_json::Value>(&text).is_ok_and(|v| v.get("evenlight").is_some())
}

/// Whether a bake may write a file of this name.
fn is_output(name: &str) -> bool {
    let numbered = |start: &str, end: &str| {
        let number = name.strip_prefix(start).and_then(|n| n.strip_suffix(end));
        number.is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()))
    };
    let pages = numbered("lightmap-", ".exr") || numbered("lightmap-", ".png");
    pages || numbered("view-", ".png") || numbered("backs-", ".png") || name == "report.html"
}

fn page_file(page: usize) -> String {
    format!("lightmap-{page}.exr")
}

fn write_maps(staging: &mut Staging, bake: &Bake, settings: &ExrSettings) -> Result<(), BakeError> {
    for (i, page) in bake.lightmap.pages.iter().enumerate() {
        let info = lightmap_exr::write(&staging.file(page_file(i))?, page, settings)?;
        if info.float_for_range {
            eprintln!("note: {} is 32-bit float, since its values go up to {}", page_file(i), info.largest);
        }
        if info.non_finite > 0 {
            eprintln!("warning: {} values of {} were not finite and are 0", info.non_finite, page_file(i));
        }
    }
    Ok(())
}

fn write_scene(
    staging: &mut Staging,
    scene: &Scene,
    bake: &mut Bake,
    PlanInputs { options, variant, remove_baked_lights, .. }: &PlanInputs,
) -> Result<(), BakeError> {
    let lights = if *remove_baked_lights { glb::fully_baked_lights(scene, options.lights) } else { Vec::new() };
    let remove_baked_sky = *remove_baked_lights && bake.lighting.sky_of_scene;
    let glb = GlbOptions { remove_baked_lights: lights, remove_baked_sky };
    let info = glb::write(&staging.file("scene.glb")?, &scene.source, scene, &bake.atlas, &glb)?;
    bake.report.warnings.extend(info.warnings);

    let mut error_percent = vec![None; scene.instances.len()];
    bake.report.meshes.iter().for_each(|m| error_percent[m.instance] = Some(m.error_percent));
    let inputs = ManifestInputs {
        scene_file: Some("scene.glb".into()),
        page_files: (0..bake.atlas.pages.len()).map(page_file).collect(),
        variant: variant.clone(),
        error_percent,
    };
    Manifest::new(scene, &bake.atlas, &bake.lightmap, options.quantity, &bake.lighting, options.lights, &inputs)
        .write(&staging.file("lightmap.json")?)
}

fn write_previews(staging: &mut Staging, scene: &Scene, bake: &mut Bake) -> Result<(), BakeError> {
    for (i, page) in bake.lightmap.pages.iter().enumerate() {
        preview::page_image(page).write_png(&staging.file(format!("lightmap-{i}.png"))?)?;
    }
    let closest = |ray: &evenlight::accel::Ray| bake.accel.closest(ray);
    let chosen;
    let cameras: &[Camera] = if scene.cameras.is_empty() {
        chosen = [preview::choose_camera(&bake.world, &closest)];
        &chosen
    } else {
        &scene.cameras[..scene.cameras.len().min(MOST_VIEWS)]
    };
    for (i, camera) in cameras.iter().enumerate() {
        let settings = preview::RenderSettings { height: view_height(camera), ..Default::default() };
        let sky = bake.lighting.sky.as_ref();
        preview::render(&bake.world, &closest, &bake.atlas, &bake.lightmap, camera, sky, &settings)
            .write_png(&staging.file(format!("view-{i}.png"))?)?;
    }
    let mut warned: Vec<_> = bake.report.warnings.iter_mut().filter(|w| w.code == LIT_FROM_BEHIND).collect();
    for (i, warning) in warned.iter_mut().enumerate().take(MOST_VIEWS) {
        let name = format!("backs-{i}.png");
        preview::render_backs(&bake.world, &closest, &bake.backs, i, [VIEW_SIZE, VIEW_SIZE * 9 / 16])
            .write_png(&staging.file(name.as_str())?)?;
        let node = &scene.instances[bake.backs.nodes[i].instance].name;
        eprintln!("note: {name} shows where node {node} is lit from behind");
        warning.message += &format!("; {name} shows where");
    }
    Ok(())
}

fn view_height(camera: &Camera) -> u32 {
    let aspect = match camera.projection {
        Projection::Perspective { aspect, .. } => aspect.unwrap_or(16.0 / 9.0),
        Projection::Orthographic { half_width, half_height } => half_width / half_height,
    };
    ((VIEW_SIZE as f32 / aspect.clamp(0.25, 4.0)).round() as u32).max(1)
}

fn to_json(path: &Path, report: &Report) -> Result<String, BakeError> {
    let io = |source| BakeError::Io { path: PathBuf::from(path), source };
    let mut text = serde_json::to_string_pretty(report).map_err(|e| io(std::io::Error::other(e)))?;
    text.push('\n');
    write_atomically(path, text.as_bytes())?;
    Ok(text)
}

/// What happened, in a few lines.
fn summary(r: &Report, folder: &Path) -> String {
    let verdict = match r.limit {
        None => format!("target {} % met", r.target_percent),
        Some("texels") => format!(
            "target {} % of what filtering shows NOT met: {:.2} %, with the texels that fit",
            r.target_shown_percent.unwrap_or_default(),
            r.shown_error_percent
        ),
        Some(limit) => format!("target {} % NOT met: ended by {limit}", r.target_percent),
    };
    let audit = r.audit.as_ref().map_or(String::new(), |a| format!("{}\n", audit(a)));
    let groups: String = r.groups.iter().map(|g| format!("group {}: {}\n", g.name, group(g))).collect();
    let asked = r.target_shown_percent.map_or(String::new(), |target| format!(" (target {target} %)"));
    format!(
        "{verdict}: texel error {:.2} % ({:.2} to {:.2}), 95 % of the meshes under {:.1} % (target {:.1} %)\n{groups}{audit}\
         with what filtering adds between texels: {:.2} %{asked}\n\
         {} texels, {} triangles, {:.1} M rays in {}; mean irradiance {:.4} lux\n\
         written to {}",
        r.texel_error_percent,
        r.texel_error_interval[0],
        r.texel_error_interval[1],
        r.mesh_error_percent_95,
        r.target_mesh_percent,
        r.shown_error_percent,
        r.atlas.texels,
        r.atlas.triangles,
        r.work.rays() as f64 / 1e6,
        seconds(r.seconds.total),
        r.mean_irradiance,
        folder.display(),
    )
}

/// Largest resident memory of this process [bytes], where the system tells.
fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib << 10)
}
