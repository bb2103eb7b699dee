//! Faults of a file that stand in nobody's way: in objects that nothing uses, or of no consequence to a bake. Whoever
//! reads the file next may be less patient, so they are warned of, by their JSON pointer.
//!
//! The rules are those of glTF 2.0 and its extensions that readers do not check themselves.

use super::container;
use super::{Document, Reader};
use crate::error::Warning;
use serde_json::{Map, Value};
use std::borrow::Cow;
use std::collections::BTreeSet;

/// Most faults that are named.
const MOST: usize = 8;

/// Top-level arrays of objects.
const LISTS: [&str; 13] = [
    "accessors",
    "animations",
    "buffers",
    "bufferViews",
    "cameras",
    "images",
    "materials",
    "meshes",
    "nodes",
    "samplers",
    "scenes",
    "skins",
    "textures",
];

/// Where extensions belong whose place says what they mean: the pointer of an object, with `*` for an index.
const PLACES: [(&str, &str); 3] =
    [("KHR_materials_", "/materials/*"), ("EXT_texture_webp", "/textures/*"), ("KHR_texture_basisu", "/textures/*")];

/// Numbers of materials and their least and largest values.
const RANGES: [(&str, f64, f64); 16] = [
    ("alphaCutoff", 0.0, f64::INFINITY),
    ("anisotropyStrength", 0.0, 1.0),
    ("clearcoatFactor", 0.0, 1.0),
    ("clearcoatRoughnessFactor", 0.0, 1.0),
    ("diffuseTransmissionFactor", 0.0, 1.0),
    ("dispersion", 0.0, f64::INFINITY),
    ("emissiveStrength", 0.0, f64::INFINITY),
    ("glossinessFactor", 0.0, 1.0),
    ("iridescenceFactor", 0.0, 1.0),
    ("metallicFactor", 0.0, 1.0),
    ("roughnessFactor", 0.0, 1.0),
    ("sheenRoughnessFactor", 0.0, 1.0),
    ("specularFactor", 0.0, 1.0),
    ("strength", 0.0, 1.0),
    ("thicknessFactor", 0.0, f64::INFINITY),
    ("transmissionFactor", 0.0, 1.0),
];

/// A warning of each.
pub(super) fn find(document: &Document) -> Vec<Warning> {
    let mut finder = Finder { document, faults: Vec::new() };
    finder.find();
    let faults = finder.faults;
    let warning = |what: String| Warning::new("fault-in-file", what);
    let named = faults.iter().take(MOST).map(|fault| format!("{fault}; a bake gets along with it, others may not"));
    let mut warnings: Vec<Warning> = named.map(warning).collect();
    if faults.len() > MOST {
        warnings.push(warning(format!("{} more faults; the glTF validator lists them", faults.len() - MOST)));
    }
    warnings
}

struct Finder<'d> {
    document: &'d Document,
    faults: Vec<String>,
}

impl<'d> Finder<'d> {
    fn find(&mut self) {
        let json = &self.document.json;
        for list in LISTS {
            match json.get(list) {
                None => {}
                Some(Value::Array(all)) if all.is_empty() => self.add(&format!("/{list}"), "is empty"),
                Some(Value::Array(all)) => (0..all.len())
                    .filter(|&i| !all[i].is_object())
                    .for_each(|i| self.add(&format!("/{list}/{i}"), "is no object")),
                Some(_) => self.add(&format!("/{list}"), "is no array"),
            }
        }
        self.extensions();
        self.each("bufferViews", Finder::buffer_view);
        self.each("accessors", Finder::accessor);
        self.each("buffers", |finder, at, buffer| {
            finder.data_uri(at, buffer, &["application/octet-stream", "application/gltf-buffer"])
        });
        self.each("images", Finder::image);
        self.each("textures", |finder, at, texture| {
            finder.refers(at, texture, "source", "images");
            finder.refers(at, texture, "sampler", "samplers");
            for name in ["EXT_texture_webp", "KHR_texture_basisu"] {
                if let Some(Value::Object(webp)) = texture.get("extensions").and_then(|e| e.get(name)) {
                    finder.refers(&format!("{at}/extensions/{name}"), webp, "source", "images");
                }
            }
        });
        self.each("materials", |finder, at, material| finder.material(at, material));
    }

    fn add(&mut self, pointer: &str, what: &str) {
        self.faults.push(format!("{pointer} {what}"));
    }

