//! The sky on a day without clouds.
//!
//! Hosek and Wilkie, "An analytic model for full spectral sky-dome radiance", 2012, with the data for Rec. 709 primaries.

use super::Sky;
use glam::{DVec3, Vec3};
use hw_skymodel::rgb::{SkyParams, SkyState};
use std::f64::consts::PI;

/// What a clear sky depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClearSky {
    /// Haze: 2 is very clear, 3 usual, 10 a milky sky. In [1, 10].
    pub turbidity: f32,
    /// Reflectance of the ground all around, which lights the sky from below, in [0, 1].
    pub ground: f32,
    /// Unit direction towards the sun, above the horizon; +Y is up.
    pub towards_sun: DVec3,
}

/// Pixels from straight up to straight down: 0.35 degrees each.
const HEIGHT: usize = 512;

/// Luminous efficacy of the watts that colour matching functions weigh [lm/W].
const EFFICACY: f64 = 683.0;

impl ClearSky {
    /// The sky as an image, dark below the horizon and without the sun itself; `scale` times what the model says.
    ///
    /// # Errors
    /// Says what is out of range.
    pub fn image(&self, scale: f32) -> Result<Sky, String> {
        let elevation = libm::asin(self.towards_sun.y.clamp(-1.0, 1.0));
        if !(0.0..=0.5 * PI).contains(&elevation) {
            return Err("the sun of a clear sky must not be below the horizon".into());
        }
        // Rounding must not lift it over the zenith.
        let elevation = (elevation as f32).min(std::f32::consts::FRAC_PI_2);
        let parameters = SkyParams { elevation, turbidity: self.turbidity, albedo: [self.ground; 3] };
        let state = SkyState::new(&parameters).map_err(|e| e.to_string())?;
        let (parameters, levels) = state.raw();
        let channels: [Channel; 3] = std::array::from_fn(|c| Channel {
            level: f64::from(levels[c]) * EFFICACY * f64::from(scale),
            p: std::array::from_fn(|k| f64::from(parameters[9 * c + k])),
        });
        let (width, height) = (2 * HEIGHT, HEIGHT);
        let mut radiance = vec![Vec3::ZERO; width * height];
        for y in 0..height / 2 {
            let (sin, cos) = libm::sincos((y as f64 + 0.5) * PI / height as f64);
            for x in 0..width {
                let (s, c) = libm::sincos(((x as f64 + 0.5) / width as f64 - 0.5) * 2.0 * PI);
                let cos_gamma = DVec3::new(sin * s, cos, -sin * c).dot(self.towards_sun);
                let of = |channel: &Channel| channel.radiance(cos, cos_gamma.clamp(-1.0, 1.0)).max(0.0) as f32;
                radiance[y * width + x] = Vec3::from(channels.each_ref().map(of)).min(Vec3::MAX);
            }
        }
        Ok(Sky::Image { width, height, radiance: radiance.into(), rotation: 0.0 })
    }
}

/// The model for one primary.
struct Channel {
    /// Factor on the distribution [nit].
    level: f64,
    /// A to I of the paper's equation 8, in the order of its data.
    p: [f64; 9],
}

