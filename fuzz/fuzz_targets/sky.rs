//! Sky images, .hdr and .exr: an error that names the file, or finite radiance.

#![no_main]

use evenlight::scene::Sky;
use libfuzzer_sys::fuzz_target;
use std::path::Path;

// A panic of a decoder that the reader catches is no fault: without this hook, only what gets out ends the run.
fuzz_target!(init: drop(std::panic::take_hook()), |bytes: &[u8]| {
    match Sky::from_bytes(Path::new("sky.exr"), bytes, 0.0, 1.0) {
        Ok((Sky::Image { width, height, radiance, .. }, _)) => {
            assert_eq!(radiance.len(), width * height);
            assert!(radiance.iter().all(|l| l.is_finite() && l.min_element() >= 0.0));
        }
        Ok(_) => unreachable!("files hold images"),
        Err(e) => assert!(e.to_string().contains("sky.exr"), "{e}"),
    }
});
