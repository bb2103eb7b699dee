//! Scenes with packed geometry, by encoders as plain as the formats allow.

use super::glb::SceneBuilder;
use base64::Engine;
use serde_json::{Value, json};

impl SceneBuilder {
    /// Packs all vertices and indices of the scene by `extension`, one of the two of meshoptimizer. What was
    /// there before has a placeholder, the second buffer.
    pub fn meshopt(mut self, extension: &str) -> SceneBuilder {
        let (mut bin, mut unpacked) = (Vec::new(), 0);
        let views = self.json["bufferViews"].as_array().map_or(0, Vec::len);
        for i in 0..views {
            let view = self.json["bufferViews"][i].clone();
            let [start, length] = ["byteOffset", "byteLength"].map(|k| view[k].as_u64().unwrap_or(0) as usize);
            let data = &self.bin[start..start + length];
            bin.resize(bin.len().next_multiple_of(4), 0);
            let at = bin.len();
            let accessors = self.json["accessors"].as_array().into_iter().flatten();
            let mut stride = accessors.filter(|a| a["bufferView"] == i).map(|a| match a["type"].as_str() {
                Some("SCALAR") => 4,
                Some("VEC2") => 8,
                _ => 12,
            });
            match stride.next() {
                None => {
                    bin.extend_from_slice(data);
                    self.json["bufferViews"][i]["byteOffset"] = json!(at);
                }
                Some(stride) => {
                    let (mode, stream) = match stride {
                        4 => ("TRIANGLES", meshopt_triangles(data)),
                        _ => ("ATTRIBUTES", meshopt_attributes(data, stride)),
                    };
                    let packed = json!({"buffer": 0, "byteOffset": at, "byteLength": stream.len(),
                        "byteStride": stride, "count": length / stride, "mode": mode});
                    self.json["bufferViews"][i] = json!({"buffer": 1, "byteOffset": unpacked, "byteLength": length,
                        "extensions": {extension: packed}});
                    bin.extend(stream);
                    unpacked += length;
                }
            }
        }
        self.bin = bin;
        self.placeholder = Some(json!({"byteLength": unpacked, "extensions": {extension: {"fallback": true}}}));
        self.requires(extension)
    }
}

/// Two streams of Google's Draco library (1.5.7, positions of 12 bits): connectivity by Edgebreaker, and plain. Both
/// hold the eight triangles of a grid of vertices (x, x z / 4, z) with UV (x / 2, z / 2), x and z from 0 to 2, the
/// front above.
pub const DRACO: [&str; 2] = [
    "RFJBQ08CAgEBAAAACQgBCAEAA+/TGv8BEf8CiEACAAAA/wAAAQMJAgEAAAEACQMAAQIAAAA/AAAAPwAAgD8AAAAAAAAAPwAAAAAA\
     AAAAAAAAPwAAAAAAAAAAAAAAAAAAgD8AAAA/AACAPwAAgD8AAAA/AACAPwAAgD8BAQEADQMdBx9VFTkOWRUFms/5S4D/D0D/7///\
     8//9DwAAEMD/AACA/wEAAAABAMD/AAAAgAAAAAAAAP8PAAAAAAAAAAAAAAAAAAAAAABADA==",
    "RFJBQ08CAgEAAAAICQEAAwEBAwQBBAICBAUDBgQEBgcEBwUFBwgBAgMJAgEAAAkDAAEAAgAAAAAAAAAAAAAAPwAAAAAAAIA/AAAA\
     AAAAAAAAAAA/AAAAPwAAAD8AAIA/AAAAPwAAAAAAAIA/AAAAPwAAgD8AAIA/AACAPwABAQANAx0HJ+U4AwTghfh/AAAA/wcAABAA\
     APj//wcgAPB/AAIAAfg///9/AAQA/wdAAAAAAAAA/w8AAAAAAAAAAAAAAAAAAAAAAEAM",
];

impl SceneBuilder {
    /// A node with a primitive in a Draco stream, in base64, with attributes as those of [`DRACO`].
    pub fn draco(mut self, name: &str, stream: &str) -> SceneBuilder {
        let stream = base64::engine::general_purpose::STANDARD.decode(stream).expect("base64");
        let view = self.view(&stream);
        let first = self.json["accessors"].as_array().map_or(0, Vec::len);
        let accessors = [
            json!({"componentType": 5126, "type": "VEC3", "count": 9, "min": [0, 0, 0], "max": [2, 1, 2]}),
            json!({"componentType": 5126, "type": "VEC2", "count": 9}),
            json!({"componentType": 5123, "type": "SCALAR", "count": 24}),
        ];
        let mut all: Vec<Value> = self.json["accessors"].as_array().cloned().unwrap_or_default();
        all.extend(accessors);
        self.json["accessors"] = json!(all);
        self = self.requires("KHR_draco_mesh_compression");
        let draco = json!({"bufferView": view, "attributes": {"POSITION": 1, "TEXCOORD_0": 0}});
        let primitive = json!({"attributes": {"POSITION": first, "TEXCOORD_0": first + 1}, "indices": first + 2,
            "mode": 4, "extensions": {"KHR_draco_mesh_compression": draco}});
        self.mesh_json(name, json!({"name": name, "primitives": [primitive]}))
    }

    fn requires(mut self, extension: &str) -> SceneBuilder {
        for list in ["extensionsUsed", "extensionsRequired"] {
            let mut names: Vec<Value> = self.json[list].as_array().cloned().unwrap_or_default();
            if !names.contains(&json!(extension)) {
                names.push(json!(extension));
            }
            self.json[list] = json!(names);
        }
        self
    }
}

/// Attributes in version 0, every difference as a whole byte.
pub fn meshopt_attributes(data: &[u8], stride: usize) -> Vec<u8> {
    let mut stream = vec![0xa0];
    let most = ((8192 / stride) & !15).min(256);
    let count = data.len() / stride;
    for block in (0..count).step_by(most) {
        let groups = most.min(count - block).div_ceil(16);
        for byte in 0..stride {
            stream.resize(stream.len() + groups.div_ceil(4), 0xff);
            for i in block..block + 16 * groups {
                let at = |i: usize| data.get(i * stride + byte).copied().unwrap_or(0);
                let delta = at(i).wrapping_sub(if i == 0 { 0 } else { at(i - 1) });
                stream.push(if delta & 0x80 != 0 { !(delta << 1) } else { delta << 1 });
            }
        }
    }
    stream.resize(stream.len() + stride.max(32), 0);
    stream
}

/// Triangles of 32-bit indices, each index by itself.
pub fn meshopt_triangles(data: &[u8]) -> Vec<u8> {
    let mut stream = vec![0xe1];
    stream.resize(1 + data.len() / 12, 0xff);
    let mut last = 0u32;
    for (i, b) in data.chunks_exact(4).enumerate() {
        if i % 3 == 0 {
            stream.push(0xff);
        }
        let index = u32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        let delta = index.wrapping_sub(last) as i32;
        let mut v = (delta << 1 ^ delta >> 31) as u32;
        while v >= 0x80 {
            stream.push(v as u8 | 0x80);
            v >>= 7;
        }
        stream.push(v as u8);
        last = index;
    }
    stream.resize(stream.len() + 16, 0);
    stream
}
