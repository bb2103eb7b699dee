//! A cone around the light of a profile, for the light tree.

use super::{Fold, HAIR, IesProfile};
use crate::scene::ies::Web;
use glam::{DVec3, Vec3};
use std::f32::consts::PI;
use std::f64::consts::TAU;

/// Step at which the light is looked at (rad).
const STEP: f64 = 0.05;

impl IesProfile {
    /// What [`cone`](Self::cone) gives.
    pub(super) fn find_cone(&self) -> (Vec3, f32) {
        let mut sum = DVec3::ZERO;
        self.visit_patches(|p| sum += p.towards * (p.largest * p.area));
        let axis = sum.try_normalize().unwrap_or(DVec3::NEG_Z);
        let mut widest = 0f64;
        self.visit_patches(|p| {
            let off = libm::acos(axis.dot(p.towards).clamp(-1.0, 1.0));
            widest = widest.max(off + p.radius - libm::acos(p.largest));
        });
        (axis.as_vec3(), (widest as f32).min(PI))
    }

    /// Calls `visit` for small parts of the sphere, all that are not dark.
    fn visit_patches(&self, mut visit: impl FnMut(&Patch)) {
        use std::f64::consts::PI;
        let azimuths = if self.fold == Fold::Axial { steps(&[-PI, PI]) } else { steps(&self.images()) };
        let polars: Vec<f64> = self.polars.iter().map(|&p| f64::from(p)).collect();
        for q in steps(&polars).windows(2) {
            for a in azimuths.windows(2) {
                // A little inside as well: the table may jump where it ends.
                let hair = 4.0 * f64::from(HAIR);
                let corners = [[a[0], q[0]], [a[0], q[1]], [a[1], q[0]], [a[1], q[1]]];
                let inner = [[a[0] + hair, q[0]], [a[0] + hair, q[1]], [a[1] - hair, q[0]], [a[1] - hair, q[1]]];
                let share = |&[a, q]: &[f64; 2]| f64::from(self.at(|| a as f32, q as f32));
                let largest = corners.iter().chain(&inner).map(share).fold(0.0, f64::max);
                if largest > 0.0 {
                    let ((sp, cp), (sa, ca)) = (libm::sincos(0.5 * (q[0] + q[1])), libm::sincos(0.5 * (a[0] + a[1])));
                    let towards = match self.web {
                        Web::C => DVec3::new(sp * ca, sp * sa, -cp),
                        Web::AOrB => DVec3::new(-cp, -sp * sa, -sp * ca),
                    };
                    let area = (a[1] - a[0]) * (libm::cos(q[0]) - libm::cos(q[1]));
                    // Half of the diagonal, and some for what is rounded.
                    let radius = 0.5 * libm::hypot(a[1] - a[0], q[1] - q[0]) + 1e-4;
                    visit(&Patch { towards, area, radius, largest: largest.min(1.0) });
                }
            }
        }
    }

    /// All azimuths in [-pi, pi] at which a column of the table is looked up, and both ends.
    fn images(&self) -> Vec<f64> {
        use std::f64::consts::PI;
        let mut all = vec![-PI, PI];
        for a in self.azimuths.iter().map(|&a| f64::from(a)) {
            all.extend([a, -a, PI - a, a - PI].map(|image| libm::remainder(image, TAU)));
        }
        all.sort_unstable_by(f64::total_cmp);
        all.dedup();
        all
    }
}

/// A part of the sphere.
struct Patch {
    /// Unit direction of its middle.
    towards: DVec3,
    /// (sr)
    area: f64,
    /// Largest angle to its middle (rad).
    radius: f64,
    /// Largest share in it, in (0, 1].
    largest: f64,
}

/// `angles` with as many between them as make steps of [`STEP`] at most.
fn steps(angles: &[f64]) -> Vec<f64> {
    let mut out: Vec<f64> = angles.first().copied().into_iter().collect();
    for pair in angles.windows(2) {
        let n = ((pair[1] - pair[0]) / STEP).ceil().max(1.0) as usize;
        out.extend((1..=n).map(|k| pair[0] + (pair[1] - pair[0]) * (k as f64 / n as f64)));
    }
    out
}
