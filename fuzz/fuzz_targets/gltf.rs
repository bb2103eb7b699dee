//! glTF and GLB files: an error that names the file, or a scene whose references hold, its textures decoded.

#![no_main]

use evenlight::scene::gltf::load_bytes;
use libfuzzer_sys::fuzz_target;
use std::path::Path;

// A panic of a decoder that the reader catches is no fault: without this hook, only what gets out ends the run.
fuzz_target!(init: drop(std::panic::take_hook()), |bytes: &[u8]| {
    let scene = match load_bytes(Path::new("absent/fuzz.glb"), bytes) {
        Ok(scene) => scene,
        Err(e) => return assert!(e.to_string().contains("absent"), "{e}"),
    };
    for primitive in scene.meshes.iter().flat_map(|m| &m.primitives) {
        let n = primitive.positions.len();
        assert!(primitive.triangles.iter().flatten().all(|&v| (v as usize) < n));
        assert!(primitive.positions.iter().all(|p| p.is_finite()));
        assert!(primitive.material < scene.materials.len());
    }
    assert!(scene.instances.iter().all(|i| i.mesh < scene.meshes.len() && i.world_from_object.is_finite()));
    assert!(scene.lights.iter().all(|l| l.intensity.is_finite() && l.intensity.min_element() >= 0.0));
    scene.textures.iter().for_each(|texture| drop(texture.decode_error()));
});
