//! What each picture format must be able to do, and which there are.
//!
//! A codec is one file with two functions: `header` reads what is known before any pixel, `raster` the pixels. A heavy
//! one is behind a feature of this crate.

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

/// Memory that a header may ask for before the number of pixels has been allowed, in bytes.
const HEADER_BYTES: usize = 64 << 20;

/// A picture format.
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

/// What a file says before its first pixel.
#[derive(Debug, Clone, Default)]
pub(crate) struct Header {
    /// Stored pixels, before any turn.
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Samples of a pixel of the [`Raster`], 1 to 4.
    pub(crate) channels: usize,
    /// Bytes of a sample of the [`Raster`]: 1, 2 or 4.
    pub(crate) depth: usize,
    /// The most bytes that decoding holds beside the file and the [`Raster`], single rows left out.
    pub(crate) beside: u64,
    /// The EXIF block (a TIFF structure).
    pub(crate) exif: Option<Vec<u8>>,
    /// The ICC color profile.
    pub(crate) icc: Option<Vec<u8>>,
    /// The orientation tag, 1 to 8, where it stands outside an EXIF block.
    pub(crate) orientation: Option<u8>,
}

/// The samples of a picture: interleaved, row by row, 1 to 4 `channels`: gray, gray and alpha, RGB, RGB and alpha.
#[derive(Debug, Clone)]
pub(crate) struct Raster {
    pub(crate) channels: usize,
    pub(crate) samples: Samples,
}

/// Samples as deep as the file has them.
#[derive(Debug, Clone)]
pub(crate) enum Samples {
    U8(Vec<u8>),
    U16(Vec<u16>),
    F32(Vec<f32>),
}

impl Header {
    /// The most bytes held at one time from the file in memory to the picture in colors of 8 bits: the file, what decoding holds
    /// beside the samples, the samples, and the copy that turning them by a quarter or reducing their depth takes.
    pub(crate) fn memory(&self, file: usize, quarter: bool) -> u64 {
        let bytes = |pixel: usize| memory::product(&[self.width as u64, self.height as u64, pixel as u64]);
        let raster = bytes(self.channels * self.depth);
        let turned = if quarter { raster } else { 0 };
        let reduced = if self.channels > 2 && self.depth == 1 { 0 } else { bytes(3) };
        let most = self.beside.max(turned).saturating_add(file as u64).max(reduced);
        raster.saturating_add(most)
    }
}

impl Format {
    /// The name as a person writes it.
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

    /// The pixels of a file whose `header` has been read and allowed.
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
        FormatError::unsupported_picture(self.name(), "a format left out of this build")
    }
}

/// `width × height × channels`, where memory has room for as many.
fn count(format: Format, width: usize, height: usize, channels: usize) -> Result<usize, FormatError> {
    width
        .checked_mul(height)
        .and_then(|pixels| pixels.checked_mul(channels))
        .ok_or_else(|| FormatError::corrupt(format.name(), format!("the picture is {width}×{height}")))
}
