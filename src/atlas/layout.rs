//! From a scene to an atlas: choose, unwrap, pack, write down.

use super::chart::charts_of;
use super::density::{Layout, Unit, UnitLayout, full_density, lay_out};
use super::select::{Selected, select};
use super::unwrap::{
    IGNORED, JoinedMesh, Limits, UnwrapError, Unwrapped, Unwrapper, code_of_mesh, default_time_limit, unwrap_mesh,
};
use super::uvunwrap::Uvunwrap;
use super::xatlas::XatlasWorker;
use super::{Atlas, MeshLayout, NO_CHART, Placement, PrimitiveLayout, keep};
use crate::cache::{Cache, Digest, Key, Slot};
use crate::error::{BakeError, Warning};
use crate::options::{self, BakeOptions, Density, UvSource};
use crate::scene::{Instance, Mesh, Scene};
use glam::{DMat3, DVec2, Vec2};
use rayon::prelude::*;
use std::time::{Duration, Instant};

/// Page sizes for which the layout is made [texels]. Above, f32 texel coordinates lose too many digits.
const PAGE_SIZES: std::ops::RangeInclusive<u32> = 16..=16384;

/// Smallest size of an instance's rectangle relative to the largest of the same mesh: all share one layout,
/// whose gutters grow with the inverse. Smaller instances get more texels than asked for.
const LEAST_INSTANCE: f64 = 0.125;

/// Lays out the lightmaps of `scene`: every triangle with an area of every baked instance gets a chart, unless
/// its material is unlit. `cancelled` is asked now and then, from any thread.
///
/// Where `options` limit the time, half of it, from this call on, is for the layout: what the unwrapper has not
/// reached then is flattened by projection, and the density is not refined any further.
///
/// The result does not depend on the number of threads, unless a time limit binds.
///
/// # Errors
/// [`BakeError::Options`] for an option out of range or an unknown node name, [`BakeError::Nothing`] where no
/// surface is left to bake, [`BakeError::Uv`] where the file's lightmap UVs are kept and cannot be used,
/// [`BakeError::Limit`] where the pages do not suffice, and [`BakeError::Cancelled`].
pub fn build(scene: &Scene, options: &BakeOptions, cancelled: &(dyn Fn() -> bool + Sync)) -> Result<Atlas, BakeError> {
    match options.uv {
        UvSource::Keep => {
            check_options(options)?;
            keep::keep(scene, options, &select(scene, options)?.baked)
        }
        UvSource::Generate => Unwrapping::new(scene, options, None, cancelled)?.lay_out(options, cancelled),
    }
}

fn check_options(options: &BakeOptions) -> Result<(), BakeError> {
    let refuse = |what: String| Err(BakeError::Options(what));
    if !PAGE_SIZES.contains(&options.max_texture) {
        return refuse(format!("--max-texture {}: must be from 16 to 16384 texels", options.max_texture));
    }
    if options.max_pages == 0 {
        return refuse("--max-pages 0: must be at least 1".into());
    }
    if options.gutter > options.max_texture / 4 {
        return refuse(format!(
            "--gutter {}: must be at most a quarter of --max-texture {}",
            options.gutter, options.max_texture
        ));
    }
    match options.density {
        Density::TexelsPerMetre(d) if !(d.is_finite() && d > 0.0) => {
            refuse(format!("--density {d}: must be `auto` or a number of texels per metre above 0"))
        }
        _ => Ok(()),
    }
}

/// A mesh with the baked instances that share its UVs.
#[derive(Debug)]
struct Shared {
    mesh: usize,
    instances: Vec<usize>,
}

/// The meshes of a scene cut and flattened: charts without places yet.
#[derive(Debug)]
pub struct Unwrapping<'s> {
    scene: &'s Scene,
    shared: Vec<Shared>,
    pub(super) units: Vec<Unit>,
    meshes: Vec<Unwrapped>,
    warnings: Vec<Warning>,
    unseen: Vec<usize>,
    deadline: Option<Instant>,
    /// Nothing had to be cut.
    pub(crate) from_cache: bool,
}

