//! The layout of lightmaps: no overlap, gutters kept, everything that has an area has a place, whatever comes
//! in.

use evenlight::atlas::unwrap::{
    self, JoinedMesh, Limits, UnwrapError, UnwrapInput, Unwrapped, UnwrappedVertex, Unwrapper as _,
};
use evenlight::atlas::{Atlas, NO_CHART, XatlasWorker, build, check};
use evenlight::options::{BakeOptions, Density, Unwrapper, UvSource};
use evenlight::scene::{Instance, Material, Mesh, Primitive, Scene, TriangleRef, gltf};
use evenlight::{BakeError, Warning};
use glam::{DAffine3, DMat3, DVec2, DVec3, Vec2, Vec3, Vec4};
use std::collections::HashMap;
use std::f64::consts::TAU;
use std::time::{Duration, Instant};

// ---------------------------------------------------------------------------------------------------------
// Scenes

type Triangles = (Vec<Vec3>, Vec<[u32; 3]>);

fn scene(meshes: Vec<Triangles>, instances: Vec<(usize, DAffine3)>) -> Scene {
    Scene {
        name: "test".into(),
        meshes: meshes
            .into_iter()
            .enumerate()
            .map(|(source, (positions, triangles))| Mesh {
                name: format!("mesh {source}"),
                source,
                primitives: vec![Primitive { positions, triangles, ..Primitive::default() }],
            })
            .collect(),
        instances: instances
            .into_iter()
            .enumerate()
            .map(|(node, (mesh, world_from_object))| Instance {
                node,
                name: format!("thing {node}"),
                mesh,
                world_from_object,
                weight: 1.0,
                density: 1.0,
                bake: true,
                casts: true,
            })
            .collect(),
        materials: vec![Material::default()],
        textures: vec![],
        lights: vec![],
        cameras: vec![],
        sky: None,
        warnings: vec![],
        changed: vec![],
        source: gltf::Document::default(),
    }
}

fn single(mesh: Triangles) -> Scene {
    scene(vec![mesh], vec![(0, DAffine3::IDENTITY)])
}

/// A box from `lo` with the given size, six faces with corners of their own.
fn cuboid(lo: Vec3, size: Vec3) -> Triangles {
    let (mut positions, mut triangles) = (vec![], vec![]);
    for axis in 0..3 {
        for side in [0.0, 1.0] {
            let first = positions.len() as u32;
            for (u, v) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
                let mut p = [0.0; 3];
                (p[axis], p[(axis + 1) % 3], p[(axis + 2) % 3]) = (side, u, v);
                positions.push(lo + size * Vec3::from(p));
            }
            let faces = if side > 0.0 { [[0, 1, 2], [0, 2, 3]] } else { [[0, 2, 1], [0, 3, 2]] };
            triangles.extend(faces.map(|t| t.map(|v| v + first)));
        }
    }
    (positions, triangles)
}

fn joined(parts: impl IntoIterator<Item = Triangles>) -> Triangles {
    let (mut positions, mut triangles) = (vec![], vec![]);
    for (p, t) in parts {
        let first = positions.len() as u32;
        positions.extend(p);
        triangles.extend(t.into_iter().map(|t| t.map(|v| v + first)));
    }
    (positions, triangles)
}

