//! Scenes built in memory, each rectangle with its own place on the map.

use evenlight::options::{Normals, TexelValue, UvSource};
use evenlight::scene::{Instance, Light, LightKind, Material, Mesh, Primitive, Scene};
use evenlight::{Bake, BakeOptions, NoObserver, bake};
use glam::{DAffine3, DVec3, Vec2, Vec3, Vec4};

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

    pub fn point_light(&mut self, position: Vec3, candela: f32) {
        self.light(position, Vec3::NEG_Y, candela, LightKind::Point);
    }

    pub fn light(&mut self, position: Vec3, direction: Vec3, intensity: f32, kind: LightKind) {
        self.scene.lights.push(Light {
            name: format!("light {}", self.scene.lights.len()),
            node: None,
            position: position.as_dvec3(),
            direction: direction.normalize(),
            intensity: Vec3::splat(intensity),
            kind,
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

/// Options under which texels are plain means on the UVs of the scene.
pub fn plain(page: u32, target_percent: f64) -> BakeOptions {
    BakeOptions {
        target_percent,
        target_mesh_percent: Some(1e9),
        max_texture: page,
        uv: UvSource::Keep,
        normals: Normals::Geometric,
        texel_value: TexelValue::Mean,
        gutter: 1,
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
