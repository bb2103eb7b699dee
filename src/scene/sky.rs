//! Light from beyond the geometry.

use super::CubeMap;
use super::texture::MAX_IMAGE_TEXELS;
use crate::error::{SceneError, Warning};
use exr::prelude as exr;
use exr::{ReadChannels, ReadLayers};
use glam::{Quat, Vec3};
use image::ImageDecoder;
use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;

/// Radiance of the surroundings as a function of direction.
#[derive(Debug, Clone)]
pub enum Sky {
    /// The same radiance (nit) from everywhere.
    Constant(Vec3),
    /// An equirectangular image: row 0 is straight up, the centre column looks along -Z, +X is to its right.
    Image {
        /// Width in texels.
        width: usize,
        /// Height in texels.
        height: usize,
        /// Radiance (nit), linear Rec. 709, row-major, non-negative and finite.
        radiance: Arc<[Vec3]>,
        /// Rotation about +Y (rad): positive turns the picture counter-clockwise as seen from above.
        rotation: f32,
    },
    /// Six images on the faces of a cube.
    Cube(CubeMap),
}

/// Index of the pixel of an equirectangular image that the unit direction `w` looks at.
pub(crate) fn sky_pixel(width: usize, height: usize, rotation: f32, w: Vec3) -> usize {
    use std::f64::consts::PI;
    let theta = libm::acos(f64::from(w.y).clamp(-1.0, 1.0));
    let phi = libm::atan2(f64::from(w.x), -f64::from(w.z)) + f64::from(rotation);
    let u = phi / (2.0 * PI) + 0.5;
    let x = ((u - u.floor()) * width as f64) as usize;
    let y = (theta / PI * height as f64) as usize;
    y.min(height - 1) * width + x.min(width - 1)
}

impl Sky {
    /// Radiance (nit) from the unit direction `w`, which points towards the sky.
    pub fn radiance(&self, w: Vec3) -> Vec3 {
        match self {
            Sky::Constant(radiance) => *radiance,
            Sky::Image { width, height, radiance, rotation } => radiance[sky_pixel(*width, *height, *rotation, w)],
            Sky::Cube(map) => map.texels()[map.texel(w)],
        }
    }

    /// The largest channel of the radiance anywhere (nit).
    pub(crate) fn largest(&self) -> f32 {
        let of = |radiance: &[Vec3]| radiance.iter().fold(0.0, |most: f32, l| most.max(l.max_element()));
        match self {
            Sky::Constant(radiance) => of(std::slice::from_ref(radiance)),
            Sky::Image { radiance, .. } => of(radiance),
            Sky::Cube(map) => of(map.texels()),
        }
    }

    /// The same, turned by so many degrees about +Y, counter-clockwise as seen from above, and `scale` times as bright.
    pub fn changed(self, degrees: f32, scale: f32) -> Sky {
        if degrees == 0.0 && scale == 1.0 {
            return self;
        }
        let turn = degrees.to_radians();
        let scaled = |radiance: &[Vec3]| radiance.iter().map(|l| (*l * scale).min(Vec3::MAX)).collect();
        match self {
            Sky::Constant(radiance) => Sky::Constant((radiance * scale).min(Vec3::MAX)),
            Sky::Image { width, height, radiance, rotation } => {
                Sky::Image { width, height, radiance: scaled(&radiance), rotation: rotation + turn }
            }
            Sky::Cube(map) => Sky::Cube(map.turned(Quat::from_rotation_y(turn), scaled(map.texels()))),
        }
    }

    /// Reads an equirectangular `.hdr` (Radiance) or `.exr` (OpenEXR, first layer with R, G and B) file, told
    /// apart by their contents. A stored 1.0 is `scale` nit; `rotation` is in degrees about +Y. Values that
    /// are negative or not finite become 0 and give a warning, as does a picture that is not 2 : 1.
    ///
    /// # Errors
    /// [`SceneError`] names the file and the cure: not readable, neither format, damaged, more than 2^28
    /// texels or more than its bytes can hold, or a `rotation` or `scale` that is not finite (`scale` may not be
    /// negative either).
    pub fn from_file(path: &Path, rotation: f32, scale: f32) -> Result<(Sky, Vec<Warning>), SceneError> {
        let io = |source| SceneError::Io { path: path.into(), source };
        if !path.metadata().map_err(io)?.is_file() {
            let what = "is not a file; give a .hdr or .exr image as the sky".into();
            return Err(SceneError::Invalid { path: path.into(), what });
        }
        Sky::from_bytes(path, &std::fs::read(path).map_err(io)?, rotation, scale)
    }

