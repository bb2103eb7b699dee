//! The GLB file around the patched JSON: one BIN chunk out of all buffers, new data and embedded images.
//!
//! Indices never change: the bytes of old bufferViews are copied range by range and the views re-based, data
//! that no view reaches any more is dropped, and new views take the numbers of dropped ones first.

use super::accessor::integer;
use super::{items, items_mut};
use crate::error::BakeError;
use crate::scene::IesProfile;
use crate::scene::gltf::Document;
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Bytes for a bufferView of their own.
pub(super) struct Blob {
    /// The bytes.
    pub data: Vec<u8>,
    /// Distance between vertices where they are padded.
    pub stride: Option<usize>,
    /// 34962 for vertices, 34963 for indices, none for images.
    pub target: Option<u32>,
}

/// Numbers the views of new data.
pub(super) struct ViewSlots {
    /// Views whose data is no longer used.
    pub dead: Vec<usize>,
    /// Number of views in the document as read.
    pub old_count: usize,
}

impl ViewSlots {
    /// Index of the view that holds blob `k`.
    pub fn slot(&self, k: usize) -> usize {
        self.dead.get(k).copied().unwrap_or(self.old_count + k.saturating_sub(self.dead.len()))
    }
}

/// The whole GLB file.
///
/// # Errors
/// [`BakeError::Limit`] beyond the 4 GiB that the format can hold.
pub(super) fn assemble(
    mut json: Value,
    document: &Document,
    slots: &ViewSlots,
    blobs: &[Blob],
) -> Result<Vec<u8>, BakeError> {
    let dead = &slots.dead[..slots.dead.len().min(blobs.len())];
    let mut bin = rebase(&mut json, document, dead);
    for (k, blob) in blobs.iter().enumerate() {
        bin.resize(bin.len().next_multiple_of(ALIGNMENT), 0);
        let mut view = json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": blob.data.len() });
        if let Some(stride) = blob.stride {
            view["byteStride"] = stride.into();
        }
        if let Some(target) = blob.target {
            view["target"] = target.into();
        }
        bin.extend_from_slice(&blob.data);
        put(&mut json, "bufferViews", slots.slot(k), view);
    }
    bin.resize(bin.len().next_multiple_of(4), 0);
    if !bin.is_empty() {
        json["buffers"][0]["byteLength"] = bin.len().into();
    } else if let Some(json) = json.as_object_mut() {
        json.shift_remove("buffers");
    }
    container(&json, &bin)
}

/// Offsets in the BIN chunk are multiples of this: enough for any component type and for 8-byte readers.
const ALIGNMENT: usize = 8;

/// Sets element `index` of a list of the document, appending where it is the next one.
pub(super) fn put(json: &mut Value, list: &str, index: usize, value: Value) {
    let Some(root) = json.as_object_mut() else { return };
    if let Some(list) = root.entry(list).or_insert_with(|| Value::Array(Vec::new())).as_array_mut() {
        if index < list.len() { list[index] = value } else { list.push(value) }
    }
}

/// Joins the buffers into one: returns its bytes and makes all views point into it.
fn rebase(json: &mut Value, document: &Document, dead: &[usize]) -> Vec<u8> {
    // Ranges of bytes still in use, per buffer.
    let mut live: BTreeMap<usize, Vec<[usize; 2]>> = BTreeMap::new();
    let dead: BTreeSet<usize> = dead.iter().copied().collect();
    for (_, view) in items(json, "bufferViews").enumerate().filter(|(i, _)| !dead.contains(i)) {
        let Some(buffer) = integer(view.get("buffer")) else { continue };
        let Some(bytes) = document.buffers.get(buffer).filter(|b| !b.is_empty()) else { continue };
        let start = integer(view.get("byteOffset")).unwrap_or(0).min(bytes.len());
        let length = integer(view.get("byteLength")).unwrap_or(0);
        live.entry(buffer).or_default().push([start, start.saturating_add(length).min(bytes.len())]);
    }
    let mut bin = Vec::new();
    // Start in the old buffer, start in the new one; ascending.
    let mut moved: BTreeMap<usize, Vec<[usize; 2]>> = BTreeMap::new();
    for (&buffer, ranges) in &mut live {
        for [start, end] in union(ranges) {
            // The same alignment as before.
            let padding = (start % ALIGNMENT + ALIGNMENT - bin.len() % ALIGNMENT) % ALIGNMENT;
            bin.resize(bin.len() + padding, 0);
            moved.entry(buffer).or_default().push([start, bin.len()]);
            bin.extend_from_slice(&document.buffers[buffer][start..end]);
        }
    }
    join_buffers(json);
    items_mut(json, "bufferViews").for_each(|view| move_range(view, &moved));
    bin
}

/// Overlapping and touching ranges made one; ascending.
fn union(ranges: &mut [[usize; 2]]) -> Vec<[usize; 2]> {
    ranges.sort_unstable();
    let mut union: Vec<[usize; 2]> = Vec::new();
    for &[start, end] in ranges.iter() {
        match union.last_mut() {
            Some(last) if start <= last[1] => last[1] = last[1].max(end),
            _ => union.push([start, end]),
        }
    }
    union
}

/// Leaves one buffer, for the BIN chunk.
fn join_buffers(json: &mut Value) {
    let mut first = items(json, "buffers").next().and_then(Value::as_object).cloned().unwrap_or_default();
    first.shift_remove("uri");
    if let Some(json) = json.as_object_mut() {
        json.insert("buffers".into(), json!([first]));
    }
}

