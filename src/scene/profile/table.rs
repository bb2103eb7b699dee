//! From the table of a file: which planes its horizontal angles stand for, and the flux.

use super::{Fold, IesProfile};
use crate::scene::ies::{Table, Web};
use std::f64::consts::TAU;

/// Angles that are meant to be the same (degrees).
const SAME: f64 = 0.1;

/// Horizontal angles (degrees) with their ends where they are meant to be, and what the others are made of.
pub(super) fn folded(table: &Table) -> Result<(Vec<f64>, Fold), String> {
    let mut angles = table.horizontal.clone();
    let last = angles.len() - 1;
    let (from, to) = (angles[0], angles[last]);
    let is = |x: f64, y: f64| (x - y).abs() <= SAME;
    let spans = |a: f64, b: f64| is(from, a) && is(to, b);
    let (fold, ends) = match table.web {
        Web::C if last == 0 => (Fold::Axial, [0.0, 0.0]),
        Web::C if spans(0.0, 90.0) => (Fold::Quadrant, [0.0, 90.0]),
        Web::C if spans(0.0, 180.0) => (Fold::Half, [0.0, 180.0]),
        Web::C if spans(90.0, 270.0) => (Fold::Across, [90.0, 270.0]),
        // The last plane is the first again, and some files leave it out.
        Web::C if is(from, 0.0) && to > 180.0 => (Fold::Around, [0.0, if is(to, 360.0) { 360.0 } else { to }]),
        Web::C => {
            return Err(format!(
                "the horizontal angles go from {from} to {to} degrees, but those of type C are 0 alone, or go from 0 to \
                 90, 180 or 360, or from 90 to 270; ask the maker for the whole table"
            ));
        }
        Web::AOrB if last > 0 && (-180.0 - SAME..-SAME).contains(&from) && to <= 180.0 + SAME => {
            (Fold::Section, [from.max(-180.0), to.min(180.0)])
        }
        Web::AOrB if last > 0 && is(from, 0.0) && to <= 180.0 + SAME => (Fold::Lateral, [0.0, to.min(180.0)]),
        Web::AOrB => {
            return Err(format!(
                "the horizontal angles go from {from} to {to} degrees, but those of types A and B go from -90 to 90, or \
                 from 0 to 90; ask the maker for the whole table"
            ));
        }
    };
    (angles[0], angles[last]) = (ends[0], ends[1]);
    Ok((angles, fold))
}

/// Refuses vertical angles that the type of photometry does not have.
pub(super) fn check_vertical(table: &Table) -> Result<(), String> {
    let (from, to) = (table.vertical[0], table.vertical[table.vertical.len() - 1]);
    let (kind, least, most) = match table.web {
        Web::C => ("type C", 0.0, 180.0),
        Web::AOrB => ("types A and B", -90.0, 90.0),
    };
    if from < least || to > most {
        return Err(format!(
            "the vertical angles go from {from} to {to} degrees, but those of {kind} lie in {least} to {most}; check \
             the photometric type"
        ));
    }
    Ok(())
}

/// Integral of the share over all directions (sr): of each cell of the table in closed form, and of those that it
/// stands for.
pub(super) fn flux(table: &Table, profile: &IesProfile) -> f64 {
    if profile.peak == 0.0 {
        return 0.0;
    }
    let from_pole = if table.web == Web::C { 0.0 } else { 90.0 };
    let polars: Vec<f64> = table.vertical.iter().map(|v| (v + from_pole).to_radians()).collect();
    // Over one column of the table, linear between its rows: integral of share times sin(polar).
    let column = |i: usize| -> f64 {
        let shares = &profile.shares[i * polars.len()..(i + 1) * polars.len()];
        let cells = polars.windows(2).zip(shares.windows(2)).map(|(q, s)| {
            let ((s0, c0), (s1, c1)) = (libm::sincos(q[0]), libm::sincos(q[1]));
            let (a, b) = (f64::from(s[0]), f64::from(s[1]));
            a * (c0 - c1) + (b - a) / (q[1] - q[0]) * (s1 - s0 - (q[1] - q[0]) * c1)
        });
        cells.sum()
    };
    let azimuths = &profile.azimuths;
    let times = match profile.fold {
        Fold::Axial => return TAU * column(0),
        Fold::Around | Fold::Section => 1.0,
        Fold::Half | Fold::Across | Fold::Lateral => 2.0,
        Fold::Quadrant => 4.0,
    };
    let sums: Vec<f64> = (0..azimuths.len()).map(column).collect();
    let wedge = |(a, s): (&[f32], &[f64])| f64::from(a[1] - a[0]) * 0.5 * (s[0] + s[1]);
    times * azimuths.windows(2).zip(sums.windows(2)).map(wedge).sum::<f64>()
}
