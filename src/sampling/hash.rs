//! Counter-based random numbers.

/// Mixes two words into one that looks independent of both (the finaliser of SplitMix64: Steele, Lea, Flood,
/// "Fast splittable pseudorandom number generators", 2014).
pub fn hash_mix(a: u64, b: u64) -> u64 {
    let mut z = a ^ b.wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(17);
    z = z.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A 32-bit seed for low-discrepancy scrambling out of several indices.
pub fn hash_seed(parts: &[u64]) -> u32 {
    (parts.iter().fold(0x5bd1_e995, |h, &p| hash_mix(h, p)) >> 32) as u32
}

/// A stream of random words addressed by its key (SplitMix64).
#[derive(Debug, Clone)]
pub struct Stream(u64);

impl Stream {
    /// The stream that belongs to `key`.
    pub fn new(key: u64) -> Stream {
        Stream(hash_mix(key, 0x6A09_E667_F3BC_C909))
    }

    /// 32 random bits.
    pub fn bits(&mut self) -> u32 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 32) as u32
    }

    /// A number in [0, 1).
    pub fn unit(&mut self) -> f32 {
        super::unit_f32(self.bits())
    }
}
