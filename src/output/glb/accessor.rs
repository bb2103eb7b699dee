//! Accessors as raw elements: copied byte by byte, never converted, so that quantised and normalised data,
//! and attributes nobody here knows, come through unchanged.

use crate::scene::gltf::Document;
use serde_json::{Map, Value};

/// A bounds-checked accessor.
pub(super) struct Accessor<'a> {
    /// The accessor's JSON.
    pub object: &'a Map<String, Value>,
    /// Bytes of one element, without what pads it to the next one.
    pub element: usize,
    /// Number of elements.
    pub count: usize,
    /// First element and distance between elements; `None`: all zero.
    data: Option<(&'a [u8], usize)>,
    /// Replaced elements, by index.
    sparse: Vec<(usize, &'a [u8])>,
}

impl<'a> Accessor<'a> {
    /// Accessor `index` of the document, with every element it promises inside its buffer.
    ///
    /// # Errors
    /// Object and fault.
    pub fn open(document: &'a Document, index: usize) -> Result<Accessor<'a>, String> {
        let broken = |what: &str| format!("accessor {index}: {what}");
        let object = document.json["accessors"][index].as_object().ok_or_else(|| broken("does not exist"))?;
        let element = element_size(object).ok_or_else(|| broken("has an unknown type"))?;
        let count = integer(object.get("count")).ok_or_else(|| broken("has no count"))?;
        let data = match integer(object.get("bufferView")) {
            None => None,
            Some(view) => {
                let offset = integer(object.get("byteOffset")).unwrap_or(0);
                let (bytes, stride) = view_bytes(document, view)?;
                let stride = stride.unwrap_or(element);
                let bytes = bytes.get(offset..).ok_or_else(|| broken("starts behind its bufferView"))?;
                let needed = (count.max(1) - 1).checked_mul(stride).and_then(|n| n.checked_add(element));
                if count > 0 && needed.is_none_or(|n| n > bytes.len()) {
                    return Err(broken("reaches beyond its bufferView"));
                }
                Some((bytes, stride))
            }
        };
        let sparse = match object.get("sparse") {
            None => Vec::new(),
            Some(sparse) => read_sparse(document, sparse, element)?
                .ok_or_else(|| broken("has sparse values outside their bufferViews"))?,
        };
        Ok(Accessor { object, element, count, data, sparse })
    }

    /// Appends the bytes of element `i` to `out`; false where there is no such element.
    pub fn copy_element(&self, i: usize, out: &mut Vec<u8>) -> bool {
        if i >= self.count {
            return false;
        }
        if let Ok(k) = self.sparse.binary_search_by_key(&i, |s| s.0) {
            out.extend_from_slice(self.sparse[k].1);
        } else if let Some((bytes, stride)) = self.data {
            out.extend_from_slice(&bytes[i * stride..i * stride + self.element]);
        } else {
            out.resize(out.len() + self.element, 0);
        }
        true
    }
}

/// Substituted elements, by index; `None` where something lies outside its view.
#[allow(clippy::type_complexity)]
fn read_sparse<'a>(
    document: &'a Document,
    sparse: &Value,
    element: usize,
) -> Result<Option<Vec<(usize, &'a [u8])>>, String> {
    let part = |name: &str| -> Result<Option<&'a [u8]>, String> {
        let Some(view) = integer(sparse[name].get("bufferView")) else { return Ok(None) };
        Ok(view_bytes(document, view)?.0.get(integer(sparse[name].get("byteOffset")).unwrap_or(0)..))
    };
    let (Some(count), Some(indices), Some(values)) = (integer(sparse.get("count")), part("indices")?, part("values")?)
    else {
        return Ok(None);
    };
    let Some(width) = component_size(&sparse["indices"]["componentType"]) else { return Ok(None) };
    let mut list: Vec<(usize, &[u8])> =
        indices.chunks_exact(width).map(little_endian).zip(values.chunks_exact(element)).take(count).collect();
    // The file promises ascending indices; sorting costs nothing and trusts nobody.
    list.sort_by_key(|s| s.0);
    Ok(Some(list).filter(|l| l.len() == count))
}

fn little_endian(bytes: &[u8]) -> usize {
    bytes.iter().rev().fold(0, |n, &b| n << 8 | usize::from(b))
}

/// Bytes of a bufferView and its stride.
fn view_bytes(document: &Document, index: usize) -> Result<(&[u8], Option<usize>), String> {
    let view = &document.json["bufferViews"][index];
    let slice = || {
        let buffer = document.buffers.get(integer(view.get("buffer"))?)?;
        let start = integer(view.get("byteOffset")).unwrap_or(0);
        buffer.get(start..start.checked_add(integer(view.get("byteLength"))?)?)
    };
    let bytes = slice().ok_or_else(|| format!("bufferView {index} is outside its buffer"))?;
    Ok((bytes, integer(view.get("byteStride")).filter(|&s| s > 0)))
}

/// A non-negative integer, also where a writer spelled it `3.0`.
pub(super) fn integer(value: Option<&Value>) -> Option<usize> {
    let value = value?;
    let number = value.as_u64().or_else(|| value.as_f64().filter(|v| v.fract() == 0.0 && *v >= 0.0).map(|v| v as u64));
    number.and_then(|n| usize::try_from(n).ok())
}

fn component_size(component_type: &Value) -> Option<usize> {
    match integer(Some(component_type))? {
        5120 | 5121 => Some(1),
        5122 | 5123 => Some(2),
        5125 | 5126 => Some(4),
        _ => None,
    }
}

/// Bytes of one element. Columns of matrices start at multiples of 4 bytes (glTF 2.0, section 3.6.2.4).
fn element_size(accessor: &Map<String, Value>) -> Option<usize> {
    let component = component_size(accessor.get("componentType")?)?;
    let (columns, rows) = match accessor.get("type")?.as_str()? {
        "SCALAR" => (1, 1),
        "VEC2" => (1, 2),
        "VEC3" => (1, 3),
        "VEC4" => (1, 4),
        "MAT2" => (2, 2),
        "MAT3" => (3, 3),
        "MAT4" => (4, 4),
        _ => return None,
    };
    let column = rows * component;
    Some(if columns == 1 { column } else { columns * column.next_multiple_of(4) })
}

/// Smallest and largest value per component of vectors stored every `stride` bytes, as the raw numbers of the
/// file; `None` for matrices.
pub(super) fn bounds(accessor: &Map<String, Value>, data: &[u8], stride: usize) -> Option<[Vec<Value>; 2]> {
    let component_type = integer(accessor.get("componentType"))?;
    let size = component_size(accessor.get("componentType")?)?;
    let components = element_size(accessor)? / size;
    if accessor.get("type")?.as_str()?.starts_with("MAT") {
        return None;
    }
    let mut range = vec![[f64::INFINITY, f64::NEG_INFINITY]; components];
    for element in data.chunks(stride) {
        for (bytes, range) in element.chunks_exact(size).zip(&mut range) {
            let raw = little_endian(bytes);
            let value = match component_type {
                5120 => f64::from(raw as u8 as i8),
                5122 => f64::from(raw as u16 as i16),
                5126 => f64::from(f32::from_bits(raw as u32)),
                _ => raw as f64,
            };
            *range = [range[0].min(value), range[1].max(value)];
        }
    }
    let number = |v: f64| if component_type == 5126 { Value::from(v) } else { Value::from(v as i64) };
    Some([0, 1].map(|side| range.iter().map(|r| number(r[side])).collect()))
}
