//! Encoding images as baseline JPEG (ITU-T T.81): large ones in strips that are encoded in parallel, separated by restart markers.

use std::io::Write;
use std::path::Path;

use cv_core::ImageView;
use cv_parallel::prelude::*;
use jpeg_encoder::{JpegColorType, SamplingFactor};
use png::{BitDepth, ColorType};

use crate::encode::{Parts, PngPixels};
use crate::files::write_bytes;
use crate::{FormatError, IoError, Metadata};

/// Quality of JPEG files, 1 to 100.
pub(crate) const JPEG_QUALITY: u8 = 95;
/// Minimum number of pixels of a strip but the last: some milliseconds of computing, and a marker in a hundred kilobytes.
const STRIP_PIXELS: usize = 1 << 19;
/// Sides of a minimum coded unit with subsampled chroma; without, they are half of that.
const UNIT_ROWS: usize = 16;

/// Image types that can be written as JPEG: 8-bit views of 1 or 3 channels.
pub trait JpegPixels: PngPixels {}
impl JpegPixels for ImageView<'_, u8, 1> {}
impl JpegPixels for ImageView<'_, u8, 3> {}

/// Encodes a JPEG file at `quality` 1 to 100 (95 is visually lossless). Chroma is not subsampled from 90 on.
///
/// # Errors
/// [`FormatError::NotRepresentable`] for an empty image or one with a side above 65535.
pub fn encode_jpeg(view: impl JpegPixels, quality: u8) -> Result<Vec<u8>, FormatError> {
    encode_jpeg_parts(view.parts(), quality, &Metadata::default())
}

/// Writes a JPEG at quality 95.
///
/// # Errors
/// As [`encode_jpeg`] and [`crate::write_atomic`].
pub fn write_jpeg(path: impl AsRef<Path>, view: impl JpegPixels) -> Result<(), IoError> {
    let path = path.as_ref();
    write_bytes(path, &encode_jpeg(view, JPEG_QUALITY).map_err(|reason| IoError::writing(path, reason))?)
}

pub(crate) fn encode_jpeg_parts(
    (width, height, color, depth, pixels): Parts<'_>,
    quality: u8,
    metadata: &Metadata,
) -> Result<Vec<u8>, FormatError> {
    let mut bytes = Vec::new();
    JpegWriter::new(&mut bytes, (width, height), (color, depth), quality, metadata.clone())?.write(&pixels)?;
    Ok(bytes)
}

/// Writes a JPEG file whose rows arrive from the top. Its bytes depend neither on how many arrive at once nor on the number of threads.
pub(crate) struct JpegWriter<W> {
    sink: W,
    strips: Strips,
    /// Rows of a strip that is not complete.
    pending: Vec<u8>,
    /// Number of strips that are written.
    written: usize,
}

impl<W: Write> JpegWriter<W> {
    /// Prepares a file of these sides; nothing is written yet.
    pub(crate) fn new(
        sink: W,
        size: (usize, usize),
        pixels: (ColorType, BitDepth),
        quality: u8,
        metadata: Metadata,
    ) -> Result<Self, FormatError> {
        let strips = Strips::new(size, pixels, quality, metadata)?;
        Ok(Self { sink, strips, pending: Vec::new(), written: 0 })
    }

    /// Writes whole rows.
    pub(crate) fn write(&mut self, mut rows: &[u8]) -> Result<(), FormatError> {
        let strip = self.strips.rows * self.strips.row_bytes();
        if !self.pending.is_empty() {
            let (first, rest) = rows.split_at((strip - self.pending.len()).min(rows.len()));
            self.pending.extend_from_slice(first);
            rows = rest;
            if self.pending.len() == strip {
                self.write_pending()?;
            }
        }
        let (whole, rest) = rows.split_at(rows.len() - rows.len() % strip);
        self.write_strips(whole)?;
        self.pending.extend_from_slice(rest);
        let missing = usize::from(self.strips.height).saturating_sub(self.written * self.strips.rows);
        if self.pending.len() == missing * self.strips.row_bytes() {
            self.write_pending()?;
        }
        Ok(())
    }

