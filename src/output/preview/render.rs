//! The scene as an engine shows it: albedo times baked light plus emission, along straight rays.

use super::{RgbImage, tone};
use crate::accel::{self, Hit, Ray};
use crate::atlas::Atlas;
use crate::lightmap::Lightmap;
use crate::scene::{Camera, Projection, Sky, SurfaceFlags, World};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::f32::consts::FRAC_1_PI;

/// How a picture is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RenderSettings {
    /// Width in pixels, > 0. Default: 960.
    pub width: u32,
    /// Height in pixels, > 0. Default: 540.
    pub height: u32,
    /// Paint surfaces without a place on the map magenta instead of with the mean light. Default: false.
    pub mark_unmapped: bool,
}

impl Default for RenderSettings {
    fn default() -> Self {
        RenderSettings { width: 960, height: 540, mark_unmapped: false }
    }
}

/// Places of the four rays in a pixel: a rotated grid, no two in the same row, column or half.
const PATTERN: [Vec2; 4] =
    [Vec2::new(0.125, 0.625), Vec2::new(0.375, 0.125), Vec2::new(0.625, 0.875), Vec2::new(0.875, 0.375)];

/// Surfaces that a ray may pass before it is given up.
const MAX_LAYERS: usize = 64;

/// Renders the scene from its maps. `closest` traces a ray through the triangles of `world`, in its frame.
///
/// Exposure is set by the logarithmic mean of what is not sky. Backs of one-sided surfaces are not there, as
/// engines cull them; metals are mirrors, however rough, and glass is clear and straight; surfaces without a map get
/// the mean irradiance. The result does not depend on the number of threads.
pub fn render(
    world: &World,
    closest: &(impl Fn(&Ray) -> Option<Hit> + Sync),
    atlas: &Atlas,
    lightmap: &Lightmap,
    camera: &Camera,
    sky: Option<&Sky>,
    settings: &RenderSettings,
) -> RgbImage {
    let (width, height) = (settings.width, settings.height);
    let fallback = if settings.mark_unmapped { None } else { Some(mean_irradiance(lightmap)) };
    let view = View { world, closest, atlas, lightmap, sky, fallback };
    let rays = CameraRays::new(world, camera, width as f32 / height.max(1) as f32);
    // Light and whether a surface was seen.
    let samples: Vec<[(Vec3, bool); 4]> = (0..width as usize * height as usize)
        .into_par_iter()
        .map(|i| {
            let pixel = Vec2::new((i % width as usize) as f32, (i / width as usize) as f32);
            PATTERN.map(|offset| {
                let at = (pixel + offset) / Vec2::new(width as f32, height as f32) * 2.0 - 1.0;
                view.trace(rays.ray(at))
            })
        })
        .collect();
    let seen = |wanted: bool| {
        let chosen = samples.iter().flatten().filter(move |s| s.1 == wanted);
        tone::log_average(chosen.map(|s| tone::luminance(s.0)))
    };
    let surface = seen(true);
    let exposure = tone::exposure(if surface > 0.0 { surface } else { seen(false) });
    let rgb = samples
        .par_iter()
        .flat_map_iter(|pixel| {
            // The mean of displayed colours, so that one ray into a lamp does not spoil an edge.
            let shown = pixel.map(|s| tone::display(s.0 * exposure).map(u32::from));
            (0..3).map(move |c| ((shown.iter().map(|s| s[c]).sum::<u32>() + 2) / 4) as u8)
        })
        .collect();
    RgbImage { width, height, rgb }
}

struct View<'a, F> {
    world: &'a World<'a>,
    closest: &'a F,
    atlas: &'a Atlas,
    lightmap: &'a Lightmap,
    sky: Option<&'a Sky>,
    /// Light of surfaces without a map; `None`: magenta.
    fallback: Option<Vec3>,
}

