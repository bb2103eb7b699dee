//! Bakes of real scenes against a path tracer of the tests' own (`common::scene_tracer`), texel by texel. The scenes lie
//! beside the repository (`../shared`, or the folder that EVENLIGHT_SHARED names); without them these tests say so and
//! pass.
//!
//! Each scene is baked to 5 % on a page of EVENLIGHT_ORACLE_TEXTURE (1024) texels squared, for at most
//! EVENLIGHT_ORACLE_SECONDS (60), and 200 texels drawn in proportion to their area are path-traced:
//! `cargo test --release --test oracle -- --ignored --nocapture`. EVENLIGHT_ORACLE_SEED (0) draws the bake anew: what is
//! far off under one seed only was noise.
//!
//! Two things are tested. The mean difference over the texels is that of Student's t at 4.9 standard errors, which
//! come from the scatter of the differences themselves. And at most 2 % of the texels may lie more than 4 of their own
//! standard errors away: real files have places that no rule covers, such as two walls at the same place.

mod common;

use common::random::Random;
use common::scene_tracer::SceneTracer;
use evenlight::atlas::TexelSampler;
use evenlight::options::{Normals, SkySource};
use evenlight::scene::Scene;
use evenlight::{Bake, BakeOptions, NoObserver, bake};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

/// Texels compared per scene.
const TEXELS: usize = 200;

/// Paths of a texel: those that tell how many it needs, and the bounds of that number.
const PILOT: usize = 256;
const PATHS: std::ops::RangeInclusive<usize> = 512..=6144;

/// Relative standard error that the paths of a texel aim at.
const AIM: f64 = 0.03;

/// Relative deviation that f32 arithmetic may leave in a texel without any noise.
const ROUNDING: f64 = 1e-4;

/// A surface less than this share of a texel's side above another covers it.
const COVER: f32 = 1.0 / 32.0;

/// Texels of the same chart over which the bake's own noise is averaged.
const NEIGHBOURS: usize = 64;

/// Only one scene at a time: the clocks of two would disturb each other.
static TURN: Mutex<()> = Mutex::new(());

/// One texel of both programs; irradiances are means of the channels [lux].
struct Compared {
    texel: usize,
    bake: f64,
    bake_variance: f64,
    path: f64,
    path_variance: f64,
}

impl Compared {
    fn difference(&self) -> f64 {
        self.bake - self.path
    }

    /// Difference in standard errors, where both programs round by [`ROUNDING`].
    fn z(&self) -> f64 {
        let rounding = (ROUNDING * self.bake.max(self.path)).powi(2).max(f64::MIN_POSITIVE);
        self.difference() / (self.bake_variance + self.path_variance + rounding).sqrt()
    }
}

fn grey(e: Vec3) -> f64 {
    f64::from(e.element_sum()) / 3.0
}

/// Texels that keep their own light, and stand for enough surface to be worth a look: stored, mostly inside their
/// chart, and not so small that they share the light of their surroundings.
fn eligible(bake: &Bake) -> Vec<usize> {
    let (texels, weight) = (&bake.texels.texels, &bake.solution.weights.weight);
    let charts = texels[..bake.texels.mapped].iter().map(|t| t.chart as usize + 1).max().unwrap_or(0);
    let mut largest = vec![0f32; charts];
    for t in &texels[..bake.texels.mapped] {
        largest[t.chart as usize] = largest[t.chart as usize].max(t.area);
    }
    let usual = (1.0 / (bake.atlas.texels_per_metre * bake.world.frame.metres)).powi(2);
    (0..bake.texels.mapped)
        .filter(|&i| {
            let least = f64::from(largest[texels[i].chart as usize] / 8.0).max(usual / 16.0);
            bake.solution.weights.stored[i] && texels[i].coverage > 0.5 && weight[i] > least
        })
        .collect()
}

/// `TEXELS` of `from`, drawn in proportion to their weights.
fn draw(bake: &Bake, from: &[usize], random: &mut Random) -> Vec<usize> {
    let mut sum = 0.0;
    let cumulative: Vec<f64> = from
        .iter()
        .map(|&i| {
            sum += bake.solution.weights.weight[i];
            sum
        })
        .collect();
    (0..TEXELS)
        .map(|_| {
            let pick = random.unit() * sum;
            from[cumulative.partition_point(|&c| c <= pick).min(from.len() - 1)]
        })
        .collect()
}

