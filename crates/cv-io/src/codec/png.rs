//! PNG, through the `png` crate.

use super::{Format, HEADER_BYTES, Header, Raster, Samples};
use crate::{FormatError, memory};
use png::{BitDepth, ColorType, Decoder, DecodingError, Limits, Reader, Transformations};
use std::io::{Cursor, ErrorKind};

pub(super) fn header(bytes: &[u8]) -> Result<Header, FormatError> {
    let reader = reader(bytes)?;
    let info = reader.info();
    let (width, height) = (info.width as usize, info.height as usize);
    let (color, depth) = reader.output_color_type();
    let (channels, deep) = (color.samples(), depth == BitDepth::Sixteen);
    // Interlaced 16-bit images are first decoded as bytes.
    let working_memory = if deep && info.interlaced {
        memory::saturating_product(&[width as u64, height as u64, 2 * channels as u64])
    } else {
        0
    };
    Ok(Header {
        width,
        height,
        channels,
        depth: if deep { 2 } else { 1 },
        working_memory,
        exif: info.exif_metadata.as_ref().map(|block| block.to_vec()),
        icc: info.icc_profile.as_ref().map(|profile| profile.to_vec()),
        orientation: None,
    })
}

pub(super) fn raster(bytes: &[u8]) -> Result<Raster, FormatError> {
    let mut reader = reader(bytes)?;
    let (color, depth) = reader.output_color_type();
    let channels = match color {
        ColorType::Grayscale => 1,
        ColorType::GrayscaleAlpha => 2,
        ColorType::Rgb => 3,
        ColorType::Rgba => 4,
        ColorType::Indexed => return Err(FormatError::corrupt(Format::Png.name(), "it has no palette")),
    };
    let size =
        reader.output_buffer_size().ok_or_else(|| FormatError::corrupt(Format::Png.name(), "it is too large"))?;
    let word = |b: &[u8; 2]| u16::from_be_bytes(*b);
    let samples = if depth == BitDepth::Sixteen && !reader.info().interlaced {
        // Row by row, to save a copy.
        let mut words = Vec::with_capacity(size / 2);
        while let Some(row) = reader.next_row().map_err(fail)? {
            words.extend(row.data().as_chunks::<2>().0.iter().map(word));
        }
        Samples::U16(words)
    } else {
        let mut samples = vec![0; size];
        reader.next_frame(&mut samples).map_err(fail)?;
        match depth {
            BitDepth::Sixteen => Samples::U16(samples.as_chunks::<2>().0.iter().map(word).collect()),
            _ => Samples::U8(samples),
        }
    };
    Ok(Raster { channels, samples })
}

/// Makes a reader that expands palettes to colors, and less than 8 bits to 8.
fn reader(bytes: &[u8]) -> Result<Reader<Cursor<&[u8]>>, FormatError> {
    let mut decoder = Decoder::new_with_limits(Cursor::new(bytes), Limits { bytes: HEADER_BYTES });
    decoder.set_ignore_text_chunk(true);
    decoder.set_transformations(Transformations::EXPAND);
    decoder.read_info().map_err(fail)
}

fn fail(error: DecodingError) -> FormatError {
    match error {
        DecodingError::IoError(e) if e.kind() == ErrorKind::UnexpectedEof => {
            FormatError::Truncated { format: Format::Png.name() }
        }
        error => FormatError::corrupt(Format::Png.name(), error.to_string()),
    }
}
