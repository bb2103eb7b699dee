//! Bytes read one after the other, never beyond their end.

/// What is said of a stream that ends too early.
pub(super) const CUT_OFF: &str = "it is cut off";

/// The unread part of a stream, without its tail.
pub(super) struct Stream<'a> {
    left: &'a [u8],
}

impl<'a> Stream<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Stream<'a> {
        Stream { left: bytes }
    }

    pub(super) fn bytes(&mut self, n: usize) -> Result<&'a [u8], &'static str> {
        let (read, left) = self.left.split_at_checked(n).ok_or(CUT_OFF)?;
        self.left = left;
        Ok(read)
    }

    pub(super) fn byte(&mut self) -> Result<u8, &'static str> {
        Ok(self.bytes(1)?[0])
    }

    /// A 32-bit number in 1 to 5 bytes of 7 bits each, the lowest first (LEB128); what does not fit is dropped.
    pub(super) fn varint(&mut self) -> Result<u32, &'static str> {
        let mut value = 0;
        for shift in (0..35).step_by(7) {
            let byte = self.byte()?;
            value |= u32::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err("it has a number of more than five bytes")
    }

    /// All must have been read.
    pub(super) fn finish(self) -> Result<(), &'static str> {
        if self.left.is_empty() { Ok(()) } else { Err("it has bytes left over") }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The examples of the specification, where the third is read from its other end.
    #[test]
    fn numbers_of_several_bytes() {
        let read = |bytes: &[u8]| Stream::new(bytes).varint();
        assert_eq!(read(&[0x7f]), Ok(0x7f));
        assert_eq!(read(&[0x81, 0x04]), Ok(0x201));
        assert_eq!(read(&[0xff, 0xa0, 0x05]), Ok(0x1_507f));
        assert_eq!(read(&[0xff, 0xff, 0xff, 0xff, 0x7f]), Ok(u32::MAX));
        assert!(read(&[0x80; 5]).is_err() && read(&[0x80]).is_err() && read(&[]).is_err());
    }
}
