//! Energy, scaling and bytes: what must hold exactly.
//!
//! No test here has a tolerance. `run` asserts the integer balance of every bake of the whole suite.

mod common;

use common::rooms::{Builder, plain, run};
use common::runs::one_round;
use evenlight::accel::{Accel, Ray};
use evenlight::light::Visibility;
use evenlight::options::{DoubleSided, TexelValue};
use evenlight::photon::{EnergyLedger, Photon, PhotonKind, Trail, walk};
use evenlight::scene::{Alpha, LightKind, Material, Scene, Sky, Texture, TextureRef, World, Wrap};
use evenlight::{Bake, BakeOptions};
use glam::{DVec3, Vec2, Vec3, Vec4};
use std::f64::consts::PI;

const PAGE: u32 = 128;

/// A room with a window to a sky, a box in it, lights of all kinds and the given material on a sheet across it.
fn mixed(sheet: Material) -> Scene {
    let mut b = Builder::new(PAGE);
    let white = b.material(Material { base_color: Vec4::new(0.8, 0.7, 0.6, 1.0), ..Material::default() });
    b.quad("floor", Vec3::ZERO, Vec3::Z * 4.0, Vec3::X * 4.0, white, [16; 2]);
    b.quad("left", Vec3::ZERO, Vec3::Y * 3.0, Vec3::Z * 4.0, white, [12, 16]);
    b.quad("right", Vec3::X * 4.0, Vec3::Z * 4.0, Vec3::Y * 3.0, white, [16, 12]);
    b.quad("back", Vec3::ZERO, Vec3::X * 4.0, Vec3::Y * 3.0, white, [16, 12]);
    b.solid(Vec3::new(0.5, 0.0, 0.5), Vec3::new(1.5, 1.0, 1.5), white, 6);
    let lamp = b.diffuse(0.3, 20.0);
    b.quad("lamp", Vec3::new(1.0, 3.0, 1.0), Vec3::X * 2.0, Vec3::Z, lamp, [6, 3]);
    let sheet = b.material(sheet);
    b.quad("sheet", Vec3::new(2.5, 0.25, 0.25), Vec3::Y * 2.0, Vec3::Z * 3.0, sheet, [8, 12]);
    b.point_light(Vec3::new(3.0, 1.0, 3.0), 10.0);
    b.light(Vec3::new(2.0, 2.5, 2.0), Vec3::NEG_Y, 30.0, LightKind::Spot { inner: 0.2, outer: 0.6 });
    b.light(Vec3::ZERO, Vec3::new(0.2, -1.0, -0.5), 40.0, LightKind::Directional { angular_diameter: 0.01 });
    b.scene_mut().sky = Some(Sky::Constant(Vec3::new(1.0, 2.0, 4.0)));
    b.finish()
}

/// Sheets of every kind that treats light in its own way.
fn sheets() -> Vec<(&'static str, Material)> {
    let tinted = Material { base_color: Vec4::new(0.9, 0.5, 0.1, 0.5), ..Material::default() };
    let cutoff = 0.25;
    vec![
        ("opaque", tinted.clone()),
        ("double-sided", Material { double_sided: true, ..tinted.clone() }),
        ("blend", Material { alpha: Alpha::Blend, ..tinted.clone() }),
        ("blend, double-sided", Material { alpha: Alpha::Blend, double_sided: true, ..tinted.clone() }),
        ("mask, present", Material { alpha: Alpha::Mask { cutoff }, ..tinted.clone() }),
        ("mask, absent", Material { alpha: Alpha::Mask { cutoff: 0.75 }, ..tinted.clone() }),
        ("transmission", Material { transmission: 0.7, ..tinted.clone() }),
        ("transmission, blend", Material { transmission: 0.7, alpha: Alpha::Blend, ..tinted.clone() }),
        ("transmission, solid", Material { transmission: 0.7, solid: true, ..tinted.clone() }),
        ("diffuse transmission", Material { diffuse_transmission: 0.6, ..tinted.clone() }),
        (
            "diffuse transmission, of half metal, half glass that is half there",
            Material {
                diffuse_transmission: 0.6,
                metallic: 0.5,
                transmission: 0.5,
                alpha: Alpha::Blend,
                ..tinted.clone()
            },
        ),
        ("metal", Material { metallic: 1.0, ..tinted.clone() }),
        ("half metal, half glass", Material { metallic: 0.5, roughness: 0.3, transmission: 1.0, ..tinted.clone() }),
        ("unlit", Material { unlit: true, ..tinted.clone() }),
        ("emitter", Material { emission: Vec3::ONE, double_sided: true, ..tinted }),
    ]
}

