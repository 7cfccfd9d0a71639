//! Image decoders, one file per format.
//!
//! A decoder has two functions: `header` reads the file header, `raster` decodes the pixels. Decoders with large dependencies are behind
//! features of this crate.

mod bmp;
#[cfg(feature = "exr")]
mod exr;
mod hdr;
mod jpeg;
mod png;
mod pnm;
#[cfg(feature = "tiff")]
mod tiff;
#[cfg(feature = "webp")]
mod webp;

use crate::{FormatError, memory};

/// Memory limit in bytes for reading a header, before the number of pixels is checked.
const HEADER_BYTES: usize = 64 << 20;

/// An image format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Format {
    Png,
    Jpeg,
    Tiff,
    Bmp,
    Pnm,
    OpenExr,
    Hdr,
    WebP,
}

/// The header of an image file.
#[derive(Debug, Clone, Default)]
pub(crate) struct Header {
    /// Stored width and height in pixels, before the orientation is applied.
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Channels of the [`Raster`], 1 to 4.
    pub(crate) channels: usize,
    /// Bytes per sample of the [`Raster`]: 1, 2 or 4.
    pub(crate) depth: usize,
    /// Peak working memory of the decoder in bytes, without the file, the [`Raster`] and single rows.
    pub(crate) working_memory: u64,
    /// The EXIF block (a TIFF structure).
    pub(crate) exif: Option<Vec<u8>>,
    /// The ICC color profile.
    pub(crate) icc: Option<Vec<u8>>,
    /// The orientation tag, 1 to 8, where it is outside an EXIF block.
    pub(crate) orientation: Option<u8>,
}

/// The samples of an image: interleaved, row-major, 1 to 4 `channels`: gray, gray and alpha, RGB, RGB and alpha.
#[derive(Debug, Clone)]
pub(crate) struct Raster {
    pub(crate) channels: usize,
    pub(crate) samples: Samples,
}

/// Samples at the bit depth of the file.
#[derive(Debug, Clone)]
pub(crate) enum Samples {
    U8(Vec<u8>),
    U16(Vec<u16>),
    F32(Vec<f32>),
}

impl Header {
    /// Estimates the peak memory in bytes from the file to the 8-bit color image: the file, the decoder's working memory, the samples, and
    /// the copy for a rotation by 90° (`quarter`) or for the reduction to 8 bits.
    pub(crate) fn memory(&self, file: usize, quarter: bool) -> u64 {
        let bytes = |pixel: usize| memory::saturating_product(&[self.width as u64, self.height as u64, pixel as u64]);
        let raster = bytes(self.channels * self.depth);
        let turned = if quarter { raster } else { 0 };
        let reduced = if self.channels > 2 && self.depth == 1 { 0 } else { bytes(3) };
        let most = self.working_memory.max(turned).saturating_add(file as u64).max(reduced);
        raster.saturating_add(most)
    }
}

impl Format {
    /// Returns the name for messages.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Png => "PNG",
            Self::Jpeg => "JPEG",
            Self::Tiff => "TIFF",
            Self::Bmp => "BMP",
            Self::Pnm => "PNM",
            Self::OpenExr => "OpenEXR",
            Self::Hdr => "Radiance HDR",
            Self::WebP => "WebP",
        }
    }

    pub(crate) fn header(self, bytes: &[u8]) -> Result<Header, FormatError> {
        match self {
            Self::Png => png::header(bytes),
            Self::Jpeg => jpeg::header(bytes),
            Self::Bmp => bmp::header(bytes),
            Self::Pnm => pnm::header(bytes),
            Self::Hdr => hdr::header(bytes),
            #[cfg(feature = "tiff")]
            Self::Tiff => tiff::header(bytes),
            #[cfg(feature = "exr")]
            Self::OpenExr => exr::header(bytes),
            #[cfg(feature = "webp")]
            Self::WebP => webp::header(bytes),
            #[cfg(not(all(feature = "tiff", feature = "exr", feature = "webp")))]
            _ => Err(self.left_out()),
        }
    }

    /// Decodes the pixels of a file whose `header` has been checked.
    pub(crate) fn raster(self, bytes: &[u8], header: &Header) -> Result<Raster, FormatError> {
        match self {
            Self::Png => png::raster(bytes),
            Self::Jpeg => jpeg::raster(bytes),
            Self::Bmp => bmp::raster(bytes),
            Self::Pnm => pnm::raster(bytes),
            Self::Hdr => hdr::raster(bytes, header),
            #[cfg(feature = "tiff")]
            Self::Tiff => tiff::raster(bytes),
            #[cfg(feature = "exr")]
            Self::OpenExr => exr::raster(bytes, header),
            #[cfg(feature = "webp")]
            Self::WebP => webp::raster(bytes),
            #[cfg(not(all(feature = "tiff", feature = "exr", feature = "webp")))]
            _ => Err(self.left_out()),
        }
    }

    #[cfg(not(all(feature = "tiff", feature = "exr", feature = "webp")))]
    fn left_out(self) -> FormatError {
        FormatError::unsupported_picture(self.name(), "a format that is disabled in this build")
    }
}

/// Computes `width × height × channels`, or an error on overflow.
fn sample_count(format: Format, width: usize, height: usize, channels: usize) -> Result<usize, FormatError> {
    width
        .checked_mul(height)
        .and_then(|pixels| pixels.checked_mul(channels))
        .ok_or_else(|| FormatError::corrupt(format.name(), format!("the image is {width}×{height}")))
}
