//! Reading disparity and depth maps of any supported format.

use std::path::Path;

use cv_core::GrayF32;

use crate::files::read_bytes;
use crate::pfm::Pfm;
use crate::{FormatError, IoError, ReadOptions, depth_png, npy, npz, pfm};

/// Reads a map of one channel; the format is detected by content: PFM, NumPy's `.npy` and `.npz` (its only two-dimensional array), or a gray
/// image whose values are `png_scale` times those of the map, 0 = invalid.
///
/// Without `png_scale` a 16-bit gray image is read as KITTI's, 256 per pixel of disparity; an 8-bit one is refused, since its scale
/// is unknown. `png_scale` is ignored for other formats. Invalid values (infinite or NaN) become NaN.
///
/// # Errors
/// [`IoError`]: cannot be opened, is none of these, or as the format's own reader.
pub fn read_map(path: impl AsRef<Path>, png_scale: Option<f64>) -> Result<GrayF32, IoError> {
    let path = path.as_ref();
    let bytes = read_bytes(path)?;
    decode_map(&bytes, png_scale).map_err(|reason| IoError::reading(path, reason))
}

/// As [`read_map`], from the bytes of a file.
///
/// # Errors
/// As [`read_map`].
pub fn decode_map(bytes: &[u8], png_scale: Option<f64>) -> Result<GrayF32, FormatError> {
    let mut map = match bytes {
        [b'P', b'f' | b'F', b'\n' | b'\r' | b' ' | b'\t', ..] => match pfm::decode(bytes)? {
            Pfm::Gray(map) => map,
            Pfm::Rgb(_) => return Err(FormatError::unsupported("PFM", "a color map where one channel is expected")),
        },
        [0x93, b'N', ..] => npy::decode(bytes)?.into_gray()?,
        [b'P', b'K', ..] => npz::decode_map(bytes, &ReadOptions::default())?.into_gray()?,
        _ => return depth_png::decode(bytes, png_scale),
    };
    for v in map.as_mut_slice() {
        if !v.is_finite() {
            *v = f32::NAN;
        }
    }
    Ok(map)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::npy::{NpyArray, NpyData};
    use cv_core::{GrayU8, Image};

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
        crate::kitti::write(path("d.npz"), map.view()).unwrap();
        crate::scaled::write(path("e.bmp"), map.view(), 4.0).unwrap();
        for (name, scale) in
            [("a.png", None), ("b.pfm", None), ("c.npy", Some(9.0)), ("d.npz", None), ("e.bmp", Some(4.0))]
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
        let color = crate::encode_png(Image::<u8, 3>::new(2, 2, [1, 2, 3]).view()).unwrap();
        assert!(decode_map(&color, Some(4.0)).is_err());
        let gray = crate::encode_png(GrayU8::new(2, 2, [8]).view()).unwrap();
        assert_eq!(decode_map(&gray, Some(4.0)).unwrap().at(0, 0), [2.0]);
        assert!(decode_map(b"", None).is_err() && decode_map(b"hello", Some(4.0)).is_err());
    }
}
