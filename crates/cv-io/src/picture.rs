//! Reading pictures of any of the supported formats.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use cv_core::{GrayF32, GrayU8, Image, Mask, RgbF32, RgbU8, Sample};

use crate::codec::{Format, Header, Raster, Samples};
use crate::exif_info::is_raw_preview;
use crate::files::{read_bytes, read_bytes_within};
use crate::{ExifInfo, FormatError, IoError, Metadata, memory, sniff, srgb};

/// The default for [`ReadOptions::max_pixels`]: 256 Mpx.
pub const DEFAULT_MAX_PIXELS: u64 = 256 << 20;

/// How pictures, maps and arrays are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadOptions {
    /// The most pixels a picture may have; its header is checked before anything is allocated. Default
    /// [`DEFAULT_MAX_PIXELS`], more than the sensor of any camera sold and 768 MiB as 8-bit color.
    pub max_pixels: u64,
    /// The most memory that reading one file may take, in bytes: the file, what decoding holds beside the result, and the result,
    /// judged by the header before anything is allocated. Default [`default_max_memory`](crate::default_max_memory).
    pub max_memory: u64,
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self { max_pixels: DEFAULT_MAX_PIXELS, max_memory: memory::default_max_memory() }
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
    /// What the file says beside the pixels, for pictures made of this one.
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
            Pixels::GrayF32(image) => image.map(|[v]| [srgb::byte(v); 3]),
            Pixels::RgbF32(image) => image.map(|p| p.map(srgb::byte)),
        }
    }

    /// As RGB of 16 bits, 65535 for white: 8 bits are multiplied by 257, gray is repeated, linear light is clipped to 0 to 1 and sRGB-encoded.
    pub fn into_rgb16(self) -> Image<u16, 3> {
        let word = |v: u8| 257 * u16::from(v);
        match self.pixels {
            Pixels::Rgb16(image) => image,
            Pixels::Gray16(image) => image.map(|[v]| [v; 3]),
            Pixels::Gray8(image) => image.map(|[v]| [word(v); 3]),
            Pixels::Rgb8(image) => image.map(|p| p.map(word)),
            Pixels::GrayF32(image) => image.map(|[v]| [srgb::word(v); 3]),
            Pixels::RgbF32(image) => image.map(|p| p.map(srgb::word)),
        }
    }

    /// As gray bytes: as [`DynImage::into_rgb8`], then Rec. 601 luma
    /// ([`luma_u8`](cv_core::luma_u8)).
    pub fn into_gray8(self) -> GrayU8 {
        match self.pixels {
            Pixels::Gray8(image) => image,
            Pixels::Gray16(image) => image.map(|[v]| [to_byte(v)]),
            Pixels::GrayF32(image) => image.map(|[v]| [srgb::byte(v)]),
            _ => self.into_rgb8().map(|rgb| [cv_core::luma_u8(rgb)]),
        }
    }
}

fn to_byte(v: u16) -> u8 {
    ((u32::from(v) + 128) / 257) as u8
}

/// Decodes the bytes of a PNG, JPEG, TIFF, WebP, BMP, PNM, OpenEXR or Radiance HDR file.
///
/// The format is told by the content. The EXIF orientation is applied. An alpha channel is dropped, as OpenCV and COLMAP do:
/// the colors under it are returned as they are stored. Palettes are resolved; CMYK and YCCK JPEGs become RGB by
/// plain inversion, without a color profile. Embedded profiles are not applied.
///
/// # Errors
/// [`FormatError`]: not a picture, damaged, cut short, or more pixels or memory than `options` allow.
pub fn decode_image(bytes: &[u8], options: &ReadOptions) -> Result<DynImage, FormatError> {
    let format = sniff::picture_format(bytes)?;
    let name = format.name();
    // The codecs are other people's code: should one panic, that is this file's error and not the program's end.
    catch_unwind(AssertUnwindSafe(|| decode(bytes, format, options)))
        .unwrap_or_else(|_| Err(FormatError::corrupt(name, "the decoder gave up on it")))
}

