//! Faults of a file that stand in nobody's way: in objects that nothing uses, or of no consequence to a bake. Whoever
//! reads the file next may be less patient, so they are warned of, by their JSON pointer.
//!
//! The rules are those of glTF 2.0 and its extensions that readers do not check themselves.

use super::{Document, Reader, container};
use crate::error::{SceneError, Warning};
use image::{ImageFormat, ImageReader};
use serde_json::{Map, Value};
use std::collections::BTreeSet;
use std::io::{BufRead, Cursor, Seek};

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

/// The list whose objects an extension belongs to, if to those of one alone.
fn list_of(extension: &str) -> Option<&'static str> {
    match extension {
        // Chosen by primitives, and named at the top.
        "KHR_materials_variants" => None,
        "EXT_texture_webp" | "KHR_texture_basisu" => Some("textures"),
        _ => extension.starts_with("KHR_materials_").then_some("materials"),
    }
}

/// Whether the pointer `at` is that of an object of `list`.
fn is_object_of(list: &str, at: &str) -> bool {
    let index = at.strip_prefix('/').and_then(|at| at.strip_prefix(list)?.strip_prefix('/'));
    index.is_some_and(|index| !index.contains('/'))
}

/// What a data URI says its data is, and whether that is well-formed; `None` for other URIs.
fn type_of_data(uri: &str) -> Option<(String, bool)> {
    let head = container::data_of(uri)?.split(',').next().unwrap_or_default();
    let mut parts = head.split(';');
    let mime = parts.next().unwrap_or_default().to_ascii_lowercase();
    Some((mime, !parts.any(str::is_empty)))
}

