//! Which side of a surface light meets, what passes it, and what happens to surfaces without a place on the map.

mod common;

use common::formulas::{QuadMap, point_irradiance, polygon_irradiance};
use common::random::Random;
use common::rooms::{Builder, plain, run, two_rooms};
use common::runs::{area_mean, node_mean, one_round, samples, side_mean, texel_samples};
use common::statistics::{ALPHA, expect_mean, normal_upper_quantile, sidak, welch_score};
use evenlight::accel::Ray;
use evenlight::light::Visibility;
use evenlight::options::DoubleSided;
use evenlight::output::preview::render_backs;
use evenlight::scene::{Alpha, LightKind, Material, Scene, Texture, TextureRef, Wrap};
use evenlight::{Bake, BakeOptions};
use glam::{Affine2, DAffine3, DVec3, Vec2, Vec3, Vec4};
use std::f64::consts::PI;

const PAGE: u32 = 64;

/// A sheet of 2 m in the plane y = 0, its front up, with a lamp of 10 cd 1 m above and one of 30 cd 1 m below.
fn between_two_lamps(material: Material) -> Scene {
    let mut b = Builder::new(PAGE);
    let material = b.material(material);
    b.quad("sheet", Vec3::new(-1.0, 0.0, -1.0), Vec3::Z * 2.0, Vec3::X * 2.0, material, [8; 2]);
    b.point_light(Vec3::Y, 10.0);
    b.point_light(Vec3::NEG_Y, 30.0);
    b.finish()
}

/// Mean irradiance of that sheet from one lamp.
fn from_lamp(candela: f64) -> f64 {
    let scene = between_two_lamps(Material::default());
    let quad = QuadMap::of(&scene, 0, PAGE);
    let texels = (0..64).map(|k| (quad.origin[0] + k % 8, quad.origin[1] + k / 8));
    texels.map(|(x, y)| quad.texel_mean(x, y, |p| point_irradiance(p, DVec3::Y, DVec3::Y, candela))).sum::<f64>() / 64.0
}

#[test]
fn one_sided_surfaces_receive_on_their_front() {
    let scene = between_two_lamps(Material::default());
    let [front] = samples(&scene, &one_round(PAGE), 0..16, |bake, e| {
        assert!(bake.texels.texels[..bake.texels.mapped].iter().all(|t| !t.back));
        [node_mean(bake, e, 0)]
    });
    expect_mean("front", &front, from_lamp(10.0), 0.01, 1);
}

/// A mirrored node still has its front where the file says: its normal is mirrored with it.
#[test]
fn mirrored_and_turned_nodes_keep_their_front() {
    // (transform, candela of the lamp that the front sees)
    let cases = [
        (DAffine3::from_scale(DVec3::new(-1.0, 1.0, 1.0)), 10.0),
        (DAffine3::from_scale(DVec3::new(1.0, 1.0, -1.0)), 10.0),
        (DAffine3::from_scale(DVec3::new(1.0, -1.0, 1.0)), 30.0),
        (DAffine3::from_scale(DVec3::NEG_ONE), 30.0),
        (DAffine3::from_rotation_x(PI), 30.0),
    ];
    for (transform, candela) in cases {
        let mut scene = between_two_lamps(Material::default());
        scene.instances[0].world_from_object = transform;
        let [front] = samples(&scene, &one_round(PAGE), 0..16, |bake, e| [node_mean(bake, e, 0)]);
        expect_mean(&format!("{transform:?}"), &front, from_lamp(candela), 0.01, cases.len());
    }
}

