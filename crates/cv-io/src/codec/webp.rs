//! WebP, through the `image-webp` crate.

use super::{Format, Header, Raster, Samples};
use crate::{FormatError, memory};
use image_webp::{DecodingError, WebPDecoder};
use std::io::{Cursor, ErrorKind};

pub(super) fn header(bytes: &[u8]) -> Result<Header, FormatError> {
    let mut decoder = open(bytes)?;
    let (width, height) = decoder.dimensions();
    // Four bytes per pixel (lossless), or luma and chroma planes padded to blocks of 16×16 pixels (lossy).
    let side = |pixels: u32| u64::from(pixels).next_multiple_of(16);
    let working_memory = memory::saturating_product(&[side(width), side(height), 4]);
    Ok(Header {
        width: width as usize,
        height: height as usize,
        channels: if decoder.has_alpha() { 4 } else { 3 },
        depth: 1,
        working_memory,
        // Damaged blocks are ignored.
        exif: decoder.exif_metadata().ok().flatten(),
        icc: decoder.icc_profile().ok().flatten(),
        orientation: None,
    })
}

pub(super) fn raster(bytes: &[u8]) -> Result<Raster, FormatError> {
    let mut decoder = open(bytes)?;
    let name = Format::WebP.name();
    let size = decoder.output_buffer_size().ok_or_else(|| FormatError::corrupt(name, "it is too large"))?;
    let mut samples = vec![0; size];
    decoder.read_image(&mut samples).map_err(fail)?;
    Ok(Raster { channels: if decoder.has_alpha() { 4 } else { 3 }, samples: Samples::U8(samples) })
}

fn open(bytes: &[u8]) -> Result<WebPDecoder<Cursor<&[u8]>>, FormatError> {
    let mut decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(fail)?;
    decoder.set_memory_limit(super::HEADER_BYTES);
    if decoder.is_animated() {
        return Err(FormatError::unsupported_picture(Format::WebP.name(), "an animation"));
    }
    Ok(decoder)
}

fn fail(error: DecodingError) -> FormatError {
    match error {
        DecodingError::IoError(e) if e.kind() == ErrorKind::UnexpectedEof => {
            FormatError::Truncated { format: Format::WebP.name() }
        }
        error => FormatError::corrupt(Format::WebP.name(), error.to_string()),
    }
}
