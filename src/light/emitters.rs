//! All emitters of a scene, and one sample of their light at a point.

use super::groups::LightGroup;
use super::lighting::Lighting;
use super::panel::{Panel, panel_bounds, panels_of};
use super::polygon::SeenPolygon;
use super::punctual::{Punctual, Shape, punctual_bounds, to_frame};
use super::receiver::Receiver;
use super::sky::SkySampler;
use super::tree::{LightBounds, LightTree};
use super::visibility::Visibility;
use crate::accel::{self, Ray};
use crate::sampling::{Stream, cosine_hemisphere, uniform_cone, uniform_triangle};
use crate::scene::{BakeMode, Light, LightKind, SurfaceFlags, World};
use glam::{Vec2, Vec3};

/// Up to this many point and spot lights each get a shadow ray of their own per sample; more go into the
/// light tree.
pub const PUNCTUAL_LOOP_LIMIT: usize = 16;

/// Up to this many emitters of the light tree are all weighed for each sample, without the tree.
const WEIGH_ALL_LIMIT: usize = 32;

/// Of more, the tree proposes this many.
const PROPOSALS: u32 = 2;

/// Shadow rays to what is no surface end a hair before it, for it may lie on one: at this share of the way.
const HAIR_BEFORE: f32 = 1.0 - 1e-5;

/// What to make of the lights.
#[derive(Debug, Clone, Copy, Default)]
pub struct LightSettings<'g> {
    /// Punctual lights are stored by their reflected light only.
    pub indirect_only: bool,
    /// Leave out all that is not in this group.
    pub group: Option<&'g LightGroup>,
}

impl LightSettings<'_> {
    fn takes(&self, is_in: impl Fn(&LightGroup) -> bool) -> bool {
        self.group.is_none_or(is_in)
    }
}

/// One entry of the light tree.
#[derive(Debug, Clone, Copy)]
enum TreeLight {
    /// `radiance` is the mean over the triangle and the sum over the channels [nit].
    Triangle {
        id: u32,
        both_sides: bool,
        radiance: f32,
    },
    Panel(u32),
    Punctual(u32),
}

/// A light of the tree as a receiver sees it.
#[derive(Debug, Clone, Copy)]
enum Seen {
    Triangle { id: u32, polygon: SeenPolygon },
    Panel { panel: u32, polygon: SeenPolygon },
    Punctual { light: u32 },
}

/// Direct irradiance [lux] that one sample finds.
#[derive(Debug, Clone, Copy, Default)]
pub struct DirectSample {
    /// On the shading normal, of the lights whose direct light is stored.
    pub stored: Vec3,
    /// Of it what comes from surfaces and the soft part of the sky: its shadows have penumbras.
    pub soft: Vec3,
    /// On the geometric normal, of all lights: what is reflected.
    pub transported: Vec3,
    /// One of the directions that it came from, for what is reflected in a direction.
    pub ray: LightRay,
}

/// One of several directions that light came from, drawn in proportion to the largest channel of what each brought.
#[derive(Debug, Clone, Copy, Default)]
pub struct LightRay {
    /// Unit direction towards the light.
    pub towards: Vec3,
    /// What it brought [lux].
    light: Vec3,
    /// Sum of the largest channels of all.
    sum: f32,
    /// Random number in [0, 1) to draw by.
    pick: f32,
}

impl LightRay {
    /// Irradiance [lux] that stands for that of all directions: the same in expectation.
    pub fn irradiance(&self) -> Vec3 {
        let largest = self.light.max_element();
        if largest > 0.0 { self.light * (self.sum / largest) } else { Vec3::ZERO }
    }

    fn add(&mut self, light: Vec3, towards: Vec3) {
        let largest = light.max_element();
        if largest <= 0.0 {
            return;
        }
        self.sum += largest;
        // One random number does for all: what is left of it is uniform again.
        let cut = largest / self.sum;
        if self.pick < cut {
            (self.light, self.towards, self.pick) = (light, towards, self.pick / cut);
        } else {
            self.pick = (self.pick - cut) / (1.0 - cut);
        }
    }
}

impl DirectSample {
    fn add(&mut self, light: Vec3, towards: Vec3, cosines: (f32, f32), stored: bool) {
        let arriving = light * cosines.0;
        self.transported += arriving;
        self.ray.add(arriving, towards);
        if stored {
            self.stored += light * cosines.1;
        }
    }

