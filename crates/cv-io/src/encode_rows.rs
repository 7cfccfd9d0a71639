//! Writing images row by row, without the whole image in memory.

use crate::encode::{Parts, PngPixels, UNKNOWN_EXTENSION, png_writer};
use crate::encode_dzi::DziWriter;
use crate::encode_jpeg::{JPEG_QUALITY, JpegWriter};
use crate::encode_tiff::{TiffLayout, TiffPosition, TiffWriter};
use crate::files::write_atomic_file;
use crate::{FormatError, IoError, Metadata};
use png::{BitDepth, ColorType};
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

/// Bytes of compressed data per PNG chunk.
const PNG_CHUNK_BYTES: usize = 1 << 18;
/// Bytes of the buffer in front of the file.
const BUFFER_BYTES: usize = 1 << 18;

type Sink = BufWriter<File>;

/// Receives an image row by row; see [`write_image_rows`].
pub struct RowWriter<'a> {
    path: &'a Path,
    metadata: Metadata,
    position: Option<TiffPosition>,
    file: Option<File>,
    /// Width and height; height counts the rows that are still to come.
    size: Option<(usize, usize)>,
    rows_left: usize,
    encoder: Option<Encoder>,
}

enum Encoder {
    Png(Box<png::StreamWriter<'static, Sink>>),
    Tiff(Box<TiffWriter<Sink>>),
    /// The file is written at the end, after the tiles.
    Dzi(Box<DziWriter>, File),
    Jpeg(Box<JpegWriter<Sink>>),
}

fn png_error(error: png::EncodingError) -> FormatError {
    match error {
        png::EncodingError::IoError(error) => FormatError::Os(error),
        error => FormatError::corrupt("PNG", error.to_string()),
    }
}

impl RowWriter<'_> {
    /// Sets the metadata; before the first rows.
    pub fn set_metadata(&mut self, metadata: Metadata) {
        self.metadata = metadata;
    }

    /// Sets the position of the top left pixel in a larger canvas, in pixels, and the size of that canvas; before the first rows. TIFF has it in the fields XPosition
    /// and YPosition (TIFF 6.0, section 12) in units of the resolution, as Hugin's and PTGui's cropped TIFF files; other formats drop it.
    pub fn set_position(&mut self, (left, top): (usize, usize), (canvas_width, canvas_height): (usize, usize)) {
        let [left, top, width, height] = [left, top, canvas_width, canvas_height].map(|v| v as u32);
        self.position = Some(TiffPosition { left, top, width, height });
    }

    /// Sets the size in pixels; before the first rows.
    pub fn set_size(&mut self, width: usize, height: usize) {
        (self.size, self.rows_left) = (Some((width, height)), height);
    }

    /// Writes the next rows, of the width of the image and always the same pixel type.
    ///
    /// # Errors
    /// [`FormatError`]: the format cannot hold the image, the rows do not fit the size, or [`FormatError::Os`].
    pub fn write(&mut self, rows: impl PngPixels) -> Result<(), FormatError> {
        self.write_parts(rows.parts())
    }

    pub(crate) fn write_parts(&mut self, (width, rows, color, depth, bytes): Parts<'_>) -> Result<(), FormatError> {
        let wrong = || FormatError::corrupt("image", format!("{width}×{rows} more pixels do not fit its size"));
        let size = self.size.filter(|size| size.0 == width && rows <= self.rows_left).ok_or_else(wrong)?;
        self.rows_left -= rows;
        if let Some(file) = self.file.take() {
            self.encoder = Some(self.encoder_for(file, size, color, depth)?);
        }
        match &mut self.encoder {
            Some(Encoder::Png(writer)) => Ok(writer.write_all(&bytes)?),
            Some(Encoder::Tiff(writer)) => writer.write(&bytes),
            Some(Encoder::Dzi(writer, _)) => writer.write(&bytes),
            Some(Encoder::Jpeg(writer)) => writer.write(&bytes),
            None => Ok(()),
        }
    }

