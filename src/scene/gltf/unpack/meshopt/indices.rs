//! Modes TRIANGLES and INDICES: vertex indices by what was seen just before.

use super::stream::{CUT_OFF, Stream};

/// Entries that a stream can look back to.
const FIFO: usize = 16;

/// What is said of a stream that looks back too far.
const UNSEEN: &str = "it refers to what was not there before";

/// The last [`FIFO`] values, the most recent at 0.
struct Fifo<T> {
    values: [T; FIFO],
    written: usize,
}

impl<T: Copy + Default> Fifo<T> {
    fn new() -> Fifo<T> {
        Fifo { values: [T::default(); FIFO], written: 0 }
    }

    fn push(&mut self, value: T) {
        self.values[self.written % FIFO] = value;
        self.written += 1;
    }

    fn get(&self, back: usize) -> Result<T, &'static str> {
        if back < self.written.min(FIFO) { Ok(self.values[(self.written - 1 - back) % FIFO]) } else { Err(UNSEEN) }
    }
}

/// Indices counted up, indices given as a difference, edges and vertices of recent triangles.
struct Recent {
    next: u32,
    last: u32,
    edges: Fifo<[u32; 2]>,
    vertices: Fifo<u32>,
}

impl Recent {
    fn next(&mut self) -> u32 {
        let index = self.next;
        self.next = index.wrapping_add(1);
        index
    }

    fn explicit(&mut self, data: &mut Stream) -> Result<u32, &'static str> {
        let v = data.varint()?;
        self.last = self.last.wrapping_add(zigzag(v));
        Ok(self.last)
    }

    /// 0: the next index; 1 to 14: a recent one; 15: one that is read later.
    fn short(&mut self, code: u8) -> Result<u32, &'static str> {
        match code {
            0 => Ok(self.next()),
            15 => Ok(0),
            _ => self.vertices.get(usize::from(code) - 1),
        }
    }

    /// A triangle that starts with edge (a, b) of an earlier one.
    fn beside_edge(&mut self, edge: u8, code: u8, data: &mut Stream) -> Result<[u32; 3], &'static str> {
        let [a, b] = self.edges.get(usize::from(edge))?;
        let c = match code {
            0 => self.next(),
            13 => self.last.wrapping_sub(1),
            14 => self.last.wrapping_add(1),
            15 => self.explicit(data)?,
            _ => self.vertices.get(usize::from(code))?,
        };
        if matches!(code, 13 | 14) {
            self.last = c;
        }
        if !(1..13).contains(&code) {
            self.vertices.push(c);
        }
        self.edges.push([c, b]);
        self.edges.push([a, c]);
        Ok([a, b, c])
    }

    /// A triangle of three vertices by a code each.
    fn apart(&mut self, codes: [u8; 3], data: &mut Stream) -> Result<[u32; 3], &'static str> {
        let mut corners = [self.short(codes[0])?, self.short(codes[1])?, self.short(codes[2])?];
        for (corner, code) in corners.iter_mut().zip(codes) {
            if code == 15 {
                *corner = self.explicit(data)?;
            }
        }
        let [a, b, c] = corners;
        for edge in [[b, a], [c, b], [a, c]] {
            self.edges.push(edge);
        }
        for (corner, code) in corners.into_iter().zip(codes) {
            if matches!(code, 0 | 15) {
                self.vertices.push(corner);
            }
        }
        Ok(corners)
    }
}

fn zigzag(v: u32) -> u32 {
    v >> 1 ^ (v & 1).wrapping_neg()
}

/// The `count` indices of a triangle list, `stride` (2 or 4) bytes each.
///
/// # Errors
/// What is wrong with the stream.
pub(super) fn decode_triangles(stream: &[u8], count: usize, stride: usize) -> Result<Vec<u8>, &'static str> {
    let Some((0xe1, body)) = stream.split_first() else { return Err("it has no header of triangles of version 1") };
    let (body, table) = body.len().checked_sub(16).map(|end| body.split_at(end)).ok_or(CUT_OFF)?;
    if table[14] != 0 || table[15] != 0 || table.iter().any(|b| b & 15 == 15 || b >> 4 == 15) {
        return Err("its table of codes is not valid");
    }
    // A code for each triangle, then what does not fit into codes.
    let (codes, data) = body.split_at_checked(count / 3).ok_or(CUT_OFF)?;
    let mut data = Stream::new(data);
    let mut recent = Recent { next: 0, last: 0, edges: Fifo::new(), vertices: Fifo::new() };
    let mut out = Vec::with_capacity(codes.len() * 3 * stride);
    for &code in codes {
        let corners = match (code >> 4, code & 15) {
            (15, low @ 14..) => {
                let bc = data.byte()?;
                if bc == 0 {
                    recent.next = 0;
                }
                recent.apart([if low == 14 { 0 } else { 15 }, bc >> 4, bc & 15], &mut data)?
            }
            (15, low) => {
                let bc = table[usize::from(low)];
                recent.apart([0, bc >> 4, bc & 15], &mut data)?
            }
            (edge, low) => recent.beside_edge(edge, low, &mut data)?,
        };
        corners.iter().for_each(|&index| put(&mut out, index, stride));
    }
    data.finish().map(|()| out)
}

