//! The walk of one photon from surface to surface.

use super::bins::{Deposit, Trail};
use super::ledger::EnergyLedger;
use crate::accel::Ray;
use crate::light::{Receiver, Visibility};
use crate::sampling::{cosine_hemisphere, unit_f32};
use crate::scene::Bounce;
use glam::{Vec2, Vec3};

/// A photon ends after this many surfaces, whatever the reflectance; what it carried is counted as cut.
pub const MAX_SURFACES: u32 = 100_000;

/// A photon ends after this many steps in a row that are shorter than a crevice is wide. Between white sheets that
/// lie upon another it would go on for hundreds, and make spikes of light that nobody sees.
pub const MOST_CREVICE_STEPS: u32 = 8;

/// Reflectances are fixed-point numbers with this many bits.
const ALBEDO_BITS: u32 = 24;

/// A photon under way.
#[derive(Debug, Clone, Copy)]
pub struct Photon {
    /// The ray it travels along.
    pub ray: Ray,
    /// Flux per channel; the largest is the same for all photons of a net.
    pub flux: [u32; 3],
    /// What it is shot for.
    pub kind: PhotonKind,
    /// Nothing reflected it diffusely yet: it came from a lamp over mirrors and through glass alone.
    pub caustic: bool,
}

/// What photons are shot for. Caustics are few, and have photons of their own, as many as they need.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PhotonKind {
    /// Light that was reflected diffusely at least once; until then, a photon leaves nothing.
    Diffuse,
    /// Light that was not: the photon ends where it would be.
    Caustic,
}

impl PhotonKind {
    /// Sets the random numbers of both kinds apart.
    pub fn key(self) -> u64 {
        match self {
            PhotonKind::Diffuse => 0x7068_6f74_6f6e,
            PhotonKind::Caustic => 0x0063_6175_7374_6963,
        }
    }
}

