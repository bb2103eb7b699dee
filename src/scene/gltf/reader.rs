//! What all readers share: checked access to the JSON's objects, and the warnings found on the way.

use super::area::PANELS;
use super::ies::PROFILES;
use super::image_based::SURROUNDINGS;
use super::{Document, container};
use crate::error::{SceneError, Warning};
use serde::Deserialize;
use serde_json::Value;
use std::borrow::Cow;

/// Most accessor elements (vertices, indices) one file may make us read: 2^28. A small file can refer to the
/// same data any number of times, so its size alone bounds nothing.
const MAX_ELEMENTS: u64 = 1 << 28;

/// How to mend a file that contradicts the specification.
pub(super) const REPAIR: &str = "export the file again, or find the fault with the glTF validator";

/// Reads objects of one document.
pub(super) struct Reader<'d> {
    pub(super) document: &'d Document,
    pub(super) warnings: Vec<Warning>,
    /// Index of the variant whose materials are read; `None`: those that primitives name themselves.
    pub(super) variant: Option<usize>,
    elements_left: u64,
}

impl<'d> Reader<'d> {
    pub(super) fn new(document: &'d Document, warnings: Vec<Warning>) -> Reader<'d> {
        Reader { document, warnings, variant: None, elements_left: MAX_ELEMENTS }
    }

    /// An error that names the file.
    pub(super) fn invalid(&self, what: impl Into<String>) -> SceneError {
        SceneError::Invalid { path: self.document.path.clone(), what: what.into() }
    }

    pub(super) fn warn(&mut self, code: &'static str, message: impl Into<String>) {
        self.warnings.push(Warning::new(code, message));
    }

    /// Takes `count` elements from what this file may make us read.
    pub(super) fn take_elements(&mut self, count: u64, label: &str) -> Result<(), SceneError> {
        match self.elements_left.checked_sub(count) {
            Some(left) => {
                self.elements_left = left;
                Ok(())
            }
            None => Err(self.invalid(format!(
                "{label}: with it the scene has more than {MAX_ELEMENTS} vertices and indices; split the scene"
            ))),
        }
    }

    /// The top-level array `list`, empty where the file has none. `lights` are those of KHR_lights_punctual,
    /// [`PROFILES`] those of EXT_lights_ies, [`SURROUNDINGS`] those of EXT_lights_image_based,
    /// [`PANELS`] those of EXT_lights_area.
    pub(super) fn list(&self, list: &str) -> Result<&'d [Value], SceneError> {
        let found = match list {
            "lights" => self.document.json.pointer("/extensions/KHR_lights_punctual/lights"),
            PROFILES => self.document.json.pointer("/extensions/EXT_lights_ies/lights"),
            SURROUNDINGS => self.document.json.pointer("/extensions/EXT_lights_image_based/lights"),
            PANELS => self.document.json.pointer("/extensions/EXT_lights_area/lights"),
            _ => self.document.json.get(list),
        };
        match found {
            None => Ok(&[]),
            Some(Value::Array(a)) => Ok(a),
            Some(_) => Err(self.invalid(format!("its `{list}` is not an array; {REPAIR}"))),
        }
    }

    /// The JSON of an object that `by` refers to.
    pub(super) fn value(&self, list: &str, index: usize, by: &str) -> Result<&'d Value, SceneError> {
        let all = self.list(list)?;
        all.get(index).ok_or_else(|| {
            self.invalid(format!("{by} refers to {list}[{index}], but the file has only {}; {REPAIR}", all.len()))
        })
    }

    /// Bytes of the image `raw`, which `label` names; `None` where it has neither a bufferView nor a uri.
    pub(super) fn image_bytes(&self, raw: &'d Value, label: &str) -> Result<Option<Cow<'d, [u8]>>, SceneError> {
        match (raw.get("bufferView").and_then(Value::as_u64), raw.get("uri").and_then(Value::as_str)) {
            (Some(view), _) => {
                let view = usize::try_from(view).unwrap_or(usize::MAX);
                Ok(Some(Cow::Borrowed(self.view(view, label)?.0)))
            }
            (None, Some(uri)) => container::read_uri(&self.document.path, uri, label).map(|bytes| Some(bytes.into())),
            (None, None) => Ok(None),
        }
    }

    /// The same as one of the crate's types.
    pub(super) fn object<T: Deserialize<'d>>(&self, list: &str, index: usize, by: &str) -> Result<T, SceneError> {
        T::deserialize(self.value(list, index, by)?)
            .map_err(|e| self.invalid(format!("{}: {e}; {REPAIR}", self.label(list, index))))
    }

    /// How messages call an object: its place in the JSON and its name, if it has one.
    pub(super) fn label(&self, list: &str, index: usize) -> String {
        match self.name(list, index) {
            Some(name) => format!("{list}[{index}] '{name}'"),
            None => format!("{list}[{index}]"),
        }
    }

    /// The name of an object, if it has one.
    pub(super) fn name(&self, list: &str, index: usize) -> Option<&'d str> {
        let name = self.list(list).ok()?.get(index)?.get("name")?.as_str()?;
        (!name.is_empty()).then_some(name)
    }

    /// The extras of an object under the key `evenlight`.
    pub(super) fn extras(&self, list: &str, index: usize) -> Option<&'d Value> {
        self.list(list).ok()?.get(index)?.get("extras")?.get("evenlight")
    }
}