/// Emitted + roulette = absorbed + absorbed on backs + escaped + cut in every kind of scene, with something in
/// each term that the scene has a use for; and what is deposited is what arrives on receiving sides.
#[test]
fn the_balance_closes_in_integers() {
    let mut total = EnergyLedger::default();
    for (what, sheet) in sheets() {
        for double_sided in [DoubleSided::Auto, DoubleSided::Split] {
            let scene = mixed(sheet.clone());
            let bake = run(&scene, &BakeOptions { double_sided, texel_value: TexelValue::Open, ..one_round(PAGE) });
            let ledger = bake.solution.ledger;
            assert_eq!(ledger.imbalance(), [0; 3], "{what}");
            assert!(ledger.emitted.iter().all(|&e| e > 0) && ledger.deposits > 0, "{what}");
            assert_eq!(ledger.cut, [0; 3], "{what}");
            total += &ledger;
        }
    }
    assert!(total.escaped[0] > 0 && total.absorbed[0] > 0 && total.back_absorbed[0] > 0);
}

/// Nothing escapes from closed rooms, and no back is met in them.
#[test]
fn nothing_escapes_from_closed_rooms() {
    let mut rooms: Vec<Builder> = (0..4).map(|_| Builder::new(PAGE)).collect();
    for (k, b) in rooms.iter_mut().enumerate() {
        let wall = b.diffuse(0.8, 0.0);
        match k {
            0 => b.room(Vec3::new(-1.0, 0.0, -3.0), Vec3::new(5.0, 2.5, 1.0), wall, 16),
            1 => b.l_room(wall, 8),
            2 => b.inner_sphere(1.7, 2, wall, 4),
            _ => {
                // Far from the origin, where f32 positions are coarse.
                let at = Vec3::new(1000.0, 50.0, -3000.0);
                b.room(at, at + Vec3::new(4.0, 3.0, 5.0), wall, 16);
            }
        }
        b.point_light([Vec3::ONE, Vec3::ONE, Vec3::ZERO, Vec3::new(1001.0, 51.0, -2999.0)][k], 10.0);
    }
    for b in rooms {
        let scene = b.finish();
        let bake = run(&scene, &BakeOptions { max_photons: Some(1 << 18), target_percent: 0.01, ..plain(PAGE, 1.0) });
        let ledger = bake.solution.ledger;
        assert!(ledger.rays > 500_000);
        assert_eq!((ledger.escaped, ledger.back_absorbed, ledger.cut), ([0; 3], [0; 3], [0; 3]));
    }
}

/// The largest channel of a photon never changes on its way, through colour, glass and roulette.
#[test]
fn photons_weigh_the_same_all_the_way() {
    for (what, sheet) in sheets() {
        let scene = mixed(sheet);
        let world = World::new(&scene);
        let accel = Accel::build(&world.positions, |_| false);
        let visibility = Visibility::new(&world, &accel);
        let mut random = common::random::Random::new(3);
        let mut trail = Trail::default();
        for _ in 0..2000 {
            trail.deposits.clear();
            let direction = Vec3::from_array(std::array::from_fn(|_| random.normal() as f32));
            let ray = Ray { origin: world.frame.from_world(glam::DVec3::splat(2.2)), direction, t_max: f32::INFINITY };
            let photon = Photon { ray, flux: [1 << 24, 1 << 23, 1 << 22], kind: PhotonKind::Diffuse, caustic: false };
            let mut ledger = EnergyLedger::default();
            walk(photon, &visibility, 0.0, || (random.unit() * 4_294_967_296.0) as u32, &mut trail, &mut ledger);
            assert_eq!(ledger.imbalance(), [0; 3], "{what}");
            for d in &trail.deposits {
                assert_eq!(d.flux.iter().max(), Some(&(1 << 24)), "{what}");
            }
        }
    }
}

/// Bits of both halves of every texel.
/// Colour of the materials below.
const BASE: Vec3 = Vec3::new(0.9, 0.5, 0.1);

/// Texel of the picture that their textures show.
const TEXEL: [u8; 4] = [51, 102, 204, 153];

