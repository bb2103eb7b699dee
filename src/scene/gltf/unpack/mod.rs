//! From glTF with compressed or instanced geometry to plain glTF.
//!
//! In: a document as read. Out: the same document without the extensions that only pack it: their data stands in
//! one more buffer, and nothing refers to them any more. The scene is read from it, and it is what is written
//! back, so that neither needs to know of them.

mod draco;
mod instances;
pub(super) mod meshopt;

use super::Document;
use super::reader::REPAIR;
use crate::error::{SceneError, Warning};
use serde_json::{Value, json};

/// Most bytes that a file may be unpacked to: 1 GiB. A stream can stand for a thousand times its own size, and
/// many views for the same stream.
const MOST_BYTES: u64 = 1 << 30;

/// Extensions that are unpacked.
pub(super) const SUPPORTED: &[&str] =
    &["EXT_meshopt_compression", "KHR_meshopt_compression", draco::NAME, instances::NAME];

/// Unpacks a document; adds to `warnings`.
///
/// # Errors
/// [`SceneError::Invalid`] names the object that cannot be unpacked.
pub(super) fn unpack(document: &mut Document, warnings: &mut Vec<Warning>) -> Result<(), SceneError> {
    let path = document.path.clone();
    let mut packed = Packed::new(document);
    // A Draco stream may itself lie in a compressed view, and so may the places of instances.
    meshopt::unpack(&mut packed)
        .and_then(|()| draco::unpack(&mut packed))
        .map(|()| packed.finish())
        .map_err(|what| SceneError::Invalid { path, what: format!("{what}; {REPAIR}") })?;
    instances::unpack(document, warnings)
}

/// A document while it is unpacked.
struct Packed<'a> {
    document: &'a mut Document,
    /// Index of the buffer that unpacked data will have.
    buffer: usize,
    /// Contents of that buffer.
    data: Vec<u8>,
    bytes_left: u64,
}

impl<'a> Packed<'a> {
    fn new(document: &'a mut Document) -> Packed<'a> {
        let buffer = document.buffers.len();
        Packed { document, buffer, data: Vec::new(), bytes_left: MOST_BYTES }
    }

    /// Number of objects in a list of the document.
    fn count(&self, list: &str) -> usize {
        self.document.json.get(list).and_then(Value::as_array).map_or(0, Vec::len)
    }

    /// Takes `size` bytes from what this file may be unpacked to.
    fn take_bytes(&mut self, size: u64, label: &str) -> Result<(), String> {
        let left = self.bytes_left.checked_sub(size).ok_or_else(|| format!("{label}: {}", too_large()))?;
        self.bytes_left = left;
        Ok(())
    }

    /// The bytes that an object's `buffer`, `byteOffset` and `byteLength` mean.
    fn range(&self, object: &Value, label: &str) -> Result<&[u8], String> {
        let get = |key| number(object, key).and_then(|n| usize::try_from(n).ok());
        let bytes = || {
            let buffer = get("buffer")?;
            let buffer = if buffer == self.buffer { &self.data } else { self.document.buffers.get(buffer)? };
            let start = if object.get("byteOffset").is_some() { get("byteOffset")? } else { 0 };
            buffer.get(start..start.checked_add(get("byteLength")?)?)
        };
        bytes().ok_or_else(|| format!("{label}: its compressed data lies outside its buffer"))
    }

    /// Appends unpacked data; returns where it starts in its buffer, at a multiple of 8.
    fn append(&mut self, data: &[u8]) -> usize {
        self.data.resize(self.data.len().next_multiple_of(8), 0);
        let at = self.data.len();
        self.data.extend_from_slice(data);
        at
    }

    /// Adds the buffer to the document, where there is anything in it.
    fn finish(self) {
        if self.data.is_empty() {
            return;
        }
        push(&mut self.document.json, "buffers", json!({ "byteLength": self.data.len() }));
        self.document.buffers.push(self.data);
    }
}

/// What is said where [`MOST_BYTES`] are exceeded.
fn too_large() -> String {
    format!("with it the file unpacks to more than {} MiB; split the scene", MOST_BYTES >> 20)
}

/// Appends to a list of the document; returns the index.
fn push(json: &mut Value, list: &str, value: Value) -> usize {
    let Some(root) = json.as_object_mut() else { return 0 };
    let Some(list) = root.entry(list).or_insert_with(|| json!([])).as_array_mut() else { return 0 };
    list.push(value);
    list.len() - 1
}

/// A number from 0 under a key of an object.
fn number(object: &Value, key: &str) -> Option<u64> {
    object.get(key)?.as_u64()
}

/// Removes an extension from an object, and `extensions` with the last one.
pub(crate) fn take_extension(object: &mut Value, name: &str) -> Option<Value> {
    let object = object.as_object_mut()?;
    let extensions = object.get_mut("extensions")?.as_object_mut()?;
    let taken = extensions.shift_remove(name);
    if extensions.is_empty() {
        object.shift_remove("extensions");
    }
    taken
}

/// Removes an extension that nothing uses any more from the root of the document.
pub(crate) fn drop_extension(json: &mut Value, name: &str) {
    take_extension(json, name);
    let Some(root) = json.as_object_mut() else { return };
    for list in ["extensionsUsed", "extensionsRequired"] {
        if let Some(names) = root.get_mut(list).and_then(Value::as_array_mut) {
            names.retain(|n| n != name);
            if names.is_empty() {
                root.shift_remove(list);
            }
        }
    }
}
