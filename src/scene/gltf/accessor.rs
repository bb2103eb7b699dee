//! Accessors as arrays of numbers, every bound checked: interleaved, sparse, normalised and quantised
//! (KHR_mesh_quantization needs nothing more than integer components, which are read everywhere).

use super::reader::{REPAIR, Reader};
use crate::error::SceneError;
use gltf::json;
use json::accessor::{ComponentType, Type};
use json::validation::Checked;

/// What an element without data counts for in the limit on elements: 16, so that at most 2^24 are filled in.
const ZERO_COST: u64 = 16;

/// Elements laid out in bytes: element `i` starts at `i * stride`. All `count` elements lie within `bytes`.
#[derive(Clone, Copy)]
struct Elements<'d> {
    bytes: &'d [u8],
    stride: usize,
}

/// A checked accessor.
struct Accessor<'d> {
    label: String,
    count: usize,
    components: usize,
    component: ComponentType,
    normalized: bool,
    /// `None`: all zero.
    base: Option<Elements<'d>>,
    /// Elements that replace those of `base`: their indices, all below `count`, and values.
    sparse: Option<(Vec<u32>, Elements<'d>)>,
}

impl<'d> Reader<'d> {
    /// Vectors of an accessor as floats: integers as numbers, or scaled to [-1, 1] or [0, 1] where normalised.
    /// It must have one of the `allowed` numbers of components; those it lacks of `N` are `fill`.
    pub(super) fn vectors<const N: usize>(
        &mut self,
        index: usize,
        allowed: &[usize],
        fill: f32,
        by: &str,
    ) -> Result<Vec<[f32; N]>, SceneError> {
        let a = self.accessor(index, by)?;
        if !allowed.contains(&a.components) {
            let what = format!("{by}: {} has {} components, not {allowed:?}; {REPAIR}", a.label, a.components);
            return Err(self.invalid(what));
        }
        let mut values = vec![[fill; N]; a.count];
        let read = |elements: Elements, i: usize, into: &mut [f32; N]| {
            let at = i * elements.stride;
            for (c, value) in into.iter_mut().enumerate().take(a.components) {
                *value = number(&elements.bytes[at + c * size_of(a.component)..], a.component, a.normalized);
            }
        };
        match a.base {
            Some(base) => values.iter_mut().enumerate().for_each(|(i, v)| read(base, i, v)),
            None => values.iter_mut().for_each(|v| v[..a.components.min(N)].fill(0.0)),
        }
        if let Some((indices, elements)) = &a.sparse {
            indices.iter().enumerate().for_each(|(k, &i)| read(*elements, k, &mut values[i as usize]));
        }
        Ok(values)
    }

    /// Vertex indices, and the largest number their type can hold (which glTF reserves).
    pub(super) fn indices(&mut self, index: usize, by: &str) -> Result<(Vec<u32>, u32), SceneError> {
        let a = self.accessor(index, by)?;
        let largest = match a.component {
            ComponentType::U8 => u32::from(u8::MAX),
            ComponentType::U16 => u32::from(u16::MAX),
            ComponentType::U32 => u32::MAX,
            other => {
                let what = format!("{by}: {} has {other:?} numbers, which cannot be indices; {REPAIR}", a.label);
                return Err(self.invalid(what));
            }
        };
        if a.components != 1 {
            let what = format!("{by}: {} has {} components, indices have 1; {REPAIR}", a.label, a.components);
            return Err(self.invalid(what));
        }
        let mut values = match a.base {
            Some(e) => (0..a.count).map(|i| unsigned(&e.bytes[i * e.stride..], a.component)).collect(),
            None => vec![0; a.count],
        };
        if let Some((indices, e)) = &a.sparse {
            for (k, &i) in indices.iter().enumerate() {
                values[i as usize] = unsigned(&e.bytes[k * e.stride..], a.component);
            }
        }
        Ok((values, largest))
    }