#[test]
fn double_sided_surfaces_receive_on_both_sides() {
    let scene = between_two_lamps(Material { double_sided: true, ..Material::default() });
    let [front, back] =
        samples(&scene, &one_round(PAGE), 0..16, |bake, e| [side_mean(bake, e, 0, false), side_mean(bake, e, 0, true)]);
    expect_mean("front", &front, from_lamp(10.0), 0.01, 2);
    expect_mean("back", &back, from_lamp(30.0), 0.01, 2);

    // Stored: the brighter side, the front, or both.
    let stored = |double_sided| {
        let bake = run(&scene, &BakeOptions { double_sided, ..one_round(PAGE) });
        let page = &bake.lightmap.pages[0];
        let mean = |layer: &[[f32; 3]]| {
            let lit = layer.iter().zip(&page.coverage).filter(|(_, c)| **c > 0.0);
            lit.map(|(e, _)| f64::from(e[0])).sum::<f64>() / 64.0
        };
        (mean(&page.irradiance), if page.back.is_empty() { None } else { Some(mean(&page.back)) })
    };
    let near = |found: f64, candela: f64| assert!((found / from_lamp(candela) - 1.0).abs() < 0.05, "{found}");
    let (auto, none) = stored(DoubleSided::Auto);
    near(auto, 30.0);
    assert_eq!(none, None);
    let (front, none) = stored(DoubleSided::Front);
    near(front, 10.0);
    assert_eq!(none, None);
    let (front, back) = stored(DoubleSided::Split);
    near(front, 10.0);
    near(back.expect("a layer of backs"), 30.0);
}

/// A room whose walls are turned inside out receives nothing and swallows all light.
#[test]
fn backs_absorb() {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(0.9, 0.0);
    b.solid(Vec3::ZERO, Vec3::splat(2.0), wall, 8);
    // A tile inside that reflects: its photons all end on backs.
    b.quad("tile", Vec3::new(0.5, 0.5, 0.5), Vec3::Z, Vec3::X, wall, [4; 2]);
    b.point_light(Vec3::new(1.0, 1.5, 1.0), 10.0);
    let scene = b.finish();
    let bake = run(&scene, &one_round(PAGE));
    for i in 0..bake.texels.mapped {
        let inside = bake.solution.weights.instance[i] == 6;
        assert_eq!(bake.solution.total.mean(i) == Vec3::ZERO, !inside);
    }
    let ledger = bake.solution.ledger;
    assert_eq!((ledger.deposits, ledger.escaped, ledger.back_absorbed), (0, [0; 3], ledger.emitted));
}

/// A room with a table that may be left out of the bake.
fn furnished(bake_table: bool) -> Scene {
    let mut b = Builder::new(128);
    let wall = b.material(Material { base_color: Vec4::new(0.7, 0.5, 0.3, 1.0), ..Material::default() });
    b.room(Vec3::ZERO, Vec3::new(3.0, 2.0, 4.0), wall, 8);
    let table = b.material(Material { base_color: Vec4::new(0.3, 0.6, 0.9, 1.0), ..Material::default() });
    b.solid(Vec3::new(1.0, 0.25, 1.0), Vec3::new(2.0, 1.0, 3.0), table, 8);
    b.point_light(Vec3::new(0.5, 1.75, 0.5), 10.0);
    let lamp = b.diffuse(0.0, 5.0);
    b.quad("lamp", Vec3::new(1.0, 1.75, 1.5), Vec3::X, Vec3::Z, lamp, [4; 2]);
    let mut scene = b.finish();
    scene.instances[6..12].iter_mut().for_each(|i| i.bake = bake_table);
    scene
}

/// Leaving a mesh out of the bake changes no other texel in expectation. 384 texels of the walls, and the means of
/// the six walls, which see a difference of about 1 %.
#[test]
fn excluding_a_mesh_changes_no_other_texel() {
    let options = BakeOptions { max_photons: Some(1 << 16), ..plain(128, 0.5) };
    let (with, without) = (furnished(true), furnished(false));
    let layout = run(&without, &one_round(128));
    assert!(layout.report.atlas.transport_texels > 0);
    assert!(layout.solution.weights.instance.iter().all(|&i| !(6..12).contains(&i)));

    let place = |bake: &Bake| -> Vec<_> { (0..bake.texels.mapped).map(|i| bake.texels.page_position(i)).collect() };
    let (all, left) = (place(&run(&with, &one_round(128))), place(&layout));
    let (a, b) = (texel_samples(&with, &options, 0..16), texel_samples(&without, &options, 100..116));
    let channel = |samples: &[Vec3], c: usize| samples.iter().map(|e| f64::from(e[c])).collect::<Vec<_>>();
    let limit = normal_upper_quantile(0.25 * sidak(ALPHA, 3 * left.len()));
    for (i, at) in left.iter().enumerate() {
        let same = all.iter().position(|p| p == at).expect("the texel is in both bakes");
        for c in 0..3 {
            let z = welch_score(&channel(&a[same], c), &channel(&b[i], c)).unwrap_or(0.0);
            assert!(z.abs() < limit, "texel {i}, channel {c}: score {z}");
        }
    }

    let walls = |bake: &Bake, e: &[Vec3]| std::array::from_fn::<_, 6, _>(|i| node_mean(bake, e, i));
    let (a, b) = (samples(&with, &options, 200..216, walls), samples(&without, &options, 300..316, walls));
    for (i, (a, b)) in a.iter().zip(&b).enumerate() {
        let z = welch_score(a, b).expect("there is noise");
        assert!(z.abs() < normal_upper_quantile(0.25 * sidak(ALPHA, 6)), "wall {i}: score {z}");
    }
}

