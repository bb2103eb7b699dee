//! Where all the light went, in exact integers.

use serde::{Deserialize, Serialize};
use std::ops::AddAssign;

/// Flux per channel in the integer unit of the bake. Always
/// `emitted + roulette = absorbed + back_absorbed + escaped + cut`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EnergyLedger {
    /// Sent out by photons at their start.
    pub emitted: [i128; 3],
    /// Net gain by Russian roulette: 0 in expectation.
    pub roulette: [i128; 3],
    /// Taken up by surfaces.
    pub absorbed: [i128; 3],
    /// Of light that met the back of one-sided surfaces.
    pub back_absorbed: [i128; 3],
    /// Left the scene.
    pub escaped: [i128; 3],
    /// In photons ended in crevices and by the bounce limit.
    pub cut: [i128; 3],
    /// Sum of all deposits, mapped or not.
    pub deposited: [i128; 3],
    /// Photons started.
    pub photons: u64,
    /// Rays traced.
    pub rays: u64,
    /// Deposits made.
    pub deposits: u64,
}

impl EnergyLedger {
    /// The same in steps of the flux `to`, where it was in steps of `from`: both powers of two, `to` the smaller.
    pub fn in_steps(&self, from: f64, to: f64) -> EnergyLedger {
        let factor = if from > 0.0 && to > 0.0 { (from / to).round() as i128 } else { 1 };
        let times = |flux: [i128; 3]| flux.map(|f| f.saturating_mul(factor));
        EnergyLedger {
            emitted: times(self.emitted),
            roulette: times(self.roulette),
            absorbed: times(self.absorbed),
            back_absorbed: times(self.back_absorbed),
            escaped: times(self.escaped),
            cut: times(self.cut),
            deposited: times(self.deposited),
            ..*self
        }
    }

    /// `emitted + roulette - absorbed - back_absorbed - escaped - cut` per channel: 0.
    pub fn imbalance(&self) -> [i128; 3] {
        std::array::from_fn(|c| {
            self.emitted[c] + self.roulette[c]
                - self.absorbed[c]
                - self.back_absorbed[c]
                - self.escaped[c]
                - self.cut[c]
        })
    }
}

impl AddAssign<&EnergyLedger> for EnergyLedger {
    fn add_assign(&mut self, o: &EnergyLedger) {
        for c in 0..3 {
            self.emitted[c] += o.emitted[c];
            self.roulette[c] += o.roulette[c];
            self.absorbed[c] += o.absorbed[c];
            self.back_absorbed[c] += o.back_absorbed[c];
            self.escaped[c] += o.escaped[c];
            self.cut[c] += o.cut[c];
            self.deposited[c] += o.deposited[c];
        }
        self.photons += o.photons;
        self.rays += o.rays;
        self.deposits += o.deposits;
    }
}
