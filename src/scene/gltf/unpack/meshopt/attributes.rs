//! Mode ATTRIBUTES, versions 0 and 1: elements of `stride` bytes as differences from the element before, stored
//! byte position by byte position in blocks of at most 256 elements and groups of 16.

use super::stream::Stream;

/// Elements per group: their differences are stored with one number of bits.
const GROUP: usize = 16;

/// Most elements of a block.
const MOST_IN_BLOCK: usize = 256;

/// Bits of a difference by the two header bits of its group. All ones stand for a whole byte that follows.
const WIDTHS_V0: [u32; 4] = [0, 2, 4, 8];
/// The same in version 1, by control mode.
const WIDTHS_V1: [[u32; 4]; 2] = [[0, 1, 2, 4], [1, 2, 4, 8]];

/// The `count` elements of an encoded stream.
///
/// - `stride` must be a multiple of 4 from 4 to 256.
/// - Memory is taken for what the stream can hold at most: about a thousand bytes for each of its own.
///
/// # Errors
/// What is wrong with the stream.
pub(super) fn decode(stream: &[u8], count: usize, stride: usize) -> Result<Vec<u8>, &'static str> {
    let (version, body) = match stream.split_first() {
        Some((0xa0, body)) => (0, body),
        Some((0xa1, body)) => (1, body),
        _ => return Err("it has no header of attributes of version 0 or 1"),
    };
    let channels = stride / 4;
    let tail = if version == 0 { stride } else { stride + channels };
    // The least sizes of the tail with its padding, as the specification gives them.
    let padded_tail = tail.max(if version == 0 { 32 } else { 24 });
    let end = body.len().checked_sub(padded_tail).ok_or(super::stream::CUT_OFF)?;
    let (baseline, modes) = body[body.len() - tail..].split_at(stride);
    let modes: Vec<Channel> = match version {
        0 => vec![Channel::Bytes; channels],
        _ => modes.iter().map(|&m| Channel::new(m)).collect::<Result<_, _>>()?,
    };

    let most = ((8192 / stride) & !(GROUP - 1)).min(MOST_IN_BLOCK);
    // Each block has a header of a byte per channel at least, so that a count cannot ask for memory by itself.
    if count.div_ceil(most).checked_mul(channels).is_none_or(|least| least > end) {
        return Err(super::stream::CUT_OFF);
    }
    let mut data = Stream::new(&body[..end]);
    let mut last = baseline.to_vec();
    let mut out = vec![0; count.checked_mul(stride).ok_or("it has too many elements")?];
    for block in out.chunks_mut(most * stride) {
        let n = block.len() / stride;
        let control = if version == 0 { &[][..] } else { data.bytes(channels)? };
        let mut deltas = [[0; MOST_IN_BLOCK]; 4];
        for (channel, mode) in modes.iter().enumerate() {
            for (j, deltas) in deltas.iter_mut().enumerate() {
                match control.get(channel).map(|c| usize::from(c >> (2 * j) & 3)) {
                    None => read_groups(&mut data, n, WIDTHS_V0, deltas)?,
                    Some(2) => deltas[..n].fill(0),
                    Some(3) => deltas[..n].copy_from_slice(data.bytes(n)?),
                    Some(mode) => read_groups(&mut data, n, WIDTHS_V1[mode], deltas)?,
                }
            }
            let at = 4 * channel;
            let mut value: [u8; 4] = [last[at], last[at + 1], last[at + 2], last[at + 3]];
            for (i, element) in block.chunks_exact_mut(stride).enumerate() {
                value = mode.next(value, [deltas[0][i], deltas[1][i], deltas[2][i], deltas[3][i]]);
                element[at..at + 4].copy_from_slice(&value);
            }
            last[at..at + 4].copy_from_slice(&value);
        }
    }
    data.finish().map(|()| out)
}

/// Reads the differences of one byte position of `n` elements.
fn read_groups(
    data: &mut Stream,
    n: usize,
    widths: [u32; 4],
    deltas: &mut [u8; MOST_IN_BLOCK],
) -> Result<(), &'static str> {
    let groups = n.div_ceil(GROUP);
    let header = data.bytes(groups.div_ceil(4))?;
    for (g, deltas) in deltas.chunks_exact_mut(GROUP).take(groups).enumerate() {
        let width = widths[usize::from(header[g / 4] >> (2 * (g % 4)) & 3)];
        match width {
            0 => deltas.fill(0),
            8 => deltas.copy_from_slice(data.bytes(GROUP)?),
            _ => {
                let packed = data.bytes(GROUP * width as usize / 8)?;
                let sentinel = (1u8 << width) - 1;
                let per_byte = 8 / width;
                for (i, delta) in (0..).zip(deltas) {
                    let k = i % per_byte;
                    // Single bits are stored from the lowest on, wider ones from the highest.
                    let shift = if width == 1 { k } else { (per_byte - 1 - k) * width };
                    *delta = packed[(i / per_byte) as usize] >> shift & sentinel;
                    if *delta == sentinel {
                        *delta = data.byte()?;
                    }
                }
            }
        }
    }
    Ok(())
}

/// How the four bytes of a channel follow from those of the element before.
#[derive(Clone, Copy)]
enum Channel {
    /// Zigzag differences of bytes.
    Bytes,
    /// Zigzag differences of 16-bit numbers.
    Words,
    /// Exclusive or with a 32-bit number, which the encoder rotated left by so many bits.
    Xor(u32),
}

