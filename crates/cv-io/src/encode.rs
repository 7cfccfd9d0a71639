//! Encoding images as PNG and TIFF, and by the extension of the file's name.

use std::borrow::Cow;
use std::io::Write;
use std::path::Path;

use cv_core::{ImageView, Sample};
use png::{BitDepth, ColorType, Compression, Filter};

use crate::encode_jpeg::{JPEG_QUALITY, encode_jpeg_parts};
use crate::encode_rows::write_image_rows;
use crate::encode_tiff::{Samples, encode_samples};
use crate::files::write_bytes;
use crate::{FormatError, IoError, Metadata};

/// Width, height, color type, bit depth, and the samples row-major, big-endian, without padding.
pub(crate) type Parts<'a> = (usize, usize, ColorType, BitDepth, Cow<'a, [u8]>);

/// Image types that can be written as PNG: views of 1, 3 or 4 channels of `u8` or `u16`, and masks.
pub trait PngPixels: sealed::Sealed {
    #[doc(hidden)]
    fn parts(&self) -> Parts<'_>;
}

mod sealed {
    pub trait Sealed {}
}

macro_rules! png_pixels {
    ($sample:ty, $channels:literal, $color:ident, $depth:ident, $bytes:expr) => {
        impl sealed::Sealed for ImageView<'_, $sample, $channels> {}
        impl PngPixels for ImageView<'_, $sample, $channels> {
            fn parts(&self) -> Parts<'_> {
                (self.width(), self.height(), ColorType::$color, BitDepth::$depth, $bytes(self))
            }
        }
    };
}

png_pixels!(u8, 1, Grayscale, Eight, samples);
png_pixels!(u8, 3, Rgb, Eight, samples);
png_pixels!(u8, 4, Rgba, Eight, samples);
png_pixels!(bool, 1, Grayscale, Eight, black_and_white);
png_pixels!(u16, 1, Grayscale, Sixteen, big_endian);
png_pixels!(u16, 3, Rgb, Sixteen, big_endian);
png_pixels!(u16, 4, Rgba, Sixteen, big_endian);

/// Returns the samples row-major without padding: copied only from views with padding.
fn samples<'a, const C: usize>(view: &ImageView<'a, u8, C>) -> Cow<'a, [u8]> {
    let ((samples, stride), width) = (view.strided_samples(), C * view.width());
    match samples.get(..width * view.height()) {
        Some(dense) if stride == width => Cow::Borrowed(dense),
        _ => copied(view, |out, row| out.extend_from_slice(row)),
    }
}