/// Share per channel that a sheet of `material` sends on, on either side, of light that arrives at a cosine to its normal,
/// from behind where that is negative: what photons do not leave there. The random numbers of the photons are an additive
/// sequence of low discrepancy.
fn sent_on(what: &str, material: Material, cosine: f64) -> [f64; 3] {
    let mut b = Builder::new(PAGE);
    let material = b.material(material);
    let corner = Vec3::new(-2.0, -2.0, 0.0);
    let sheet = b.quad("sheet", corner, Vec3::X * 4.0, Vec3::Y * 4.0, material, [8; 2]);
    let mut png = std::io::Cursor::new(Vec::new());
    let picture = image::RgbaImage::from_pixel(1, 1, image::Rgba(TEXEL));
    picture.write_to(&mut png, image::ImageFormat::Png).expect("writing to memory");
    let texture = Texture::new("picture".into(), png.into_inner().into(), [Wrap::Clamp; 2], false);
    b.scene_mut().textures.push(texture);
    b.scene_mut().meshes[sheet].primitives[0].tex_coords[0] = vec![Vec2::ZERO; 4];
    let scene = b.finish();
    let world = World::new(&scene);
    let accel = Accel::build(&world.positions, |_| false);
    let visibility = Visibility::new(&world, &accel);
    let direction = Vec3::new((1.0 - cosine * cosine).sqrt() as f32, 0.0, -cosine as f32);
    let origin = world.frame.from_world(DVec3::new(0.3, 0.2, 0.0) - direction.as_dvec3());
    let ray = Ray { origin, direction, t_max: f32::INFINITY };
    let photon = Photon { ray, flux: [1 << 24; 3], kind: PhotonKind::Diffuse, caustic: false };
    let (mut ledger, mut trail) = (EnergyLedger::default(), Trail::default());
    for k in 1..=1u32 << 16 {
        let mut dimension = 0;
        let random = || {
            dimension += 1;
            // Steps in powers of the root of x^6 = x + 1.
            let step = 1.134_724_138_401_519_4f64.powi(-dimension);
            ((f64::from(k) * step + 0.5).fract() * 4_294_967_296.0) as u32
        };
        walk(photon, &visibility, 0.0, random, &mut trail, &mut ledger);
        trail = Trail::default();
    }
    assert_eq!(ledger.imbalance(), [0; 3], "{what}");
    std::array::from_fn(|c| 1.0 - (ledger.absorbed[c] + ledger.back_absorbed[c]) as f64 / ledger.emitted[c] as f64)
}

/// Share that a metal of normal reflectance `f0` reflects in all directions: quadrature of the microfacet formula of glTF
/// 2.0, appendix B, over the directions of the light.
fn metal(f0: f64, roughness: f64, cosine: f64) -> f64 {
    let schlick = |vh: f64| f0 + (1.0 - f0) * (1.0 - vh).powi(5);
    let a2 = roughness.powi(4);
    if a2 == 0.0 {
        return schlick(cosine);
    }
    let (n, v) = (700, DVec3::new((1.0 - cosine * cosine).sqrt(), 0.0, cosine));
    let step = |k: i32| (f64::from(k) + 0.5) / f64::from(n);
    let mut sum = 0.0;
    for i in 0..n {
        let z = step(i);
        for j in 0..n {
            let (sin, cos) = (PI * step(j)).sin_cos();
            let l = DVec3::new(cos, sin, 0.0) * (1.0 - z * z).sqrt() + DVec3::Z * z;
            let h = (l + v).normalize();
            let d = a2 / (PI * (h.z * h.z * (a2 - 1.0) + 1.0).powi(2));
            let root = |a: f64, b: f64| a * (a2 + (1.0 - a2) * b * b).sqrt();
            let visible = 0.5 / (root(z, cosine) + root(cosine, z));
            sum += d * visible * schlick(v.dot(h)) * z;
        }
    }
    sum * 2.0 * PI / f64::from(n * n)
}

/// Share that one face of glass reflects, by Fresnel's equations in angles; `ior` is the index beyond.
fn fresnel(cosine: f64, ior: f64) -> f64 {
    let i = cosine.acos();
    let t = i.sin() / ior;
    if t >= 1.0 {
        return 1.0;
    }
    let t = t.asin();
    let (s, p) = ((i - t).sin() / (i + t).sin(), (i - t).tan() / (i + t).tan());
    0.5 * (s * s + p * p)
}

/// Linear value of an sRGB code (IEC 61966-2-1).
fn linear(code: u8) -> f64 {
    ((f64::from(code) / 255.0 + 0.055) / 1.055).powf(2.4)
}

