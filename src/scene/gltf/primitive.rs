//! Meshes and their primitives: every topology of triangles becomes a list, one triangle of the source each.

use super::reader::{REPAIR, Reader};
use super::variant;
use crate::error::SceneError;
use crate::scene::{Mesh, Primitive};
use glam::{Vec2, Vec3, Vec4};
use gltf::json;
use json::mesh::{Mode, Semantic};
use json::validation::Checked;

/// TEXCOORD sets read; files with more are odd, and a set's number must not size an array.
const MAX_TEX_COORDS: u32 = 8;

/// Reads a mesh of the document. Primitives without triangles are left out.
pub(super) fn read_mesh(reader: &mut Reader, index: usize) -> Result<Mesh, SceneError> {
    let mesh: json::Mesh = reader.object("meshes", index, "the scene")?;
    let label = reader.label("meshes", index);
    let name = reader.name("meshes", index).map_or_else(|| format!("mesh {index}"), str::to_owned);
    let mut primitives = Vec::with_capacity(mesh.primitives.len());
    for (source, primitive) in mesh.primitives.iter().enumerate() {
        if let Some(p) = read_primitive(reader, primitive, source, &format!("{label} primitive {source}"))? {
            primitives.push(p);
        }
    }
    if mesh.primitives.iter().any(|p| p.targets.as_ref().is_some_and(|t| !t.is_empty())) {
        reader.warn("morph-targets", format!("{label} has morph targets; it is baked in its rest pose"));
    }
    Ok(Mesh { name, source: index, primitives })
}

fn read_primitive(
    reader: &mut Reader,
    raw: &json::mesh::Primitive,
    source: usize,
    label: &str,
) -> Result<Option<Primitive>, SceneError> {
    let mode = match raw.mode {
        Checked::Valid(mode @ (Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan)) => mode,
        Checked::Valid(other) => {
            reader.warn("no-triangles", format!("{label} is drawn as {other:?}, not triangles, and is left out"));
            return Ok(None);
        }
        Checked::Invalid => return Err(reader.invalid(format!("{label} has an unknown mode; {REPAIR}"))),
    };
    let accessor = |semantic: Semantic| raw.attributes.get(&Checked::Valid(semantic)).map(|i| i.value());
    let Some(positions) = accessor(Semantic::Positions) else {
        reader.warn("no-positions", format!("{label} has no POSITION and is left out"));
        return Ok(None);
    };
    let mut positions: Vec<Vec3> =
        reader.vectors::<3>(positions, &[3], 0.0, label)?.into_iter().map(Vec3::from).collect();
    let mut triangles = read_triangles(reader, raw, mode, positions.len(), label)?;
    if triangles.is_empty() {
        reader.warn("no-triangles", format!("{label} has no triangles and is left out"));
        return Ok(None);
    }
    drop_non_finite(reader, &mut positions, &mut triangles, label);

    let mut normals = match accessor(Semantic::Normals) {
        Some(i) => attribute::<3>(reader, i, &[3], 0.0, positions.len(), &format!("{label} NORMAL"))?,
        None => Vec::new(),
    }
    .into_iter()
    .map(Vec3::from)
    .collect::<Vec<_>>();
    let repaired = repair_normals(&mut normals, &positions, &triangles);
    if repaired > 0 {
        reader.warn("bad-normals", format!("{label}: {repaired} normals without a direction were replaced"));
    }
    let colors = match accessor(Semantic::Colors(0)) {
        Some(i) => attribute::<4>(reader, i, &[3, 4], 1.0, positions.len(), &format!("{label} COLOR_0"))?,
        None => Vec::new(),
    };
    let colors = colors.into_iter().map(Vec4::from).map(|c| if c.is_finite() { c } else { Vec4::ONE }).collect();
    let mut tex_coords: Vec<Vec<Vec2>> = Vec::new();
    for set in 0..MAX_TEX_COORDS {
        let Some(i) = accessor(Semantic::TexCoords(set)) else { continue };
        let uvs = attribute::<2>(reader, i, &[2], 0.0, positions.len(), &format!("{label} TEXCOORD_{set}"))?;
        tex_coords.resize(set as usize + 1, Vec::new());
        tex_coords[set as usize] =
            uvs.into_iter().map(|uv| Vec2::from(uv.map(|c| if c.is_finite() { c } else { 0.0 }))).collect();
    }
    // Replaced by the default material, which stands behind the file's own, where the file gives none.
    let material = variant::material(reader, raw, label)?.or(raw.material.map(|m| m.value())).unwrap_or(usize::MAX);
    Ok(Some(Primitive { source, positions, normals, tex_coords, colors, triangles, material }))
}

/// Values per vertex; without any, and a warning, where their number is not that of the vertices.
fn attribute<const N: usize>(
    reader: &mut Reader,
    accessor: usize,
    allowed: &[usize],
    fill: f32,
    vertices: usize,
    label: &str,
) -> Result<Vec<[f32; N]>, SceneError> {
    let values = reader.vectors::<N>(accessor, allowed, fill, label)?;
    if values.len() != vertices {
        let n = values.len();
        reader.warn("attribute-count", format!("{label} has {n} values for {vertices} vertices and is ignored"));
        return Ok(Vec::new());
    }
    Ok(values)
}

