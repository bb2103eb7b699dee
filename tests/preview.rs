//! Pictures of small scenes, whose pixels can be told beforehand.

use evenlight::Scene;
use evenlight::accel::Accel;
use evenlight::atlas::{Atlas, MeshLayout, Page, Placement, PrimitiveLayout};
use evenlight::lightmap::{Lightmap, LightmapPage};
use evenlight::output::preview::{RenderSettings, RgbImage, choose_camera, render};
use evenlight::scene::gltf::Document;
use evenlight::scene::{Alpha, Camera, Instance, Material, Mesh, Primitive, Projection, Sky, SurfaceFlags, World};
use glam::{DAffine3, DVec3, Vec2, Vec3, Vec4};

/// A square of the given corners in its own mesh.
fn square(corners: [Vec3; 4], material: usize) -> Mesh {
    let primitive = Primitive {
        positions: corners.to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        material,
        ..Default::default()
    };
    Mesh { name: "square".into(), source: 0, primitives: vec![primitive] }
}

/// A square facing +Z at depth `z`, from -`half` to `half`.
fn facing(z: f32, half: f32, material: usize) -> Mesh {
    let corner = |x: f32, y: f32| Vec3::new(x * half, y * half, z);
    square([corner(-1., -1.), corner(1., -1.), corner(1., 1.), corner(-1., 1.)], material)
}

/// The inside of a box, one square per wall.
fn room(size: Vec3) -> Vec<Mesh> {
    let c = |i: usize| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) * size;
    let walls = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 2, 6, 4], [1, 5, 7, 3], [0, 4, 5, 1], [2, 3, 7, 6]];
    walls.map(|w| square(w.map(c), 0)).into()
}

fn scene(meshes: Vec<Mesh>, materials: Vec<Material>) -> Scene {
    let instance = |mesh: usize| Instance {
        node: mesh,
        name: format!("node {mesh}"),
        mesh,
        world_from_object: DAffine3::IDENTITY,
        weight: 1.0,
        density: 1.0,
        bake: true,
        casts: true,
    };
    Scene {
        name: "test".into(),
        instances: (0..meshes.len()).map(instance).collect(),
        meshes,
        materials,
        textures: Vec::new(),
        lights: Vec::new(),
        cameras: Vec::new(),
        sky: None,
        warnings: Vec::new(),
        changed: Vec::new(),
        source: Document::default(),
    }
}

/// One texel per square, side by side.
fn atlas(scene: &Scene) -> Atlas {
    let n = scene.instances.len();
    let layout = PrimitiveLayout {
        source_vertices: vec![0, 1, 2, 3],
        uvs: vec![Vec2::splat(0.5); 4],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        charts: vec![0, 0],
    };
    let mesh = MeshLayout { primitives: vec![layout], chart_count: 1 };
    let place = |i: usize| Placement { page: 0, origin: Vec2::new(i as f32, 0.0), size: Vec2::ONE };
    Atlas {
        pages: vec![Page { width: n as u32, height: 1 }],
        meshes: vec![Some(mesh); n],
        placements: (0..n).map(|i| Some(place(i))).collect(),
        first_chart: (0..=n as u32).collect(),
        ..Default::default()
    }
}

fn lightmap(irradiance: &[f32]) -> Lightmap {
    let page = LightmapPage {
        width: irradiance.len() as u32,
        height: 1,
        irradiance: irradiance.iter().map(|&e| [e; 3]).collect(),
        area: vec![1.0; irradiance.len()],
        coverage: vec![1.0; irradiance.len()],
        ..Default::default()
    };
    Lightmap { pages: vec![page] }
}

fn picture(scene: &Scene, irradiance: &[f32], camera: &Camera, settings: &RenderSettings) -> RgbImage {
    let world = World::new(scene);
    let accel = Accel::build(&world.positions, |t| world.flags[t as usize].has(SurfaceFlags::DEGENERATE));
    render(
        &world,
        &|ray| accel.closest(ray),
        &atlas(scene),
        &lightmap(irradiance),
        camera,
        scene.sky.as_ref(),
        settings,
    )
}

/// Looks along -Z from z = 4; the squares above fill the middle.
fn camera() -> Camera {
    Camera {
        name: "test".into(),
        position: DVec3::new(0.0, 0.0, 4.0),
        forward: Vec3::NEG_Z,
        up: Vec3::Y,
        projection: Projection::Orthographic { half_width: 2.0, half_height: 2.0 },
    }
}

const SMALL: RenderSettings = RenderSettings { width: 16, height: 16, mark_unmapped: false };

fn pixel(image: &RgbImage, x: usize, y: usize) -> [u8; 3] {
    let at = 3 * (y * image.width as usize + x);
    [image.rgb[at], image.rgb[at + 1], image.rgb[at + 2]]
}

