//! One lightmap page as an OpenEXR file.
//!
//! In: a [`LightmapPage`] in lux. Out: a single-part scan line file with ZIP16 compression, channels `R G B`
//! plus one layer `group.R` for each group of lights that is kept apart, and the extra layers asked for as `layer.R` (or
//! plain `layer` where a layer has one channel), row 0 at v = 0 as glTF and OpenEXR both have it. The header says what the numbers are, so that a file without its
//! manifest can still be used right. Equal pages give equal bytes.

use super::write_atomically;
use crate::error::BakeError;
use crate::lightmap::LightmapPage;
use crate::options::Quantity;
use exr::prelude as ex;
use exr::prelude::{ReadChannels, ReadLayers, WritableImage};
use std::collections::BTreeMap;
use std::f32::consts::FRAC_1_PI;
use std::io::Cursor;
use std::path::Path;

/// Largest value stored as half: half ends at 65504, and a filter or an encoder behind us needs some room.
const LARGEST_HALF: f32 = 60000.0;

/// An extra layer of the file. Always stored as 32-bit float.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Layer {
    /// Half the difference of the two halves, in the quantity of the main layer.
    HalfDifference,
    /// Share of the texel inside its chart, in [0, 1].
    Coverage,
    /// Surface area mapped to the texel (m2).
    Area,
    /// The back side of double-sided surfaces, in the quantity of the main layer.
    Back,
}

impl Layer {
    /// All layers, in the order in which they are documented.
    pub const ALL: [Layer; 4] = [Layer::HalfDifference, Layer::Coverage, Layer::Area, Layer::Back];

    /// Name in the file and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Layer::HalfDifference => "half_difference",
            Layer::Coverage => "coverage",
            Layer::Area => "area",
            Layer::Back => "back",
        }
    }
}

impl std::str::FromStr for Layer {
    type Err = BakeError;

    fn from_str(name: &str) -> Result<Layer, BakeError> {
        Layer::ALL.into_iter().find(|l| l.name() == name).ok_or_else(|| {
            let known = Layer::ALL.map(Layer::name).join(", ");
            BakeError::Options(format!("there is no layer {name:?}; choose from {known}"))
        })
    }
}

/// How a page is written and what its header says.
#[derive(Debug, Clone, PartialEq)]
pub struct ExrSettings {
    /// What the texels hold. Default: irradiance over pi.
    pub quantity: Quantity,
    /// 32-bit float instead of half for `R G B`. Default: false (float only where half would overflow).
    pub float: bool,
    /// Extra layers. A layer the page lacks (no back side was stored) is left out. Default: none.
    pub layers: Vec<Layer>,
    /// Name of the scene. Default: empty.
    pub scene: String,
    /// Seed of the bake. Default: 0.
    pub seed: u64,
    /// Measured texel error [percent of the mean], if known. Default: unknown.
    pub texel_error_percent: Option<f64>,
}

impl Default for ExrSettings {
    fn default() -> Self {
        ExrSettings {
            quantity: Quantity::IrradianceOverPi,
            float: false,
            layers: Vec::new(),
            scene: String::new(),
            seed: 0,
            texel_error_percent: None,
        }
    }
}

/// What was written.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct ExrInfo {
    /// `R G B` are 32-bit float.
    pub float: bool,
    /// `R G B` are float although half was asked for, because of values beyond 60000.
    pub float_for_range: bool,
    /// Largest magnitude among `R G B`, in the unit written.
    pub largest: f32,
    /// Values that were not finite and were written as 0.
    pub non_finite: usize,
    /// Size of the file in bytes.
    pub bytes: usize,
}

/// Factor from irradiance (lux) to the numbers of a file.
pub fn scale_of(quantity: Quantity) -> f32 {
    match quantity {
        Quantity::IrradianceOverPi => FRAC_1_PI,
        Quantity::Irradiance => 1.0,
    }
}

/// Unit of the numbers of a file, as headers and manifests name it.
pub fn unit_of(quantity: Quantity) -> &'static str {
    match quantity {
        Quantity::IrradianceOverPi => "cd/m2",
        Quantity::Irradiance => "lux",
    }
}

/// Writes `page` to `path`.
///
/// # Errors
/// [`BakeError::Io`] where the file cannot be written, or where the page is empty or its vectors do not have
/// `width * height` entries.
pub fn write(path: &Path, page: &LightmapPage, settings: &ExrSettings) -> Result<ExrInfo, BakeError> {
    let (bytes, mut info) = encode(page, settings).map_err(|what| BakeError::Io {
        path: path.into(),
        source: std::io::Error::new(std::io::ErrorKind::InvalidInput, what),
    })?;
    info.bytes = bytes.len();
    write_atomically(path, &bytes)?;
    Ok(info)
}