fn read_triangles(
    reader: &mut Reader,
    raw: &json::mesh::Primitive,
    mode: Mode,
    vertices: usize,
    label: &str,
) -> Result<Vec<[u32; 3]>, SceneError> {
    let indices = match raw.indices {
        Some(accessor) => {
            let (indices, reserved) = reader.indices(accessor.value(), label)?;
            if indices.contains(&reserved) {
                if reserved as usize >= vertices {
                    return Err(reader.invalid(format!(
                        "{label} has the index {reserved}, which restarts a strip elsewhere but is forbidden in glTF; \
                         export it as a triangle list"
                    )));
                }
                reader.warn(
                    "restart-index",
                    format!("{label} uses the reserved index {reserved} as a vertex; engines may leave triangles out"),
                );
            }
            indices
        }
        // The reader's limit on elements keeps the count below 2^32.
        None => (0..vertices as u32).collect(),
    };
    if let Some(i) = indices.iter().find(|&&i| i as usize >= vertices) {
        return Err(reader.invalid(format!("{label} has the index {i}, but only {vertices} vertices; {REPAIR}")));
    }
    if mode == Mode::Triangles && indices.len() % 3 != 0 {
        let n = indices.len();
        reader.warn("incomplete-triangle", format!("{label} has {n} corners; the last incomplete triangle is ignored"));
    }
    Ok(triangle_list(mode, &indices))
}

/// The triangles of a list, strip or fan as the glTF specification, section 3.7.2.1, numbers their corners:
/// p_i = {v_i, v_(i + 1 + i mod 2), v_(i + 2 - i mod 2)} for strips, {v_(i+1), v_(i+2), v_0} for fans.
fn triangle_list(mode: Mode, v: &[u32]) -> Vec<[u32; 3]> {
    match mode {
        Mode::TriangleStrip => {
            (0..v.len().saturating_sub(2)).map(|i| [v[i], v[i + 1 + i % 2], v[i + 2 - i % 2]]).collect()
        }
        Mode::TriangleFan => (0..v.len().saturating_sub(2)).map(|i| [v[i + 1], v[i + 2], v[0]]).collect(),
        _ => v.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect(),
    }
}

/// Moves vertices that are nowhere to the origin and shrinks their triangles to a point: the triangles keep
/// their numbers, so that the file can be written back.
fn drop_non_finite(reader: &mut Reader, positions: &mut [Vec3], triangles: &mut [[u32; 3]], label: &str) {
    if positions.iter().all(|p| p.is_finite()) {
        return;
    }
    let mut dropped = 0;
    for t in triangles {
        if t.iter().any(|&v| !positions[v as usize].is_finite()) {
            *t = [t[0]; 3];
            dropped += 1;
        }
    }
    for p in positions {
        *p = if p.is_finite() { *p } else { Vec3::ZERO };
    }
    reader.warn("non-finite-position", format!("{label}: {dropped} triangles have infinite or undefined corners"));
}

/// Makes normals unit length; those without a direction become the area-weighted mean of the planes around
/// their vertex (+Z where no triangle has a plane). Returns how many were replaced.
fn repair_normals(normals: &mut [Vec3], positions: &[Vec3], triangles: &[[u32; 3]]) -> usize {
    for n in &mut *normals {
        *n = if n.is_finite() { n.as_dvec3().normalize_or_zero().as_vec3() } else { Vec3::ZERO };
    }
    let bad: Vec<usize> = (0..normals.len()).filter(|&i| normals[i] == Vec3::ZERO).collect();
    if bad.is_empty() {
        return 0;
    }
    let mut sums = vec![glam::DVec3::ZERO; normals.len()];
    for t in triangles {
        let [a, b, c] = t.map(|v| positions[v as usize].as_dvec3());
        let plane = (b - a).cross(c - a);
        t.iter().for_each(|&v| sums[v as usize] += plane);
    }
    for &i in &bad {
        normals[i] = sums[i].try_normalize().unwrap_or(glam::DVec3::Z).as_vec3();
    }
    bad.len()
}

/// True where a primitive has TEXCOORD_`set`.
pub(super) fn has_tex_coord(primitive: &Primitive, set: usize) -> bool {
    primitive.tex_coords.get(set).is_some_and(|s| !s.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strips_and_fans_keep_their_winding() {
        let v = [10, 11, 12, 13, 14];
        assert_eq!(triangle_list(Mode::TriangleStrip, &v), [[10, 11, 12], [11, 13, 12], [12, 13, 14]]);
        assert_eq!(triangle_list(Mode::TriangleFan, &v), [[11, 12, 10], [12, 13, 10], [13, 14, 10]]);
        assert_eq!(triangle_list(Mode::Triangles, &v), [[10, 11, 12]]);
        for mode in [Mode::Triangles, Mode::TriangleStrip, Mode::TriangleFan] {
            assert!(triangle_list(mode, &v[..2]).is_empty());
        }
    }

    #[test]
    fn normals_without_direction_take_the_plane() {
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y];
        let mut normals = [Vec3::ZERO, Vec3::splat(f32::NAN), Vec3::X * 5.0];
        assert_eq!(repair_normals(&mut normals, &positions, &[[0, 1, 2]]), 2);
        assert_eq!(normals, [Vec3::Z, Vec3::Z, Vec3::X]);
    }
}
