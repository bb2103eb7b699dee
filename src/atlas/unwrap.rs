//! Cutting and flattening a mesh: the unwrapper behind a trait, and everything that keeps a bake alive when it
//! fails.
//!
//! In: the triangles of a mesh in metres. Out: charts in metres, one plane triangle per input triangle. A mesh
//! goes to the backend in pieces of whole connected components. What the backend panics on, takes too long
//! for, drops or gets wrong is retried in halves and in the end flattened by `planar`: every
//! triangle with an area gets a chart, and every detour leaves a warning.

use super::NO_CHART;
use super::check::{self, PlaneTriangle};
use super::pieces::{Piece, Source, halves, pieces, weld};
use super::planar::Lean;
use crate::cache::Digest;
use crate::error::Warning;
use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;
use std::collections::HashMap;
use std::time::{Duration, Instant};

/// What a backend sees: a mesh in its own frame, centred and scaled to coordinates in [-1, 1], finite, every
/// index in range and every triangle with an area.
#[derive(Debug, Clone)]
pub struct UnwrapInput {
    /// Corners.
    pub positions: Vec<Vec3>,
    /// Triangles as indices into `positions`.
    pub triangles: Vec<[u32; 3]>,
    /// Charts must not span triangles of different groups.
    pub groups: Vec<u32>,
}

/// A vertex on the map.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct UnwrappedVertex {
    /// The input vertex it copies.
    pub source: u32,
    /// Place in its chart's own plane, in the unit of the input's positions.
    pub uv: DVec2,
}

/// A mesh cut into charts, each in its own plane.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Unwrapped {
    /// Vertices; those of different charts are different.
    pub vertices: Vec<UnwrappedVertex>,
    /// The input's triangles in order, as indices into `vertices`; meaningless where `charts` is [`NO_CHART`].
    pub triangles: Vec<[u32; 3]>,
    /// Chart of each triangle, or [`NO_CHART`] where it was dropped.
    pub charts: Vec<u32>,
    /// Number of charts.
    pub chart_count: u32,
}

impl Unwrapped {
    /// Whether it can be one of `mesh`: every reference is to something that is there, and all places are numbers.
    pub(super) fn is_of(&self, mesh: &JoinedMesh) -> bool {
        let n = mesh.triangles.len();
        let there = |t: &[u32; 3]| t.iter().all(|&v| (v as usize) < self.vertices.len());
        self.triangles.len() == n
            && self.charts.len() == n
            && self.chart_count as usize <= n
            && self.charts.iter().zip(&self.triangles).all(|(&c, t)| c == NO_CHART || c < self.chart_count && there(t))
            && self.vertices.iter().all(|v| (v.source as usize) < mesh.positions.len() && v.uv.is_finite())
    }
}

/// Why a backend gave nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum UnwrapError {
    /// It panicked or crashed.
    #[error("crashed: {0}")]
    Crashed(String),
    /// It was stopped after its time limit.
    #[error("took longer than {0} s")]
    TimedOut(u64),
    /// It refused the mesh or answered nonsense.
    #[error("failed: {0}")]
    Failed(String),
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
    /// It cannot run at all; the message says how to get it.
    #[error("{0}")]
    Unavailable(String),
}

/// When a backend has to give up.
#[derive(Clone, Copy)]
pub struct Limits<'a> {
    /// Longest time for one call.
    pub time: Duration,
    /// When all calls must have ended: what is left then is flattened by projection. Default: never.
    pub deadline: Option<Instant>,
    /// True once the caller wants to stop.
    pub cancelled: &'a (dyn Fn() -> bool + Sync),
}

impl Limits<'_> {
    /// The deadline is over.
    pub fn late(&self) -> bool {
        self.deadline.is_some_and(|d| Instant::now() >= d)
    }

    /// The same with a call's time cut at the deadline.
    fn for_a_call(self) -> Self {
        let left = self.deadline.map_or(Duration::MAX, |d| d.saturating_duration_since(Instant::now()));
        Limits { time: self.time.min(left), ..self }
    }
}