fn black_and_white(mask: &ImageView<'_, bool, 1>) -> Cow<'static, [u8]> {
    copied(mask, |out, row| out.extend(row.iter().map(|&v| if v { 255 } else { 0 })))
}

fn big_endian<const C: usize>(view: &ImageView<'_, u16, C>) -> Cow<'static, [u8]> {
    copied(view, |out, row| out.extend(row.iter().flat_map(|v| v.to_be_bytes())))
}

fn copied<T: Sample, const C: usize>(
    view: &ImageView<'_, T, C>,
    extend: impl Fn(&mut Vec<u8>, &[T]),
) -> Cow<'static, [u8]> {
    let mut bytes = Vec::with_capacity(view.width() * view.height() * C * size_of::<T>());
    (0..view.height()).for_each(|y| extend(&mut bytes, view.row(y)));
    Cow::Owned(bytes)
}

/// Encodes a PNG file.
///
/// # Errors
/// [`FormatError::NotRepresentable`] for an empty image or one whose sides exceed 2³¹ − 1.
pub fn encode_png(view: impl PngPixels) -> Result<Vec<u8>, FormatError> {
    encode_png_parts(view.parts(), &Metadata::default(), None)
}

/// Not generic, so that the encoder is compiled once and not for each pixel type.
pub(crate) fn encode_png_parts(
    (width, height, color, depth, pixels): Parts<'_>,
    metadata: &Metadata,
    dpi: Option<f64>,
) -> Result<Vec<u8>, FormatError> {
    let side = |n: usize| u32::try_from(n).ok().filter(|&n| n > 0 && n <= i32::MAX as u32);
    let (Some(w), Some(h)) = (side(width), side(height)) else {
        return Err(FormatError::NotRepresentable { format: "PNG", what: format!("an image of {width}×{height}") });
    };
    let mut bytes = Vec::new();
    let fail = |e: png::EncodingError| FormatError::corrupt("PNG", e.to_string());
    let mut write = || png_writer(&mut bytes, (w, h), (color, depth), metadata, dpi)?.write_image_data(&pixels);
    write().map_err(fail)?;
    Ok(bytes)
}

/// Writes the header of a PNG.
pub(crate) fn png_writer<W: Write>(
    sink: W,
    (width, height): (u32, u32),
    (color, depth): (ColorType, BitDepth),
    metadata: &Metadata,
    dpi: Option<f64>,
) -> Result<png::Writer<W>, png::EncodingError> {
    let mut info = png::Info::with_size(width, height);
    info.exif_metadata = metadata.exif_for(width, height).map(Into::into);
    info.icc_profile = metadata.icc_for(color.samples()).map(Into::into);
    info.pixel_dims = dpi.map(|dpi| {
        let per_meter = (dpi / 0.0254).round() as u32;
        png::PixelDimensions { xppu: per_meter, yppu: per_meter, unit: png::Unit::Meter }
    });
    let mut encoder = png::Encoder::with_info(sink, info)?;
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_compression(Compression::Fast);
    // On panoramas within half a percent of the size of the adaptive choice, in a third of the time of its filters.
    encoder.set_filter(Filter::Paeth);
    encoder.write_header()
}

/// Writes a PNG; masks as 0 and 255.
///
/// # Errors
/// As [`encode_png`] and [`crate::write_atomic`].
pub fn write_png(path: impl AsRef<Path>, view: impl PngPixels) -> Result<(), IoError> {
    write_png_with(path, view, &Metadata::default())
}

/// As [`write_png`] for an image derived from one with this metadata. Writes the EXIF block, without thumbnail, orientation and other tags that no
/// longer apply, and a color profile for the same number of channels.
///
/// # Errors
/// As [`write_png`].
pub fn write_png_with(path: impl AsRef<Path>, view: impl PngPixels, metadata: &Metadata) -> Result<(), IoError> {
    let path = path.as_ref();
    write_bytes(path, &encode_png_parts(view.parts(), metadata, None).map_err(|reason| IoError::writing(path, reason))?)
}

/// As [`write_png`] for printing, with the resolution in dots per inch, which defines the size on paper.
///
/// # Errors
/// As [`write_png`].
pub fn write_png_to_print(path: impl AsRef<Path>, view: impl PngPixels, dpi: f64) -> Result<(), IoError> {
    let path = path.as_ref();
    let bytes = encode_png_parts(view.parts(), &Metadata::default(), Some(dpi));
    write_bytes(path, &bytes.map_err(|reason| IoError::writing(path, reason))?)
}

/// What is not supported about other file names.
pub(crate) const UNKNOWN_EXTENSION: &str = "an extension other than .png, .tif, .tiff, .jpg, .jpeg and .dzi";

/// Encodes a TIFF file with Deflate compression; BigTIFF where it may exceed 4 GiB.
///
/// # Errors
/// [`FormatError::NotRepresentable`] for an empty image.
pub fn encode_tiff(view: impl PngPixels) -> Result<Vec<u8>, FormatError> {
    encode_tiff_parts(view.parts(), &Metadata::default())
}

fn encode_tiff_parts(
    (width, height, color, depth, bytes): Parts<'_>,
    metadata: &Metadata,
) -> Result<Vec<u8>, FormatError> {
    let depth = if depth == BitDepth::Sixteen { 2 } else { 1 };
    encode_samples(&Samples { width, height, channels: color.samples(), depth, bytes: &bytes }, metadata)
}

/// Writes an image in the format of the file name's extension: `.png`, `.tif` or `.tiff`, `.jpg` or `.jpeg`, or `.dzi`
/// ([Deep Zoom](crate::write_image_rows)). Metadata are written as by [`write_png_with`].
///
/// # Errors
/// [`FormatError::Unsupported`] for another extension; [`FormatError::NotRepresentable`] for a JPEG of 16 bits or with alpha and for a Deep Zoom
/// image of 16 bits; else as [`encode_png`], [`encode_tiff`], [`encode_jpeg`](crate::encode_jpeg) and [`crate::write_atomic`].
pub fn write_image(path: impl AsRef<Path>, view: impl PngPixels, metadata: &Metadata) -> Result<(), IoError> {
    let path = path.as_ref();
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    let parts = view.parts();
    if extension.as_deref() == Some("dzi") {
        return write_image_rows(path, |rows| {
            rows.set_size(parts.0, parts.1);
            rows.write_parts(parts).map_err(|reason| IoError::writing(path, reason))
        });
    }
    let bytes = match extension.as_deref() {
        Some("png") => encode_png_parts(parts, metadata, None),
        Some("tif" | "tiff") => encode_tiff_parts(parts, metadata),
        Some("jpg" | "jpeg") => encode_jpeg_parts(parts, JPEG_QUALITY, metadata),
        _ => Err(FormatError::unsupported("the file name", UNKNOWN_EXTENSION)),
    };
    write_bytes(path, &bytes.map_err(|reason| IoError::writing(path, reason))?)
}
