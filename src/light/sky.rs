//! Directions towards the sky.

use crate::scene::{Sky, sky_pixel};
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

/// An equirectangular image with the distribution of its brightness. Radiance is constant within a pixel, so
/// that look-up and sampling agree exactly.
#[derive(Debug, Clone)]
pub struct SkyImage {
    width: usize,
    height: usize,
    radiance: Arc<[Vec3]>,
    rotation: f32,
    /// Cumulative brightness of rows, then of the pixels of each row, each normalised to end at 1.
    rows: Vec<f64>,
    columns: Vec<f32>,
    /// Sum of brightness times solid angle over the sphere.
    total: f64,
}

impl SkySampler {
    /// Prepares to sample `sky`; `None` where it is black.
    pub fn new(sky: &Sky) -> Option<SkySampler> {
        match sky {
            Sky::Constant(l) if l.max_element() <= 0.0 => None,
            Sky::Constant(l) => Some(SkySampler::Constant(*l)),
            Sky::Image { width, height, radiance, rotation } => {
                let mut image = SkyImage {
                    width: *width,
                    height: *height,
                    radiance: radiance.clone(),
                    rotation: *rotation,
                    rows: Vec::with_capacity(*height),
                    columns: Vec::with_capacity(width * height),
                    total: 0.0,
                };
                image.distribute();
                (image.total > 0.0).then_some(SkySampler::Image(image))
            }
        }
    }

    /// Radiance (nit) from the unit direction `w` (towards the sky).
    pub fn radiance(&self, w: Vec3) -> Vec3 {
        match self {
            SkySampler::Constant(l) => *l,
            SkySampler::Image(image) => image.radiance[image.pixel(w)],
        }
    }

    /// Whether sky of this radiance casts soft shadows.
    pub fn is_soft(&self, radiance: Vec3) -> bool {
        match self {
            SkySampler::Constant(_) => true,
            SkySampler::Image(image) => brightness(radiance) <= HARD * image.total / (4.0 * PI),
        }
    }
}

fn brightness(l: Vec3) -> f64 {
    // The mean of the channels: every channel that carries light can be sampled.
    l.as_dvec3().element_sum()
}

impl SkyImage {
    fn distribute(&mut self) {
        let mut sum_rows = 0.0;
        for y in 0..self.height {
            let solid = self.pixel_solid_angle(y);
            let mut sum = 0.0f64;
            let first = self.columns.len();
            for x in 0..self.width {
                sum += brightness(self.radiance[y * self.width + x]);
                self.columns.push(sum as f32);
            }
            if sum > 0.0 {
                self.columns[first..].iter_mut().for_each(|c| *c = (f64::from(*c) / sum) as f32);
            }
            sum_rows += sum * solid;
            self.rows.push(sum_rows);
        }
        self.total = sum_rows;
        if sum_rows > 0.0 {
            self.rows.iter_mut().for_each(|r| *r /= sum_rows);
        }
    }

    /// Exact solid angle of a pixel in row `y` [sr].
    fn pixel_solid_angle(&self, y: usize) -> f64 {
        let h = self.height as f64;
        let band = libm::cos(y as f64 / h * PI) - libm::cos((y + 1) as f64 / h * PI);
        band * 2.0 * PI / self.width as f64
    }

    fn pixel(&self, w: Vec3) -> usize {
        sky_pixel(self.width, self.height, self.rotation, w)
    }

    /// Direction in proportion to brightness, with its density per solid angle [1/sr].
    pub fn sample(&self, u: Vec2) -> (Vec3, f32) {
        let v = f64::from(u.y);
        let y = self.rows.partition_point(|&r| r <= v).min(self.height - 1);
        let below = if y == 0 { 0.0 } else { self.rows[y - 1] };
        let fy = ((v - below) / (self.rows[y] - below).max(1e-300)).clamp(0.0, 1.0);
        let row = &self.columns[y * self.width..(y + 1) * self.width];
        let x = row.partition_point(|&c| c <= u.x).min(self.width - 1);
        let left = if x == 0 { 0.0 } else { row[x - 1] };
        let fx = f64::from(((u.x - left) / (row[x] - left).max(1e-30)).clamp(0.0, 1.0));
        // Uniform in solid angle inside the pixel: linear in cos(theta).
        let h = self.height as f64;
        let (c0, c1) = (libm::cos(y as f64 / h * PI), libm::cos((y + 1) as f64 / h * PI));
        let cos_theta = c0 + (c1 - c0) * fy;
        let sin_theta = (1.0 - cos_theta * cos_theta).max(0.0).sqrt();
        let phi = ((x as f64 + fx) / self.width as f64 - 0.5) * 2.0 * PI - f64::from(self.rotation);
        let (s, c) = libm::sincos(phi);
        let w = Vec3::new((sin_theta * s) as f32, cos_theta as f32, (-sin_theta * c) as f32);
        // The density that belongs to the direction as rounded, so that both strategies weigh it alike.
        (w, self.density(w))
    }

    /// Density of [`sample`](Self::sample) at the unit direction `w` [1/sr].
    pub fn density(&self, w: Vec3) -> f32 {
        (brightness(self.radiance[self.pixel(w)]) / self.total) as f32
    }
}
