//! The node tree of one scene: world transforms, instances, and what nodes carry besides meshes.

use super::reader::{REPAIR, Reader};
use super::{area, ies, image_based, light};
use crate::error::SceneError;
use crate::scene::{Camera, Instance, Light, Projection, Sky};
use glam::{DAffine3, DMat4, DQuat, DVec3, Vec3};
use gltf::json;
use serde_json::Value;

/// What the nodes of the scene hold, in depth-first order.
#[derive(Default)]
pub(super) struct Tree {
    /// Their `mesh` is the index in the document.
    pub(super) instances: Vec<Instance>,
    pub(super) lights: Vec<Light>,
    profiles: ies::Profiles,
    pub(super) cameras: Vec<Camera>,
    pub(super) sky: Option<Sky>,
}

/// Walks the default scene, else the first one, else all nodes that are no node's child.
pub(super) fn walk(reader: &mut Reader) -> Result<Tree, SceneError> {
    let mut tree = Tree::default();
    let roots = match chosen_scene(reader)? {
        Some(scene) => {
            tree.sky = match image_based::read(reader, scene)? {
                None => read_sky(reader, scene)?,
                some => some,
            };
            scene_roots(reader, scene)?
        }
        None => {
            let roots = all_roots(reader)?;
            if !roots.is_empty() {
                reader.warn("no-scene", "the file has no scene; all of its nodes are taken");
            }
            roots
        }
    };
    // Of each node visited, the one it was reached from (itself for a root).
    let mut parents: Vec<Option<usize>> = vec![None; reader.list("nodes")?.len()];
    let mut hidden = 0;
    let mut pending: Vec<(usize, usize, DAffine3, bool)> =
        roots.iter().rev().map(|&root| (root, root, DAffine3::IDENTITY, true)).collect();
    while let Some((index, parent, world_from_parent, visible)) = pending.pop() {
        let by = if index == parent { "the scene".to_owned() } else { reader.label("nodes", parent) };
        let node: json::Node = reader.object("nodes", index, &by)?;
        if parents[index].is_some() {
            return Err(visited_twice(reader, &parents, index, parent));
        }
        parents[index] = Some(parent);
        let world_from_node = world_from_parent * local_transform(reader, index, &node);
        let visible = visible && is_visible(&node);
        if visible {
            read_node(reader, &mut tree, index, &node, world_from_node)?;
        } else if node.mesh.is_some() || LightsOf::new(&node).any() {
            hidden += 1;
        }
        // Seen or not, a node can be looked from.
        if let Some(camera) = &node.camera {
            tree.cameras.extend(read_camera(reader, camera.value(), index, world_from_node)?);
        }
        let children = node.children.unwrap_or_default();
        pending.extend(children.iter().rev().map(|c| (c.value(), index, world_from_node, visible)));
    }
    if hidden > 0 {
        let message = format!(
            "{hidden} nodes with meshes or lights are invisible (KHR_node_visibility): they are \
             neither baked nor block or give light, but stay in the file"
        );
        reader.warn("hidden-nodes", message);
    }
    Ok(tree)
}

/// False where KHR_node_visibility hides a node, and with it all below.
fn is_visible(node: &json::Node) -> bool {
    let extension = node.extensions.as_ref().and_then(|e| e.others.get("KHR_node_visibility"));
    extension.and_then(|e| e.get("visible")) != Some(&Value::Bool(false))
}

/// The lights at a node.
struct LightsOf<'n> {
    /// Of EXT_lights_ies.
    profiled: Option<&'n Value>,
    /// Index of that of KHR_lights_punctual.
    punctual: Option<usize>,
    /// Of EXT_lights_area.
    area: Option<&'n Value>,
}

impl LightsOf<'_> {
    fn new(node: &json::Node) -> LightsOf<'_> {
        let extensions = node.extensions.as_ref();
        LightsOf {
            profiled: extensions.and_then(|e| e.others.get("EXT_lights_ies")),
            punctual: extensions.and_then(|e| e.khr_lights_punctual.as_ref()).map(|l| l.light.value()),
            area: extensions.and_then(|e| e.others.get("EXT_lights_area")),
        }
    }

    fn any(&self) -> bool {
        self.profiled.is_some() || self.punctual.is_some() || self.area.is_some()
    }
}