/// Walks `photon` to its end. Gaps below `crevice` [frame units] keep it for a few steps only. `random` gives the
/// next random word. What it leaves is appended to `trail`; the ledger balances.
pub fn walk(
    mut photon: Photon,
    visibility: &Visibility,
    crevice: f32,
    mut random: impl FnMut() -> u32,
    trail: &mut Trail,
    ledger: &mut EnergyLedger,
) {
    let world = visibility.world;
    add(&mut ledger.emitted, photon.flux);
    ledger.photons += 1;
    let mut crevice_steps = 0;
    // Distance since the last reflection.
    let mut gone = 0.0;
    for _ in 0..MAX_SURFACES {
        ledger.rays += 1;
        let Some(hit) = visibility.accel.closest(&photon.ray) else {
            add(&mut ledger.escaped, photon.flux);
            return;
        };
        crevice_steps = if hit.t < crevice { crevice_steps + 1 } else { 0 };
        if crevice_steps > MOST_CREVICE_STEPS {
            break;
        }
        let uv = Vec2::new(hit.u, hit.v);
        let met = world.meet(hit.triangle, uv, photon.ray.direction);
        let wanted = photon.kind == PhotonKind::Caustic || !photon.caustic;
        if met.receives && wanted {
            trail.deposits.push(Deposit {
                triangle: hit.triangle,
                back: met.back,
                uv: world.hair_before(hit.triangle, uv, photon.ray.direction),
                flux: photon.flux,
                direction: photon.ray.direction,
                distance: gone + hit.t,
                caustic: photon.caustic,
            });
            add(&mut ledger.deposited, photon.flux);
            ledger.deposits += 1;
        }
        if !met.receives && !met.passes {
            add(&mut ledger.back_absorbed, photon.flux);
            if photon.kind == PhotonKind::Diffuse {
                trail.backs.push((hit.triangle, photon.flux.iter().map(|&f| u64::from(f)).sum()));
            }
            return;
        }
        let bounce = world.bounce((hit.triangle, uv), &met, photon.ray.direction, hit.t, || unit_f32(random()));
        let ends = photon.kind == PhotonKind::Caustic;
        let reflected = scale(photon.flux, if ends { Vec3::ZERO } else { met.reflected });
        let thrown = scale(photon.flux, bounce.map_or(Vec3::ZERO, |b| b.share));
        let passed = scale(photon.flux, met.passed);
        let transmitted = scale(photon.flux, if ends { Vec3::ZERO } else { met.transmitted });
        // Roulette by the largest channel: the photon goes on in one of the ways, as heavy as before.
        let largest = max(photon.flux);
        let r = u64::from(random()) * u64::from(largest);
        let each = [reflected, thrown, passed, transmitted].map(|share| u64::from(max(share)) << 32);
        let (next, share) = if r < each[0] {
            (Some(Way::Diffuse), reflected)
        } else if r < each[0] + each[1] {
            (bounce.map(Way::Specular), thrown)
        } else if r < each[0] + each[1] + each[2] {
            (Some(Way::Straight), passed)
        } else if r < each[0] + each[1] + each[2] + each[3] {
            (Some(Way::DiffuseBeyond), transmitted)
        } else {
            (None, [0; 3])
        };
        // What the surface keeps of all shares; a back side's keep is counted apart.
        let kept = if met.receives { &mut ledger.absorbed } else { &mut ledger.back_absorbed };
        let expected: [i128; 3] =
            std::array::from_fn(|c| [reflected, thrown, passed, transmitted].iter().map(|s| i128::from(s[c])).sum());
        (0..3).for_each(|c| kept[c] += i128::from(photon.flux[c]) - expected[c]);
        let Some(way) = next else {
            (0..3).for_each(|c| ledger.roulette[c] -= expected[c]);
            return;
        };
        let heaviest = u64::from(max(share));
        let flux = share.map(|f| ((u64::from(f) * u64::from(largest) + heaviest / 2) / heaviest) as u32);
        (0..3).for_each(|c| ledger.roulette[c] += i128::from(flux[c]) - expected[c]);

        gone = if let Way::Straight = way { gone + hit.t } else { 0.0 };
        let at = Receiver::met(world, hit.triangle, uv, met.facing, photon.ray.direction, hit.t);
        let (origin, direction) = match way {
            Way::Diffuse => {
                let u = Vec2::new(unit_f32(random()), unit_f32(random()));
                (at.origin, cosine_hemisphere(met.facing, u))
            }
            Way::Specular(b) => (if b.through { at.beyond(world) } else { at.origin }, b.direction),
            Way::Straight => (at.beyond(world), photon.ray.direction),
            Way::DiffuseBeyond => {
                let u = Vec2::new(unit_f32(random()), unit_f32(random()));
                (at.opposite(world).origin, cosine_hemisphere(-met.facing, u))
            }
        };
        let caustic = photon.caustic && !matches!(way, Way::Diffuse | Way::DiffuseBeyond);
        photon = Photon { ray: Ray { origin, direction, t_max: f32::INFINITY }, flux, caustic, ..photon };
    }
    add(&mut ledger.cut, photon.flux);
}

/// How a photon goes on.
enum Way {
    Diffuse,
    Specular(Bounce),
    Straight,
    /// On the side that it did not come from.
    DiffuseBeyond,
}

fn add(sum: &mut [i128; 3], flux: [u32; 3]) {
    (0..3).for_each(|c| sum[c] += i128::from(flux[c]));
}

fn max(f: [u32; 3]) -> u32 {
    f[0].max(f[1]).max(f[2])
}

/// `flux` times a share in [0, 1] per channel, rounded down.
fn scale(flux: [u32; 3], share: Vec3) -> [u32; 3] {
    let one = (1u32 << ALBEDO_BITS) as f32;
    let fixed = (share.clamp(Vec3::ZERO, Vec3::ONE) * one).to_array().map(|s| s as u64);
    std::array::from_fn(|c| ((u64::from(flux[c]) * fixed[c]) >> ALBEDO_BITS) as u32)
}
