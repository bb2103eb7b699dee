//! Photons in whole scrambled nets.

use super::bins::{DepositSink, Trail};
use super::ledger::EnergyLedger;
use super::start::StartTable;
use super::walk::{Photon, PhotonKind, walk};
use crate::accel::Ray;
use crate::atlas::TexelSampler;
use crate::light::{Direct, Leaving, START_SLOTS, StartSlot, TexelLight};
use crate::sampling::{
    DIMENSIONS, Stream, cosine_hemisphere, hash_mix, scrambled_stratum, sobol, sobol_index_of_stratum, unit_f32,
};
use glam::Vec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Largest flux of a photon, in integer steps: reflectances multiply it without overflow.
const LARGEST_WEIGHT: u32 = 1 << 30;

/// Photons of one texel between two moves of their start: a move costs about as much as a photon.
const MOVE_EVERY: u32 = 16;

/// Photons per task.
const CHUNK: u32 = 2048;

/// The integer unit of flux of a bake: a power of two, so that scaling every light by a power of two changes
/// no integer.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
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
    /// What the photons are for.
    pub kind: PhotonKind,
    /// Seed of the bake.
    pub seed: u64,
    /// Integer unit of flux.
    pub flux: Flux,
    /// Photons of another net started at the same points: none starts there again before that is moved.
    pub used: bool,
    /// Where each half starts.
    pub starts: &'a [StartTable; 2],
    /// Direct light with its start points.
    pub direct: &'a Direct,
    /// What they are found with.
    pub light: TexelLight<'a>,
    /// Width below which a gap between surfaces is none [frame units].
    pub crevice: f32,
}

/// Some photons of a net: one of equal parts of it, each of which is a net as well.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct NetPart {
    /// Number of the net.
    pub net: u64,
    /// Number of the part.
    pub part: u32,
    /// Binary logarithm of the number of parts.
    pub part_bits: u32,
    /// Binary logarithm of the photons in each; with `part_bits` at most 32.
    pub bits: u32,
}

impl NetPart {
    /// All of a net.
    pub fn whole(net: u64, bits: u32) -> NetPart {
        NetPart { net, part: 0, part_bits: 0, bits }
    }
}

