//! Lightmaps as EXR files: what goes in comes out, in the unit that the header says.

use evenlight::lightmap::LightmapPage;
use evenlight::options::Quantity;
use evenlight::output::lightmap_exr::{ExrSettings, Layer, read, write};
use std::f32::consts::FRAC_1_PI;
use std::path::PathBuf;

/// A page with different values everywhere, so that no flip or swap goes unseen.
fn page(width: u32, height: u32) -> LightmapPage {
    let n = width as usize * height as usize;
    let rgb = |scale: f32| (0..n).map(|i| [i as f32 * scale, i as f32 * 0.5, 7.0]).collect::<Vec<[f32; 3]>>();
    LightmapPage {
        width,
        height,
        irradiance: rgb(1.0),
        half_difference: rgb(-0.25),
        groups: Vec::new(),
        back: rgb(3.0),
        coverage: (0..n).map(|i| i as f32 / n as f32).collect(),
        area: (0..n).map(|i| 1e-9 * i as f32).collect(),
    }
}

fn half(v: f32) -> f32 {
    half::f16::from_f32(v).to_f32()
}

#[test]
fn half_by_default_and_over_pi() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lightmap-0.exr");
    let page = page(37, 21);
    let info = write(&path, &page, &ExrSettings::default()).unwrap();
    assert!(!info.float && !info.float_for_range);
    let back = read(&path).unwrap();
    assert_eq!((back.width, back.height, back.channels.len()), (37, 21, 3));
    let want: Vec<[f32; 3]> = page.irradiance.iter().map(|t| t.map(|v| half(v * FRAC_1_PI))).collect();
    assert_eq!(back.rgb("").unwrap(), want);
    let attribute = |name: &str| back.attributes.get(name).map(String::as_str);
    assert_eq!(attribute("unit"), Some("cd/m2"));
    assert_eq!(attribute("divided_by_pi"), Some("1"));
    assert_eq!(attribute("quantity"), Some("irradiance over pi"));
    assert_eq!(attribute("texel_error_percent"), None);
    assert!(attribute("software").unwrap().starts_with("evenlight "));
}

#[test]
fn layers_and_attributes_survive() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("all.exr");
    let page = page(5, 4);
    let settings = ExrSettings {
        quantity: Quantity::Irradiance,
        layers: Layer::ALL.to_vec(),
        scene: "Küche/шум".into(),
        seed: u64::MAX,
        texel_error_percent: Some(1.25),
        ..Default::default()
    };
    write(&path, &page, &settings).unwrap();
    let back = read(&path).unwrap();
    assert_eq!(back.rgb("half_difference.").unwrap(), page.half_difference);
    assert_eq!(back.rgb("back.").unwrap(), page.back);
    assert_eq!(back.channels["coverage"], page.coverage);
    assert_eq!(back.channels["area"], page.area, "float, not half");
    assert_eq!(back.attributes["scene"], "Küche/шум");
    assert_eq!(back.attributes["seed"], u64::MAX.to_string());
    assert_eq!(back.attributes["texel_error_percent"], "1.25");
    assert_eq!(back.attributes["unit"], "lux");
}

#[test]
fn values_beyond_half_make_the_page_float() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bright.exr");
    let mut page = page(3, 3);
    page.irradiance[4] = [1e6, 2.0, 3.0];
    let info = write(&path, &page, &ExrSettings::default()).unwrap();
    assert!(info.float && info.float_for_range);
    assert_eq!(read(&path).unwrap().rgb("").unwrap()[4][0], 1e6 * FRAC_1_PI);
}

#[test]
fn broken_values_are_counted_and_black() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("broken.exr");
    let mut page = page(3, 3);
    page.irradiance[2] = [f32::NAN, f32::INFINITY, 1.0];
    let info = write(&path, &page, &ExrSettings { quantity: Quantity::Irradiance, ..Default::default() }).unwrap();
    assert_eq!((info.non_finite, info.float), (2, false));
    assert_eq!(read(&path).unwrap().rgb("").unwrap()[2], [0.0, 0.0, 1.0]);
}

#[test]
fn equal_pages_give_equal_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let settings = ExrSettings { layers: Layer::ALL.to_vec(), texel_error_percent: Some(2.0), ..Default::default() };
    let files: Vec<Vec<u8>> = (0..4)
        .map(|i| {
            let path = folder.path().join(format!("{i}.exr"));
            write(&path, &page(64, 64), &settings).unwrap();
            std::fs::read(path).unwrap()
        })
        .collect();
    assert!(files.windows(2).all(|pair| pair[0] == pair[1]));
}

#[test]
fn a_page_without_texels_or_with_missing_ones_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("none.exr");
    assert!(write(&path, &LightmapPage::default(), &ExrSettings::default()).is_err());
    let mut page = page(4, 4);
    page.irradiance.pop();
    let error = write(&path, &page, &ExrSettings::default()).unwrap_err().to_string();
    assert!(error.contains("15 of 16"), "{error}");
    assert!(!path.exists());
    assert!("no_such_layer".parse::<Layer>().is_err());
    assert_eq!("back".parse::<Layer>().unwrap(), Layer::Back);
}

/// Files by other programs can be read, for comparisons.
#[test]
#[allow(clippy::print_stderr)]
fn reference_maps_can_be_read() {
    let shared = std::env::var_os("EVENLIGHT_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared")), PathBuf::from);
    let path = shared.join("ref/cornell_256.exr");
    if !path.exists() {
        eprintln!("skipped: no reference maps beside the repository");
        return;
    }
    let page = read(&path).unwrap();
    assert!(page.width > 0 && page.channels.values().all(|c| c.len() == page.width * page.height));
}
