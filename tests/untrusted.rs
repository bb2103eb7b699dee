//! Files from strangers: whatever their bytes are, there is an error that says why or something that can be baked, and
//! memory stays within bounds. The bounds are those of the address space as the system counts it, so that memory taken
//! and never touched counts too.
//!
//! Damaged .glb, .gltf, meshopt, Draco and IES files are under test in `loader.rs`, `formats.rs` and `ies.rs`.

mod common;

use ::exr::prelude::{self as exr, WritableImage};
use common::glb::SceneBuilder;
use common::random::Random;
use evenlight::scene::gltf::load_bytes;
use evenlight::scene::{Sky, Texture, Wrap};
use image::{DynamicImage, ImageFormat, Rgb32FImage, RgbImage};
use serde_json::{Value, json};
use std::io::Cursor;
use std::path::Path;

const FLOOR: [[f32; 3]; 4] = [[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]];

/// Most that all tests of this file together may add to the address space of the process [MiB].
const MOST_MIB: u64 = 2048;

/// Largest address space that this process had so far [MiB]; 0 where the system does not tell.
fn address_space() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmPeak:")?.split_whitespace().next()?.parse().ok());
    peak.unwrap_or(0u64) >> 10
}

/// Runs `work`, which must take no more than [`MOST_MIB`].
fn within_memory<T>(what: &str, work: impl FnOnce() -> T) -> T {
    let before = address_space();
    let done = work();
    let grown = address_space() - before;
    assert!(grown < MOST_MIB, "{what} took {grown} MiB");
    done
}

/// Damaged copies of `good`: every length up to 256 bytes and some beyond, and `rounds` with bytes changed, left out or
/// repeated.
fn damaged(good: &[u8], rounds: usize, seed: u64) -> Vec<Vec<u8>> {
    let mut random = Random::new(seed);
    let heads = (0..good.len().min(256)).chain((256..good.len()).step_by(97));
    let mut all: Vec<Vec<u8>> = heads.map(|n| good[..n].to_vec()).collect();
    for _ in 0..rounds {
        let mut bytes = good.to_vec();
        for _ in 0..1 + random.below(4) {
            // Heads hold the numbers that do most harm.
            let within = if random.below(2) == 0 { bytes.len().min(64) } else { bytes.len() };
            let at = random.below(within.max(1)).min(bytes.len().saturating_sub(1));
            match random.below(5) {
                _ if bytes.is_empty() => {}
                0 => bytes[at] ^= 1 << random.below(8),
                1 => bytes[at] = random.below(256) as u8,
                2 => bytes[at] = [0, 0x7f, 0x80, 0xff][random.below(4)],
                3 => drop(bytes.drain(at..(at + 1 + random.below(8)).min(bytes.len()))),
                _ => {
                    let part = bytes[at..(at + 1 + random.below(16)).min(bytes.len())].to_vec();
                    drop(bytes.splice(at..at, part));
                }
            }
        }
        all.push(bytes);
    }
    all
}

/// A picture of no pattern that a coder could leave out, of `width` x `height` texels.
fn picture(width: u32, height: u32) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| image::Rgb([(x * 37 % 256) as u8, (y * 91 % 256) as u8, (x ^ y) as u8]))
}

fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, format).expect("it can be encoded");
    bytes.into_inner()
}

fn texture(bytes: &[u8]) -> Texture {
    Texture::new("picture".into(), bytes.into(), [Wrap::Repeat; 2], false)
}

#[test]
fn damaged_textures_are_pictures_or_say_why_not() {
    let formats = [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP];
    for (seed, format) in formats.into_iter().enumerate() {
        let good = encoded(picture(24, 16), format);
        assert_eq!(texture(&good).decode_error(), None, "{format:?}");
        let refused = within_memory("a texture", || {
            let all = damaged(&good, 1_500, seed as u64);
            all.iter().filter(|bytes| texture(bytes).decode_error().is_some_and(|why| !why.is_empty())).count()
        });
        assert!(refused > 100, "{format:?}: {refused} refused");
    }
    // What readers do not decode is named in a warning.
    let ktx = [b"\xABKTX 20\xBB\r\n\x1A\n", &[0xffu8; 68][..]].concat();
    for bytes in damaged(&ktx, 200, 9) {
        let mut builder = SceneBuilder::new().material("grey", [0.5; 3]).quad("floor", FLOOR);
        builder.texture(&bytes, "image/ktx2");
        load_bytes(Path::new("ktx.glb"), &builder.glb()).expect("nothing uses it");
    }
}

/// An EXR picture of 24 x 16 texels.
fn exr_of(encoding: exr::Encoding) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let channels = exr::SpecificChannels::rgb(|at: exr::Vec2<usize>| {
        let [x, y] = [at.x() as f32, at.y() as f32];
        (x, y * 0.37, (x * 1.7 + y * 0.9).sin().abs())
    });
    let layer = exr::Layer::new((24, 16), exr::LayerAttributes::named("sky"), encoding, channels);
    exr::Image::from_layer(layer).write().to_buffered(&mut bytes).expect("it can be encoded");
    bytes.into_inner()
}

