//! EXT_lights_image_based: a cube map around the scene.
//!
//! Of its prefiltered images the sharpest six, for roughness 0, are the radiance of the surroundings; the irradiance
//! of every point follows from them, so that the coefficients of irradiance that the file also has are only compared.
//!
//! *Unit.* The extension calls its values lux. They are taken as nit, times `intensity`: that is what a mirror shows of
//! them, and what the coefficients, pi times as large, agree with.
//! *Encoding.* RGB is sRGB-encoded, as in all colour images of glTF. An image with an alpha channel is RGBD: its linear
//! RGB is divided by alpha, as Babylon.js packs it.
//! *Orientation.* The extension asks for the faces of OpenGL mirrored left to right, which is how they look from inside
//! in glTF's right-handed space. Where they join better as OpenGL has them, the file was written so, and is read so.

use super::light::light_index;
use super::reader::{REPAIR, Reader};
use crate::error::SceneError;
use crate::scene::{CubeMap, Sky, srgb_table};
use glam::{Quat, Vec3};
use image::{DynamicImage, ImageFormat, ImageReader};
use serde::Deserialize;
use serde_json::Value;
use std::borrow::Cow;
use std::io::Cursor;

/// The list of lights, as messages call it.
pub(super) const SURROUNDINGS: &str = "EXT_lights_image_based.lights";

/// Most texels along an edge of a face: six faces then have the texels of 100 million.
const MAX_SIZE: u32 = 2048;

/// Value of the spherical harmonic of degree 0.
const Y_00: f32 = 0.282_094_8;

/// The mean irradiance that the coefficients speak of may be this many times that of the images, or one over it:
/// what encodings and filters differ by.
const ALIKE: f32 = 1.25;

/// The surroundings that a scene names; `None` where it names none.
///
/// # Errors
/// [`SceneError`] names the light or image that is missing, damaged or too large.
pub(super) fn read(reader: &mut Reader, scene: usize) -> Result<Option<Sky>, SceneError> {
    let by = reader.label("scenes", scene);
    let extension = reader.value("scenes", scene, "the file")?.pointer("/extensions/EXT_lights_image_based");
    let Some(extension) = extension else { return Ok(None) };
    let index = light_index(reader, extension, "EXT_lights_image_based", &by)?;
    let light = reader.value(SURROUNDINGS, index, &by)?;
    let label = reader.label(SURROUNDINGS, index);
    let intensity =
        match light.get("intensity") {
            None => 1.0,
            Some(value) => value.as_f64().filter(|i| *i >= 0.0 && *i <= 1e30).ok_or_else(|| {
                reader.invalid(format!("{label} has the intensity {value}, no number from 0; {REPAIR}"))
            })? as f32,
        };
    let rotation = read_rotation(reader, light, &label)?;
    let (size, mut radiance) = read_faces(reader, light, &label)?;
    if joins_mirrored(size, &radiance) {
        mirror(size, &mut radiance);
        let what =
            "the faces join only if each is mirrored left to right, which the extension asks of the file; they are";
        reader.warn("sky-mirrored", format!("{label}: {what}"));
    }
    radiance.iter_mut().for_each(|l| *l *= intensity);
    let map = CubeMap::new(size, radiance.into(), rotation);
    compare_irradiance(reader, light, &label, map.mean() * std::f32::consts::PI, intensity);
    Ok(Some(Sky::Cube(map)))
}

fn read_rotation(reader: &Reader, light: &Value, label: &str) -> Result<Quat, SceneError> {
    let Some(value) = light.get("rotation") else { return Ok(Quat::IDENTITY) };
    let rotation = <[f32; 4]>::deserialize(value).ok().map(Quat::from_array);
    rotation
        .filter(|q| q.length() > 0.0 && q.length().is_finite())
        .map(Quat::normalize)
        .ok_or_else(|| reader.invalid(format!("{label} has the rotation {value}, no quaternion; {REPAIR}")))
}

/// Edge [texels] and radiance [nit, before the intensity] of the sharpest six images.
fn read_faces(reader: &mut Reader, light: &Value, label: &str) -> Result<(usize, Vec<Vec3>), SceneError> {
    let faces = light.pointer("/specularImages/0").and_then(|faces| <[usize; 6]>::deserialize(faces).ok());
    let Some(faces) = faces else {
        return Err(reader.invalid(format!("{label} has no specularImages with six indices in the first; {REPAIR}")));
    };
    // All sizes are looked at before anything is decoded.
    let mut encoded = Vec::with_capacity(6);
    for image in faces {
        let bytes = image_bytes(reader, image, label)?;
        let (format, size) = look(&bytes)
            .map_err(|what| reader.invalid(format!("{} of {label} {what}", reader.label("images", image))))?;
        encoded.push((image, bytes, format, size));
    }
    let size = encoded[0].3;
    if let Some((image, _, _, other)) = encoded.iter().find(|e| e.3 != size) {
        let image = reader.label("images", *image);
        return Err(reader.invalid(format!(
            "{image} of {label} has {other} x {other} texels, but the first face {size} x {size}; make them alike"
        )));
    }
    if light.get("specularImageSize").and_then(Value::as_f64) != Some(f64::from(size)) {
        let said = light.get("specularImageSize").map_or("none".into(), Value::to_string);
        let message = format!("{label} has the specularImageSize {said}, but images of {size} x {size} texels");
        reader.warn("sky-size", message);
    }
    let mut radiance = Vec::with_capacity(6 * (size * size) as usize);
    for (image, bytes, format, _) in encoded {
        let picture = image::load_from_memory_with_format(&bytes, format).map_err(|e| {
            reader.invalid(format!("{} of {label} is damaged ({e}); {REPAIR}", reader.label("images", image)))
        })?;
        decode(picture, &mut radiance);
    }
    Ok((size as usize, radiance))
}

