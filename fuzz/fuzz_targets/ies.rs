//! IES profiles: an error that names the file, or shares of a finite flux.

#![no_main]

use evenlight::scene::IesProfile;
use glam::Vec3;
use libfuzzer_sys::fuzz_target;
use std::path::Path;

fuzz_target!(|bytes: &[u8]| {
    match IesProfile::from_bytes(Path::new("lamp.ies"), bytes, None) {
        Ok((profile, _)) => {
            assert!(profile.flux() >= 0.0 && profile.flux().is_finite());
            for w in [Vec3::X, Vec3::NEG_Y, Vec3::Z, Vec3::splat(3f32.sqrt().recip())] {
                assert!((0.0..=1.0).contains(&profile.share(w)));
            }
        }
        Err(e) => assert!(e.to_string().contains("lamp.ies"), "{e}"),
    }
});