impl Shooting<'_> {
    /// Shoots a part of a net of both halves. A half whose direct samples found no light sends out nothing, but its
    /// photons count.
    pub fn both_halves(&self, part: NetPart, sink: &impl DepositSink) -> EnergyLedger {
        let mut ledger = EnergyLedger::default();
        for half in (0..2).filter(|&half| self.starts[half].total() > 0.0) {
            ledger += &self.net(half, part, sink);
        }
        ledger
    }

    /// Shoots a part of a net of a half: 2^`bits` photons. The start coordinate walks its strata in order (one
    /// jittered photon in each), so that rays start in texel order; all other coordinates are those of the
    /// Owen-scrambled Sobol point that belongs to the stratum. Every photon is thus uniform in all other
    /// coordinates whatever its stratum, and the mean over the part is unbiased. All parts together have one photon in
    /// each stratum of the whole net, as the points of one sequence.
    pub fn net(&self, half: usize, part: NetPart, sink: &impl DepositSink) -> EnergyLedger {
        let count = 1u32 << part.bits;
        let net = Net {
            half,
            part,
            key: hash_mix(hash_mix(self.seed, self.kind.key()), part.net << 1 | half as u64),
            weight: self.flux.weight(self.starts[half].total()),
        };
        (0..count.div_ceil(CHUNK))
            .into_par_iter()
            .map(|chunk| {
                let mut task = Task::default();
                for stratum in chunk * CHUNK..((chunk + 1) * CHUNK).min(count) {
                    self.photon(&net, stratum, &mut task);
                }
                sink.take(half, &task.trail);
                task.ledger
            })
            .reduce(EnergyLedger::default, |mut a, b| {
                a += &b;
                a
            })
    }

    /// One photon from its start to its end.
    fn photon(&self, net: &Net, stratum: u32, task: &mut Task) {
        let NetPart { part, part_bits, bits, .. } = net.part;
        let index = sobol_index_of_stratum(stratum, bits) | (part << bits);
        let mut stream = Stream::new(hash_mix(net.key, u64::from(part) << bits | u64::from(stratum)));
        let jitter = f64::from(stream.bits()) / 4_294_967_296.0;
        // Which of its finer strata a part has here is random, but no two have the same.
        let fine = scrambled_stratum(part, part_bits, hash_mix(net.key, !u64::from(stratum)) as u32);
        let strata = 1u64 << (bits + part_bits);
        let coordinate = (f64::from(stratum << part_bits | fine) + jitter) / strata as f64;
        let texel = self.starts[net.half].pick(coordinate, task.texel);
        if task.texel.replace(texel) != Some(texel) {
            task.slots = std::array::from_fn(|slot| self.direct.start(net.half, texel, slot).copied());
            task.photons = 0;
            task.moved = [false; START_SLOTS];
        }
        let slot = stream.bits() as usize % START_SLOTS;
        task.photons += 1;
        // What leaves as from a mirror always goes the same way: caustics move for every photon.
        let first = self.used && !std::mem::replace(&mut task.moved[slot], true);
        if self.kind == PhotonKind::Caustic || first || task.photons.is_multiple_of(MOVE_EVERY) {
            self.move_start(texel, slot, &mut stream, task);
        }
        let Some(start) = task.slots[slot] else { return };
        let caustic = matches!(start.way(), Leaving::Along(_));
        if self.kind == PhotonKind::Caustic && !caustic {
            return;
        }

        let scramble = net.key as u32;
        let mut dimension = 0;
        let mut random = || {
            dimension += 1;
            if dimension < DIMENSIONS { sobol(index, dimension, scramble) } else { stream.bits() }
        };
        let at = self.light.start(texel, &start);
        let u = Vec2::new(unit_f32(random()), unit_f32(random()));
        let (origin, direction) = match start.way() {
            Leaving::Reflected => (at.origin, cosine_hemisphere(at.geometric_normal, u)),
            Leaving::Transmitted => {
                let beyond = at.opposite(self.light.visibility.world);
                (beyond.origin, cosine_hemisphere(beyond.geometric_normal, u))
            }
            Leaving::Along(way) => (self.light.leave(&at, way), way),
        };
        let flux = start.color.map(|c| ((u64::from(c) * u64::from(net.weight) + 32767) / 65535) as u32);
        let ray = Ray { origin, direction, t_max: f32::INFINITY };
        let photon = Photon { ray, flux, kind: self.kind, caustic };
        walk(photon, self.light.visibility, self.crevice, random, &mut task.trail, &mut task.ledger);
    }

    /// Many photons from one point crowd around it: the start moves over its texel, to a point drawn anew with the
    /// probability by which more or less light is reflected there. Starts so remain distributed as what the texel
    /// reflects, whatever their number (Metropolis et al. 1953; Hastings 1970; Veach and Guibas 1997).
    fn move_start(&self, texel: usize, slot: usize, stream: &mut Stream, task: &mut Task) {
        let Some(start) = &mut task.slots[slot] else { return };
        if task.loaded.replace(texel) != Some(texel) {
            task.sampler.load(self.light.texels, texel);
        }
        let rays = &mut task.ledger.rays;
        let place = Vec2::new(stream.unit(), stream.unit());
        let Some(at) = self.light.point(texel, &task.sampler, place, rays) else { return };
        let found = self.light.any_light(at, stream, rays);
        if let Some(other) = StartSlot::new(&found).filter(|other| other.largest > stream.unit() * start.largest) {
            *start = other;
        }
    }
}

/// What a task works with.
#[derive(Default)]
struct Task {
    /// The texel that the last photon started from, to search on from there.
    texel: Option<usize>,
    /// Where its photons start, and how many did.
    slots: [Option<StartSlot>; START_SLOTS],
    photons: u32,
    /// Whether these starts were moved before their first photon.
    moved: [bool; START_SLOTS],
    /// The texel that the sampler holds.
    loaded: Option<usize>,
    sampler: TexelSampler,
    trail: Trail,
    ledger: EnergyLedger,
}

/// One net of one half.
struct Net {
    half: usize,
    part: NetPart,
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
