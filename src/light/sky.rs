//! Directions towards the sky.

use super::distribution::{Distribution, Drawn};
use crate::scene::{CubeMap, Sky, sky_pixel};
use glam::{Vec2, Vec3};
use std::f64::consts::PI;
use std::sync::Arc;

/// Sky brighter than this many times its mean, as the sun in it, casts hard shadows.
const HARD: f64 = 50.0;

/// The sky, ready to be sampled.
#[derive(Debug, Clone)]
pub enum SkySampler {
    /// The same radiance (nit) from everywhere.
    Constant(Vec3),
    /// An image whose bright parts are found by importance.
    Image(SkyImage),
}

/// An image of the sky with the distribution of its brightness. Radiance is constant within a texel, so that look-up
/// and sampling agree exactly.
#[derive(Debug, Clone)]
pub struct SkyImage {
    picture: Picture,
    /// Brightness times solid angle; its total is the sum over the sphere.
    distribution: Distribution,
}

#[derive(Debug, Clone)]
enum Picture {
    Equirectangular { width: usize, height: usize, radiance: Arc<[Vec3]>, rotation: f32 },
    Cube(CubeMap),
}

impl SkySampler {
    /// Prepares to sample `sky`; `None` where it is black.
    pub fn new(sky: &Sky) -> Option<SkySampler> {
        let image = match sky {
            Sky::Constant(l) if l.max_element() <= 0.0 => return None,
            Sky::Constant(l) => return Some(SkySampler::Constant(*l)),
            Sky::Image { width, height, radiance, rotation } => {
                let texel = |x: usize, y: usize| brightness(radiance[y * width + x]);
                let distribution = Distribution::new(*width, *height, texel, |y| solid_angle(*width, *height, y));
                let (width, height, radiance, rotation) = (*width, *height, radiance.clone(), *rotation);
                SkyImage { picture: Picture::Equirectangular { width, height, radiance, rotation }, distribution }
            }
            Sky::Cube(map) => {
                let n = map.size();
                // The faces below one another, each texel with the solid angle of its centre.
                let texel = |x: usize, y: usize| brightness(map.texels()[y * n + x]) * map.solid_angle(x, y % n);
                let distribution = Distribution::new(n, 6 * n, texel, |_| 1.0);
                SkyImage { picture: Picture::Cube(map.clone()), distribution }
            }
        };
        (image.distribution.total > 0.0).then_some(SkySampler::Image(image))
    }

    /// Radiance (nit) from the unit direction `w` (towards the sky).
    pub fn radiance(&self, w: Vec3) -> Vec3 {
        match self {
            SkySampler::Constant(l) => *l,
            SkySampler::Image(image) => image.radiance(w),
        }
    }

    /// Whether sky of this radiance casts soft shadows.
    pub fn is_soft(&self, radiance: Vec3) -> bool {
        match self {
            SkySampler::Constant(_) => true,
            SkySampler::Image(image) => brightness(radiance) <= HARD * image.distribution.total / (4.0 * PI),
        }
    }
}

fn brightness(l: Vec3) -> f64 {
    // The mean of the channels: every channel that carries light can be sampled.
    l.as_dvec3().element_sum()
}

/// Exact solid angle of a texel in row `y` of an equirectangular image [sr].
fn solid_angle(width: usize, height: usize, y: usize) -> f64 {
    let h = height as f64;
    let band = libm::cos(y as f64 / h * PI) - libm::cos((y + 1) as f64 / h * PI);
    band * 2.0 * PI / width as f64
}

impl SkyImage {
    fn radiance(&self, w: Vec3) -> Vec3 {
        match &self.picture {
            Picture::Equirectangular { width, height, radiance, rotation } => {
                radiance[sky_pixel(*width, *height, *rotation, w)]
            }
            Picture::Cube(map) => map.texels()[map.texel(w)],
        }
    }

    /// Direction in proportion to brightness, with its density per solid angle [1/sr].
    pub fn sample(&self, u: Vec2) -> (Vec3, f32) {
        let Drawn { x, y, within: [fx, fy] } = self.distribution.sample(u.to_array());
        let w = match &self.picture {
            Picture::Equirectangular { width, height, rotation, .. } => {
                // Uniform in solid angle inside the texel: linear in cos(theta).
                let h = *height as f64;
                let (c0, c1) = (libm::cos(y as f64 / h * PI), libm::cos((y + 1) as f64 / h * PI));
                let cos_theta = c0 + (c1 - c0) * fy;
                let sin_theta = (1.0 - cos_theta * cos_theta).max(0.0).sqrt();
                let phi = ((x as f64 + fx) / *width as f64 - 0.5) * 2.0 * PI - f64::from(*rotation);
                let (s, c) = libm::sincos(phi);
                Vec3::new((sin_theta * s) as f32, cos_theta as f32, (-sin_theta * c) as f32)
            }
            // Uniform on the face inside the texel.
            Picture::Cube(map) => {
                let n = map.size();
                map.direction(y / n, (x as f64 + fx) as f32, ((y % n) as f64 + fy) as f32)
            }
        };
        // The density that belongs to the direction as rounded, so that both strategies weigh it alike.
        (w, self.density(w))
    }

    /// Density of [`sample`](Self::sample) at the unit direction `w` [1/sr].
    pub fn density(&self, w: Vec3) -> f32 {
        let even = (brightness(self.radiance(w)) / self.distribution.total) as f32;
        match &self.picture {
            Picture::Equirectangular { .. } => even,
            Picture::Cube(map) => {
                // Per area of the face it is even; solid angle per area falls with the cube of the distance.
                let [here, centre] = map.distances(w);
                let farther = here / centre;
                even * (farther * farther * farther)
            }
        }
    }
}
