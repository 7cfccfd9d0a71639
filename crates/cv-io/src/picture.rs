//! Reading pictures of any of the supported formats.

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use cv_core::{GrayF32, GrayU8, Image, Mask, RgbF32, RgbU8, Sample};
use image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, Limits};

use crate::exif_info::is_raw_preview;
use crate::files::read_bytes;
use crate::{ExifInfo, FormatError, IoError, sniff};

/// The default for [`ReadOptions::max_pixels`]: 256 Mpx.
pub const DEFAULT_MAX_PIXELS: u64 = 256 << 20;

/// How pictures are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadOptions {
    /// The most pixels a picture may have; its header is checked before anything is allocated. Default
    /// [`DEFAULT_MAX_PIXELS`], more than the sensor of any camera sold and 768 MiB as 8-bit color.
    pub max_pixels: u64,
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self { max_pixels: DEFAULT_MAX_PIXELS }
    }
}

/// The samples of a picture, as deep as the file has them.
#[derive(Debug, Clone, PartialEq)]
pub enum Pixels {
    /// One channel of bytes. Files of 1, 2 and 4 bits a pixel are stretched to 0 to 255.
    Gray8(GrayU8),
    /// One channel of 16 bits.
    Gray16(Image<u16, 1>),
    /// RGB bytes.
    Rgb8(RgbU8),
    /// RGB of 16 bits.
    Rgb16(Image<u16, 3>),
    /// One channel of linear light or of measurements.
    GrayF32(GrayF32),
    /// RGB of linear light (OpenEXR, Radiance HDR, float TIFF); 1 is the white of a display.
    RgbF32(RgbF32),
}

/// A decoded picture: right way up, without alpha.
#[derive(Debug, Clone, PartialEq)]
pub struct DynImage {
    /// The samples.
    pub pixels: Pixels,
    /// What the camera said; `focal` is in pixels of this picture.
    pub exif: ExifInfo,
}

impl DynImage {
    /// Width and height in pixels.
    pub fn size(&self) -> (usize, usize) {
        match &self.pixels {
            Pixels::Gray8(i) => i.size(),
            Pixels::Gray16(i) => i.size(),
            Pixels::Rgb8(i) => i.size(),
            Pixels::Rgb16(i) => i.size(),
            Pixels::GrayF32(i) => i.size(),
            Pixels::RgbF32(i) => i.size(),
        }
    }

    /// As RGB bytes: 16 bits are rounded to 8, gray is repeated, linear light is clipped to 0 to 1 and sRGB-encoded.
    pub fn into_rgb8(self) -> RgbU8 {
        match self.pixels {
            Pixels::Rgb8(image) => image,
            Pixels::Gray8(image) => image.map(|[v]| [v; 3]),
            Pixels::Gray16(image) => image.map(|[v]| [to_byte(v); 3]),
            Pixels::Rgb16(image) => image.map(|p| p.map(to_byte)),
            Pixels::GrayF32(image) => image.map(|[v]| [srgb_byte(v); 3]),
            Pixels::RgbF32(image) => image.map(|p| p.map(srgb_byte)),
        }
    }

    /// As gray bytes: as [`DynImage::into_rgb8`], then Rec. 601 luma
    /// ([`luma_u8`](cv_core::luma_u8)).
    pub fn into_gray8(self) -> GrayU8 {
        match self.pixels {
            Pixels::Gray8(image) => image,
            Pixels::Gray16(image) => image.map(|[v]| [to_byte(v)]),
            Pixels::GrayF32(image) => image.map(|[v]| [srgb_byte(v)]),
            _ => self.into_rgb8().map(|rgb| [cv_core::luma_u8(rgb)]),
        }
    }
}

fn to_byte(v: u16) -> u8 {
    ((u32::from(v) + 128) / 257) as u8
}

/// Linear light to an sRGB byte (IEC 61966-2-1).
fn srgb_byte(v: f32) -> u8 {
    // NaN becomes black.
    let v = v.clamp(0.0, 1.0);
    let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    (encoded * 255.0).round() as u8
}

