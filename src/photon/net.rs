//! Photons in whole scrambled nets.

use super::bins::{DepositSink, Trail};
use super::ledger::EnergyLedger;
use super::start::StartTable;
use super::walk::{Photon, walk};
use crate::accel::Ray;
use crate::atlas::Texels;
use crate::light::{Direct, Receiver, START_SLOTS, Visibility};
use crate::sampling::{DIMENSIONS, Stream, cosine_hemisphere, hash_mix, sobol, sobol_index_of_stratum, unit_f32};
use glam::Vec2;
use rayon::prelude::*;

/// Largest flux of a photon, in integer steps: reflectances multiply it without overflow.
const LARGEST_WEIGHT: u32 = 1 << 30;

/// Photons per task.
const CHUNK: u32 = 2048;

/// The integer unit of flux of a bake: a power of two, so that scaling every light by a power of two changes
/// no integer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Flux {
    /// Flux of one integer step [lux x frame units squared].
    pub unit: f64,
}

impl Flux {
    /// The unit in which a total start flux of `total` has 25 bits.
    pub fn for_total(total: f64) -> Flux {
        let exponent = if total > 0.0 { libm::ilogb(total) } else { 0 };
        Flux { unit: libm::ldexp(1.0, exponent - 24) }
    }

    /// True where photons of a total start flux of `total` still fit their integers.
    pub fn holds(&self, total: f64) -> bool {
        total <= self.unit * f64::from(LARGEST_WEIGHT)
    }

    /// The largest channel of every photon where the start flux is `total`: the flux per texel is then the sum
    /// of its deposits divided by the number of photons.
    pub fn weight(&self, total: f64) -> u32 {
        (total / self.unit).round().clamp(1.0, f64::from(LARGEST_WEIGHT)) as u32
    }
}

/// Everything that photons of a round need.
#[derive(Debug)]
pub struct Shooting<'a> {
    /// Seed of the bake.
    pub seed: u64,
    /// Integer unit of flux.
    pub flux: Flux,
    /// Where each half starts.
    pub starts: &'a [StartTable; 2],
    /// Direct light with its start points.
    pub direct: &'a Direct,
    /// All texels.
    pub texels: &'a Texels,
    /// What photons meet.
    pub visibility: &'a Visibility<'a>,
    /// Width below which a gap between surfaces is none [frame units].
    pub crevice: f32,
}

impl Shooting<'_> {
    /// Shoots net number `net` of a half: 2^`bits` photons. The start coordinate walks its strata in order (one
    /// jittered photon in each), so that rays start in texel order; all other coordinates are those of the
    /// Owen-scrambled Sobol point that belongs to the stratum. Every photon is thus uniform in all other
    /// coordinates whatever its stratum, and the mean over the net is unbiased.
    pub fn net(&self, half: usize, net: u64, bits: u32, sink: &impl DepositSink) -> EnergyLedger {
        let count = 1u32 << bits;
        let net = Net {
            half,
            bits,
            key: hash_mix(hash_mix(self.seed, 0x7068_6f74_6f6e), net << 1 | half as u64),
            weight: self.flux.weight(self.starts[half].total()),
        };
        (0..count.div_ceil(CHUNK))
            .into_par_iter()
            .map(|chunk| {
                let mut ledger = EnergyLedger::default();
                let mut trail = Trail::default();
                let mut texel = None;
                for stratum in chunk * CHUNK..((chunk + 1) * CHUNK).min(count) {
                    texel = Some(self.photon(&net, stratum, texel, &mut trail, &mut ledger));
                }
                sink.take(half, &trail);
                ledger
            })
            .reduce(EnergyLedger::default, |mut a, b| {
                a += &b;
                a
            })
    }

    /// One photon from its start to its end; returns the texel it started from, to search on from there.
    fn photon(
        &self,
        net: &Net,
        stratum: u32,
        from: Option<usize>,
        trail: &mut Trail,
        ledger: &mut EnergyLedger,
    ) -> usize {
        let mut stream = Stream::new(hash_mix(net.key, u64::from(stratum)));
        let jitter = f64::from(stream.bits()) / 4_294_967_296.0;
        let texel = self.starts[net.half].pick((f64::from(stratum) + jitter) / f64::from(1u32 << net.bits), from);
        let slot = stream.bits() as usize % START_SLOTS;
        let Some(start) = self.direct.start(net.half, texel, slot) else { return texel };

        let (index, scramble) = (sobol_index_of_stratum(stratum, net.bits), net.key as u32);
        let mut dimension = 0;
        let mut random = || {
            dimension += 1;
            if dimension < DIMENSIONS { sobol(index, dimension, scramble) } else { stream.bits() }
        };
        let world = self.visibility.world;
        // The very point that the direct light was found at.
        let at = Receiver::new(world, start.triangle, start.uv, self.texels.texels[texel].back, false);
        let direction = cosine_hemisphere(at.geometric_normal, Vec2::new(unit_f32(random()), unit_f32(random())));
        let flux = start.color.map(|c| ((u64::from(c) * u64::from(net.weight) + 32767) / 65535) as u32);
        let photon = Photon { ray: Ray { origin: at.origin, direction, t_max: f32::INFINITY }, flux };
        walk(photon, self.visibility, self.crevice, random, trail, ledger);
        texel
    }
}

/// One net of one half.
struct Net {
    half: usize,
    bits: u32,
    key: u64,
    weight: u32,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_unit_is_a_power_of_two_with_room_to_grow() {
        for total in [1e-12, 0.3, 1.0, 7.5e9] {
            let flux = Flux::for_total(total);
            assert_eq!(flux.unit.log2().fract(), 0.0);
            assert!((1 << 24..1 << 25).contains(&flux.weight(total)));
            assert!(flux.holds(total * 30.0) && !flux.holds(total * 70.0));
            // Twice the light: the same integers.
            assert_eq!(Flux::for_total(total * 2.0).weight(total * 2.0), flux.weight(total));
        }
    }
}