impl<F: Fn(&Ray) -> Option<Hit>> View<'_, F> {
    /// Radiance [nit] that arrives against a ray, and whether it comes from a surface rather than the sky.
    fn trace(&self, mut ray: Ray) -> (Vec3, bool) {
        let (mut light, mut throughput, mut surface_seen) = (Vec3::ZERO, Vec3::ONE, false);
        for _ in 0..MAX_LAYERS {
            let Some(hit) = (self.closest)(&ray) else {
                let sky = self.sky.map_or(Vec3::ZERO, |sky| sky.radiance(ray.direction.normalize()));
                return (light + throughput * sky, surface_seen);
            };
            let uv = Vec2::new(hit.u, hit.v);
            let mut mirrored = None;
            let flags = self.world.flags[hit.triangle as usize];
            let back = ray.direction.dot(self.world.normals[hit.triangle as usize]) > 0.0;
            if !back || flags.has(SurfaceFlags::DOUBLE_SIDED) {
                let surface = self.world.surface(hit.triangle, uv);
                let e = self.irradiance(hit.triangle, uv, back);
                let (normal, way) = (self.world.normals[hit.triangle as usize], ray.direction.normalize());
                surface_seen |= surface.alpha > 0.0;
                let mut sent = surface.albedo * e;
                if surface.diffuse_transmittance != Vec3::ZERO {
                    sent += surface.diffuse_transmittance * self.irradiance(hit.triangle, uv, !back);
                }
                light += throughput * surface.alpha * (sent * FRAC_1_PI + surface.emission);
                let metal = surface.specular.map_or(Vec3::ZERO, |s| s.metal_color * s.metal);
                // One way to go on must do: the brighter.
                let passed = surface.passed(normal.dot(way)) + surface.seen_through();
                if metal.max_element() > passed.max_element() {
                    throughput *= metal;
                    mirrored = Some(self.mirrored(&hit, if back { -normal } else { normal }, way));
                } else {
                    throughput *= passed;
                }
            }
            // Less than half a step of an 8-bit image is left.
            if throughput.max_element() < 1.0 / 512.0 {
                break;
            }
            match mirrored {
                Some(back) => ray = back,
                None => ray.origin = self.behind(&ray, &hit),
            }
        }
        (light, surface_seen)
    }

    /// The ray that a mirror sends back.
    fn mirrored(&self, hit: &Hit, facing: Vec3, way: Vec3) -> Ray {
        let uv = Vec2::new(hit.u, hit.v);
        let shading = self.world.shading_normal(hit.triangle, uv);
        let shading = if shading.dot(facing) < 0.0 { -shading } else { shading };
        let turned = way.reflect(shading);
        let direction = if turned.dot(facing) > 0.0 { turned } else { way.reflect(facing) };
        let extent = self.world.extent(hit.triangle);
        let origin = accel::offset_origin(self.world.position(hit.triangle, uv), facing, extent);
        Ray { origin, direction, t_max: f32::INFINITY }
    }

    /// A point just behind a hit, a few units in the last place away.
    fn behind(&self, ray: &Ray, hit: &Hit) -> Vec3 {
        let at = self.world.position(hit.triangle, Vec2::new(hit.u, hit.v));
        at + ray.direction * (16.0 * f32::EPSILON * at.abs().max_element().max(0.01))
    }

    /// Irradiance [lux] at a point of a triangle, filtered as a GPU would.
    fn irradiance(&self, triangle: u32, uv: Vec2, back: bool) -> Vec3 {
        let unmapped = self.fallback.unwrap_or(Vec3::new(1.0, 0.0, 1.0));
        let place = self.atlas.texel_coordinates(self.world.scene, self.world.refs[triangle as usize]);
        let Some((page, [a, b, c], _)) = place else { return unmapped };
        let Some(page) = self.lightmap.pages.get(page as usize) else { return unmapped };
        let at = a * (1.0 - uv.x - uv.y) + b * uv.x + c * uv.y;
        let values = if back && !page.back.is_empty() { &page.back } else { &page.irradiance };
        page.filtered(values, at.as_dvec2()).unwrap_or(unmapped)
    }
}

/// Mean irradiance over the surface on all pages.
fn mean_irradiance(lightmap: &Lightmap) -> Vec3 {
    let (mut sum, mut area) = (glam::DVec3::ZERO, 0.0);
    for page in &lightmap.pages {
        for (e, &a) in page.irradiance.iter().zip(&page.area) {
            let e = Vec3::from(*e);
            if e.is_finite() {
                sum += e.as_dvec3() * f64::from(a);
                area += f64::from(a);
            }
        }
    }
    if area > 0.0 { (sum / area).as_vec3() } else { Vec3::ZERO }
}

/// Turns points of the image into rays of the frame.
pub(super) struct CameraRays {
    origin: Vec3,
    forward: Vec3,
    right: Vec3,
    up: Vec3,
    parallel: bool,
}

impl CameraRays {
    pub(super) fn new(world: &World, camera: &Camera, aspect: f32) -> CameraRays {
        let forward = camera.forward.normalize_or(Vec3::NEG_Z);
        let right = forward.cross(camera.up).try_normalize().unwrap_or_else(|| forward.any_orthonormal_vector());
        let up = right.cross(forward);
        let metres = world.frame.metres as f32;
        let (half_width, half_height) = match camera.projection {
            Projection::Perspective { vertical_fov, aspect: file_aspect } => {
                let tan = (vertical_fov.clamp(0.01, 3.1) * 0.5).tan();
                // A picture narrower than the camera's keeps the camera's width in view.
                let scale = file_aspect.map_or(1.0, |a| (a / aspect).max(1.0));
                (tan * scale * aspect, tan * scale)
            }
            Projection::Orthographic { half_width, half_height } => {
                let scale = (half_width / (half_height * aspect)).max(1.0);
                (half_height * scale * aspect / metres, half_height * scale / metres)
            }
        };
        CameraRays {
            origin: world.frame.from_world(camera.position),
            forward,
            right: right * half_width,
            up: up * half_height,
            parallel: matches!(camera.projection, Projection::Orthographic { .. }),
        }
    }

    /// Ray through a point of the image, (-1, -1) at its top left.
    pub(super) fn ray(&self, at: Vec2) -> Ray {
        let aside = self.right * at.x - self.up * at.y;
        let (origin, direction) = match self.parallel {
            true => (self.origin + aside, self.forward),
            false => (self.origin, (self.forward + aside).normalize()),
        };
        Ray { origin, direction, t_max: f32::INFINITY }
    }
}