fn encode(page: &LightmapPage, settings: &ExrSettings) -> Result<(Vec<u8>, ExrInfo), String> {
    let (width, height) = (page.width as usize, page.height as usize);
    let n = width * height;
    if n == 0 {
        return Err(format!("the page has no texels ({width} x {height})"));
    }
    let check = |what: &str, len| if len == n { Ok(()) } else { Err(format!("{what} has {len} of {n} texels")) };
    check("irradiance", page.irradiance.len())?;
    let scale = scale_of(settings.quantity);

    let values = || page.irradiance.iter().flatten().map(|v| v * scale);
    let largest = values().filter(|v| v.is_finite()).fold(0.0, |a: f32, v| a.max(v.abs()));
    let non_finite = values().filter(|v| !v.is_finite()).count();
    let float_for_range = !settings.float && largest > LARGEST_HALF;
    let float = settings.float || float_for_range;

    let mut channels = ex::SmallVec::new();
    add_rgb(&mut channels, "", &page.irradiance, scale, float);
    for group in &page.groups {
        check(&format!("group {}", group.name), group.irradiance.len())?;
        add_rgb(&mut channels, &format!("{}.", group.name), &group.irradiance, scale, float);
    }
    for &layer in &settings.layers {
        match layer {
            Layer::Back if page.back.is_empty() => {}
            Layer::Back => {
                check("back", page.back.len())?;
                add_rgb(&mut channels, "back.", &page.back, scale, true);
            }
            Layer::HalfDifference => {
                check("half_difference", page.half_difference.len())?;
                add_rgb(&mut channels, "half_difference.", &page.half_difference, scale, true);
            }
            Layer::Coverage => {
                check("coverage", page.coverage.len())?;
                channels.push(ex::AnyChannel::new("coverage", ex::FlatSamples::F32(page.coverage.clone())));
            }
            Layer::Area => {
                check("area", page.area.len())?;
                channels.push(ex::AnyChannel::new("area", ex::FlatSamples::F32(page.area.clone())));
            }
        }
    }
    let encoding = ex::Encoding {
        compression: ex::Compression::ZIP16,
        blocks: ex::Blocks::ScanLines,
        line_order: ex::LineOrder::Increasing,
    };
    let layer = ex::Layer::new((width, height), layer_attributes(settings), encoding, ex::AnyChannels::sort(channels));
    let mut image = ex::Image::from_layer(layer);
    image.attributes.chromaticities = Some(REC709);
    let mut bytes = Cursor::new(Vec::new());
    image.write().to_buffered(&mut bytes).map_err(|e| e.to_string())?;
    let mut bytes = bytes.into_inner();
    sort_attributes(&mut bytes);
    Ok((bytes, ExrInfo { float, float_for_range, largest, non_finite, bytes: 0 }))
}

type Channels = ex::SmallVec<[ex::AnyChannel<ex::FlatSamples>; 4]>;

/// Adds the channels `prefix` + R, G, B; what is not finite becomes 0, since one NaN would spread over its
/// neighbours in every filter that reads the map.
fn add_rgb(channels: &mut Channels, prefix: &str, rgb: &[[f32; 3]], scale: f32, float: bool) {
    for (c, name) in ["R", "G", "B"].into_iter().enumerate() {
        let values = rgb.iter().map(|t| t[c] * scale).map(|v| if v.is_finite() { v } else { 0.0 });
        let samples = if float {
            ex::FlatSamples::F32(values.collect())
        } else {
            ex::FlatSamples::F16(values.map(ex::f16::from_f32).collect())
        };
        channels.push(ex::AnyChannel::new(format!("{prefix}{name}").as_str(), samples));
    }
}

/// Primaries of ITU-R BT.709-6 with the white point D65.
const REC709: ex::attribute::Chromaticities = ex::attribute::Chromaticities {
    red: ex::Vec2(0.64, 0.33),
    green: ex::Vec2(0.30, 0.60),
    blue: ex::Vec2(0.15, 0.06),
    white: ex::Vec2(0.3127, 0.3290),
};

