//! xatlas as an [`Unwrapper`], in a child process.
//!
//! xatlas aborts or hangs on odd meshes, so it never runs in the process that bakes: `evenlight unwrap-worker`
//! reads one mesh on its standard input, unwraps it and writes the charts to its standard output. The parent
//! ends it after the time limit. The worker needs the feature `xatlas`; without it, it says so.
//!
//! Both messages are little-endian: a magic word, counts (u32), then the arrays. Everything read is checked.

use super::unwrap::{Limits, UnwrapError, UnwrapInput, Unwrapped, UnwrappedVertex, Unwrapper};
use glam::{DVec2, Vec3};
use std::io::{Read, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// The name of the subcommand that runs [`worker_main`].
pub const WORKER_COMMAND: &str = "unwrap-worker";

/// How to get a worker that can unwrap.
const CURE: &str = "build evenlight with `cargo build --release --features xatlas` (it needs a C++ compiler and \
                    libclang), or use --unwrapper uvunwrap";

/// Exit status of a worker built without xatlas.
const NOT_BUILT_IN: i32 = 69;

const QUESTION: u32 = u32::from_le_bytes(*b"EVQ1");
const ANSWER: u32 = u32::from_le_bytes(*b"EVA1");

/// How often the parent looks whether the worker is done.
const POLL: Duration = Duration::from_millis(2);

/// Runs a worker process per mesh.
#[derive(Debug, Clone)]
pub struct XatlasWorker {
    program: PathBuf,
}

impl XatlasWorker {
    /// Uses the evenlight binary `program`, which must be built with the feature `xatlas`.
    pub fn new(program: PathBuf) -> XatlasWorker {
        XatlasWorker { program }
    }
}

impl Unwrapper for XatlasWorker {
    fn unwrap(&self, mesh: &UnwrapInput, limits: Limits<'_>) -> Result<Unwrapped, UnwrapError> {
        let child = Command::new(&self.program)
            .arg(WORKER_COMMAND)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn();
        let program = self.program.display();
        let child =
            child.map_err(|e| UnwrapError::Unavailable(format!("cannot run the unwrapper {program}: {e}; {CURE}")))?;
        let (status, answer) = converse(child, &question(mesh), limits)?;
        match status {
            Some(0) => {
                parse_answer(&answer).ok_or_else(|| UnwrapError::Failed("the worker's answer cannot be read".into()))
            }
            Some(NOT_BUILT_IN) => Err(UnwrapError::Unavailable(format!("{program} was built without xatlas; {CURE}"))),
            Some(code) => Err(UnwrapError::Crashed(format!("the worker ended with status {code}"))),
            None => Err(UnwrapError::Crashed("the worker was killed".into())),
        }
    }
}

/// Sends the question, collects the answer, and ends the worker when its time is over. Pipes are served by
/// threads of their own, so that neither side waits for the other with full buffers.
fn converse(mut child: Child, question: &[u8], limits: Limits<'_>) -> Result<(Option<i32>, Vec<u8>), UnwrapError> {
    let start = Instant::now();
    let (stdin, stdout) = (child.stdin.take(), child.stdout.take());
    std::thread::scope(|scope| {
        scope.spawn(move || {
            // A worker that ends early closes the pipe; its status tells why.
            let _ = stdin.map(|mut s| s.write_all(question));
        });
        let reader = scope.spawn(move || {
            let mut answer = Vec::new();
            let read = stdout.map(|s| s.take(MAX_BYTES).read_to_end(&mut answer));
            matches!(read, Some(Ok(_))).then_some(answer)
        });
        let outcome = loop {
            match child.try_wait() {
                Ok(Some(status)) => break Ok(status.code()),
                Ok(None) if (limits.cancelled)() => break Err(UnwrapError::Cancelled),
                Ok(None) if start.elapsed() >= limits.time => {
                    break Err(UnwrapError::TimedOut(limits.time.as_secs()));
                }
                Ok(None) => std::thread::sleep(POLL),
                Err(e) => break Err(UnwrapError::Failed(format!("cannot wait for the worker: {e}"))),
            }
        };
        if outcome.is_err() {
            // It may have ended by itself in between: then there is nothing to end.
            let _ = child.kill();
            let _ = child.wait();
        }
        let answer = reader.join().ok().flatten();
        let answer = answer.ok_or_else(|| UnwrapError::Failed("cannot read the worker's answer".into()));
        Ok((outcome?, answer?))
    })
}

/// Longest message that is read [bytes].
const MAX_BYTES: u64 = 1 << 32;

fn words(values: impl IntoIterator<Item = u32>) -> impl Iterator<Item = u8> {
    values.into_iter().flat_map(u32::to_le_bytes)
}

/// A mesh as bytes: magic, vertices, triangles; positions, corners, groups.
fn question(mesh: &UnwrapInput) -> Vec<u8> {
    let mut bytes: Vec<u8> = words([QUESTION, mesh.positions.len() as u32, mesh.triangles.len() as u32]).collect();
    bytes.extend(words(mesh.positions.iter().flat_map(|p| p.to_array().map(f32::to_bits))));
    bytes.extend(words(mesh.triangles.iter().flatten().copied()));
    bytes.extend(words(mesh.groups.iter().copied()));
    bytes
}

/// A mesh from bytes; `None` where they do not hold one.
#[cfg_attr(not(any(test, feature = "xatlas")), expect(dead_code, reason = "only a worker with xatlas reads meshes"))]
fn parse_question(bytes: &[u8]) -> Option<UnwrapInput> {
    let mut words = Words::new(bytes)?;
    let (vertices, triangles) = words.header(QUESTION)?;
    (words.left() == 3 * vertices as usize + 4 * triangles as usize).then_some(())?;
    let positions: Vec<Vec3> = words
        .take(3 * vertices)?
        .chunks_exact(3)
        .map(|p| Vec3::from([0, 1, 2].map(|k| f32::from_bits(p[k]))))
        .collect();
    let triangles: Vec<[u32; 3]> = words.take(3 * triangles)?.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect();
    let groups = words.take(triangles.len() as u32)?;
    let sound = positions.iter().all(|p| p.is_finite()) && triangles.iter().flatten().all(|&v| v < vertices);
    sound.then_some(UnwrapInput { positions, triangles, groups })
}

/// Charts as bytes: magic, vertices, triangles; source and UV of each vertex, corners, charts; chart count.
#[cfg_attr(not(any(test, feature = "xatlas")), expect(dead_code, reason = "only a worker with xatlas answers"))]
fn answer(charts: &Unwrapped) -> Vec<u8> {
    let mut bytes: Vec<u8> = words([ANSWER, charts.vertices.len() as u32, charts.triangles.len() as u32]).collect();
    let uv = |v: &UnwrappedVertex| v.uv.as_vec2().to_array().map(f32::to_bits);
    bytes.extend(words(charts.vertices.iter().flat_map(|v| [v.source, uv(v)[0], uv(v)[1]])));
    bytes.extend(words(charts.triangles.iter().flatten().copied()));
    bytes.extend(words(charts.charts.iter().copied().chain([charts.chart_count])));
    bytes
}

/// Charts from bytes; `None` where they do not hold any. Indices are checked by the caller, as for every
/// backend.
fn parse_answer(bytes: &[u8]) -> Option<Unwrapped> {
    let mut words = Words::new(bytes)?;
    let (vertices, triangles) = words.header(ANSWER)?;
    (words.left() == 3 * vertices as usize + 4 * triangles as usize + 1).then_some(())?;
    let coordinate = |bits| f64::from(f32::from_bits(bits));
    let vertices = words
        .take(3 * vertices)?
        .chunks_exact(3)
        .map(|v| UnwrappedVertex { source: v[0], uv: DVec2::new(coordinate(v[1]), coordinate(v[2])) })
        .collect();
    let triangles: Vec<[u32; 3]> = words.take(3 * triangles)?.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect();
    let charts = words.take(triangles.len() as u32)?;
    let chart_count = words.take(1)?[0];
    // No mesh has more charts than triangles: a larger number would only ask for memory.
    (chart_count as usize <= triangles.len()).then_some(Unwrapped { vertices, triangles, charts, chart_count })
}

/// Reads 32-bit words.
struct Words<'a> {
    bytes: &'a [u8],
}