/// Index of the scene to bake, if the file has any.
fn chosen_scene(reader: &Reader) -> Result<Option<usize>, SceneError> {
    let scenes = reader.list("scenes")?.len();
    match reader.document.json.get("scene") {
        None => Ok((scenes > 0).then_some(0)),
        Some(value) => match value.as_u64() {
            Some(i) if i < scenes as u64 => Ok(Some(i as usize)),
            _ => Err(reader.invalid(format!("its `scene` is {value}, but it has {scenes} scenes; {REPAIR}"))),
        },
    }
}

fn scene_roots(reader: &Reader, scene: usize) -> Result<Vec<usize>, SceneError> {
    let label = reader.label("scenes", scene);
    match reader.value("scenes", scene, "the file")?.get("nodes") {
        None => Ok(Vec::new()),
        Some(nodes) => nodes
            .as_array()
            .and_then(|nodes| nodes.iter().map(|v| usize::try_from(v.as_u64()?).ok()).collect())
            .ok_or_else(|| reader.invalid(format!("{label}: its nodes are not a list of indices; {REPAIR}"))),
    }
}

fn all_roots(reader: &Reader) -> Result<Vec<usize>, SceneError> {
    let nodes = reader.list("nodes")?;
    let mut is_child = vec![false; nodes.len()];
    for child in nodes.iter().filter_map(|n| n.get("children")?.as_array()).flatten() {
        if let Some(flag) = child.as_u64().and_then(|i| is_child.get_mut(usize::try_from(i).ok()?)) {
            *flag = true;
        }
    }
    if !nodes.is_empty() && is_child.iter().all(|&c| c) {
        return Err(reader.invalid(format!("every node is another's child: the node tree is circular; {REPAIR}")));
    }
    Ok((0..nodes.len()).filter(|&i| !is_child[i]).collect())
}

/// The error for a node reached a second time, now from `parent`.
fn visited_twice(reader: &Reader, parents: &[Option<usize>], index: usize, parent: usize) -> SceneError {
    let mut ancestor = parent;
    while ancestor != index && parents[ancestor].is_some_and(|p| p != ancestor) {
        ancestor = parents[ancestor].unwrap_or(ancestor);
    }
    let label = reader.label("nodes", index);
    let how = if ancestor == index { "is its own ancestor" } else { "is in the tree twice" };
    reader.invalid(format!("{label} {how}, but a node has one parent at most; {REPAIR}"))
}

fn local_transform(reader: &mut Reader, index: usize, node: &json::Node) -> DAffine3 {
    let has_trs = node.translation.is_some() || node.rotation.is_some() || node.scale.is_some();
    if let Some(m) = node.matrix {
        if has_trs || [m[3], m[7], m[11], m[15]] != [0.0, 0.0, 0.0, 1.0] {
            let label = reader.label("nodes", index);
            reader.warn("odd-matrix", format!("{label}: only the affine part of its matrix is used"));
        }
        return DAffine3::from_mat4(DMat4::from_cols_array(&m.map(f64::from)));
    }
    let translation = node.translation.map_or(DVec3::ZERO, |t| DVec3::from(t.map(f64::from)));
    let scale = node.scale.map_or(DVec3::ONE, |s| DVec3::from(s.map(f64::from)));
    let rotation = match node.rotation {
        None => DQuat::IDENTITY,
        Some(json::scene::UnitQuaternion(q)) => {
            let q = DQuat::from_array(q.map(f64::from));
            let length = q.length();
            if length > 0.0 && length.is_finite() {
                q / length
            } else {
                let label = reader.label("nodes", index);
                reader.warn("odd-rotation", format!("{label}: its rotation {q} is none and is ignored"));
                DQuat::IDENTITY
            }
        }
    };
    DAffine3::from_scale_rotation_translation(scale, rotation, translation)
}

fn read_node(
    reader: &mut Reader,
    tree: &mut Tree,
    index: usize,
    node: &json::Node,
    world_from_node: DAffine3,
) -> Result<(), SceneError> {
    let label = reader.label("nodes", index);
    if let Some(mesh) = &node.mesh {
        reader.value("meshes", mesh.value(), &label)?;
        if node.skin.is_some() {
            reader.warn("skin", format!("{label} is skinned; it is baked in its bind pose"));
        }
        if is_drawable(&world_from_node) {
            tree.instances.push(read_instance(reader, index, mesh.value(), world_from_node, &label));
        } else {
            reader.warn("odd-transform", format!("{label} is scaled to nothing or to infinity; its mesh is left out"));
        }
    }
    let lights = LightsOf::new(node);
    if let Some(extension) = lights.profiled {
        if lights.punctual.is_some() {
            let which =
                "two lights, of EXT_lights_ies and of KHR_lights_punctual; the first is taken, as the same better";
            reader.warn("two-lights", format!("{label} has {which}"));
        }
        tree.lights.extend(ies::read(reader, &mut tree.profiles, extension, index, world_from_node)?);
    } else if let Some(light) = lights.punctual {
        tree.lights.extend(light::read(reader, light, index, world_from_node)?);
    }
    if let Some(extension) = lights.area {
        tree.lights.extend(area::read(reader, extension, index, world_from_node)?);
    }
    Ok(())
}