/// Two rooms share one floor and one ceiling; between them stands a wall without thickness. With light in one room
/// only, the other is black: exactly, in every texel that the wall does not stand on.
#[test]
fn no_light_passes_under_a_thin_wall() {
    // With 32 columns the wall stands between two texels, with 33 in the middle of one.
    for columns in [32, 33] {
        for double_sided in [true, false] {
            let scene = two_rooms(128, columns, double_sided);
            let options =
                BakeOptions { max_photons: Some(1 << 19), double_sided: DoubleSided::Split, ..plain(128, 0.1) };
            let bake = run(&scene, &options);
            let width = 6.0 / f64::from(columns);
            let (mut dark, mut lit) = (0, 0);
            for i in 0..bake.texels.mapped {
                let e = bake.solution.total.mean(i);
                let centre = common::rooms::centre(&bake, i);
                let of_sheet = bake.solution.weights.instance[i] == 6;
                let on_dark_side = if of_sheet { !bake.texels.texels[i].back } else { centre.x - 3.0 > 0.51 * width };
                if on_dark_side {
                    assert_eq!(e, Vec3::ZERO, "{columns} columns, texel at {centre}");
                    dark += 1;
                } else if of_sheet || 3.0 - centre.x > 0.51 * width {
                    assert!(e.min_element() > 0.0, "{columns} columns, texel at {centre}");
                    lit += 1;
                }
            }
            assert!(dark > 800 && lit > 800);
        }
    }
}

/// A black tile of 1 m under a sheet under a panel: the panel faces down and is lit from the side by a sun that the
/// sheet does not meet; the sheet covers all ways from panel to tile. With `sun_above` there is no
/// panel, and a sun shines straight down instead.
fn through_a_sheet(sheet: Material, sun_above: bool, texture: Option<Texture>) -> Scene {
    let mut b = Builder::new(PAGE);
    let black = b.diffuse(0.0, 0.0);
    let (x, z) = (Vec3::X, Vec3::Z);
    let corner = Vec3::new(-0.5, 0.0, -0.5);
    b.quad("tile", corner, z, x, black, [8; 2]);
    let material = b.material(sheet);
    let sheet = b.quad("sheet", Vec3::new(-0.75, 1.0, -0.75), z * 1.5, x * 1.5, material, [6; 2]);
    if sun_above {
        b.light(Vec3::ZERO, Vec3::NEG_Y, 100.0, LightKind::Directional { angular_diameter: 0.0 });
    } else {
        let grey = b.diffuse(0.5, 0.0);
        b.quad("panel", corner + Vec3::Y * 2.0, x, z, grey, [8; 2]);
        b.light(Vec3::ZERO, Vec3::new(1.0, 0.375, 0.0), 1000.0, LightKind::Directional { angular_diameter: 0.0 });
    }
    if let Some(texture) = texture {
        b.scene_mut().textures.push(texture);
        // u runs along x here.
        b.scene_mut().meshes[sheet].primitives[0].tex_coords[0] = vec![Vec2::ZERO, Vec2::Y, Vec2::ONE, Vec2::X];
    }
    b.finish()
}

