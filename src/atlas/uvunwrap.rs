//! The crate uvunwrap as an [`Unwrapper`].
//!
//! It is deterministic for any thread count. It may panic on odd meshes and silently drops triangles thinner
//! than 1e-6 of the mesh: both are told to the caller, who has other ways.

use super::NO_CHART;
use super::check::signed_area;
use super::unwrap::{Limits, UnwrapError, UnwrapInput, Unwrapped, UnwrappedVertex, Unwrapper, surface_area};
use glam::DVec2;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

/// The crate uvunwrap, run in this process.
#[derive(Debug, Clone, Copy, Default)]
pub struct Uvunwrap;

/// Texels per triangle of the layout that only carries the charts to us: enough that a chart's rounding to
/// f32, relative to the whole layout, stays far below a texel of the real atlas.
const TEXELS_PER_TRIANGLE: f64 = 64.0;

impl Unwrapper for Uvunwrap {
    fn unwrap(&self, mesh: &UnwrapInput, limits: Limits<'_>) -> Result<Unwrapped, UnwrapError> {
        let positions: Vec<[f32; 3]> = mesh.positions.iter().map(|p| p.to_array()).collect();
        let input = ::uvunwrap::MeshInput {
            face_materials: Some(&mesh.groups),
            ..::uvunwrap::MeshInput::new(&positions, mesh.triangles.as_flattened())
        };
        let options = ::uvunwrap::Options {
            max_chart_area: largest_chart(mesh),
            density: ::uvunwrap::Density::Fixed { texels_per_unit: carrier_density(mesh), page_size: None },
            padding: 1,
            packing: ::uvunwrap::Packing::Fast,
            ..::uvunwrap::Options::default()
        };
        let start = Instant::now();
        let go_on = |_| !(limits.cancelled)() && start.elapsed() < limits.time;
        // The call shares nothing with us but its arguments, so a panic leaves nothing half done.
        let answer = catch_unwind(AssertUnwindSafe(|| {
            ::uvunwrap::generate_with_progress(std::slice::from_ref(&input), &options, go_on)
        }));
        match answer {
            Ok(Ok(atlas)) => Ok(charts(mesh, &atlas)),
            Ok(Err(::uvunwrap::Error::Cancelled)) if (limits.cancelled)() => Err(UnwrapError::Cancelled),
            Ok(Err(::uvunwrap::Error::Cancelled)) => Err(UnwrapError::TimedOut(limits.time.as_secs())),
            Ok(Err(e)) => Err(UnwrapError::Failed(e.to_string())),
            Err(panic) => Err(UnwrapError::Crashed(panic_message(panic.as_ref()))),
        }
    }
}

/// Makes panics inside the crate uvunwrap silent: they are caught, reported as warnings and worked around. All
/// other panics keep the hook that is installed now. For programs: it changes the process's panic hook, which
/// a library must not do unasked.
pub fn silence_unwrapper_panics() {
    let others = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if !info.location().is_some_and(|l| l.file().contains("uvunwrap-")) {
            others(info);
        }
    }));
}

/// Charts of more triangles than this are cut: flattening takes more than twice the time for twice the
/// triangles, and is not stopped inside a chart.
const CHART_TRIANGLES: f64 = 16_384.0;

/// Largest area of a chart, 0 for any: where triangles are about equal, that of [`CHART_TRIANGLES`].
fn largest_chart(mesh: &UnwrapInput) -> f32 {
    let triangles = mesh.triangles.len() as f64;
    if triangles <= CHART_TRIANGLES { 0.0 } else { (area(mesh) * CHART_TRIANGLES / triangles) as f32 }
}

fn area(mesh: &UnwrapInput) -> f64 {
    mesh.triangles.iter().map(|t| surface_area(t.map(|v| mesh.positions[v as usize].as_dvec3()))).sum()
}

/// Texels per unit of the layout that carries the charts to us.
fn carrier_density(mesh: &UnwrapInput) -> f32 {
    let texels = (mesh.triangles.len() as f64 * TEXELS_PER_TRIANGLE).clamp(65_536.0, 16_777_216.0);
    // The longest chart, about the mesh's diagonal, must not ask for an endless page either.
    (texels / area(mesh).max(f64::MIN_POSITIVE)).sqrt().min(8192.0) as f32
}

/// The charts back in the mesh's unit; dropped triangles, which collapse onto a point, without one.
fn charts(mesh: &UnwrapInput, atlas: &::uvunwrap::Atlas) -> Unwrapped {
    let to_units = DVec2::new(f64::from(atlas.width), f64::from(atlas.height)) / f64::from(atlas.texels_per_unit);
    let output = &atlas.meshes[0];
    let vertices: Vec<UnwrappedVertex> = output
        .vertices
        .iter()
        .map(|v| UnwrappedVertex { source: v.xref, uv: DVec2::new(f64::from(v.uv[0]), f64::from(v.uv[1])) * to_units })
        .collect();
    let triangles: Vec<[u32; 3]> = output.indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect();
    let charts = triangles
        .iter()
        .map(|t| {
            let chart = t.map(|v| output.vertices[v as usize].chart);
            let dropped = chart[0] != chart[1] || chart[1] != chart[2];
            let empty = signed_area(&t.map(|v| vertices[v as usize].uv)) == 0.0;
            chart[0].filter(|_| !dropped && !empty).unwrap_or(NO_CHART)
        })
        .collect();
    debug_assert_eq!(triangles.len(), mesh.triangles.len(), "uvunwrap keeps triangles one to one");
    Unwrapped { vertices, triangles, charts, chart_count: atlas.chart_count }
}

fn panic_message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|s| s.to_string()).or_else(|| panic.downcast_ref::<String>().cloned());
    text.unwrap_or_else(|| "panicked".into())
}