impl<'s> Unwrapping<'s> {
    /// Cuts and flattens what is to be baked, or takes from `cache` what was made of the same meshes before; as [`build`],
    /// which says what may fail.
    ///
    /// # Errors
    /// Those of [`build`].
    pub fn new(
        scene: &'s Scene,
        options: &BakeOptions,
        cache: Option<&mut dyn Cache>,
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Unwrapping<'s>, BakeError> {
        check_options(options)?;
        let Selected { baked, unseen } = select(scene, options)?;
        // Half of the time belongs to the light.
        let deadline =
            options.time_limit.and_then(|s| Instant::now().checked_add(Duration::try_from_secs_f64(0.5 * s).ok()?));
        let mut warnings = Vec::new();
        let densities = instance_densities(scene, &baked, &mut warnings);
        let mut shared: Vec<Shared> = Vec::new();
        let mut of_mesh: Vec<Option<usize>> = vec![None; scene.meshes.len()];
        for (i, instance) in scene.instances.iter().enumerate().filter(|(i, _)| baked[*i]) {
            let s = *of_mesh[instance.mesh].get_or_insert_with(|| {
                shared.push(Shared { mesh: instance.mesh, instances: Vec::new() });
                shared.len() - 1
            });
            shared[s].instances.push(i);
        }
        let mut units: Vec<Unit> = shared.iter().map(|s| unit(scene, s, &densities)).collect();
        let joined = joined_meshes(scene, &shared, &units, options);
        let mut slot = cache.map(|cache| Slot { cache, key: key_of(&joined, options) });
        let kept = slot.as_mut().and_then(|slot| kept_charts(slot, &joined));
        let from_cache = kept.is_some();
        let unwrapped = match kept {
            Some(kept) => kept,
            None => unwrap_all(&joined, options, deadline, cancelled)?,
        };
        slot.iter_mut().filter(|_| !from_cache).for_each(|slot| keep_charts(slot, &unwrapped));
        let mut meshes = Vec::with_capacity(shared.len());
        for (unit, (unwrapped, found)) in units.iter_mut().zip(unwrapped) {
            warnings.extend(found);
            unit.charts = charts_of(&unwrapped);
            unit.factors = vec![1.0; unit.charts.len()];
            meshes.push(unwrapped);
        }
        if units.iter().all(|u| u.charts.is_empty()) {
            return Err(BakeError::Nothing(format!(
                "{}: no triangle of the nodes to bake has an area; check the scales of the nodes",
                scene.name
            )));
        }
        Ok(Unwrapping { scene, shared, units, meshes, warnings, unseen, deadline, from_cache })
    }

    /// Gives every chart its place, as `options` ask (`density`, `max_texture`, `max_pages`, `gutter`).
    ///
    /// # Errors
    /// [`BakeError::Limit`] where the pages do not suffice, and [`BakeError::Cancelled`].
    pub fn lay_out(&self, options: &BakeOptions, cancelled: &(dyn Fn() -> bool + Sync)) -> Result<Atlas, BakeError> {
        let Unwrapping { scene, shared, units, meshes, .. } = self;
        let layout = lay_out(units, options, self.deadline, cancelled)?;
        let mut warnings = self.warnings.clone();
        warn_of_scaling(units, &layout, &mut warnings);
        let mut atlas = Atlas {
            pages: layout.pages.clone(),
            meshes: vec![None; scene.meshes.len()],
            placements: vec![None; scene.instances.len()],
            texels_per_metre: layout.density,
            gutter: options.gutter,
            warnings,
            unseen: self.unseen.clone(),
            ..Atlas::default()
        };
        for (((s, unit), placed), unwrapped) in shared.iter().zip(units).zip(&layout.units).zip(meshes) {
            let size = if unit.instances.is_empty() {
                let page = layout.pages[placed.page as usize];
                [page.width, page.height]
            } else {
                placed.size
            };
            let uvs = uvs(unwrapped, unit, placed, size);
            atlas.meshes[s.mesh] = Some(mesh_layout(&scene.meshes[s.mesh], unwrapped, &uvs));
            for (k, &i) in s.instances.iter().enumerate() {
                let vec2 = |v: [u32; 2]| Vec2::new(v[0] as f32, v[1] as f32);
                atlas.placements[i] = Some(match placed.rectangles.get(k) {
                    None => Placement { page: placed.page, origin: Vec2::ZERO, size: vec2(size) },
                    Some(r) => Placement { page: r.page, origin: vec2(r.origin), size: vec2(r.size) },
                });
            }
        }
        atlas.first_chart = first_charts(scene, &atlas);
        Ok(atlas)
    }

