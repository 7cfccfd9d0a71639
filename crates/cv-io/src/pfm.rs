//! Portable float maps (PFM): disparity, depth and flow as Middlebury and ETH3D publish them.
//!
//! A text header `Pf` (one channel) or `PF` (three), width, height and a scale whose sign is the byte order (negative: little
//! endian) and whose magnitude is ignored, as by other readers; then rows of `f32` from the bottom up. Invalid values are +∞ in the file and
//! NaN in memory.

use std::io::Write;
use std::path::Path;

use cv_core::{GrayF32, Image, ImageView, RgbF32};

use crate::files::read_bytes;
use crate::npy::MAX_EMPTY_SIDE;
use crate::{FormatError, IoError, ReadOptions, memory, write_atomic};

const NAME: &str = "PFM";

/// A decoded map.
#[derive(Debug, Clone, PartialEq)]
pub enum Pfm {
    /// `Pf`.
    Gray(GrayF32),
    /// `PF`.
    Rgb(RgbF32),
}

/// Decodes the bytes of a PFM file. Infinite values become NaN.
///
/// # Errors
/// [`FormatError`] where the header does not parse, the number of samples does not match it, or it exceeds
/// [`DEFAULT_MAX_PIXELS`](crate::DEFAULT_MAX_PIXELS) or [`default_max_memory`](crate::default_max_memory).
pub fn decode(bytes: &[u8]) -> Result<Pfm, FormatError> {
    decode_with(bytes, &ReadOptions::default())
}

/// As [`decode`], with options.
///
/// # Errors
/// As [`decode`].
pub fn decode_with(bytes: &[u8], options: &ReadOptions) -> Result<Pfm, FormatError> {
    let corrupt = |reason: &str| FormatError::corrupt(NAME, reason);
    let mut rest = bytes;
    let channels = match token(&mut rest) {
        Some("Pf") => 1,
        Some("PF") => 3,
        _ => return Err(FormatError::UnknownFormat { expected: "a PFM float map (Pf or PF)" }),
    };
    let mut side = || token(&mut rest).and_then(|t| t.parse::<u32>().ok());
    let (Some(width), Some(height)) = (side(), side()) else {
        return Err(corrupt("the width and height are not whole numbers"));
    };
    let (w, h) = (u64::from(width), u64::from(height));
    if w * h > options.max_pixels {
        return Err(FormatError::TooManyPixels { width: w, height: h, limit: options.max_pixels });
    }
    if w * h == 0 && w.max(h) > MAX_EMPTY_SIDE {
        return Err(corrupt(&format!("a map of {width}×{height} has no pixels")));
    }
    let scale = token(&mut rest)
        .and_then(|t| t.parse::<f64>().ok())
        .filter(|s| s.is_finite() && *s != 0.0)
        .ok_or_else(|| corrupt("the scale is not a number other than zero"))?;
    let needed = width as usize * height as usize * channels * 4;
    // One white-space byte ends the header; files converted on Windows have two.
    let samples = match rest {
        [b'\r', b'\n', samples @ ..] if samples.len() == needed => samples,
        [b'\n' | b' ' | b'\r' | b'\t', samples @ ..] => samples,
        _ => rest,
    };
    if samples.len() < needed {
        return Err(FormatError::Truncated { format: NAME });
    }
    if samples.len() > needed {
        let extra = samples.len() - needed;
        return Err(corrupt(&format!("there are {extra} bytes more than {width}×{height}×{channels} samples need")));
    }
    memory::check_limit((needed + bytes.len()) as u64, options.max_memory, Some((w, h)))?;
    let row = width as usize * channels * 4;
    let mut data = Vec::with_capacity(needed / 4);
    let infinite_to_nan = |v: f32| if v.is_infinite() { f32::NAN } else { v };
    for line in samples.chunks_exact(row.max(1)).rev() {
        let values = line.as_chunks::<4>().0.iter();
        if scale < 0.0 {
            data.extend(values.map(|&b| infinite_to_nan(f32::from_le_bytes(b))));
        } else {
            data.extend(values.map(|&b| infinite_to_nan(f32::from_be_bytes(b))));
        }
    }
    let (w, h) = (width as usize, height as usize);
    let wrong = |e: cv_core::ImageError| corrupt(&e.to_string());
    Ok(match channels {
        1 => Pfm::Gray(Image::from_vec(w, h, data).map_err(wrong)?),
        _ => Pfm::Rgb(Image::from_vec(w, h, data).map_err(wrong)?),
    })
}

/// Parses the next word of the header, after white space.
fn token<'a>(rest: &mut &'a [u8]) -> Option<&'a str> {
    let start = rest.iter().position(|b| !b.is_ascii_whitespace())?;
    let len = rest[start..].iter().take(32).position(u8::is_ascii_whitespace)?;
    let word = std::str::from_utf8(&rest[start..start + len]).ok()?;
    *rest = &rest[start + len..];
    Some(word)
}

/// Encodes a map of one or three channels, little-endian; NaN becomes +∞.
///
/// # Errors
/// [`FormatError::NotRepresentable`] where `C` is neither 1 nor 3.
pub fn encode<const C: usize>(view: ImageView<'_, f32, C>, sink: &mut dyn Write) -> Result<(), FormatError> {
    let kind = match C {
        1 => "Pf",
        3 => "PF",
        _ => return Err(FormatError::NotRepresentable { format: NAME, what: format!("{C} channels") }),
    };
    write!(sink, "{kind}\n{} {}\n-1\n", view.width(), view.height())?;
    let mut line = Vec::with_capacity(view.width() * C * 4);
    for y in (0..view.height()).rev() {
        line.clear();
        for &v in view.row(y) {
            line.extend_from_slice(&(if v.is_nan() { f32::INFINITY } else { v }).to_le_bytes());
        }
        sink.write_all(&line)?;
    }
    Ok(())
}

/// Reads a map of one channel.
///
/// # Errors
/// [`IoError`]: cannot be opened, has three channels, or as [`decode`].
pub fn read(path: impl AsRef<Path>) -> Result<GrayF32, IoError> {
    let path = path.as_ref();
    match decode(&read_bytes(path)?) {
        Ok(Pfm::Gray(image)) => Ok(image),
        Ok(Pfm::Rgb(_)) => {
            Err(IoError::reading(path, FormatError::unsupported(NAME, "a color map where one channel is expected")))
        }
        Err(reason) => Err(IoError::reading(path, reason)),
    }
}

/// Reads a map of three channels.
///
/// # Errors
/// [`IoError`]: cannot be opened, has one channel, or as [`decode`].
pub fn read_rgb(path: impl AsRef<Path>) -> Result<RgbF32, IoError> {
    let path = path.as_ref();
    match decode(&read_bytes(path)?) {
        Ok(Pfm::Rgb(image)) => Ok(image),
        Ok(Pfm::Gray(_)) => {
            Err(IoError::reading(path, FormatError::unsupported(NAME, "a one-channel map where color is expected")))
        }
        Err(reason) => Err(IoError::reading(path, reason)),
    }
}

/// Writes a map; see [`encode`].
///
/// # Errors
/// As [`encode`] and [`write_atomic`].
pub fn write<const C: usize>(path: impl AsRef<Path>, view: ImageView<'_, f32, C>) -> Result<(), IoError> {
    write_atomic(path, |sink| encode(view, sink))
}