/// Something that cuts a mesh into charts and flattens them. Its results are checked, never trusted.
pub trait Unwrapper: Sync {
    /// Unwraps `mesh`.
    ///
    /// # Errors
    /// [`UnwrapError`]; none of them ends a bake but [`UnwrapError::Cancelled`] and
    /// [`UnwrapError::Unavailable`].
    fn unwrap(&self, mesh: &UnwrapInput, limits: Limits<'_>) -> Result<Unwrapped, UnwrapError>;
}

/// All primitives of a mesh joined, in metres.
#[derive(Debug, Clone, Default)]
pub struct JoinedMesh {
    /// Name for messages.
    pub name: String,
    /// Positions (m); may be non-finite or huge.
    pub positions: Vec<DVec3>,
    /// Triangles as indices into `positions`, all in range.
    pub triangles: Vec<[u32; 3]>,
    /// Face group of each triangle, or [`IGNORED`].
    pub groups: Vec<u32>,
    /// The most texels per metre that its charts may get. Components of more triangles than texels are projected
    /// on planes: what the backend would do better, nobody could see.
    pub texels_per_metre: f64,
}

impl JoinedMesh {
    /// Adds all that its charts depend on.
    pub(super) fn feed(&self, digest: &mut Digest) {
        // Warnings name it.
        digest.bytes(self.name.as_bytes());
        digest.values(&self.positions);
        digest.values(&self.triangles);
        digest.values(&self.groups);
        digest.debug(&self.texels_per_metre);
    }

    /// Area of the triangles that get charts (m2).
    pub fn area(&self) -> f64 {
        let counts = |t: &u32| self.groups[*t as usize] != IGNORED;
        (0..self.triangles.len() as u32).filter(counts).map(|t| area_of(self, t)).filter(|a| a.is_finite()).sum()
    }
}

/// The code of a warning of this module that the mesh alone brings about, written down as `code`; `None` for others, of
/// charts that are as they are because time ran out or a child process ended.
pub(super) fn code_of_mesh(code: &str) -> Option<&'static str> {
    let all =
        ["unwrapper-failed", "unwrapper-dropped", "unwrapper-faulty", "non-finite-triangles", "degenerate-triangles"];
    all.into_iter().find(|known| *known == code)
}

/// The group of triangles that get no chart on purpose.
pub const IGNORED: u32 = u32::MAX;

/// Altitude, relative to the largest coordinate of a triangle, below which it has no area: positions come from
/// f32, so whatever is flatter than this is collinear up to the rounding of f64.
const MIN_RELATIVE_ALTITUDE: f64 = 1e-14;

/// Pieces of fewer triangles than this are not halved any further.
const MIN_HALVED: usize = 256;

/// How often a piece is halved after a time-out, when each try may take the full limit again.
const MAX_HALVINGS_AFTER_TIME_OUT: u32 = 2;

/// Time for a backend call when `triangles` are unwrapped at the same time: 60 s and 20 s per 100,000.
pub fn default_time_limit(triangles: usize) -> Duration {
    Duration::from_secs(60 + triangles as u64 / 5000)
}

/// Unwraps `mesh` with `backend` and every fallback. UVs come back in metres; each chart has the area of its
/// surface.
///
/// # Errors
/// [`UnwrapError::Cancelled`] and [`UnwrapError::Unavailable`] only.
pub fn unwrap_mesh(
    mesh: &JoinedMesh,
    backend: &dyn Unwrapper,
    limits: Limits<'_>,
) -> Result<(Unwrapped, Vec<Warning>), UnwrapError> {
    let mut warnings = Vec::new();
    let usable = usable_triangles(mesh, &mut warnings);
    let welded = weld(&mesh.positions);
    let source = Source { mesh, welded: &welded };
    let parts = pieces(source, &usable)
        .into_par_iter()
        .map(|Piece { triangles, seen }| match seen {
            true => unwrap_piece(source, triangles, backend, limits, 0),
            false if (limits.cancelled)() => Err(UnwrapError::Cancelled),
            false => Ok(Part { charts: source.flatten(&triangles, Lean::Much), notes: Notes::default() }),
        })
        .collect::<Result<Vec<_>, _>>()?;
    let mut notes = Notes::default();
    let mut result = Unwrapped {
        vertices: Vec::new(),
        triangles: vec![[0; 3]; mesh.triangles.len()],
        charts: vec![NO_CHART; mesh.triangles.len()],
        chart_count: 0,
    };
    for part in parts {
        notes.add(&part.notes);
        for chart in part.charts {
            append(&mut result, mesh, &chart);
        }
    }
    notes.warn(mesh, &mut warnings);
    Ok((result, warnings))
}