    /// The instances that share each mesh.
    pub(super) fn instances(&self) -> impl Iterator<Item = &[usize]> {
        self.shared.iter().map(|s| &*s.instances)
    }
}

/// First global chart id of each instance, and the total.
pub(super) fn first_charts(scene: &Scene, atlas: &Atlas) -> Vec<u32> {
    let mut first = vec![0];
    let mut total = 0;
    for (instance, placement) in scene.instances.iter().zip(&atlas.placements) {
        if let (Some(_), Some(layout)) = (placement, &atlas.meshes[instance.mesh]) {
            total += layout.chart_count;
        }
        first.push(total);
    }
    first
}

/// The density factor of each instance, 1 where the file's makes no sense.
fn instance_densities(scene: &Scene, baked: &[bool], warnings: &mut Vec<Warning>) -> Vec<f64> {
    let usable = |d: f32| d.is_finite() && d > 0.0;
    for i in (0..baked.len()).filter(|&i| baked[i] && !usable(scene.instances[i].density)) {
        let Instance { name, density, .. } = &scene.instances[i];
        let message = format!("node {name}: evenlight.density {density} is not a number above 0; 1 is used instead");
        warnings.push(Warning::new("bad-density", message));
    }
    scene.instances.iter().map(|i| if usable(i.density) { f64::from(i.density) } else { 1.0 }).collect()
}

/// Largest factor by which a transform lengthens an axis of the mesh; 0 where it is not finite.
fn scale_of(instance: &Instance) -> f64 {
    let m = instance.world_from_object.matrix3;
    let longest = m.x_axis.length().max(m.y_axis.length()).max(m.z_axis.length());
    if m.is_finite() && longest.is_finite() { longest } else { 0.0 }
}

/// Metres per object unit at the largest instance.
fn largest_scale(scene: &Scene, s: &Shared) -> f64 {
    let largest = s.instances.iter().map(|&i| scale_of(&scene.instances[i])).fold(0.0, f64::max);
    if largest > 0.0 { largest } else { 1.0 }
}

/// The meshes to unwrap, in metres, and the texels that they can get.
fn joined_meshes(scene: &Scene, shared: &[Shared], units: &[Unit], options: &BakeOptions) -> Vec<JoinedMesh> {
    let mut meshes: Vec<JoinedMesh> = shared
        .par_iter()
        .map(|s| {
            let metres = match s.instances[..] {
                [only] => scene.instances[only].world_from_object.matrix3,
                _ => DMat3::from_diagonal(glam::DVec3::splat(largest_scale(scene, s))),
            };
            joined(scene, &scene.meshes[s.mesh], metres)
        })
        .collect();
    let density = match options.density {
        Density::TexelsPerMetre(density) => density,
        Density::Auto | Density::Even => {
            let areas: Vec<f64> = meshes.par_iter().map(JoinedMesh::area).collect();
            full_density(units.iter().zip(areas), options.max_texture)
        }
    };
    meshes.iter_mut().zip(units).for_each(|(m, u)| m.texels_per_metre = density * u.density);
    meshes
}

/// What charts are kept by: the meshes that they are cut from, and what cuts them.
fn key_of(meshes: &[JoinedMesh], options: &BakeOptions) -> Key {
    let mut digest = Digest::default();
    meshes.iter().for_each(|mesh| mesh.feed(&mut digest));
    digest.debug(&options.unwrapper.name());
    digest.key("charts")
}

/// Charts and (code, message) of the warnings of each mesh.
type KeptCharts = Vec<(Unwrapped, Vec<(String, String)>)>;

