//! Filters that turn decoded attributes into what accessors expect, in place. Values that the specification does
//! not define become some number, never a panic: casts saturate, and not-a-number becomes 0.

/// What is stored in place of the attribute.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Filter {
    /// Itself.
    None,
    /// A unit vector as a point of an octahedron.
    Octahedral,
    /// A unit quaternion without its largest component.
    Quaternion,
    /// Floats as exponent and mantissa.
    Exponential,
    /// Colours as luma and chroma.
    Color,
}

impl Filter {
    /// The filter of a `filter` property.
    pub(super) fn parse(name: &str) -> Option<Filter> {
        Some(match name {
            "NONE" => Filter::None,
            "OCTAHEDRAL" => Filter::Octahedral,
            "QUATERNION" => Filter::Quaternion,
            "EXPONENTIAL" => Filter::Exponential,
            "COLOR" => Filter::Color,
            _ => return None,
        })
    }

    /// True where the filter knows elements of so many bytes.
    pub(super) fn takes(self, stride: usize) -> bool {
        match self {
            Filter::None => true,
            Filter::Octahedral | Filter::Color => matches!(stride, 4 | 8),
            Filter::Quaternion => stride == 8,
            Filter::Exponential => stride.is_multiple_of(4),
        }
    }

    /// Applies the filter to elements of `stride` bytes, which it must take.
    pub(super) fn apply(self, data: &mut [u8], stride: usize) {
        let wide = stride == 8;
        match self {
            Filter::None => {}
            Filter::Octahedral if wide => shorts(data, |v| octahedral(v, 32767.0).map(|c| c as i16)),
            Filter::Octahedral => {
                for v in data.chunks_exact_mut(4) {
                    let decoded = octahedral([0, 1, 2, 3].map(|c| i16::from(v[c] as i8)), 127.0);
                    decoded.iter().zip(v).for_each(|(&c, b)| *b = c as i8 as u8);
                }
            }
            Filter::Quaternion => shorts(data, quaternion),
            Filter::Exponential => {
                for word in data.chunks_exact_mut(4) {
                    word.copy_from_slice(&exponential([word[0], word[1], word[2], word[3]]).to_le_bytes());
                }
            }
            Filter::Color if wide => {
                shorts(data, |v| color(v.map(|c| c as u16 as i32), v.map(i32::from), 65535.0).map(|c| c as u16 as i16));
            }
            Filter::Color => {
                for v in data.chunks_exact_mut(4) {
                    let bytes = [v[0], v[1], v[2], v[3]];
                    let decoded = color(bytes.map(i32::from), bytes.map(|c| i32::from(c as i8)), 255.0);
                    decoded.iter().zip(v).for_each(|(&c, b)| *b = c as u8);
                }
            }
        }
    }
}

/// Replaces each four 16-bit numbers.
fn shorts(data: &mut [u8], decode: impl Fn([i16; 4]) -> [i16; 4]) {
    for element in data.chunks_exact_mut(8) {
        let v = [0, 2, 4, 6].map(|at| i16::from_le_bytes([element[at], element[at + 1]]));
        decode(v).iter().zip(element.chunks_exact_mut(2)).for_each(|(c, b)| b.copy_from_slice(&c.to_le_bytes()));
    }
}

/// x and y on the octahedron, and 1 in the same units; the fourth number is passed through. `max` is 1 in the
/// units of the result.
fn octahedral(v: [i16; 4], max: f32) -> [f32; 4] {
    let [x, y, one] = [v[0], v[1], v[2]].map(f32::from);
    let (mut x, mut y) = (x / one, y / one);
    let z = 1.0 - x.abs() - y.abs();
    // The far half of the octahedron is folded over.
    let t = z.min(0.0);
    x -= t.copysign(x);
    y -= t.copysign(y);
    let length = (x * x + y * y + z * z).sqrt();
    let [x, y, z] = [x, y, z].map(|c| (c / length * max).round());
    [x, y, z, f32::from(v[3])]
}

/// Three components over sqrt(1/2), and 1 in the same units but for the two lowest bits, which say which
/// component is left out.
fn quaternion(v: [i16; 4]) -> [i16; 4] {
    let scale = std::f32::consts::FRAC_1_SQRT_2 / f32::from(v[3] | 3);
    let [x, y, z] = [v[0], v[1], v[2]].map(|c| f32::from(c) * scale);
    let w = (1.0 - x * x - y * y - z * z).max(0.0).sqrt();
    let largest = (v[3] & 3) as usize;
    let mut out = [0; 4];
    for (k, c) in [w, x, y, z].into_iter().enumerate() {
        out[(largest + k) % 4] = (c * 32767.0).round() as i16;
    }
    out
}

