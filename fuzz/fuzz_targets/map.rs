//! Float maps and arrays: what decodes can be written and decodes to the same again.
#![no_main]

use cv_io::{npy, npz, pfm};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(pfm::Pfm::Gray(map)) = pfm::decode(bytes) {
        let mut again = Vec::new();
        pfm::encode(map.view(), &mut again).unwrap();
        let Ok(pfm::Pfm::Gray(back)) = pfm::decode(&again) else { panic!("what was written does not read") };
        assert!(map.as_slice().iter().zip(back.as_slice()).all(|(a, b)| a == b || (a.is_nan() && b.is_nan())));
    }
    if let Ok(array) = npy::decode(bytes) {
        let again = npy::encode(&array).unwrap();
        assert_eq!(npy::decode(&again).unwrap().shape, array.shape);
    }
    let _ = npz::decode(bytes);
});