impl Channel {
    /// Radiance (nit) from where the angles to the zenith and to the sun have these cosines. Reckoned here rather than by
    /// the crate, for the same bits on every machine.
    fn radiance(&self, cos_theta: f64, cos_gamma: f64) -> f64 {
        let [a, b, c, d, e, f, g, i, h] = self.p;
        let haze = (1.0 + cos_gamma * cos_gamma) / libm::pow(1.0 + h * h - 2.0 * h * cos_gamma, 1.5);
        let glow = d * libm::exp(e * libm::acos(cos_gamma));
        let rest = c + glow + f * cos_gamma * cos_gamma + g * haze + i * cos_theta.sqrt();
        self.level * (1.0 + a * libm::exp(b / (cos_theta + 0.01))) * rest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hw_skymodel::rgb::Channel as Primary;

    fn sky(turbidity: f32, elevation: f64, azimuth: f64) -> (Sky, DVec3) {
        let ((se, ce), (sa, ca)) = (elevation.to_radians().sin_cos(), azimuth.to_radians().sin_cos());
        let towards_sun = DVec3::new(sa * ce, se, -ca * ce);
        (ClearSky { turbidity, ground: 0.2, towards_sun }.image(1.0).expect("in range"), towards_sun)
    }

    fn luminance(c: Vec3) -> f64 {
        f64::from(c.dot(Vec3::new(0.2126, 0.7152, 0.0722)))
    }

    /// Illuminance of the sky on open ground, by the pixels of the image.
    fn on_the_ground(sky: &Sky) -> f64 {
        let Sky::Image { width, height, radiance, .. } = sky else { panic!("an image") };
        let theta = |y: usize| y as f64 * PI / *height as f64;
        let rows = (0..height / 2).map(|y| {
            // The integral of cos sin over the row is half the difference of sin^2.
            let weight = 0.5 * (theta(y + 1).sin().powi(2) - theta(y).sin().powi(2)) * 2.0 * PI / *width as f64;
            weight * radiance[y * width..(y + 1) * width].iter().map(|&c| luminance(c)).sum::<f64>()
        });
        rows.sum()
    }

    /// Clear-sky illuminance of the IES (RP-21, 1984): 0.8 + 15.5 sqrt(sin elevation) klux, on a very clear day.
    #[test]
    fn the_ground_gets_what_was_measured() {
        for elevation in [5.0, 10.0, 20.0, 45.0, 60.0, 80.0] {
            let measured = 1000.0 * (0.8 + 15.5 * f64::to_radians(elevation).sin().sqrt());
            let found = on_the_ground(&sky(2.0, elevation, 30.0).0);
            assert!((found / measured - 1.08).abs() < 0.1, "{elevation}: {found} lux, measured {measured}");
        }
    }

    /// Each pixel is what the crate says of its direction.
    #[test]
    fn the_model_is_the_crates() {
        let (turbidity, elevation) = (3.5, 35.0);
        let (Sky::Image { width, height, radiance, .. }, towards_sun) = sky(turbidity, elevation, 70.0) else {
            panic!("an image")
        };
        let parameters = SkyParams { elevation: (elevation as f32).to_radians(), turbidity, albedo: [0.2; 3] };
        let state = SkyState::new(&parameters).expect("in range");
        for (x, y) in [(0, 0), (100, 40), (512, 200), (711, 156), (900, 255)] {
            let (theta, phi) =
                ((y as f64 + 0.5) * PI / height as f64, ((x as f64 + 0.5) / width as f64 - 0.5) * 2.0 * PI);
            let w = DVec3::new(theta.sin() * phi.sin(), theta.cos(), -theta.sin() * phi.cos());
            let gamma = w.dot(towards_sun).clamp(-1.0, 1.0).acos();
            let expected =
                [Primary::R, Primary::G, Primary::B].map(|c| 683.0 * state.radiance(theta as f32, gamma as f32, c));
            let found = radiance[y * width + x];
            assert!(
                found.distance(Vec3::from(expected)) < 2e-3 * found.length(),
                "{x}, {y}: {found}, not {expected:?}"
            );
        }
    }

    #[test]
    fn it_is_brightest_at_the_sun_blue_above_and_dark_below() {
        let (sky, sun) = sky(2.5, 30.0, 120.0);
        let at = |w: DVec3| sky.radiance(w.normalize().as_vec3());
        let bright = luminance(at(sun));
        for w in [DVec3::Y, -DVec3::Z, DVec3::new(-sun.x, sun.y, -sun.z), sun + DVec3::Y * 0.3] {
            assert!(luminance(at(w)) < bright);
        }
        let above = at(DVec3::new(-sun.x, 2.0, -sun.z));
        assert!(above.z > above.y && above.y > above.x, "{above}");
        assert_eq!(at(DVec3::new(0.3, -0.1, 0.2)), Vec3::ZERO);
    }

    #[test]
    fn what_is_out_of_range_is_said() {
        let of = |turbidity, ground, y: f64| {
            let towards_sun = DVec3::new((1.0 - y * y).sqrt(), y, 0.0);
            ClearSky { turbidity, ground, towards_sun }.image(1.0)
        };
        assert!(of(0.5, 0.2, 0.5).is_err() && of(11.0, 0.2, 0.5).is_err() && of(2.0, 1.5, 0.5).is_err());
        assert!(of(2.0, 0.2, -0.1).expect_err("below").contains("horizon"));
        assert!(of(2.0, 0.2, 1.0).is_ok() && of(2.0, 0.2, 0.0).is_ok());
    }
}