    /// Light of a surface, whose shadows have penumbras.
    fn add_soft(&mut self, light: Vec3, towards: Vec3, at: &Receiver, stored: bool) {
        if light == Vec3::ZERO {
            return;
        }
        let cosines = at.cosines(towards);
        self.add(light, towards, cosines, stored);
        if stored {
            self.soft += light * cosines.1;
        }
    }
}

/// Dimensions of the unit cube that one sample uses, besides the two for the place on the texel.
pub const SAMPLE_DIMENSIONS: usize = 10;

/// All emitters of a scene.
#[derive(Debug)]
pub struct Emitters {
    /// Directional lights, and point and spot lights if they are few.
    looped: Vec<Punctual>,
    /// Point and spot lights of the tree.
    punctual: Vec<Punctual>,
    /// Lights with area, all of the tree.
    panels: Vec<Panel>,
    tree: LightTree,
    tree_lights: Vec<TreeLight>,
    sky: Option<SkySampler>,
}

impl Emitters {
    /// Gathers what emits: surfaces of `world`, and `lighting`, leaving out what is black or switched off.
    pub fn new(world: &World, lighting: &Lighting, settings: LightSettings) -> Emitters {
        let mut looped = Vec::new();
        let mut punctual = Vec::new();
        let mut panels = Vec::new();
        let shines = |l: &Light| l.bake != BakeMode::Off && l.intensity.max_element() > 0.0;
        let lights = lighting.lights.iter().enumerate().filter(|(i, l)| shines(l) && settings.takes(|g| g.lights[*i]));
        for (_, light) in lights {
            if let LightKind::Area(shape) = light.kind {
                panels.extend(panels_of(light, shape, world, settings));
            }
            let Some(p) = to_frame(light, world, settings) else { continue };
            if p.is_lamp() { punctual.push(p) } else { looped.push(p) }
        }
        if punctual.len() <= PUNCTUAL_LOOP_LIMIT {
            looped.append(&mut punctual);
        }
        let (mut bounds, mut tree_lights) = (Vec::new(), Vec::new());
        for id in 0..world.len() as u32 {
            if let Some(b) = triangle_bounds(world, id)
                && settings.takes(|g| g.materials[world.material_index(id)])
            {
                bounds.push(b);
                let radiance = b.power / world.area(id) as f32;
                tree_lights.push(TreeLight::Triangle { id, both_sides: b.two_sided, radiance });
            }
        }
        for (i, p) in panels.iter().enumerate() {
            bounds.push(panel_bounds(p));
            tree_lights.push(TreeLight::Panel(i as u32));
        }
        for (i, p) in punctual.iter().enumerate() {
            bounds.push(punctual_bounds(p));
            tree_lights.push(TreeLight::Punctual(i as u32));
        }
        let sky = lighting.sky.as_ref().filter(|_| settings.takes(|g| g.sky)).and_then(SkySampler::new);
        Emitters { looped, punctual, panels, tree: LightTree::new(&bounds), tree_lights, sky }
    }

    /// True where nothing emits.
    pub fn is_empty(&self) -> bool {
        self.looped.is_empty() && self.tree_lights.is_empty() && self.sky.is_none()
    }

    /// Number of emissive triangles, those of lights with area among them, and of lights without area.
    pub fn counts(&self) -> (usize, usize) {
        let triangles = self.tree_lights.iter().filter(|l| !matches!(l, TreeLight::Punctual(_))).count();
        (triangles, self.looped.len() + self.punctual.len())
    }

    /// The sky, if it shines.
    pub fn sky(&self) -> Option<&SkySampler> {
        self.sky.as_ref()
    }