/// A chart on its way: triangles of the mesh and their corners in the chart's plane [m].
#[derive(Debug, Clone)]
pub(super) struct FlatChart {
    pub triangles: Vec<u32>,
    pub corners: Vec<PlaneTriangle>,
}

/// What came of a piece.
#[derive(Default)]
struct Part {
    charts: Vec<FlatChart>,
    notes: Notes,
}

/// Counts of triangles per detour, for the warnings.
#[derive(Default, Clone)]
struct Notes {
    crashed: usize,
    timed_out: usize,
    late: usize,
    failed: usize,
    dropped: usize,
    faulty: usize,
    reason: Option<String>,
}

impl Notes {
    fn add(&mut self, o: &Notes) {
        self.crashed += o.crashed;
        self.timed_out += o.timed_out;
        self.late += o.late;
        self.failed += o.failed;
        self.dropped += o.dropped;
        self.faulty += o.faulty;
        self.reason = self.reason.take().or_else(|| o.reason.clone());
    }

    fn warn(&self, mesh: &JoinedMesh, warnings: &mut Vec<Warning>) {
        let name = &mesh.name;
        let of = mesh.triangles.len();
        let reason = self.reason.as_deref().unwrap_or("no reason given");
        let mut say = |count: usize, code, what: String| {
            if count > 0 {
                warnings.push(Warning::new(code, format!("mesh {name}: {what}")));
            }
        };
        let again = "they were unwrapped in smaller parts or flattened plane by plane";
        say(
            self.crashed,
            "unwrapper-crashed",
            format!("the unwrapper crashed on {} of {of} triangles ({reason}); {again}", self.crashed),
        );
        say(
            self.timed_out,
            "unwrapper-timed-out",
            format!("the unwrapper was stopped on {} of {of} triangles ({reason}); {again}", self.timed_out),
        );
        say(
            self.late,
            "unwrap-time-limit",
            format!(
                "{} of {of} triangles were flattened plane by plane, since half of the bake's time was over; raise \
                 --time-limit for fewer charts",
                self.late
            ),
        );
        say(
            self.failed,
            "unwrapper-failed",
            format!("the unwrapper refused {} of {of} triangles ({reason}); {again}", self.failed),
        );
        say(
            self.dropped,
            "unwrapper-dropped",
            format!(
                "the unwrapper dropped {} of {of} triangles as too thin; they were flattened plane by plane",
                self.dropped
            ),
        );
        say(
            self.faulty,
            "unwrapper-faulty",
            format!(
                "{} of {of} triangles came back from the unwrapper overlapping, flipped or stretched; they were \
                 flattened plane by plane",
                self.faulty
            ),
        );
    }
}

/// Triangles that get a chart, in order.
fn usable_triangles(mesh: &JoinedMesh, warnings: &mut Vec<Warning>) -> Vec<u32> {
    let (mut degenerate, mut non_finite) = (0, 0);
    let mut usable = Vec::with_capacity(mesh.triangles.len());
    for (i, t) in mesh.triangles.iter().enumerate() {
        let c = t.map(|v| mesh.positions[v as usize]);
        let longest = c[0].distance(c[1]).max(c[1].distance(c[2])).max(c[2].distance(c[0]));
        let area = surface_area(c);
        let flat = c.iter().fold(0.0, |m, p| p.abs().max_element().max(m)) * MIN_RELATIVE_ALTITUDE;
        if mesh.groups[i] == IGNORED {
            continue;
        } else if !(c.iter().all(|p| p.is_finite()) && area.is_finite()) {
            non_finite += 1;
        } else if area == 0.0 || 2.0 * area / longest <= flat {
            degenerate += 1;
        } else {
            usable.push(i as u32);
        }
    }
    let name = &mesh.name;
    if non_finite > 0 {
        warnings.push(Warning::new(
            "non-finite-triangles",
            format!("mesh {name}: {non_finite} triangles have corners that are not finite numbers and get no texels"),
        ));
    }
    if degenerate > 0 {
        warnings.push(Warning::new(
            "degenerate-triangles",
            format!("mesh {name}: {degenerate} triangles have no area and get no texels"),
        ));
    }
    usable
}

/// Surface area of a triangle.
pub(super) fn surface_area(c: [DVec3; 3]) -> f64 {
    0.5 * (c[1] - c[0]).cross(c[2] - c[0]).length()
}

