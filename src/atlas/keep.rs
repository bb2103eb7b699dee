//! The lightmap UVs of the file, taken as they are.
//!
//! TEXCOORD_1 of every baked node lies on one page of `max_texture` squared, texel for texel. What a bake
//! cannot repair is an error: missing sets, coordinates outside the page, overlaps.

use super::check::{PlaneTriangle, find_overlaps, signed_area};
use super::layout::first_charts;
use super::unwrap::surface_area;
use super::{Atlas, MeshLayout, NO_CHART, Page, Placement, PrimitiveLayout};
use crate::error::{BakeError, Warning};
use crate::options::BakeOptions;
use crate::scene::{Mesh, Scene, TriangleRef};
use glam::{DVec2, Vec2};
use std::collections::{BTreeMap, HashMap};

/// Triangles that meet by no more than this touch, they do not overlap [texels].
const TOUCH: f64 = 1e-4;

/// At most this many overlaps are counted for the message.
const COUNTED_OVERLAPS: usize = 1000;

/// The set of coordinates that engines read lightmaps with.
const LIGHTMAP_SET: usize = 1;

/// The atlas that the file's TEXCOORD_1 describes.
///
/// # Errors
/// [`BakeError::Uv`] names the nodes and the cure.
pub(super) fn keep(scene: &Scene, options: &BakeOptions, baked: &[bool]) -> Result<Atlas, BakeError> {
    let side = options.max_texture;
    let mut atlas = Atlas {
        pages: vec![Page { width: side, height: side }],
        meshes: vec![None; scene.meshes.len()],
        placements: vec![None; scene.instances.len()],
        gutter: options.gutter,
        ..Atlas::default()
    };
    for (i, instance) in scene.instances.iter().enumerate().filter(|(i, _)| baked[*i]) {
        if atlas.meshes[instance.mesh].is_none() {
            let layout = kept_mesh(scene, &scene.meshes[instance.mesh], &instance.name, side, &mut atlas.warnings)?;
            atlas.meshes[instance.mesh] = Some(layout);
        }
        let size = Vec2::splat(side as f32);
        atlas.placements[i] = Some(Placement { page: 0, origin: Vec2::ZERO, size });
    }
    atlas.first_chart = first_charts(scene, &atlas);
    let (refs, triangles) = mapped_triangles(scene, &atlas);
    refuse_overlaps(scene, &refs, &triangles)?;
    let surface: f64 = refs.iter().map(|&r| world_area(scene, r)).filter(|a| a.is_finite()).sum();
    let texels: f64 = triangles.iter().map(|t| signed_area(t).abs()).sum();
    if texels == 0.0 {
        return Err(BakeError::Nothing(format!(
            "{}: the lightmap UVs (TEXCOORD_1) of the nodes to bake cover no area; bake with --uv generate",
            scene.name
        )));
    }
    atlas.texels_per_metre = (texels / surface.max(f64::MIN_POSITIVE)).sqrt();
    Ok(atlas)
}

/// The layout of a mesh from its TEXCOORD_1.
fn kept_mesh(
    scene: &Scene,
    mesh: &Mesh,
    node: &str,
    side: u32,
    warnings: &mut Vec<Warning>,
) -> Result<MeshLayout, BakeError> {
    let mut islands = Islands::default();
    let mut collapsed = 0;
    let mut layout = MeshLayout::default();
    for primitive in &mesh.primitives {
        let mut p = PrimitiveLayout {
            source_vertices: (0..primitive.positions.len() as u32).collect(),
            uvs: vec![Vec2::ZERO; primitive.positions.len()],
            triangles: primitive.triangles.clone(),
            charts: vec![NO_CHART; primitive.triangles.len()],
        };
        if scene.materials[primitive.material].unlit || primitive.triangles.is_empty() {
            layout.primitives.push(p);
            continue;
        }
        let set = primitive.tex_coords.get(LIGHTMAP_SET).filter(|s| s.len() == primitive.positions.len());
        let Some(set) = set else {
            return Err(BakeError::Uv(format!(
                "node {node}: primitive {} of its mesh has no TEXCOORD_1; unwrap a second UV set in the modelling \
                 program, or bake with --uv generate",
                primitive.source
            )));
        };
        let slack = (TOUCH / f64::from(side)) as f32;
        p.uvs = set.iter().map(|uv| uv.clamp(Vec2::ZERO, Vec2::ONE)).collect();
        for (k, t) in primitive.triangles.iter().enumerate() {
            let uv = t.map(|v| set[v as usize]);
            if !uv.iter().all(|p| p.is_finite() && p.min_element() >= -slack && p.max_element() <= 1.0 + slack) {
                return Err(BakeError::Uv(format!(
                    "node {node}: triangle {k} of primitive {} has lightmap UVs (TEXCOORD_1) outside 0 to 1: {}; \
                     repack them, or bake with --uv generate",
                    primitive.source,
                    uv.map(|p| format!("({}, {})", p.x, p.y)).join(", ")
                )));
            }
            let corners = t.map(|v| primitive.positions[v as usize].as_dvec3());
            let area = surface_area(corners);
            if signed_area(&uv.map(|p| p.as_dvec2())) == 0.0 || !area.is_finite() {
                collapsed += usize::from(area > 0.0);
            } else {
                let keys = t.map(|v| islands.key(primitive.positions[v as usize], set[v as usize]));
                p.charts[k] = islands.join(keys);
            }
        }
        layout.primitives.push(p);
    }
    layout.chart_count = islands.number(&mut layout.primitives);
    if collapsed > 0 {
        let message = format!("node {node}: {collapsed} triangles have lightmap UVs without area and get no texels");
        warnings.push(Warning::new("collapsed-uvs", message));
    }
    warn_of_flips(mesh, &layout, node, warnings);
    Ok(layout)
}

