//! Where a luminaire sends its light, as a goniophotometer measured it.

mod cone;
mod file;
mod table;

use super::ies::{self, Table, Web};
use crate::error::{SceneError, Warning};
use file::{read_small, tilt_file};
use glam::Vec3;
use std::f32::consts::{FRAC_PI_2, PI};
use std::path::Path;
use table::{check_vertical, flux, folded};

/// Intensity over all directions, read from an IES file: bilinear between the angles of its table, dark where it has
/// none.
///
/// Directions are those of the light's own frame, as EXT_lights_ies places it. The zero of both angles is -Z, where the
/// light points. Type C: the horizontal angle turns about it, from +X (0 degrees) to +Y (90 degrees), counter-clockwise
/// as seen from above a lamp that hangs. Types A and B: vertical angles go from -X (-90 degrees) over -Z to +X,
/// horizontal ones from -Z towards -Y, clockwise about +X.
#[derive(Debug, Clone, PartialEq)]
pub struct IesProfile {
    /// File it was read from, for messages.
    pub name: String,
    web: Web,
    fold: Fold,
    /// Horizontal angles (rad), ascending; one where the light is the same all around.
    azimuths: Vec<f32>,
    /// Angles from the pole (rad), ascending in [0, pi]: -Z of type C, -X of the others.
    polars: Vec<f32>,
    /// Intensity over the largest, in [0, 1]: a row of polar angles for each azimuth.
    shares: Vec<f32>,
    peak: f64,
    flux: f64,
    lamp_lumens: Option<f64>,
    tilt: Vec<[f64; 2]>,
    cone: (Vec3, f32),
}

/// How the horizontal angles of the table stand for those that it lacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fold {
    /// The same all around.
    Axial,
    /// All there; the last is the first again.
    Around,
    /// Mirrored at the plane of 0 and 180 degrees.
    Half,
    /// Mirrored at the plane of 90 and 270 degrees.
    Across,
    /// Mirrored at both.
    Quadrant,
    /// Types A and B: what is not there is dark.
    Section,
    /// The same, mirrored at 0 degrees.
    Lateral,
}

/// A direction at the border of the table belongs to it, whatever way it was rounded (rad).
const HAIR: f32 = 1e-6;

impl IesProfile {
    /// Reads an IES file. What a line `TILT=name` names must lie in the same folder.
    ///
    /// # Errors
    /// [`SceneError`] names the file, the line and the cure.
    pub fn from_file(path: &Path) -> Result<(IesProfile, Vec<Warning>), SceneError> {
        let bytes = read_small(path).map_err(|source| SceneError::Io { path: path.into(), source })?;
        IesProfile::from_bytes(path, &bytes, path.parent())
    }

    /// Reads the contents of an IES file. `path` names it in messages; the file of a line `TILT=name` is looked for
    /// in `folder`, if there is one.
    ///
    /// # Errors
    /// As [`from_file`](Self::from_file).
    pub fn from_bytes(
        path: &Path,
        bytes: &[u8],
        folder: Option<&Path>,
    ) -> Result<(IesProfile, Vec<Warning>), SceneError> {
        let invalid = |what: String| SceneError::Invalid { path: path.into(), what };
        let tilt_file = |name: &str| tilt_file(name, folder);
        let table = ies::parse(bytes, tilt_file).map_err(|fault| invalid(fault.to_string()))?;
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let mut profile = IesProfile::of_table(name, &table).map_err(invalid)?;
        profile.flux = flux(&table, &profile) * profile.peak;
        profile.cone = profile.find_cone();
        let file = path.display();
        let mut warnings: Vec<Warning> =
            table.odd.iter().map(|odd| Warning::new("odd-ies", format!("{file}: {odd}"))).collect();
        if profile.peak == 0.0 {
            warnings.push(Warning::new("odd-ies", format!("{file}: all of its intensities are 0: it gives no light")));
        }
        Ok((profile, warnings))
    }