/// Unwraps some triangles: the backend, else halves, else planes.
fn unwrap_piece(
    source: Source,
    piece: Vec<u32>,
    backend: &dyn Unwrapper,
    limits: Limits<'_>,
    halvings: u32,
) -> Result<Part, UnwrapError> {
    let mesh = source.mesh;
    if (limits.cancelled)() {
        return Err(UnwrapError::Cancelled);
    }
    let late = |piece: &[u32]| Part {
        charts: source.flatten(piece, Lean::Little),
        notes: Notes { late: piece.len(), ..Notes::default() },
    };
    if limits.late() {
        return Ok(late(&piece));
    }
    let local = Local::new(mesh, &piece);
    let answer = if local.input.triangles.is_empty() {
        Ok(Unwrapped::default())
    } else {
        backend.unwrap(&local.input, limits.for_a_call()).and_then(|u| local.validated(u))
    };
    let error = match answer {
        Ok(unwrapped) => return Ok(local.accept(source, &unwrapped)),
        Err(e @ (UnwrapError::Cancelled | UnwrapError::Unavailable(_))) => return Err(e),
        Err(UnwrapError::TimedOut(_)) if limits.late() => return Ok(late(&piece)),
        Err(e) => e,
    };
    let mut notes = Notes { reason: Some(error.to_string()), ..Notes::default() };
    let mut halve = piece.len() >= MIN_HALVED;
    match error {
        UnwrapError::Crashed(_) => notes.crashed = piece.len(),
        UnwrapError::TimedOut(_) => {
            notes.timed_out = piece.len();
            halve &= halvings < MAX_HALVINGS_AFTER_TIME_OUT;
        }
        _ => notes.failed = piece.len(),
    }
    let mut part = Part::default();
    if halve {
        // The parent's count already covers the halves'.
        let (a, b) = halves(mesh, piece);
        let (a, b) = rayon::join(
            || unwrap_piece(source, a, backend, limits, halvings + 1),
            || unwrap_piece(source, b, backend, limits, halvings + 1),
        );
        for half in [a?, b?] {
            part.charts.extend(half.charts);
            notes.late += half.notes.late;
            notes.dropped += half.notes.dropped;
            notes.faulty += half.notes.faulty;
        }
    } else {
        part.charts = source.flatten(&piece, Lean::Little);
    }
    part.notes = notes;
    Ok(part)
}

/// A piece in the frame that backends see.
struct Local {
    input: UnwrapInput,
    /// Triangle of the mesh for each triangle of `input`.
    triangles: Vec<u32>,
    /// Triangles of the piece that have no area in f32 and are kept from the backend.
    left: Vec<u32>,
    /// Metres per unit of the frame.
    metres: f64,
}

impl Local {
    fn new(mesh: &JoinedMesh, piece: &[u32]) -> Local {
        let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for &t in piece {
            for v in mesh.triangles[t as usize] {
                lo = lo.min(mesh.positions[v as usize]);
                hi = hi.max(mesh.positions[v as usize]);
            }
        }
        // Halves first: the sum of two huge coordinates may overflow.
        let centre = lo * 0.5 + hi * 0.5;
        let metres = (hi * 0.5 - lo * 0.5).max_element().max(f64::MIN_POSITIVE);
        let mut local = Local {
            input: UnwrapInput { positions: Vec::new(), triangles: Vec::new(), groups: Vec::new() },
            triangles: Vec::new(),
            left: Vec::new(),
            metres,
        };
        let mut vertex_of = HashMap::new();
        for &t in piece {
            let source = mesh.triangles[t as usize];
            let corner = source.map(|v| ((mesh.positions[v as usize] - centre) / metres).as_vec3());
            let area = surface_area(corner.map(|c| c.as_dvec3()));
            if !(area.is_finite() && area > 0.0) {
                local.left.push(t);
                continue;
            }
            let corners = [0, 1, 2].map(|k| {
                *vertex_of.entry(source[k]).or_insert_with(|| {
                    local.input.positions.push(corner[k]);
                    local.input.positions.len() as u32 - 1
                })
            });
            local.input.triangles.push(corners);
            local.input.groups.push(mesh.groups[t as usize]);
            local.triangles.push(t);
        }
        local
    }