/// Numbers in [0, 1) from a counter: a hash, so that scenes look random and never change.
fn random(i: usize) -> f32 {
    let mut x = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    x = (x ^ x >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ x >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((x ^ x >> 31) >> 40) as f32 / (1u64 << 24) as f32
}

fn random_point(i: usize) -> Vec3 {
    Vec3::new(random(3 * i), random(3 * i + 1), random(3 * i + 2))
}

fn box_soup(count: usize) -> Triangles {
    joined((0..count).map(|i| cuboid(random_point(2 * i) * 100.0, random_point(2 * i + 1) * 2.0 + 0.1)))
}

/// A grid of (n + 1) x (m + 1) points by `f` of (0..1, 0..1).
fn grid(n: u32, m: u32, f: impl Fn(f64, f64) -> DVec3) -> Triangles {
    let at = |x: u32, y: u32| y * (n + 1) + x;
    let positions = (0..=m)
        .flat_map(|y| (0..=n).map(move |x| (x, y)))
        .map(|(x, y)| f(f64::from(x) / f64::from(n), f64::from(y) / f64::from(m)).as_vec3())
        .collect();
    let triangles = (0..m)
        .flat_map(|y| (0..n).map(move |x| (x, y)))
        .flat_map(|(x, y)| [[at(x, y), at(x + 1, y), at(x + 1, y + 1)], [at(x, y), at(x + 1, y + 1), at(x, y + 1)]])
        .collect();
    (positions, triangles)
}

fn sphere(n: u32) -> Triangles {
    grid(2 * n, n, |u, v| {
        let (s, c) = (v * TAU / 2.0).sin_cos();
        DVec3::new(s * (u * TAU).cos(), c, s * (u * TAU).sin())
    })
}

fn terrain(n: u32) -> Triangles {
    grid(n, n, |u, v| {
        DVec3::new(u * 100.0, 4.0 * (u * 17.0).sin() * (v * 13.0).cos() + (u * 71.0 + v * 53.0).sin(), v * 100.0)
    })
}

/// A flat strip, 5000 times as long as wide.
fn strip() -> Triangles {
    grid(500, 1, |u, v| DVec3::new(u * 500.0, 0.0, v * 0.1))
}

fn needles(count: usize) -> Triangles {
    let positions = (0..count)
        .flat_map(|i| {
            let p = random_point(i) * 10.0;
            [p, p + random_point(i + count), p + random_point(i + count) * 1.000_001]
        })
        .collect();
    (positions, (0..count as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect())
}

fn triangle_soup(count: usize) -> Triangles {
    let positions = (0..3 * count).map(|i| random_point(i / 3) * 10.0 + random_point(i + 7919)).collect();
    (positions, (0..count as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect())
}

/// The same faces three times, and collapsed ones among them.
fn duplicates() -> Triangles {
    let (positions, triangles) = sphere(12);
    let degenerate = [[0, 0, 0], [1, 1, 2], [5, 6, 5]];
    let all = triangles.iter().chain(&triangles).chain(&triangles).copied().chain(degenerate).collect();
    (positions, all)
}

fn options(side: u32) -> BakeOptions {
    BakeOptions { max_texture: side, ..BakeOptions::default() }
}

fn atlas(scene: &Scene, options: &BakeOptions) -> Atlas {
    build(scene, options, &|| false).unwrap_or_else(|e| panic!("{e}"))
}

// ---------------------------------------------------------------------------------------------------------
// Checks

fn refs(scene: &Scene) -> impl Iterator<Item = TriangleRef> {
    scene.instances.iter().enumerate().flat_map(|(i, instance)| {
        scene.meshes[instance.mesh].primitives.iter().enumerate().flat_map(move |(p, primitive)| {
            (0..primitive.triangles.len()).map(move |k| TriangleRef {
                instance: i as u32,
                primitive: p as u32,
                index: k as u32,
            })
        })
    })
}

fn world_area(scene: &Scene, r: TriangleRef) -> f64 {
    let instance = &scene.instances[r.instance as usize];
    let p = &scene.meshes[instance.mesh].primitives[r.primitive as usize];
    let m = instance.world_from_object.matrix3;
    let c = p.triangles[r.index as usize].map(|v| m * p.positions[v as usize].as_dvec3());
    0.5 * (c[1] - c[0]).cross(c[2] - c[0]).length()
}

/// What every layout must keep. Returns the share of the pages that charts cover.
fn verify(scene: &Scene, atlas: &Atlas, options: &BakeOptions) -> f64 {
    let grown = options.gutter.div_ceil(2) as i64;
    for (mesh, layout) in scene.meshes.iter().zip(&atlas.meshes) {
        let Some(layout) = layout else { continue };
        for (p, l) in mesh.primitives.iter().zip(&layout.primitives) {
            let n = p.positions.len() as u32;
            assert!(l.source_vertices.iter().take(n as usize).copied().eq(0..n), "source vertices come first");
            assert_eq!(l.source_vertices.len(), l.uvs.len());
            assert_eq!(l.triangles.len(), p.triangles.len());
            for (t, s) in l.triangles.iter().zip(&p.triangles) {
                assert_eq!(t.map(|v| l.source_vertices[v as usize]), *s, "triangles are those of the source");
            }
            assert!(l.uvs.iter().all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0));
            assert!(l.charts.iter().all(|&c| c < layout.chart_count || c == NO_CHART));
        }
    }
    assert_eq!(atlas.first_chart.len(), scene.instances.len() + 1);
    // The footprint of each chart, grown by half the gutter, is its own and stays on the page.
    let mut owner: Vec<Vec<u32>> =
        atlas.pages.iter().map(|p| vec![u32::MAX; p.width as usize * p.height as usize]).collect();
    let mut plane: Vec<Vec<[DVec2; 3]>> = vec![vec![]; atlas.pages.len()];
    let mut footprints: HashMap<(u32, u32), Vec<(i64, i64)>> = HashMap::new();
    let mut covered = 0.0;
    for r in refs(scene) {
        let Some((page, at, chart)) = atlas.texel_coordinates(scene, r) else { continue };
        let t = at.map(|p| p.as_dvec2());
        covered += check::signed_area(&t).abs();
        plane[page as usize].push(t);
        footprints.entry((page, chart)).or_default().extend(texels_of(&t));
    }
    let mut charts: Vec<_> = footprints.into_iter().collect();
    charts.sort_unstable_by_key(|(k, _)| *k);
    for ((page, chart), mut texels) in charts {
        texels.sort_unstable();
        texels.dedup();
        let size = atlas.pages[page as usize];
        for (x, y) in texels {
            for (dx, dy) in (-grown..=grown).flat_map(|dx| (-grown..=grown).map(move |dy| (dx, dy))) {
                let (x, y) = (x + dx, y + dy);
                let inside = (0..i64::from(size.width)).contains(&x) && (0..i64::from(size.height)).contains(&y);
                // A page cropped to its charts may be rounded up, never cut into the gutter.
                assert!(inside, "chart {chart} reaches ({x}, {y}) of page {page}, {size:?}");
                let texel = &mut owner[page as usize][y as usize * size.width as usize + x as usize];
                assert!(*texel == u32::MAX || *texel == chart, "charts {} and {chart} meet at ({x}, {y})", *texel);
                *texel = chart;
            }
        }
    }
    for triangles in &plane {
        assert_eq!(check::find_overlaps(triangles, 0.02, 3), [], "triangles overlap");
    }
    covered / atlas.pages.iter().map(|p| f64::from(p.width) * f64::from(p.height)).sum::<f64>()
}

/// Texels whose inside a triangle touches by more than the rounding of f32.
fn texels_of(t: &[DVec2; 3]) -> Vec<(i64, i64)> {
    const EPS: f64 = 1e-3;
    let (lo, hi) = (t[0].min(t[1]).min(t[2]), t[0].max(t[1]).max(t[2]));
    // Empty for slivers thinner than the rounding: they may lie on either side of a texel's edge.
    let range = |a: f64, b: f64| (a + EPS).floor() as i64..(b - EPS).ceil() as i64;
    let mut texels = vec![];
    for y in range(lo.y, hi.y) {
        // Clip to the row.
        let (y0, y1) = (y as f64, y as f64 + 1.0);
        let (mut x0, mut x1) = (f64::INFINITY, f64::NEG_INFINITY);
        for k in 0..3 {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            let (a, b) = if a.y < b.y { (a, b) } else { (b, a) };
            if b.y < y0 || a.y > y1 {
                continue;
            }
            for y in [y0.max(a.y), y1.min(b.y)] {
                let x = if b.y > a.y { a.x + (b.x - a.x) * (y - a.y) / (b.y - a.y) } else { a.x };
                (x0, x1) = (x0.min(x), x1.max(x));
            }
        }
        if x0 <= x1 {
            texels.extend(range(x0, x1).map(|x| (x, y)));
        }
    }
    texels
}

/// Every triangle with an area has a chart, and areas inside a chart differ by less than `bound`.
fn verify_complete(scene: &Scene, atlas: &Atlas, bound: f64) {
    let mut charts: HashMap<u32, Vec<(f64, f64)>> = HashMap::new();
    for r in refs(scene) {
        let area = world_area(scene, r);
        let placed = atlas.texel_coordinates(scene, r);
        assert!(placed.is_some() || area < 1e-12, "{r:?} of area {area} has no chart");
        if let Some((_, at, chart)) = placed {
            charts.entry(chart).or_default().push((area, check::signed_area(&at.map(|p| p.as_dvec2())).abs()));
        }
    }
    for (chart, t) in charts {
        let (surface, texels) = t.iter().fold((0.0, 0.0), |s, t| (s.0 + t.0, s.1 + t.1));
        for (a, b) in &t {
            let ratio = (b / texels) / (a / surface);
            // Below a hundredth of a texel the rounding of f32 coordinates shows.
            assert!(texels < 1.0 || *b < 0.01 || (1.0 / bound..bound).contains(&ratio), "chart {chart}: {ratio}");
        }
    }
}

fn has(warnings: &[Warning], code: &str) -> bool {
    warnings.iter().any(|w| w.code == code)
}

// ---------------------------------------------------------------------------------------------------------
// Tests

#[test]
fn generated_meshes_keep_their_gutters() {
    for (name, mesh, side, least) in [
        ("box", cuboid(Vec3::ZERO, Vec3::ONE), 512, 0.6),
        ("boxes", box_soup(60), 1024, 0.55),
        ("sphere", sphere(40), 512, 0.45),
        ("terrain", terrain(60), 512, 0.5),
        ("strip", strip(), 256, 0.0),
        ("needles", needles(100), 512, 0.0),
        ("soup", triangle_soup(400), 1024, 0.3),
    ] {
        let scene = single(mesh);
        let options = options(side);
        let atlas = atlas(&scene, &options);
        let share = verify(&scene, &atlas, &options);
        println!("{name}: {:?}, {:.0} %, {:?}", atlas.pages, share * 100.0, atlas.warnings);
        assert_eq!(atlas.pages.len(), 1, "{name}");
        assert!(share >= least, "{name}: {share}");
        verify_complete(&scene, &atlas, 10.0);
    }
}

#[test]
fn gutters_and_page_sizes_are_kept() {
    for (gutter, side) in [(0, 256), (1, 256), (3, 300), (8, 512), (4, 2048), (4, 4096)] {
        let scene = single(joined([box_soup(20), sphere(10), strip()]));
        let options = BakeOptions { gutter, ..options(side) };
        verify(&scene, &atlas(&scene, &options), &options);
    }
}

#[test]
fn duplicate_and_degenerate_faces_are_laid_out_and_named() {
    let scene = single(duplicates());
    let options = options(512);
    let atlas = atlas(&scene, &options);
    verify(&scene, &atlas, &options);
    verify_complete(&scene, &atlas, 10.0);
    assert!(has(&atlas.warnings, "degenerate-triangles"), "{:?}", atlas.warnings);
}

#[test]
fn broken_coordinates_give_warnings() {
    for bad in [f32::NAN, f32::INFINITY, 1e18, 3e38, 1e-30] {
        let (mut positions, triangles) = joined([cuboid(Vec3::ZERO, Vec3::ONE), sphere(6)]);
        positions[3].x = bad;
        positions[40].y = -bad;
        let scene = single((positions, triangles));
        let options = options(128);
        let atlas = atlas(&scene, &options);
        verify(&scene, &atlas, &options);
        if !bad.is_finite() {
            assert!(has(&atlas.warnings, "non-finite-triangles"), "{:?}", atlas.warnings);
        }
    }
}

#[test]
fn far_and_tiny_and_squashed_nodes() {
    let far = DAffine3::from_translation(DVec3::splat(1e7));
    let tiny = DAffine3::from_scale(DVec3::splat(1e-9));
    let squashed = DAffine3::from_scale(DVec3::new(1.0, 0.0, 1.0));
    let broken = DAffine3::from_scale(DVec3::new(f64::NAN, 0.0, 1.0));
    for at in [far, tiny, squashed] {
        let scene = scene(vec![cuboid(Vec3::ZERO, Vec3::ONE)], vec![(0, at)]);
        let options = options(128);
        verify(&scene, &atlas(&scene, &options), &options);
    }
    let scene = scene(vec![cuboid(Vec3::ZERO, Vec3::ONE)], vec![(0, broken)]);
    assert!(matches!(build(&scene, &options(128), &|| false), Err(BakeError::Nothing(_))));
}

#[test]
fn instances_share_uvs_in_rectangles_of_their_own() {
    let at = |x: f64, scale: f64| {
        DAffine3::from_mat3_translation(DMat3::from_diagonal(DVec3::splat(scale)), DVec3::new(x, 0.0, 0.0))
    };
    let places =
        vec![(0, at(0.0, 1.0)), (0, at(5.0, 2.0)), (1, at(10.0, 1.0)), (0, at(20.0, 0.5)), (0, at(30.0, -0.7))];
    let scene = scene(vec![joined([cuboid(Vec3::ZERO, Vec3::ONE), sphere(8)]), terrain(20)], places);
    for density in [Density::Auto, Density::TexelsPerMetre(7.3)] {
        let options = BakeOptions { density, ..options(1024) };
        let atlas = atlas(&scene, &options);
        verify(&scene, &atlas, &options);
        verify_complete(&scene, &atlas, 10.0);
        let sizes: Vec<f32> = [1, 0, 3].map(|i| atlas.placements[i].expect("baked").size.x).into();
        assert!((sizes[0] / sizes[1] - 2.0).abs() < 0.2 && (sizes[1] / sizes[2] - 2.0).abs() < 0.2, "{sizes:?}");
        let whole = atlas.placements[2].expect("baked");
        assert_eq!((whole.origin, whole.size.x), (Vec2::ZERO, atlas.pages[whole.page as usize].width as f32));
    }
}

#[test]
fn a_fixed_density_takes_the_pages_it_needs() {
    let meshes: Vec<_> = (0..12).map(|i| cuboid(Vec3::ZERO, Vec3::splat(1.0 + i as f32 * 0.1))).collect();
    let places = (0..12).map(|i| (i, DAffine3::from_translation(DVec3::new(3.0 * i as f64, 0.0, 0.0)))).collect();
    let scene = scene(meshes, places);
    let mut options = BakeOptions { density: Density::TexelsPerMetre(60.0), ..options(512) };
    let several = atlas(&scene, &options);
    assert!(several.pages.len() > 2, "{:?}", several.pages);
    verify(&scene, &several, &options);
    let texels: f64 = refs(&scene)
        .filter_map(|r| several.texel_coordinates(&scene, r))
        .map(|(_, t, _)| check::signed_area(&t.map(|p| p.as_dvec2())).abs())
        .sum();
    let surface: f64 = refs(&scene).map(|r| world_area(&scene, r)).sum();
    assert!(((texels / surface).sqrt() / 60.0 - 1.0).abs() < 0.01);

    options.max_pages = 2;
    let error = build(&scene, &options, &|| false).expect_err("two pages do not suffice").to_string();
    assert!(error.contains("--max-pages") && error.contains("--density"), "{error}");

    // Little surface takes a small page.
    options.density = Density::TexelsPerMetre(5.0);
    assert_eq!(atlas(&scene, &options).pages.iter().map(|p| p.width).collect::<Vec<_>>(), [128]);
}

#[test]
fn what_is_larger_than_a_page_is_scaled_down() {
    let scene = single(strip());
    let options = BakeOptions { density: Density::TexelsPerMetre(10.0), ..options(256) };
    let atlas = atlas(&scene, &options);
    verify(&scene, &atlas, &options);
    let warning = atlas.warnings.iter().find(|w| w.code == "chart-larger-than-page").expect("a warning");
    assert!(warning.message.contains("thing 0"), "{}", warning.message);
}

#[test]
fn more_charts_than_texels_is_a_clear_error() {
    let scene = single(triangle_soup(5000));
    let options = BakeOptions { max_pages: 1, ..options(128) };
    let start = Instant::now();
    let error = build(&scene, &options, &|| false).expect_err("they cannot fit").to_string();
    assert!(start.elapsed() < Duration::from_secs(5), "it took {:?} to say so", start.elapsed());
    assert!(error.contains("--max-texture"), "{error}");
}

/// 60,000 triangles on 16,384 texels. Six cones of 60 degrees would cover a sphere, greedy ones take more.
#[test]
fn what_is_finer_than_its_texels_is_projected() {
    let scene = single(sphere(122));
    let options = options(128);
    let atlas = atlas(&scene, &options);
    assert!(verify(&scene, &atlas, &options) > 0.45);
    verify_complete(&scene, &atlas, 2.5);
    assert!(atlas.first_chart[1] <= 12, "{} charts", atlas.first_chart[1]);
}

#[test]
fn a_time_limit_ends_the_unwrapping_but_not_the_bake() {
    let scene = single(joined([sphere(40), box_soup(60)]));
    let options = BakeOptions { time_limit: Some(1e-6), ..options(1024) };
    let atlas = atlas(&scene, &options);
    assert!(has(&atlas.warnings, "unwrap-time-limit"), "{:?}", atlas.warnings);
    assert!(verify(&scene, &atlas, &options) > 0.3);
    verify_complete(&scene, &atlas, 10.0);
}

#[test]
fn whoever_cancels_gets_no_atlas() {
    let scene = single(joined([sphere(40), box_soup(60)]));
    for after in [0, 1, 3] {
        let asked = std::sync::atomic::AtomicU32::new(0);
        let cancelled = || asked.fetch_add(1, std::sync::atomic::Ordering::Relaxed) >= after;
        let answer = build(&scene, &options(512), &cancelled);
        assert!(matches!(answer, Err(BakeError::Cancelled)), "after {after} questions: {answer:?}");
    }
}

#[test]
fn selection() {
    let mut s = scene(vec![cuboid(Vec3::ZERO, Vec3::ONE)], vec![(0, DAffine3::IDENTITY); 3]);
    s.instances[2].bake = false;
    let mut options = options(128);
    options.exclude = vec!["thing 0".into()];
    let placed = |a: &Atlas| a.placements.iter().map(Option::is_some).collect::<Vec<_>>();
    assert_eq!(placed(&atlas(&s, &options)), [false, true, false]);
    options.only = vec!["thing 0".into()];
    assert!(matches!(build(&s, &options, &|| false), Err(BakeError::Nothing(_))));
    options.only = vec!["thnig 1".into()];
    let error = build(&s, &options, &|| false).expect_err("a wrong name").to_string();
    assert!(error.contains("thnig 1") && error.contains("`thing 1`"), "{error}");
    options = BakeOptions { max_texture: 3, ..BakeOptions::default() };
    assert!(matches!(build(&s, &options, &|| false), Err(BakeError::Options(_))));
    options = BakeOptions { density: Density::TexelsPerMetre(f64::NAN), ..BakeOptions::default() };
    assert!(matches!(build(&s, &options, &|| false), Err(BakeError::Options(_))));
    assert!(matches!(build(&s, &BakeOptions::default(), &|| true), Err(BakeError::Cancelled)));
}

/// Nobody would see a map on a mirror: it gets none, unless it is asked for or nothing else is there.
#[test]
fn what_shows_no_diffuse_light_gets_no_map() {
    let mut s = scene(
        vec![cuboid(Vec3::ZERO, Vec3::ONE), cuboid(Vec3::ZERO, Vec3::ONE)],
        vec![(0, DAffine3::IDENTITY), (1, DAffine3::IDENTITY)],
    );
    let placed = |s: &Scene, o: &BakeOptions| {
        let a = atlas(s, o);
        (a.placements.iter().map(Option::is_some).collect::<Vec<_>>(), a.unseen)
    };
    for unseen in [
        Material { metallic: 1.0, ..Material::default() },
        Material { transmission: 1.0, ..Material::default() },
        Material { base_color: Vec4::W, ..Material::default() },
    ] {
        s.materials = vec![Material::default(), unseen];
        s.meshes[1].primitives[0].material = 1;
        assert_eq!(placed(&s, &options(128)), (vec![true, false], vec![1]));
        let only = BakeOptions { only: vec!["thing 1".into()], ..options(128) };
        assert_eq!(placed(&s, &only), (vec![false, true], vec![]));
        s.meshes[0].primitives[0].material = 1;
        assert_eq!(placed(&s, &options(128)), (vec![true, true], vec![]));
        s.meshes[0].primitives[0].material = 0;
    }
    // Half a metal shows half of it.
    s.materials[1] = Material { metallic: 0.5, ..Material::default() };
    assert_eq!(placed(&s, &options(128)), (vec![true, true], vec![]));
}

#[test]
fn threads_change_nothing() {
    let scene = scene(
        vec![joined([sphere(20), box_soup(50), needles(20)]), terrain(30)],
        vec![(0, DAffine3::IDENTITY), (1, DAffine3::IDENTITY), (1, DAffine3::from_scale(DVec3::splat(0.5)))],
    );
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        format!("{:?}", pool.install(|| atlas(&scene, &options(512))))
    };
    assert!(on(1) == on(2), "the atlas depends on the number of threads");
}

// ---------------------------------------------------------------------------------------------------------
// xatlas

fn with_xatlas(side: u32) -> BakeOptions {
    let worker = env!("CARGO_BIN_EXE_evenlight").into();
    BakeOptions { unwrapper: Unwrapper::Xatlas { worker }, ..options(side) }
}

#[cfg(feature = "xatlas")]
#[test]
fn xatlas_unwraps_in_a_child_process() {
    let scene = single(joined([box_soup(40), sphere(16), terrain(20)]));
    let options = with_xatlas(512);
    let atlas = atlas(&scene, &options);
    let share = verify(&scene, &atlas, &options);
    println!("xatlas: {:.0} %, {:?}", share * 100.0, atlas.warnings);
    verify_complete(&scene, &atlas, 10.0);
    assert!(!atlas.warnings.iter().any(|w| w.code.starts_with("unwrapper-")), "{:?}", atlas.warnings);
}

#[cfg(not(feature = "xatlas"))]
#[test]
fn a_worker_without_xatlas_says_how_to_get_it() {
    let scene = single(cuboid(Vec3::ZERO, Vec3::ONE));
    let error = build(&scene, &with_xatlas(128), &|| false).expect_err("not built in").to_string();
    assert!(error.contains("--features xatlas"), "{error}");
}

#[test]
fn a_worker_that_hangs_or_lies_is_worked_around() {
    let mesh =
        UnwrapInput { positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y], triangles: vec![[0, 1, 2]], groups: vec![0] };
    let ask = |program: &str, seconds| {
        let limits = Limits { time: Duration::from_secs(seconds), deadline: None, cancelled: &|| false };
        XatlasWorker::new(program.into()).unwrap(&mesh, limits)
    };
    assert!(matches!(ask("/nowhere/evenlight", 1), Err(UnwrapError::Unavailable(_))));
    if cfg!(unix) {
        // `yes` talks for ever, `true` says nothing, `false` fails.
        assert_eq!(ask("yes", 1), Err(UnwrapError::TimedOut(1)));
        assert!(matches!(ask("true", 9), Err(UnwrapError::Failed(_))));
        assert!(matches!(ask("false", 9), Err(UnwrapError::Crashed(_))));
    }
}