    /// Looks at each object of a list.
    fn each(&mut self, list: &str, look: impl Fn(&mut Finder<'d>, &str, &'d Map<String, Value>)) {
        let all = self.document.json.get(list).and_then(Value::as_array).into_iter().flatten();
        for (i, value) in all.enumerate() {
            if let Value::Object(object) = value {
                look(self, &format!("/{list}/{i}"), object);
            }
        }
    }

    /// A reference to an object that is not there.
    fn refers(&mut self, at: &str, object: &Map<String, Value>, key: &str, list: &str) {
        let Some(value) = object.get(key) else { return };
        let all = self.document.json.get(list).and_then(Value::as_array).map_or(0, Vec::len);
        if value.as_u64().is_none_or(|index| index >= all as u64) {
            self.add(&format!("{at}/{key}"), &format!("refers to {list}[{value}], of {all}"));
        }
    }

    /// A number outside of `[least, most]`.
    fn within(&mut self, at: &str, object: &Map<String, Value>, key: &str, [least, most]: [f64; 2]) {
        // Of the same name are colours.
        if let Some(value) = object.get(key).and_then(Value::as_f64)
            && !(least..=most).contains(&value)
        {
            self.add(&format!("{at}/{key}"), &format!("is {value}, outside of {least} to {most}"));
        }
    }

    /// Extensions that are not declared, declared twice, or in a place where they mean nothing.
    fn extensions(&mut self) {
        let mut declared = BTreeSet::new();
        for list in ["extensionsUsed", "extensionsRequired"] {
            let names = self.document.json.get(list).and_then(Value::as_array).into_iter().flatten();
            let mut seen = BTreeSet::new();
            for (i, name) in names.enumerate().filter_map(|(i, name)| Some((i, name.as_str()?))) {
                declared.insert(name);
                if !seen.insert(name) {
                    self.add(&format!("/{list}/{i}"), &format!("names {name} again"));
                }
            }
        }
        let mut left = vec![(String::new(), String::new(), &self.document.json)];
        while let Some((at, place, value)) = left.pop() {
            let children: Vec<(String, String, &Value)> = match value {
                Value::Object(object) => object
                    .iter()
                    .filter(|(key, _)| *key != "extras")
                    .map(|(key, value)| (format!("{at}/{key}"), format!("{place}/{key}"), value))
                    .collect(),
                Value::Array(all) if all.iter().any(|v| v.is_object() || v.is_array()) => {
                    all.iter().enumerate().map(|(i, v)| (format!("{at}/{i}"), format!("{place}/*"), v)).collect()
                }
                _ => Vec::new(),
            };
            let extensions = value.get("extensions").and_then(Value::as_object);
            for name in extensions.into_iter().flat_map(Map::keys) {
                let pointer = format!("{at}/extensions/{name}");
                let right = PLACES.iter().find(|(known, _)| name.starts_with(known)).map(|p| p.1);
                // A variant is chosen by primitives, and named at the top.
                let right = if name == "KHR_materials_variants" { None } else { right };
                if !declared.contains(name.as_str()) {
                    self.add(&pointer, "is not declared in extensionsUsed");
                } else if right.is_some_and(|right| right != place) {
                    self.add(&pointer, "means nothing there");
                }
            }
            left.extend(children.into_iter().rev());
        }
    }

    fn buffer_view(&mut self, at: &str, view: &'d Map<String, Value>) {
        for key in ["buffer", "byteLength"] {
            if !view.contains_key(key) {
                self.add(at, &format!("has no {key}"));
            }
        }
        self.refers(at, view, "buffer", "buffers");
        let number = |key: &str| view.get(key).and_then(Value::as_u64);
        let buffer =
            number("buffer").and_then(|b| self.document.json.get("buffers")?.get(b as usize)?.get("byteLength"));
        let end = number("byteOffset").unwrap_or(0).saturating_add(number("byteLength").unwrap_or(0));
        if let Some(length) = buffer.and_then(Value::as_u64)
            && end > length
        {
            self.add(at, &format!("ends {} bytes after its buffer", end - length));
        }
        if let Some(stride) = number("byteStride") {
            if !(4..=252).contains(&stride) || stride % 4 != 0 {
                self.add(&format!("{at}/byteStride"), &format!("is {stride}, not a multiple of 4 from 4 to 252"));
            } else if number("byteLength").is_some_and(|length| stride > length) {
                self.add(&format!("{at}/byteStride"), &format!("is {stride}, more than there are bytes"));
            } else if number("target").is_some_and(|target| target != 34962) {
                self.add(&format!("{at}/byteStride"), "belongs to vertices alone");
            }
        }
    }