/// Decodes the bytes of a PNG, JPEG, TIFF, BMP, PNM, OpenEXR or Radiance HDR file.
///
/// The format is told by the content. The EXIF orientation is applied. An alpha channel is dropped, as OpenCV and COLMAP do:
/// the colors under it are returned as they are stored. Palettes are resolved; CMYK and YCCK JPEGs become RGB by
/// plain inversion, without a color profile. Embedded profiles are ignored.
///
/// # Errors
/// [`FormatError`]: not a picture, damaged, cut short, or more pixels than `options` allow.
pub fn decode_image(bytes: &[u8], options: &ReadOptions) -> Result<DynImage, FormatError> {
    let format = sniff::picture_format(bytes)?;
    let name = sniff::name(format);
    // The codecs are other people's code: should one panic, that is this file's error and not the program's end.
    catch_unwind(AssertUnwindSafe(|| decode(bytes, format, options)))
        .unwrap_or_else(|_| Err(FormatError::corrupt(name, "the decoder gave up on it")))
}

fn decode(bytes: &[u8], format: ImageFormat, options: &ReadOptions) -> Result<DynImage, FormatError> {
    let fail = |error| from_image_error(format, error);
    if format == ImageFormat::Tiff && is_raw_preview(bytes) {
        return Err(FormatError::unsupported_picture("camera raw", "undeveloped sensor data"));
    }
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    // Enough for any header's own allocations; the pixels are allowed for once their number is known.
    reader.limits(limits(64 << 20));
    let mut decoder = reader.into_decoder().map_err(fail)?;
    let (width, height) = decoder.dimensions();
    let (w, h) = (u64::from(width), u64::from(height));
    if w.saturating_mul(h) > options.max_pixels {
        return Err(FormatError::TooManyPixels { width: w, height: h, limit: options.max_pixels });
    }
    if w == 0 || h == 0 {
        return Err(FormatError::corrupt(sniff::name(format), format!("the picture is {w}×{h}")));
    }
    sniff::plausible(format, bytes, w, h)?;
    // Room for the pixels and for a decoder's working copy of them, and as much again as any header needs.
    decoder.set_limits(limits(decoder.total_bytes().saturating_mul(3).saturating_add(64 << 20))).map_err(fail)?;
    let orientation = decoder.orientation().unwrap_or(image::metadata::Orientation::NoTransforms);
    let exif = decoder.exif_metadata().ok().flatten();
    let mut picture = DynamicImage::from_decoder(decoder).map_err(fail)?;
    picture.apply_orientation(orientation);
    let exif = match exif {
        Some(block) => ExifInfo::parse(block, width as usize, height as usize, orientation.to_exif()),
        None => ExifInfo { orientation: orientation.to_exif(), ..ExifInfo::default() },
    };
    Ok(DynImage { pixels: pixels(picture)?, exif })
}

fn limits(max_alloc: u64) -> Limits {
    let mut limits = Limits::default();
    limits.max_alloc = Some(max_alloc);
    limits
}

fn pixels(picture: DynamicImage) -> Result<Pixels, FormatError> {
    let (w, h) = (picture.width() as usize, picture.height() as usize);
    Ok(match picture {
        DynamicImage::ImageLuma8(i) => Pixels::Gray8(owned(w, h, i.into_raw())?),
        DynamicImage::ImageRgb8(i) => Pixels::Rgb8(owned(w, h, i.into_raw())?),
        DynamicImage::ImageLuma16(i) => Pixels::Gray16(owned(w, h, i.into_raw())?),
        DynamicImage::ImageRgb16(i) => Pixels::Rgb16(owned(w, h, i.into_raw())?),
        DynamicImage::ImageRgb32F(i) => Pixels::RgbF32(owned(w, h, i.into_raw())?),
        DynamicImage::ImageLumaA8(i) => Pixels::Gray8(owned(w, h, without_alpha::<_, 1>(&i.into_raw()))?),
        DynamicImage::ImageRgba8(i) => Pixels::Rgb8(owned(w, h, without_alpha::<_, 3>(&i.into_raw()))?),
        DynamicImage::ImageLumaA16(i) => Pixels::Gray16(owned(w, h, without_alpha::<_, 1>(&i.into_raw()))?),
        DynamicImage::ImageRgba16(i) => Pixels::Rgb16(owned(w, h, without_alpha::<_, 3>(&i.into_raw()))?),
        DynamicImage::ImageRgba32F(i) => Pixels::RgbF32(owned(w, h, without_alpha::<_, 3>(&i.into_raw()))?),
        other => {
            return Err(FormatError::unsupported_picture("picture", format!("the pixel type {:?}", other.color())));
        }
    })
}

fn owned<T: Sample, const C: usize>(width: usize, height: usize, data: Vec<T>) -> Result<Image<T, C>, FormatError> {
    Image::from_vec(width, height, data).map_err(|e| FormatError::corrupt("picture", e.to_string()))
}

