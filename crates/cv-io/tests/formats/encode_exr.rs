//! Writing OpenEXR.

use cv_core::RgbF32;
use cv_io::{FormatError, encode_exr};

#[test]
fn an_empty_image_is_refused() {
    let empty = RgbF32::new(0, 4, [0.0; 3]);
    assert!(matches!(encode_exr(empty.view()), Err(FormatError::NotRepresentable { format: "OpenEXR", .. })));
}

/// Decodes the last block by hand, from the layout of the format.
#[test]
fn the_layout_is_that_of_the_format() {
    let image = RgbF32::from_fn(5, 20, |x, y| [x as f32 + 0.5, y as f32 * 100.0, 1e-3]);
    let bytes = encode_exr(image.view()).unwrap();
    let find = |name: &[u8]| bytes.windows(name.len()).position(|w| w == name).unwrap();
    assert_eq!(bytes[find(b"compression\0compression\0") + 28], 3);
    let table = find(b"screenWindowWidth\0float\0") + 24 + 4 + 4 + 1;
    let offset = u64::from_le_bytes(bytes[table + 8..table + 16].try_into().unwrap()) as usize;
    let number = |at: usize| i32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    assert_eq!((number(offset), offset + 8 + number(offset + 4) as usize), (16, bytes.len()));
    let mut plain = miniz_oxide::inflate::decompress_to_vec_zlib(&bytes[offset + 8..]).unwrap();
    assert_eq!(plain.len(), 4 * 5 * 3 * 4);
    for i in 1..plain.len() {
        plain[i] = plain[i].wrapping_add(plain[i - 1]).wrapping_sub(128);
    }
    let half = plain.len().div_ceil(2);
    let value = |k: usize| {
        let byte = |i: usize| plain[i / 2 + if i.is_multiple_of(2) { 0 } else { half }];
        f32::from_le_bytes(std::array::from_fn(|b| byte(4 * k + b)))
    };
    // Rows 16 to 19: blue, green, red.
    assert_eq!([value(0), value(5), value(10), value(14)], [1e-3, 1600.0, 0.5, 4.5]);
    assert_eq!(value(15 + 5), 1700.0);
}

#[cfg(feature = "exr")]
#[test]
fn files_round_trip() {
    for (width, height) in [(1, 1), (7, 16), (5, 37)] {
        let image = RgbF32::from_fn(width, height, |x, y| {
            [x as f32 * 1e4, y as f32 + 0.25, ((x * 31 + y * 17) % 7) as f32 * 1e-5]
        });
        let read = cv_io::decode_image(&encode_exr(image.view()).unwrap(), &cv_io::ReadOptions::default()).unwrap();
        assert_eq!(read.pixels, cv_io::Pixels::RgbF32(image));
    }
}