    /// The answer, if its arrays fit the question.
    fn validated(&self, u: Unwrapped) -> Result<Unwrapped, UnwrapError> {
        let fits = u.triangles.len() == self.input.triangles.len()
            && u.charts.len() == u.triangles.len()
            && u.vertices.iter().all(|v| (v.source as usize) < self.input.positions.len())
            && u.triangles.iter().flatten().all(|&v| (v as usize) < u.vertices.len())
            && u.charts.iter().all(|&c| c < u.chart_count || c == NO_CHART);
        if fits { Ok(u) } else { Err(UnwrapError::Failed("its answer does not fit the mesh".into())) }
    }

    /// Takes the charts that pass the check; flattens what was dropped or is at fault.
    fn accept(&self, source: Source, u: &Unwrapped) -> Part {
        let mut part = Part::default();
        let mut left = self.left.clone();
        part.notes.dropped = left.len();
        let mut members: Vec<Vec<u32>> = vec![Vec::new(); u.chart_count as usize];
        for (i, &c) in u.charts.iter().enumerate() {
            if c == NO_CHART {
                left.push(self.triangles[i]);
                part.notes.dropped += 1;
            } else {
                members[c as usize].push(i as u32);
            }
        }
        for chart in members.into_iter().filter(|m| !m.is_empty()) {
            let corners: Vec<PlaneTriangle> = chart
                .iter()
                .map(|&i| u.triangles[i as usize].map(|v| u.vertices[v as usize].uv * self.metres))
                .collect();
            let triangles: Vec<u32> = chart.iter().map(|&i| self.triangles[i as usize]).collect();
            let (kept, faulty) = sound(source.mesh, FlatChart { triangles, corners });
            part.notes.faulty += faulty.len();
            left.extend(faulty);
            part.charts.extend(kept);
        }
        left.sort_unstable();
        part.charts.extend(source.flatten(&left, Lean::Little));
        part
    }
}

/// Overlap relative to a chart's extent that is put down to the rounding of f32.
const OVERLAP_TOLERANCE: f64 = 2e-5;

/// The sound part of a chart, scaled to the area of its surface, and the triangles that have to leave it.
fn sound(mesh: &JoinedMesh, chart: FlatChart) -> (Option<FlatChart>, Vec<u32>) {
    let surface: Vec<f64> = chart.triangles.iter().map(|&t| area_of(mesh, t)).collect();
    let faults = check::triangle_faults(&chart.corners, &surface);
    let mut faulty = Vec::new();
    let mut kept = FlatChart { triangles: Vec::new(), corners: Vec::new() };
    for (i, fault) in faults.iter().enumerate() {
        if fault.is_some() {
            faulty.push(chart.triangles[i]);
        } else {
            kept.triangles.push(chart.triangles[i]);
            kept.corners.push(chart.corners[i]);
        }
    }
    let (mut lo, mut hi) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for p in kept.corners.iter().flatten() {
        lo = lo.min(*p);
        hi = hi.max(*p);
    }
    let tolerance = (hi - lo).max_element() * OVERLAP_TOLERANCE;
    if kept.triangles.is_empty() || !check::find_overlaps(&kept.corners, tolerance, 1).is_empty() {
        return (None, chart.triangles);
    }
    let mapped: f64 = kept.corners.iter().map(|c| check::signed_area(c).abs()).sum();
    let surface: f64 = kept.triangles.iter().map(|&t| area_of(mesh, t)).sum();
    let scale = (surface / mapped).sqrt();
    for p in kept.corners.iter_mut().flatten() {
        *p = (*p - lo) * scale;
    }
    (Some(kept), faulty)
}

pub(super) fn area_of(mesh: &JoinedMesh, t: u32) -> f64 {
    surface_area(mesh.triangles[t as usize].map(|v| mesh.positions[v as usize]))
}

/// Adds a chart to the result, one vertex per source vertex and place.
fn append(result: &mut Unwrapped, mesh: &JoinedMesh, chart: &FlatChart) {
    let id = result.chart_count;
    result.chart_count += 1;
    let mut vertex_of = HashMap::with_capacity(chart.triangles.len() * 2);
    for (&t, corners) in chart.triangles.iter().zip(&chart.corners) {
        let source = mesh.triangles[t as usize];
        result.charts[t as usize] = id;
        result.triangles[t as usize] = [0, 1, 2].map(|k| {
            let key = (source[k], corners[k].x.to_bits(), corners[k].y.to_bits());
            *vertex_of.entry(key).or_insert_with(|| {
                result.vertices.push(UnwrappedVertex { source: source[k], uv: corners[k] });
                result.vertices.len() as u32 - 1
            })
        });
    }
}
