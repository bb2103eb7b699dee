//! How much more light it takes.

use crate::bisect::bisected;

/// The squared error of photons smoothed over cells falls as photons^-this: cells shrink as photons get more, so that
/// noise and bias fall together (-2/3 for smooth light, -1/2 at kinks; measured -0.25 to -0.9).
pub(super) const SMOOTH_FALL: f64 = 0.6;

/// ... and that of smoothed direct light as samples^-this: they go where they are needed, by a low-discrepancy sequence
/// (measured -0.8 to -1.8).
const SOFT_FALL: f64 = 1.0;

/// Weight of that beside what rounds show, as that of a round that multiplies the work by e.
const FALL_WEIGHT: f64 = 1.0;

/// How quickly errors may be believed to fall: bias that photons cannot yet resolve hides and comes up again.
const FALL_RANGE: std::ops::RangeInclusive<f64> = 0.3..=1.5;

/// How the squared error of smoothed light falls with the work, as work^-exponent: what rounds have shown of it.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Fall {
    weight: f64,
    sum: f64,
}

impl Fall {
    /// Of photons, before any round.
    pub fn of_photons() -> Fall {
        Fall { weight: FALL_WEIGHT, sum: FALL_WEIGHT * SMOOTH_FALL }
    }

    /// Of smoothed direct light, before any round.
    pub fn of_soft_light() -> Fall {
        Fall { weight: FALL_WEIGHT, sum: FALL_WEIGHT * SOFT_FALL }
    }

    /// A round in which the work grew by the factor `growth` and the squared error fell by the factor `fall`.
    pub fn learn(&mut self, growth: f64, fall: f64) {
        if growth > 1.0 && growth.is_finite() && fall > 0.0 && fall.is_finite() {
            let (growth, fall) = (growth.ln(), fall.ln());
            self.weight += growth * growth;
            self.sum += growth * fall;
        }
    }

    /// The exponent.
    pub fn exponent(&self) -> f64 {
        (self.sum / self.weight).clamp(*FALL_RANGE.start(), *FALL_RANGE.end())
    }
}

/// Aimed for below the target: estimates scatter.
const MARGIN: f64 = 0.96;

/// Squared errors by source and the cost of each so far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spent {
    /// Squared error of direct light that falls as 1 / samples.
    pub direct: f64,
    /// Squared error of direct light that is smoothed over cells, noise and bias.
    pub soft: f64,
    /// Squared error of the indirect light, noise and bias.
    pub indirect: f64,
    /// Exponents with which `soft` and `indirect` fall.
    pub falls: [f64; 2],
    /// Cost of the direct light so far, > 0.
    pub direct_cost: f64,
    /// Cost of the photons so far, in the same unit, > 0.
    pub photon_cost: f64,
}

/// Factors (>= 1) on both kinds of work that bring the sum of the squared errors down to `1 / needed` of it with
/// the least cost.
pub fn cheapest_growth(spent: &Spent, needed: f64) -> (f64, f64) {
    let Spent { direct, soft, indirect, falls, direct_cost, photon_cost } = *spent;
    let goal = (direct + soft + indirect) / needed * MARGIN * MARGIN;
    if needed <= 1.0 || goal <= 0.0 || goal.is_nan() {
        return (1.0, 1.0);
    }
    // At the least cost a little more of either brings the same: the price m of error says how far to go.
    let best = |m: f64, square: f64, fall: f64, cost: f64| libm::pow(m * fall * square / cost, 1.0 / (1.0 + fall));
    // Both kinds of direct light fall together, at first by the mean of their powers.
    let direct_fall = (direct + falls[0] * soft) / (direct + soft).max(1e-300);
    let growth = |m: f64| {
        let x = best(m, direct + soft, direct_fall, direct_cost);
        let y = best(m, indirect, falls[1], photon_cost);
        (x.max(1.0), y.max(1.0))
    };
    let error = |(x, y): (f64, f64)| direct / x + soft * libm::pow(x, -falls[0]) + indirect * libm::pow(y, -falls[1]);
    // By logarithms, for prices span many orders of magnitude.
    let scale = (direct_cost + photon_cost) / (direct + soft + indirect);
    let (_, high) = bisected(-40.0, 80.0, 60, |price| error(growth(scale * libm::exp2(price))) > goal);
    growth(scale * libm::exp2(high))
}

