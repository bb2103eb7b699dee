//! What is unwrapped together: pieces of whole connected components, neither too small to be worth a call nor too
//! large to be given up.

use super::planar::{self, Lean};
use super::unwrap::{FlatChart, JoinedMesh, area_of};
use glam::DVec3;
use std::collections::{HashMap, VecDeque};

/// Components are joined to pieces of about this many triangles: enough to be worth a call, few enough that a
/// panic spoils little.
const PIECE_TRIANGLES: usize = 8192;

/// Larger components are halved beforehand: the time for a smooth chart grows faster than its triangles, and a
/// backend may not look at its clock inside one.
const MAX_PIECE_TRIANGLES: usize = 131_072;

/// A mesh and, for each of its positions, the first one at the same place.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    pub mesh: &'a JoinedMesh,
    pub welded: &'a [u32],
}

impl Source<'_> {
    /// Charts of the triangles by projection.
    pub fn flatten(self, triangles: &[u32], lean: Lean) -> Vec<FlatChart> {
        planar::flatten(self.mesh, self.welded, triangles, lean)
    }
}

/// Triangles that are unwrapped together.
pub struct Piece {
    pub triangles: Vec<u32>,
    /// They have at least a texel each.
    pub seen: bool,
}

/// For each position the index of the first one with the same bits (-0 equals 0).
pub fn weld(positions: &[DVec3]) -> Vec<u32> {
    let mut first = HashMap::with_capacity(positions.len());
    let key = |p: &DVec3| p.to_array().map(|c| if c == 0.0 { 0 } else { c.to_bits() });
    positions.iter().enumerate().map(|(i, p)| *first.entry(key(p)).or_insert(i as u32)).collect()
}

/// The usable triangles in pieces of whole components (connected through positions), in a fixed order. Charts
/// never span components, so this costs nothing, and it keeps small things precise beside large ones.
pub fn pieces(source: Source, usable: &[u32]) -> Vec<Piece> {
    let mesh = source.mesh;
    let mut pieces: Vec<Piece> = Vec::new();
    let mut last = [None; 2];
    let mut components = VecDeque::from(components(source, usable));
    while let Some(component) = components.pop_front() {
        if component.len() > MAX_PIECE_TRIANGLES {
            let (a, b) = halves(mesh, component);
            components.push_front(b);
            components.push_front(a);
            continue;
        }
        let area: f64 = component.iter().map(|&t| area_of(mesh, t)).sum();
        let seen = area * mesh.texels_per_metre.powi(2) >= component.len() as f64;
        let open: &mut Option<usize> = &mut last[usize::from(seen)];
        match open.map(|k| &mut pieces[k]) {
            Some(p) if p.triangles.len() + component.len() <= PIECE_TRIANGLES => p.triangles.extend(component),
            _ => {
                *open = Some(pieces.len());
                pieces.push(Piece { triangles: component, seen });
            }
        }
    }
    pieces
}

/// The usable triangles by connected component.
fn components(source: Source, usable: &[u32]) -> Vec<Vec<u32>> {
    let Source { mesh, welded } = source;
    let mut parent: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    fn root(parent: &mut [u32], mut v: u32) -> u32 {
        while parent[v as usize] != v {
            parent[v as usize] = parent[parent[v as usize] as usize];
            v = parent[v as usize];
        }
        v
    }
    for &t in usable {
        let [a, b, c] = mesh.triangles[t as usize].map(|v| root(&mut parent, welded[v as usize]));
        parent[b as usize] = a;
        let c = root(&mut parent, c);
        let a = root(&mut parent, a);
        parent[c as usize] = a;
    }
    const NONE: u32 = u32::MAX;
    let mut component_of = vec![NONE; mesh.positions.len()];
    let mut components: Vec<Vec<u32>> = Vec::new();
    for &t in usable {
        let r = root(&mut parent, welded[mesh.triangles[t as usize][0] as usize]) as usize;
        if component_of[r] == NONE {
            component_of[r] = components.len() as u32;
            components.push(Vec::new());
        }
        components[component_of[r] as usize].push(t);
    }
    components
}

/// Halves of a piece, cut at the median centroid along the longest axis.
pub fn halves(mesh: &JoinedMesh, mut piece: Vec<u32>) -> (Vec<u32>, Vec<u32>) {
    let centroid = |t: u32| mesh.triangles[t as usize].map(|v| mesh.positions[v as usize]).iter().sum::<DVec3>() / 3.0;
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for &t in &piece {
        lo = lo.min(centroid(t));
        hi = hi.max(centroid(t));
    }
    let extent = hi - lo;
    let axis = (0..3).fold(0, |best, k| if extent[k] > extent[best] { k } else { best });
    piece.sort_by(|&a, &b| centroid(a)[axis].total_cmp(&centroid(b)[axis]).then(a.cmp(&b)));
    let mut second = piece.split_off(piece.len() / 2);
    piece.sort_unstable();
    second.sort_unstable();
    (piece, second)
}
