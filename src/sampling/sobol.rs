//! Owen-scrambled Sobol points.
//!
//! Direction numbers: Joe and Kuo, "Constructing Sobol sequences with better two-dimensional projections",
//! 2008, first dimensions. Scrambling: Laine and Karras 2011 with the constants of Burley, "Practical
//! hash-based Owen scrambling", 2020 (improved hash by Vegdahl 2021). Indices may use all 32 bits, unlike in
//! the crate sobol_burley, whose sequences end at 2^16 points.

/// Number of dimensions with direction numbers.
pub const DIMENSIONS: usize = 12;

/// (degree s, coefficient a, initial m) of dimensions 1 and up; dimension 0 is the van der Corput sequence.
const POLYNOMIALS: [(usize, u32, &[u32]); DIMENSIONS - 1] = [
    (1, 0, &[1]),
    (2, 1, &[1, 3]),
    (3, 1, &[1, 3, 1]),
    (3, 2, &[1, 1, 1]),
    (4, 1, &[1, 1, 3, 3]),
    (4, 4, &[1, 3, 5, 13]),
    (5, 2, &[1, 1, 5, 5, 17]),
    (5, 4, &[1, 1, 5, 5, 5]),
    (5, 7, &[1, 1, 7, 11, 19]),
    (5, 11, &[1, 1, 5, 1, 1]),
    (5, 13, &[1, 1, 1, 3, 11]),
];

/// `TABLES[d][b][v]`: XOR of the direction numbers of the bits set in byte `b` = `v` of the index.
static TABLES: [[[u32; 256]; 4]; DIMENSIONS] = tables();

const fn tables() -> [[[u32; 256]; 4]; DIMENSIONS] {
    let mut out = [[[0u32; 256]; 4]; DIMENSIONS];
    let mut d = 0;
    while d < DIMENSIONS {
        let direction = direction_numbers(d);
        let mut b = 0;
        while b < 4 {
            let mut v = 0;
            while v < 256 {
                let mut x = 0;
                let mut k = 0;
                while k < 8 {
                    if v >> k & 1 == 1 {
                        x ^= direction[b * 8 + k];
                    }
                    k += 1;
                }
                out[d][b][v] = x;
                v += 1;
            }
            b += 1;
        }
        d += 1;
    }
    out
}

const fn direction_numbers(dimension: usize) -> [u32; 32] {
    let mut v = [0u32; 32];
    let mut i = 0;
    if dimension == 0 {
        while i < 32 {
            v[i] = 1 << (31 - i);
            i += 1;
        }
        return v;
    }
    let (s, a, m) = POLYNOMIALS[dimension - 1];
    while i < 32 {
        if i < s {
            v[i] = m[i] << (31 - i);
        } else {
            v[i] = v[i - s] ^ (v[i - s] >> s);
            let mut k = 1;
            while k < s {
                if a >> (s - 1 - k) & 1 == 1 {
                    v[i] ^= v[i - k];
                }
                k += 1;
            }
        }
        i += 1;
    }
    v
}

/// Point `index` of the Sobol sequence in `dimension`, scrambled by `seed`; 32 bits, to be read as a binary
/// fraction. Sets of 2^m points that start at a multiple of 2^m are nets.
pub fn sobol(index: u32, dimension: usize, seed: u32) -> u32 {
    let t = &TABLES[dimension];
    let x = t[0][(index & 255) as usize]
        ^ t[1][(index >> 8 & 255) as usize]
        ^ t[2][(index >> 16 & 255) as usize]
        ^ t[3][(index >> 24) as usize];
    owen_scramble(x, mix(seed ^ (dimension as u32).wrapping_mul(0x9E37_79B9)))
}

/// Index of the point that lies in stratum `stratum` of 2^`bits` equal strata of dimension 0 (unscrambled):
/// walking the strata in order visits the net sorted by that dimension.
pub fn sobol_index_of_stratum(stratum: u32, bits: u32) -> u32 {
    if bits == 0 { 0 } else { stratum.reverse_bits() >> (32 - bits) }
}

/// Stratum of 2^`bits` equal ones that point `index` of a scrambled van der Corput sequence lies in: for the first
/// 2^`bits` indices each one once.
pub fn scrambled_stratum(index: u32, bits: u32, seed: u32) -> u32 {
    if bits == 0 { 0 } else { owen_scramble(index.reverse_bits(), mix(seed)) >> (32 - bits) }
}

fn owen_scramble(x: u32, seed: u32) -> u32 {
    let mut n = x.reverse_bits();
    n ^= n.wrapping_mul(0x3d20_adea);
    n = n.wrapping_add(seed);
    n = n.wrapping_mul((seed >> 16) | 1);
    n ^= n.wrapping_mul(0x0552_6c56);
    n ^= n.wrapping_mul(0x53a2_2864);
    n.reverse_bits()
}

fn mix(mut n: u32) -> u32 {
    n ^= n >> 16;
    n = n.wrapping_mul(0x21f0_aaad);
    n ^= n >> 15;
    n = n.wrapping_mul(0xd35a_2d97);
    n ^ (n >> 15)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_of_parts_fill_each_stratum_once_and_any_part_may_have_any() {
        let mut first = [0; 8];
        for seed in 0..4096 {
            let mut strata: Vec<u32> = (0..8).map(|k| scrambled_stratum(k, 3, seed)).collect();
            first[strata[5] as usize] += 1;
            // Half of the parts have one in each half, and so on.
            assert!(strata.chunks(2).all(|pair| pair[0] / 4 != pair[1] / 4), "{strata:?}");
            strata.sort_unstable();
            assert_eq!(strata, [0, 1, 2, 3, 4, 5, 6, 7]);
        }
        // 5 standard deviations of a count of 512: 1 in a million for any of them by chance.
        assert!(first.iter().all(|&n| f64::abs(f64::from(n) - 512.0) < 5.0 * 512f64.sqrt()), "{first:?}");
    }

    /// Every elementary interval of a (t, m, 2)-net with t = 0 holds exactly one point: dimensions 0 and 1
    /// of the Sobol sequence are such a net for every m, scrambled or not.
    #[test]
    fn first_two_dimensions_are_a_net() {
        for m in [4u32, 8] {
            for k in 0..=m {
                let mut seen = vec![0; 1 << m];
                for i in 0..1 << m {
                    let a = if k == 0 { 0 } else { sobol(i, 0, 77) >> (32 - k) };
                    let b = if k == m { 0 } else { sobol(i, 1, 77) >> (32 - (m - k)) };
                    seen[((a << (m - k)) | b) as usize] += 1;
                }
                assert!(seen.iter().all(|&n| n == 1), "m {m}, split {k}");
            }
        }
    }

    /// One point in each of 2^m strata of every single dimension.
    #[test]
    fn every_dimension_is_stratified() {
        for d in 0..DIMENSIONS {
            let mut seen = [0; 256];
            (0..256).for_each(|i| seen[(sobol(i, d, 5) >> 24) as usize] += 1);
            assert!(seen.iter().all(|&n| n == 1), "dimension {d}");
        }
    }

    #[test]
    fn strata_are_visited_in_order() {
        for k in 0..64 {
            let i = sobol_index_of_stratum(k, 6);
            assert_eq!(i.reverse_bits() >> 26, k);
        }
    }
}
