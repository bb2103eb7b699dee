//! Small scenes as GLB bytes, built in one expression:
//!
//! ```ignore
//! let bytes = SceneBuilder::new()
//!     .material("grey", [0.5; 3])
//!     .quad("floor", [[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]])
//!     .point_light("lamp", [0.0, 2.0, 0.0], [100.0; 3])
//!     .glb();
//! ```
//!
//! Lengths in metres, colours linear Rec. 709, light in candela, lux and nit. Shapes use the material added
//! last, or none. Whatever the methods do not offer, [`SceneBuilder::patch`] writes into the JSON.

// Each test file compiles its own copy and uses part of it.
#![allow(dead_code)]

use base64::Engine;
use glam::{Quat, Vec3};
use serde_json::{Value, json};

/// A scene in the making.
#[derive(Clone)]
pub struct SceneBuilder {
    pub(super) json: Value,
    pub(super) bin: Vec<u8>,
    /// A second buffer, without data.
    pub(super) placeholder: Option<Value>,
}

impl Default for SceneBuilder {
    fn default() -> Self {
        Self::new()
    }
}

impl SceneBuilder {
    /// An empty scene.
    pub fn new() -> SceneBuilder {
        let json = json!({
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            "nodes": [],
        });
        SceneBuilder { json, bin: Vec::new(), placeholder: None }
    }

    /// A diffuse material.
    pub fn material(self, name: &str, albedo: [f32; 3]) -> Self {
        self.material_json(json!({"name": name,
            "pbrMetallicRoughness": {"baseColorFactor": rgba(albedo), "metallicFactor": 0.0}}))
    }

    /// A diffuse material that reflects and emits on both sides.
    pub fn two_sided(self, name: &str, albedo: [f32; 3]) -> Self {
        self.material_json(json!({"name": name, "doubleSided": true,
            "pbrMetallicRoughness": {"baseColorFactor": rgba(albedo), "metallicFactor": 0.0}}))
    }

    /// A diffuse material that also emits `radiance` [nit].
    pub fn emitter(mut self, name: &str, albedo: [f32; 3], radiance: [f32; 3]) -> Self {
        // The factor is limited to 1, the strength is not.
        let strength = radiance.iter().fold(1.0f32, |a, &b| a.max(b));
        self = self.uses("KHR_materials_emissive_strength");
        self.material_json(json!({"name": name, "emissiveFactor": radiance.map(|c| c / strength),
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": strength}},
            "pbrMetallicRoughness": {"baseColorFactor": rgba(albedo), "metallicFactor": 0.0}}))
    }

    /// Any material, as glTF writes it.
    pub fn material_json(mut self, material: Value) -> Self {
        self.push("materials", material);
        self
    }

    /// A node with a quad: corners counter-clockwise as seen from its front, the first at UV (0, 0) and the
    /// second at (1, 0).
    pub fn quad(self, name: &str, corners: [[f32; 3]; 4]) -> Self {
        let [a, b, c, _] = corners.map(Vec3::from);
        let normal = (b - a).cross(c - a).normalize_or(Vec3::Y).to_array();
        let uvs = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        self.mesh(name, &corners, &[normal; 4], &uvs, &[[0, 1, 2], [0, 2, 3]])
    }

    /// A node with an axis-aligned box seen from outside, with flat normals.
    pub fn cuboid(self, name: &str, low: [f32; 3], high: [f32; 3]) -> Self {
        self.boxed(name, low, high, false)
    }

    /// A node with an axis-aligned box seen from inside, with flat normals: a closed room.
    pub fn room(self, name: &str, low: [f32; 3], high: [f32; 3]) -> Self {
        self.boxed(name, low, high, true)
    }

    fn boxed(self, name: &str, low: [f32; 3], high: [f32; 3], inward: bool) -> Self {
        let (mut positions, mut normals, mut uvs, mut triangles) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for axis in 0..3 {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            for top in [false, true] {
                let first = positions.len() as u32;
                for (s, t) in [(0, 0), (1, 0), (1, 1), (0, 1)] {
                    let mut p = low;
                    p[axis] = if top { high[axis] } else { low[axis] };
                    p[u] = if s == 1 { high[u] } else { low[u] };
                    p[v] = if t == 1 { high[v] } else { low[v] };
                    positions.push(p);
                    uvs.push([s as f32, t as f32]);
                    let mut n = [0.0; 3];
                    n[axis] = if top != inward { 1.0 } else { -1.0 };
                    normals.push(n);
                }
                let corner = |k: u32| first + if top != inward { k } else { 3 - k };
                triangles.push([corner(0), corner(1), corner(2)]);
                triangles.push([corner(0), corner(2), corner(3)]);
            }
        }
        self.mesh(name, &positions, &normals, &uvs, &triangles)
    }