/// What a surface of each kind sends on at a point, of light at any angle and from either side, is what its formula says,
/// within 0.001; and of every photon all is accounted for.
#[test]
fn materials_send_on_what_their_formulas_say() {
    /// Of the base colour in one channel, and the cosine.
    type Formula = Box<dyn Fn(f64, f64) -> f64>;
    let plain = Material { base_color: BASE.extend(0.25), ..Material::default() };
    let metallic = |roughness| Material { metallic: 1.0, roughness, double_sided: true, ..plain.clone() };
    let glass = Material { transmission: 1.0, roughness: 0.0, ..plain.clone() };
    let leaf =
        Material { diffuse_transmission: 0.6, diffuse_transmission_color: Vec3::new(0.5, 0.7, 0.8), ..plain.clone() };
    let picture = Some(TextureRef { texture: 0, tex_coord: 0, transform: glam::Affine2::IDENTITY });
    let front = |base: f64, cosine: f64| if cosine > 0.0 { base } else { 0.0 };
    let pane = |base: f64, cosine: f64| {
        let r = fresnel(cosine.abs(), 1.5);
        let r = 2.0 * r / (1.0 + r);
        r + (1.0 - r) * base
    };
    // The colour of what a leaf transmits goes with its base colour, channel by channel.
    let transmitted = |base: f64| {
        if base > 0.8 {
            0.5
        } else if base > 0.3 {
            0.7
        } else {
            0.8
        }
    };
    let cases: Vec<(&str, Material, Formula)> = vec![
        ("diffuse", plain.clone(), Box::new(front)),
        ("emitter", Material { emission: Vec3::ONE, ..plain.clone() }, Box::new(front)),
        ("unlit", Material { unlit: true, ..plain.clone() }, Box::new(|_, _| 0.0)),
        ("double-sided", Material { double_sided: true, ..plain.clone() }, Box::new(|base, _| base)),
        (
            "blend",
            Material { alpha: Alpha::Blend, ..plain.clone() },
            Box::new(move |base, cosine| 0.75 + 0.25 * front(base, cosine)),
        ),
        ("mask, present", Material { alpha: Alpha::Mask { cutoff: 0.2 }, ..plain.clone() }, Box::new(front)),
        ("mask, absent", Material { alpha: Alpha::Mask { cutoff: 0.3 }, ..plain.clone() }, Box::new(|_, _| 1.0)),
        ("mirror", metallic(0.0), Box::new(|base, cosine| metal(base, 0.0, cosine.abs()))),
        ("metal, 0.3", metallic(0.3), Box::new(|base, cosine| metal(base, 0.3, cosine.abs()))),
        ("metal, 0.6", metallic(0.6), Box::new(|base, cosine| metal(base, 0.6, cosine.abs()))),
        ("metal, 1.0", metallic(1.0), Box::new(|base, cosine| metal(base, 1.0, cosine.abs()))),
        (
            "half metal",
            Material { metallic: 0.5, ..metallic(0.6) },
            Box::new(|base, cosine| 0.5 * base + 0.5 * metal(base, 0.6, cosine.abs())),
        ),
        ("pane", glass.clone(), Box::new(pane)),
        (
            "half a pane",
            Material { transmission: 0.5, ..glass.clone() },
            Box::new(move |base, cosine| 0.5 * base + 0.5 * pane(base, cosine)),
        ),
        (
            "solid glass",
            Material { solid: true, ..glass.clone() },
            Box::new(|base, cosine| {
                let r = fresnel(cosine.abs(), if cosine > 0.0 { 1.5 } else { 1.0 / 1.5 });
                r + (1.0 - r) * base
            }),
        ),
        ("leaf", leaf.clone(), Box::new(move |base, _| 0.4 * base + 0.6 * transmitted(base))),
        (
            "leaf, a quarter there, half metal, half of the rest glass",
            Material { metallic: 0.5, transmission: 0.5, roughness: 0.0, alpha: Alpha::Blend, ..leaf.clone() },
            Box::new(move |base, cosine| {
                let diffuse = 0.4 * base + 0.6 * transmitted(base);
                let there = 0.5 * metal(base, 0.0, cosine.abs()) + 0.25 * pane(base, cosine) + 0.25 * diffuse;
                0.75 + 0.25 * there
            }),
        ),
        (
            "white, textured leaf",
            Material {
                base_color: Vec4::ONE,
                base_color_texture: picture,
                diffuse_transmission_texture: picture,
                diffuse_transmission_color_texture: picture,
                diffuse_transmission_color: Vec3::splat(0.5),
                diffuse_transmission: 1.0,
                ..Material::default()
            },
            Box::new(|base, _| 0.4 * base + 0.6 * 0.5 * base),
        ),
        (
            "textured metal",
            Material { base_color_texture: picture, metallic_texture: picture, base_color: Vec4::ONE, ..metallic(1.0) },
            Box::new(|base, cosine| 0.2 * base + 0.8 * metal(base, 0.4, cosine.abs())),
        ),
    ];
    for (what, material, formula) in cases {
        let textured = material.base_color_texture.is_some();
        for cosine in [0.95, 0.35, -0.5] {
            let found = sent_on(what, material.clone(), cosine);
            for c in 0..3 {
                let base = if textured { linear(TEXEL[c]) } else { f64::from(BASE[c]) };
                let expected = formula(base, cosine);
                assert!((found[c] - expected).abs() < 1e-3, "{what} at {cosine}: {} for {expected}", found[c]);
            }
        }
    }
}