/// Charts that were kept of these very meshes.
fn kept_charts(slot: &mut Slot, meshes: &[JoinedMesh]) -> Option<Vec<(Unwrapped, Vec<Warning>)>> {
    let kept: KeptCharts = slot.load()?;
    let fits = |(mesh, (charts, _)): (&JoinedMesh, &(Unwrapped, _))| charts.is_of(mesh);
    if kept.len() != meshes.len() || !meshes.iter().zip(&kept).all(fits) {
        return None;
    }
    let warning = |(code, message): (String, String)| Some(Warning::new(code_of_mesh(&code)?, message));
    Some(kept.into_iter().map(|(c, warnings)| (c, warnings.into_iter().filter_map(warning).collect())).collect())
}

/// Keeps charts, unless more than their meshes had a part in them: others may come out the next time.
fn keep_charts(slot: &mut Slot, charts: &[(Unwrapped, Vec<Warning>)]) {
    if !slot.cache.is_plan() && charts.iter().flat_map(|c| &c.1).any(|w| code_of_mesh(w.code).is_none()) {
        return;
    }
    let of = |w: &Warning| (w.code.to_string(), w.message.clone());
    let kept: Vec<(&Unwrapped, Vec<(String, String)>)> =
        charts.iter().map(|(c, warnings)| (c, warnings.iter().map(of).collect())).collect();
    slot.keep(&kept);
}

fn unwrap_all(
    meshes: &[JoinedMesh],
    options: &BakeOptions,
    deadline: Option<Instant>,
    cancelled: &(dyn Fn() -> bool + Sync),
) -> Result<Vec<(Unwrapped, Vec<Warning>)>, BakeError> {
    let backend: Box<dyn Unwrapper> = match &options.unwrapper {
        options::Unwrapper::Uvunwrap => Box::new(Uvunwrap),
        options::Unwrapper::Xatlas { worker } => Box::new(XatlasWorker::new(worker.clone())),
    };
    // Meshes share the cores, so the clock of each runs for all.
    let triangles = meshes.iter().map(|m| m.triangles.len()).sum();
    let limits = Limits { time: default_time_limit(triangles), deadline, cancelled };
    meshes.par_iter().map(|mesh| unwrap_mesh(mesh, backend.as_ref(), limits)).collect::<Result<Vec<_>, _>>().map_err(
        |e| match e {
            UnwrapError::Cancelled => BakeError::Cancelled,
            e => BakeError::Options(e.to_string()),
        },
    )
}

/// All primitives of a mesh in metres. Face groups keep apart what is shaded differently: the two sides of a
/// chart are stored together or not at all, and unlit surfaces get no texels.
fn joined(scene: &Scene, mesh: &Mesh, metres: DMat3) -> JoinedMesh {
    let mut joined = JoinedMesh { name: mesh.name.clone(), ..JoinedMesh::default() };
    for primitive in &mesh.primitives {
        let first = joined.positions.len() as u32;
        let material = &scene.materials[primitive.material];
        let group = if material.unlit { IGNORED } else { u32::from(material.is_two_sided()) };
        joined.positions.extend(primitive.positions.iter().map(|p| metres * p.as_dvec3()));
        joined.triangles.extend(primitive.triangles.iter().map(|t| t.map(|v| v + first)));
        joined.groups.resize(joined.triangles.len(), group);
    }
    joined
}

/// What is known of a unit before its mesh has charts.
fn unit(scene: &Scene, s: &Shared, densities: &[f64]) -> Unit {
    if let [only] = s.instances[..] {
        let name = format!("node {}", scene.instances[only].name);
        let density = densities[only];
        return Unit { name, charts: Vec::new(), density, factors: Vec::new(), instances: Vec::new() };
    }
    let sizes: Vec<f64> = s.instances.iter().map(|&i| scale_of(&scene.instances[i]) * densities[i]).collect();
    let largest = sizes.iter().copied().fold(0.0, f64::max);
    let largest = if largest > 0.0 { largest } else { 1.0 };
    let instances = sizes.iter().map(|s| (s / largest).max(LEAST_INSTANCE)).collect();
    let name = format!("mesh {}", scene.meshes[s.mesh].name);
    Unit { name, charts: Vec::new(), density: largest / largest_scale(scene, s), factors: Vec::new(), instances }
}

/// Loss of density below which nobody is warned: charts are rounded to whole texels anyway.
const NOTABLE_LOSS: f64 = 0.9;