/// The same in 16 bits by B44, whose decoder takes what it is given without a check.
fn exr_of_halves() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let channels = exr::SpecificChannels::rgb(|at: exr::Vec2<usize>| {
        let [r, g, b] = [at.x(), at.y(), at.x() ^ at.y()].map(|v| half::f16::from_f32(v as f32 * 0.37));
        (r, g, b)
    });
    let encoding = exr::Encoding { compression: exr::Compression::B44, ..exr::Encoding::UNCOMPRESSED };
    let layer = exr::Layer::new((24, 16), exr::LayerAttributes::named("sky"), encoding, channels);
    exr::Image::from_layer(layer).write().to_buffered(&mut bytes).expect("it can be encoded");
    bytes.into_inner()
}

/// Reads a sky; what is read must be radiance.
fn sky(name: &str, bytes: &[u8]) -> Result<(), String> {
    let (sky, _) = Sky::from_bytes(Path::new(name), bytes, 0.0, 1.0).map_err(|e| e.to_string())?;
    let Sky::Image { width, height, radiance, .. } = sky else { panic!("{name}: no image") };
    assert_eq!(radiance.len(), width * height, "{name}");
    assert!(radiance.iter().all(|l| l.is_finite() && l.min_element() >= 0.0), "{name}");
    Ok(())
}

#[test]
fn damaged_skies_are_radiance_or_say_why_not() {
    let hdr = Rgb32FImage::from_fn(24, 16, |x, y| image::Rgb([x as f32, 0.1 * y as f32, 1e-3]));
    let tiles = exr::Blocks::Tiles(exr::Vec2(8, 8));
    let with = |compression, blocks| exr_of(exr::Encoding { compression, blocks, ..exr::Encoding::UNCOMPRESSED });
    let lines = exr::Blocks::ScanLines;
    let files = [
        ("lines.hdr", encoded(hdr, ImageFormat::Hdr)),
        ("plain.exr", with(exr::Compression::Uncompressed, lines)),
        ("runs.exr", with(exr::Compression::RLE, lines)),
        ("zip.exr", with(exr::Compression::ZIP16, lines)),
        ("piz.exr", with(exr::Compression::PIZ, lines)),
        ("pxr24.exr", with(exr::Compression::PXR24, tiles)),
        ("b44.exr", with(exr::Compression::B44, tiles)),
        ("half.exr", exr_of_halves()),
    ];
    for (seed, (name, good)) in files.iter().enumerate() {
        sky(name, good).expect("a good file");
        let refused = within_memory(name, || {
            let all = damaged(good, 1_500, seed as u64);
            all.iter().filter_map(|bytes| sky(name, bytes).err()).filter(|why| why.contains(name)).count()
        });
        assert!(refused > 100, "{name}: {refused} refused");
    }
}

/// A few bytes that claim to be a picture of `width` x `height` texels.
fn claims(format: ImageFormat, width: u32, height: u32) -> Vec<u8> {
    let mut bytes = encoded(picture(24, 16), format);
    match format {
        ImageFormat::Png => {
            bytes[16..20].copy_from_slice(&width.to_be_bytes());
            bytes[20..24].copy_from_slice(&height.to_be_bytes());
            let crc = crc32(&bytes[12..29]);
            bytes[29..33].copy_from_slice(&crc.to_be_bytes());
        }
        ImageFormat::Jpeg => {
            let frame = bytes.windows(2).position(|w| w == [0xff, 0xc0]).expect("a frame");
            bytes[frame + 5..frame + 7].copy_from_slice(&(height as u16).to_be_bytes());
            bytes[frame + 7..frame + 9].copy_from_slice(&(width as u16).to_be_bytes());
        }
        _ => {
            // The head of VP8L: a byte of signature, then 14 bits each of what both are less one.
            let at = bytes.windows(4).position(|w| w == b"VP8L").expect("a lossless picture") + 9;
            let sizes = (width - 1) & 0x3fff | ((height - 1) & 0x3fff) << 14;
            bytes[at..at + 4].copy_from_slice(&sizes.to_le_bytes());
        }
    }
    bytes
}

/// The checksum of PNG chunks.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, &b| {
        (0..8).fold(crc ^ u32::from(b), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 })
    })
}

