//! TIFF, through the `tiff` crate: gray, RGB and CMYK of 8 and 16 bits and floats, interleaved or planar.

use super::{Format, HEADER_BYTES, Header, Raster, Samples, sample_count};
use crate::metadata::exif_of_tiff;
use crate::{FormatError, memory};
use std::io::{Cursor, ErrorKind};
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

const NAME: &str = "TIFF";

pub(super) fn header(bytes: &[u8]) -> Result<Header, FormatError> {
    let mut decoder = open(bytes)?;
    let (width, height) = decoder.dimensions().map_err(fail)?;
    // A damaged tag is ignored.
    let orientation = decoder.find_tag_unsigned::<u8>(Tag::Orientation).ok().flatten();
    let icc = decoder.find_tag(Tag::IccProfile).ok().flatten().and_then(|profile| profile.into_u8_vec().ok());
    // Unsupported layouts are refused when decoding.
    let (channels, depth, planes) = pixel_layout(&mut decoder).unwrap_or((4, 4, false));
    let cmyk = decoder.colortype().is_ok_and(|color| matches!(color, ColorType::CMYK(_)));
    let copy = memory::saturating_product(&[u64::from(width), u64::from(height), (channels * depth) as u64]);
    // Planar and CMYK samples are copied; a JPEG strip or tile is decompressed as a whole.
    let chunk = jpeg_chunk(&mut decoder, bytes);
    let working_memory = chunk.max(copy.saturating_mul(u64::from(planes) + u64::from(cmyk)));
    let channels = if cmyk { 3 } else { channels };
    Ok(Header {
        width: width as usize,
        height: height as usize,
        channels,
        depth,
        working_memory,
        exif: exif_of_tiff(bytes),
        icc,
        orientation,
    })
}

/// Computes the maximum bytes for a JPEG strip or tile, by its own header, which may differ from that of the image: four bytes per pixel and
/// as many 16-bit coefficients. 0 without JPEG compression.
fn jpeg_chunk(decoder: &mut Decoder<Cursor<&[u8]>>, bytes: &[u8]) -> u64 {
    if decoder.find_tag_unsigned::<u16>(Tag::Compression).ok().flatten() != Some(7) {
        return 0;
    }
    let mut list = |tag: Tag| decoder.find_tag_unsigned_vec::<u64>(tag).ok().flatten().unwrap_or_default();
    let mut chunks = list(Tag::StripOffsets);
    chunks.extend(list(Tag::TileOffsets));
    let mut lengths = list(Tag::StripByteCounts);
    lengths.extend(list(Tag::TileByteCounts));
    let part = |(at, length): (&u64, &u64)| {
        let start = usize::try_from(*at).unwrap_or(usize::MAX).min(bytes.len());
        &bytes[start..][..usize::try_from(*length).unwrap_or(usize::MAX).min(bytes.len() - start)]
    };
    let most = chunks.iter().zip(&lengths).map(|chunk| super::jpeg::frame_pixels(part(chunk))).max().unwrap_or(0);
    let tables = decoder.find_tag(Tag::JPEGTables).ok().flatten().and_then(|tables| tables.into_u8_vec().ok());
    most.max(tables.map_or(0, |tables| super::jpeg::frame_pixels(&tables))).saturating_mul(12)
}

/// Returns the stored channels, the bytes per sample in memory, and whether the layout is planar.
fn pixel_layout(decoder: &mut Decoder<Cursor<&[u8]>>) -> Result<(usize, usize, bool), FormatError> {
    let (channels, bits) = match decoder.colortype().map_err(fail)? {
        ColorType::Gray(bits @ (1 | 8 | 16 | 32)) => (1, bits),
        ColorType::GrayA(bits @ (8 | 16)) => (2, bits),
        ColorType::RGB(bits @ (8 | 16 | 32)) => (3, bits),
        ColorType::RGBA(bits @ (8 | 16 | 32)) => (4, bits),
        ColorType::CMYK(bits @ (8 | 16)) => (4, bits),
        other => return Err(FormatError::unsupported_picture(NAME, format!("the pixel type {other:?}"))),
    };
    let planes = decoder.find_tag_unsigned::<u16>(Tag::PlanarConfiguration).ok().flatten() == Some(2);
    Ok((channels, usize::from(bits).div_ceil(8), planes))
}

