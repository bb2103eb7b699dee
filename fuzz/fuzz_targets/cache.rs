//! What a cache gives back: whatever it holds, a bake takes it or leaves it. The hash that guards the files of a cache
//! folder is passed over here, for who can write files there can write hashes. The first byte of the input says which
//! kind of content it takes the place of.

#![no_main]

use evenlight::cache::{Cache, Key, Writing};
use evenlight::options::Audits;
use evenlight::{BakeOptions, NoObserver, Scene, bake_with_cache};
use libfuzzer_sys::fuzz_target;
use std::io::{Cursor, Read};
use std::sync::LazyLock;

static SCENE: LazyLock<Scene> =
    LazyLock::new(|| Scene::from_gltf(concat!(env!("CARGO_MANIFEST_DIR"), "/../fixtures/cube.glb")).expect("a scene"));

struct Planted<'i> {
    kind: &'static str,
    bytes: &'i [u8],
}

impl Cache for Planted<'_> {
    fn load(&mut self, key: &Key) -> Option<Box<dyn Read>> {
        (key.kind == self.kind).then(|| Box::new(Cursor::new(self.bytes.to_vec())) as Box<dyn Read>)
    }

    /// With EVENLIGHT_SEEDS set to a folder, writes what a bake keeps there, as seeds.
    fn keep(&mut self, key: &Key, writing: &Writing) {
        let Some(folder) = std::env::var_os("EVENLIGHT_SEEDS") else { return };
        let kind = ["charts", "density", "light"].iter().position(|k| *k == key.kind).expect("a kind");
        let mut bytes = vec![kind as u8];
        writing(&mut bytes).expect("memory can be written");
        std::fs::write(std::path::Path::new(&folder).join(key.to_string()), bytes).expect("the folder can be written");
    }

    fn is_due(&self) -> bool {
        false
    }
}

fuzz_target!(|bytes: &[u8]| {
    let Some((&kind, bytes)) = bytes.split_first() else { return };
    let kind = ["charts", "density", "light"][usize::from(kind) % 3];
    let options = BakeOptions {
        target_percent: 50.0,
        max_texture: 16,
        max_photons: Some(1 << 10),
        threads: 1,
        audit: Audits::Off,
        ..BakeOptions::default()
    };
    let baked = bake_with_cache(&SCENE, &options, Some(&mut Planted { kind, bytes }), &mut NoObserver);
    drop(baked);
});
