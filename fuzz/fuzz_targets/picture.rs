//! Pictures: whatever the bytes, an error or a picture within the limit.
#![no_main]

use cv_io::{ReadOptions, decode_image};
use libfuzzer_sys::fuzz_target;

const LIMIT: u64 = 1 << 20;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(picture) = decode_image(bytes, &ReadOptions { max_pixels: LIMIT }) {
        let (width, height) = picture.size();
        assert!((width * height) as u64 <= LIMIT);
    }
});