    /// A node with any triangles. Empty `normals` or `uvs` are left out of the file.
    pub fn mesh(
        mut self,
        name: &str,
        positions: &[[f32; 3]],
        normals: &[[f32; 3]],
        uvs: &[[f32; 2]],
        triangles: &[[u32; 3]],
    ) -> Self {
        let mut attributes = json!({"POSITION": self.floats("VEC3", positions.as_flattened(), 3)});
        let bounds = |pick: fn(f32, f32) -> f32, start| {
            positions.iter().fold([start; 3], |m: [f32; 3], p| std::array::from_fn(|i| pick(m[i], p[i])))
        };
        let last = self.json["accessors"].as_array().map_or(0, |a| a.len() - 1);
        self.json["accessors"][last]["min"] = json!(bounds(f32::min, f32::INFINITY));
        self.json["accessors"][last]["max"] = json!(bounds(f32::max, f32::NEG_INFINITY));
        if !normals.is_empty() {
            attributes["NORMAL"] = json!(self.floats("VEC3", normals.as_flattened(), 3));
        }
        if !uvs.is_empty() {
            attributes["TEXCOORD_0"] = json!(self.floats("VEC2", uvs.as_flattened(), 2));
        }
        let bytes: Vec<u8> = triangles.as_flattened().iter().flat_map(|i| i.to_le_bytes()).collect();
        let indices = self.accessor(&bytes, 5125, "SCALAR", triangles.len() * 3);
        let mut primitive = json!({"attributes": attributes, "indices": indices});
        if let Some(n) = self.json["materials"].as_array().map(Vec::len) {
            primitive["material"] = json!(n - 1);
        }
        self.mesh_json(name, json!({"name": name, "primitives": [primitive]}))
    }

    /// A node with any mesh, as glTF writes it (see [`SceneBuilder::accessor`] for its data).
    pub fn mesh_json(mut self, name: &str, mesh: Value) -> Self {
        let mesh = self.push("meshes", mesh);
        self.node(json!({"name": name, "mesh": mesh}))
    }

    /// Another node that draws the mesh added last.
    pub fn instance(self, name: &str) -> Self {
        let mesh = self.json["meshes"].as_array().map_or(0, |m| m.len() - 1);
        self.node(json!({"name": name, "mesh": mesh}))
    }

    /// A point light [cd].
    pub fn point_light(self, name: &str, position: [f32; 3], candela: [f32; 3]) -> Self {
        self.light(name, json!({"type": "point"}), candela, json!({"translation": position}))
    }

    /// A spot light [cd] with half angles [rad] of its full and its whole cone.
    pub fn spot_light(
        self,
        name: &str,
        position: [f32; 3],
        direction: [f32; 3],
        candela: [f32; 3],
        inner: f32,
        outer: f32,
    ) -> Self {
        let spot = json!({"type": "spot", "spot": {"innerConeAngle": inner, "outerConeAngle": outer}});
        self.light(name, spot, candela, json!({"translation": position, "rotation": aim(direction)}))
    }

    /// A directional light: `lux` on a plane facing it, travelling along `direction`.
    pub fn sun(self, name: &str, direction: [f32; 3], lux: [f32; 3]) -> Self {
        self.light(name, json!({"type": "directional"}), lux, json!({"rotation": aim(direction)}))
    }

    fn light(mut self, name: &str, mut light: Value, strength: [f32; 3], mut node: Value) -> Self {
        self = self.uses("KHR_lights_punctual");
        // The colour is limited to 1, the intensity is not.
        let intensity = strength.iter().fold(f32::MIN_POSITIVE, |a, &b| a.max(b));
        light["name"] = json!(name);
        light["color"] = json!(strength.map(|c| c / intensity));
        light["intensity"] = json!(intensity);
        let lights = &mut self.json["extensions"]["KHR_lights_punctual"]["lights"];
        let index = push_to(lights, light);
        node["name"] = json!(name);
        node["extensions"] = json!({"KHR_lights_punctual": {"light": index}});
        self.node(node)
    }

    /// The same radiance [nit] from everywhere beyond the geometry.
    pub fn sky(mut self, radiance: [f32; 3]) -> Self {
        self.json["scenes"][0]["extras"]["sky_radiance"] = json!(radiance);
        self
    }

    /// A perspective camera that looks along `direction`, with its full vertical angle [rad].
    pub fn camera(mut self, name: &str, position: [f32; 3], direction: [f32; 3], vertical_fov: f32) -> Self {
        let camera = json!({"type": "perspective", "perspective": {"yfov": vertical_fov, "znear": 0.01}});
        let index = self.push("cameras", camera);
        self.node(json!({"name": name, "camera": index, "translation": position, "rotation": aim(direction)}))
    }

    /// A root node, as glTF writes it.
    pub fn node(mut self, node: Value) -> Self {
        let index = self.push("nodes", node);
        push_to(&mut self.json["scenes"][0]["nodes"], json!(index));
        self
    }

