//! Scenes built in memory, each rectangle with its own place on the map.

use evenlight::options::{Audits, Normals, Smoothing, TexelValue, UvSource};
use evenlight::scene::{Instance, Light, LightKind, Material, Mesh, Primitive, Scene};
use evenlight::{Bake, BakeOptions, NoObserver, bake};
use glam::{DAffine3, DVec3, Mat3, Quat, Vec2, Vec3, Vec4};

/// A scene of rectangles laid out on one page, texel for texel.
pub struct Builder {
    scene: Scene,
    page: u32,
    pen: [u32; 2],
    shelf: u32,
}

/// Texels left empty between rectangles.
const GAP: u32 = 2;

impl Builder {
    pub fn new(page: u32) -> Builder {
        let scene = Scene {
            name: "built".into(),
            meshes: Vec::new(),
            instances: Vec::new(),
            materials: Vec::new(),
            textures: Vec::new(),
            lights: Vec::new(),
            cameras: Vec::new(),
            sky: None,
            warnings: Vec::new(),
            changed: Vec::new(),
            source: Default::default(),
        };
        Builder { scene, page, pen: [GAP, GAP], shelf: 0 }
    }

    pub fn material(&mut self, material: Material) -> usize {
        self.scene.materials.push(material);
        self.scene.materials.len() - 1
    }

    /// A diffuse grey that may emit `radiance`.
    pub fn diffuse(&mut self, albedo: f32, radiance: f32) -> usize {
        self.material(Material {
            base_color: Vec4::new(albedo, albedo, albedo, 1.0),
            emission: Vec3::splat(radiance),
            ..Material::default()
        })
    }

    /// The parallelogram `corner`, `corner + u`, `corner + u + v`, `corner + v`; its front looks along u x v.
    /// It gets `texels` columns along u and rows along v.
    pub fn quad(&mut self, name: &str, corner: Vec3, u: Vec3, v: Vec3, material: usize, texels: [u32; 2]) -> usize {
        if self.pen[0] + texels[0] + GAP > self.page {
            self.pen = [GAP, self.pen[1] + self.shelf + GAP];
            self.shelf = 0;
        }
        let [x, y] = self.pen;
        assert!(y + texels[1] + GAP <= self.page, "the page is full");
        self.pen[0] += texels[0] + GAP;
        self.shelf = self.shelf.max(texels[1]);
        let at = |i: u32, j: u32| Vec2::new((x + i) as f32, (y + j) as f32) / self.page as f32;
        let uvs = vec![at(0, 0), at(texels[0], 0), at(texels[0], texels[1]), at(0, texels[1])];
        self.triangles(
            name,
            vec![corner, corner + u, corner + u + v, corner + v],
            uvs,
            vec![[0, 1, 2], [0, 2, 3]],
            material,
        )
    }

    /// Any triangles with their own UVs.
    pub fn triangles(
        &mut self,
        name: &str,
        positions: Vec<Vec3>,
        uvs: Vec<Vec2>,
        triangles: Vec<[u32; 3]>,
        material: usize,
    ) -> usize {
        let mesh = self.scene.meshes.len();
        let primitive =
            Primitive { positions, tex_coords: vec![Vec::new(), uvs], triangles, material, ..Primitive::default() };
        self.scene.meshes.push(Mesh { name: name.into(), source: mesh, primitives: vec![primitive] });
        self.scene.instances.push(Instance {
            node: mesh,
            name: name.into(),
            mesh,
            world_from_object: DAffine3::IDENTITY,
            weight: 1.0,
            density: 1.0,
            bake: true,
            casts: true,
        });
        mesh
    }

    /// The six walls of the box from `lo` to `hi`, seen from inside, `texels` squared each, named -x to +z.
    pub fn room(&mut self, lo: Vec3, hi: Vec3, material: usize, texels: u32) {
        let d = hi - lo;
        let (x, y, z) = (Vec3::X * d.x, Vec3::Y * d.y, Vec3::Z * d.z);
        let t = [texels; 2];
        self.quad("-x", lo, y, z, material, t);
        self.quad("+x", lo + x, z, y, material, t);
        self.quad("-y", lo, z, x, material, t);
        self.quad("+y", lo + y, x, z, material, t);
        self.quad("-z", lo, x, y, material, t);
        self.quad("+z", lo + z, y, x, material, t);
    }

    /// The six faces of the box from `lo` to `hi`, seen from outside, `texels` squared each.
    pub fn solid(&mut self, lo: Vec3, hi: Vec3, material: usize, texels: u32) {
        let d = hi - lo;
        let (x, y, z) = (Vec3::X * d.x, Vec3::Y * d.y, Vec3::Z * d.z);
        let t = [texels; 2];
        self.quad("solid -x", lo, z, y, material, t);
        self.quad("solid +x", lo + x, y, z, material, t);
        self.quad("solid -y", lo, x, z, material, t);
        self.quad("solid +y", lo + y, z, x, material, t);
        self.quad("solid -z", lo, y, x, material, t);
        self.quad("solid +z", lo + z, x, y, material, t);
    }

