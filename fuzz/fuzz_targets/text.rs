//! Cameras, rigs, matches and COLMAP models.
#![no_main]

use cv_io::{colmap, parse_camera, parse_matches, parse_rig};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    if let Ok(camera) = parse_camera(text, Some((640, 480))) {
        assert!(camera.validate().is_ok() && camera.width > 0 && camera.height > 0);
    }
    let _ = parse_rig(text, Some((640, 480)));
    let _ = parse_matches(text);
    let _ = colmap::parse_cameras(text);
    let _ = colmap::parse_images(text);
    let _ = colmap::parse_points(text);
});