    /// The numbers of an accessor's own data as they are stored, not normalised, with the element and the component that
    /// each is; none where it has no such data, replaces some of it, or cannot be read.
    pub(super) fn stored(&mut self, index: usize) -> impl Iterator<Item = (usize, usize, f64)> + use<'d> {
        let a = self.accessor(index, "").ok().filter(|a| a.sparse.is_none());
        let data = a.and_then(|a| Some((a.base?, a.count, a.components, a.component)));
        data.into_iter().flat_map(|(base, count, components, component)| {
            (0..count).flat_map(move |i| {
                (0..components).map(move |c| {
                    let b = &base.bytes[i * base.stride + c * size_of(component)..];
                    let whole = component == ComponentType::U32;
                    let value =
                        if whole { f64::from(unsigned(b, component)) } else { f64::from(number(b, component, false)) };
                    (i, c, value)
                })
            })
        })
    }

    fn accessor(&mut self, index: usize, by: &str) -> Result<Accessor<'d>, SceneError> {
        let raw: json::Accessor = self.object("accessors", index, by)?;
        let label = self.label("accessors", index);
        let (Checked::Valid(component), Checked::Valid(shape)) = (raw.component_type, raw.type_) else {
            return Err(self.invalid(format!("{label} has an unknown type or componentType; {REPAIR}")));
        };
        let component = component.0;
        let components = match shape {
            Type::Scalar => 1,
            Type::Vec2 => 2,
            Type::Vec3 => 3,
            Type::Vec4 => 4,
            _ => return Err(self.invalid(format!("{by}: {label} holds matrices; {REPAIR}"))),
        };
        let element = components * size_of(component);
        let count = raw.count.0;
        // Zeros that no data stands behind are what a tiny file could ask for without end.
        let cost = if raw.buffer_view.is_some() { count } else { count.saturating_mul(ZERO_COST) };
        self.take_elements(cost, &label)?;
        // Below the element limit, so a usize holds it.
        let count = count as usize;
        let base = match raw.buffer_view {
            Some(view) => {
                let offset = raw.byte_offset.unwrap_or_default().0;
                Some(self.elements(view.value(), offset, count, element, &label)?)
            }
            None => None,
        };
        let sparse = match raw.sparse {
            Some(sparse) => {
                let n = sparse.count.0;
                if n > count as u64 {
                    return Err(self.invalid(format!("{label} replaces {n} of {count} elements; {REPAIR}")));
                }
                let n = n as usize;
                let Checked::Valid(index_type) = sparse.indices.component_type else {
                    return Err(self.invalid(format!("{label}: its sparse indices have an unknown type; {REPAIR}")));
                };
                let (view, offset) = (sparse.indices.buffer_view.value(), sparse.indices.byte_offset.0);
                let at = self.elements(view, offset, n, size_of(index_type.0), &label)?;
                let indices: Vec<u32> = (0..n).map(|i| unsigned(&at.bytes[i * at.stride..], index_type.0)).collect();
                if let Some(i) = indices.iter().find(|&&i| i as usize >= count) {
                    return Err(self.invalid(format!("{label} replaces element {i} of {count}; {REPAIR}")));
                }
                let (view, offset) = (sparse.values.buffer_view.value(), sparse.values.byte_offset.0);
                Some((indices, self.elements(view, offset, n, element, &label)?))
            }
            None => None,
        };
        Ok(Accessor { label, count, components, component, normalized: raw.normalized, base, sparse })
    }

    /// `count` elements of `size` bytes from `offset` in a buffer view, all of them inside.
    fn elements(
        &self,
        view: usize,
        offset: u64,
        count: usize,
        size: usize,
        label: &str,
    ) -> Result<Elements<'d>, SceneError> {
        let (bytes, stride) = self.view(view, label)?;
        let stride = stride.unwrap_or(size);
        if stride < size {
            return Err(self.invalid(format!("{label}: a stride of {stride} is less than its {size} bytes; {REPAIR}")));
        }
        let end = match count {
            0 => Some(offset),
            _ => (stride as u64)
                .checked_mul(count as u64 - 1)
                .and_then(|l| l.checked_add(size as u64))
                .and_then(|l| l.checked_add(offset)),
        };
        match end {
            Some(end) if end <= bytes.len() as u64 => Ok(Elements { bytes: &bytes[offset as usize..], stride }),
            _ => Err(self.invalid(format!(
                "{label}: {count} elements do not fit into the {} bytes of bufferViews[{view}]; {REPAIR}",
                bytes.len()
            ))),
        }
    }

    /// Bytes of a buffer view and its stride, if given.
    pub(super) fn view(&self, index: usize, by: &str) -> Result<(&'d [u8], Option<usize>), SceneError> {
        let view: json::buffer::View = self.object("bufferViews", index, by)?;
        let label = self.label("bufferViews", index);
        let buffer = view.buffer.value();
        self.value("buffers", buffer, &label)?;
        let bytes = self.document.buffers.get(buffer).map_or(&[][..], |b| &b[..]);
        let start = view.byte_offset.unwrap_or_default().0;
        let end = start.checked_add(view.byte_length.0).filter(|&end| end <= bytes.len() as u64);
        let Some(end) = end else {
            return Err(self
                .invalid(format!("{label} reaches beyond the {} bytes of buffers[{buffer}]; {REPAIR}", bytes.len())));
        };
        // A stride of 0 is not valid, but old exporters wrote it for "tightly packed".
        let stride = view.byte_stride.map(|s| s.0).filter(|&s| s > 0);
        Ok((&bytes[start as usize..end as usize], stride))
    }
}

fn size_of(component: ComponentType) -> usize {
    match component {
        ComponentType::I8 | ComponentType::U8 => 1,
        ComponentType::I16 | ComponentType::U16 => 2,
        ComponentType::U32 | ComponentType::F32 => 4,
    }
}