    fn of_table(name: String, table: &Table) -> Result<IesProfile, String> {
        let (mut horizontal, fold) = folded(table)?;
        check_vertical(table)?;
        let peak = table.candela.iter().copied().fold(0.0, f64::max);
        let scale = if peak > 0.0 { 1.0 / peak } else { 0.0 };
        let mut shares: Vec<f32> = table.candela.iter().map(|&c| (c * scale) as f32).collect();
        if fold == Fold::Around && horizontal[horizontal.len() - 1] < 360.0 {
            horizontal.push(360.0);
            shares.extend_from_within(..table.vertical.len());
        }
        let from_pole = if table.web == Web::C { 0.0 } else { 90.0 };
        Ok(IesProfile {
            name,
            web: table.web,
            fold,
            azimuths: horizontal.iter().map(|h| h.to_radians() as f32).collect(),
            polars: table.vertical.iter().map(|v| (v + from_pole).to_radians() as f32).collect(),
            shares,
            peak,
            flux: 0.0,
            lamp_lumens: table.lamp_lumens,
            tilt: table.tilt.clone(),
            cone: (Vec3::NEG_Z, PI),
        })
    }

    /// Largest intensity (cd).
    pub fn peak(&self) -> f64 {
        self.peak
    }

    /// Flux of the luminaire (lm): the integral of the intensity over all directions, in closed form.
    pub fn flux(&self) -> f64 {
        self.flux
    }

    /// Rated flux of its lamps (lm); `None` where photometry is absolute.
    pub fn lamp_lumens(&self) -> Option<f64> {
        self.lamp_lumens
    }

    /// Share of the light that is left where the luminaire is tilted by `angle` (rad) out of the position in which it
    /// was measured: 1 but for lamps that say otherwise (`TILT=`).
    pub fn tilt_factor(&self, angle: f64) -> f64 {
        let angle = angle.to_degrees();
        let next = self.tilt.partition_point(|t| t[0] <= angle);
        match (self.tilt.get(next.wrapping_sub(1)), self.tilt.get(next)) {
            (Some(&[a, fa]), Some(&[b, fb])) => fa + (fb - fa) * (angle - a) / (b - a),
            (Some(&[_, only]), None) | (None, Some(&[_, only])) => only,
            (None, None) => 1.0,
        }
    }

    /// Intensity over [`peak`](Self::peak) along `w`, a unit direction in the light's frame, in which it travels.
    pub fn share(&self, w: Vec3) -> f32 {
        // Arc tangents of both sides of a triangle: an arc cosine loses half of the digits at the poles. Of zeros that
        // have a sign, as at the very pole, they would take the far side.
        let (polar, azimuth) = match self.web {
            Web::C => (libm::atan2f(libm::hypotf(w.x, w.y), -w.z), [w.y, w.x]),
            Web::AOrB => (libm::atan2f(libm::hypotf(w.y, w.z), -w.x), [0.0 - w.y, 0.0 - w.z]),
        };
        self.at(|| libm::atan2f(azimuth[0], azimuth[1]), polar)
    }

    /// The same at angles: `azimuth` in [-pi, 2 pi], `polar` in [0, pi].
    fn at(&self, azimuth: impl FnOnce() -> f32, polar: f32) -> f32 {
        let Some((row, down)) = between(&self.polars, polar) else { return 0.0 };
        let column =
            if self.fold == Fold::Axial { Some((0, 0.0)) } else { between(&self.azimuths, self.fold(azimuth())) };
        let Some((column, right)) = column else { return 0.0 };
        let along = |column: usize| {
            let first = column * self.polars.len() + row;
            mix(self.shares[first], self.shares[first + 1], down)
        };
        if right == 0.0 { along(column) } else { mix(along(column), along(column + 1), right) }
    }

    /// The azimuth of the table that stands for `a` in [-pi, 2 pi].
    fn fold(&self, a: f32) -> f32 {
        let around = if a < 0.0 { a + 2.0 * PI } else { a };
        let half = if around > PI { 2.0 * PI - around } else { around };
        match self.fold {
            Fold::Axial => 0.0,
            Fold::Around => around,
            Fold::Half => half,
            Fold::Across if around < FRAC_PI_2 => PI - around,
            Fold::Across if around > 1.5 * PI => 3.0 * PI - around,
            Fold::Across => around,
            Fold::Quadrant => half.min(PI - half),
            Fold::Section => a,
            Fold::Lateral => a.abs(),
        }
    }

    /// A unit axis in the light's frame and an angle (rad) such that along any direction at the angle t from the axis,
    /// [`share`](Self::share) is at most cos(max(0, t - angle)), 0 beyond a right angle more.
    pub fn cone(&self) -> (Vec3, f32) {
        self.cone
    }
}