    /// One unbiased sample of the direct irradiance at `at`. `u(d)` gives coordinate `d` of a point of the
    /// unit cube, d < `SAMPLE_DIMENSIONS`, `more` further random numbers. `pick` is one that draws a direction, where that
    /// matters. Rays traced are added to `rays`.
    pub fn sample(
        &self,
        at: &Receiver,
        visibility: &Visibility,
        u: impl Fn(usize) -> f32,
        more: &mut Stream,
        pick: f32,
        rays: &mut u64,
    ) -> DirectSample {
        let mut out = DirectSample { ray: LightRay { pick, ..LightRay::default() }, ..DirectSample::default() };
        for light in &self.looped {
            self.add_punctual(light, 1.0, at, visibility, || Vec2::new(u(7), u(8)), &mut out, rays);
        }
        self.add_chosen(at, visibility, &u, more, &mut out, rays);
        match &self.sky {
            None => {}
            Some(sky @ SkySampler::Constant(_)) => {
                let w = normal_mixture(at, Vec2::new(u(3), u(4)), u(5));
                add_sky(sky, w, 1.0 / mixture_density(at, w), at, visibility, &mut out, rays);
            }
            Some(sky @ SkySampler::Image(image)) => {
                // Two samples, combined by the balance heuristic (Veach 1997).
                let w = normal_mixture(at, Vec2::new(u(3), u(4)), u(5));
                add_sky(sky, w, 1.0 / (mixture_density(at, w) + image.density(w)), at, visibility, &mut out, rays);
                let (w, density) = image.sample(Vec2::new(u(5), u(6)));
                add_sky(sky, w, 1.0 / (mixture_density(at, w) + density), at, visibility, &mut out, rays);
            }
        }
        out
    }

    /// Whether anything but suns and the sky shines.
    pub fn has_lamps(&self) -> bool {
        !self.tree_lights.is_empty() || self.looped.iter().any(Punctual::is_lamp)
    }

    /// [`sample`](Self::sample) of what is no sun and no sky: irradiance (lux) on the geometric normal.
    pub fn lamps(
        &self,
        at: &Receiver,
        visibility: &Visibility,
        u: impl Fn(usize) -> f32,
        more: &mut Stream,
        rays: &mut u64,
    ) -> Vec3 {
        let mut out = DirectSample::default();
        for light in self.looped.iter().filter(|l| l.is_lamp()) {
            self.add_punctual(light, 1.0, at, visibility, || Vec2::ZERO, &mut out, rays);
        }
        self.add_chosen(at, visibility, &u, more, &mut out, rays);
        out.transported
    }

    /// One light of the tree.
    fn add_chosen(
        &self,
        at: &Receiver,
        visibility: &Visibility,
        u: &impl Fn(usize) -> f32,
        more: &mut Stream,
        out: &mut DirectSample,
        rays: &mut u64,
    ) {
        match self.choose(at, visibility, u(0), u(9)) {
            None => {}
            Some((Seen::Triangle { id, polygon }, weight)) => {
                let place = Vec2::new(u(1), u(2));
                add_triangle(id, &polygon, weight, at, visibility, place, more, out, rays);
            }
            Some((Seen::Panel { panel, polygon }, weight)) => {
                let (panel, place) = (&self.panels[panel as usize], Vec2::new(u(1), u(2)));
                add_panel(panel, &polygon, weight, at, visibility, place, more, out, rays);
            }
            Some((Seen::Punctual { light }, weight)) => {
                let light = &self.punctual[light as usize];
                self.add_punctual(light, weight, at, visibility, || Vec2::ZERO, out, rays);
            }
        }
    }

    /// A light of the tree and the factor on what it sends: one over the probability of its choice, on average.
    ///
    /// Lights are weighed by the irradiance that they send where nothing is in the way, and one is taken in
    /// proportion (resampled importance sampling: Talbot, Cline and Egbert 2005): all of them if they are few, else
    /// those that the tree proposes. Where all are weighed and see the receiver, samples do not scatter at all.
    fn choose(&self, at: &Receiver, visibility: &Visibility, propose: f32, pick: f32) -> Option<(Seen, f32)> {
        let mut pick = f64::from(pick);
        let (mut chosen, mut total) = (None, 0f64);
        let mut weigh = |light: u32, weight: f64| {
            let Some((seen, unshadowed)) = self.look(light, at, visibility) else { return };
            let share = weight * unshadowed;
            total += share;
            // One random number does for all: what is left of it is uniform again.
            let cut = share / total;
            if pick < cut {
                (chosen, pick) = (Some((seen, unshadowed)), pick / cut);
            } else {
                pick = (pick - cut) / (1.0 - cut);
            }
        };
        if self.tree_lights.len() <= WEIGH_ALL_LIMIT {
            (0..self.tree_lights.len() as u32).for_each(|light| weigh(light, 1.0));
        } else {
            self.tree.draw(at.origin, at.geometric_normal, PROPOSALS, propose, weigh);
        }
        chosen.map(|(seen, unshadowed)| (seen, (total / unshadowed) as f32))
    }