/// Sheets without reflection, and the share of light per channel that passes.
fn passing_sheets() -> Vec<(&'static str, Material, [f64; 3])> {
    let black = Material { base_color: Vec4::new(0.0, 0.0, 0.0, 0.5), ..Material::default() };
    // As thin as air: what glass reflects is tested elsewhere.
    let base_color = Vec4::new(0.9, 0.5, 0.125, 1.0);
    let glass = Material { base_color, transmission: 1.0, ior: 1.0, ..Material::default() };
    let faint = Material { base_color: glass.base_color.with_w(0.5), alpha: Alpha::Blend, ..glass.clone() };
    vec![
        ("opaque", black.clone(), [0.0; 3]),
        ("mask, present", Material { alpha: Alpha::Mask { cutoff: 0.5 }, ..black.clone() }, [0.0; 3]),
        ("mask, absent", Material { alpha: Alpha::Mask { cutoff: 0.51 }, ..black.clone() }, [1.0; 3]),
        ("blend", Material { alpha: Alpha::Blend, ..black.clone() }, [0.5; 3]),
        ("blend, double-sided", Material { alpha: Alpha::Blend, double_sided: true, ..black }, [0.5; 3]),
        ("glass", glass.clone(), [0.9, 0.5, 0.125]),
        ("glass, double-sided", Material { double_sided: true, ..glass }, [0.9, 0.5, 0.125]),
        ("glass, half there", faint, [0.95, 0.75, 0.5625]),
    ]
}

#[test]
fn direct_light_through_sheets() {
    for (what, sheet, share) in passing_sheets() {
        let bake_scene = through_a_sheet(sheet, true, None);
        let bake = run(&bake_scene, &one_round(PAGE));
        for i in (0..bake.texels.mapped).filter(|&i| bake.solution.weights.instance[i] == 0) {
            let e = bake.solution.total.mean(i);
            for c in 0..3 {
                assert!((f64::from(e[c]) - 100.0 * share[c]).abs() < 1e-3, "{what}: {e} for {share:?}");
            }
        }
    }
}

/// Radiance of the panel: half of what it gets from of 1000 lux by its cosine, over pi.
fn panel_radiance() -> f64 {
    0.5 / PI * 1000.0 * 0.375 / 1f64.hypot(0.375)
}

/// The part of the panel with x below `limit` as seen from `p`.
fn panel_irradiance(p: DVec3, limit: f64) -> f64 {
    let x1 = limit.clamp(-0.5, 0.5);
    let corners = [(-0.5, -0.5), (x1, -0.5), (x1, 0.5), (-0.5, 0.5)].map(|(x, z)| DVec3::new(x, 2.0, z));
    if x1 <= -0.5 { 0.0 } else { polygon_irradiance(p, DVec3::Y, &corners, panel_radiance()) }
}

/// Photons from the panel: Lambert's formula times the share that passes, per channel.
#[test]
fn reflected_light_through_sheets() {
    let sheets = passing_sheets();
    let tests = 3 * sheets.len();
    for (what, sheet, share) in sheets {
        let scene = through_a_sheet(sheet, false, None);
        let quad = QuadMap::of(&scene, 0, PAGE);
        let expected = mean_of_tile(&quad, |p| panel_irradiance(p, 0.5));
        let found = samples(&scene, &one_round(PAGE), 0..40, |bake, e| {
            area_mean(bake, e, |i| bake.solution.weights.instance[i] == 0).to_array()
        });
        for c in 0..3 {
            if share[c] == 0.0 {
                assert!(found[c].iter().all(|&e| e == 0.0), "{what}");
            } else {
                expect_mean(what, &found[c], expected * share[c], 0.05, tests);
            }
        }
    }
}

fn mean_of_tile(quad: &QuadMap, e: impl Fn(DVec3) -> f64) -> f64 {
    let texels = (0..64).map(|k| (quad.origin[0] + k % 8, quad.origin[1] + k / 8));
    texels.map(|(x, y)| quad.texel_mean(x, y, &e)).sum::<f64>() / 64.0
}

