//! Where a condition ends to hold.

/// The ends of what is left of `low` to `high` after so many halvings, of where `short` ends to hold.
pub fn bisected(mut low: f64, mut high: f64, steps: u32, short: impl Fn(f64) -> bool) -> (f64, f64) {
    for _ in 0..steps {
        let middle = 0.5 * (low + high);
        if short(middle) { low = middle } else { high = middle }
    }
    (low, high)
}