fn decode(bytes: &[u8], format: Format, options: &ReadOptions) -> Result<DynImage, FormatError> {
    if format == Format::Tiff && is_raw_preview(bytes) {
        return Err(FormatError::unsupported_picture("camera raw", "undeveloped sensor data"));
    }
    let mut header = format.header(bytes)?;
    let (w, h) = (header.width as u64, header.height as u64);
    if w.saturating_mul(h) > options.max_pixels {
        return Err(FormatError::TooManyPixels { width: w, height: h, limit: options.max_pixels });
    }
    if w == 0 || h == 0 {
        return Err(FormatError::corrupt(format.name(), format!("the picture is {w}×{h}")));
    }
    sniff::plausible(format, bytes, w, h)?;
    let exif = exif_of(&header);
    memory::allow(header.memory(bytes.len(), exif.orientation >= 5), options.max_memory, Some((w, h)))?;
    let raster = format.raster(bytes, &header)?;
    let pixels = pixels(raster, header.width, header.height, exif.orientation)?;
    let metadata = Metadata { exif: header.exif.take(), icc: header.icc.take() };
    Ok(DynImage { pixels, exif, metadata })
}

fn exif_of(header: &Header) -> ExifInfo {
    let mut info = match &header.exif {
        Some(block) => ExifInfo::parse(block.clone(), header.width, header.height),
        None => ExifInfo::default(),
    };
    if let Some(orientation) = header.orientation.filter(|tag| (1..=8).contains(tag)) {
        info.orientation = orientation;
    }
    info
}

/// Without alpha, and turned the right way up.
fn pixels(raster: Raster, width: usize, height: usize, orientation: u8) -> Result<Pixels, FormatError> {
    let (size, channels) = ((width, height), raster.channels);
    let gray = channels < 3;
    Ok(match raster.samples {
        Samples::U8(data) if gray => Pixels::Gray8(upright(data, channels, size, orientation)?),
        Samples::U8(data) => Pixels::Rgb8(upright(data, channels, size, orientation)?),
        Samples::U16(data) if gray => Pixels::Gray16(upright(data, channels, size, orientation)?),
        Samples::U16(data) => Pixels::Rgb16(upright(data, channels, size, orientation)?),
        Samples::F32(data) if gray => Pixels::GrayF32(upright(data, channels, size, orientation)?),
        Samples::F32(data) => Pixels::RgbF32(upright(data, channels, size, orientation)?),
    })
}

fn upright<T: Sample, const C: usize>(
    mut data: Vec<T>,
    channels: usize,
    (width, height): (usize, usize),
    orientation: u8,
) -> Result<Image<T, C>, FormatError> {
    if channels != C {
        // In place: a copy without alpha would take as much again.
        let pixels = data.len() / channels;
        for i in 0..pixels {
            data.copy_within(i * channels..i * channels + C, i * C);
        }
        data.truncate(pixels * C);
    }
    let mut stored =
        Image::<T, C>::from_vec(width, height, data).map_err(|e| FormatError::corrupt("picture", e.to_string()))?;
    // Where the pixel to be seen at (x, y) is stored: EXIF 2.32, tag 274. The first three in place.
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
    // On its side.
    Ok(Image::from_fn(height, width, |x, y| {
        let (x, y) = at(x, y, right, bottom);
        stored.at(x, y)
    }))
}

/// The last pixel first.
fn reverse_pixels<T: Sample, const C: usize>(samples: &mut [T]) {
    samples.as_chunks_mut::<C>().0.reverse();
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
    decode_image(&read_bytes_within(path, options.max_memory)?, options)
        .map_err(|reason| IoError::reading(path, reason))
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
    let header = catch_unwind(AssertUnwindSafe(|| format.header(bytes)))
        .unwrap_or_else(|_| Err(FormatError::corrupt(format.name(), "the decoder gave up on it")))?;
    let exif = exif_of(&header);
    let (width, height) = (header.width, header.height);
    Ok((if exif.orientation >= 5 { (height, width) } else { (width, height) }, exif))
}

#[cfg(test)]
mod tests;