/// A sheet whose texture has no surface where x < 0: the tile sees the sun there, and of the panel what lies beyond
/// the edge of the hole.
#[test]
fn light_through_a_hole_in_a_texture() {
    let picture = image::RgbaImage::from_fn(2, 1, |x, _| image::Rgba([0, 0, 0, if x == 0 { 0 } else { 255 }]));
    let mut png = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut png, image::ImageFormat::Png).expect("writing to memory");
    let texture = || Texture::new("hole".into(), png.get_ref().as_slice().into(), [Wrap::Clamp; 2], true);
    let sheet = Material {
        base_color_texture: Some(TextureRef { texture: 0, tex_coord: 0, transform: Affine2::IDENTITY }),
        alpha: Alpha::Mask { cutoff: 0.5 },
        ..Material::default()
    };
    let direct = through_a_sheet(sheet.clone(), true, Some(texture()));
    let bake = run(&direct, &one_round(PAGE));
    for i in (0..bake.texels.mapped).filter(|&i| bake.solution.weights.instance[i] == 0) {
        let lit = common::rooms::centre(&bake, i).x < 0.0;
        let e = bake.solution.total.mean(i).x;
        assert!((e - if lit { 100.0 } else { 0.0 }).abs() < 1e-3, "{e}");
    }

    let reflected = through_a_sheet(sheet, false, Some(texture()));
    let quad = QuadMap::of(&reflected, 0, PAGE);
    let halves = samples(&reflected, &one_round(PAGE), 0..96, |bake, e| {
        [true, false].map(|left| {
            let keep = |i| bake.solution.weights.instance[i] == 0 && (common::rooms::centre(bake, i).x < 0.0) == left;
            area_mean(bake, e, keep).x
        })
    });
    for (left, found) in [true, false].into_iter().zip(&halves) {
        // From p the edge at x = 0, 1 m up, hides what lies beyond -p.x, 2 m up.
        let expected = 2.0 * mean_of_tile(&quad, |p| if (p.x < 0.0) == left { panel_irradiance(p, -p.x) } else { 0.0 });
        expect_mean("behind the hole", found, expected, 0.1, 2);
    }
}

/// Sheets that reflect or pass all light take none from a closed room: sum E a = Phi / (1 - rho) over its walls.
#[test]
fn lossless_sheets_in_a_closed_room() {
    let white = Material { base_color: Vec4::new(1.0, 1.0, 1.0, 0.5), double_sided: true, ..Material::default() };
    for (what, sheet) in [
        ("blend", Material { alpha: Alpha::Blend, ..white.clone() }),
        ("transmission", Material { transmission: 0.6, roughness: 0.0, ..white.clone() }),
        ("mirror", Material { metallic: 1.0, roughness: 0.0, ..white.clone() }),
        ("diffuse transmission", Material { diffuse_transmission: 0.7, double_sided: false, ..white.clone() }),
        ("half a mirror", Material { metallic: 0.5, roughness: 0.0, alpha: Alpha::Blend, ..white.clone() }),
        ("opaque", white),
    ] {
        let mut b = Builder::new(128);
        let wall = b.diffuse(0.6, 0.0);
        b.room(Vec3::ZERO, Vec3::new(3.0, 2.0, 4.0), wall, 12);
        let sheet = b.material(sheet);
        b.quad("sheet", Vec3::new(0.5, 0.5, 2.0), Vec3::X * 2.0, Vec3::Y, sheet, [8, 4]);
        b.point_light(Vec3::new(1.5, 1.0, 1.0), 10.0);
        let scene = b.finish();
        let [walls] = samples(&scene, &one_round(128), 0..32, |bake, e| {
            let of_walls = |i: usize| bake.solution.weights.instance[i] < 6;
            [area_mean(bake, e, of_walls).x * 52.0]
        });
        expect_mean(what, &walls, 4.0 * PI * 10.0 / 0.4, 0.015, 6);
    }
}

/// Transmits 0.6 of the diffuse light in its own colour, and reflects the rest by its base colour.
fn leaf(base: [f32; 3], transmitted: [f32; 3]) -> Material {
    Material {
        base_color: Vec3::from(base).extend(1.0),
        diffuse_transmission: 0.6,
        diffuse_transmission_color: transmitted.into(),
        ..Material::default()
    }
}