/// Fails in a way of its own on every mesh of more than 300 triangles, and lies about the others.
struct Unreliable;

impl unwrap::Unwrapper for Unreliable {
    fn unwrap(&self, mesh: &UnwrapInput, _: Limits<'_>) -> Result<Unwrapped, UnwrapError> {
        match mesh.triangles.len() {
            n if n > 1500 => Err(UnwrapError::TimedOut(1)),
            n if n > 300 => Err(UnwrapError::Crashed("by design".into())),
            n => {
                // Everything in one chart, projected on a plane: full of overlaps.
                let vertices = mesh.positions.iter().enumerate();
                let vertices = vertices.map(|(i, p)| UnwrappedVertex { source: i as u32, uv: p.truncate().as_dvec2() });
                let (vertices, triangles) = (vertices.collect(), mesh.triangles.clone());
                Ok(Unwrapped { vertices, triangles, charts: vec![0; n], chart_count: 1 })
            }
        }
    }
}

#[test]
fn every_failure_of_an_unwrapper_is_worked_around() {
    let (positions, triangles) = sphere(24);
    let count = triangles.len();
    let mesh = JoinedMesh {
        name: "sphere".into(),
        positions: positions.iter().map(|p| p.as_dvec3()).collect(),
        triangles,
        groups: vec![0; count],
        texels_per_metre: f64::INFINITY,
    };
    let limits = Limits { time: Duration::from_secs(9), deadline: None, cancelled: &|| false };
    let (unwrapped, warnings) = unwrap::unwrap_mesh(&mesh, &Unreliable, limits).expect("a way around");
    assert!(has(&warnings, "unwrapper-timed-out") && has(&warnings, "unwrapper-faulty"), "{warnings:?}");
    let mut charts = vec![vec![]; unwrapped.chart_count as usize];
    for (k, t) in unwrapped.triangles.iter().enumerate() {
        let c = mesh.triangles[k].map(|v| mesh.positions[v as usize]);
        let area = (c[1] - c[0]).cross(c[2] - c[0]).length();
        assert!(unwrapped.charts[k] != NO_CHART || area < 1e-12);
        if unwrapped.charts[k] != NO_CHART {
            charts[unwrapped.charts[k] as usize].push(t.map(|v| unwrapped.vertices[v as usize].uv));
        }
    }
    assert!(charts.iter().all(|c| check::find_overlaps(c, 1e-6, 1).is_empty()));
}