#[test]
fn pictures_that_claim_to_be_huge_take_no_memory() {
    for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP] {
        for (width, height) in [(16384, 16384), (16383, 11000), (65535, 65535), (0, 7)] {
            let bytes = claims(format, width, height);
            let why = within_memory("a texture", || texture(&bytes).decode_error());
            assert!(why.is_some(), "{format:?} of {width} x {height}");
        }
    }
    let hdr = |size: &str| format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n{size}\n\x02\x02\x40\x00").into_bytes();
    let exr_with = |width: i32, height: i32| {
        let mut bytes = exr_of(exr::Encoding { compression: exr::Compression::ZIP16, ..exr::Encoding::UNCOMPRESSED });
        for name in [&b"dataWindow\0box2i\0"[..], b"displayWindow\0box2i\0"] {
            let at = bytes.windows(name.len()).position(|w| w == name).expect("a window") + name.len() + 4;
            bytes[at..at + 8].fill(0);
            bytes[at + 8..at + 12].copy_from_slice(&(width - 1).to_le_bytes());
            bytes[at + 12..at + 16].copy_from_slice(&(height - 1).to_le_bytes());
        }
        bytes
    };
    let skies = [
        ("a.hdr", hdr("-Y 16384 +X 16384")),
        ("b.hdr", hdr("-Y 4097 +X 4096")),
        ("c.hdr", hdr("-Y 4294967295 +X 4294967295")),
        ("a.exr", exr_with(16384, 16384)),
        ("b.exr", exr_with(1 << 27, 2)),
        ("c.exr", exr_with(i32::MAX, i32::MAX)),
    ];
    let before = address_space();
    for (name, bytes) in skies {
        let why = sky(name, &bytes).expect_err(name);
        assert!(why.contains(name), "{why}");
    }
    // Each would take 3 GiB.
    assert!(address_space() - before < 256, "{} MiB", address_space() - before);
}

/// A floor whose JSON `change` changes.
fn floor(change: impl FnOnce(&mut Value)) -> Vec<u8> {
    SceneBuilder::new().material("grey", [0.5; 3]).quad("floor", FLOOR).patch(change).glb()
}

#[test]
fn numbers_that_ask_for_all_memory_are_refused() {
    let most = u64::MAX;
    let sparse = |count: u64, replaced: u64| {
        json!({"componentType": 5126, "type": "VEC3", "count": count, "sparse": {"count": replaced,
            "indices": {"bufferView": 0, "componentType": 5125}, "values": {"bufferView": 0}}})
    };
    let instanced = |count: u64| {
        floor(move |j| {
            j["accessors"][0]["count"] = json!(count);
            j["nodes"][0]["extensions"] = json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}});
            j["extensionsUsed"] = json!(["EXT_mesh_gpu_instancing"]);
        })
    };
    let meshopt = |count: u64| {
        floor(move |j| {
            let packed =
                json!({"buffer": 0, "byteLength": 16, "byteStride": 256, "count": count, "mode": "ATTRIBUTES"});
            j["bufferViews"][0]["byteLength"] = json!(count.saturating_mul(256));
            j["bufferViews"][0]["extensions"] = json!({"EXT_meshopt_compression": packed});
            j["extensionsUsed"] = json!(["EXT_meshopt_compression"]);
        })
    };
    let cases = [
        ("vertices", floor(|j| j["accessors"][0]["count"] = json!(most))),
        ("indices", floor(|j| j["accessors"][3]["count"] = json!(1u64 << 33))),
        ("zeros", floor(|j| j["accessors"][0] = json!({"componentType": 5126, "type": "VEC4", "count": 1u64 << 30}))),
        ("a stride", floor(|j| j["bufferViews"][0]["byteStride"] = json!(most))),
        ("a view", floor(|j| j["bufferViews"][0]["byteLength"] = json!(most))),
        ("a buffer", json!({"buffers": [{"byteLength": most, "uri": "data:,"}]}).to_string().into_bytes()),
        ("sparse zeros", floor(|j| j["accessors"][0] = sparse(1 << 40, 1))),
        ("sparse values", floor(|j| j["accessors"][0] = sparse(4, 1 << 40))),
        ("sparse values below the count", floor(|j| j["accessors"][0] = sparse(1 << 24, 1 << 24))),
        ("a billion instances", instanced(1_000_000_000)),
        ("a meshopt stream of zeros", meshopt(1 << 22)),
        ("a meshopt stream beyond all limits", meshopt(1 << 50)),
    ];
    for (what, bytes) in cases {
        let before = address_space();
        let why = load_bytes(Path::new("bomb.glb"), &bytes).expect_err(what).to_string();
        assert!(why.contains("bomb.glb") && why.contains("; "), "{what}: {why}");
        assert!(address_space() - before < 1024, "{what} took {} MiB", address_space() - before);
    }
}

#[test]
fn nesting_without_end_is_refused() {
    let nested = |open: &str, close: &str| {
        let deep = [open.repeat(100_000), "1".into(), close.repeat(100_000)].concat();
        format!(r#"{{"asset": {{"version": "2.0"}}, "extras": {deep}}}"#)
    };
    for text in [nested("[", "]"), nested(r#"{"a":"#, "}"), "[".repeat(1_000_000)] {
        let why = load_bytes(Path::new("deep.gltf"), text.as_bytes()).expect_err("too deep").to_string();
        assert!(why.contains("deep.gltf") && why.contains("JSON"), "{why}");
    }
    // As deep as the reader of JSON allows, which all that walks the document has to stand.
    let deep = [r#"{"a":"#.repeat(120), "1".into(), "}".repeat(120)].concat();
    let text = format!(r#"{{"asset": {{"version": "2.0"}}, "materials": [{deep}], "extras": {deep}}}"#);
    load_bytes(Path::new("deep.gltf"), text.as_bytes()).expect("deep, but good");
}
