//! JPEG, through zune-jpeg.

use super::{Format, Header, Raster, Samples};
use crate::{FormatError, memory};
use zune_jpeg::JpegDecoder;
use zune_jpeg::errors::DecodeErrors;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

pub(super) fn header(bytes: &[u8]) -> Result<Header, FormatError> {
    let decoder = decoder(bytes, DecoderOptions::default())?;
    let size = decoder.dimensions();
    let (width, height) = size.ok_or_else(|| FormatError::corrupt(Format::Jpeg.name(), "it has no size"))?;
    let channels = if decoder.input_colorspace() == Some(ColorSpace::Luma) { 1 } else { 3 };
    // A single scan of all components is decoded row by row; for several scans, all coefficients (16 bits) are kept. Blocks
    // are padded to units of at most 32×32 pixels.
    let components = decoder.info().map_or(4, |info| info.components);
    let side = |pixels: usize| pixels.next_multiple_of(32) as u64;
    let working_memory = if is_single_scan(bytes, components) {
        0
    } else {
        memory::saturating_product(&[side(width), side(height), 2 * u64::from(components)])
    };
    Ok(Header {
        width,
        height,
        channels,
        depth: 1,
        working_memory,
        exif: decoder.exif().cloned(),
        icc: decoder.icc_profile(),
        orientation: None,
    })
}

/// Iterates over the segments of a file: the marker's second byte, and the bytes after the length. Stray and padding bytes between segments are
/// skipped.
fn segments(bytes: &[u8]) -> impl Iterator<Item = (u8, &[u8])> {
    let mut at = 0;
    std::iter::from_fn(move || {
        while let Some(&[marker, kind, high, low]) = bytes.get(at..at + 4) {
            match (marker, kind) {
                (0..=0xfe, _) | (0xff, 0xff) => at += 1,
                (0xff, 0x00 | 0x01 | 0xd0..=0xd8) => at += 2,
                _ => {
                    let content = &bytes[at + 4..];
                    at += 2 + usize::from(u16::from_be_bytes([high, low])).max(2);
                    return Some((kind, content));
                }
            }
        }
        None
    })
}

/// Returns the number of pixels of the largest frame declared before the first scan.
#[cfg(feature = "tiff")]
pub(super) fn frame_pixels(bytes: &[u8]) -> u64 {
    let side = |high, low| u64::from(u16::from_be_bytes([high, low]));
    let frames = segments(bytes).take_while(|(kind, _)| *kind != 0xda);
    let pixels = frames.filter_map(|(kind, content)| match (kind, content) {
        (0xc4 | 0xc8 | 0xcc, _) => None,
        (0xc0..=0xcf, &[_, h1, h2, w1, w2, ..]) => Some(side(h1, h2) * side(w1, w2)),
        _ => None,
    });
    pixels.max().unwrap_or(0)
}

/// Whether the file is sequential and its first scan has all `components`.
fn is_single_scan(bytes: &[u8], components: u8) -> bool {
    for (kind, content) in segments(bytes) {
        match kind {
            // A start of frame other than the sequential ones.
            0xc2 | 0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => return false,
            0xda => return content.first() == Some(&components),
            _ => {}
        }
    }
    false
}

pub(super) fn raster(bytes: &[u8]) -> Result<Raster, FormatError> {
    // CMYK is converted to RGB; gray stays gray.
    let (colors, channels) = match decoder(bytes, DecoderOptions::default())?.input_colorspace() {
        Some(ColorSpace::Luma) => (ColorSpace::Luma, 1),
        _ => (ColorSpace::RGB, 3),
    };
    let mut decoder = decoder(bytes, DecoderOptions::default().jpeg_set_out_colorspace(colors))?;
    Ok(Raster { channels, samples: Samples::U8(decoder.decode().map_err(fail)?) })
}

/// Makes a decoder and reads the headers.
fn decoder(bytes: &[u8], options: DecoderOptions) -> Result<JpegDecoder<ZCursor<&[u8]>>, FormatError> {
    // Lenient, since some cameras violate details of the standard.
    let options = options.set_strict_mode(false).set_max_width(usize::MAX).set_max_height(usize::MAX);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(fail)?;
    Ok(decoder)
}

fn fail(error: DecodeErrors) -> FormatError {
    match error {
        DecodeErrors::Unsupported(what) => FormatError::unsupported_picture(Format::Jpeg.name(), format!("“{what:?}”")),
        error => FormatError::corrupt(Format::Jpeg.name(), error.to_string()),
    }
}