/// Of a leaf that is drawn from its front alone, the map holds the front, however much brighter the back is; and so it does
/// of glass.
#[test]
fn maps_hold_the_side_that_is_drawn() {
    let glass = Material { transmission: 0.5, ior: 1.2, ..Material::default() };
    for material in [leaf([0.5; 3], [0.5; 3]), glass] {
        for (double_sided, candela) in [(false, 10.0), (true, 30.0)] {
            let scene = between_two_lamps(Material { double_sided, ..material.clone() });
            let bake = run(&scene, &one_round(PAGE));
            let page = &bake.lightmap.pages[0];
            let lit = page.irradiance.iter().zip(&page.coverage).filter(|(_, c)| **c > 0.0);
            let found = lit.map(|(e, _)| f64::from(e[0])).sum::<f64>() / 64.0;
            assert!((found / from_lamp(candela) - 1.0).abs() < 0.05, "{found}");
        }
    }
}

/// The sun on a leaf: below, it shines as a lamp of the radiance t E / pi would, on a tile that gets no other light.
#[test]
fn a_leaf_shines_below() {
    let color = [0.9f32, 0.5, 0.125];
    let corners = [(-0.75, -0.75), (0.75, -0.75), (0.75, 0.75), (-0.75, 0.75)].map(|(x, z)| DVec3::new(x, 1.0, z));
    // Opaque to straight light, whether or not half of it is missing.
    for (alpha, share) in [(Alpha::Opaque, 1.0), (Alpha::Blend, 0.5)] {
        let sheet = leaf([0.0; 3], color);
        let sheet = Material { base_color: sheet.base_color.with_w(0.5), alpha, ..sheet };
        let scene = through_a_sheet(sheet, true, None);
        let quad = QuadMap::of(&scene, 0, PAGE);
        let below = mean_of_tile(&quad, |p| polygon_irradiance(p, DVec3::Y, &corners, share * 0.6 * 100.0 / PI));
        let found = samples(&scene, &one_round(PAGE), 0..24, |bake, e| {
            area_mean(bake, e, |i| bake.solution.weights.instance[i] == 0).to_array()
        });
        for c in 0..3 {
            let expected = below * f64::from(color[c]) + (1.0 - share) * 100.0;
            expect_mean(&format!("{alpha:?}"), &found[c], expected, 0.02, 6);
        }
    }
}

/// A lamp in a closed shade: what is reflected adds up inside to E = Phi / (A (1 - rho)), whatever the shape, and a share
/// tau / (1 - rho) of all light gets out.
#[test]
fn a_lampshade_lets_light_out() {
    let (base, color) = ([0.8f32, 0.5, 0.2], [0.9f32, 0.9, 0.5]);
    let mut b = Builder::new(128);
    let shade = b.material(leaf(base, color));
    b.room(Vec3::ZERO, Vec3::new(3.0, 2.0, 4.0), shade, 12);
    b.point_light(Vec3::new(1.5, 1.0, 1.0), 10.0);
    let scene = b.finish();
    let found: Vec<[f64; 6]> = (0..48)
        .map(|seed| {
            let bake = run(&scene, &BakeOptions { seed, ..one_round(128) });
            let e: Vec<Vec3> = (0..bake.texels.mapped).map(|t| bake.solution.total.mean(t)).collect();
            let inside = area_mean(&bake, &e, |i| !bake.texels.texels[i].back);
            let ledger = bake.solution.ledger;
            std::array::from_fn(|c| match c {
                0..3 => inside[c],
                _ => ledger.escaped[c - 3] as f64 / ledger.emitted[c - 3] as f64,
            })
        })
        .collect();
    for c in 0..3 {
        let (rho, tau) = (0.4 * f64::from(base[c]), 0.6 * f64::from(color[c]));
        let of = |k: usize| found.iter().map(|f| f[k]).collect::<Vec<f64>>();
        expect_mean("inside", &of(c), 4.0 * PI * 10.0 / (52.0 * (1.0 - rho)), 0.02, 6);
        // Photons carry what leaves the surface at first.
        expect_mean("outside", &of(c + 3), tau / (1.0 - rho) / (rho + tau), 0.02, 6);
    }
}