fn without_alpha<T: Copy, const C: usize>(data: &[T]) -> Vec<T> {
    data.chunks_exact(C + 1).flat_map(|p| &p[..C]).copied().collect()
}

fn from_image_error(format: ImageFormat, error: ImageError) -> FormatError {
    use image::error::UnsupportedErrorKind as Kind;
    let name = sniff::name(format);
    match error {
        ImageError::IoError(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
            FormatError::Truncated { format: name }
        }
        ImageError::IoError(e) => FormatError::corrupt(name, e.to_string()),
        ImageError::Unsupported(e) => FormatError::unsupported_picture(
            name,
            match e.kind() {
                Kind::Color(color) => format!("the pixel type {color:?}"),
                Kind::Format(_) => "this variant".to_owned(),
                Kind::GenericFeature(feature) => format!("“{feature}”"),
                other => format!("{other:?}"),
            },
        ),
        ImageError::Limits(e) => FormatError::corrupt(name, format!("it would take too much memory: {e}")),
        // The decoder's own words, without those of the layers around it.
        ImageError::Decoding(e) => {
            let own = std::error::Error::source(&e).map(ToString::to_string);
            FormatError::corrupt(name, own.unwrap_or_else(|| e.to_string()))
        }
        error => FormatError::corrupt(name, error.to_string()),
    }
}

/// Reads a picture at full depth; see [`decode_image`] for what is understood and how.
///
/// # Errors
/// [`IoError`]: cannot be opened, or as [`decode_image`], with default [`ReadOptions`].
pub fn read_image(path: impl AsRef<Path>) -> Result<DynImage, IoError> {
    read_image_with(path, &ReadOptions::default())
}

/// [`read_image`] with options.
///
/// # Errors
/// As [`read_image`].
pub fn read_image_with(path: impl AsRef<Path>, options: &ReadOptions) -> Result<DynImage, IoError> {
    let path = path.as_ref();
    decode_image(&read_bytes(path)?, options).map_err(|reason| IoError::reading(path, reason))
}

/// Reads a picture as RGB bytes; see [`DynImage::into_rgb8`].
///
/// # Errors
/// As [`read_image`].
pub fn read_rgb(path: impl AsRef<Path>) -> Result<RgbU8, IoError> {
    read_image(path).map(DynImage::into_rgb8)
}

/// Reads a picture as gray bytes; see [`DynImage::into_gray8`].
///
/// # Errors
/// As [`read_image`].
pub fn read_gray_u8(path: impl AsRef<Path>) -> Result<GrayU8, IoError> {
    read_image(path).map(DynImage::into_gray8)
}

/// Reads a mask: true where the gray value is above the middle (128 to 255).
///
/// # Errors
/// As [`read_image`].
pub fn read_mask(path: impl AsRef<Path>) -> Result<Mask, IoError> {
    Ok(read_gray_u8(path)?.map(|[v]| [v > 127]))
}

/// The size (after orientation) and EXIF facts of a picture, without decoding its pixels.
///
/// # Errors
/// As [`read_image`].
pub fn read_image_info(path: impl AsRef<Path>) -> Result<((usize, usize), ExifInfo), IoError> {
    let path = path.as_ref();
    let bytes = read_bytes(path)?;
    header(&bytes).map_err(|reason| IoError::reading(path, reason))
}

fn header(bytes: &[u8]) -> Result<((usize, usize), ExifInfo), FormatError> {
    let format = sniff::picture_format(bytes)?;
    let read = || {
        let reader = ImageReader::with_format(Cursor::new(bytes), format);
        let mut decoder = reader.into_decoder().map_err(|e| from_image_error(format, e))?;
        let (width, height) = decoder.dimensions();
        let (width, height) = (width as usize, height as usize);
        let orientation = decoder.orientation().unwrap_or(image::metadata::Orientation::NoTransforms).to_exif();
        let exif = match decoder.exif_metadata().ok().flatten() {
            Some(block) => ExifInfo::parse(block, width, height, orientation),
            None => ExifInfo { orientation, ..ExifInfo::default() },
        };
        Ok((if orientation >= 5 { (height, width) } else { (width, height) }, exif))
    };
    catch_unwind(AssertUnwindSafe(read))
        .unwrap_or_else(|_| Err(FormatError::corrupt(sniff::name(format), "the decoder gave up on it")))
}

#[cfg(test)]
mod tests;
