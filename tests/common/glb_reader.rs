//! Reads GLB files for tests, without any code of the library, and checks what the format promises.

use serde_json::Value;

/// JSON and buffers of a document.
pub struct Parsed {
    pub json: Value,
    pub buffers: Vec<Vec<u8>>,
}

/// Splits a GLB file into its chunks.
pub fn parse(file: &[u8]) -> Parsed {
    let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&file[..4], word(4), word(8)), (&b"glTF"[..], 2, file.len()), "header");
    let mut at = 12;
    let mut chunks = Vec::new();
    while at < file.len() {
        assert_eq!(word(at) % 4, 0, "chunk length");
        chunks.push((&file[at + 4..at + 8], &file[at + 8..at + 8 + word(at)]));
        at += 8 + word(at);
    }
    assert_eq!(chunks[0].0, b"JSON");
    let json = serde_json::from_slice(chunks[0].1).expect("JSON chunk");
    assert!(chunks.len() <= 2 && chunks.iter().skip(1).all(|c| c.0 == b"BIN\0"));
    Parsed { json, buffers: chunks.iter().skip(1).map(|c| c.1.to_vec()).collect() }
}

fn get(value: &Value, key: &str, default: usize) -> usize {
    value.get(key).map_or(default, |v| v.as_u64().unwrap_or_else(|| panic!("{key} of {value}")) as usize)
}

fn list<'a>(value: &'a Value, key: &str) -> &'a [Value] {
    value.get(key).and_then(Value::as_array).map_or(&[], Vec::as_slice)
}

impl Parsed {
    /// Elements of an accessor as raw numbers, sparse ones resolved.
    pub fn elements(&self, accessor: usize) -> Vec<Vec<f64>> {
        let a = &self.json["accessors"][accessor];
        let components = match a["type"].as_str().unwrap() {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            other => panic!("{other}"),
        };
        let (kind, count) = (get(a, "componentType", 0), get(a, "count", 0));
        let mut elements = match a.get("bufferView") {
            None => vec![vec![0.0; components]; count],
            Some(view) => self.read(view, get(a, "byteOffset", 0), kind, components, count),
        };
        if let Some(sparse) = a.get("sparse") {
            let n = get(sparse, "count", 0);
            let (i, v) = (&sparse["indices"], &sparse["values"]);
            let at = self.read(&i["bufferView"], get(i, "byteOffset", 0), get(i, "componentType", 0), 1, n);
            let values = self.read(&v["bufferView"], get(v, "byteOffset", 0), kind, components, n);
            for (at, value) in at.into_iter().zip(values) {
                elements[at[0] as usize] = value;
            }
        }
        elements
    }

    fn read(&self, view: &Value, offset: usize, kind: usize, components: usize, count: usize) -> Vec<Vec<f64>> {
        let view = &self.json["bufferViews"][view.as_u64().unwrap() as usize];
        let size = match kind {
            5120 | 5121 => 1,
            5122 | 5123 => 2,
            5125 | 5126 => 4,
            other => panic!("componentType {other}"),
        };
        let stride = get(view, "byteStride", size * components);
        let start = get(view, "byteOffset", 0);
        let bytes = &self.buffers[get(view, "buffer", 0)][start..start + get(view, "byteLength", 0)];
        assert_eq!((start + offset) % size, 0, "accessor offset is aligned to its components");
        let number = |b: &[u8]| match kind {
            5120 => f64::from(b[0] as i8),
            5121 => f64::from(b[0]),
            5122 => f64::from(i16::from_le_bytes([b[0], b[1]])),
            5123 => f64::from(u16::from_le_bytes([b[0], b[1]])),
            5125 => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            _ => f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        };
        let element = |i: usize| {
            let at = offset + i * stride;
            (0..components).map(|c| number(&bytes[at + c * size..at + (c + 1) * size])).collect()
        };
        (0..count).map(element).collect()
    }

