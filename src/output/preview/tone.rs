//! From scene light to 8-bit sRGB.

use glam::Vec3;

/// Where the mean goes: the 18 % grey of photography.
const KEY: f32 = 0.18;

/// Luminance of a linear Rec. 709 colour (ITU-R BT.709-6, item 3.2).
pub(super) fn luminance(rgb: Vec3) -> f32 {
    rgb.dot(Vec3::new(0.2126, 0.7152, 0.0722))
}

/// Factor that brings a scene of the given mean luminance to [`KEY`]; 0 for a black one.
pub(super) fn exposure(mean: f32) -> f32 {
    if mean > 0.0 && mean.is_finite() { (KEY / mean).min(f32::MAX) } else { 0.0 }
}

/// Logarithmic mean of the luminances above zero, as Reinhard et al., "Photographic Tone Reproduction for
/// Digital Images", 2002, equation 1; 0 without any.
pub(super) fn log_average(luminances: impl Iterator<Item = f32>) -> f32 {
    let (mut sum, mut n) = (0.0, 0u64);
    for l in luminances.filter(|l| *l > 0.0 && l.is_finite()) {
        sum += f64::from(l).ln();
        n += 1;
    }
    if n == 0 { 0.0 } else { (sum / n as f64).exp() as f32 }
}

/// An exposed colour as 8-bit sRGB: the fit of K. Narkowicz, "ACES Filmic Tone Mapping Curve", 2015, without
/// its exposure bias, per channel, then the sRGB curve (IEC 61966-2-1). What is not finite becomes black.
pub(super) fn display(rgb: Vec3) -> [u8; 3] {
    rgb.to_array().map(|x| {
        if !x.is_finite() {
            return 0;
        }
        // Beyond this the curve is flat, and its squares would overflow.
        let x = x.clamp(0.0, 1e6);
        let y = (x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)).clamp(0.0, 1.0);
        let code = if y <= 0.003_130_8 { 12.92 * y } else { 1.055 * y.powf(1.0 / 2.4) - 0.055 };
        (code * 255.0).round() as u8
    })
}
