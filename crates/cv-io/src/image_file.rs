//! Reading images of any supported format.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use cv_core::{GrayF32, GrayU8, Image, Mask, RgbF32, RgbU8, Sample};

use crate::codec::{Format, Header, Raster, Samples};
use crate::exif_info::is_raw_preview;
use crate::files::{read_bytes, read_bytes_within};
use crate::{ExifInfo, FormatError, IoError, Metadata, format_detection, memory, srgb_encoding};

/// The default for [`ReadOptions::max_pixels`]: 256 Mpx.
pub const DEFAULT_MAX_PIXELS: u64 = 256 << 20;

/// Limits for reading images, maps and arrays.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadOptions {
    /// Maximum number of pixels of an image, checked by its header before allocation. Default
    /// [`DEFAULT_MAX_PIXELS`], more than any camera sensor has, and 768 MiB as 8-bit color.
    pub max_pixels: u64,
    /// Maximum memory in bytes for reading one file: the file, the decoder's working memory, and the result,
    /// checked by the header before allocation. Default [`default_max_memory`](crate::default_max_memory).
    pub max_memory: u64,
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self { max_pixels: DEFAULT_MAX_PIXELS, max_memory: memory::default_max_memory() }
    }
}

/// The samples of an image at the bit depth of the file.
#[derive(Debug, Clone, PartialEq)]
pub enum Pixels {
    /// One channel of 8 bits. Files of 1, 2 and 4 bits per pixel are scaled to 0 to 255.
    Gray8(GrayU8),
    /// One channel of 16 bits.
    Gray16(Image<u16, 1>),
    /// RGB of 8 bits.
    Rgb8(RgbU8),
    /// RGB of 16 bits.
    Rgb16(Image<u16, 3>),
    /// One channel of linear intensity or of measurements.
    GrayF32(GrayF32),
    /// Linear RGB (OpenEXR, Radiance HDR, float TIFF); 1 is display white.
    RgbF32(RgbF32),
}

/// A decoded image, with the EXIF orientation applied, without alpha.
#[derive(Debug, Clone, PartialEq)]
pub struct DynImage {
    /// The samples.
    pub pixels: Pixels,
    /// EXIF metadata; `focal` is in pixels of this image.
    pub exif: ExifInfo,
    /// Metadata for derived images.
    pub metadata: Metadata,
}

macro_rules! pixels_from {
    ($($image:ty => $kind:ident),* $(,)?) => {
        $(impl From<$image> for Pixels {
            fn from(image: $image) -> Self {
                Self::$kind(image)
            }
        })*
    };
}

pixels_from! {
    GrayU8 => Gray8,
    Image<u16, 1> => Gray16,
    RgbU8 => Rgb8,
    Image<u16, 3> => Rgb16,
    GrayF32 => GrayF32,
    RgbF32 => RgbF32,
}

impl DynImage {
    /// Returns width and height in pixels.
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

    /// Converts to 8-bit RGB: 16 bits are rounded to 8, gray is replicated, linear intensity is clipped to 0 to 1 and sRGB-encoded.
    pub fn into_rgb8(self) -> RgbU8 {
        match self.pixels {
            Pixels::Rgb8(image) => image,
            Pixels::Gray8(image) => image.map(|[v]| [v; 3]),
            Pixels::Gray16(image) => image.map(|[v]| [u16_to_u8(v); 3]),
            Pixels::Rgb16(image) => image.map(|p| p.map(u16_to_u8)),
            Pixels::GrayF32(image) => image.map(|[v]| [srgb_encoding::encode_u8(v); 3]),
            Pixels::RgbF32(image) => image.map(|p| p.map(srgb_encoding::encode_u8)),
        }
    }

    /// Converts to 16-bit RGB, 65535 for white: 8 bits are multiplied by 257, gray is replicated, linear intensity is clipped to 0 to 1 and
    /// sRGB-encoded.
    pub fn into_rgb16(self) -> Image<u16, 3> {
        let u8_to_u16 = |v: u8| 257 * u16::from(v);
        match self.pixels {
            Pixels::Rgb16(image) => image,
            Pixels::Gray16(image) => image.map(|[v]| [v; 3]),
            Pixels::Gray8(image) => image.map(|[v]| [u8_to_u16(v); 3]),
            Pixels::Rgb8(image) => image.map(|p| p.map(u8_to_u16)),
            Pixels::GrayF32(image) => image.map(|[v]| [srgb_encoding::encode_u16(v); 3]),
            Pixels::RgbF32(image) => image.map(|p| p.map(srgb_encoding::encode_u16)),
        }
    }

    /// Converts to 8-bit gray: as [`DynImage::into_rgb8`], then Rec. 601 luma ([`luma_u8`](cv_core::luma_u8)).
    pub fn into_gray8(self) -> GrayU8 {
        match self.pixels {
            Pixels::Gray8(image) => image,
            Pixels::Gray16(image) => image.map(|[v]| [u16_to_u8(v)]),
            Pixels::GrayF32(image) => image.map(|[v]| [srgb_encoding::encode_u8(v)]),
            _ => self.into_rgb8().map(|rgb| [cv_core::luma_u8(rgb)]),
        }
    }
}