pub(super) fn raster(bytes: &[u8]) -> Result<Raster, FormatError> {
    let mut decoder = open(bytes)?;
    let (width, height) = decoder.dimensions().map_err(fail)?;
    let (width, height) = (width as usize, height as usize);
    let color = decoder.colortype().map_err(fail)?;
    let stored = pixel_layout(&mut decoder)?.0;
    // Limits: the samples, and as much again plus the header limit for strips.
    let mut limits = Limits::default();
    limits.decoding_buffer_size = sample_count(Format::Tiff, width, height, 4 * stored)?;
    limits.intermediate_buffer_size = limits.decoding_buffer_size.saturating_add(HEADER_BYTES);
    limits.ifd_value_size = limits.intermediate_buffer_size;
    let mut decoder = decoder.with_limits(limits);
    let mut result = DecodingResult::U8(Vec::new());
    let layout = decoder.read_image_to_buffer(&mut result).map_err(fail)?;
    if result.as_buffer(0).as_bytes().len() < layout.complete_len {
        return Err(FormatError::corrupt(NAME, "it would take too much memory"));
    }
    let planes = layout.planes;
    let cmyk = matches!(color, ColorType::CMYK(_));
    let samples = match result {
        DecodingResult::U8(bits) if color == ColorType::Gray(1) => Samples::U8(unpack_bits(&bits, width)),
        DecodingResult::U8(v) if cmyk => Samples::U8(cmyk_to_rgb(&interleave(v, planes), 255.0, |v| v as u8)),
        DecodingResult::U16(v) if cmyk => Samples::U16(cmyk_to_rgb(&interleave(v, planes), 65535.0, |v| v as u16)),
        DecodingResult::U8(v) => Samples::U8(interleave(v, planes)),
        DecodingResult::U16(v) => Samples::U16(interleave(v, planes)),
        DecodingResult::F32(v) => Samples::F32(interleave(v, planes)),
        _ => return Err(FormatError::unsupported_picture(NAME, "samples other than unsigned bytes, words and floats")),
    };
    Ok(Raster { channels: if cmyk { 3 } else { stored }, samples })
}

fn open(bytes: &[u8]) -> Result<Decoder<Cursor<&[u8]>>, FormatError> {
    Decoder::new(Cursor::new(bytes)).map_err(fail)
}

/// Expands one bit per pixel, rows padded to bytes, to 0 and 255.
fn unpack_bits(bits: &[u8], width: usize) -> Vec<u8> {
    let row =
        |row: &[u8]| (0..width).map(|x| if row[x / 8] >> (7 - x % 8) & 1 == 1 { 255 } else { 0 }).collect::<Vec<_>>();
    bits.chunks_exact(width.div_ceil(8)).flat_map(row).collect()
}

/// Converts planar samples to interleaved ones.
fn interleave<T: Copy>(samples: Vec<T>, planes: usize) -> Vec<T> {
    if planes < 2 {
        return samples;
    }
    let size = samples.len() / planes;
    (0..size * planes).map(|i| samples[i % planes * size + i / planes]).collect()
}

/// Converts CMYK to RGB, without a color profile.
fn cmyk_to_rgb<T: Copy + Into<f32>>(cmyk: &[T], full: f32, store: fn(f32) -> T) -> Vec<T> {
    let pixel = |ink: &[T]| {
        let black = 1.0 - ink[3].into() / full;
        [ink[0], ink[1], ink[2]].map(|ink| store((full - ink.into()) * black))
    };
    cmyk.chunks_exact(4).flat_map(pixel).collect()
}

fn fail(error: TiffError) -> FormatError {
    match error {
        TiffError::IoError(e) if e.kind() == ErrorKind::UnexpectedEof => FormatError::Truncated { format: NAME },
        TiffError::UnsupportedError(what) => FormatError::unsupported_picture(NAME, format!("“{what}”")),
        TiffError::LimitsExceeded => FormatError::corrupt(NAME, "it would take too much memory"),
        error => FormatError::corrupt(NAME, error.to_string()),
    }
}
