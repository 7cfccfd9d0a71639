//! Disparity and depth in gray PNG files: KITTI's 1/256 px, 16-bit millimeters, Middlebury's scaled 8-bit disparities.
//!
//! In all three 0 is invalid, NaN in memory.

use std::path::Path;

use cv_core::{GrayF32, Image, ImageView};

use crate::files::read_bytes;
use crate::{FormatError, IoError, Pixels, ReadOptions, decode_image, read_image, write_png};

const NAME: &str = "disparity PNG";

/// KITTI's 16-bit disparity PNG: `round(256 d)`, 0 = invalid.
pub mod kitti {
    use super::*;

    /// Reads disparities in pixels.
    ///
    /// # Errors
    /// [`IoError`]: as [`read_image`], or not a 16-bit gray image.
    pub fn read(path: impl AsRef<Path>) -> Result<GrayF32, IoError> {
        Ok(dequantize(&read_16(path.as_ref())?, 1.0 / 256.0))
    }

    /// Writes disparities in pixels.
    ///
    /// Valid values from 0 up to 1/512 are stored as the smallest one, 1/256, as KITTI's own tools do. Returns the number of
    /// valid values outside 0 to 255.998, which are stored as invalid.
    ///
    /// # Errors
    /// As [`write_png`].
    pub fn write(path: impl AsRef<Path>, disparity: ImageView<'_, f32, 1>) -> Result<usize, IoError> {
        write_16(path.as_ref(), disparity, 256.0)
    }
}

/// 16-bit PNG of millimeters, 0 = invalid, as depth cameras, ScanNet and TUM-like tools use.
pub mod depth_mm {
    use super::*;

    /// Reads depth in meters.
    ///
    /// # Errors
    /// [`IoError`]: as [`read_image`], or not a 16-bit gray image.
    pub fn read(path: impl AsRef<Path>) -> Result<GrayF32, IoError> {
        Ok(dequantize(&read_16(path.as_ref())?, 1.0 / 1000.0))
    }

    /// Writes depth in meters.
    ///
    /// Returns the number of valid values outside 0 to 65.535 m, which are stored as invalid.
    ///
    /// # Errors
    /// As [`write_png`].
    pub fn write(path: impl AsRef<Path>, depth: ImageView<'_, f32, 1>) -> Result<usize, IoError> {
        write_16(path.as_ref(), depth, 1000.0)
    }
}

/// Gray PNG of 8 or 16 bits where `value / scale` is the disparity in pixels and 0 = invalid (Middlebury 2001 to 2006).
pub mod scaled {
    use super::*;

    /// Reads disparities in pixels. `scale` is 4 for Middlebury's cones at quarter size, 256 for KITTI.
    ///
    /// # Errors
    /// [`IoError`]: as [`read_image`], or a color image, or a scale that is not positive.
    pub fn read(path: impl AsRef<Path>, scale: f64) -> Result<GrayF32, IoError> {
        let path = path.as_ref();
        decode(&read_bytes(path)?, Some(scale)).map_err(|reason| IoError::reading(path, reason))
    }

    /// Writes 8-bit disparities, `round(scale d)`, at least 1 where valid. Returns the number of valid values that do not fit, which are
    /// stored as invalid.
    ///
    /// # Errors
    /// As [`write_png`].
    pub fn write(path: impl AsRef<Path>, disparity: ImageView<'_, f32, 1>, scale: f64) -> Result<usize, IoError> {
        let (stored, unrepresentable) = quantize(disparity, scale, f64::from(u8::MAX));
        write_png(path, stored.map(|[v]| [v as u8]).view())?;
        Ok(unrepresentable)
    }
}

/// Decodes a gray image to its values divided by `scale`; without a scale, a 16-bit image by 256.
pub(crate) fn decode(bytes: &[u8], scale: Option<f64>) -> Result<GrayF32, FormatError> {
    let pixels = decode_image(bytes, &ReadOptions::default())?.pixels;
    let scale = match (scale, &pixels) {
        (Some(scale), _) if scale > 0.0 && scale.is_finite() => scale,
        (Some(scale), _) => return Err(FormatError::corrupt(NAME, format!("the scale {scale} is not positive"))),
        (None, Pixels::Gray16(_)) => 256.0,
        (None, _) => return Err(FormatError::missing(NAME, "scale, which an 8-bit file does not define")),
    };
    match pixels {
        Pixels::Gray16(image) => Ok(dequantize(&image, 1.0 / scale)),
        Pixels::Gray8(image) => Ok(dequantize(&image, 1.0 / scale)),
        // Some tools write gray as three equal channels.
        Pixels::Rgb8(image) if image.pixels().all(|[r, g, b]| r == g && g == b) => {
            Ok(dequantize(&image.map(|[v, _, _]| [v]), 1.0 / scale))
        }
        _ => Err(FormatError::unsupported(NAME, "a color image")),
    }
}

fn read_16(path: &Path) -> Result<Image<u16, 1>, IoError> {
    match read_image(path)?.pixels {
        Pixels::Gray16(image) => Ok(image),
        Pixels::Gray8(_) => Err(IoError::reading(path, FormatError::unsupported("16-bit PNG", "an image of 8 bits"))),
        _ => Err(IoError::reading(path, FormatError::unsupported("16-bit PNG", "a color image"))),
    }
}

fn dequantize<T: cv_core::Sample + Into<f64>>(image: &Image<T, 1>, scale: f64) -> GrayF32 {
    image.map(|[v]| {
        let v: f64 = v.into();
        [if v == 0.0 { f32::NAN } else { (v * scale) as f32 }]
    })
}

fn write_16(path: &Path, view: ImageView<'_, f32, 1>, scale: f64) -> Result<usize, IoError> {
    let (stored, unrepresentable) = quantize(view, scale, f64::from(u16::MAX));
    write_png(path, stored.view())?;
    Ok(unrepresentable)
}

/// Quantizes to `round(scale · v)` within 1 to `max`, 0 where invalid; returns also the number of valid values that do not fit.
fn quantize(view: ImageView<'_, f32, 1>, scale: f64, max: f64) -> (Image<u16, 1>, usize) {
    let mut image = Image::<u16, 1>::new(view.width(), view.height(), [0]);
    let mut unrepresentable = 0;
    for y in 0..view.height() {
        for (out, &v) in image.row_mut(y).iter_mut().zip(view.row(y)) {
            let scaled = (f64::from(v) * scale).round();
            if v >= 0.0 && scaled <= max {
                *out = scaled.max(1.0) as u16;
            } else if !v.is_nan() {
                unrepresentable += 1;
            }
        }
    }
    (image, unrepresentable)
}
