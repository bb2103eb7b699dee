//! Images, decoded when they are first looked at.

use glam::{Vec2, Vec4};
use std::sync::{Arc, OnceLock};

/// How a coordinate outside [0, 1] is brought back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Wrap {
    /// The fraction of the coordinate.
    #[default]
    Repeat,
    /// Back and forth.
    Mirror,
    /// The border texel.
    Clamp,
}

/// How texel values become linear numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColorSpace {
    /// RGB is sRGB-encoded, alpha is linear.
    Srgb,
    /// All channels are linear.
    Linear,
}

/// An image with its sampler. Decoding happens on the first look-up; an image that cannot be decoded is
/// white and `decode_error` says why.
#[derive(Debug)]
pub struct Texture {
    /// Name of the image, its file, or `image N`.
    pub name: String,
    /// The file's bytes (PNG, JPEG, WebP).
    pub encoded: Arc<[u8]>,
    /// Wrapping in u and v.
    pub wrap: [Wrap; 2],
    /// Nearest-neighbour magnification instead of bilinear.
    pub nearest: bool,
    pub(super) image: OnceLock<Result<Image, String>>,
}

/// Decoded texels, row 0 at v = 0.
#[derive(Debug)]
pub(super) struct Image {
    pub(super) width: u32,
    pub(super) height: u32,
    /// Four bytes each, as the decoder left them: a copy would be the largest thing that a scene makes us hold.
    pub(super) rgba: Vec<u8>,
}

/// Largest number of texels an input image may have: 16384 x 16384.
pub const MAX_IMAGE_TEXELS: u64 = 1 << 28;

impl Texture {
    /// An image not decoded yet.
    pub fn new(name: String, encoded: Arc<[u8]>, wrap: [Wrap; 2], nearest: bool) -> Texture {
        Texture { name, encoded, wrap, nearest, image: OnceLock::new() }
    }

    fn image(&self) -> Result<&Image, &String> {
        self.image.get_or_init(|| decode(&self.encoded)).as_ref()
    }

    /// Whether anybody looked at it yet.
    pub fn is_decoded(&self) -> bool {
        self.image.get().is_some()
    }

    /// Why the image could not be decoded, if it was looked at.
    pub fn known_decode_error(&self) -> Option<&str> {
        self.image.get()?.as_ref().err().map(String::as_str)
    }

    /// Decodes now; the reason where that fails.
    pub fn decode_error(&self) -> Option<String> {
        self.image().err().cloned()
    }

    /// Bilinear (or nearest) value at `uv`, linear RGBA in [0, 1]; white where the image cannot be decoded.
    pub fn sample(&self, uv: Vec2, space: ColorSpace) -> Vec4 {
        let Ok(image) = self.image() else { return Vec4::ONE };
        let size = [image.width as i64, image.height as i64];
        let texels: &[[u8; 4]] = bytemuck::cast_slice(&image.rgba);
        let fetch = |x: i64, y: i64| {
            let x = wrap(x, size[0], self.wrap[0]);
            let y = wrap(y, size[1], self.wrap[1]);
            decode_texel(texels[(y * size[0] + x) as usize], space)
        };
        // Non-finite coordinates land on texel 0 instead of anywhere.
        let at = |v: f32, n: i64| if v.is_finite() { (v - v.floor() + v.floor() % 1024.0) * n as f32 } else { 0.0 };
        let (x, y) = (at(uv.x, size[0]), at(uv.y, size[1]));
        if self.nearest {
            return fetch(x.floor() as i64, y.floor() as i64);
        }
        let (fx, fy) = (x - 0.5, y - 0.5);
        let (x0, y0) = (fx.floor(), fy.floor());
        let (tx, ty) = (fx - x0, fy - y0);
        let (x0, y0) = (x0 as i64, y0 as i64);
        let top = fetch(x0, y0) * (1.0 - tx) + fetch(x0 + 1, y0) * tx;
        let bottom = fetch(x0, y0 + 1) * (1.0 - tx) + fetch(x0 + 1, y0 + 1) * tx;
        top * (1.0 - ty) + bottom * ty
    }
}

fn wrap(i: i64, n: i64, mode: Wrap) -> i64 {
    match mode {
        Wrap::Repeat => i.rem_euclid(n),
        Wrap::Clamp => i.clamp(0, n - 1),
        Wrap::Mirror => {
            let k = i.rem_euclid(2 * n);
            if k < n { k } else { 2 * n - 1 - k }
        }
    }
}

fn decode_texel(t: [u8; 4], space: ColorSpace) -> Vec4 {
    match space {
        ColorSpace::Linear => Vec4::new(t[0] as f32, t[1] as f32, t[2] as f32, t[3] as f32) / 255.0,
        ColorSpace::Srgb => {
            let lut = srgb_table();
            Vec4::new(lut[t[0] as usize], lut[t[1] as usize], lut[t[2] as usize], t[3] as f32 / 255.0)
        }
    }
}

/// Linear value of each 8-bit sRGB code (IEC 61966-2-1).
pub(crate) fn srgb_table() -> &'static [f32; 256] {
    static TABLE: OnceLock<[f32; 256]> = OnceLock::new();
    TABLE.get_or_init(|| {
        std::array::from_fn(|i| {
            let c = i as f64 / 255.0;
            (if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }) as f32
        })
    })
}

fn decode(bytes: &[u8]) -> Result<Image, String> {
    let reader =
        image::ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format().map_err(|e| e.to_string())?;
    let (w, h) = reader.into_dimensions().map_err(|e| e.to_string())?;
    if w == 0 || h == 0 || u64::from(w) * u64::from(h) > MAX_IMAGE_TEXELS {
        return Err(format!("{w} x {h} texels is outside 1 to {MAX_IMAGE_TEXELS}"));
    }
    let image = image::load_from_memory(bytes).map_err(|e| e.to_string())?.into_rgba8();
    Ok(Image { width: w, height: h, rgba: image.into_raw() })
}
