//! The scene flattened to world-space triangles, in the frame that everything later computes in.

use super::specular::{Arrival, Bounce, Specular, pane_reflectance};
use super::{Alpha, BakeMode, ColorSpace, Material, Primitive, Scene, TextureRef};
use glam::{DVec3, Vec2, Vec3, Vec4};

/// The normalised frame: recentred in f64, then scaled by a power of two so that every coordinate lies in
/// [-1, 1]. Scaling a scene by a power of two therefore changes no bit of what is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// World position of the frame's origin (m).
    pub centre: DVec3,
    /// Metres per unit of the frame, a power of two.
    pub metres: f64,
}

impl Frame {
    /// Frame position of a world position.
    pub fn from_world(&self, p: DVec3) -> Vec3 {
        ((p - self.centre) / self.metres).as_vec3()
    }

    /// World position (m) of a frame position.
    pub fn to_world(&self, p: Vec3) -> DVec3 {
        p.as_dvec3() * self.metres + self.centre
    }
}

/// Where a world triangle comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TriangleRef {
    /// Index into [`Scene::instances`].
    pub instance: u32,
    /// Index into the mesh's primitives.
    pub primitive: u32,
    /// Index into the primitive's triangles.
    pub index: u32,
}

/// What a ray has to know about a triangle before it looks at the material.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SurfaceFlags(u8);

impl SurfaceFlags {
    /// Both sides receive light, reflect and emit.
    pub const DOUBLE_SIDED: SurfaceFlags = SurfaceFlags(1);
    /// Light may pass some points (MASK, BLEND, transmission).
    pub const PASSES_LIGHT: SurfaceFlags = SurfaceFlags(2);
    /// Emits light.
    pub const EMITS: SurfaceFlags = SurfaceFlags(4);
    /// Neither emits nor reflects, only blocks.
    pub const UNLIT: SurfaceFlags = SurfaceFlags(8);
    /// No area, or not finite.
    pub const DEGENERATE: SurfaceFlags = SurfaceFlags(16);
    /// No ray meets it, for it has no area or its node casts nothing.
    pub const UNSEEN: SurfaceFlags = SurfaceFlags(64);
    /// Reflectance or emission varies over the triangle.
    pub const VARIES: SurfaceFlags = SurfaceFlags(32);
    /// Some light leaves as from a mirror or through a lens.
    pub const SPECULAR: SurfaceFlags = SurfaceFlags(128);

    /// True if all bits of `other` are set.
    pub fn has(self, other: SurfaceFlags) -> bool {
        self.0 & other.0 == other.0
    }

    fn with(self, other: SurfaceFlags, on: bool) -> SurfaceFlags {
        if on { SurfaceFlags(self.0 | other.0) } else { self }
    }
}

/// What the material says at a point. Linear Rec. 709.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePoint {
    /// Diffuse reflectance rho in [0, 1] of the surface where it is present: alpha not applied.
    pub albedo: Vec3,
    /// Diffuse transmittance in [0, 1], of light that leaves by Lambert's law on the far side: alpha not applied.
    pub diffuse_transmittance: Vec3,
    /// Emitted radiance (nit) where the surface is present: alpha not applied.
    pub emission: Vec3,
    /// Share of the light that meets the surface at all, in [0, 1]; 0 or 1 for MASK, 1 for OPAQUE.
    pub alpha: f32,
    /// Share per channel of the light meeting the surface that passes straight through, in [0, 1], but for what the
    /// surface reflects by Fresnel's law.
    pub transmittance: Vec3,
    /// What leaves as from a mirror or through a lens.
    pub specular: Option<Specular>,
}

impl SurfacePoint {
    /// Share of light per channel that is reflected.
    pub fn reflected(&self) -> Vec3 {
        self.albedo * self.alpha
    }

    /// Share of light per channel that leaves diffusely on the far side.
    pub fn transmitted(&self) -> Vec3 {
        self.diffuse_transmittance * self.alpha
    }

    /// Share of light per channel that passes straight, beside the surface and through it, for light with a cosine to
    /// its normal, of either sign.
    pub fn passed(&self, cosine: f32) -> Vec3 {
        let beside = Vec3::splat(1.0 - self.alpha);
        if self.transmittance == Vec3::ZERO {
            return beside;
        }
        let reflected = self.specular.map_or(0.0, |s| pane_reflectance(cosine.abs().min(1.0), s.ior));
        beside + self.transmittance * (self.alpha * (1.0 - reflected))
    }