    fn encoder_for(
        &self,
        file: File,
        (width, height): (usize, usize),
        color: ColorType,
        depth: BitDepth,
    ) -> Result<Encoder, FormatError> {
        let refused = |format, what| FormatError::NotRepresentable { format, what };
        let too_large = |format| refused(format, format!("an image of {width}×{height}"));
        let extension = self.path.extension().map(|e| e.to_string_lossy().to_lowercase());
        match extension.as_deref() {
            Some("png") => {
                let side = |n: usize| u32::try_from(n).ok().filter(|&n| n > 0 && n <= i32::MAX as u32);
                let (Some(w), Some(h)) = (side(width), side(height)) else { return Err(too_large("PNG")) };
                let sink = BufWriter::with_capacity(BUFFER_BYTES, file);
                let writer = png_writer(sink, (w, h), (color, depth), &self.metadata, None).map_err(png_error)?;
                let writer = writer.into_stream_writer_with_size(PNG_CHUNK_BYTES).map_err(png_error)?;
                Ok(Encoder::Png(Box::new(writer)))
            }
            Some("tif" | "tiff") => {
                let depth = if depth == BitDepth::Sixteen { 2 } else { 1 };
                let layout = TiffLayout::new(width, height, color.samples(), depth)?;
                let sink = BufWriter::with_capacity(BUFFER_BYTES, file);
                Ok(Encoder::Tiff(Box::new(TiffWriter::new(sink, layout, &self.metadata, self.position)?)))
            }
            Some("dzi") => {
                let writer = DziWriter::new(self.path, (width, height), (color, depth))?;
                Ok(Encoder::Dzi(Box::new(writer), file))
            }
            Some("jpg" | "jpeg") => {
                let sink = BufWriter::with_capacity(BUFFER_BYTES, file);
                let (size, pixels) = ((width, height), (color, depth));
                let writer = JpegWriter::new(sink, size, pixels, JPEG_QUALITY, self.metadata.clone())?;
                Ok(Encoder::Jpeg(Box::new(writer)))
            }
            _ => Err(FormatError::unsupported("the file name", UNKNOWN_EXTENSION)),
        }
    }

    fn finish(self) -> Result<(), FormatError> {
        if self.rows_left > 0 || self.encoder.is_none() {
            return Err(FormatError::corrupt("image", format!("{} rows are missing", self.rows_left)));
        }
        match self.encoder {
            Some(Encoder::Png(writer)) => writer.finish().map_err(png_error),
            Some(Encoder::Tiff(writer)) => writer.finish(),
            Some(Encoder::Dzi(writer, mut file)) => Ok(file.write_all(writer.finish()?.as_bytes())?),
            Some(Encoder::Jpeg(writer)) => writer.finish(),
            None => Ok(()),
        }
    }
}

/// Writes an image row by row, in the format of the file name's extension: `.png`, `.tif` or `.tiff`, `.jpg` or `.jpeg` (8-bit colors), or `.dzi`. The file appears
/// when `write` has succeeded, as by [`write_atomic`](crate::write_atomic).
///
/// A Deep Zoom image `a.dzi` (8 bits) has its tiles in a folder `a_files` beside it: tiles of 254 px with an overlap of 1 px, as JPEG, or PNG with alpha. The
/// folder of an existing `a.dzi` is replaced.
///
/// # Errors
/// Whatever `write` fails with; [`IoError`] as for [`write_image`](crate::write_image), and where rows are missing.
pub fn write_image_rows<R, E: From<IoError>>(
    path: impl AsRef<Path>,
    write: impl FnOnce(&mut RowWriter<'_>) -> Result<R, E>,
) -> Result<R, E> {
    let path = path.as_ref();
    let (mut write, mut outcome) = (Some(write), None);
    let mut content = |file: File| -> Result<(), FormatError> {
        let mut rows = RowWriter {
            path,
            metadata: Metadata::default(),
            position: None,
            file: Some(file),
            size: None,
            rows_left: 0,
            encoder: None,
        };
        let Some(write) = write.take() else { return Ok(()) };
        let result = write(&mut rows);
        let is_written = result.is_ok();
        outcome = Some(result);
        // The temporary file is removed.
        if is_written { rows.finish() } else { Err(io::Error::other("it was not finished").into()) }
    };
    let written = write_atomic_file(path, &mut content);
    match (outcome, written) {
        (Some(Err(error)), _) => Err(error),
        (_, Err(reason)) => Err(IoError::writing(path, reason).into()),
        (Some(Ok(result)), Ok(())) => Ok(result),
        (None, Ok(())) => Err(IoError::writing(path, FormatError::Empty).into()),
    }
}