    /// An L-shaped room seen from inside: the square from 0 to 4 along x and z without the quarter beyond 2,
    /// 2 high. Walls meet floor and ceiling at whole quads, so that no edge ends inside another.
    pub fn l_room(&mut self, material: usize, texels: u32) {
        let (x, y, z) = (Vec3::X * 2.0, Vec3::Y * 2.0, Vec3::Z * 2.0);
        let t = [texels; 2];
        for (i, j) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)] {
            let corner = x * i + z * j;
            self.quad("floor", corner, z, x, material, t);
            self.quad("ceiling", corner + y, x, z, material, t);
        }
        // Along the outline: the wall from `at` along `along` looks to the left of its way, into the room.
        let outline = [
            (z * 2.0, -z),
            (z, -z),
            (Vec3::ZERO, x),
            (x, x),
            (x * 2.0, z),
            (x * 2.0 + z, -x),
            (x + z, z),
            (x + z * 2.0, -x),
        ];
        for (at, along) in outline {
            self.quad("wall", at, along, y, material, t);
        }
    }

    /// A sphere of radius `radius` about the origin seen from inside, of 20 * 4^`levels` triangles with texels of
    /// their own.
    pub fn inner_sphere(&mut self, radius: f32, levels: u32, material: usize, texels: u32) {
        let g = (1.0 + 5f32.sqrt()) / 2.0;
        let v: Vec<Vec3> = (0..12)
            .map(|i| {
                let (s, t) = (if i & 1 == 0 { 1.0 } else { -1.0 }, if i & 2 == 0 { g } else { -g });
                [Vec3::new(0.0, s, t), Vec3::new(s, t, 0.0), Vec3::new(t, 0.0, s)][i / 4].normalize()
            })
            .collect();
        let mut triangles = Vec::new();
        // Corners at the distance of an edge span the 20 faces.
        let edge = |a: Vec3, b: Vec3| a.dot(b) > 0.4;
        for (i, &a) in v.iter().enumerate() {
            for (j, &b) in v.iter().enumerate().skip(i + 1) {
                for &c in v.iter().skip(j + 1).filter(|&&c| edge(a, b) && edge(b, c) && edge(a, c)) {
                    let outward = (b - a).cross(c - a).dot(a) > 0.0;
                    triangles.push(if outward { [a, c, b] } else { [a, b, c] });
                }
            }
        }
        for _ in 0..levels {
            triangles = triangles
                .into_iter()
                .flat_map(|[a, b, c]| {
                    // Halved in an order of their own, so that neighbours agree on the bits.
                    let middle = |p: Vec3, q: Vec3| ((p + q) * 0.5).normalize();
                    let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                    [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
                })
                .collect();
        }
        let per_row = (self.page - GAP) / (texels + GAP);
        let (mut positions, mut uvs) = (Vec::new(), Vec::new());
        for (k, t) in triangles.iter().enumerate() {
            let at = [k as u32 % per_row, k as u32 / per_row].map(|i| GAP + i * (texels + GAP));
            assert!(at[1] + texels <= self.page, "the page is full");
            for (p, [x, y]) in t.iter().zip([[0, 0], [texels, 0], [0, texels]]) {
                positions.push(*p * radius);
                uvs.push(Vec2::new((at[0] + x) as f32, (at[1] + y) as f32) / self.page as f32);
            }
        }
        let indices = (0..triangles.len() as u32).map(|k| [3 * k, 3 * k + 1, 3 * k + 2]).collect();
        self.triangles("sphere", positions, uvs, indices, material);
    }

    pub fn point_light(&mut self, position: Vec3, candela: f32) {
        self.light(position, Vec3::NEG_Y, candela, LightKind::Point);
    }

    pub fn light(&mut self, position: Vec3, direction: Vec3, intensity: f32, kind: LightKind) {
        self.scene.lights.push(Light {
            name: format!("light {}", self.scene.lights.len()),
            node: None,
            position: position.as_dvec3(),
            direction: direction.normalize(),
            axes: Mat3::from_quat(Quat::from_rotation_arc(Vec3::NEG_Z, direction.normalize())),
            intensity: Vec3::splat(intensity),
            kind,
            profile: None,
            bake: Default::default(),
        });
    }

    pub fn scene_mut(&mut self) -> &mut Scene {
        &mut self.scene
    }

    pub fn finish(self) -> Scene {
        self.scene
    }
}