    /// Share per channel that a look through solid glass finds, taken to be straight.
    pub fn seen_through(&self) -> Vec3 {
        self.specular.filter(|s| s.solid).map_or(Vec3::ZERO, |s| s.tint * s.glass)
    }
}

/// What light that comes along a direction meets at a point of a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Met {
    /// It is the back of the triangle.
    pub back: bool,
    /// Unit geometric normal of the side that is met.
    pub facing: Vec3,
    /// Light falls on that side: else it is the back of a one-sided surface.
    pub receives: bool,
    /// Light may pass.
    pub passes: bool,
    /// Share per channel that is reflected; 0 where that side does not receive.
    pub reflected: Vec3,
    /// Share per channel that leaves diffusely on the far side; 0 where that side does not receive.
    pub transmitted: Vec3,
    /// Share per channel that passes straight.
    pub passed: Vec3,
    /// What leaves as from a mirror or through a lens.
    pub specular: Option<Specular>,
}

/// World triangles of all instances that take part. Triangle ids count through the instances in order, each with all its
/// primitives' triangles (degenerate ones included).
#[derive(Debug)]
pub struct World<'s> {
    /// The scene this was made from.
    pub scene: &'s Scene,
    /// The normalised frame of `positions`.
    pub frame: Frame,
    /// Corners in the frame, in the vertex order of the file.
    pub positions: Vec<[Vec3; 3]>,
    /// Unit geometric normal on the front side (mirrored transforms accounted for); zero if degenerate.
    pub normals: Vec<Vec3>,
    /// Where each triangle comes from.
    pub refs: Vec<TriangleRef>,
    /// What a ray has to know of each triangle.
    pub flags: Vec<SurfaceFlags>,
    /// First triangle id of each instance, and the total at the end.
    pub first_triangle: Vec<u32>,
    constants: Vec<SurfacePoint>,
    normal_matrices: Vec<glam::Mat3>,
}

/// Triangles smaller than this in the frame [frame units squared] are degenerate.
const MIN_AREA: f64 = 1e-20;

/// Length of a hair, in units of a triangle's largest |coordinate|: ten times what rounding moves a point by.
const HAIR: f32 = 32.0 * f32::EPSILON;

/// A point inside every triangle, off its lines of symmetry: weights of the second and third corner.
const INNER: Vec2 = Vec2::new(0.33, 0.26);