/// A signed mantissa of 24 bits and a signed exponent of 8: m 2^e.
fn exponential(b: [u8; 4]) -> f32 {
    let word = i32::from_le_bytes(b);
    let (exponent, mantissa) = (word >> 24, word << 8 >> 8);
    // 2^e is a normal f64 for every e of 8 bits, and the product exact.
    let power = f64::from_bits(((1023 + exponent) as u64) << 52);
    (f64::from(mantissa) * power) as f32
}

/// Y, Co, Cg of K bits, and alpha of K - 1 bits below a bit that is set; the components without and with sign.
/// `max` is 1 in the units of the result.
fn color(unsigned: [i32; 4], signed: [i32; 4], max: f32) -> [f32; 4] {
    let one = ((1u32 << (32 - unsigned[3].leading_zeros())) - 1) as i32;
    let (y, co, cg) = (unsigned[0], signed[1], signed[2]);
    let half = unsigned[3] & (one >> 1);
    // Alpha has one bit less than the others; its lowest is doubled.
    let alpha = half << 1 | half & 1;
    let scale = max / one as f32;
    [y + co - cg, y + cg, y - co - cg, alpha].map(|c| (c as f32 * scale).round())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(filter: Filter, v: [i8; 4]) -> [i8; 4] {
        let mut data = v.map(|c| c as u8);
        filter.apply(&mut data, 4);
        data.map(|c| c as i8)
    }

    fn words(filter: Filter, v: [i16; 4]) -> [i16; 4] {
        let mut data: Vec<u8> = v.iter().flat_map(|c| c.to_le_bytes()).collect();
        filter.apply(&mut data, 8);
        [0, 2, 4, 6].map(|at| i16::from_le_bytes([data[at], data[at + 1]]))
    }

    #[test]
    fn corners_and_faces_of_the_octahedron() {
        let decode = |v| bytes(Filter::Octahedral, v);
        assert_eq!(decode([0, 0, 127, 5]), [0, 0, 127, 5]);
        assert_eq!(decode([127, 0, 127, -5]), [127, 0, 0, -5]);
        assert_eq!(decode([0, -31, 31, 0]), [0, -127, 0, 0]);
        assert_eq!(decode([-127, 127, 127, 0]), [0, 0, -127, 0]);
        // The middle of a face: 127 / sqrt(3) = 73.3.
        let (third, face) = (10_000, (32767.0 / 3f64.sqrt()).round() as i16);
        assert_eq!(words(Filter::Octahedral, [third, -third, 30_000, 9]), [face, -face, face, 9]);
        assert_eq!(words(Filter::Octahedral, [-2 * third, 2 * third, 30_000, 9]), [-face, face, -face, 9]);
    }

    #[test]
    fn quaternions_get_their_largest_component_back() {
        let decode = |v| words(Filter::Quaternion, v);
        assert_eq!(decode([0, 0, 0, 32767]), [0, 0, 0, 32767]);
        assert_eq!(decode([0, 0, 0, 32764]), [32767, 0, 0, 0]);
        // A quarter turn, in 12 bits: both components are sqrt(1/2), stored as 1. The largest is the second.
        let half = (32767.0 * std::f64::consts::FRAC_1_SQRT_2).round() as i16;
        assert_eq!(decode([2047, 0, 0, 2045]), [0, half, half, 0]);
    }

    #[test]
    fn exponent_and_mantissa() {
        let decode = |e: i32, m: i32| exponential((e << 24 | m & 0xff_ffff).to_le_bytes());
        assert_eq!(decode(-3, 5), 0.625);
        assert_eq!(decode(0, -(1 << 23)), -8_388_608.0);
        assert_eq!(decode(100, 3), 3.0 * 2f32.powi(100));
        assert_eq!(decode(-100, -1), -(2f32.powi(-100)));
        assert_eq!(decode(-128, 0), 0.0);
    }

    #[test]
    fn luma_and_chroma() {
        // K = 8: (200, 100, 51, 255): Co = 74, t = 51 + 74 = 125, Cg = -12, Y = 113, alpha 127 below bit 7.
        let data = bytes(Filter::Color, [113, 74, -12, -1]);
        assert_eq!(data.map(|c| c as u8), [199, 101, 51, 255], "Co and Cg were halved downwards");
        // K = 4: white is 15 of 15; alpha 0.
        assert_eq!(bytes(Filter::Color, [15, 0, 0, 8]).map(|c| c as u8), [255, 255, 255, 0]);
        assert_eq!(words(Filter::Color, [15, 0, 0, 15]).map(|c| c as u16), [65535; 4]);
    }
}
