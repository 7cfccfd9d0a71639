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
