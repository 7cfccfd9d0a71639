//! Writing OpenEXR: one layer of 32-bit float RGB with ZIP compression, in blocks of 16 rows ("OpenEXR File Layout", and `ImfZip.cpp` for the order of
//! bytes in a block).

use crate::files::write_bytes;
use crate::{FormatError, IoError};
use cv_core::ImageView;
use std::path::Path;

/// Rows per block of ZIP compression.
const ROWS_PER_BLOCK: usize = 16;
/// Deflate compression level, 0 to 10.
const COMPRESSION_LEVEL: u8 = 3;

/// Encodes an OpenEXR file of linear RGB in 32-bit floats, 1 for display white. O(pixels).
///
/// # Errors
/// [`FormatError::NotRepresentable`] for an empty image or one whose sides exceed 2³¹ − 1.
pub fn encode_exr(view: ImageView<'_, f32, 3>) -> Result<Vec<u8>, FormatError> {
    let (width, height) = view.size();
    let last = |n: usize| i32::try_from(n).ok().filter(|&n| n > 0).map(|n| n - 1);
    let (Some(right), Some(bottom)) = (last(width), last(height)) else {
        return Err(FormatError::NotRepresentable {
            format: "OpenEXR", what: format!("an image of {width}×{height}")
        });
    };
    let mut bytes = vec![0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0];
    let mut attribute = |name: &str, kind: &str, value: &[u8]| {
        bytes.extend(
            [name.as_bytes(), b"\0", kind.as_bytes(), b"\0", &(value.len() as i32).to_le_bytes(), value].concat(),
        );
    };
    // Channels in the order of their names, as their rows: floats, not subsampled.
    let mut channels = Vec::new();
    for name in [b'B', b'G', b'R'] {
        channels.extend([name, 0]);
        [2_i32, 0, 1, 1].iter().for_each(|v| channels.extend(v.to_le_bytes()));
    }
    channels.push(0);
    attribute("channels", "chlist", &channels);
    attribute("compression", "compression", &[3]);
    let window: Vec<u8> = [0, 0, right, bottom].iter().flat_map(|v| v.to_le_bytes()).collect();
    attribute("dataWindow", "box2i", &window);
    attribute("displayWindow", "box2i", &window);
    attribute("lineOrder", "lineOrder", &[0]);
    attribute("pixelAspectRatio", "float", &1_f32.to_le_bytes());
    attribute("screenWindowCenter", "v2f", &[0; 8]);
    attribute("screenWindowWidth", "float", &1_f32.to_le_bytes());
    bytes.push(0);
    let blocks = height.div_ceil(ROWS_PER_BLOCK);
    let table = bytes.len();
    bytes.resize(table + 8 * blocks, 0);
    let (mut plain, mut ordered) = (Vec::new(), Vec::<u8>::new());
    for block in 0..blocks {
        plain.clear();
        let rows = ROWS_PER_BLOCK * block..(ROWS_PER_BLOCK * (block + 1)).min(height);
        for y in rows.clone() {
            let row = view.row(y).as_chunks::<3>().0;
            [2, 1, 0].iter().for_each(|&c| plain.extend(row.iter().flat_map(|pixel| pixel[c].to_le_bytes())));
        }
        // Even bytes, then odd ones, each as the difference to its predecessor.
        ordered.clear();
        ordered.extend(plain.iter().step_by(2).chain(plain.iter().skip(1).step_by(2)));
        for i in (1..ordered.len()).rev() {
            ordered[i] = ordered[i].wrapping_sub(ordered[i - 1]).wrapping_add(128);
        }
        let packed = miniz_oxide::deflate::compress_to_vec_zlib(&ordered, COMPRESSION_LEVEL);
        let data = if packed.len() < plain.len() { &packed } else { &plain };
        let offset = bytes.len() as u64;
        bytes[table + 8 * block..][..8].copy_from_slice(&offset.to_le_bytes());
        bytes.extend((rows.start as i32).to_le_bytes());
        bytes.extend((data.len() as i32).to_le_bytes());
        bytes.extend_from_slice(data);
    }
    Ok(bytes)
}

/// Writes an OpenEXR file.
///
/// # Errors
/// As [`encode_exr`] and [`crate::write_atomic`].
pub fn write_exr(path: impl AsRef<Path>, view: ImageView<'_, f32, 3>) -> Result<(), IoError> {
    let path = path.as_ref();
    write_bytes(path, &encode_exr(view).map_err(|reason| IoError::writing(path, reason))?)
}
