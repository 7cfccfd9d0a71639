//! Float maps of every format.

use cv_core::{GrayF32, GrayU8, Image};
use cv_io::npy::{NpyArray, NpyData};
use cv_io::{decode_map, npy, npz, pfm, read_map};

#[test]
fn every_format_gives_the_same_map() {
    let folder = tempfile::tempdir().unwrap();
    let map = GrayF32::from_vec(3, 2, vec![1.0, 2.5, f32::NAN, 4.0, 0.25, 63.75]).unwrap();
    let path = |name: &str| folder.path().join(name);
    // Misleading names: the format is detected by content.
    pfm::write(path("a.png"), map.view()).unwrap();
    let infinite = map.map(|[v]| [if v.is_nan() { f32::NEG_INFINITY } else { v }]);
    let array = NpyArray::from_view(infinite.view());
    npy::write(path("b.pfm"), &array).unwrap();
    let other = NpyArray { shape: vec![5], data: NpyData::U8(vec![0; 5]) };
    npz::write(path("c.npy"), &[("note", &other), ("map", &array)], true).unwrap();
    cv_io::kitti::write(path("d.npz"), map.view()).unwrap();
    cv_io::scaled::write(path("e.bmp"), map.view(), 4.0).unwrap();
    for (name, scale) in [("a.png", None), ("b.pfm", None), ("c.npy", Some(9.0)), ("d.npz", None), ("e.bmp", Some(4.0))]
    {
        let back = read_map(path(name), scale).unwrap();
        let same = |(a, b): (&f32, &f32)| a == b || (a.is_nan() && b.is_nan());
        assert!(back.as_slice().iter().zip(map.as_slice()).all(same), "{name}: {back:?}");
    }
    assert!(read_map(path("e.bmp"), None).unwrap_err().to_string().contains("scale"));
    npz::write(path("f"), &[("x", &array), ("y", &array)], false).unwrap();
    assert!(read_map(path("f"), None).unwrap_err().to_string().contains("x, y"));
}

#[test]
fn color_is_not_a_map() {
    let color = cv_io::encode_png(Image::<u8, 3>::new(2, 2, [1, 2, 3]).view()).unwrap();
    assert!(decode_map(&color, Some(4.0)).is_err());
    let gray = cv_io::encode_png(GrayU8::new(2, 2, [8]).view()).unwrap();
    assert_eq!(decode_map(&gray, Some(4.0)).unwrap().at(0, 0), [2.0]);
    assert!(decode_map(b"", None).is_err() && decode_map(b"hello", Some(4.0)).is_err());
}