fn u16_to_u8(v: u16) -> u8 {
    ((u32::from(v) + 128) / 257) as u8
}

/// Decodes the bytes of a PNG, JPEG, TIFF, WebP, BMP, PNM, OpenEXR or Radiance HDR file.
///
/// The format is detected by content. The EXIF orientation is applied. An alpha channel is dropped, as by OpenCV and COLMAP:
/// the stored colors are returned. Palettes are resolved; CMYK and YCCK JPEGs are converted to RGB by
/// inversion, without a color profile. Embedded profiles are not applied.
///
/// # Errors
/// [`FormatError`]: not an image, damaged, truncated, or more pixels or memory than `options` allow.
pub fn decode_image(bytes: &[u8], options: &ReadOptions) -> Result<DynImage, FormatError> {
    let format = format_detection::image_format(bytes)?;
    let name = format.name();
    // A panic in a third-party codec becomes an error of this file.
    catch_unwind(AssertUnwindSafe(|| decode(bytes, format, options)))
        .unwrap_or_else(|_| Err(FormatError::corrupt(name, "the decoder failed")))
}

fn decode(bytes: &[u8], format: Format, options: &ReadOptions) -> Result<DynImage, FormatError> {
    if format == Format::Tiff && is_raw_preview(bytes) {
        return Err(FormatError::unsupported_picture("camera raw", "raw sensor data"));
    }
    let mut header = format.header(bytes)?;
    let (w, h) = (header.width as u64, header.height as u64);
    if w.saturating_mul(h) > options.max_pixels {
        return Err(FormatError::TooManyPixels { width: w, height: h, limit: options.max_pixels });
    }
    if w == 0 || h == 0 {
        return Err(FormatError::corrupt(format.name(), format!("the image is {w}×{h}")));
    }
    format_detection::check_plausible(format, bytes, w, h)?;
    let exif = exif_info(&header);
    memory::check_limit(header.memory(bytes.len(), exif.orientation >= 5), options.max_memory, Some((w, h)))?;
    let raster = format.raster(bytes, &header)?;
    let pixels = to_pixels(raster, header.width, header.height, exif.orientation)?;
    let metadata = Metadata { exif: header.exif.take(), icc: header.icc.take() };
    Ok(DynImage { pixels, exif, metadata })
}

fn exif_info(header: &Header) -> ExifInfo {
    let mut info = match &header.exif {
        Some(block) => ExifInfo::parse(block.clone(), header.width, header.height),
        None => ExifInfo::default(),
    };
    if let Some(orientation) = header.orientation.filter(|tag| (1..=8).contains(tag)) {
        info.orientation = orientation;
    }
    info
}

/// Drops alpha and applies the orientation.
fn to_pixels(raster: Raster, width: usize, height: usize, orientation: u8) -> Result<Pixels, FormatError> {
    let (size, channels) = ((width, height), raster.channels);
    let gray = channels < 3;
    Ok(match raster.samples {
        Samples::U8(data) if gray => Pixels::Gray8(to_upright_image(data, channels, size, orientation)?),
        Samples::U8(data) => Pixels::Rgb8(to_upright_image(data, channels, size, orientation)?),
        Samples::U16(data) if gray => Pixels::Gray16(to_upright_image(data, channels, size, orientation)?),
        Samples::U16(data) => Pixels::Rgb16(to_upright_image(data, channels, size, orientation)?),
        Samples::F32(data) if gray => Pixels::GrayF32(to_upright_image(data, channels, size, orientation)?),
        Samples::F32(data) => Pixels::RgbF32(to_upright_image(data, channels, size, orientation)?),
    })
}

fn to_upright_image<T: Sample, const C: usize>(
    mut data: Vec<T>,
    channels: usize,
    (width, height): (usize, usize),
    orientation: u8,
) -> Result<Image<T, C>, FormatError> {
    if channels != C {
        // In place, to save a copy.
        let pixels = data.len() / channels;
        for i in 0..pixels {
            data.copy_within(i * channels..i * channels + C, i * C);
        }
        data.truncate(pixels * C);
    }
    let mut stored =
        Image::<T, C>::from_vec(width, height, data).map_err(|e| FormatError::corrupt("image", e.to_string()))?;
    // Stored position of the pixel at (x, y) of the upright image: EXIF 2.32, tag 274. Orientations 2 to 4 are applied in place.
    let (right, bottom) = (width - 1, height - 1);
    let at: fn(usize, usize, usize, usize) -> (usize, usize) = match orientation {
        2 => {
            (0..height).for_each(|y| reverse_pixels::<T, C>(stored.row_mut(y)));
            return Ok(stored);
        }
        3 => {
            reverse_pixels::<T, C>(stored.as_mut_slice());
            return Ok(stored);
        }
        4 => {
            let row = width * C;
            let (top, rest) = stored.as_mut_slice().split_at_mut(height / 2 * row);
            top.chunks_exact_mut(row).zip(rest.chunks_exact_mut(row).rev()).for_each(|(a, b)| a.swap_with_slice(b));
            return Ok(stored);
        }
        5 => |x, y, _, _| (y, x),
        6 => |x, y, _, bottom| (y, bottom - x),
        7 => |x, y, right, bottom| (right - y, bottom - x),
        8 => |x, y, right, _| (right - y, x),
        _ => return Ok(stored),
    };
    // Orientations 5 to 8 exchange width and height.
    Ok(Image::from_fn(height, width, |x, y| {
        let (x, y) = at(x, y, right, bottom);
        stored.at(x, y)
    }))
}