/// A leaf that takes no light shows nowhere in a furnace: E stays pi L / (1 - rho), on the walls and on both its sides.
#[test]
fn a_leaf_vanishes_in_a_furnace() {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(0.6, 5.0);
    b.room(Vec3::ZERO, Vec3::new(3.0, 2.0, 4.0), wall, 6);
    let leaf = b.material(leaf([1.0; 3], [1.0; 3]));
    b.quad("leaf", Vec3::new(0.5, 0.5, 2.0), Vec3::X * 2.0, Vec3::Y, leaf, [8, 4]);
    let scene = b.finish();
    let found = samples(&scene, &one_round(PAGE), 0..24, |bake, e| {
        let mean = |leaf: bool, back: bool| {
            area_mean(bake, e, |i| (bake.solution.weights.instance[i] == 6, bake.texels.texels[i].back) == (leaf, back))
                .x
        };
        [mean(false, false), mean(true, false), mean(true, true)]
    });
    for (what, found) in ["walls", "front", "back"].into_iter().zip(&found) {
        expect_mean(what, found, PI * 5.0 / 0.4, 0.05, 3);
    }
}

/// A pleated screen from floor to ceiling, white on both sides and folded to 22 degrees, keeps the light out: none gets
/// through where a point beside a fold is lifted off its own surface. One photon in some millions meets the very tip of a
/// fold, where rounding cannot tell its sides apart.
#[test]
fn no_light_passes_a_fold() {
    const PLEATS: u32 = 64;
    let mut b = Builder::new(256);
    let wall = b.diffuse(0.6, 0.0);
    b.room(Vec3::new(-1.0, 0.0, -1.0), Vec3::ONE, wall, 8);
    let white = b.material(Material { base_color: Vec4::ONE, double_sided: true, ..Material::default() });
    let corner = |k: u32| {
        let radius = if k.is_multiple_of(2) { 0.6 } else { 0.45 };
        let angle = (0.3 + f64::from(k % (2 * PLEATS)) * PI / f64::from(PLEATS)) as f32;
        Vec3::new(radius * angle.cos(), 0.0, radius * angle.sin())
    };
    for k in 0..2 * PLEATS {
        b.quad("pleat", corner(k), Vec3::Y, corner(k + 1) - corner(k), white, [2, 2]);
    }
    b.point_light(Vec3::new(0.8, 0.5, 0.8), 1e6);
    let scene = b.finish();
    for seed in 0..8 {
        let options =
            BakeOptions { seed, max_photons: Some(1 << 19), double_sided: DoubleSided::Split, ..plain(256, 0.01) };
        let bake = run(&scene, &options);
        // The lamp is outside: one side of each pleat is lit. The room has six nodes.
        let lit = |back: bool| {
            let of_pleat = |&i: &usize| bake.solution.weights.instance[i] >= 6 && bake.texels.texels[i].back == back;
            let pleats = (0..bake.texels.mapped).filter(of_pleat);
            pleats.filter(|&i| bake.solution.total.mean(i) != Vec3::ZERO).count()
        };
        let (inner, outer) = (lit(true).min(lit(false)), lit(true).max(lit(false)));
        assert!(outer > 400, "{outer} texels");
        assert!(inner <= 2, "seed {seed}: {inner} texels with light inside the screen");
    }
}

/// A cube of 2 m, a lamp of 10 cd in its middle; the first wall turned over where `flipped`.
fn cube(albedo: f32, flipped: bool) -> Scene {
    let mut b = Builder::new(PAGE);
    let wall = b.diffuse(albedo, 0.0);
    b.room(Vec3::ZERO, Vec3::splat(2.0), wall, 8);
    b.point_light(Vec3::ONE, 10.0);
    let mut scene = b.finish();
    if flipped {
        scene.meshes[0].primitives[0].triangles.iter_mut().for_each(|t| t.swap(1, 2));
    }
    scene
}

/// A sixth of the lamp's light meets the flipped wall, whether or not the others reflect any, and what they reflect
/// meets it, too.
#[test]
fn a_flipped_wall_is_found_by_its_light() {
    for albedo in [0.0, 0.5] {
        let scene = cube(albedo, true);
        let bake = run(&scene, &one_round(PAGE));
        let [node] = bake.backs.nodes[..] else { panic!("{:?}", bake.backs.nodes) };
        assert_eq!(node.instance, 0);
        assert!((node.direct - 1.0 / 6.0).abs() < 0.005, "{}", node.direct);
        assert_eq!(node.reflected > 0.0, albedo > 0.0);
        assert_eq!(bake.report.warnings.iter().filter(|w| w.code == "lit-from-behind").count(), 1);
        if albedo == 0.0 {
            // Flux of the sixth of a sphere, over 4 m2.
            let expected = 10.0 * 4.0 * PI / 6.0 / 4.0;
            let mean = (0..bake.world.len()).map(|t| f64::from(bake.backs.irradiance[t])).sum::<f64>() / 2.0;
            assert!((mean / expected - 1.0).abs() < 0.2, "{mean} for {expected}");
        }
    }
}