// ---------------------------------------------------------------------------------------------------------
// Real scenes

/// Scenes that are not part of the repository, next to it or where the environment says.
fn shared(name: &str) -> Option<std::path::PathBuf> {
    let beside = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared");
    let root = std::env::var_os("EVENLIGHT_SHARED").unwrap_or_else(|| beside.into());
    let path = std::path::Path::new(&root).join("scenes").join(name);
    let there = path.exists();
    if !there {
        println!("skipped: {} is not there", path.display());
    }
    there.then_some(path)
}

#[test]
fn real_scenes_are_laid_out() {
    for name in ["veach-ajar.glb", "modern-hall.glb", "map-complex.glb"] {
        let Some(path) = shared(name) else { continue };
        let scene = Scene::from_gltf(&path).unwrap_or_else(|e| panic!("{e}"));
        let options = options(2048);
        let start = Instant::now();
        let atlas = atlas(&scene, &options);
        let took = start.elapsed();
        let share = verify(&scene, &atlas, &options);
        println!(
            "{name}: {} triangles, {} instances, {:?} charts, {took:.2?}, {:?}, {:.1} %, {:.2} texels/m",
            scene.triangle_count(),
            scene.instances.len(),
            atlas.first_chart.last(),
            atlas.pages,
            share * 100.0,
            atlas.texels_per_metre
        );
        for w in &atlas.warnings {
            println!("  {}: {}", w.code, w.message);
        }
    }
}