    /// The contents of such a file; `path` names it in messages.
    ///
    /// # Errors
    /// As [`from_file`](Self::from_file), but for the file system's.
    pub fn from_bytes(path: &Path, bytes: &[u8], rotation: f32, scale: f32) -> Result<(Sky, Vec<Warning>), SceneError> {
        let invalid = |what: String| SceneError::Invalid { path: path.into(), what };
        if !rotation.is_finite() || !scale.is_finite() || scale < 0.0 {
            return Err(invalid(format!(
                "a sky's rotation ({rotation}) must be a number, its scale ({scale}) one from 0"
            )));
        }
        let picture = if bytes.starts_with(b"#?") {
            read_hdr(bytes)
        } else if bytes.starts_with(&[0x76, 0x2f, 0x31, 0x01]) {
            // The decoder fails on some damaged B44 blocks where sums are checked, as in debug builds.
            let read = std::panic::catch_unwind(|| read_exr(bytes));
            read.unwrap_or_else(|_| Err("is damaged (the decoder failed)".into()))
        } else {
            Err("is neither a .hdr nor a .exr image".into())
        };
        let Picture { width, height, mut radiance } =
            picture.map_err(|e| invalid(format!("{e}; convert it to an equirectangular .hdr or .exr image")))?;

        let mut warnings = Vec::new();
        let mut mended = 0;
        for texel in &mut radiance {
            let scaled = *texel * scale;
            if !scaled.is_finite() || scaled.min_element() < 0.0 {
                mended += 1;
            }
            *texel = Vec3::from(scaled.to_array().map(|c| if c.is_finite() { c.max(0.0) } else { 0.0 }));
        }
        let file = path.display();
        if mended > 0 {
            let message = format!("{file}: {mended} texels of the sky are negative or not finite and taken as 0");
            warnings.push(Warning::new("sky-values", message));
        }
        if width != 2 * height {
            let message = format!("{file}: the sky is {width} x {height} texels, not twice as wide as high");
            warnings.push(Warning::new("sky-shape", message));
        }
        Ok((Sky::Image { width, height, radiance: radiance.into(), rotation: rotation.to_radians() }, warnings))
    }
}

/// A decoded image, row-major from the top.
struct Picture {
    width: usize,
    height: usize,
    radiance: Vec<Vec3>,
}

/// Texels of a picture that is read whatever its length: 192 MiB.
const MODEST_TEXELS: u64 = 1 << 24;

/// Most texels of a larger picture that a byte of its file may stand for. ZIP makes a byte of 172 texels of one colour,
/// the runs of .hdr of 16; codes that make more of them do so of pictures that show nothing.
const TEXELS_PER_BYTE: u64 = 512;

/// Whether a picture in so many bytes may be decoded: memory for it is taken before it is read, so that its size alone,
/// which a few bytes can say, must not decide.
fn check_size(width: usize, height: usize, bytes: usize) -> Result<(), String> {
    let texels = (width as u64).checked_mul(height as u64);
    let Some(texels @ 1..=MAX_IMAGE_TEXELS) = texels else {
        return Err(format!("has {width} x {height} texels, outside 1 to {MAX_IMAGE_TEXELS}"));
    };
    if texels > MODEST_TEXELS.max((bytes as u64).saturating_mul(TEXELS_PER_BYTE)) {
        let what = "are too few for them: it is cut off, or of one colour and can be smaller";
        return Err(format!("has {width} x {height} texels, but its {bytes} bytes {what}"));
    }
    Ok(())
}

fn read_hdr(bytes: &[u8]) -> Result<Picture, String> {
    let damaged = |e: image::ImageError| format!("is damaged ({e})");
    let decoder = image::codecs::hdr::HdrDecoder::new(Cursor::new(bytes)).map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    check_size(width as usize, height as usize, bytes.len())?;
    // The header's EXPOSURE has already been multiplied into the values.
    let exposure = decoder.metadata().exposure.filter(|e| e.is_finite() && *e > 0.0).unwrap_or(1.0);
    let picture = image::DynamicImage::from_decoder(decoder).map_err(damaged)?.into_rgb32f();
    let radiance = picture.pixels().map(|p| Vec3::from(p.0) / exposure).collect();
    Ok(Picture { width: width as usize, height: height as usize, radiance })
}