/// False where a transform leaves no area of anything, or none that is finite.
fn is_drawable(m: &DAffine3) -> bool {
    let a = m.matrix3;
    let areas = [a.x_axis.cross(a.y_axis), a.y_axis.cross(a.z_axis), a.z_axis.cross(a.x_axis)];
    m.is_finite() && areas.iter().all(|v| v.is_finite()) && areas.iter().any(|v| *v != DVec3::ZERO)
}

fn read_instance(reader: &mut Reader, node: usize, mesh: usize, world_from_object: DAffine3, label: &str) -> Instance {
    let name = reader.name("nodes", node).map_or_else(|| format!("node {node}"), str::to_owned);
    let mut instance =
        Instance { node, name, mesh, world_from_object, weight: 1.0, density: 1.0, bake: true, casts: true };
    let Some(extras) = reader.value("nodes", node, label).ok().and_then(|n| n.get("extras")) else { return instance };
    let ours = extras.get("evenlight");
    let mut number = |value: Option<&Value>, key: &str, default: f32, least: f32| {
        let Some(value) = value else { return default };
        match value.as_f64().map(|v| v as f32) {
            Some(v) if v.is_finite() && v >= least => v,
            _ => {
                let message = format!("{label}: extras {key} is {value}, not a number from {least}; {default} is used");
                reader.warn("odd-extras", message);
                default
            }
        }
    };
    let weight = ours.and_then(|e| e.get("weight")).or(extras.get("compare_weight"));
    instance.weight = number(weight, "weight", 1.0, 0.0);
    instance.density = number(ours.and_then(|e| e.get("density")), "density", 1.0, 1e-3);
    let on = |key: &str| ours.and_then(|e| e.get(key)) != Some(&Value::Bool(false));
    instance.bake = on("bake") && on("receives");
    instance.casts = on("casts");
    instance
}

fn read_camera(
    reader: &mut Reader,
    index: usize,
    node: usize,
    world_from_node: DAffine3,
) -> Result<Option<Camera>, SceneError> {
    let camera: json::Camera = reader.object("cameras", index, &reader.label("nodes", node))?;
    let label = reader.label("cameras", index);
    let projection = match (&camera.perspective, &camera.orthographic) {
        (Some(p), _) => Projection::Perspective {
            vertical_fov: p.yfov,
            aspect: p.aspect_ratio.filter(|a| a.is_finite() && *a > 0.0),
        },
        (None, Some(o)) => Projection::Orthographic { half_width: o.xmag, half_height: o.ymag },
        (None, None) => return Err(reader.invalid(format!("{label} has no projection; {REPAIR}"))),
    };
    let usable = match projection {
        Projection::Perspective { vertical_fov, .. } => vertical_fov > 0.0 && vertical_fov < std::f32::consts::PI,
        Projection::Orthographic { half_width, half_height } => {
            half_width != 0.0 && half_height != 0.0 && half_width.is_finite() && half_height.is_finite()
        }
    };
    let forward = direction(&world_from_node, DVec3::NEG_Z);
    let up = direction(&world_from_node, DVec3::Y);
    let (Some(forward), Some(up), true) = (forward, up, usable && world_from_node.translation.is_finite()) else {
        reader.warn("odd-camera", format!("{label} sees nothing and is left out"));
        return Ok(None);
    };
    let name = reader.name("cameras", index).or(reader.name("nodes", node));
    let name = name.map_or_else(|| format!("camera {index}"), str::to_owned);
    Ok(Some(Camera { name, position: world_from_node.translation, forward, up, projection }))
}

/// Unit world direction of a node's axis; `None` where its transform leaves none.
pub(super) fn direction(world_from_node: &DAffine3, axis: DVec3) -> Option<Vec3> {
    world_from_node.transform_vector3(axis).try_normalize().map(|d| d.as_vec3())
}