    /// A light as `at` sees it, and the irradiance that it sends where nothing is in the way, summed over the
    /// channels (mean of the geometric and the shading normal) [lux]; `None` where that is 0.
    fn look(&self, light: u32, at: &Receiver, visibility: &Visibility) -> Option<(Seen, f64)> {
        match self.tree_lights[light as usize] {
            TreeLight::Triangle { id, both_sides, radiance } => {
                let world = visibility.world;
                let corners = world.positions[id as usize].map(|p| (p - at.origin).as_dvec3());
                let facing = -world.normals[id as usize].as_dvec3().dot(corners[0]);
                if id == at.triangle || facing == 0.0 || (facing < 0.0 && !both_sides) {
                    return None;
                }
                let polygon = SeenPolygon::new(corners, at)?;
                Some((Seen::Triangle { id, polygon }, f64::from(radiance) * polygon.projected()))
            }
            TreeLight::Panel(k) => {
                let panel = &self.panels[k as usize];
                let corners = panel.corners.map(|p| (p - at.origin).as_dvec3());
                if panel.normal.as_dvec3().dot(corners[0]) >= 0.0 {
                    return None;
                }
                let polygon = SeenPolygon::new(corners, at)?;
                let radiance = f64::from(panel.radiance.element_sum());
                Some((Seen::Panel { panel: k, polygon }, radiance * polygon.projected()))
            }
            TreeLight::Punctual(k) => {
                let light = &self.punctual[k as usize];
                let (_, w, falloff) = light.towards(at)?;
                let (geometric, shading) = at.cosines(w);
                let e = light.intensity.element_sum() * falloff * 0.5 * (geometric + shading);
                (e > 0.0).then_some((Seen::Punctual { light: k }, f64::from(e)))
            }
        }
    }

    fn add_punctual(
        &self,
        light: &Punctual,
        weight: f32,
        at: &Receiver,
        visibility: &Visibility,
        u: impl Fn() -> Vec2,
        out: &mut DirectSample,
        rays: &mut u64,
    ) {
        let (direction, t_max, unit, falloff) = match &light.shape {
            Shape::Directional { cos_radius } => {
                let axis = -light.direction;
                let w = if *cos_radius < 1.0 { uniform_cone(axis, *cos_radius, u()) } else { axis };
                (w, f32::INFINITY, w, 1.0)
            }
            Shape::Point | Shape::Profile(_) | Shape::Spot { .. } => {
                let Some((to, w, falloff)) = light.towards(at) else { return };
                (to, HAIR_BEFORE, w, falloff)
            }
        };
        let cosines = at.cosines(unit);
        if cosines.0 <= 0.0 || falloff <= 0.0 {
            return;
        }
        *rays += 1;
        let passed = visibility.transmittance(&Ray { origin: at.origin, direction, t_max });
        if passed != Vec3::ZERO {
            out.add(light.intensity * passed * (falloff * weight), unit, cosines, light.stored);
        }
    }
}

/// Direction with density [`mixture_density`]: cosine about the geometric or, half of the time, the shading
/// normal. Where both agree this is plain cosine sampling.
fn normal_mixture(at: &Receiver, u: Vec2, pick: f32) -> Vec3 {
    let n = if pick < 0.5 { at.geometric_normal } else { at.shading_normal };
    cosine_hemisphere(n, u)
}

fn mixture_density(at: &Receiver, w: Vec3) -> f32 {
    let c = at.geometric_normal.dot(w).max(0.0) + at.shading_normal.dot(w).max(0.0);
    (c * 0.5 * std::f32::consts::FRAC_1_PI).max(1e-12)
}

fn add_sky(
    sky: &SkySampler,
    w: Vec3,
    weight: f32,
    at: &Receiver,
    visibility: &Visibility,
    out: &mut DirectSample,
    rays: &mut u64,
) {
    let cosines = at.cosines(w);
    let radiance = sky.radiance(w);
    if cosines.0 <= 0.0 || radiance == Vec3::ZERO {
        return;
    }
    *rays += 1;
    let passed = visibility.transmittance(&Ray { origin: at.origin, direction: w, t_max: f32::INFINITY });
    let light = radiance * passed * weight;
    out.add(light, w, cosines, true);
    if sky.is_soft(radiance) {
        out.soft += light * cosines.1;
    }
}