// ---------------------------------------------------------------------------------------------------------
// Kept UVs

fn with_uvs(mut scene: Scene, f: impl Fn(Vec3) -> Vec2) -> Scene {
    for p in scene.meshes.iter_mut().flat_map(|m| &mut m.primitives) {
        p.tex_coords = vec![vec![], p.positions.iter().map(|&v| f(v)).collect()];
    }
    scene
}

#[test]
fn kept_uvs_are_taken_as_they_are() {
    let options = BakeOptions { uv: UvSource::Keep, ..options(256) };
    let flat = |x: f64| grid(4, 4, move |u, v| DVec3::new(x + u, 0.0, v));
    let pair = || scene(vec![flat(0.0), flat(1.0)], vec![(0, DAffine3::IDENTITY), (1, DAffine3::IDENTITY)]);
    let good = with_uvs(pair(), |p| Vec2::new(p.x * 0.5, p.z));
    let kept = atlas(&good, &options);
    assert_eq!((kept.pages[0].width, kept.pages[0].height), (256, 256));
    assert_eq!(kept.first_chart, [0, 1, 2]);
    assert!((kept.texels_per_metre - 181.0).abs() < 1.0, "{}", kept.texels_per_metre);

    let fails = |scene: &Scene| match build(scene, &options, &|| false) {
        Err(BakeError::Uv(message)) => message,
        other => panic!("{other:?}"),
    };
    let crossed = scene(vec![flat(0.0), flat(0.6)], vec![(0, DAffine3::IDENTITY), (1, DAffine3::IDENTITY)]);
    let overlap = fails(&with_uvs(crossed, |p| Vec2::new(p.x * 0.5, p.z)));
    assert!(overlap.contains("thing 0") && overlap.contains("thing 1"), "{overlap}");
    let outside = fails(&with_uvs(pair(), |p| Vec2::new(p.x * 0.6, p.z)));
    assert!(outside.contains("thing 1") && outside.contains("outside"), "{outside}");
    let missing = fails(&pair());
    assert!(missing.contains("TEXCOORD_1") && missing.contains("--uv generate"), "{missing}");
    fails(&with_uvs(pair(), |_| Vec2::NAN));
}