/// Type of an image, and whether its head tells its size; `None` where glTF does not know it. That of KTX2 is not read.
fn look(mut from: impl BufRead + Seek) -> Option<(&'static str, bool)> {
    if from.fill_buf().is_ok_and(|head| head.starts_with(b"\xABKTX 20\xBB")) {
        return Some(("image/ktx2", true));
    }
    let reader = ImageReader::new(from).with_guessed_format().ok()?;
    let is = match reader.format()? {
        ImageFormat::Png => "image/png",
        ImageFormat::Jpeg => "image/jpeg",
        ImageFormat::WebP => "image/webp",
        _ => return None,
    };
    Some((is, reader.into_dimensions().is_ok()))
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
        self.each("bufferViews", |finder, _, at, view| finder.buffer_view(at, view));
        self.each("accessors", Finder::accessor);
        self.each("buffers", |finder, _, at, buffer| {
            finder.data_uri(at, buffer, &["application/octet-stream", "application/gltf-buffer"])
        });
        self.each("images", Finder::image);
        self.each("textures", |finder, _, at, texture| {
            finder.refers(at, texture, "source", "images");
            finder.refers(at, texture, "sampler", "samplers");
            for name in ["EXT_texture_webp", "KHR_texture_basisu"] {
                if let Some(Value::Object(webp)) = texture.get("extensions").and_then(|e| e.get(name)) {
                    finder.refers(&format!("{at}/extensions/{name}"), webp, "source", "images");
                }
            }
        });
        self.each("materials", |finder, _, at, material| finder.material(at, material));
    }

    fn add(&mut self, pointer: &str, what: &str) {
        self.faults.push(format!("{pointer} {what}"));
    }

    /// Looks at each object of a list.
    fn each(&mut self, list: &str, look: impl Fn(&mut Finder<'d>, usize, &str, &'d Map<String, Value>)) {
        let all = self.document.json.get(list).and_then(Value::as_array).into_iter().flatten();
        for (i, object) in all.enumerate().filter_map(|(i, value)| Some((i, value.as_object()?))) {
            look(self, i, &format!("/{list}/{i}"), object);
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
        let mut left = vec![(String::new(), &self.document.json)];
        while let Some((at, value)) = left.pop() {
            let extensions = value.get("extensions").and_then(Value::as_object);
            for name in extensions.into_iter().flat_map(Map::keys) {
                let pointer = format!("{at}/extensions/{name}");
                if !declared.contains(name.as_str()) {
                    self.add(&pointer, "is not declared in extensionsUsed");
                } else if list_of(name).is_some_and(|list| !is_object_of(list, &at)) {
                    self.add(&pointer, "means nothing there");
                }
            }
            let mut children: Vec<(String, &Value)> = match value {
                Value::Object(object) => {
                    let inner = object.iter().filter(|(key, _)| *key != "extras");
                    inner.map(|(key, value)| (format!("{at}/{key}"), value)).collect()
                }
                Value::Array(all) => all.iter().enumerate().map(|(i, value)| (format!("{at}/{i}"), value)).collect(),
                _ => Vec::new(),
            };
            children.retain(|(_, value)| value.is_object() || value.is_array());
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

    fn accessor(&mut self, index: usize, at: &str, accessor: &'d Map<String, Value>) {
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
            self.values(index, at, accessor);
        }
    }

    /// Values that are no numbers, or outside of what `min` and `max` say.
    fn values(&mut self, index: usize, at: &str, accessor: &'d Map<String, Value>) {
        let bounds = |key: &str| -> Vec<f64> {
            let all = accessor.get(key).and_then(Value::as_array).into_iter().flatten();
            all.map(|v| v.as_f64().unwrap_or(f64::NAN)).collect()
        };
        let [min, max] = ["min", "max"].map(bounds);
        let floats = accessor.get("componentType").and_then(Value::as_u64) == Some(5126);
        if !floats && min.is_empty() && max.is_empty() {
            return;
        }
        let mut outside = 0usize;
        for (i, c, v) in Reader::new(self.document, Vec::new()).stored(index) {
            if !v.is_finite() {
                return self.add(at, &format!("holds a value that is no number, in element {i}"));
            }
            // Bounds are written in decimal, of floats.
            let low = min.get(c).is_some_and(|&min| v < min && v < f64::from(min as f32));
            let high = max.get(c).is_some_and(|&max| v > max && v > f64::from(max as f32));
            outside += usize::from(low || high);
        }
        if outside > 0 {
            self.add(at, &format!("holds {outside} values outside of its min and max"));
        }
    }

    /// A data URI of another type than may stand there, or that cannot be decoded.
    fn data_uri(&mut self, at: &str, object: &Map<String, Value>, types: &[&str]) {
        let Some(uri) = object.get("uri").and_then(Value::as_str) else { return };
        let pointer = format!("{at}/uri");
        let Some((mime, well_formed)) = type_of_data(uri) else {
            let scheme = uri.split_once(':').map(|(scheme, _)| scheme);
            if scheme.is_some_and(|s| s.is_empty() || s.contains(['/', '?', '#'])) {
                self.add(&pointer, "is no URI");
            }
            return;
        };
        if !types.contains(&mime.as_str()) {
            self.add(&pointer, &format!("is of the type `{mime}`, not {}", types.join(" or ")));
        } else if !well_formed {
            self.add(&pointer, "is no data URI");
        }
    }

    fn image(&mut self, index: usize, at: &str, image: &'d Map<String, Value>) {
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
        let uri = image.get("uri").and_then(Value::as_str);
        let unreadable = |e: SceneError| format!("cannot be read: {e}");
        // Of a file only the head is looked at: whoever uses it reads it whole.
        let looked = match uri.filter(|uri| !container::is_data_uri(uri)) {
            Some(uri) => {
                let file = container::file_of_uri(&self.document.path, uri, at);
                file.and_then(|file| container::open_file(&file)).map_err(unreadable).map(look)
            }
            None => {
                match Reader::new(self.document, Vec::new()).image_bytes(&self.document.json["images"][index], at) {
                    Ok(Some(bytes)) => Ok(look(Cursor::new(bytes))),
                    Err(e) if uri.is_some() => Err(unreadable(e)),
                    _ => return,
                }
            }
        };
        let (is, is_whole) = match looked {
            Ok(Some(looked)) => looked,
            Ok(None) => return self.add(at, "is no image that glTF knows"),
            Err(what) => return self.add(&format!("{at}/uri"), &what),
        };
        if is == "image/ktx2" {
            return;
        }
        let of_uri = uri.and_then(type_of_data).map(|(mime, _)| mime);
        let says = image.get("mimeType").and_then(Value::as_str);
        if let Some(other) = [of_uri.as_deref(), says].into_iter().flatten().find(|mime| !mime.eq_ignore_ascii_case(is))
        {
            self.add(at, &format!("is {is}, not {other} as it says"));
        }
        let used = self.document.json.get("extensionsUsed").and_then(Value::as_array);
        let webp = used.is_some_and(|used| used.iter().any(|name| name == "EXT_texture_webp"));
        if is == "image/webp" && !webp {
            self.add(at, "is WebP, which takes the extension EXT_texture_webp");
        }
        if !is_whole {
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
