//! Bakes against references that other renderers made, where they lie beside the repository (`../shared`, or the
//! folder that EVENLIGHT_SHARED names); without them these tests say so and pass.
//!
//! A reference holds R, G, B (irradiance), noise.R, noise.G, noise.B (half the difference of its two halves), and a
//! file of texels the area and coverage. Figures are relative to the area-weighted mean of the reference over all
//! channels, over the texels with area. `distance` is the RMS with the reference's own noise taken out; an honest
//! bake has its own sigma there, and no more than the reference's bias besides.

mod common;

use common::exr_reader::Picture;
use common::formulas::point_irradiance;
use common::rooms::plain;
use evenlight::scene::{LightKind, Scene, Sky};
use evenlight::{BakeOptions, NoObserver, bake};
use glam::{DMat2, DVec2, DVec3};
use std::path::{Path, PathBuf};

/// The folder of references; `None`, and a line that says so, where there is none.
fn shared() -> Option<PathBuf> {
    let beside = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared");
    let folder = std::env::var_os("EVENLIGHT_SHARED").map_or_else(|| PathBuf::from(beside), PathBuf::from);
    let found = folder.join("ref/scenes").is_dir();
    if !found {
        println!("skipped: no references in {}", folder.display());
    }
    found.then_some(folder)
}

/// Bake minus reference, all in percent of the reference's mean.
struct Comparison {
    /// RMS without the reference's noise.
    distance: f64,
    bias: f64,
    reference_noise: f64,
    /// The bake's own sigma, from its half differences over the same texels.
    sigma: f64,
    /// The ends of the 95 % interval of that, as reported.
    interval: [f64; 2],
}

/// Bakes a scene of the folder and compares it with `reference`, or another picture where its name differs.
fn compare(name: &str, options: &BakeOptions, reference: impl Fn(&Path) -> Option<Picture>) -> Option<Comparison> {
    let folder = shared()?;
    let scene = Scene::from_gltf(folder.join(format!("ref/scenes/{name}.glb"))).expect("the scene loads");
    let texels = Picture::read(&folder.join(format!("ref/scenes/{name}_texels.exr")));
    let reference = reference(&folder)?;
    let baked = bake(&scene, options, &mut NoObserver).expect("the bake succeeds");
    let page = &baked.lightmap.pages[0];
    assert_eq!((page.width as usize, page.height as usize), (reference.width, reference.height));

    let (mut weight, mut mean, mut square, mut noise2, mut difference, mut own) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for (c, channel) in ["R", "G", "B"].into_iter().enumerate() {
        let r = reference.channel(channel);
        let noise = reference.channels.get(&format!("noise.{channel}"));
        for (i, area) in texels.channel("area").iter().map(|&a| f64::from(a)).enumerate() {
            // A texel whose cover rounds to nothing in one of both programs says nothing.
            if area <= 0.0 || page.coverage[i] == 0.0 {
                continue;
            }
            let d = f64::from(page.irradiance[i][c]) - f64::from(r[i]);
            weight += area;
            mean += area * f64::from(r[i]);
            difference += area * d;
            square += area * d * d;
            noise2 += area * noise.map_or(0.0, |n| f64::from(n[i])).powi(2);
            own += area * f64::from(page.half_difference[i][c]).powi(2);
        }
    }
    let mean = mean / weight;
    let percent = |square: f64| 100.0 * (square / weight).max(0.0).sqrt() / mean;
    let found = Comparison {
        distance: percent(square - noise2),
        bias: 100.0 * difference / weight / mean,
        reference_noise: percent(noise2),
        sigma: percent(own),
        interval: baked.report.texel_error_interval,
    };
    println!(
        "{name}: distance {:.3} %, sigma {:.3} % (reported {:.3}), bias {:+.3} %, reference noise {:.3} %, {:.1} s, {:?}",
        found.distance,
        found.sigma,
        baked.report.sigma,
        found.bias,
        found.reference_noise,
        baked.report.seconds.total,
        baked.report.split,
    );
    Some(found)
}

/// A reference file of the folder.
fn rendered(name: &str) -> impl Fn(&Path) -> Option<Picture> {
    let file = format!("ref/{name}.exr");
    move |folder| Some(Picture::read(&folder.join(&file)))
}

/// The distance must be the bake's sigma, but for `own`, the percentage that the reference itself may be off by. Where
/// few texels have noise, as at the rim of a spot, both scatter: as far as the interval reaches, and a little more.
fn assert_agrees(name: &str, found: Option<Comparison>, own: f64) {
    let Some(Comparison { distance, bias, sigma, interval: [low, high], .. }) = found else { return };
    assert!(low <= sigma && sigma <= high, "{name}: sigma {sigma:.3} % is not within {low:.3} to {high:.3} %");
    assert!(distance <= 1.05 * high.hypot(own), "{name}: {distance:.3} % away with a sigma of {sigma:.3} %");
    assert!(distance >= 0.9 * low - own, "{name}: {distance:.3} % away is less than the sigma of {sigma:.3} %");
    assert!(bias.abs() < 0.5, "{name}: bias {bias:.3} %");
}