// ---------------------------------------------------------------------------------------------------------
// Sizes of real use

#[test]
#[ignore = "measures; run with --release --ignored --nocapture"]
fn measure() {
    for (name, mesh) in [
        ("10,000 boxes", box_soup(10_000)),
        ("1,700 boxes", box_soup(1_700)),
        ("sphere of 100,000", sphere(160)),
        ("terrain of 100,000", terrain(224)),
        ("terrain of 1,000,000", terrain(707)),
    ] {
        let scene = single(mesh);
        for side in [2048, 4096] {
            let options = options(side);
            let start = Instant::now();
            let atlas = atlas(&scene, &options);
            let took = start.elapsed();
            let share = verify(&scene, &atlas, &options);
            let charts = atlas.first_chart.last();
            println!(
                "{name}: {} triangles, {charts:?} charts, {side}: {took:.2?}, {} pages, {:.1} %, {:.2} texels/m, {:?}",
                scene.triangle_count(),
                atlas.pages.len(),
                share * 100.0,
                atlas.texels_per_metre,
                atlas.warnings
            );
        }
    }
    let (positions, triangles) = terrain(707);
    let plane: Vec<[DVec2; 3]> = triangles
        .iter()
        .map(|t| t.map(|v| positions[v as usize]).map(|p| DVec2::new(f64::from(p.x), f64::from(p.z))))
        .collect();
    let start = Instant::now();
    assert_eq!(check::find_overlaps(&plane, 1e-6, 1), []);
    println!("check of {} triangles: {:.2?}", plane.len(), start.elapsed());
}