/// Share of the squared error allowed over all that caustics may take.
pub const CAUSTIC_SHARE: f64 = 0.25;

/// Factor (>= 1) on the photons for caustics that lowers their squared error by the factor `needed`.
pub fn caustic_growth(needed: f64) -> f64 {
    libm::pow(needed, 1.0 / SMOOTH_FALL).max(1.0)
}

/// A mesh above its target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Missed {
    /// Scene instance.
    pub instance: usize,
    /// Squared error of its direct light, in units of the squared target.
    pub direct: f64,
    /// Squared error of its indirect light, likewise.
    pub indirect: f64,
    /// Squared error of light from lamps over mirrors and through glass, likewise: no mesh can gather that.
    pub caustic: f64,
    /// Texels with surface.
    pub texels: usize,
    /// Rays that each of its texels gathers indirect light with, per half; 0 while photons are to do.
    pub gathered: u32,
    /// Of `indirect`, what more of those rays would lower; the rest is in the light that they look up.
    pub of_rays: f64,
    /// What it gathers may be smoothed over cells.
    pub smooths: bool,
}

/// What brings missed meshes to their target.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeshPlan {
    /// Factor on the photons, >= 1.
    pub photons: f64,
    /// Factor on the photons for caustics, >= 1.
    pub caustics: f64,
    /// (instance, factor on its direct samples).
    pub direct: Vec<(usize, f64)>,
    /// (instance, gather rays of each texel and half).
    pub gather: Vec<(usize, u32)>,
}

/// Cost of the photons so far, in rays.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotonCost {
    /// Of those for diffusely reflected light, > 0.
    pub diffuse: f64,
    /// Of those for caustics alone.
    pub caustic: f64,
}

/// Cost of a gather ray in rays of photons: rays of one texel go everywhere, and look light up (measured 1.7 to 4).
pub const GATHER_RAY_COST: f64 = 2.5;

/// Rays that texels take to gather with `samples` each per half: in each half one that looks around and one towards
/// the light.
pub fn gather_rays(samples: f64, texels: usize) -> f64 {
    4.0 * samples * texels as f64
}

/// Squared relative scatter of one gather sample, before it was measured.
const GATHER_SCATTER: f64 = 2.0;

/// Smoothed over cells, what meshes of more texels than this gather takes fewer rays, up to this many times.
const GATHER_TEXELS: f64 = 8192.0;
const GATHER_SAVING: f64 = 8.0;

/// Gather rays of a texel and half: at least, at most, and growth from round to round.
const GATHER_RANGE: std::ops::RangeInclusive<f64> = 8.0..=16384.0;
const GATHER_GROWTH: f64 = 8.0;

/// What costs less than this share of all photons is tried first.
const CHEAP: f64 = 0.02;

/// Light is gathered anew once there are so many times the photons.
pub const GATHER_AGAIN: u64 = 4;