    fn accessor(&mut self, at: &str, accessor: &'d Map<String, Value>) {
        for key in ["componentType", "count", "type"] {
            if !accessor.contains_key(key) {
                self.add(at, &format!("has no {key}"));
            }
        }
        self.refers(at, accessor, "bufferView", "bufferViews");
        if accessor.contains_key("byteOffset") && !accessor.contains_key("bufferView") {
            self.add(&format!("{at}/byteOffset"), "has no bufferView to be in");
        }
        let component = accessor.get("componentType").and_then(Value::as_u64);
        if accessor.get("normalized") == Some(&Value::Bool(true)) && matches!(component, Some(5125 | 5126)) {
            self.add(&format!("{at}/normalized"), "is for integers of 8 or 16 bits");
        }
        let sparse = accessor.get("sparse");
        for part in ["indices", "values"] {
            if let Some(Value::Object(part_of)) = sparse.and_then(|s| s.get(part)) {
                self.refers(&format!("{at}/sparse/{part}"), part_of, "bufferView", "bufferViews");
            }
        }
        if sparse.is_none() {
            self.values(at, accessor);
        }
    }

    /// Values that are no numbers, or outside of what `min` and `max` say.
    fn values(&mut self, at: &str, accessor: &'d Map<String, Value>) {
        let number = |object: &Map<String, Value>, key: &str| object.get(key).and_then(Value::as_u64);
        let Some(view) = number(accessor, "bufferView")
            .and_then(|v| self.document.json.get("bufferViews")?.get(v as usize)?.as_object())
        else {
            return;
        };
        let Some(buffer) = number(view, "buffer").and_then(|b| self.document.buffers.get(b as usize)) else { return };
        let width = match accessor.get("type").and_then(Value::as_str) {
            Some("SCALAR") => 1,
            Some("VEC2") => 2,
            Some("VEC3") => 3,
            Some("VEC4") => 4,
            _ => return,
        };
        let Some(component) = number(accessor, "componentType") else { return };
        let bytes = match component {
            5120 | 5121 => 1,
            5122 | 5123 => 2,
            5125 | 5126 => 4,
            _ => return,
        };
        let bounds = |key: &str| -> Option<Vec<f64>> {
            let all = accessor.get(key)?.as_array()?;
            (all.len() == width).then(|| all.iter().map(|v| v.as_f64().unwrap_or(f64::NAN)).collect())
        };
        let [min, max] = ["min", "max"].map(bounds);
        if component != 5126 && min.is_none() && max.is_none() {
            return;
        }
        let stride = number(view, "byteStride").unwrap_or((width * bytes) as u64) as usize;
        let start = number(view, "byteOffset").unwrap_or(0).saturating_add(number(accessor, "byteOffset").unwrap_or(0));
        let Some(data) = usize::try_from(start).ok().and_then(|start| buffer.get(start..)) else { return };
        let count = number(accessor, "count").unwrap_or(0).min(1 + (data.len() / stride.max(1)) as u64) as usize;
        let value = |b: &[u8]| match component {
            5120 => f64::from(b[0] as i8),
            5121 => f64::from(b[0]),
            5122 => f64::from(i16::from_le_bytes([b[0], b[1]])),
            5123 => f64::from(u16::from_le_bytes([b[0], b[1]])),
            5125 => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            _ => f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        };
        let mut outside = 0usize;
        for i in 0..count {
            let Some(element) = data.get(i * stride..).and_then(|d| d.get(..width * bytes)) else { break };
            for (k, b) in element.chunks_exact(bytes).enumerate() {
                let v = value(b);
                if !v.is_finite() {
                    return self.add(at, &format!("holds a value that is no number, in element {i}"));
                }
                // Bounds are written in decimal, of floats.
                let low = min.as_ref().is_some_and(|min| v < min[k] && v < f64::from(min[k] as f32));
                let high = max.as_ref().is_some_and(|max| v > max[k] && v > f64::from(max[k] as f32));
                outside += usize::from(low || high);
            }
        }
        if outside > 0 {
            self.add(at, &format!("holds {outside} values outside of its min and max"));
        }
    }