/// The constant sky of a scene's extras, `sky_radiance: [r, g, b]` in nit.
fn read_sky(reader: &mut Reader, scene: usize) -> Result<Option<Sky>, SceneError> {
    let Some(value) = reader.value("scenes", scene, "the file")?.pointer("/extras/sky_radiance") else {
        return Ok(None);
    };
    let channels = <[f32; 3] as serde::Deserialize>::deserialize(value).map(Vec3::from);
    match channels {
        Ok(radiance) if radiance.is_finite() && radiance.min_element() >= 0.0 => Ok(Some(Sky::Constant(radiance))),
        _ => {
            let label = reader.label("scenes", scene);
            reader.warn("odd-extras", format!("{label}: extras sky_radiance is {value}, not three numbers from 0"));
            Ok(None)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Document;
    use super::*;
    use serde_json::json;

    fn walk_json(json: Value) -> Result<(Tree, usize), SceneError> {
        let document = Document { path: "test.gltf".into(), json, buffers: Vec::new() };
        let mut reader = Reader::new(&document, Vec::new());
        walk(&mut reader).map(|tree| (tree, reader.warnings.len()))
    }

    #[test]
    fn transforms_compose_and_may_mirror() {
        let (tree, warnings) = walk_json(json!({"scenes": [{"nodes": [0]}], "meshes": [{}], "nodes": [
            {"children": [1], "translation": [1, 2, 3], "scale": [2, 2, 2]},
            {"mesh": 0, "scale": [-1, 1, 1], "rotation": [0, 0, std::f64::consts::FRAC_1_SQRT_2, std::f64::consts::FRAC_1_SQRT_2]},
        ]}))
        .unwrap();
        let m = tree.instances[0].world_from_object;
        assert!(m.matrix3.determinant() < 0.0 && warnings == 0);
        // Mirrored to (-1, 0, 0), turned to (0, -1, 0), doubled, moved.
        assert!(m.transform_point3(DVec3::X).distance(DVec3::new(1.0, 0.0, 3.0)) < 1e-6);
    }

    #[test]
    fn trees_must_be_trees() {
        let with = |nodes: Value| walk_json(json!({"scenes": [{"nodes": [0]}], "nodes": nodes})).map(|_| ());
        let message = |nodes: Value| with(nodes).unwrap_err().to_string();
        assert!(message(json!([{"children": [1]}, {"children": [0]}])).contains("its own ancestor"));
        assert!(message(json!([{"children": [0]}])).contains("its own ancestor"));
        assert!(message(json!([{"children": [1, 2]}, {"children": [2]}, {}])).contains("twice"));
        assert!(message(json!([{"children": [7]}])).contains("nodes[7]"));
        assert!(walk_json(json!({"nodes": [{"children": [0]}]})).is_err());
    }

    #[test]
    fn depth_is_no_danger() {
        let n = 200_000;
        let nodes: Vec<Value> = (1..=n).map(|i| if i < n { json!({"children": [i]}) } else { json!({}) }).collect();
        assert!(walk_json(json!({"scenes": [{"nodes": [0]}], "nodes": nodes})).is_ok());
    }

    #[test]
    fn flat_is_drawn_and_nothing_is_not() {
        let with = |scale: Value| {
            walk_json(json!({"meshes": [{}], "nodes": [{"mesh": 0, "scale": scale}], "scenes": [{"nodes": [0]}]}))
                .map(|(tree, warnings)| (tree.instances.len(), warnings))
        };
        assert_eq!(with(json!([1, 1, 0])).unwrap(), (1, 0));
        assert_eq!(with(json!([1, 0, 0])).unwrap(), (0, 1));
        assert_eq!(with(json!([1e39, 1, 1])).unwrap(), (0, 1));
    }

    #[test]
    fn extras_are_read_and_checked() {
        let with = |extras: Value| {
            let (tree, warnings) = walk_json(json!({"meshes": [{}], "scenes": [{"nodes": [0]}],
                "nodes": [{"mesh": 0, "extras": extras}]}))
            .unwrap();
            let i = &tree.instances[0];
            (i.weight, i.density, i.bake, warnings)
        };
        assert_eq!(with(json!({"evenlight": {"weight": 3, "density": 0.5, "bake": false}})), (3.0, 0.5, false, 0));
        assert_eq!(with(json!({"compare_weight": 2})), (2.0, 1.0, true, 0));
        assert_eq!(with(json!({"evenlight": {"weight": -1, "density": "x"}})), (1.0, 1.0, true, 2));
        assert_eq!(with(json!(5)), (1.0, 1.0, true, 0));
    }
}