impl<'s> World<'s> {
    /// Flattens `scene`.
    pub fn new(scene: &'s Scene) -> World<'s> {
        let frame = frame_of(scene);
        let n = scene.triangle_count();
        let mut world = World {
            scene,
            frame,
            positions: Vec::with_capacity(n),
            normals: Vec::with_capacity(n),
            refs: Vec::with_capacity(n),
            flags: Vec::with_capacity(n),
            first_triangle: Vec::with_capacity(scene.instances.len() + 1),
            constants: scene.materials.iter().map(constant_point).collect(),
            normal_matrices: Vec::with_capacity(scene.instances.len()),
        };
        for (i, instance) in scene.instances.iter().enumerate() {
            world.first_triangle.push(world.positions.len() as u32);
            let m = instance.world_from_object.matrix3;
            let mirrored = m.determinant() < 0.0;
            // Cofactor matrix: right for normals whatever the scale, and never divides by zero.
            let sign = if mirrored { -1.0 } else { 1.0 };
            let cofactor =
                glam::DMat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis))
                    * sign;
            let largest = cofactor.to_cols_array().iter().fold(0.0f64, |a, b| a.max(b.abs()));
            world.normal_matrices.push((cofactor / largest.max(f64::MIN_POSITIVE)).as_mat3());
            if !instance.takes_part() {
                continue;
            }
            for (p, primitive) in scene.meshes[instance.mesh].primitives.iter().enumerate() {
                let material = &scene.materials[primitive.material];
                let flags = material_flags(material, primitive);
                let local: Vec<DVec3> = primitive
                    .positions
                    .iter()
                    .map(|v| (instance.world_from_object.transform_point3(v.as_dvec3()) - frame.centre) / frame.metres)
                    .collect();
                for (k, t) in primitive.triangles.iter().enumerate() {
                    let c = t.map(|v| local[v as usize].as_vec3());
                    let d = c.map(|v| v.as_dvec3());
                    let normal = (d[1] - d[0]).cross(d[2] - d[0]) * sign;
                    let degenerate = !normal.is_finite() || normal.length() < 2.0 * MIN_AREA;
                    world.positions.push(c);
                    world.normals.push(if degenerate { Vec3::ZERO } else { normal.normalize().as_vec3() });
                    world.refs.push(TriangleRef { instance: i as u32, primitive: p as u32, index: k as u32 });
                    let unseen = degenerate || !instance.casts;
                    let flags = flags.with(SurfaceFlags::DEGENERATE, degenerate).with(SurfaceFlags::UNSEEN, unseen);
                    world.flags.push(flags);
                }
            }
        }
        world.first_triangle.push(world.positions.len() as u32);
        world
    }

    /// Number of triangles, degenerate ones included.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// True without any triangle.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// True where some surface reflects as a mirror or refracts.
    pub fn is_specular(&self) -> bool {
        self.flags.iter().any(|f| f.has(SurfaceFlags::SPECULAR))
    }

    /// Area of a triangle [frame units squared].
    pub fn area(&self, triangle: u32) -> f64 {
        let d = self.positions[triangle as usize].map(|v| v.as_dvec3());
        0.5 * (d[1] - d[0]).cross(d[2] - d[0]).length()
    }

    /// Largest side of a triangle's bounding box [frame units].
    pub fn extent(&self, triangle: u32) -> f32 {
        let [a, b, c] = self.positions[triangle as usize];
        (a.max(b).max(c) - a.min(b).min(c)).max_element()
    }

    /// Position at barycentric weights `uv` of the second and third corner.
    pub fn position(&self, triangle: u32, uv: Vec2) -> Vec3 {
        let [a, b, c] = self.positions[triangle as usize];
        a * (1.0 - uv.x - uv.y) + b * uv.x + c * uv.y
    }

    /// A point of a triangle off all its edges and lines of symmetry.
    pub fn inner(&self, triangle: u32) -> Vec3 {
        self.position(triangle, INNER)
    }

    /// Barycentric weights of the point of a triangle that lies a hair, a few roundings, before `uv` on a way along
    /// `direction`. Next to a wall that stands on the triangle, rounding may put a point where light arrives on the
    /// wall's far side; this one is where the light has been. Beside an edge that the light came over, it is a hair
    /// inside: a wall that stands on an edge is often the border to bright daylight.
    pub fn hair_before(&self, triangle: u32, uv: Vec2, direction: Vec3) -> Vec2 {
        let [a, b, c] = self.positions[triangle as usize];
        let (ab, ac) = (b - a, c - a);
        let normal = ab.cross(ac);
        let hair = HAIR * a.abs().max(b.abs()).max(c.abs()).max_element();
        let back = direction * (-hair / normal.length_squared());
        let moved = uv + Vec2::new(back.cross(ac).dot(normal), ab.cross(back).dot(normal));
        if moved.min_element() >= 0.0 && moved.element_sum() <= 1.0 {
            return moved;
        }
        let way = (self.inner(triangle) - self.position(triangle, uv)).length();
        uv + (INNER - uv) * (hair / way).min(1.0)
    }

    /// The primitive of a triangle and its vertex indices.
    pub fn primitive(&self, triangle: u32) -> (&'s Primitive, [u32; 3]) {
        let r = self.refs[triangle as usize];
        let mesh = &self.scene.meshes[self.scene.instances[r.instance as usize].mesh];
        let primitive = &mesh.primitives[r.primitive as usize];
        (primitive, primitive.triangles[r.index as usize])
    }

    /// The material of a triangle.
    pub fn material(&self, triangle: u32) -> &'s Material {
        &self.scene.materials[self.material_index(triangle)]
    }

    /// The number of that material in the scene.
    pub fn material_index(&self, triangle: u32) -> usize {
        self.primitive(triangle).0.material
    }

    /// Unit interpolated normal on the front side, turned to within the front hemisphere of the geometric
    /// normal; the geometric normal where the file gives none.
    pub fn shading_normal(&self, triangle: u32, uv: Vec2) -> Vec3 {
        let geometric = self.normals[triangle as usize];
        let (primitive, t) = self.primitive(triangle);
        if primitive.normals.is_empty() {
            return geometric;
        }
        let [a, b, c] = t.map(|v| primitive.normals[v as usize]);
        let m = self.normal_matrices[self.refs[triangle as usize].instance as usize];
        let n = (m * (a * (1.0 - uv.x - uv.y) + b * uv.x + c * uv.y)).normalize_or_zero();
        if n == Vec3::ZERO || !n.is_finite() {
            return geometric;
        }
        // A normal that looks to the back of its own triangle is a fault of the file.
        if n.dot(geometric) < 1e-3 { geometric } else { n }
    }

    /// What light along `direction` meets at a point of a triangle. The material is looked up only if it matters.
    pub fn meet(&self, triangle: u32, uv: Vec2, direction: Vec3) -> Met {
        let (flags, normal) = (self.flags[triangle as usize], self.normals[triangle as usize]);
        let back = normal.dot(direction) > 0.0;
        let receives = !back || flags.has(SurfaceFlags::DOUBLE_SIDED);
        let passes = flags.has(SurfaceFlags::PASSES_LIGHT);
        let facing = if back { -normal } else { normal };
        let (reflected, transmitted, passed) = (Vec3::ZERO, Vec3::ZERO, Vec3::ZERO);
        let mut met = Met { back, facing, receives, passes, reflected, transmitted, passed, specular: None };
        if receives || passes {
            let surface = self.surface(triangle, uv);
            if receives {
                (met.reflected, met.specular) = (surface.reflected(), surface.specular);
                met.transmitted = surface.transmitted();
            }
            if passes {
                met.passed = surface.passed(normal.dot(direction));
            }
        }
        met
    }

    /// One way that light with the unit direction `arriving`, after a free way of length `way` [frame units], leaves a point
    /// of the specular surface that it `met`, drawn by random numbers in [0, 1).
    pub fn bounce(
        &self,
        (triangle, uv): (u32, Vec2),
        met: &Met,
        arriving: Vec3,
        way: f32,
        mut random: impl FnMut() -> f32,
    ) -> Option<Bounce> {
        let specular = met.specular?;
        let side = if met.back { -1.0 } else { 1.0 };
        let arrival = Arrival {
            direction: arriving,
            facing: met.facing,
            shading: self.shading_normal(triangle, uv) * side,
            back: met.back,
            way: way * self.frame.metres as f32,
        };
        specular.bounce(&arrival, [random(), random(), random()])
    }

    /// What the material says at a point of a triangle.
    pub fn surface(&self, triangle: u32, uv: Vec2) -> SurfacePoint {
        let (primitive, t) = self.primitive(triangle);
        if !self.flags[triangle as usize].has(SurfaceFlags::VARIES) {
            return self.constants[primitive.material];
        }
        let material = &self.scene.materials[primitive.material];
        let w = [1.0 - uv.x - uv.y, uv.x, uv.y];
        let color = if primitive.colors.is_empty() {
            Vec4::ONE
        } else {
            primitive.colors[t[0] as usize] * w[0]
                + primitive.colors[t[1] as usize] * w[1]
                + primitive.colors[t[2] as usize] * w[2]
        };
        let look = |r: &Option<TextureRef>, space| match r {
            None => Vec4::ONE,
            Some(r) => match primitive.tex_coords.get(r.tex_coord).filter(|s| !s.is_empty()) {
                None => Vec4::ONE,
                Some(set) => {
                    let at = set[t[0] as usize] * w[0] + set[t[1] as usize] * w[1] + set[t[2] as usize] * w[2];
                    self.scene.textures[r.texture].sample(r.transform.transform_point2(at), space)
                }
            },
        };
        let base = material.base_color * color * look(&material.base_color_texture, ColorSpace::Srgb);
        let metal = look(&material.metallic_texture, ColorSpace::Linear);
        let transmission = material.transmission * look(&material.transmission_texture, ColorSpace::Linear).x;
        let diffuse_transmission =
            material.diffuse_transmission * look(&material.diffuse_transmission_texture, ColorSpace::Linear).w;
        let transmitted_color = material.diffuse_transmission_color
            * look(&material.diffuse_transmission_color_texture, ColorSpace::Srgb).truncate();
        let emission = material.emission * look(&material.emission_texture, ColorSpace::Srgb).truncate();
        let (roughness, metallic) = (material.roughness * metal.y, material.metallic * metal.z);
        let point =
            Inputs { base, metallic, roughness, transmission, diffuse_transmission, transmitted_color, emission };
        resolve(material, &point)
    }
}