/// Islands: triangles connected over corners with the same position and the same UV.
#[derive(Default)]
struct Islands {
    corner: HashMap<[u32; 5], u32>,
    parent: Vec<u32>,
}

impl Islands {
    fn key(&mut self, position: glam::Vec3, uv: Vec2) -> u32 {
        let [x, y, z] = position.to_array();
        let bits = [x, y, z, uv.x, uv.y].map(|c| if c == 0.0 { 0 } else { c.to_bits() });
        *self.corner.entry(bits).or_insert_with(|| {
            self.parent.push(self.parent.len() as u32);
            self.parent.len() as u32 - 1
        })
    }

    fn root(&mut self, mut k: u32) -> u32 {
        while self.parent[k as usize] != k {
            self.parent[k as usize] = self.parent[self.parent[k as usize] as usize];
            k = self.parent[k as usize];
        }
        k
    }

    /// Joins three corners and returns one that stands for them.
    fn join(&mut self, keys: [u32; 3]) -> u32 {
        let a = self.root(keys[0]);
        for k in &keys[1..] {
            let r = self.root(*k);
            self.parent[r as usize] = a;
        }
        a
    }

    /// Replaces the corners that stand for islands by chart ids in the order of the triangles.
    fn number(&mut self, primitives: &mut [PrimitiveLayout]) -> u32 {
        let mut chart_of = BTreeMap::new();
        for c in primitives.iter_mut().flat_map(|p| &mut p.charts).filter(|c| **c != NO_CHART) {
            let next = chart_of.len() as u32;
            *c = *chart_of.entry(self.root(*c)).or_insert(next);
        }
        chart_of.len() as u32
    }
}

/// Warns of islands in which some triangles lie face up and others face down.
fn warn_of_flips(mesh: &Mesh, layout: &MeshLayout, node: &str, warnings: &mut Vec<Warning>) {
    let mut turns = vec![[0u32; 2]; layout.chart_count as usize];
    for (p, primitive) in layout.primitives.iter().zip(&mesh.primitives) {
        for (t, &c) in primitive.triangles.iter().zip(&p.charts).filter(|(_, c)| **c != NO_CHART) {
            let area = signed_area(&t.map(|v| p.uvs[v as usize].as_dvec2()));
            turns[c as usize][usize::from(area < 0.0)] += 1;
        }
    }
    let flipped: u32 = turns.iter().map(|t| t[0].min(t[1])).sum();
    if flipped > 0 {
        let message = format!("node {node}: {flipped} triangles lie face down in the lightmap UVs of their island");
        warnings.push(Warning::new("flipped-uvs", message));
    }
}

/// All triangles with a place on the map and where they lie [texels].
fn mapped_triangles(scene: &Scene, atlas: &Atlas) -> (Vec<TriangleRef>, Vec<PlaneTriangle>) {
    let (mut refs, mut triangles) = (Vec::new(), Vec::new());
    for (i, instance) in scene.instances.iter().enumerate() {
        for (p, primitive) in scene.meshes[instance.mesh].primitives.iter().enumerate() {
            for k in 0..primitive.triangles.len() {
                let r = TriangleRef { instance: i as u32, primitive: p as u32, index: k as u32 };
                if let Some((_, at, _)) = atlas.texel_coordinates(scene, r) {
                    refs.push(r);
                    triangles.push(at.map(|p: Vec2| -> DVec2 { p.as_dvec2() }));
                }
            }
        }
    }
    (refs, triangles)
}

fn refuse_overlaps(scene: &Scene, refs: &[TriangleRef], triangles: &[PlaneTriangle]) -> Result<(), BakeError> {
    let overlaps = find_overlaps(triangles, TOUCH, COUNTED_OVERLAPS);
    let Some(&(a, b)) = overlaps.first() else { return Ok(()) };
    let name = |t: u32| {
        let r = refs[t as usize];
        let instance = &scene.instances[r.instance as usize];
        let source = scene.meshes[instance.mesh].primitives[r.primitive as usize].source;
        format!("node {} (primitive {source}, triangle {})", instance.name, r.index)
    };
    let count = match overlaps.len() {
        1 => "one pair".into(),
        COUNTED_OVERLAPS => format!("at least {COUNTED_OVERLAPS} pairs"),
        n => format!("{n} pairs"),
    };
    Err(BakeError::Uv(format!(
        "the lightmap UVs (TEXCOORD_1) of {} and {} overlap, {count} of triangles in all; give every node its own \
         place, or bake with --uv generate",
        name(a),
        name(b)
    )))
}

/// Area of a triangle in the world [m2].
fn world_area(scene: &Scene, r: TriangleRef) -> f64 {
    let instance = &scene.instances[r.instance as usize];
    let primitive = &scene.meshes[instance.mesh].primitives[r.primitive as usize];
    let m = instance.world_from_object.matrix3;
    surface_area(primitive.triangles[r.index as usize].map(|v| m * primitive.positions[v as usize].as_dvec3()))
}