/// Sun and sky on the outer sides of a room are not at fault, nor is anything where all walls are as they should be.
#[test]
fn a_room_under_the_sun_is_not_lit_from_behind() {
    let mut scene = cube(0.5, false);
    let sun = LightKind::Directional { angular_diameter: 0.0093 };
    let lamp = scene.lights[0].clone();
    scene.lights.push(evenlight::scene::Light { kind: sun, intensity: Vec3::splat(1e5), ..lamp });
    scene.sky = Some(evenlight::scene::Sky::Constant(Vec3::splat(1e4)));
    let bake = run(&scene, &one_round(PAGE));
    assert_eq!((&bake.backs.nodes[..], &bake.backs.irradiance[..]), (&[][..], &[][..]));
}

/// The picture looks at the flipped wall from inside: red in its middle and over much of it, all else is grey.
#[test]
fn a_flipped_wall_is_red_in_the_picture() {
    let scene = cube(0.5, true);
    let bake = run(&scene, &one_round(PAGE));
    let (width, height) = (64, 36);
    let image = render_backs(&bake.world, &|ray| bake.accel.closest(ray), &bake.backs, 0, [width, height]);
    let pixels = image.rgb.as_chunks::<3>().0;
    let red = |p: &[u8; 3]| p[0] > 3 * p[1].max(p[2]);
    let grey = |p: &[u8; 3]| p[0] == p[1] && p[1] == p[2] && p[0] > 60;
    assert!(pixels.iter().all(|p| red(p) || grey(p)), "neither red nor grey");
    assert!(red(&pixels[(height / 2 * width + width / 2) as usize]));
    let share = pixels.iter().filter(|p| red(p)).count() as f64 / pixels.len() as f64;
    assert!((0.2..0.95).contains(&share), "{share}");
}

/// Without a surface that lets light pass, shadow rays look at no material: the same answer. An image that no ray looks at
/// is not decoded, and a light that sends nothing takes no rays.
#[test]
fn what_a_scene_does_not_need_is_skipped() {
    let (scene, mut more) = (cube(0.5, false), cube(0.5, false));
    let said = |lines: &[String], what: &str| lines.iter().find(|s| s.starts_with(what)).cloned();
    let plain = run(&scene, &one_round(PAGE));
    assert_eq!((said(&plain.report.skips, "lights: "), said(&plain.report.skips, "images: ")), (None, None));

    let quick = Visibility::new(&plain.world, &plain.accel);
    let slow = Visibility { some_pass: true, ..quick };
    let mut random = Random::new(3);
    let mut point = || Vec3::from_array([0; 3].map(|_| 1.5 * random.normal() as f32));
    for _ in 0..10_000 {
        let (origin, to) = (point(), point());
        let ray = Ray { origin, direction: to - origin, t_max: 1.0 };
        assert_eq!(quick.transmittance(&ray), slow.transmittance(&ray));
    }

    // A black lamp, and an image on a material that nothing has.
    let black = evenlight::scene::Light { intensity: Vec3::ZERO, ..more.lights[0].clone() };
    more.lights.push(black);
    more.textures.push(Texture::new("unused".into(), [0u8; 4].as_slice().into(), [Wrap::Repeat; 2], false));
    let image = TextureRef { texture: 0, tex_coord: 1, transform: Affine2::IDENTITY };
    more.materials.push(Material { base_color_texture: Some(image), ..Material::default() });
    let with = run(&more, &one_round(PAGE));
    assert!(said(&with.report.skips, "lights: 1 of 2").is_some(), "{:?}", with.report.skips);
    assert!(said(&with.report.skips, "images: 1 of 1").is_some(), "{:?}", with.report.skips);
    assert_eq!(with.report.work.direct_rays, plain.report.work.direct_rays);
    assert_eq!(with.lightmap.pages[0].irradiance, plain.lightmap.pages[0].irradiance);
}