fn material_flags(material: &Material, primitive: &Primitive) -> SurfaceFlags {
    let textured = material.base_color_texture.is_some()
        || material.metallic_texture.is_some()
        || material.emission_texture.is_some()
        || material.transmission_texture.is_some()
        || material.diffuse_transmission_texture.is_some()
        || material.diffuse_transmission_color_texture.is_some();
    let emits = !material.unlit && material.bake != BakeMode::Off && material.emission.max_element() > 0.0;
    SurfaceFlags::default()
        .with(SurfaceFlags::DOUBLE_SIDED, material.is_two_sided())
        .with(SurfaceFlags::PASSES_LIGHT, material.passes_light())
        .with(SurfaceFlags::EMITS, emits)
        .with(SurfaceFlags::UNLIT, material.unlit)
        .with(SurfaceFlags::SPECULAR, material.is_specular())
        .with(SurfaceFlags::VARIES, textured || !primitive.colors.is_empty())
}

fn constant_point(m: &Material) -> SurfacePoint {
    let point = Inputs {
        base: m.base_color,
        metallic: m.metallic,
        roughness: m.roughness,
        transmission: m.transmission,
        diffuse_transmission: m.diffuse_transmission,
        transmitted_color: m.diffuse_transmission_color,
        emission: m.emission,
    };
    resolve(m, &point)
}