    /// Flushes the sink.
    pub(crate) fn finish(mut self) -> Result<(), FormatError> {
        Ok(self.sink.flush()?)
    }

    fn write_pending(&mut self) -> Result<(), FormatError> {
        let rows = std::mem::take(&mut self.pending);
        self.write_strips(&rows)
    }

    /// Encodes whole strips, or the last one, in parallel.
    fn write_strips(&mut self, rows: &[u8]) -> Result<(), FormatError> {
        let (strips, first) = (&self.strips, self.written);
        let encoded = rows
            .par_chunks(strips.rows * strips.row_bytes())
            .enumerate()
            .map(|(i, rows)| strips.encode(first + i, rows))
            .try_collect::<_, FormatError>()?;
        self.written += encoded.len();
        encoded.iter().try_for_each(|bytes| self.sink.write_all(bytes)).map_err(FormatError::Os)
    }
}

/// The strips of an image; each is a restart interval.
struct Strips {
    width: u16,
    height: u16,
    /// 1 or 3.
    channels: usize,
    quality: u8,
    metadata: Metadata,
    /// Rows of each but the last.
    rows: usize,
}

impl Strips {
    fn new(
        (width, height): (usize, usize),
        (color, depth): (ColorType, BitDepth),
        quality: u8,
        metadata: Metadata,
    ) -> Result<Self, FormatError> {
        let refused = |what| FormatError::NotRepresentable { format: "JPEG", what };
        if depth != BitDepth::Eight || color == ColorType::Rgba {
            return Err(refused(if depth == BitDepth::Eight { "alpha" } else { "samples of 16 bits" }.to_owned()));
        }
        let side = |n: usize| u16::try_from(n).ok().filter(|&n| n > 0);
        let (Some(w), Some(h)) = (side(width), side(height)) else {
            return Err(refused(format!("an image of {width}×{height}")));
        };
        let rows = STRIP_PIXELS.div_ceil(width).next_multiple_of(UNIT_ROWS);
        Ok(Self { width: w, height: h, channels: color.samples(), quality: quality.clamp(1, 100), metadata, rows })
    }

    fn row_bytes(&self) -> usize {
        self.channels * usize::from(self.width)
    }

    /// Encodes a strip as the part of the file that ends with its restart marker, or with the end of the image. The first one begins with the header.
    fn encode(&self, index: usize, rows: &[u8]) -> Result<Vec<u8>, FormatError> {
        let fail = |e: jpeg_encoder::EncodingError| FormatError::corrupt("JPEG", e.to_string());
        let mut bytes = Vec::new();
        let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, self.quality);
        let (sampling, unit) = if self.quality < 90 && self.channels == 3 {
            (SamplingFactor::F_2_2, UNIT_ROWS)
        } else {
            (SamplingFactor::F_1_1, UNIT_ROWS / 2)
        };
        encoder.set_sampling_factor(sampling);
        if index == 0 {
            let exif = self.metadata.exif_for(self.width.into(), self.height.into());
            let exif = exif.map(|block| [&b"Exif\0\0"[..], &block].concat());
            // The maximum of a segment; EXIF blocks without thumbnail are far smaller.
            if let Some(exif) = exif.filter(|exif| exif.len() <= 65_533) {
                encoder.add_app_segment(1, exif).map_err(fail)?;
            }
            if let Some(profile) = self.metadata.icc_for(self.channels) {
                encoder.add_icc_profile(profile).map_err(fail)?;
            }
        }
        let strips = usize::from(self.height).div_ceil(self.rows);
        if strips > 1 {
            // At most 16384 minimum coded units: two rows of 8192.
            encoder.set_restart_interval((usize::from(self.width).div_ceil(unit) * (self.rows / unit)) as u16);
        }
        let height = (rows.len() / self.row_bytes()) as u16;
        encoder
            .encode_image(JpegRows { width: self.width, height, channels: self.channels, pixels: rows })
            .map_err(fail)?;
        if strips == 1 {
            return Ok(bytes);
        }
        let header = Header::parse(&bytes).ok_or_else(|| FormatError::corrupt("JPEG", "no header".to_owned()))?;
        if index + 1 < strips {
            // The marker of the end becomes a restart marker: they count from RST0 to RST7.
            let end = bytes.len() - 1;
            bytes[end] = 0xD0 + (index % 8) as u8;
        }
        if index == 0 {
            bytes[header.height..header.height + 2].copy_from_slice(&self.height.to_be_bytes());
        } else {
            bytes.drain(..header.len);
        }
        Ok(bytes)
    }
}

