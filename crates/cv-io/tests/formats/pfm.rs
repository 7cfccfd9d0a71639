//! PFM.

use cv_core::{GrayF32, ImageView, RgbF32};
use cv_io::pfm::{Pfm, decode, decode_with, encode};
use cv_io::{FormatError, ReadOptions};
use proptest::prelude::*;

fn bytes_of<const C: usize>(view: ImageView<'_, f32, C>) -> Vec<u8> {
    let mut bytes = Vec::new();
    encode(view, &mut bytes).unwrap();
    bytes
}

#[test]
fn rows_are_bottom_up_and_the_sign_is_the_byte_order() {
    let mut file = b"Pf\n2 2\n-1.0\n".to_vec();
    [3.0f32, 4.0, 1.0, f32::INFINITY].iter().for_each(|v| file.extend(v.to_le_bytes()));
    let mut big = b"Pf 2\n2\r\n0.0039\n".to_vec();
    [3.0f32, 4.0, 1.0, f32::INFINITY].iter().for_each(|v| big.extend(v.to_be_bytes()));
    for file in [file, big] {
        let Pfm::Gray(image) = decode(&file).unwrap() else { panic!("one channel") };
        assert_eq!((image.at(0, 0), image.at(0, 1), image.at(1, 1)), ([1.0], [3.0], [4.0]));
        assert!(image.at(1, 0)[0].is_nan());
    }
}

#[test]
fn false_headers_are_refused() {
    let truth = bytes_of(GrayF32::new(3, 2, [0.5]).view());
    assert!(matches!(decode(&truth[..truth.len() - 1]), Err(FormatError::Truncated { .. })));
    let mut longer = truth.clone();
    longer.push(0);
    assert!(matches!(decode(&longer), Err(FormatError::Corrupt { .. })));
    for (header, what) in [
        ("Pf\n4000000000 4000000000\n-1\n", "pixels"),
        ("Pf\n-3 2\n-1\n", "whole numbers"),
        ("Pf\n3 2\n0\n", "scale"),
        ("Pf\n3 2\nnan\n", "scale"),
        ("Pg\n3 2\n-1\n", "PFM"),
        ("Pf\n", "whole numbers"),
    ] {
        let mut file = header.as_bytes().to_vec();
        file.extend([0; 24]);
        let error = decode(&file).unwrap_err().to_string();
        assert!(error.contains(what), "{header:?}: {error}");
    }
}

#[test]
fn the_memory_of_a_map_is_checked_by_its_header() {
    let bytes = bytes_of(GrayF32::new(300, 200, [0.5]).view());
    let within = |max_memory| decode_with(&bytes, &ReadOptions { max_memory, ..ReadOptions::default() });
    let needed = bytes.len() as u64 + 4 * 300 * 200;
    assert!(within(needed).is_ok());
    let error = within(needed - 1).unwrap_err();
    assert!(matches!(error, FormatError::TooMuchMemory { size: Some((300, 200)), .. }), "{error}");
}

proptest! {
    #[test]
    fn maps_round_trip(w in 0usize..7, h in 0usize..7, values in prop::collection::vec(prop::num::f32::ANY, 147)) {
        let image = RgbF32::from_fn(w, h, |x, y| std::array::from_fn(|c| values[(y * w + x) * 3 + c]));
        let Ok(Pfm::Rgb(back)) = decode(&bytes_of(image.view())) else { return Err(TestCaseError::fail("color")) };
        prop_assert_eq!(back.size(), image.size());
        for (a, b) in image.as_slice().iter().zip(back.as_slice()) {
            prop_assert!(a == b || (!a.is_finite() && b.is_nan()), "{} {}", a, b);
        }
    }
}