    /// Triangles of a primitive, strips and fans resolved as glTF 2.0, section 3.7.2.1, defines them.
    pub fn triangles(&self, primitive: &Value) -> Vec<[usize; 3]> {
        let indices: Vec<usize> = match primitive.get("indices") {
            Some(i) => self.elements(i.as_u64().unwrap() as usize).iter().map(|e| e[0] as usize).collect(),
            None => (0..self.vertex_count(primitive)).collect(),
        };
        match get(primitive, "mode", 4) {
            4 => indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect(),
            5 => (0..indices.len() - 2).map(|i| [indices[i], indices[i + 1 + i % 2], indices[i + 2 - i % 2]]).collect(),
            6 => (1..indices.len() - 1).map(|i| [indices[i], indices[i + 1], indices[0]]).collect(),
            other => panic!("mode {other}"),
        }
    }

    fn vertex_count(&self, primitive: &Value) -> usize {
        let position = primitive["attributes"]["POSITION"].as_u64().unwrap() as usize;
        get(&self.json["accessors"][position], "count", 0)
    }

    /// Panics where the document breaks a rule that this writer could break.
    pub fn check(&self) {
        let json = &self.json;
        let buffers = list(json, "buffers");
        if let Some(first) = buffers.first() {
            let length = get(first, "byteLength", 0);
            assert!(length <= self.buffers[0].len() && self.buffers[0].len() < length + 4, "length of the BIN chunk");
        }
        for view in list(json, "bufferViews") {
            let end = get(view, "byteOffset", 0) + get(view, "byteLength", 0);
            assert!(end <= get(&buffers[get(view, "buffer", 0)], "byteLength", 0), "{view} reaches beyond its buffer");
        }
        for (i, accessor) in list(json, "accessors").iter().enumerate() {
            if accessor["type"].as_str().is_some_and(|t| t.starts_with("MAT")) {
                continue;
            }
            let elements = self.elements(i);
            for (key, side) in [("min", f64::min as fn(f64, f64) -> f64), ("max", f64::max)] {
                for (c, bound) in list(accessor, key).iter().enumerate() {
                    let found = elements.iter().map(|e| e[c]).reduce(side);
                    let bound = bound.as_f64().unwrap();
                    assert_eq!(found.map(|v| v as f32), Some(bound as f32), "{key} of accessor {i}");
                }
            }
        }
        for primitive in list(json, "meshes").iter().flat_map(|m| list(m, "primitives")) {
            self.check_primitive(primitive);
        }
        for image in list(json, "images") {
            assert!(image.get("uri").is_some() != image.get("bufferView").is_some(), "{image}");
        }
    }

    fn check_primitive(&self, primitive: &Value) {
        let count = self.vertex_count(primitive);
        let attributes = primitive["attributes"].as_object().unwrap();
        let targets = list(primitive, "targets").iter().flat_map(|t| t.as_object().unwrap());
        for (name, index) in attributes.iter().chain(targets) {
            let accessor = &self.json["accessors"][index.as_u64().unwrap() as usize];
            assert_eq!(get(accessor, "count", 0), count, "count of {name}");
            let Some(view) = accessor.get("bufferView") else { continue };
            let view = &self.json["bufferViews"][view.as_u64().unwrap() as usize];
            let at = get(accessor, "byteOffset", 0) + get(view, "byteOffset", 0);
            assert_eq!(at % 4, 0, "offset of {name} in {view}");
            assert_eq!(get(view, "byteStride", 4) % 4, 0, "stride of {name}");
        }
        let sets = attributes.keys().filter(|k| k.starts_with("TEXCOORD_")).count();
        assert!((0..sets).all(|n| attributes.contains_key(&format!("TEXCOORD_{n}"))), "gap in the UV sets");
        if list(&self.json, "accessors").iter().any(|a| a["type"].is_string()) && get(primitive, "mode", 4) >= 4 {
            assert!(self.triangles(primitive).iter().flatten().all(|&v| v < count), "index out of range");
        }
    }
}