fn layer_attributes(settings: &ExrSettings) -> ex::LayerAttributes {
    use ex::attribute::AttributeValue;
    // EXR text is bytes; names of scenes are stored as UTF-8, which is what readers expect.
    let text = |s: &str| ex::Text::from_slice_unchecked(s.as_bytes());
    let software_name = Some(text(concat!("evenlight ", env!("CARGO_PKG_VERSION"))));
    let mut attributes = ex::LayerAttributes { software_name, ..Default::default() };
    let quantity = match settings.quantity {
        Quantity::IrradianceOverPi => "irradiance over pi",
        Quantity::Irradiance => "irradiance",
    };
    let over_pi = i32::from(settings.quantity == Quantity::IrradianceOverPi);
    let mut put = |name, value| attributes.other.insert(text(name), value);
    put("quantity", AttributeValue::Text(text(quantity)));
    put("unit", AttributeValue::Text(text(unit_of(settings.quantity))));
    put("divided_by_pi", AttributeValue::I32(over_pi));
    put("scene", AttributeValue::Text(text(&settings.scene)));
    put("seed", AttributeValue::Text(text(&settings.seed.to_string())));
    if let Some(percent) = settings.texel_error_percent.filter(|p| p.is_finite()) {
        put("texel_error_percent", AttributeValue::F64(percent));
    }
    attributes
}

/// Puts the header's attributes in order of their names: the encoder keeps them in a hash map, whose order
/// changes from run to run. Their total length stays, so all offsets in the file do too.
fn sort_attributes(bytes: &mut [u8]) {
    const START: usize = 8; // magic number and version
    let text_end = |from: usize| bytes[from..].iter().position(|&b| b == 0).map(|n| from + n + 1);
    let mut attributes = Vec::new();
    let mut at = START;
    while bytes.get(at).is_some_and(|&b| b != 0) {
        let Some(size_at) = text_end(at).and_then(text_end) else { return };
        let Some(size) = bytes.get(size_at..size_at + 4) else { return };
        let end = size_at + 4 + u32::from_le_bytes([size[0], size[1], size[2], size[3]]) as usize;
        let Some(attribute) = bytes.get(at..end) else { return };
        attributes.push(attribute.to_vec());
        at = end;
    }
    attributes.sort();
    let sorted = attributes.concat();
    bytes[START..START + sorted.len()].copy_from_slice(&sorted);
}

/// An EXR file in memory, for tests and tools.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ExrPage {
    /// Width in texels.
    pub width: usize,
    /// Height in texels.
    pub height: usize,
    /// Values per channel, row-major, row 0 first; channels of a named part are `part.channel`.
    pub channels: BTreeMap<String, Vec<f32>>,
    /// Text and number attributes as text.
    pub attributes: BTreeMap<String, String>,
}

impl ExrPage {
    /// The channels `prefix` + R, G, B as triples; `None` where one is missing. The main layer has the
    /// prefix "", the others `back.` and the like.
    pub fn rgb(&self, prefix: &str) -> Option<Vec<[f32; 3]>> {
        let channel = |c| self.channels.get(&format!("{prefix}{c}"));
        let (r, g, b) = (channel("R")?, channel("G")?, channel("B")?);
        Some(r.iter().zip(g).zip(b).map(|((&r, &g), &b)| [r, g, b]).collect())
    }
}

/// Reads any flat EXR file: all parts that have the size of the first one, all channels, as 32-bit float.
///
/// # Errors
/// [`BakeError::Io`] names the file and what is wrong with it.
pub fn read(path: &Path) -> Result<ExrPage, BakeError> {
    let image = ex::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .from_file(path)
        .map_err(|e| BakeError::Io { path: path.into(), source: std::io::Error::other(e.to_string()) })?;
    let mut page = ExrPage::default();
    let utf8 = |t: &ex::Text| String::from_utf8_lossy(t.bytes()).into_owned();
    for layer in &image.layer_data {
        if page.channels.is_empty() {
            (page.width, page.height) = (layer.size.width(), layer.size.height());
        } else if (page.width, page.height) != (layer.size.width(), layer.size.height()) {
            continue;
        }
        let part = layer.attributes.layer_name.as_ref().filter(|_| image.layer_data.len() > 1).map(utf8);
        for channel in &layer.channel_data.list {
            let name = utf8(&channel.name);
            let name = part.as_ref().map_or(name.clone(), |p| format!("{p}.{name}"));
            page.channels.insert(name, channel.sample_data.values_as_f32().collect());
        }
        if let Some(software) = &layer.attributes.software_name {
            page.attributes.insert("software".into(), utf8(software));
        }
        for (name, value) in &layer.attributes.other {
            use ex::attribute::AttributeValue as V;
            let value = match value {
                V::Text(t) => utf8(t),
                V::I32(v) => v.to_string(),
                V::F32(v) => v.to_string(),
                V::F64(v) => v.to_string(),
                _ => continue,
            };
            page.attributes.insert(utf8(name), value);
        }
    }
    Ok(page)
}