fn mix(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// The interval of ascending `angles` (two at least) that `x` is in, and how far; `None` outside of all.
fn between(angles: &[f32], x: f32) -> Option<(usize, f32)> {
    let last = angles.len() - 1;
    if x < angles[0] - HAIR || x > angles[last] + HAIR {
        return None;
    }
    let i = angles.partition_point(|&a| a <= x).clamp(1, last) - 1;
    Some((i, ((x - angles[i]) / (angles[i + 1] - angles[i])).clamp(0.0, 1.0)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use std::f64::consts::{PI as PI64, TAU};

    /// A profile of LM-63-2002, absolute, all factors 1, from type, angles and `candela(horizontal, vertical)`.
    fn profile(kind: u32, horizontal: &[f64], vertical: &[f64], candela: impl Fn(f64, f64) -> f64) -> IesProfile {
        read(&text(kind, horizontal, vertical, candela)).expect("a good file")
    }

    fn text(kind: u32, horizontal: &[f64], vertical: &[f64], candela: impl Fn(f64, f64) -> f64) -> String {
        let list = |values: &[f64]| values.iter().map(|v| format!("{v} ")).collect::<String>();
        let rows = horizontal.iter().map(|&h| list(&vertical.iter().map(|&v| candela(h, v)).collect::<Vec<f64>>()));
        format!(
            "IESNA:LM-63-2002\nTILT=NONE\n1 -1 1 {} {} {kind} 2 0 0 0\n1 1 0\n{}\n{}\n{}\n",
            vertical.len(),
            horizontal.len(),
            list(vertical),
            list(horizontal),
            rows.collect::<Vec<String>>().join("\n")
        )
    }

    fn read(text: &str) -> Result<IesProfile, SceneError> {
        IesProfile::from_bytes(Path::new("lamp.ies"), text.as_bytes(), None).map(|(profile, _)| profile)
    }

    fn refused(text: &str) -> String {
        read(text).expect_err("a bad file").to_string()
    }

    /// Candela along the direction at the angles (degrees) that the type measures it by.
    fn candela(p: &IesProfile, horizontal: f64, vertical: f64) -> f64 {
        let ((sh, ch), (sv, cv)) = (horizontal.to_radians().sin_cos(), vertical.to_radians().sin_cos());
        let w = match p.web {
            Web::C => DVec3::new(sv * ch, sv * sh, -cv),
            Web::AOrB => DVec3::new(sv, -cv * sh, -cv * ch),
        };
        f64::from(p.share(w.as_vec3())) * p.peak()
    }

    #[track_caller]
    fn expect(p: &IesProfile, horizontal: f64, vertical: f64, expected: f64) {
        let found = candela(p, horizontal, vertical);
        assert!((found - expected).abs() < 1e-4 * p.peak(), "at {horizontal}, {vertical}: {found}, not {expected}");
    }

    /// By hand: 0.5 * (100 + 60) along 45 degrees of the first plane, 0.5 * (80 + 20) of the second, 65 between.
    #[test]
    fn values_between_angles_are_bilinear() {
        let p = profile(1, &[0.0, 90.0], &[0.0, 90.0], |h, v| match (h as i32, v as i32) {
            (0, 0) => 100.0,
            (0, 90) => 60.0,
            (90, 0) => 80.0,
            _ => 20.0,
        });
        for (h, v, expected) in [(0.0, 0.0, 100.0), (0.0, 45.0, 80.0), (90.0, 45.0, 50.0), (45.0, 45.0, 65.0)] {
            expect(&p, h, v, expected);
        }
        // A quarter of the way along the horizontal, three quarters down: 100, 60 and 80, 20 give 70 and 35.
        expect(&p, 22.5, 67.5, 0.75 * 70.0 + 0.25 * 35.0);
        expect(&p, 22.5, 90.0001, 0.0);
        assert_eq!((p.peak(), p.lamp_lumens()), (100.0, None));
    }

    /// Where the angles of type C point in the frame of the light, and those of types A and B.
    #[test]
    fn angles_point_as_the_extension_says() {
        let c = profile(1, &[0.0, 90.0, 180.0, 270.0, 360.0], &[0.0, 90.0, 180.0], |h, v| match v as i32 {
            0 => 1.0,
            90 => 10.0 + (h as i32 % 360) as f64 / 9.0,
            _ => 2.0,
        });
        let along = |p: &IesProfile, w: Vec3| (f64::from(p.share(w)) * p.peak()).round() as i32;
        assert_eq!([along(&c, Vec3::NEG_Z), along(&c, Vec3::Z)], [1, 2]);
        assert_eq!([Vec3::X, Vec3::Y, Vec3::NEG_X, Vec3::NEG_Y].map(|w| along(&c, w)), [10, 20, 30, 40]);
        let b = |kind| {
            profile(kind, &[-90.0, 0.0, 90.0], &[-90.0, 0.0, 90.0], |h, v| match (h as i32, v as i32) {
                (_, -90) => 1.0,
                (_, 90) => 2.0,
                (-90, _) => 3.0,
                (0, _) => 4.0,
                _ => 5.0,
            })
        };
        for p in [b(2), b(3)] {
            let axes = [Vec3::NEG_X, Vec3::X, Vec3::Y, Vec3::NEG_Z, Vec3::NEG_Y];
            assert_eq!(axes.map(|w| along(&p, w)), [1, 2, 3, 4, 5]);
            assert_eq!(along(&p, Vec3::Z), 0, "behind is dark");
        }
    }

    /// Each range of horizontal angles, against the plane that it stands for.
    #[test]
    fn missing_planes_are_mirrored() {
        let f = |h: f64, v: f64| h + v;
        let v = [0.0, 90.0, 180.0];
        let axial = profile(1, &[0.0], &v, f);
        let quadrant = profile(1, &[0.0, 45.0, 90.0], &v, f);
        let half = profile(1, &[0.0, 90.0, 180.0], &v, f);
        let across = profile(1, &[90.0, 180.0, 270.0], &v, f);
        let all = profile(1, &[0.0, 90.0, 180.0, 270.0, 360.0], &v, |h, v| f(h % 360.0, v));
        let open = profile(1, &[0.0, 90.0, 180.0, 270.0], &v, f);
        for vertical in [0.1, 30.0, 90.0, 179.9] {
            for h in [10.0, 80.0, 100.0, 170.0, 190.0, 260.0, 300.0, 350.0] {
                expect(&axial, h, vertical, vertical);
                let half_way = if h > 180.0 { 360.0 - h } else { h };
                expect(&half, h, vertical, half_way + vertical);
                expect(&quadrant, h, vertical, f64::min(half_way, 180.0 - half_way) + vertical);
                let mirrored = if h < 90.0 {
                    180.0 - h
                } else if h > 270.0 {
                    540.0 - h
                } else {
                    h
                };
                expect(&across, h, vertical, mirrored + vertical);
                // Past 270 degrees it goes down to the first plane again.
                let around = if h > 270.0 { 270.0 * (360.0 - h) / 90.0 } else { h };
                expect(&all, h, vertical, around + vertical);
                expect(&open, h, vertical, around + vertical);
            }
        }
        let lateral = profile(2, &[0.0, 90.0], &[-90.0, 90.0], |h, _| 90.0 - h);
        let section = profile(2, &[-90.0, 90.0], &[0.0, 90.0], |h, _| 90.0 + h);
        for h in [1.0, 30.0, 89.0] {
            for side in [-1.0, 1.0] {
                expect(&lateral, side * h, 20.0, 90.0 - h);
                expect(&section, side * h, 20.0, 90.0 + side * h);
                expect(&section, side * h, -20.0, 0.0);
            }
        }
    }

    /// Uniform: 4 pi I. A cosine: pi I. Up or down alone: half. By hand, one cell linear in the angle over a quarter:
    /// the integral of (1 - t / (pi / 2)) sin t over 0 to pi / 2 is 1 - 2 / pi.
    #[test]
    fn flux_in_closed_form() {
        let near = |p: &IesProfile, expected: f64| {
            let found = p.flux();
            assert!((found / expected - 1.0).abs() < 2e-6, "{found} lm, not {expected}");
        };
        let one = |_: f64, _: f64| 50.0;
        let full: [f64; 3] = [0.0, 90.0, 180.0];
        for h in [&[0.0][..], &[0.0, 90.0], &[0.0, 180.0], &[90.0, 270.0], &[0.0, 180.0, 360.0], &[0.0, 120.0, 240.0]] {
            near(&profile(1, h, &full, one), 4.0 * PI64 * 50.0);
            near(&profile(1, h, &[0.0, 90.0], one), 2.0 * PI64 * 50.0);
            near(&profile(1, h, &[90.0, 180.0], one), 2.0 * PI64 * 50.0);
            near(&profile(1, h, &[0.0, 90.0], |_, v| 90.0 - v), 2.0 * PI64 * 90.0 * (1.0 - 2.0 / PI64));
        }
        for h in [&[-90.0, 0.0, 90.0][..], &[0.0, 90.0], &[-90.0, 90.0]] {
            for kind in [2, 3] {
                near(&profile(kind, h, &[-90.0, 90.0], one), 2.0 * PI64 * 50.0);
                near(&profile(kind, h, &[0.0, 90.0], one), PI64 * 50.0);
            }
        }
        near(&profile(2, &[-180.0, 180.0], &[-90.0, 90.0], one), 4.0 * PI64 * 50.0);
        let degrees: Vec<f64> = (0..=360).map(|k| f64::from(k) * 0.5).collect();
        let cosine = profile(1, &[0.0], &degrees, |_, v| 70.0 * v.to_radians().cos().max(0.0));
        assert!((cosine.flux() / (PI64 * 70.0) - 1.0).abs() < 3e-5, "{}", cosine.flux());
    }

    /// The flux once more, as a sum over directions that knows nothing of tables.
    #[test]
    fn flux_is_the_integral_of_the_intensity() {
        for p in samples() {
            let (rows, columns) = (2000, 1000);
            let mut sum = 0.0;
            for i in 0..rows {
                let z = -1.0 + (f64::from(i) + 0.5) * 2.0 / f64::from(rows);
                let r = (1.0 - z * z).sqrt();
                for k in 0..columns {
                    let (s, c) = ((f64::from(k) + 0.37) * TAU / f64::from(columns)).sin_cos();
                    sum += f64::from(p.share(DVec3::new(r * c, r * s, z).as_vec3()));
                }
            }
            let integral = sum * 2.0 * TAU / f64::from(rows * columns) * p.peak();
            assert!((p.flux() / integral - 1.0).abs() < 2e-3, "{:?}: {}, not {integral}", p.fold, p.flux());
        }
    }

    /// Lamps of all kinds: batwing, spot, up and down, one-sided, floodlights.
    fn samples() -> Vec<IesProfile> {
        let v: Vec<f64> = (0..=36).map(|k| f64::from(k) * 5.0).collect();
        let down: Vec<f64> = (0..=18).map(|k| f64::from(k) * 5.0).collect();
        let ab: Vec<f64> = (-18..=18).map(|k| f64::from(k) * 5.0).collect();
        let h: Vec<f64> = (0..=24).map(|k| f64::from(k) * 15.0).collect();
        let bat = |_: f64, v: f64| 100.0 * (1.0 - ((v - 65.0) / 25.0).powi(2)).max(0.0) + 5.0;
        let spot = |_: f64, v: f64| 1000.0 * (1.0 - v / 20.0).max(0.0);
        let both = |_: f64, v: f64| 80.0 * v.to_radians().cos().abs();
        let side = |h: f64, v: f64| 60.0 * (1.0 + h.to_radians().cos()) * v.to_radians().sin();
        vec![
            profile(1, &[0.0], &down, bat),
            profile(1, &[0.0], &v, spot),
            profile(1, &[0.0, 90.0], &v, both),
            profile(1, &h, &v, side),
            profile(1, &h[..13], &down, side),
            profile(1, &h[6..19], &v, side),
            profile(1, &[0.0, 180.0, 360.0], &[90.0, 135.0, 180.0], |_, v| v),
            profile(2, &ab, &ab, |h, v| 100.0 * (1.0 - (h * h + v * v) / 900.0).max(0.0)),
            profile(3, &[0.0, 45.0, 90.0], &ab, |h, v| 200.0 - h - v),
        ]
    }

    /// The bound holds at random directions, is 0 only in the dark, and is narrow for a spot.
    #[test]
    fn the_cone_bounds_the_light() {
        for p in samples() {
            let (axis, angle) = p.cone();
            for k in 0..50_000 {
                let w = crate::sampling::uniform_cone(Vec3::Z, -1.0, point(k));
                let off = axis.dot(w).clamp(-1.0, 1.0).acos() - angle;
                let bound = if off > FRAC_PI_2 { 0.0 } else { off.max(0.0).cos() };
                assert!(p.share(w) <= bound + 1e-3, "{:?} along {w}: {} over {bound}", p.fold, p.share(w));
                assert!(bound > 0.0 || p.share(w) == 0.0, "{:?} along {w}", p.fold);
            }
        }
        let (axis, angle) = samples()[1].cone();
        assert!(axis.distance(Vec3::NEG_Z) < 1e-3 && angle < 0.1, "{axis} {angle}");
    }

    fn point(k: u32) -> glam::Vec2 {
        let part = |a: f64| (f64::from(k) * a + 0.5).fract() as f32;
        glam::Vec2::new(part(0.754_877_67), part(0.569_840_3))
    }

    #[test]
    fn lamps_that_must_not_tilt_lose_light() {
        let tilted = text(1, &[0.0], &[0.0, 90.0], |_, _| 1.0).replace("=NONE", "=INCLUDE\n1 3\n0 60 90\n1 0.7 0.4");
        let p = read(&tilted).expect("a good file");
        for (degrees, factor) in [(0.0, 1.0), (30.0, 0.85), (60.0, 0.7), (75.0, 0.55), (90.0, 0.4), (150.0, 0.4)] {
            let found = p.tilt_factor(f64::to_radians(degrees));
            assert!((found - factor).abs() < 1e-9, "{degrees}: {found}");
        }
        assert_eq!(profile(1, &[0.0], &[0.0, 90.0], |_, _| 1.0).tilt_factor(1.0), 1.0);
    }

    #[test]
    fn a_dark_lamp_is_dark_and_said_to_be() {
        let dark = text(1, &[0.0], &[0.0, 90.0], |_, _| 0.0);
        let (p, warnings) = IesProfile::from_bytes(Path::new("a/lamp.ies"), dark.as_bytes(), None).expect("good");
        assert_eq!((p.flux(), p.peak(), p.share(Vec3::NEG_Z), p.name.as_str()), (0.0, 0.0, 0.0, "lamp.ies"));
        assert!(warnings[0].message.contains("a/lamp.ies: all of its intensities are 0"), "{warnings:?}");
    }

    #[test]
    fn tables_that_leave_directions_open_are_refused() {
        let one = |_: f64, _: f64| 1.0;
        for (kind, h, v, what) in [
            (1, &[0.0, 45.0][..], &[0.0, 90.0][..], "from 0 to 45 degrees, but those of type C"),
            (1, &[-90.0, 90.0], &[0.0, 90.0], "from -90 to 90 degrees, but those of type C"),
            (2, &[0.0], &[0.0, 90.0], "those of types A and B"),
            (3, &[10.0, 90.0], &[0.0, 90.0], "those of types A and B"),
            (1, &[0.0], &[-90.0, 90.0], "from -90 to 90 degrees, but those of type C lie in 0 to 180"),
            (2, &[0.0, 90.0], &[0.0, 180.0], "those of types A and B lie in -90 to 90"),
        ] {
            let found = refused(&text(kind, h, v, one));
            assert!(found.starts_with("lamp.ies: ") && found.contains(what), "{found}");
        }
        assert!(refused("no profile").contains("lamp.ies: line 1: has no line TILT="));
        let tilted = text(1, &[0.0], &[0.0, 90.0], one).replace("=NONE", "=old\\MH.TLT");
        assert!(
            refused(&tilted).contains("line 2: TILT=old\\MH.TLT: a profile inside a scene"),
            "{}",
            refused(&tilted)
        );
    }

    #[test]
    fn a_tilt_file_lies_beside_the_profile() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("lamp.ies");
        let tilted = text(1, &[0.0], &[0.0, 90.0], |_, _| 1.0).replace("=NONE", "=C:\\old\\MH.TLT");
        std::fs::write(&path, tilted).expect("written");
        let missing = IesProfile::from_file(&path).expect_err("no such file").to_string();
        assert!(
            missing.contains("cannot read") && missing.contains("MH.TLT") && missing.contains("TILT=NONE"),
            "{missing}"
        );
        std::fs::write(folder.path().join("MH.TLT"), "1 2\n0 90\n1 0.5\n").expect("written");
        let (p, _) = IesProfile::from_file(&path).expect("a good file");
        assert!((p.tilt_factor(PI64 / 4.0) - 0.75).abs() < 1e-9);
        let absent = IesProfile::from_file(&folder.path().join("none.ies")).expect_err("no such file").to_string();
        assert!(absent.contains("none.ies"), "{absent}");
    }
}
