//! Writing TIFF: strips with Deflate compression after horizontal differencing (TIFF 6.0, section 14, and Adobe's technical note on Deflate),
//! little-endian.

use crate::{FormatError, Metadata};
use exif::experimental::Writer;
use exif::{Context, Field, In, Tag, Value};
use std::io::Cursor;

/// Approximate bytes of a strip before compression.
const STRIP_BYTES: usize = 1 << 18;
/// Deflate compression level, 0 to 10: higher levels shrink 16-bit photographs little more.
const COMPRESSION_LEVEL: u8 = 3;

/// The samples of an image: row-major, big-endian, without padding.
pub(crate) struct Samples<'a> {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// 1 (gray), 3 (RGB) or 4 (RGB and alpha).
    pub(crate) channels: usize,
    /// Bytes per sample: 1 or 2.
    pub(crate) depth: usize,
    pub(crate) bytes: &'a [u8],
}

/// Encodes a TIFF file.
///
/// # Errors
/// [`FormatError::NotRepresentable`] for an empty image, and for more bytes than 32-bit offsets can address.
pub(crate) fn encode_samples(samples: &Samples<'_>, metadata: &Metadata) -> Result<Vec<u8>, FormatError> {
    let Samples { width, height, channels, depth, bytes } = *samples;
    let side = |n: usize| u32::try_from(n).ok().filter(|&n| n > 0);
    let (Some(w), Some(h)) = (side(width), side(height)) else {
        return Err(FormatError::NotRepresentable { format: "TIFF", what: format!("an image of {width}×{height}") });
    };
    let row = width * channels * depth;
    let rows = (STRIP_BYTES / row).clamp(1, height);
    let mut strips = Vec::with_capacity(height.div_ceil(rows));
    let mut plain = Vec::with_capacity(rows * row);
    for strip in bytes.chunks(rows * row) {
        plain.clear();
        plain.extend_from_slice(strip);
        plain
            .chunks_exact_mut(row)
            .for_each(|row| if depth == 1 { difference_u8(row, channels) } else { difference_u16(row, channels) });
        strips.push(miniz_oxide::deflate::compress_to_vec_zlib(&plain, COMPRESSION_LEVEL));
    }
    // Fields take far less than a tenth.
    if strips.iter().map(Vec::len).sum::<usize>() as u64 > u64::from(u32::MAX) / 10 * 9 {
        return Err(FormatError::NotRepresentable { format: "TIFF", what: "more than 4 GB".to_owned() });
    }
    let numbers = |tag: Tag, values: &[u16]| Field { tag, ifd_num: In::PRIMARY, value: Value::Short(values.to_vec()) };
    let number = |tag: Tag, value: u32| Field { tag, ifd_num: In::PRIMARY, value: Value::Long(vec![value]) };
    let mut fields = metadata.tiff_fields(w, h);
    fields.extend([
        number(Tag::ImageWidth, w),
        number(Tag::ImageLength, h),
        numbers(Tag::BitsPerSample, &vec![8 * depth as u16; channels]),
        numbers(Tag::Compression, &[8]),
        numbers(Tag::PhotometricInterpretation, &[if channels == 1 { 1 } else { 2 }]),
        numbers(Tag::SamplesPerPixel, &[channels as u16]),
        number(Tag::RowsPerStrip, rows as u32),
        numbers(Tag::PlanarConfiguration, &[1]),
        // Horizontal differencing.
        numbers(Tag(Context::Tiff, 317), &[2]),
    ]);
    if channels == 4 {
        // Unassociated alpha.
        fields.push(numbers(Tag(Context::Tiff, 338), &[2]));
    }
    if let Some(profile) = metadata.icc_for(channels) {
        let value = Value::Undefined(profile.to_vec(), 0);
        fields.push(Field { tag: Tag(Context::Tiff, 34675), ifd_num: In::PRIMARY, value });
    }
    let strips: Vec<&[u8]> = strips.iter().map(Vec::as_slice).collect();
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    writer.set_strips(&strips, In::PRIMARY);
    let mut file = Cursor::new(Vec::new());
    writer.write(&mut file, true).map_err(|e| FormatError::corrupt("TIFF", e.to_string()))?;
    Ok(file.into_inner())
}

/// Applies horizontal differencing to 8-bit samples.
fn difference_u8(row: &mut [u8], channels: usize) {
    for i in (channels..row.len()).rev() {
        row[i] = row[i].wrapping_sub(row[i - channels]);
    }
}

/// Applies horizontal differencing to 16-bit samples and converts them to little-endian.
fn difference_u16(row: &mut [u8], channels: usize) {
    let words = row.as_chunks_mut::<2>().0;
    for i in (0..words.len()).rev() {
        let before = i.checked_sub(channels).map_or(0, |j| u16::from_be_bytes(words[j]));
        words[i] = u16::from_be_bytes(words[i]).wrapping_sub(before).to_le_bytes();
    }
}