impl Channel {
    fn new(mode: u8) -> Result<Channel, &'static str> {
        match (mode & 15, mode >> 4) {
            (0, 0) => Ok(Channel::Bytes),
            (1, 0) => Ok(Channel::Words),
            (2, turn) => Ok(Channel::Xor(u32::from(turn))),
            _ => Err("it has an unknown channel mode"),
        }
    }

    fn next(self, last: [u8; 4], delta: [u8; 4]) -> [u8; 4] {
        match self {
            Channel::Bytes => {
                std::array::from_fn(|j| last[j].wrapping_add(delta[j] >> 1 ^ (delta[j] & 1).wrapping_neg()))
            }
            Channel::Words => {
                let word = |b: [u8; 4], j: usize| u16::from_le_bytes([b[j], b[j + 1]]);
                let add = |j: usize| {
                    let d = word(delta, j);
                    word(last, j).wrapping_add(d >> 1 ^ (d & 1).wrapping_neg()).to_le_bytes()
                };
                let ([a, b], [c, d]) = (add(0), add(2));
                [a, b, c, d]
            }
            Channel::Xor(turn) => {
                (u32::from_le_bytes(last) ^ u32::from_le_bytes(delta).rotate_right(turn)).to_le_bytes()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Element `i` of what meshoptimizer 1.0 encoded below: numbers of 16 bits, a float, shifted noise, bytes.
    fn element(i: u32) -> Vec<u8> {
        let noise = i.wrapping_mul(2_654_435_761) >> 24;
        let mut bytes = Vec::new();
        bytes.extend(((3 * i * i) as u16).to_le_bytes());
        bytes.extend(((1000 - 17 * i) as u16).to_le_bytes());
        bytes.extend((0.5 * i as f32).to_le_bytes());
        bytes.extend((noise << 4).to_le_bytes());
        bytes.extend([i as u8, 7, noise as u8, (i / 5) as u8]);
        bytes
    }

    const V0: &str = "a0070006121e2a36424e5a66727e8a96a2aefc000000bac6d205000008088000000007002121212121212121212121212121\
        21fc00000021212101000000040000070000ff80804040404020202020202020fc00000020101005308000007e8000000007\
        003f3f3f3f1f3f3f3f3f1f3f3f3f1f3ffc0000003f3f3f060fbfbbfbfdbfbbfb121414141414fc000000140b0d0000052aaa\
        aaaaa8000000000700c3c3c3c3c1c3c3c3c3c1c3c3c3c1c3fc000000c3c3c301002008020000000000000000000000000000\
        00000000e803000000000000000000070000";
    /// With every control mode, and the channel modes bytes, words, and exclusive or turned by 4 and by 5 bits.
    const V1: &str = "a1bb68ae390006121e2a36424e5a66727e8a96a2aebac6d200212121212121212121212121212121212121011200070f020f\
        f8f4c4f262e262e010f81c07003e0103009ea2e6a26fa2e6a27ea1e2a662afe2a6629e052aaaaaaaa800000000c3c3c3c3c1\
        c3c3c3c3c1c3c3c3c1c3c3c3c30200200802000000000000e80300000000000000000007000001524200";

    fn bytes(hex: &str) -> Vec<u8> {
        hex.as_bytes().chunks(2).map(|d| u8::from_str_radix(std::str::from_utf8(d).unwrap(), 16).unwrap()).collect()
    }

    #[test]
    fn both_versions_decode_what_the_reference_encoded() {
        let expected: Vec<u8> = (0..19).flat_map(element).collect();
        for stream in [V0, V1] {
            assert_eq!(decode(&bytes(stream), 19, 16).as_ref(), Ok(&expected));
        }
    }

    /// The example of the specification: sixteen differences, 4 bits each, two of them as whole bytes.
    #[test]
    fn the_example_of_the_specification() {
        let deltas = [0x17, 0x5f, 0xf0, 0xbc, 0x77, 0xa9, 0x21, 0x00, 0x34, 0xb5];
        let mut stream = vec![0xa0, 2];
        stream.extend(deltas);
        stream.extend([0, 0, 0]);
        stream.extend([0; 32]);
        let expected = [-1i8, -4, -3, 26, -91, 0, -6, 6, -4, -4, 5, -5, 1, -1, 0, 0];
        let decoded = decode(&stream, 16, 4).unwrap();
        let mut sum = 0i8;
        for (element, delta) in decoded.chunks(4).zip(expected) {
            sum = sum.wrapping_add(delta);
            assert_eq!(element, [sum as u8, 0, 0, 0]);
        }
    }

    #[test]
    fn wrong_lengths_are_refused() {
        let stream = bytes(V1);
        for cut in 0..stream.len() {
            assert!(decode(&stream[..cut], 19, 16).is_err());
        }
        assert!(decode(&stream, 18, 16).is_err() && decode(&stream, 19, 12).is_err());
        assert!(decode(&stream, usize::MAX, 16).is_err() && decode(&stream, 1 << 40, 256).is_err());
        let mut mode = stream.clone();
        *mode.last_mut().unwrap() = 3;
        assert!(decode(&mode, 19, 16).is_err());
    }
}