    /// A data URI of another type than may stand there, or that cannot be decoded.
    fn data_uri(&mut self, at: &str, object: &Map<String, Value>, types: &[&str]) {
        let Some(uri) = object.get("uri").and_then(Value::as_str) else { return };
        let pointer = format!("{at}/uri");
        if !container::is_data_uri(uri) {
            let scheme = uri.split_once(':').map(|(scheme, _)| scheme);
            if scheme.is_some_and(|s| s.is_empty() || s.contains(['/', '?', '#'])) {
                self.add(&pointer, "is no URI");
            }
            return;
        }
        let (head, _) = uri.split_once(',').unwrap_or((uri, ""));
        let head = head.get("data:".len()..).unwrap_or_default();
        let mime = head.split(';').next().unwrap_or_default().to_ascii_lowercase();
        if !types.contains(&mime.as_str()) {
            self.add(&pointer, &format!("is of the type `{mime}`, not {}", types.join(" or ")));
        } else if head.split(';').skip(1).any(str::is_empty) {
            self.add(&pointer, "is no data URI");
        }
    }

    fn image(&mut self, at: &str, image: &'d Map<String, Value>) {
        const TYPES: [&str; 4] = ["image/png", "image/jpeg", "image/webp", "image/ktx2"];
        self.refers(at, image, "bufferView", "bufferViews");
        if image.contains_key("uri") == image.contains_key("bufferView") {
            self.add(at, "has to have one of uri and bufferView");
        }
        let before = self.faults.len();
        self.data_uri(at, image, &TYPES);
        if self.faults.len() > before {
            return;
        }
        let bytes = match image.get("uri").and_then(Value::as_str) {
            Some(uri) => match container::read_uri(&self.document.path, uri, at) {
                Ok(bytes) => Cow::Owned(bytes),
                Err(e) => return self.add(&format!("{at}/uri"), &format!("cannot be read: {e}")),
            },
            None => {
                let reader = Reader::new(self.document, Vec::new());
                let view = image.get("bufferView").and_then(Value::as_u64);
                let Some((bytes, _)) = view.and_then(|v| reader.view(v as usize, at).ok()) else { return };
                Cow::Borrowed(bytes)
            }
        };
        let is = match image::guess_format(&bytes) {
            Ok(image::ImageFormat::Png) => "image/png",
            Ok(image::ImageFormat::Jpeg) => "image/jpeg",
            Ok(image::ImageFormat::WebP) => "image/webp",
            _ if bytes.starts_with(b"\xABKTX 20\xBB") => return,
            _ => return self.add(at, "is no image that glTF knows"),
        };
        let uri = image.get("uri").and_then(Value::as_str).filter(|uri| container::is_data_uri(uri));
        let of_uri = uri.and_then(|uri| uri.get("data:".len()..)?.split([';', ',']).next());
        let says = image.get("mimeType").and_then(Value::as_str);
        if let Some(other) = [of_uri, says].into_iter().flatten().find(|mime| !mime.eq_ignore_ascii_case(is)) {
            self.add(at, &format!("is {is}, not {other} as it says"));
        }
        let used = self.document.json.get("extensionsUsed").and_then(Value::as_array);
        let webp = used.is_some_and(|used| used.iter().any(|name| name == "EXT_texture_webp"));
        if is == "image/webp" && !webp {
            self.add(at, "is WebP, which takes the extension EXT_texture_webp");
        }
        let reader = image::ImageReader::new(std::io::Cursor::new(&bytes)).with_guessed_format();
        if reader.is_ok_and(|reader| reader.into_dimensions().is_err()) {
            self.add(at, "is cut off or damaged");
        }
    }

    /// References to textures that are not there, and numbers out of their ranges.
    fn material(&mut self, at: &str, object: &'d Map<String, Value>) {
        for (key, low, high) in RANGES {
            self.within(at, object, key, [low, high]);
        }
        for (key, value) in object.iter().filter(|(key, _)| *key != "extras") {
            let Value::Object(inner) = value else { continue };
            let inside = format!("{at}/{key}");
            if key.ends_with("Texture") {
                self.refers(&inside, inner, "index", "textures");
            }
            self.material(&inside, inner);
        }
    }
}
