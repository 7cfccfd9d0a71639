//! npy.

use cv_io::npy::{NpyArray, NpyData, decode, decode_with, encode};
use cv_io::{FormatError, ReadOptions};
use proptest::prelude::*;

/// The file of `np.array([[1, 2, 3], [4, 5, 6]], '>i2', order='F')`, by the format's definition.
fn fortran_big_endian(version: u8) -> Vec<u8> {
    let header = "{'descr': '>i2', 'fortran_order': True, 'shape': (2, 3), }\n";
    let mut file = b"\x93NUMPY".to_vec();
    file.extend([version, 0]);
    match version {
        1 => file.extend((header.len() as u16).to_le_bytes()),
        _ => file.extend((header.len() as u32).to_le_bytes()),
    }
    file.extend(header.as_bytes());
    [1i16, 4, 2, 5, 3, 6].iter().for_each(|v| file.extend(v.to_be_bytes()));
    file
}

#[test]
fn fortran_order_and_big_endian_in_every_version() {
    for version in 1..=3 {
        let array = decode(&fortran_big_endian(version)).unwrap();
        assert_eq!(array, NpyArray { shape: vec![2, 3], data: NpyData::I16(vec![1, 2, 3, 4, 5, 6]) });
    }
    assert!(matches!(decode(&fortran_big_endian(4)), Err(FormatError::Unsupported { .. })));
}

#[test]
fn false_headers_are_refused() {
    let good = fortran_big_endian(1);
    assert!(matches!(decode(&good[..good.len() - 1]), Err(FormatError::Truncated { .. })));
    let with = |from: &str, to: &str| {
        let text = "{'descr': '>i2', 'fortran_order': True, 'shape': (2, 3), }\n".replace(from, to);
        let mut file = b"\x93NUMPY".to_vec();
        file.extend([1, 0]);
        file.extend((text.len() as u16).to_le_bytes());
        file.extend(text.as_bytes());
        file.extend([0; 12]);
        decode(&file)
    };
    assert!(with("2, 3", "2, 3").is_ok());
    for shape in ["1, 3", "9999999999, 9999999999", "99999999999", "3, -1", "2.0, 3"] {
        assert!(with("2, 3", shape).is_err(), "{shape}");
    }
    for dtype in ["O", "<c16", "<U5", "<f2", ""] {
        assert!(matches!(with(">i2", dtype), Err(FormatError::Unsupported { .. })), "{dtype}");
    }
    assert!(with("True", "1").is_err() && with("shape", "shpe").is_err());
}

#[test]
fn the_memory_of_an_array_is_checked_by_its_header() {
    let array = NpyArray { shape: vec![100, 200], data: NpyData::F32(vec![1.0; 20_000]) };
    let bytes = encode(&array).unwrap();
    let within = |max_memory| decode_with(&bytes, &ReadOptions { max_memory, ..ReadOptions::default() });
    let needed = bytes.len() as u64 + 80_000;
    assert_eq!(within(needed).unwrap(), array);
    let error = within(needed - 1).unwrap_err();
    assert!(matches!(error, FormatError::TooMuchMemory { needed: n, .. } if n == needed), "{error}");
    assert_eq!(array.to_gray().unwrap(), array.clone().into_gray().unwrap());
}

#[test]
fn long_axes_of_empty_arrays_are_refused() {
    let empty =
        |shape: &[usize]| decode(&encode(&NpyArray { shape: shape.to_vec(), data: NpyData::F32(Vec::new()) }).unwrap());
    for shape in [[40_000_000_000, 0], [0, 40_000_000_000]] {
        assert!(matches!(empty(&shape), Err(FormatError::Corrupt { .. })), "{shape:?}");
    }
    assert_eq!(empty(&[0, 512]).unwrap().shape, [0, 512]);
    assert!(matches!(cv_io::pfm::decode(b"Pf\n0 4294967295\n-1\n"), Err(FormatError::Corrupt { .. })));
}

proptest! {
    #[test]
    fn arrays_round_trip(shape in prop::collection::vec(0usize..5, 0..4), seed in any::<u64>(), kind in 0..5) {
        let count = shape.iter().product::<usize>();
        let values: Vec<u64> = (0..count as u64).map(|i| (seed ^ i).wrapping_mul(0x9e37_79b9_7f4a_7c15)).collect();
        let data = match kind {
            0 => NpyData::Bool(values.iter().map(|v| v & 1 == 1).collect()),
            1 => NpyData::I8(values.iter().map(|&v| v as i8).collect()),
            2 => NpyData::U16(values.iter().map(|&v| v as u16).collect()),
            3 => NpyData::F32(values.iter().map(|&v| v as f32).collect()),
            _ => NpyData::F64(values.iter().map(|&v| v as f64).collect()),
        };
        let array = NpyArray { shape, data };
        let bytes = encode(&array).unwrap();
        prop_assert_eq!(&decode(&bytes).unwrap(), &array);
        // Alignment of the values, as the format requires.
        let header = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        prop_assert_eq!((10 + header) % 64, 0);
    }
}