/// The numbers of a material at a point, textures applied.
struct Inputs {
    base: Vec4,
    metallic: f32,
    roughness: f32,
    transmission: f32,
    diffuse_transmission: f32,
    transmitted_color: Vec3,
    emission: Vec3,
}

/// The split of the light that meets a surface: a metal has a specular lobe alone, of the rest a share `transmission` is
/// glass, and what remains is diffuse, of which a share `diffuse_transmission` leaves on the far side. The coat of a
/// dielectric is counted as diffuse.
fn resolve(m: &Material, point: &Inputs) -> SurfacePoint {
    let &Inputs { base, metallic, roughness, transmission, diffuse_transmission, transmitted_color, emission } = point;
    let alpha = match m.alpha {
        Alpha::Opaque => 1.0,
        Alpha::Mask { cutoff } => f32::from(u8::from(base.w >= cutoff)),
        Alpha::Blend => base.w.clamp(0.0, 1.0),
    };
    if m.unlit {
        let none = Vec3::ZERO;
        return SurfacePoint {
            albedo: none,
            diffuse_transmittance: none,
            emission: none,
            alpha,
            transmittance: none,
            specular: None,
        };
    }
    let (metal, t) = (metallic.clamp(0.0, 1.0), transmission.clamp(0.0, 1.0));
    let base = base.truncate().clamp(Vec3::ZERO, Vec3::ONE);
    let color = base * (1.0 - metal);
    let glass = (1.0 - metal) * t;
    let emission = if m.bake == BakeMode::Off { Vec3::ZERO } else { emission.max(Vec3::ZERO) };
    let specular = Specular {
        metal: metal * alpha,
        metal_color: base,
        glass: glass * alpha,
        tint: base,
        ior: m.ior,
        solid: m.solid,
        absorption: m.absorption,
        alpha: roughness.clamp(0.0, 1.0).powi(2),
    };
    let far = diffuse_transmission.clamp(0.0, 1.0);
    let diffuse_transmittance = transmitted_color.clamp(Vec3::ZERO, Vec3::ONE) * ((1.0 - metal) * (1.0 - t) * far);
    SurfacePoint {
        albedo: color * (1.0 - t) * (1.0 - far),
        diffuse_transmittance,
        emission,
        alpha,
        transmittance: if m.solid { Vec3::ZERO } else { color * t },
        specular: m.is_specular().then_some(specular),
    }
}

fn frame_of(scene: &Scene) -> Frame {
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for instance in scene.instances.iter().filter(|i| i.takes_part()) {
        for primitive in &scene.meshes[instance.mesh].primitives {
            for t in &primitive.triangles {
                for &v in t {
                    let p = instance.world_from_object.transform_point3(primitive.positions[v as usize].as_dvec3());
                    if p.is_finite() {
                        lo = lo.min(p);
                        hi = hi.max(p);
                    }
                }
            }
        }
    }
    if lo.x > hi.x {
        return Frame { centre: DVec3::ZERO, metres: 1.0 };
    }
    let centre = (lo + hi) * 0.5;
    let half = ((hi - lo) * 0.5).max_element().max(f64::MIN_POSITIVE);
    // The power of two above the half extent.
    Frame { centre, metres: half.log2().floor().exp2() * 2.0 }
}