fn warn_of_scaling(units: &[Unit], layout: &Layout, warnings: &mut Vec<Warning>) {
    for (unit, placed) in units.iter().zip(&layout.units) {
        let asked = layout.density * unit.density;
        let worst = unit
            .charts
            .iter()
            .zip(&unit.factors)
            .zip(&placed.charts)
            .flat_map(|((c, f), spot)| [0, 1].map(|k| (f64::from(spot.texels[k]) + 1.0) / (c.size[k] * asked * f)))
            .fold(1.0, f64::min);
        if worst < NOTABLE_LOSS {
            warnings.push(Warning::new(
                "chart-larger-than-page",
                format!(
                    "{}: does not fit on a page at {asked:.4} texels per metre and gets {:.4} where it is longest; \
                     raise --max-texture or split the mesh",
                    unit.name,
                    asked * worst
                ),
            ));
        }
    }
}

/// Lightmap UV of each vertex of an unwrapped mesh in a box of `size` texels.
fn uvs(mesh: &Unwrapped, unit: &Unit, placed: &UnitLayout, size: [u32; 2]) -> Vec<Vec2> {
    let mut uvs = vec![Vec2::ZERO; mesh.vertices.len()];
    for (chart, spot) in unit.charts.iter().zip(&placed.charts) {
        let (lo, hi) = spot.bounds();
        for (&v, &place) in chart.vertices.iter().zip(&chart.places) {
            let at = spot.texel(place, chart.size);
            uvs[v as usize] = Vec2::new(uv_within(at, lo, hi, size, 0), uv_within(at, lo, hi, size, 1));
        }
    }
    uvs
}

/// The f32 coordinate that, multiplied by the size in f32, comes nearest to a texel coordinate without leaving
/// its chart's box: at 16384 texels an f32 is a thousandth of a texel off, which must not add a column of
/// texels to a chart.
fn uv_within(at: DVec2, lo: DVec2, hi: DVec2, size: [u32; 2], axis: usize) -> f32 {
    let (lo, hi, size) = (lo[axis], hi[axis], size[axis] as f32);
    let mut uv = (at[axis].clamp(lo, hi) / f64::from(size)) as f32;
    while uv * size < lo as f32 {
        uv = uv.next_up();
    }
    while uv * size > hi as f32 {
        uv = uv.next_down();
    }
    uv
}

/// The layout of a mesh, primitive by primitive, from that of all primitives joined.
fn mesh_layout(mesh: &Mesh, unwrapped: &Unwrapped, uvs: &[Vec2]) -> MeshLayout {
    let mut layout =
        MeshLayout { primitives: Vec::with_capacity(mesh.primitives.len()), chart_count: unwrapped.chart_count };
    let mut new_vertex = vec![u32::MAX; unwrapped.vertices.len()];
    let (mut first_vertex, mut first_triangle) = (0, 0);
    for primitive in &mesh.primitives {
        let n = primitive.positions.len();
        let mut p = PrimitiveLayout {
            source_vertices: (0..n as u32).collect(),
            uvs: vec![Vec2::ZERO; n],
            triangles: Vec::with_capacity(primitive.triangles.len()),
            charts: unwrapped.charts[first_triangle..][..primitive.triangles.len()].to_vec(),
        };
        let mut placed = vec![false; n];
        for (k, source) in primitive.triangles.iter().enumerate() {
            if p.charts[k] == NO_CHART {
                p.triangles.push(*source);
                continue;
            }
            p.triangles.push(unwrapped.triangles[first_triangle + k].map(|v| {
                let v = v as usize;
                if new_vertex[v] == u32::MAX {
                    let source = unwrapped.vertices[v].source as usize - first_vertex;
                    if placed[source] {
                        new_vertex[v] = p.source_vertices.len() as u32;
                        p.source_vertices.push(source as u32);
                        p.uvs.push(uvs[v]);
                    } else {
                        placed[source] = true;
                        new_vertex[v] = source as u32;
                        p.uvs[source] = uvs[v];
                    }
                }
                new_vertex[v]
            }));
        }
        first_vertex += n;
        first_triangle += primitive.triangles.len();
        layout.primitives.push(p);
    }
    layout
}