/// Lets a view of an old buffer point to where its bytes are now.
fn move_range(range: &mut Value, moved: &BTreeMap<usize, Vec<[usize; 2]>>) {
    let Some(buffer) = integer(range.get("buffer")) else { return };
    let start = integer(range.get("byteOffset")).unwrap_or(0);
    let ranges = moved.get(&buffer).map_or(&[][..], Vec::as_slice);
    let before = ranges.partition_point(|r| r[0] <= start);
    if let Some([old, new]) = before.checked_sub(1).map(|k| ranges[k]) {
        range["buffer"] = 0.into();
        range["byteOffset"] = (start - old + new).into();
    }
}

/// Header, JSON chunk and BIN chunk (glTF 2.0, section 4.4).
fn container(json: &Value, bin: &[u8]) -> Result<Vec<u8>, BakeError> {
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let bin_size = if bin.is_empty() { 0 } else { 8 + bin.len() };
    let size = 12 + 8 + text.len() + bin_size;
    let limit = || BakeError::Limit {
        what: "the scene with its lightmap UVs",
        asked: format!("{size} bytes"),
        allowed: format!("{} bytes of a GLB file", u32::MAX),
        cure: "bake the scene in parts, or keep its images outside".into(),
    };
    let size = u32::try_from(size).map_err(|_| limit())?;
    let mut out = Vec::with_capacity(size as usize);
    let word = |out: &mut Vec<u8>, v: u32| out.extend_from_slice(&v.to_le_bytes());
    out.extend_from_slice(b"glTF");
    word(&mut out, 2);
    word(&mut out, size);
    word(&mut out, text.len() as u32);
    out.extend_from_slice(b"JSON");
    out.extend_from_slice(&text);
    if !bin.is_empty() {
        word(&mut out, bin.len() as u32);
        out.extend_from_slice(b"BIN\0");
        out.extend_from_slice(bin);
    }
    Ok(out)
}

/// Turns images that lie beside the document into blobs, so that the GLB stands alone. Data URIs stay; so do
/// images that cannot be read or are none, each with a message. `view_of` numbers the blobs' views.
pub(super) fn embed_images(
    json: &mut Value,
    folder: &Path,
    blobs: &mut Vec<Blob>,
    view_of: impl Fn(usize) -> usize,
) -> (usize, Vec<String>) {
    let (mut embedded, mut left) = (0, Vec::new());
    for (i, image) in items_mut(json, "images").enumerate() {
        let Some(image) = image.as_object_mut() else { continue };
        let Some(uri) = image.get("uri").and_then(Value::as_str).map(str::to_owned) else { continue };
        if uri.starts_with("data:") {
            continue;
        }
        match read_image(folder, &uri) {
            Ok((data, mime_type)) => {
                place_in_view(image, view_of(blobs.len()), mime_type, &uri);
                blobs.push(Blob { data, stride: None, target: None });
                embedded += 1;
            }
            Err(why) => left.push(format!("image {i} stays outside the written scene: {uri}: {why}")),
        }
    }
    (embedded, left)
}

/// The same for the profiles of EXT_lights_ies.
pub(super) fn embed_profiles(
    json: &mut Value,
    folder: &Path,
    blobs: &mut Vec<Blob>,
    view_of: impl Fn(usize) -> usize,
) -> Vec<String> {
    let mut left = Vec::new();
    let profiles = json.pointer_mut("/extensions/EXT_lights_ies/lights").and_then(Value::as_array_mut);
    for profile in profiles.into_iter().flatten().filter_map(Value::as_object_mut) {
        let Some(uri) = profile.get("uri").and_then(Value::as_str).map(str::to_owned) else { continue };
        if uri.starts_with("data:") {
            continue;
        }
        match read_profile(folder, &uri) {
            Ok(data) => {
                place_in_view(profile, view_of(blobs.len()), "application/x-ies-lm-63", &uri);
                blobs.push(Blob { data, stride: None, target: None });
            }
            Err(why) => left.push(format!("IES profile {uri} stays outside the written scene: {why}")),
        }
    }
    left
}

/// A file that is an IES profile and needs no other.
fn read_profile(folder: &Path, uri: &str) -> Result<Vec<u8>, String> {
    let name = percent_encoding::percent_decode_str(uri).decode_utf8().map_err(|e| e.to_string())?;
    let bytes = std::fs::read(folder.join(name.as_ref())).map_err(|e| e.to_string())?;
    IesProfile::from_bytes(Path::new(uri), &bytes, None).map_err(|e| e.to_string())?;
    Ok(bytes)
}

fn place_in_view(image: &mut Map<String, Value>, view: usize, mime_type: &str, uri: &str) {
    image.shift_remove("uri");
    image.insert("bufferView".into(), view.into());
    image.insert("mimeType".into(), mime_type.into());
    if !image.contains_key("name") {
        image.insert("name".into(), uri.into());
    }
}

fn read_image(folder: &Path, uri: &str) -> Result<(Vec<u8>, &'static str), String> {
    let name = percent_encoding::percent_decode_str(uri).decode_utf8().map_err(|e| e.to_string())?;
    let bytes = std::fs::read(folder.join(name.as_ref())).map_err(|e| e.to_string())?;
    // Told by content, not by name: a document must not pull other files into the output.
    let mime_type = match bytes.as_slice() {
        [0x89, b'P', b'N', b'G', ..] => "image/png",
        [0xff, 0xd8, 0xff, ..] => "image/jpeg",
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => "image/webp",
        [0xab, b'K', b'T', b'X', b' ', b'2', b'0', ..] => "image/ktx2",
        _ => return Err("neither PNG, JPEG, WebP nor KTX2".into()),
    };
    Ok((bytes, mime_type))
}