/// The number at the start of `b`; normalised integers as the glTF specification, section 3.6.2.2, says.
fn number(b: &[u8], component: ComponentType, normalized: bool) -> f32 {
    let (value, scale) = match component {
        ComponentType::F32 => return f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
        ComponentType::I8 => (f32::from(b[0] as i8), f32::from(i8::MAX)),
        ComponentType::U8 => (f32::from(b[0]), f32::from(u8::MAX)),
        ComponentType::I16 => (f32::from(i16::from_le_bytes([b[0], b[1]])), f32::from(i16::MAX)),
        ComponentType::U16 => (f32::from(u16::from_le_bytes([b[0], b[1]])), f32::from(u16::MAX)),
        ComponentType::U32 => (unsigned(b, component) as f32, u32::MAX as f32),
    };
    if normalized { (value / scale).max(-1.0) } else { value }
}

/// The unsigned integer at the start of `b`; `component` must be an unsigned type.
fn unsigned(b: &[u8], component: ComponentType) -> u32 {
    match size_of(component) {
        1 => u32::from(b[0]),
        2 => u32::from(u16::from_le_bytes([b[0], b[1]])),
        _ => u32::from_le_bytes([b[0], b[1], b[2], b[3]]),
    }
}

#[cfg(test)]
mod tests {
    use super::super::Document;
    use super::*;
    use serde_json::{Value, json};

    fn document(bytes: &[u8], views: Value, accessor: Value) -> Document {
        let json = json!({"buffers": [{"byteLength": bytes.len()}], "bufferViews": views, "accessors": [accessor]});
        Document { path: "test.gltf".into(), json, buffers: vec![bytes.to_vec()] }
    }

    fn scalars(document: &Document) -> Result<Vec<[f32; 1]>, SceneError> {
        Reader::new(document, Vec::new()).vectors(0, &[1], 0.0, "test")
    }

    #[test]
    fn normalised_integers_reach_both_ends() {
        for (component, bytes, expected) in [
            (5120, vec![0x80, 0x81, 127], [-1.0, -1.0, 1.0]),
            (5121, vec![0, 51, 255], [0.0, 0.2, 1.0]),
            (5122, vec![0, 0x80, 1, 0x80, 0xff, 0x7f], [-1.0, -1.0, 1.0]),
            (5123, vec![0, 0, 0x33, 0x33, 0xff, 0xff], [0.0, 0.2, 1.0]),
        ] {
            let d = document(
                &bytes,
                json!([{"buffer": 0, "byteLength": bytes.len()}]),
                json!({"bufferView": 0, "componentType": component, "count": 3, "type": "SCALAR", "normalized": true}),
            );
            assert_eq!(scalars(&d).unwrap().concat(), expected, "component type {component}");
        }
    }

    #[test]
    fn interleaved_elements_step_by_the_stride() {
        let d = document(
            &[9, 1, 9, 9, 2, 9, 9, 3],
            json!([{"buffer": 0, "byteLength": 8, "byteStride": 3}]),
            json!({"bufferView": 0, "byteOffset": 1, "componentType": 5121, "count": 3, "type": "SCALAR"}),
        );
        assert_eq!(scalars(&d).unwrap().concat(), [1.0, 2.0, 3.0]);
    }

    #[test]
    fn sparse_replaces_zeros_and_is_bounded() {
        let sparse = |index: u8| {
            document(
                &[index, 7],
                json!([{"buffer": 0, "byteLength": 1}, {"buffer": 0, "byteOffset": 1, "byteLength": 1}]),
                json!({"componentType": 5121, "count": 3, "type": "SCALAR", "sparse": {"count": 1,
                    "indices": {"bufferView": 0, "componentType": 5121}, "values": {"bufferView": 1}}}),
            )
        };
        assert_eq!(scalars(&sparse(2)).unwrap().concat(), [0.0, 0.0, 7.0]);
        assert!(scalars(&sparse(3)).is_err());
    }

    #[test]
    fn nothing_is_read_or_reserved_beyond_the_data() {
        let view = json!([{"buffer": 0, "byteLength": 4}]);
        let with = |accessor: Value| scalars(&document(&[0; 4], view.clone(), accessor));
        let base = |count: u64, offset: u64| json!({"bufferView": 0, "byteOffset": offset, "componentType": 5121, "count": count, "type": "SCALAR"});
        assert!(with(base(4, 0)).is_ok());
        assert!(with(base(4, 1)).is_err());
        assert!(with(base(1, u64::MAX)).is_err());
        assert!(with(base(u64::MAX, 0)).is_err());
        assert!(with(json!({"componentType": 5121, "count": u64::MAX, "type": "SCALAR"})).is_err());
        assert!(with(json!({"bufferView": 1, "componentType": 5121, "count": 1, "type": "SCALAR"})).is_err());
    }
}