#[test]
fn cornell_box() {
    assert_agrees("cornell_256", compare("cornell_256", &plain(256, 4.0), rendered("cornell_256")), 0.6);
}

/// The reference is off on one thin column half a metre from a lamp: on texels that cover several of its facets it
/// has less light in all than the formula gives for the direct part alone. They make 1.6 % of RMS.
#[test]
fn many_point_lights() {
    assert_agrees("points_256", compare("points_256", &plain(256, 4.0), rendered("points_256")), 1.7);
}

#[test]
fn sphere() {
    assert_agrees("sphere_256", compare("sphere_256", &plain(256, 4.0), rendered("sphere_256")), 0.2);
}

/// An open plane of 64 texels squared under one light: against the formula, integrated over the texels.
#[test]
fn unit_planes() {
    for name in ["unit_sun_64", "unit_sky_64", "unit_point_64", "unit_spot_64"] {
        let found = compare(name, &plain(64, 0.5), |folder| formula(folder, name));
        assert_agrees(name, found, 0.15);
    }
}

/// The map of a plane lit by the lights and the sky of its scene: the mean of the formula over 64 x 64 points of each
/// texel that lie on the plane.
fn formula(folder: &Path, name: &str) -> Option<Picture> {
    let scene = Scene::from_gltf(folder.join(format!("ref/scenes/{name}.glb"))).expect("the scene loads");
    let primitive = &scene.meshes[0].primitives[0];
    let [a, b, c] = primitive.triangles[0].map(|v| v as usize);
    let position = |v: usize| scene.instances[0].world_from_object.transform_point3(primitive.positions[v].as_dvec3());
    let uv = |v: usize| primitive.tex_coords[1][v].as_dvec2();
    let weights_from_uv = DMat2::from_cols(uv(b) - uv(a), uv(c) - uv(a)).inverse();
    let corners: Vec<DVec2> = (0..primitive.positions.len()).map(uv).collect();
    let (lo, hi) = corners.iter().fold((corners[0], corners[0]), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
    let normal = (position(b) - position(a)).cross(position(c) - position(a)).normalize();

    let size = 64;
    let mut picture = Picture { width: size, height: size, channels: Default::default() };
    let mut values = vec![DVec3::ZERO; size * size];
    for (i, value) in values.iter_mut().enumerate() {
        let mut covered = 0.0;
        for k in 0..4096 {
            let inside = DVec2::new((k % 64) as f64 + 0.5, (k / 64) as f64 + 0.5) / 64.0;
            let at = (DVec2::new((i % size) as f64, (i / size) as f64) + inside) / size as f64;
            if at.cmpge(lo).all() && at.cmple(hi).all() {
                let w = weights_from_uv * (at - uv(a));
                let p = position(a) + (position(b) - position(a)) * w.x + (position(c) - position(a)) * w.y;
                *value += plane_irradiance(&scene, p, normal);
                covered += 1.0;
            }
        }
        *value /= f64::max(covered, 1.0);
    }
    for (c, channel) in ["R", "G", "B"].into_iter().enumerate() {
        picture.channels.insert(channel.into(), values.iter().map(|v| v[c] as f32).collect());
    }
    Some(picture)
}

/// Irradiance of an open plane at `p`.
fn plane_irradiance(scene: &Scene, p: DVec3, normal: DVec3) -> DVec3 {
    let mut e = match &scene.sky {
        Some(Sky::Constant(radiance)) => radiance.as_dvec3() * std::f64::consts::PI,
        _ => DVec3::ZERO,
    };
    for light in &scene.lights {
        let axis = light.direction.as_dvec3();
        let share = match light.kind {
            LightKind::Directional { .. } => normal.dot(-axis).max(0.0),
            LightKind::Point => point_irradiance(p, normal, light.position, 1.0),
            LightKind::Spot { inner, outer } => {
                let (inner, outer) = (f64::from(inner).cos(), f64::from(outer).cos());
                let cone = ((axis.dot((p - light.position).normalize()) - outer) / (inner - outer)).clamp(0.0, 1.0);
                point_irradiance(p, normal, light.position, 1.0) * cone * cone
            }
            LightKind::Area(_) => panic!("{} has an area, which no scene of this comparison has", light.name),
        };
        e += light.intensity.as_dvec3() * share;
    }
    e
}

/// A real room of 50,000 triangles. Some walls stand in it twice at the same place: a photon meets the one drawn first,
/// so that the other lacks the indirect light that the reference has there. They make 2.9 % of RMS.
#[test]
#[ignore = "takes minutes"]
fn modern_hall() {
    assert_agrees("modern-hall_512", compare("modern-hall_512", &plain(512, 4.0), rendered("modern-hall_512")), 3.2);
}

/// A real room lit through the gap of a door.
#[test]
#[ignore = "takes a minute"]
fn veach_ajar() {
    assert_agrees("veach-ajar_512", compare("veach-ajar_512", &plain(512, 4.0), rendered("veach-ajar_512")), 1.0);
}