impl Words<'_> {
    fn new(bytes: &[u8]) -> Option<Words<'_>> {
        bytes.len().is_multiple_of(4).then_some(Words { bytes })
    }

    fn left(&self) -> usize {
        self.bytes.len() / 4
    }

    fn take(&mut self, count: u32) -> Option<Vec<u32>> {
        let (taken, rest) = self.bytes.split_at_checked(count as usize * 4)?;
        self.bytes = rest;
        Some(taken.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
    }

    /// Vertices and triangles after the magic word; small enough that three words each can be counted in u32.
    fn header(&mut self, magic: u32) -> Option<(u32, u32)> {
        let h = self.take(3)?;
        (h[0] == magic && h[1] < u32::MAX / 4 && h[2] < u32::MAX / 4).then_some((h[1], h[2]))
    }
}

/// What `evenlight unwrap-worker` does: one mesh from standard input, its charts to standard output. Returns
/// the exit status.
#[cfg(not(feature = "xatlas"))]
pub fn worker_main() -> i32 {
    NOT_BUILT_IN
}

/// What `evenlight unwrap-worker` does: one mesh from standard input, its charts to standard output. Returns
/// the exit status.
#[cfg(feature = "xatlas")]
pub fn worker_main() -> i32 {
    let mut bytes = Vec::new();
    if std::io::stdin().lock().take(MAX_BYTES).read_to_end(&mut bytes).is_err() {
        return 1;
    }
    let Some(charts) = parse_question(&bytes).and_then(|mesh| run_xatlas(&mesh)) else { return 1 };
    match std::io::stdout().lock().write_all(&answer(&charts)) {
        Ok(()) => 0,
        Err(_) => 1,
    }
}