    /// Sets a property of the node added last, for instance `"translation"`, `"scale"` or `"matrix"`.
    pub fn with(mut self, key: &str, value: Value) -> Self {
        let last = self.json["nodes"].as_array().map_or(0, |n| n.len() - 1);
        self.json["nodes"][last][key] = value;
        self
    }

    /// Sets extras under the key `evenlight` of the node added last.
    pub fn extras(self, extras: Value) -> Self {
        self.with("extras", json!({"evenlight": extras}))
    }

    /// Changes the JSON in any other way.
    pub fn patch(mut self, change: impl FnOnce(&mut Value)) -> Self {
        change(&mut self.json);
        self
    }

    /// Adds an image (PNG, JPEG) and a texture of it; returns the index of the texture.
    pub fn texture(&mut self, encoded: &[u8], mime_type: &str) -> usize {
        let view = self.view(encoded);
        let image = self.push("images", json!({"bufferView": view, "mimeType": mime_type}));
        self.push("textures", json!({"source": image}))
    }

    /// Adds data as an accessor with glTF's numbers for component types; returns its index.
    pub fn accessor(&mut self, bytes: &[u8], component_type: u32, kind: &str, count: usize) -> usize {
        let view = self.view(bytes);
        let accessor = json!({"bufferView": view, "componentType": component_type, "type": kind, "count": count});
        self.push("accessors", accessor)
    }

    /// Adds data as a buffer view; returns its index.
    pub fn view(&mut self, bytes: &[u8]) -> usize {
        let view = json!({"buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len()});
        self.bin.extend_from_slice(bytes);
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        self.push("bufferViews", view)
    }

    fn floats(&mut self, kind: &str, values: &[f32], components: usize) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.accessor(&bytes, 5126, kind, values.len() / components)
    }

    fn uses(mut self, extension: &str) -> Self {
        declare(&mut self.json["extensionsUsed"], extension);
        self
    }

    /// Declares the extensions that materials, textures and nodes use, as a file has to.
    fn declare(&mut self) {
        let mut left = ["materials", "textures", "nodes"].map(|list| self.json[list].clone()).to_vec();
        while let Some(value) = left.pop() {
            for name in value["extensions"].as_object().into_iter().flatten().map(|(name, _)| name) {
                declare(&mut self.json["extensionsUsed"], name);
            }
            match value {
                Value::Array(all) => left.extend(all),
                Value::Object(all) => left.extend(all.into_iter().map(|(_, inner)| inner)),
                _ => {}
            }
        }
    }

    fn push(&mut self, list: &str, value: Value) -> usize {
        push_to(&mut self.json[list], value)
    }

    /// The scene as a GLB file.
    pub fn glb(mut self) -> Vec<u8> {
        self.declare();
        if !self.bin.is_empty() {
            self.json["buffers"] = json!([{"byteLength": self.bin.len()}]);
            self.placeholder.into_iter().for_each(|p| _ = push_to(&mut self.json["buffers"], p));
        }
        let mut text = self.json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut chunks = Vec::new();
        for (kind, data) in [(*b"JSON", &text), (*b"BIN\0", &self.bin)] {
            if !data.is_empty() {
                chunks.extend((data.len() as u32).to_le_bytes());
                chunks.extend(kind);
                chunks.extend(data);
            }
        }
        let mut glb = b"glTF".to_vec();
        glb.extend(2u32.to_le_bytes());
        glb.extend((12 + chunks.len() as u32).to_le_bytes());
        glb.extend(chunks);
        glb
    }

    /// The scene as one `.gltf` file, its buffer as a data URI.
    pub fn gltf(mut self) -> String {
        self.declare();
        if !self.bin.is_empty() {
            let data = base64::engine::general_purpose::STANDARD.encode(&self.bin);
            let uri = format!("data:application/octet-stream;base64,{data}");
            self.json["buffers"] = json!([{"byteLength": self.bin.len(), "uri": uri}]);
            self.placeholder.into_iter().for_each(|p| _ = push_to(&mut self.json["buffers"], p));
        }
        self.json.to_string()
    }
}

fn rgba(c: [f32; 3]) -> [f32; 4] {
    [c[0], c[1], c[2], 1.0]
}

/// The rotation that turns -Z to `direction`.
fn aim(direction: [f32; 3]) -> [f32; 4] {
    Quat::from_rotation_arc(Vec3::NEG_Z, Vec3::from(direction).normalize_or(Vec3::NEG_Z)).to_array()
}

fn declare(used: &mut Value, extension: &str) {
    if !used.as_array().is_some_and(|u| u.iter().any(|e| e == extension)) {
        push_to(used, json!(extension));
    }
}

/// Appends to an array, which null becomes; returns the index.
fn push_to(list: &mut Value, value: Value) -> usize {
    if list.is_null() {
        *list = json!([]);
    }
    match list.as_array_mut() {
        Some(array) => {
            array.push(value);
            array.len() - 1
        }
        None => panic!("{list} is not an array"),
    }
}