/// `count` indices of any kind, `stride` (2 or 4) bytes each.
///
/// # Errors
/// What is wrong with the stream.
pub(super) fn decode_indices(stream: &[u8], count: usize, stride: usize) -> Result<Vec<u8>, &'static str> {
    let Some((0xd1, body)) = stream.split_first() else { return Err("it has no header of indices of version 1") };
    // Four bytes of padding; each index takes one byte at least.
    let body = body.len().checked_sub(4).map(|end| &body[..end]).filter(|b| b.len() >= count).ok_or(CUT_OFF)?;
    let mut data = Stream::new(body);
    let mut last = [0u32; 2];
    let mut out = Vec::with_capacity(count * stride);
    for _ in 0..count {
        let v = data.varint()?;
        let baseline = &mut last[(v & 1) as usize];
        *baseline = baseline.wrapping_add(zigzag(v >> 1));
        put(&mut out, *baseline, stride);
    }
    data.finish().map(|()| out)
}

fn put(out: &mut Vec<u8>, index: u32, stride: usize) {
    match stride {
        2 => out.extend_from_slice(&(index as u16).to_le_bytes()),
        _ => out.extend_from_slice(&index.to_le_bytes()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The corners of nine triangles, as both modes of meshoptimizer 1.0 encode them.
    const INDICES: [u32; 27] =
        [0, 1, 2, 2, 1, 3, 4, 6, 5, 7, 8, 9, 2, 1, 3, 100, 50, 0, 0, 50, 101, 9, 8, 10, 11, 10, 12];
    const TRIANGLES: [u8; 42] = [
        0xe1, 0xf0, 0x10, 0xfe, 0xff, 0x96, 0xff, 0x1f, 0x8f, 0xff, 0xf0, 0x0c, 0xff, 0x02, 0x02, 0x02, 0xfa, 0xb6,
        0x01, 0x63, 0x66, 0xb5, 0x01, 0x1f, 0x02, 0x02, 0x00, 0x76, 0x87, 0x56, 0x67, 0x78, 0xa9, 0x86, 0x65, 0x89,
        0x68, 0x98, 0x01, 0x69, 0x00, 0x00,
    ];
    const SEQUENCE: [u8; 37] = [
        0xd1, 0x00, 0x04, 0x04, 0x00, 0x02, 0x08, 0x04, 0x08, 0x02, 0x08, 0x04, 0x04, 0x1a, 0x02, 0x08, 0x91, 0x03,
        0xbc, 0x01, 0x8f, 0x03, 0x01, 0x00, 0x95, 0x03, 0xa2, 0x01, 0x02, 0x08, 0x04, 0x02, 0x08, 0x00, 0x00, 0x00,
        0x00,
    ];

    fn words(bytes: Vec<u8>) -> Vec<u32> {
        bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
    }

    #[test]
    fn what_the_reference_encoded() {
        assert_eq!(decode_triangles(&TRIANGLES, 27, 4).map(words), Ok(INDICES.to_vec()));
        assert_eq!(decode_indices(&SEQUENCE, 27, 4).map(words), Ok(INDICES.to_vec()));
        let short = decode_indices(&SEQUENCE, 27, 2).unwrap();
        assert_eq!(short.chunks(2).map(|b| u32::from(b[0]) | u32::from(b[1]) << 8).collect::<Vec<_>>(), INDICES);
    }

    #[test]
    fn wrong_lengths_and_tables_are_refused() {
        for cut in 0..TRIANGLES.len() {
            assert!(decode_triangles(&TRIANGLES[..cut], 27, 4).is_err());
        }
        for cut in 0..SEQUENCE.len() {
            assert!(decode_indices(&SEQUENCE[..cut], 27, 4).is_err());
        }
        assert!(decode_triangles(&TRIANGLES, 24, 4).is_err() && decode_triangles(&TRIANGLES, usize::MAX, 4).is_err());
        assert!(decode_indices(&SEQUENCE, 26, 4).is_err() && decode_indices(&SEQUENCE, usize::MAX, 4).is_err());
        let mut table = TRIANGLES;
        table[TRIANGLES.len() - 16] = 0xf0;
        assert!(decode_triangles(&table, 27, 4).is_err());
    }

    #[test]
    fn nothing_is_there_before_it_was_written() {
        // A triangle beside an edge, first of all.
        let mut stream = vec![0xe1, 0x00];
        stream.extend([0; 16]);
        assert_eq!(decode_triangles(&stream, 3, 4), Err(UNSEEN));
    }
}