/// Five coloured walls and a front, a lamp under the ceiling that shines down, a box in the way.
pub fn cornell(page: u32) -> Scene {
    let mut b = Builder::new(page);
    let mut coloured =
        |r, g, blue| b.material(Material { base_color: Vec4::new(r, g, blue, 1.0), ..Material::default() });
    let (white, red, green) = (coloured(0.7, 0.7, 0.7), coloured(0.6, 0.1, 0.08), coloured(0.15, 0.5, 0.1));
    b.room(Vec3::ZERO, Vec3::splat(3.0), white, 8);
    for (wall, material) in [(0, red), (1, green)] {
        b.scene.meshes[wall].primitives[0].material = material;
    }
    b.solid(Vec3::new(0.75, 0.25, 0.5), Vec3::new(1.75, 1.25, 1.5), white, 4);
    let lamp = b.material(Material {
        base_color: Vec4::new(0.2, 0.2, 0.2, 1.0),
        emission: Vec3::new(12.0, 9.0, 5.0),
        ..Material::default()
    });
    b.quad("lamp", Vec3::new(1.0, 2.5, 1.25), Vec3::X, Vec3::Z, lamp, [4; 2]);
    b.finish()
}

/// Two rooms of 3 x 4 m, 2.5 m high, under one floor and one ceiling, parted at x = 3 by a wall without thickness,
/// instance 6; a point light in the first. Surfaces that run through both have `columns` texels along x.
pub fn two_rooms(page: u32, columns: u32, double_sided: bool) -> Scene {
    let mut b = Builder::new(page);
    let wall = b.diffuse(0.8, 0.0);
    let (x, y, z) = (Vec3::X * 6.0, Vec3::Y * 2.5, Vec3::Z * 4.0);
    b.quad("floor", Vec3::ZERO, z, x, wall, [16, columns]);
    b.quad("ceiling", y, x, z, wall, [columns, 16]);
    b.quad("left", Vec3::ZERO, y, z, wall, [10, 16]);
    b.quad("right", x, z, y, wall, [16, 10]);
    b.quad("back", Vec3::ZERO, x, y, wall, [columns, 10]);
    b.quad("front", z, y, x, wall, [10, columns]);
    let sheet = b.material(Material { base_color: Vec4::new(0.8, 0.8, 0.8, 1.0), double_sided, ..Material::default() });
    // Its front looks into the dark room.
    b.quad("sheet", x * 0.5, y, z, sheet, [10, 16]);
    b.point_light(Vec3::new(1.0, 1.0, 2.0), 1e6);
    b.finish()
}

/// Options under which texels are plain means on the UVs of the scene.
pub fn plain(page: u32, target_percent: f64) -> BakeOptions {
    BakeOptions {
        target_percent,
        target_mesh_percent: Some(1e9),
        max_texture: page,
        uv: UvSource::Keep,
        normals: Normals::Geometric,
        texel_value: TexelValue::Mean,
        smoothing: Smoothing::None,
        gutter: 1,
        audit: Audits::Off,
        seed: 1,
        ..BakeOptions::default()
    }
}

pub fn run<'s>(scene: &'s Scene, options: &BakeOptions) -> Bake<'s> {
    let bake = bake(scene, options, &mut NoObserver).expect("the bake succeeds");
    assert_eq!(bake.solution.ledger.imbalance(), [0; 3], "energy balance");
    bake
}

/// Sum of E times area [lux m2] over all stored texels, per channel mean.
pub fn received(bake: &Bake) -> f64 {
    let m2 = bake.world.frame.metres.powi(2);
    (0..bake.texels.mapped)
        .map(|i| {
            f64::from(bake.solution.total.mean(i).element_sum()) / 3.0 * f64::from(bake.texels.texels[i].area) * m2
        })
        .sum()
}

/// Mean irradiance of the texels that `keep` selects by world position of their centre, and their number.
pub fn mean_where(bake: &Bake, instance: usize, keep: impl Fn(DVec3) -> bool) -> (f64, usize) {
    let (mut sum, mut weight, mut n) = (0.0, 0.0, 0);
    for i in 0..bake.texels.mapped {
        if bake.solution.weights.instance[i] as usize != instance || !keep(centre(bake, i)) {
            continue;
        }
        let a = f64::from(bake.texels.texels[i].area);
        sum += f64::from(bake.solution.total.mean(i).element_sum()) / 3.0 * a;
        weight += a;
        n += 1;
    }
    (sum / weight, n)
}

/// World position of the middle of a texel.
pub fn centre(bake: &Bake, texel: usize) -> DVec3 {
    let mut sampler = evenlight::atlas::TexelSampler::default();
    sampler.load(&bake.texels, texel);
    let (triangle, uv) = sampler.sample(Vec2::splat(0.5));
    bake.world.frame.to_world(bake.world.position(triangle, uv))
}