/// Bytes of an image; for a sky there is nothing to take in its place.
fn image_bytes<'d>(reader: &Reader<'d>, index: usize, by: &str) -> Result<Cow<'d, [u8]>, SceneError> {
    let label = reader.label("images", index);
    let bytes = reader.image_bytes(reader.value("images", index, by)?, &label)?;
    bytes.ok_or_else(|| reader.invalid(format!("{label} of {by} has neither a uri nor a bufferView; {REPAIR}")))
}

/// Format and edge [texels] of an image that can be a face.
fn look(bytes: &[u8]) -> Result<(ImageFormat, u32), String> {
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| e.to_string())?;
    let format = reader.format().filter(|f| matches!(f, ImageFormat::Png | ImageFormat::Jpeg));
    let format = format.ok_or("is neither PNG nor JPEG; the extension allows no others")?;
    let (width, height) = reader.into_dimensions().map_err(|e| format!("is damaged ({e}); {REPAIR}"))?;
    if width != height || !(1..=MAX_SIZE).contains(&width) {
        return Err(format!("has {width} x {height} texels; a face is square, with 1 to {MAX_SIZE} along an edge"));
    }
    Ok((format, width))
}

/// Appends linear radiance.
fn decode(picture: DynamicImage, out: &mut Vec<Vec3>) {
    let table = srgb_table();
    let packed = picture.color().has_alpha();
    out.extend(picture.into_rgba8().pixels().map(|p| {
        let [r, g, b, d] = p.0;
        let linear = Vec3::from([r, g, b].map(|c| table[usize::from(c)]));
        // The least divisor that can be stored stands where there is none.
        if packed { linear * (255.0 / f32::from(d.max(1))) } else { linear }
    }));
}

/// True where the four upright faces join better if each is mirrored: that of +X with -Z on its right then, else with
/// +Z. What joins as well either way, as an even sky, is not mirrored.
fn joins_mirrored(size: usize, radiance: &[Vec3]) -> bool {
    let column = |face: usize, x: usize, y: usize| radiance[(face * size + y) * size + x];
    // Relative to the brightness, so that a sun on a seam does not decide alone.
    let apart = |a: Vec3, b: Vec3| f64::from((a - b).abs().element_sum() / (a + b).element_sum().max(1e-20));
    let seams = |order: [usize; 4]| -> f64 {
        let pairs = order.iter().zip(order.iter().cycle().skip(1)).take(4);
        let joined = |(&left, &right): (&usize, &usize)| {
            (0..size).map(|y| apart(column(left, size - 1, y), column(right, 0, y))).sum::<f64>()
        };
        pairs.map(joined).sum()
    };
    // Faces from left to right around the horizon.
    let [as_asked, unmirrored] = [seams([0, 4, 1, 5]), seams([0, 5, 1, 4])];
    size > 1 && as_asked > 0.0 && unmirrored < 0.5 * as_asked
}

/// Turns every face over, left to right.
fn mirror(size: usize, radiance: &mut [Vec3]) {
    radiance.chunks_exact_mut(size).for_each(<[Vec3]>::reverse);
}

/// Says so where the file's coefficients of irradiance contradict its images. The first is the mean irradiance over
/// Y_00, whatever the signs and the order that the others were written with.
fn compare_irradiance(reader: &mut Reader, light: &Value, label: &str, of_images: Vec3, intensity: f32) {
    let coefficients = light.get("irradianceCoefficients").and_then(|c| <[[f32; 3]; 9]>::deserialize(c).ok());
    let Some([first, ..]) = coefficients else {
        let message = format!("{label} has no nine irradianceCoefficients; a bake needs only its images");
        return reader.warn("sky-irradiance", message);
    };
    let said = (Vec3::from(first) * Y_00 * intensity).element_sum() / 3.0;
    let found = of_images.element_sum() / 3.0;
    if !(found / ALIKE..=found * ALIKE).contains(&said) {
        let message = format!(
            "{label}: its irradianceCoefficients speak of {said} lux on average, its images of {found}; the images are baked"
        );
        reader.warn("sky-irradiance", message);
    }
}
