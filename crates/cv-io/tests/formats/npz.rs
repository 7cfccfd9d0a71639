//! npz.

use cv_io::FormatError;
use cv_io::npy::{NpyArray, NpyData};
use cv_io::npz::{decode, encode};
use proptest::prelude::*;

fn arrays() -> (NpyArray, NpyArray) {
    let a = NpyArray { shape: vec![20, 50], data: NpyData::F32((0..1000).map(|i| (i / 7) as f32).collect()) };
    let b = NpyArray { shape: vec![3], data: NpyData::I16(vec![-1, 0, 1]) };
    (a, b)
}

#[test]
fn stored_and_deflated_archives_round_trip() {
    let (a, b) = arrays();
    for compress in [false, true] {
        let bytes = encode(&[("disparity", &a), ("α", &b)], compress).unwrap();
        assert_eq!(decode(&bytes).unwrap(), [("disparity".to_owned(), a.clone()), ("α".to_owned(), b.clone())]);
    }
    assert!(decode(&encode(&[], true).unwrap()).unwrap().is_empty());
}

#[test]
fn a_flipped_bit_in_the_data_is_detected() {
    let (a, b) = arrays();
    for compress in [false, true] {
        let good = encode(&[("a", &a), ("b", &b)], compress).unwrap();
        let data = 30 + 5 + 10..30 + 5 + 200;
        for at in data {
            let mut bad = good.clone();
            bad[at] ^= 0x10;
            assert!(decode(&bad).is_err(), "byte {at}");
        }
    }
}

#[test]
fn impossible_sizes_are_refused() {
    let (a, _) = arrays();
    let good = encode(&[("a", &a)], true).unwrap();
    let at = good.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    let mut bad = good;
    bad[at + 24..at + 28].copy_from_slice(&0xfff0_0000u32.to_le_bytes());
    assert!(decode(&bad).is_err());
}

#[test]
fn excess_data_is_refused() {
    let (a, _) = arrays();
    let mut bytes = encode(&[("a", &a)], true).unwrap();
    let at = bytes.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    bytes[at + 24..at + 28].copy_from_slice(&100u32.to_le_bytes());
    assert!(matches!(decode(&bytes), Err(FormatError::Corrupt { .. })));
}

proptest! {
    #[test]
    fn damage_never_panics(at in 0usize..2000, value: u8, cut in 0usize..2000, compress: bool) {
        let (a, b) = arrays();
        let mut bytes = encode(&[("a", &a), ("b", &b)], compress).unwrap();
        let len = bytes.len();
        bytes[at % len] = value;
        let _ = decode(&bytes);
        bytes.truncate(cut % len);
        prop_assert!(decode(&bytes).is_err());
    }
}
