//! Detection of image formats by their first bytes, whatever the file name.

use crate::FormatError;
use crate::codec::Format;

pub(crate) const IMAGE_FORMATS: &str = "a PNG, JPEG, TIFF, WebP, BMP, PNM, OpenEXR or Radiance HDR image";

/// Detects the image format of `bytes`; the error names other known formats.
pub(crate) fn image_format(bytes: &[u8]) -> Result<Format, FormatError> {
    if bytes.is_empty() {
        return Err(FormatError::Empty);
    }
    let brand = (bytes.get(4..8) == Some(b"ftyp")).then(|| bytes.get(8..12)).flatten();
    let other = match bytes {
        _ if matches!(brand, Some(b"avif" | b"avis")) => Some(("AVIF", "this image format")),
        _ if matches!(brand, Some(b"heic" | b"heix" | b"hevc" | b"mif1" | b"msf1")) => {
            Some(("HEIC", "this image format"))
        }
        _ if brand == Some(b"crx ") => Some(("CR3", "raw sensor data")),
        _ if brand.is_some() => Some(("MP4", "a video")),
        [b'I', b'I', b'*', 0, _, _, _, _, b'C', b'R', ..] => Some(("CR2", "raw sensor data")),
        [b'G', b'I', b'F', b'8', ..] => Some(("GIF", "this image format")),
        [0xff, 0x0a, ..] | [0, 0, 0, 0x0c, b'J', b'X', b'L', b' ', ..] => Some(("JPEG XL", "this image format")),
        [0, 0, 0, 0x0c, b'j', b'P', ..] | [0xff, 0x4f, 0xff, 0x51, ..] => Some(("JPEG 2000", "this image format")),
        [b'8', b'B', b'P', b'S', ..] => Some(("PSD", "this image format")),
        [b'%', b'P', b'D', b'F', ..] => Some(("PDF", "a document")),
        [b'P', b'7', b'\n' | b'\r' | b' ', ..] => Some(("PAM", "this image format")),
        [b'P', b'F' | b'f', b'\n' | b'\r' | b' ', ..] => Some(("PFM", "a float map where an image is expected")),
        [0x93, b'N', b'U', b'M', b'P', b'Y', ..] => Some(("npy", "an array where an image is expected")),
        [b'P', b'K', 3, 4, ..] => Some(("ZIP or npz", "an archive where an image is expected")),
        [b'<', b's', b'v', b'g', ..] => Some(("SVG", "a vector drawing")),
        _ => None,
    };
    if let Some((format, what)) = other {
        return Err(FormatError::unsupported_picture(format, what));
    }
    match bytes {
        [0x89, b'P', b'N', b'G', b'\r', b'\n', 0x1a, b'\n', ..] => Ok(Format::Png),
        [0xff, 0xd8, 0xff, ..] => Ok(Format::Jpeg),
        // The second word is BigTIFF's: the same format with 64-bit offsets.
        [b'I', b'I', b'*' | b'+', 0, ..] | [b'M', b'M', 0, b'*' | b'+', ..] => Ok(Format::Tiff),
        [b'B', b'M', ..] => Ok(Format::Bmp),
        [b'P', b'1'..=b'6', space, ..] if space.is_ascii_whitespace() || *space == b'#' => Ok(Format::Pnm),
        [0x76, 0x2f, 0x31, 0x01, ..] => Ok(Format::OpenExr),
        [b'#', b'?', b'R', b'A', b'D', b'I', b'A', b'N', b'C', b'E', ..] | [b'#', b'?', b'R', b'G', b'B', b'E', ..] => {
            Ok(Format::Hdr)
        }
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => Ok(Format::WebP),
        _ => Err(FormatError::UnknownFormat { expected: IMAGE_FORMATS }),
    }
}

/// Checks cheaply that the file size is sufficient for the header's pixels, before allocation.
pub(crate) fn check_plausible(format: Format, bytes: &[u8], width: u64, height: u64) -> Result<(), FormatError> {
    let name = format.name();
    let len = bytes.len() as u64;
    let possible = match format {
        // Deflate compresses at most 1032 to 1; a pixel takes at least one bit.
        Format::Png => len.saturating_mul(1032 * 8),
        // Every 8×8 block of the first component takes at least one bit.
        Format::Jpeg => len.saturating_mul(8 * 64 * 4),
        // Without compression, at least one bit per pixel.
        Format::Bmp | Format::Pnm => len.saturating_mul(8),
        // A row takes at least four bytes: a pixel, or its run-length header.
        Format::Hdr => (len / 4).saturating_mul(width),
        _ => u64::MAX,
    };
    if width.saturating_mul(height) > possible {
        return Err(FormatError::corrupt(
            name,
            format!("{len} bytes cannot hold the {width}×{height} pixels of the header"),
        ));
    }
    if format == Format::Jpeg && !jpeg_has_end(bytes) {
        return Err(FormatError::Truncated { format: name });
    }
    Ok(())
}

/// Whether the markers of a JPEG lead to its end-of-image marker: the decoder silently fills missing data with gray.
fn jpeg_has_end(bytes: &[u8]) -> bool {
    // This pair cannot occur inside entropy-coded data.
    if bytes.ends_with(&[0xff, 0xd9]) {
        return true;
    }
    let mut at = 2;
    let mut in_scan = false;
    while at + 1 < bytes.len() {
        if bytes[at] != 0xff {
            if !in_scan {
                // Stray bytes between segments: decoders skip them too.
                at += 1;
                continue;
            }
            match bytes[at..].iter().position(|&b| b == 0xff) {
                Some(step) => at += step,
                None => return false,
            }
            continue;
        }
        match bytes[at + 1] {
            0xd9 => return true,
            // Padding, an escaped 0xff, a restart marker.
            0xff => at += 1,
            0x00 | 0x01 | 0xd0..=0xd8 => at += 2,
            marker => {
                let Some(&[high, low]) = bytes.get(at + 2..at + 4) else { return false };
                in_scan = marker == 0xda || (in_scan && marker == 0xdc);
                at += 2 + usize::from(u16::from_be_bytes([high, low])).max(2);
            }
        }
    }
    false
}