fn bits(bake: &Bake) -> Vec<[u32; 3]> {
    let halves = &bake.solution.total;
    halves.odd.iter().chain(&halves.even).map(|e| e.to_array().map(f32::to_bits)).collect()
}

fn assert_same(what: &str, a: &[[u32; 3]], b: &[[u32; 3]]) {
    assert_eq!(a.len(), b.len(), "{what}");
    let differing = a.iter().zip(b).filter(|(a, b)| a != b).count();
    assert_eq!(differing, 0, "{what}: {differing} of {} values differ", a.len());
}

/// Options of a bake with several rounds.
fn several_rounds() -> BakeOptions {
    BakeOptions { max_photons: Some(1 << 16), ..plain(PAGE, 3.0) }
}

/// Every light times 2^k: every texel times 2^k, to the bit.
#[test]
fn light_is_linear() {
    let (_, sheet) = sheets().swap_remove(3);
    let base = mixed(sheet.clone());
    let reference = run(&base, &several_rounds());
    for k in [-7, 4, 20] {
        let factor = 2f32.powi(k);
        let mut scene = mixed(sheet.clone());
        scene.lights.iter_mut().for_each(|l| l.intensity *= factor);
        scene.materials.iter_mut().for_each(|m| m.emission *= factor);
        scene.sky = Some(Sky::Constant(Vec3::new(1.0, 2.0, 4.0) * factor));
        let mut bake = run(&scene, &several_rounds());
        for e in bake.solution.total.odd.iter_mut().chain(&mut bake.solution.total.even) {
            *e /= factor;
        }
        assert_same(&format!("2^{k}"), &bits(&reference), &bits(&bake));
    }
}

/// The scene 2^k times as large and its point and spot lights 4^k times as strong: the same irradiance, to the bit.
#[test]
fn size_by_a_power_of_two_changes_nothing() {
    let (_, sheet) = sheets().swap_remove(6);
    let base = mixed(sheet.clone());
    let reference = run(&base, &several_rounds());
    for k in [-3, 1, 10] {
        let factor = 2f32.powi(k);
        let mut scene = mixed(sheet.clone());
        for p in scene.meshes.iter_mut().flat_map(|m| &mut m.primitives).flat_map(|p| &mut p.positions) {
            *p *= factor;
        }
        for l in &mut scene.lights {
            l.position *= f64::from(factor);
            if !matches!(l.kind, LightKind::Directional { .. }) {
                l.intensity *= factor * factor;
            }
        }
        assert_same(&format!("2^{k}"), &bits(&reference), &bits(&run(&scene, &several_rounds())));
    }
}

/// The same bytes for any number of threads, and again.
#[test]
fn threads_change_nothing() {
    let (_, sheet) = sheets().swap_remove(3);
    let scene = mixed(sheet);
    let with = |threads| {
        let bake = run(&scene, &BakeOptions { threads, ..several_rounds() });
        let maps: Vec<[u32; 3]> =
            bake.lightmap.pages.iter().flat_map(|p| &p.irradiance).map(|e| e.map(f32::to_bits)).collect();
        let report = (bake.report.texel_error_percent.to_bits(), bake.report.work.photon_rays, bake.solution.ledger);
        (bits(&bake), maps, report)
    };
    let reference = with(1);
    for threads in [1, 2, 7] {
        let again = with(threads);
        assert_same("texels", &reference.0, &again.0);
        assert_same("maps", &reference.1, &again.1);
        assert_eq!(reference.2, again.2, "{threads} threads");
    }
}

/// Another seed is another bake.
#[test]
fn seeds_differ() {
    let (_, sheet) = sheets().swap_remove(0);
    let scene = mixed(sheet);
    let [a, b] = [1, 2].map(|seed| bits(&run(&scene, &BakeOptions { seed, ..one_round(PAGE) })));
    let same = a.iter().zip(&b).filter(|(a, b)| a == b).count();
    assert!(same < a.len() / 10, "{same} of {} values are the same", a.len());
}