/// The cheapest way for all of `missed` but the `spared` dearest: more photons serve all, gathering serves one
/// mesh for rays in proportion to its texels. `target` is the meshes' target as a fraction, `cost` that of the photons of
/// both kinds so far, `anyway` the factor by which there will be more photons for the sake of the whole.
pub fn plan_meshes(missed: &[Missed], spared: usize, target: f64, cost: PhotonCost, anyway: f64) -> MeshPlan {
    /// About half of the squared target for direct light, half for indirect light: estimates scatter, and one more round
    /// for a mesh that just missed its target costs more than it saves.
    const SHARE: f64 = 0.43;
    let alone = GATHER_SCATTER / (2.0 * SHARE * target * target);
    let bounded = |samples: f64| samples.clamp(*GATHER_RANGE.start(), *GATHER_RANGE.end()).ceil();
    let samples = |m: &Missed| match m.gathered {
        0 if m.smooths => bounded(alone / (m.texels as f64 / GATHER_TEXELS).clamp(1.0, GATHER_SAVING)),
        0 => bounded(alone),
        n => bounded(f64::from(n) * (m.indirect / SHARE * 1.1).min(GATHER_GROWTH)),
    };
    let gathering = |m: &Missed| GATHER_RAY_COST * gather_rays(samples(m), m.texels);
    let photons_for = |m: &Missed| libm::pow(m.indirect / SHARE, 1.0 / SMOOTH_FALL);
    // What is gathered errs by its rays, or by the light that they look up. In a few texels this is hard to tell, and
    // more rays cost next to nothing.
    let hungry = |m: &&Missed| {
        let by_rays = m.of_rays > 0.5 * m.indirect || gathering(m) < CHEAP * cost.diffuse;
        m.gathered > 0 && by_rays && samples(m) > f64::from(m.gathered)
    };
    let waits = |m: &&Missed| m.gathered > 0 && !hungry(m);
    // What direct and other indirect light leave of the squared target is for caustics.
    let caustics_for = |m: &Missed| caustic_growth(m.caustic / (0.95 - m.direct.min(SHARE) - m.indirect.min(SHARE)));
    let price = |m: &Missed| {
        let indirect = if waits(&m) { cost.diffuse * photons_for(m).max(GATHER_AGAIN as f64) } else { gathering(m) };
        indirect + cost.caustic * (caustics_for(m) - 1.0)
    };
    let mut meshes: Vec<&Missed> = missed.iter().collect();
    meshes.sort_by(|a, b| price(b).total_cmp(&price(a)).then(a.instance.cmp(&b.instance)));
    let meshes = &meshes[spared.min(meshes.len())..];
    let dim = || meshes.iter().copied().filter(|m| m.indirect > SHARE);

    let least = dim().filter(waits).map(|m| photons_for(m).max(GATHER_AGAIN as f64)).fold(anyway, f64::max);

    // Photon growth that each of the others would need, the largest first: those above a line gather, the rest
    // wait for photons to grow up to it.
    let mut by_growth: Vec<(f64, &Missed)> =
        dim().filter(|m| m.gathered == 0).map(|m| (photons_for(m).max(least), m)).collect();
    by_growth.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.instance.cmp(&b.1.instance)));
    let growth = |k: usize| by_growth.get(k).map_or(least, |g| g.0);
    let (mut best, mut gathered_cost) = ((f64::INFINITY, 0), 0.0);
    for k in 0..=by_growth.len() {
        let total = gathered_cost + cost.diffuse * (growth(k) - 1.0);
        if total < best.0 {
            best = (total, k);
        }
        gathered_cost += by_growth.get(k).map_or(0.0, |g| gathering(g.1));
    }
    let new = by_growth[..best.1].iter().map(|g| g.1);
    MeshPlan {
        photons: growth(best.1),
        caustics: meshes.iter().map(|m| caustics_for(m)).fold(1.0, f64::max),
        direct: meshes.iter().filter(|m| m.direct > SHARE).map(|m| (m.instance, m.direct / SHARE)).collect(),
        gather: new.chain(dim().filter(hungry)).map(|m| (m.instance, samples(m) as u32)).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn growth_meets_the_goal_at_the_least_cost() {
        let spent = Spent {
            direct: 3.0,
            soft: 0.0,
            indirect: 5.0,
            direct_cost: 1e6,
            photon_cost: 3e6,
            falls: [SMOOTH_FALL; 2],
        };
        let (x, y) = cheapest_growth(&spent, 4.0);
        let error = |x: f64, y: f64| 3.0 / x + 5.0 * y.powf(-SMOOTH_FALL);
        let cost = |x: f64, y: f64| 1e6 * x + 3e6 * y;
        assert!((error(x, y) / (2.0 * MARGIN * MARGIN) - 1.0).abs() < 1e-6);
        // Any other way to the same error costs more.
        for other in [0.8 * x, 1.2 * x] {
            let rest = error(x, y) - 3.0 / other;
            let paired = (rest / 5.0).powf(-1.0 / SMOOTH_FALL);
            assert!(cost(other, paired) > cost(x, y));
        }
    }

    #[test]
    fn what_adds_no_error_does_not_grow() {
        let spent = Spent {
            direct: 0.0,
            soft: 0.0,
            indirect: 1.0,
            direct_cost: 1e6,
            photon_cost: 1e6,
            falls: [SMOOTH_FALL; 2],
        };
        assert_eq!(cheapest_growth(&spent, 9.0).0, 1.0);
        let spent = Spent {
            direct: 1.0,
            soft: 0.0,
            indirect: 0.0,
            direct_cost: 1e6,
            photon_cost: 1e6,
            falls: [SMOOTH_FALL; 2],
        };
        let (x, y) = cheapest_growth(&spent, 9.0);
        assert_eq!(y, 1.0);
        assert!((x - 9.0 / (MARGIN * MARGIN)).abs() < 1e-3);
        assert_eq!(cheapest_growth(&spent, 0.5), (1.0, 1.0));
    }

    #[test]
    fn exponents_are_learnt_from_rounds_with_growth() {
        let mut fall = Fall::of_photons();
        assert_eq!(fall.exponent(), SMOOTH_FALL);
        fall.learn(1.0, 2.0);
        fall.learn(0.5, f64::NAN);
        assert_eq!(fall.exponent(), SMOOTH_FALL);
        (0..4).for_each(|_| fall.learn(5.0, libm::pow(5.0, 0.8)));
        assert!((fall.exponent() - 0.8).abs() < 0.02, "{fall:?}");
        (0..40).for_each(|_| fall.learn(5.0, 0.9));
        assert_eq!(fall.exponent(), *FALL_RANGE.start());
    }

    #[test]
    fn small_meshes_gather_and_large_ones_wait_for_photons() {
        let missed = |instance, indirect, texels| Missed {
            instance,
            direct: 0.1,
            indirect,
            caustic: 0.0,
            texels,
            gathered: 0,
            of_rays: 0.0,
            smooths: true,
        };
        let cost = |diffuse| PhotonCost { diffuse, caustic: 0.2 * diffuse };
        let meshes = [missed(0, 400.0, 30), missed(1, 1.2, 200_000), missed(2, 90.0, 100)];
        let plan = plan_meshes(&meshes, 0, 0.15, cost(1e6), 1.0);
        assert_eq!(plan.gather.iter().map(|g| g.0).collect::<Vec<_>>(), [0, 2]);
        assert!(plan.photons > 1.5 && plan.photons < 10.0, "{plan:?}");
        assert!(plan.direct.is_empty());
        // ... but if these are dear: smoothed over cells, what it gathers takes fewer rays.
        let plan = plan_meshes(&meshes, 0, 0.15, cost(1e8), 1.0);
        let [small, _, large] = plan.gather.as_slice() else { panic!("{plan:?}") };
        assert!(large.0 == 1 && small.0 == 0 && large.1 * 7 < small.1, "{plan:?}");
        // The dearest may be spared.
        let plan = plan_meshes(&meshes, 1, 0.15, cost(1e6), 1.0);
        assert_eq!(plan.photons, 1.0);
        // ... which are those that only many more photons for caustics would help.
        let thrown = Missed { caustic: 50.0, ..meshes[2] };
        let plan = plan_meshes(&[meshes[0], thrown], 1, 0.15, cost(1e8), 1.0);
        assert_eq!((plan.caustics, plan.gather.len()), (1.0, 1));
        // What is gathered grows by what is missing, where its rays are too few.
        let again = Missed { gathered: 89, indirect: 2.0, of_rays: 1.5, ..meshes[0] };
        let plan = plan_meshes(&[again], 0, 0.15, cost(1e7), 1.0);
        assert_eq!(plan.gather, [(0, (89.0f64 * 2.0 / 0.43 * 1.1).ceil() as u32)]);
        assert_eq!(plan.photons, 1.0);
        // Where they are not, what they look up must get better.
        let plan = plan_meshes(&[Missed { of_rays: 0.3, texels: 3000, ..again }], 0, 0.15, cost(1e7), 1.0);
        assert!(plan.gather.is_empty() && plan.photons >= GATHER_AGAIN as f64, "{plan:?}");
        // ... and where no more are allowed, likewise.
        let full = Missed { gathered: *GATHER_RANGE.end() as u32, ..again };
        let plan = plan_meshes(&[full], 0, 0.15, cost(1e7), 1.0);
        assert!(plan.gather.is_empty() && plan.photons >= GATHER_AGAIN as f64, "{plan:?}");
    }
}