/// Variance of the stored mean of texel `all[position]` if its irradiance is `level`. Its own two halves say little:
/// the squares of half differences of its neighbours in the chart are averaged, scaled by E / area as noise of counting
/// is. `level` is not the texel's own estimate: one that found too little light would seem too sure of it. In a chart of
/// too few texels, or none that is lit, all light is taken as that of photons counted one by one.
fn own_variance(bake: &Bake, all: &[usize], position: usize, level: f64) -> f64 {
    let (texels, total, area) = (&bake.texels.texels, &bake.solution.total, &bake.solution.weights.weight);
    let chart = texels[all[position]].chart;
    let from = position.saturating_sub(NEIGHBOURS / 2);
    let (mut noise, mut light, mut count) = (0.0, 0.0, 0);
    for &i in all[from..].iter().take(NEIGHBOURS).filter(|&&i| texels[i].chart == chart) {
        noise += area[i] * grey(total.difference(i)).powi(2);
        light += grey(total.mean(i));
        count += 1;
    }
    let known = count >= NEIGHBOURS / 4 && noise > 0.0;
    let per_level = if known { noise / light } else { photon_flux(bake) };
    // What smoothing adds is known per mesh only.
    (per_level * level / area[all[position]]).max(stated_square(bake, all[position]))
}

/// Square of the error that the bake states for the mesh of a texel.
fn stated_square(bake: &Bake, texel: usize) -> f64 {
    let instance = bake.solution.weights.instance[texel] as usize;
    let floor = 0.01 * bake.solution.error.mean;
    let of = |m: &&evenlight::accuracy::MeshError| m.instance == instance;
    let rms = |m: &evenlight::accuracy::MeshError| m.error_percent / 100.0 * m.mean.max(floor);
    bake.solution.meshes.iter().find(of).map_or(0.0, |m| rms(m).powi(2))
}

/// What one photon adds to the stored mean of a texel, times the texel's area [lux x frame units squared].
fn photon_flux(bake: &Bake) -> f64 {
    let ledger = &bake.solution.ledger;
    let emitted = ledger.emitted.iter().sum::<i128>() as f64 / 3.0 * bake.solution.unit;
    emitted / (ledger.photons.max(1) as f64).powi(2)
}

/// Irradiance of a texel and the square of its standard error, by `paths` paths from points that are not buried;
/// `None` where no such point is found.
fn trace(bake: &Bake, tracer: &SceneTracer, texel: usize, paths: usize, random: &mut Random) -> Option<(f64, f64)> {
    let mut sampler = TexelSampler::default();
    sampler.load(&bake.texels, texel);
    let t = &bake.texels.texels[texel];
    let (back, cover) = (t.back, COVER * t.area.sqrt());
    let (mut sum, mut square) = (0.0, 0.0);
    for _ in 0..paths {
        let open = (0..200).find_map(|_| {
            let (triangle, uv) = sampler.sample(Vec2::new(random.unit() as f32, random.unit() as f32));
            let at = tracer.point(triangle, uv, back);
            (!tracer.buried(&at, cover, random)).then_some(at)
        });
        let e = tracer.irradiance(open?, random).element_sum() / 3.0;
        sum += e;
        square += e * e;
    }
    let n = paths as f64;
    let mean = sum / n;
    Some((mean, (square / n - mean * mean).max(0.0) / (n - 1.0)))
}

fn compare(bake: &Bake, tracer: &SceneTracer, all: &[usize], texel: usize, seed: u64) -> Option<Compared> {
    let mut random = Random::new(seed);
    let (mean, variance) = trace(bake, tracer, texel, PILOT, &mut random)?;
    let wish = if mean > 0.0 { PILOT as f64 * variance / (AIM * mean).powi(2) } else { f64::INFINITY };
    let paths = (wish.ceil() as usize).clamp(*PATHS.start(), *PATHS.end());
    // The pilot itself is not counted: a number of paths chosen by their own values biases their mean.
    let (path, path_variance) = trace(bake, tracer, texel, paths, &mut random)?;
    let level = path + path_variance.sqrt();
    let bake_variance = own_variance(bake, all, all.partition_point(|&i| i < texel), level);
    Some(Compared { texel, bake: grey(bake.solution.total.mean(texel)), bake_variance, path, path_variance })
}

/// Mean of `d`, its standard error, and the mean without the least and largest 2.5 %.
fn mean_of(d: &[f64]) -> (f64, f64, f64) {
    let n = d.len() as f64;
    let mean = d.iter().sum::<f64>() / n;
    let variance = d.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0);
    let mut sorted = d.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let cut = d.len() / 40;
    let kept = &sorted[cut..d.len() - cut];
    (mean, (variance / n).sqrt(), kept.iter().sum::<f64>() / kept.len() as f64)
}