/// Places in the header of a baseline JPEG file.
struct Header {
    /// Offset of the height, of two bytes.
    height: usize,
    /// Offset of the entropy-coded data.
    len: usize,
}

impl Header {
    fn parse(bytes: &[u8]) -> Option<Self> {
        let (mut at, mut height) = (2, None);
        while let [0xFF, marker, high, low] = *bytes.get(at..at + 4)? {
            if marker == 0xC0 {
                // After the marker, the length and the precision.
                height = Some(at + 5);
            }
            at += 2 + usize::from(u16::from_be_bytes([high, low]));
            if marker == 0xDA {
                return Some(Self { height: height?, len: at });
            }
        }
        None
    }
}

/// Pixels for the encoder. (Its own `encode` would be compiled for nine pixel types.)
struct JpegRows<'a> {
    width: u16,
    height: u16,
    /// 1 or 3.
    channels: usize,
    pixels: &'a [u8],
}

impl jpeg_encoder::ImageBuffer for JpegRows<'_> {
    fn get_jpeg_color_type(&self) -> JpegColorType {
        if self.channels == 1 { JpegColorType::Luma } else { JpegColorType::Ycbcr }
    }

    fn width(&self) -> u16 {
        self.width
    }

    fn height(&self) -> u16 {
        self.height
    }

    fn fill_buffers(&self, y: u16, buffers: &mut [Vec<u8>; 4]) {
        let row = self.channels * usize::from(self.width);
        let row = &self.pixels[usize::from(y) * row..][..row];
        let [luma, blue, red, _] = buffers;
        if self.channels == 1 {
            return luma.extend_from_slice(row);
        }
        for &[r, g, b] in row.as_chunks().0 {
            let ycc = jpeg_encoder::rgb_to_ycbcr(r, g, b);
            luma.push(ycc.0);
            blue.push(ycc.1);
            red.push(ycc.2);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

    use super::*;
    use cv_core::Image;

    /// Encodes an image whose rows arrive `at_once`.
    fn encoded(parts: &Parts<'_>, quality: u8, at_once: usize) -> Vec<u8> {
        let (width, height, color, depth, pixels) = parts;
        let mut bytes = Vec::new();
        let mut writer =
            JpegWriter::new(&mut bytes, (*width, *height), (*color, *depth), quality, Metadata::default()).unwrap();
        pixels.chunks(at_once * width * color.samples()).for_each(|rows| writer.write(rows).unwrap());
        bytes
    }

    #[test]
    fn strips_are_the_same_however_the_rows_arrive() {
        // Ten strips, so that the markers go round, the last one of three rows; with and without subsampled chroma.
        let color = Image::<u8, 3>::from_fn(11_000, 9 * 48 + 3, |x, y| {
            [(x / 63) as u8, (y * 3 % 256) as u8, ((x ^ y) % 256) as u8]
        });
        let gray = color.map(|p| [p[2]]);
        for (parts, quality) in [(color.view().parts(), 95), (color.view().parts(), 80), (gray.view().parts(), 95)] {
            let bytes = encoded(&parts, quality, parts.1);
            for at_once in [47, 100] {
                assert!(encoded(&parts, quality, at_once) == bytes, "{at_once} rows at once");
            }
        }
    }
}