/// Charts by xatlas; `None` where it refuses the mesh.
#[cfg(feature = "xatlas")]
fn run_xatlas(mesh: &UnwrapInput) -> Option<Unwrapped> {
    use super::NO_CHART;
    use super::unwrap::surface_area;
    use xatlas_rs_v2::{ChartOptions, IndexData, MeshData, MeshDecl, PackOptions, Xatlas};

    let positions: Vec<f32> = mesh.positions.iter().flat_map(|p| p.to_array()).collect();
    let declaration = MeshDecl {
        vertex_position_data: MeshData::Contiguous(&positions),
        // `face_ignore_data` must stay None: the wrapper passes one flag where one per face is read.
        face_material_data: Some(&mesh.groups),
        index_data: Some(IndexData::U32(mesh.triangles.as_flattened())),
        ..MeshDecl::default()
    };
    let mut xatlas = Xatlas::new();
    if xatlas.add_mesh(&declaration).is_err() {
        // Dropping the atlas after a refused mesh aborts; the process ends anyway.
        std::mem::forget(xatlas);
        return None;
    }
    let corner = |v: u32| mesh.positions[v as usize].as_dvec3();
    let area: f64 = mesh.triangles.iter().map(|t| surface_area(t.map(corner))).sum();
    let texels = (mesh.triangles.len() as f64 * 16.0).clamp(65_536.0, 4_194_304.0);
    let texels_per_unit = (texels / area.max(f64::MIN_POSITIVE)).sqrt().min(4096.0) as f32;
    let packing = PackOptions { texels_per_unit, padding: 1, rotate_charts: false, ..PackOptions::default() };
    xatlas.generate(&ChartOptions { fix_winding: true, ..ChartOptions::default() }, &packing);
    let meshes = xatlas.meshes();
    let output = meshes.first()?;
    let scale = 1.0 / f64::from(xatlas.texels_per_unit());
    let vertices = output
        .vertex_array
        .iter()
        .map(|v| UnwrappedVertex { source: v.xref, uv: DVec2::new(f64::from(v.uv[0]), f64::from(v.uv[1])) * scale })
        .collect();
    let triangles: Vec<[u32; 3]> = output.index_array.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect();
    let mut count = 0;
    let charts = triangles
        .iter()
        .map(|t| {
            let chart = t.map(|v| output.vertex_array[v as usize].chart_index);
            let whole = chart[0] == chart[1] && chart[1] == chart[2];
            let chart = u32::try_from(chart[0]).ok().filter(|_| whole);
            count = count.max(chart.map_or(0, |c| c + 1));
            chart.unwrap_or(NO_CHART)
        })
        .collect();
    Some(Unwrapped { vertices, triangles, charts, chart_count: count })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_survive_the_way_and_cut_ones_are_refused() {
        let mesh = UnwrapInput {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            groups: vec![0, 1],
        };
        let bytes = question(&mesh);
        let back = parse_question(&bytes).expect("a sound message");
        assert_eq!((back.positions, back.triangles, back.groups), (mesh.positions, mesh.triangles, mesh.groups));
        assert!((0..bytes.len()).all(|n| parse_question(&bytes[..n]).is_none()));

        let vertices = (0..3).map(|k| UnwrappedVertex { source: k, uv: DVec2::new(f64::from(k), 0.5) }).collect();
        let charts = Unwrapped { vertices, triangles: vec![[0, 1, 2]], charts: vec![0], chart_count: 1 };
        let bytes = answer(&charts);
        assert_eq!(parse_answer(&bytes), Some(charts));
        assert!((0..bytes.len()).all(|n| parse_answer(&bytes[..n]).is_none()));
    }
}