/// Bakes a scene and compares it; `sky` is the radiance of a constant sky [nit].
fn agrees(name: &str, sky: f32) {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let beside = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared");
    let folder = std::env::var_os("EVENLIGHT_SHARED").map_or_else(|| PathBuf::from(beside), PathBuf::from);
    let file = folder.join(format!("scenes/{name}.glb"));
    if !file.is_file() {
        println!("skipped: no {}", file.display());
        return;
    }
    let setting = |name: &str| std::env::var(name).ok().map(|s| s.parse::<u32>().expect("a whole number"));
    let options = BakeOptions {
        target_percent: 5.0,
        max_texture: setting("EVENLIGHT_ORACLE_TEXTURE").unwrap_or(1024),
        time_limit: Some(setting("EVENLIGHT_ORACLE_SECONDS").unwrap_or(60).into()),
        normals: Normals::Geometric,
        sky: (sky > 0.0).then_some(SkySource::Constant(Vec3::splat(sky))),
        seed: setting("EVENLIGHT_ORACLE_SEED").unwrap_or(0).into(),
        ..BakeOptions::default()
    };
    let scene = Scene::from_gltf(&file).expect("the scene loads");
    let bake = bake(&scene, &options, &mut NoObserver).expect("the bake succeeds");

    let all = eligible(&bake);
    let picked = draw(&bake, &all, &mut Random::new(17));
    let tracer = SceneTracer::new(&bake);
    let compared: Vec<Compared> = picked
        .par_iter()
        .enumerate()
        .filter_map(|(k, &texel)| compare(&bake, &tracer, &all, texel, (k as u64) << 32))
        .collect();
    let n = compared.len() as f64;
    let level = compared.iter().map(|c| c.path).sum::<f64>() / n;
    let (mean, error, trimmed) = mean_of(&compared.iter().map(Compared::difference).collect::<Vec<_>>());
    let rms = (compared.iter().map(|c| c.z().powi(2)).sum::<f64>() / n).sqrt();
    let mut far: Vec<&Compared> = compared.iter().filter(|c| c.z().abs() > 4.0).collect();
    far.sort_by(|a, b| b.z().abs().total_cmp(&a.z().abs()));
    println!(
        "| {name} | {n} texels | {:.1} s | texel error {:.2} % | ratio {:.4} +- {:.4} | trimmed {:.4} | RMS z {rms:.2} | \
         {} beyond 4 |",
        bake.report.seconds.total,
        bake.report.texel_error_percent,
        1.0 + mean / level,
        error / level,
        1.0 + trimmed / level,
        far.len(),
    );
    let mut shown = compared.iter().collect::<Vec<_>>();
    shown.sort_by(|a, b| b.z().abs().total_cmp(&a.z().abs()));
    shown.iter().take(far.len().clamp(1, 12)).for_each(|c| println!("    {}", describe(&bake, c)));

    assert!(compared.len() * 10 >= TEXELS * 9, "{name}: only {n} of {TEXELS} texels have open points");
    assert!(mean.abs() <= 4.9 * error, "{name}: the means differ by {:.1} standard errors", mean / error);
    assert!(far.len() * 50 <= compared.len(), "{name}: {} texels of {n} are far off", far.len());
}

/// Where a texel lies and what both programs say.
fn describe(bake: &Bake, c: &Compared) -> String {
    let mut sampler = TexelSampler::default();
    sampler.load(&bake.texels, c.texel);
    let (triangle, uv) = sampler.sample(Vec2::splat(0.5));
    let at = bake.world.frame.to_world(bake.world.position(triangle, uv));
    let coincident = SceneTracer::new(bake).coincident(triangle, uv);
    let node = &bake.world.scene.instances[bake.solution.weights.instance[c.texel] as usize].name;
    format!(
        "node {node}, triangle {triangle}{} at {at:.3} facing {:.2}: E {:.5} +- {:.5}, path {:.5} +- {:.5}, z {:+.1}{}",
        if bake.texels.texels[c.texel].back { " (back)" } else { "" },
        bake.world.normals[triangle as usize],
        c.bake,
        c.bake_variance.sqrt(),
        c.path,
        c.path_variance.sqrt(),
        c.z(),
        if coincident.is_empty() { String::new() } else { format!(", at the place of triangles {coincident:?}") },
    )
}

macro_rules! scenes {
    ($($test:ident: $name:literal, $sky:literal;)*) => {
        $(
            #[test]
            #[ignore = "takes minutes"]
            fn $test() {
                agrees($name, $sky);
            }
        )*
    };
}

scenes! {
    cornell_box: "cornell-box", 0.0;
    modern_hall: "modern-hall", 0.0;
    veach_ajar: "veach-ajar", 0.0;
    living_room: "living-room-2", 0.0;
    classroom: "classroom", 20.0;
    country_kitchen: "country-kitchen", 0.0;
    lux_kitchen: "lux-kitchen", 0.0;
    godot_room: "godot-room", 5.0;
    bevy_mixed_lighting: "bevy-MixedLightingExample", 0.0;
    map_complex: "map-complex", 0.0;
}