fn read_exr(bytes: &[u8]) -> Result<Picture, String> {
    let damaged = |e: exr::Error| format!("is damaged or has no R, G and B ({e})");
    let meta = exr::MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(damaged)?;
    for header in &meta.headers {
        check_size(header.layer_size.width(), header.layer_size.height(), bytes.len())?;
    }
    let image = exr::read()
        .no_deep_data()
        .largest_resolution_level()
        .rgb_channels(
            |size, _| Picture {
                width: size.width(),
                height: size.height(),
                radiance: vec![Vec3::ZERO; size.width() * size.height()],
            },
            |picture: &mut Picture, at, (r, g, b): (f32, f32, f32)| {
                picture.radiance[at.y() * picture.width + at.x()] = Vec3::new(r, g, b);
            },
        )
        .first_valid_layer()
        .all_attributes()
        // Nobody could catch a panic in threads of the decoder's own.
        .non_parallel()
        .from_buffered(Cursor::new(bytes))
        .map_err(damaged)?;
    Ok(image.layer_data.channel_data.pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(name: &str, bytes: &[u8]) -> Result<(Sky, Vec<Warning>), SceneError> {
        Sky::from_bytes(Path::new(name), bytes, 90.0, 2.0)
    }

    fn exr_bytes(texel: [f32; 3]) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        let channels = exr::SpecificChannels::rgb(move |at: exr::Vec2<usize>| {
            let [r, g, b] = if at.x() == 0 { texel } else { [1.0, 2.0, 3.0] };
            (r, g, b)
        });
        exr::WritableImage::write(&exr::Image::from_channels((4, 2), channels)).to_buffered(&mut bytes).unwrap();
        bytes.into_inner()
    }

    fn hdr_bytes() -> Vec<u8> {
        let mut bytes = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=4\n\n-Y 2 +X 4\n".to_vec();
        // 128 * 2^(131 - 136) = 4 in each channel.
        bytes.extend([128, 128, 128, 131].repeat(8));
        bytes
    }

    #[test]
    fn exr_values_are_scaled_and_mended() {
        let (Sky::Image { width, height, radiance, rotation }, warnings) =
            load("s.exr", &exr_bytes([f32::NAN, -1.0, 5.0])).unwrap()
        else {
            panic!("an image")
        };
        assert_eq!((width, height), (4, 2));
        assert_eq!(radiance[0], Vec3::new(0.0, 0.0, 10.0));
        assert_eq!(radiance[5], Vec3::new(2.0, 4.0, 6.0));
        assert_eq!(rotation, std::f32::consts::FRAC_PI_2);
        assert_eq!(warnings.iter().map(|w| w.code).collect::<Vec<_>>(), ["sky-values"]);
    }

    #[test]
    fn hdr_exposure_is_taken_back() {
        let (sky, warnings) = load("s.hdr", &hdr_bytes()).unwrap();
        let Sky::Image { radiance, .. } = sky else { panic!("an image") };
        assert_eq!(radiance[3], Vec3::splat(4.0 / 4.0 * 2.0));
        assert!(warnings.is_empty());
    }

    #[test]
    fn damage_is_an_error() {
        for good in [exr_bytes([1.0; 3]), hdr_bytes()] {
            for cut in 0..good.len() {
                let _ = load("s", &good[..cut]);
                let mut bad = good.clone();
                for flip in [0x01, 0x80, 0xff] {
                    bad[cut] = good[cut] ^ flip;
                    let _ = load("s", &bad);
                }
            }
        }
        let huge = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2000000000 +X 2000000000\n";
        assert!(load("s.hdr", huge).unwrap_err().to_string().contains("texels"));
        assert!(load("s.hdr", b"hello").is_err());
    }

    #[test]
    fn the_sky_image_lies_as_documented() {
        let sky = |rotation: f32| Sky::Image {
            width: 4,
            height: 2,
            radiance: (0..8).map(|i| Vec3::splat(i as f32)).collect::<Arc<[Vec3]>>(),
            rotation,
        };
        let look = |sky: &Sky, x: f32, y: f32, z: f32| sky.radiance(Vec3::new(x, y, z).normalize()).x;
        // Just right of the centre is column 2, +X is three quarters to the right, below is row 1.
        assert_eq!(look(&sky(0.0), 0.1, 0.5, -1.0), 2.0);
        assert_eq!(look(&sky(0.0), 1.0, 0.5, 0.1), 3.0);
        assert_eq!(look(&sky(0.0), 0.1, -0.5, -1.0), 6.0);
        // Turned counter-clockwise from above by 90 degrees, what was at -Z is at -X.
        assert_eq!(look(&sky(std::f32::consts::FRAC_PI_2), -1.0, 0.5, -0.1), 2.0);
    }
}
