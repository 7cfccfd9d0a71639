//! Windows bitmaps without compression: palettes of 1, 4 and 8 bits, 16 and 32 bits with masks, 24 bits.

use super::{Format, Header, Raster, Samples, sample_count};
use crate::FormatError;

const NAME: &str = "BMP";

/// The headers (BITMAPFILEHEADER, then BITMAPCOREHEADER or BITMAPINFOHEADER and its successors).
struct FileHeader {
    width: usize,
    height: usize,
    top_down: bool,
    bits: usize,
    /// Offset of the pixel data.
    at: usize,
    /// RGB color of each entry.
    palette: Vec<[u8; 3]>,
    /// Bit masks of red, green and blue.
    masks: [u32; 3],
}

pub(super) fn header(bytes: &[u8]) -> Result<Header, FormatError> {
    let start = parse_header(bytes)?;
    Ok(Header { width: start.width, height: start.height, channels: 3, depth: 1, ..Header::default() })
}

pub(super) fn raster(bytes: &[u8]) -> Result<Raster, FormatError> {
    let start = parse_header(bytes)?;
    // Rows are padded to four bytes.
    let stride = sample_count(Format::Bmp, start.width, start.bits, 1)?.div_ceil(32) * 4;
    let length = sample_count(Format::Bmp, stride, start.height, 1)?;
    let stored = bytes.get(start.at..).and_then(|rest| rest.get(..length));
    let stored = stored.ok_or(FormatError::Truncated { format: NAME })?;
    let mut samples = Vec::with_capacity(sample_count(Format::Bmp, start.width, start.height, 3)?);
    for y in 0..start.height {
        let row = if start.top_down { y } else { start.height - 1 - y };
        let row = &stored[row * stride..][..stride];
        for x in 0..start.width {
            samples.extend(match start.bits {
                24 => [row[3 * x + 2], row[3 * x + 1], row[3 * x]],
                16 => extract_masked(u32::from(u16::from_le_bytes([row[2 * x], row[2 * x + 1]])), start.masks),
                32 => extract_masked(u32_at(row, 4 * x)?, start.masks),
                bits => {
                    let per_byte = 8 / bits;
                    let shift = 8 - bits * (x % per_byte + 1);
                    let index = usize::from(row[x / per_byte] >> shift) & ((1 << bits) - 1);
                    *start.palette.get(index).ok_or_else(|| FormatError::corrupt(NAME, "the palette is too short"))?
                }
            });
        }
    }
    Ok(Raster { channels: 3, samples: Samples::U8(samples) })
}

fn parse_header(bytes: &[u8]) -> Result<FileHeader, FormatError> {
    let at = u32_at(bytes, 10)? as usize;
    let size = u32_at(bytes, 14)? as usize;
    let core = size == 12;
    if !core && size < 40 {
        return Err(FormatError::unsupported_picture(NAME, format!("a header of {size} bytes")));
    }
    let (width, height, bits) = if core {
        (i32::from(u16_at(bytes, 18)?), i32::from(u16_at(bytes, 20)?), u16_at(bytes, 24)?)
    } else {
        (u32_at(bytes, 18)?.cast_signed(), u32_at(bytes, 22)?.cast_signed(), u16_at(bytes, 28)?)
    };
    let compression = if core { 0 } else { u32_at(bytes, 30)? };
    let masks = match (bits, compression) {
        // 3 and 6: masks of red, green, blue (and alpha) follow the first 40 bytes.
        (16 | 32, 3 | 6) => [u32_at(bytes, 54)?, u32_at(bytes, 58)?, u32_at(bytes, 62)?],
        (16, 0) => [0x7c00, 0x03e0, 0x001f],
        (1 | 4 | 8 | 24 | 32, 0) => [0x00ff_0000, 0x0000_ff00, 0x0000_00ff],
        _ => {
            return Err(FormatError::unsupported_picture(
                NAME,
                format!("{bits} bits a pixel, compression {compression}"),
            ));
        }
    };
    if masks.contains(&0) {
        return Err(FormatError::corrupt(NAME, "a color has no bits"));
    }
    let entry = if core { 3 } else { 4 };
    let palette = if bits <= 8 {
        let table = bytes.get(14 + size..at).ok_or(FormatError::Truncated { format: NAME })?;
        table.chunks_exact(entry).take(1 << bits).map(|bgr| [bgr[2], bgr[1], bgr[0]]).collect()
    } else {
        Vec::new()
    };
    Ok(FileHeader {
        width: width.max(0) as usize,
        height: height.unsigned_abs() as usize,
        top_down: height < 0,
        bits: usize::from(bits),
        at,
        palette,
        masks,
    })
}

/// Extracts the bits under each mask, scaled to 0 to 255.
fn extract_masked(pixel: u32, masks: [u32; 3]) -> [u8; 3] {
    masks.map(|mask| {
        let shift = mask.trailing_zeros();
        let (value, full) = (u64::from((pixel & mask) >> shift), u64::from(mask >> shift));
        ((value * 255 + full / 2) / full) as u8
    })
}

fn u16_at(bytes: &[u8], at: usize) -> Result<u16, FormatError> {
    match bytes.get(at..at + 2) {
        Some(&[a, b]) => Ok(u16::from_le_bytes([a, b])),
        _ => Err(FormatError::Truncated { format: NAME }),
    }
}

fn u32_at(bytes: &[u8], at: usize) -> Result<u32, FormatError> {
    Ok(u32::from(u16_at(bytes, at)?) | u32::from(u16_at(bytes, at + 2)?) << 16)
}