/// Light of one point of a triangle. Points are drawn in proportion to what each of them sends, so that the sample
/// is the exact irradiance of the whole triangle, or 0 where something is in the way.
fn add_triangle(
    id: u32,
    polygon: &SeenPolygon,
    weight: f32,
    at: &Receiver,
    visibility: &Visibility,
    u: Vec2,
    more: &mut Stream,
    out: &mut DirectSample,
    rays: &mut u64,
) {
    let world = visibility.world;
    let corners = world.positions[id as usize].map(|p| (p - at.origin).as_dvec3());
    let Some(w) = polygon.sample(u, more) else { return };
    let Some(uv) = barycentric_along(corners, w) else { return };
    let s = world.surface(id, uv);
    let radiance = s.emission * s.alpha;
    if radiance == Vec3::ZERO {
        return;
    }
    let target = world.position(id, uv);
    let normal = world.normals[id as usize];
    let side = normal * normal.dot(at.origin - target).signum();
    let to = accel::offset_origin(target, side, world.extent(id)) - at.origin;
    *rays += 1;
    let passed = visibility.transmittance(&Ray { origin: at.origin, direction: to, t_max: 1.0 });
    out.add_soft(
        radiance * passed * polygon.share(w, weight),
        w.as_vec3(),
        at,
        world.material(id).bake == BakeMode::Full,
    );
}

/// The same of a light with area.
fn add_panel(
    panel: &Panel,
    polygon: &SeenPolygon,
    weight: f32,
    at: &Receiver,
    visibility: &Visibility,
    u: Vec2,
    more: &mut Stream,
    out: &mut DirectSample,
    rays: &mut u64,
) {
    let Some(w) = polygon.sample(u, more) else { return };
    let (direction, towards) = (w.as_vec3(), -panel.normal.dot(w.as_vec3()));
    if towards <= 0.0 {
        return;
    }
    // To where the direction meets the plane of the light.
    let t_max = -panel.normal.dot(panel.corners[0] - at.origin) / towards * HAIR_BEFORE;
    *rays += 1;
    let passed = visibility.transmittance(&Ray { origin: at.origin, direction, t_max });
    out.add_soft(panel.radiance * passed * polygon.share(w, weight), direction, at, panel.stored);
}

/// Barycentric weights where the direction `w` from the origin meets a triangle's plane.
fn barycentric_along(corners: [glam::DVec3; 3], w: glam::DVec3) -> Option<Vec2> {
    let (e1, e2) = (corners[1] - corners[0], corners[2] - corners[0]);
    let p = w.cross(e2);
    let det = e1.dot(p);
    if det == 0.0 {
        return None;
    }
    let s = -corners[0];
    let q = s.cross(e1);
    let (u, v) = (s.dot(p) / det, w.dot(q) / det);
    let (u, v) = (u.clamp(0.0, 1.0), v.clamp(0.0, 1.0));
    let over = (u + v).max(1.0);
    Some(Vec2::new((u / over) as f32, (v / over) as f32))
}

/// Bounds of an emissive triangle; `None` if it emits nothing.
fn triangle_bounds(world: &World, id: u32) -> Option<LightBounds> {
    let flags = world.flags[id as usize];
    if !flags.has(SurfaceFlags::EMITS) || flags.has(SurfaceFlags::DEGENERATE) {
        return None;
    }
    let at = |uv| {
        let s = world.surface(id, uv);
        (s.emission * s.alpha).element_sum()
    };
    let mean = if flags.has(SurfaceFlags::VARIES) {
        // A few looks at the texture; never 0 where the factor is not, so that no lit part is missed.
        let n = 16;
        let r2 = |k: u32, a: f64| (f64::from(k) * a + 0.5).fract() as f32;
        let sum: f32 = (0..n).map(|k| at(uniform_triangle(Vec2::new(r2(k, 0.754_877_67), r2(k, 0.569_840_3))))).sum();
        (sum / n as f32).max(0.01 * world.material(id).emission.element_sum())
    } else {
        at(Vec2::splat(1.0 / 3.0))
    };
    let power = mean * world.area(id) as f32;
    if power <= 0.0 {
        return None;
    }
    let [a, b, c] = world.positions[id as usize];
    Some(LightBounds {
        lo: a.min(b).min(c),
        hi: a.max(b).max(c),
        power,
        axis: world.normals[id as usize],
        cos_spread: 1.0,
        two_sided: world.material(id).double_sided,
        all_around: false,
    })
}