#[test]
fn surfaces_show_albedo_times_light_and_the_rest_is_sky() {
    let grey = Material { base_color: Vec4::new(0.5, 0.5, 0.5, 1.0), ..Default::default() };
    let mut scene = scene(vec![facing(0.0, 1.0, 0)], vec![grey]);
    let black_sky = picture(&scene, &[3.0], &camera(), &SMALL);
    let middle = pixel(&black_sky, 8, 8);
    assert_eq!(pixel(&black_sky, 1, 1), [0; 3]);
    assert_eq!(picture(&scene, &[3e5], &camera(), &SMALL), black_sky, "the picture does not depend on the unit");
    // A sky as bright as the surface: E albedo / pi.
    scene.sky = Some(Sky::Constant(Vec3::splat(3.0 * 0.5 / std::f32::consts::PI)));
    let equal = picture(&scene, &[3.0], &camera(), &SMALL);
    assert_eq!((pixel(&equal, 8, 8), pixel(&equal, 1, 1)), (middle, middle));
}

#[test]
fn light_passes_masks_blends_and_glass_and_culled_backs() {
    let behind = Material::default();
    let shown = |front: Material| {
        let scene = scene(vec![facing(1.0, 1.0, 1), facing(0.0, 1.0, 0)], vec![behind.clone(), front]);
        // The front square is dark, the one behind it lit; exposure is fixed by nothing else in view.
        let world = World::new(&scene);
        let accel = Accel::build(&world.positions, |_| false);
        let image = render(
            &world,
            &|ray| accel.closest(ray),
            &atlas(&scene),
            &lightmap(&[0.0, 1.0]),
            &camera(),
            scene.sky.as_ref(),
            &RenderSettings { width: 8, height: 8, mark_unmapped: false },
        );
        pixel(&image, 4, 4)[0]
    };
    assert_eq!(shown(Material::default()), 0, "opaque");
    let lit = shown(Material {
        alpha: Alpha::Mask { cutoff: 0.5 },
        base_color: Vec4::new(1.0, 1.0, 1.0, 0.2),
        ..Default::default()
    });
    assert!(lit > 50, "{lit}");
    assert_eq!(shown(Material { transmission: 1.0, ..Default::default() }), lit, "exposure follows the light");
    let blend = Material { alpha: Alpha::Blend, base_color: Vec4::new(1.0, 1.0, 1.0, 0.5), ..Default::default() };
    assert_eq!(shown(blend), lit);
}

#[test]
fn backs_of_one_sided_surfaces_are_not_drawn() {
    let mut turned = facing(1.0, 1.0, 0);
    turned.primitives[0].triangles = vec![[0, 2, 1], [0, 3, 2]];
    let image =
        picture(&scene(vec![turned, facing(0.0, 1.0, 0)], vec![Material::default()]), &[0.0, 1.0], &camera(), &SMALL);
    assert!(pixel(&image, 8, 8)[0] > 50);
}

#[test]
fn surfaces_without_a_map_have_the_mean_light_or_are_marked() {
    let scene = scene(vec![facing(0.0, 1.0, 0), facing(-1.0, 2.0, 0)], vec![Material::default()]);
    let world = World::new(&scene);
    let accel = Accel::build(&world.positions, |_| false);
    let mut atlas = atlas(&scene);
    atlas.placements[0] = None;
    let shown = |mark_unmapped: bool| {
        let settings = RenderSettings { mark_unmapped, ..SMALL };
        let image =
            render(&world, &|ray| accel.closest(ray), &atlas, &lightmap(&[2.0, 2.0]), &camera(), None, &settings);
        (pixel(&image, 8, 8), pixel(&image, 1, 1))
    };
    let (unmapped, mapped) = shown(false);
    assert_eq!(unmapped, mapped);
    let (unmapped, _) = shown(true);
    assert!(unmapped[1] == 0 && unmapped[0] > 0, "{unmapped:?}");
}

#[test]
fn the_picture_does_not_depend_on_threads() {
    let scene = scene(room(Vec3::new(6.0, 3.0, 4.0)), vec![Material::default()]);
    let run = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
            let world = World::new(&scene);
            let accel = Accel::build(&world.positions, |_| false);
            let camera = choose_camera(&world, &|ray| accel.closest(ray));
            let light = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
            picture(&scene, &light, &camera, &RenderSettings { width: 32, height: 18, mark_unmapped: false })
        })
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn a_room_is_seen_from_inside_and_an_object_from_outside() {
    let size = Vec3::new(6.0, 3.0, 4.0);
    let inside = scene(room(size), vec![Material::default()]);
    let view = |scene: &Scene| {
        let world = World::new(scene);
        let accel = Accel::build(&world.positions, |_| false);
        choose_camera(&world, &|ray| accel.closest(ray))
    };
    let p = view(&inside).position.as_vec3();
    assert!(p.cmpgt(Vec3::ZERO).all() && p.cmplt(size).all(), "{p}");
    // The same box with its fronts outside.
    let mut outside = room(size);
    for wall in &mut outside {
        wall.primitives[0].triangles = vec![[0, 2, 1], [0, 3, 2]];
    }
    let camera = view(&scene(outside, vec![Material::default()]));
    let p = camera.position.as_vec3();
    assert!(p.cmplt(Vec3::ZERO).any() || p.cmpgt(size).any(), "{p}");
    assert!(camera.forward.dot(size * 0.5 - p) > 0.0);
    // Nothing at all still has a view.
    assert!(view(&scene(Vec::new(), vec![Material::default()])).position.is_finite());
}
