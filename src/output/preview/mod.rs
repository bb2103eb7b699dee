//! Pictures to look at: the maps themselves, and the scene as an engine would show it.
//!
//! In: a finished lightmap, and for scene pictures the world and a way to trace rays. Out: 8-bit sRGB images.
//! Nothing is computed anew: a scene picture shows what the maps hold, seams, noise and all.

mod backs;
mod camera;
mod render;
mod tone;

pub use backs::render_backs;
pub use camera::choose_camera;
pub use render::{RenderSettings, render};

use crate::error::BakeError;
use crate::lightmap::LightmapPage;
use image::ImageEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use std::path::Path;

/// An 8-bit sRGB image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbImage {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// R, G, B per pixel, row-major from the top left.
    pub rgb: Vec<u8>,
}

impl RgbImage {
    /// The image as a PNG file in memory; equal images give equal bytes.
    ///
    /// # Errors
    /// [`BakeError::Io`] where the image has no pixels or not `3 * width * height` values.
    pub fn to_png(&self) -> Result<Vec<u8>, BakeError> {
        self.to_filtered_png(FilterType::default())
    }

    /// [`to_png`](Self::to_png) with a chosen filter: few flat colours are smaller without any.
    pub(super) fn to_filtered_png(&self, filter: FilterType) -> Result<Vec<u8>, BakeError> {
        let (width, height) = (self.width, self.height);
        let invalid = |why: &dyn std::fmt::Display| {
            let why = format!("{width} x {height} pixels cannot be encoded: {why}");
            BakeError::Io { path: "a preview".into(), source: std::io::Error::other(why) }
        };
        if self.rgb.len() as u64 != 3 * u64::from(width) * u64::from(height) || self.rgb.is_empty() {
            return Err(invalid(&"it needs at least one pixel, and three values per pixel"));
        }
        let mut png = Vec::new();
        PngEncoder::new_with_quality(&mut png, CompressionType::default(), filter)
            .write_image(&self.rgb, width, height, image::ExtendedColorType::Rgb8)
            .map_err(|e| invalid(&e))?;
        Ok(png)
    }

    /// Writes the image as a PNG file.
    ///
    /// # Errors
    /// As [`RgbImage::to_png`], and [`BakeError::Io`] where the file cannot be written.
    pub fn write_png(&self, path: &Path) -> Result<(), BakeError> {
        super::write_atomically(path, &self.to_png()?)
    }
}

/// A page as an image, gutters included, exposed for the mean irradiance of the surface on it.
pub fn page_image(page: &LightmapPage) -> RgbImage {
    let (mut sum, mut area) = (0.0, 0.0);
    for (e, &a) in page.irradiance.iter().zip(&page.area) {
        let luminance = tone::luminance((*e).into());
        if luminance.is_finite() {
            sum += f64::from(luminance) * f64::from(a);
            area += f64::from(a);
        }
    }
    let mean = if area > 0.0 { (sum / area) as f32 } else { 0.0 };
    let exposure = tone::exposure(mean);
    let rgb = page.irradiance.iter().flat_map(|&e| tone::display(glam::Vec3::from(e) * exposure)).collect();
    RgbImage { width: page.width, height: page.height, rgb }
}

/// [`page_image`] as a PNG file in memory.
///
/// # Errors
/// As [`RgbImage::to_png`].
pub fn page_png(page: &LightmapPage) -> Result<Vec<u8>, BakeError> {
    page_image(page).to_png()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_of_one_brightness_is_mid_grey_whatever_its_unit() {
        let grey = |e: f32| {
            let page = LightmapPage {
                width: 2,
                height: 2,
                irradiance: vec![[e; 3]; 4],
                area: vec![1.0; 4],
                ..Default::default()
            };
            page_image(&page).rgb[0]
        };
        assert_eq!(grey(1e-6), grey(1e6));
        assert!((100..160).contains(&grey(1.0)), "{}", grey(1.0));
    }

    #[test]
    fn a_black_or_broken_page_gives_a_picture_all_the_same() {
        let mut page = LightmapPage { width: 2, height: 1, ..Default::default() };
        page.irradiance = vec![[0.0; 3], [f32::NAN; 3]];
        page.area = vec![1.0; 2];
        assert!(page_png(&page).is_ok());
        assert!(page_image(&page).rgb.iter().all(|&v| v == 0));
        assert!(page_png(&LightmapPage::default()).is_err());
    }
}