/// Reverses the order of pixels.
fn reverse_pixels<T: Sample, const C: usize>(samples: &mut [T]) {
    samples.as_chunks_mut::<C>().0.reverse();
}

/// Reads an image at full bit depth; see [`decode_image`].
///
/// # Errors
/// [`IoError`]: cannot be opened, or as [`decode_image`], with default [`ReadOptions`].
pub fn read_image(path: impl AsRef<Path>) -> Result<DynImage, IoError> {
    read_image_with(path, &ReadOptions::default())
}

/// As [`read_image`], with options.
///
/// # Errors
/// As [`read_image`].
pub fn read_image_with(path: impl AsRef<Path>, options: &ReadOptions) -> Result<DynImage, IoError> {
    let path = path.as_ref();
    decode_image(&read_bytes_within(path, options.max_memory)?, options)
        .map_err(|reason| IoError::reading(path, reason))
}

/// Reads an image as 8-bit RGB; see [`DynImage::into_rgb8`].
///
/// # Errors
/// As [`read_image`].
pub fn read_rgb(path: impl AsRef<Path>) -> Result<RgbU8, IoError> {
    read_image(path).map(DynImage::into_rgb8)
}

/// Reads an image as 8-bit gray; see [`DynImage::into_gray8`].
///
/// # Errors
/// As [`read_image`].
pub fn read_gray_u8(path: impl AsRef<Path>) -> Result<GrayU8, IoError> {
    read_image(path).map(DynImage::into_gray8)
}

/// Reads a mask: true where the gray level is 128 to 255.
///
/// # Errors
/// As [`read_image`].
pub fn read_mask(path: impl AsRef<Path>) -> Result<Mask, IoError> {
    Ok(read_gray_u8(path)?.map(|[v]| [v > 127]))
}

/// Reads the size (after orientation) and EXIF metadata of an image, without decoding its pixels.
///
/// # Errors
/// As [`read_image`].
pub fn read_image_info(path: impl AsRef<Path>) -> Result<((usize, usize), ExifInfo), IoError> {
    let path = path.as_ref();
    let bytes = read_bytes(path)?;
    decode_info(&bytes).map_err(|reason| IoError::reading(path, reason))
}

/// What the header of an image file says.
#[derive(Debug, Clone)]
pub struct ImageHeader {
    /// Width and height in pixels, after orientation.
    pub size: (usize, usize),
    /// EXIF information.
    pub exif: ExifInfo,
    /// EXIF block and color profile.
    pub metadata: Metadata,
    /// Bytes per sample: 1, 2 or 4.
    pub depth: usize,
    /// Peak memory in bytes to decode it to an 8-bit color image.
    pub memory: u64,
}

/// Reads the header of an image file, without decoding its pixels.
///
/// # Errors
/// As [`read_image`].
pub fn read_image_header(path: impl AsRef<Path>) -> Result<ImageHeader, IoError> {
    let path = path.as_ref();
    let bytes = read_bytes(path)?;
    let (mut header, exif) = decode_header(&bytes).map_err(|reason| IoError::reading(path, reason))?;
    let is_turned = exif.orientation >= 5;
    Ok(ImageHeader {
        size: if is_turned { (header.height, header.width) } else { (header.width, header.height) },
        metadata: Metadata { exif: header.exif.take(), icc: header.icc.take() },
        depth: header.depth,
        memory: header.memory(bytes.len(), is_turned),
        exif,
    })
}

fn decode_header(bytes: &[u8]) -> Result<(Header, ExifInfo), FormatError> {
    let format = format_detection::image_format(bytes)?;
    let header = catch_unwind(AssertUnwindSafe(|| format.header(bytes)))
        .unwrap_or_else(|_| Err(FormatError::corrupt(format.name(), "the decoder failed")))?;
    let exif = exif_info(&header);
    Ok((header, exif))
}

fn decode_info(bytes: &[u8]) -> Result<((usize, usize), ExifInfo), FormatError> {
    let (header, exif) = decode_header(bytes)?;
    let (width, height) = (header.width, header.height);
    Ok((if exif.orientation >= 5 { (height, width) } else { (width, height) }, exif))
}
