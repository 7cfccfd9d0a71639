//! Writing TIFF: strips with Deflate compression after horizontal differencing (TIFF 6.0, section 14, and Adobe's technical note on Deflate),
//! little-endian. BigTIFF where 32-bit positions may not suffice.

use crate::big_tiff::{to_big_tiff, u16_at, u32_at};
use crate::{FormatError, Metadata};
use exif::experimental::Writer;
use exif::{Context, Field, In, Tag, Value};
use std::io::{Cursor, Seek, SeekFrom, Write};

/// Approximate bytes of a strip before compression.
const STRIP_BYTES: usize = 1 << 18;
/// Deflate compression level, 0 to 10: higher levels shrink 16-bit photographs little more.
const COMPRESSION_LEVEL: u8 = 3;

/// The samples of an image: row-major, big-endian, without padding.
pub(crate) struct Samples<'a> {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// 1 (gray), 3 (RGB) or 4 (RGB and alpha).
    pub(crate) channels: usize,
    /// Bytes per sample: 1 or 2.
    pub(crate) depth: usize,
    pub(crate) bytes: &'a [u8],
}

/// Encodes a TIFF file.
///
/// # Errors
/// [`FormatError::NotRepresentable`] for an empty image.
pub(crate) fn encode_samples(samples: &Samples<'_>, metadata: &Metadata) -> Result<Vec<u8>, FormatError> {
    let Samples { width, height, channels, depth, bytes } = *samples;
    let layout = TiffLayout::new(width, height, channels, depth)?;
    let mut file = Cursor::new(Vec::new());
    let mut writer = TiffWriter::new(&mut file, layout, metadata, None)?;
    writer.write(bytes)?;
    writer.finish()?;
    Ok(file.into_inner())
}

/// Size and sample format of a TIFF file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TiffLayout {
    width: u32,
    height: u32,
    channels: usize,
    /// Bytes per sample: 1 or 2.
    depth: usize,
    /// BigTIFF, with 64-bit positions.
    is_big: bool,
}

/// Bytes of samples from which on files are BigTIFF: compressed photographs are smaller, but by how much is unknown before. Directories and metadata have the rest
/// of 4 GiB.
const BIG_TIFF_BYTES: u64 = (1 << 32) - (1 << 26);

impl TiffLayout {
    /// # Errors
    /// [`FormatError::NotRepresentable`] for an empty image.
    pub(crate) fn new(width: usize, height: usize, channels: usize, depth: usize) -> Result<Self, FormatError> {
        let side = |n: usize| u32::try_from(n).ok().filter(|&n| n > 0);
        match (side(width), side(height)) {
            (Some(width), Some(height)) => {
                let bytes = u128::from(width) * u128::from(height) * (channels * depth) as u128;
                Ok(Self { width, height, channels, depth, is_big: bytes > u128::from(BIG_TIFF_BYTES) })
            }
            _ => Err(FormatError::NotRepresentable { format: "TIFF", what: format!("an image of {width}×{height}") }),
        }
    }

    /// Bytes of a row before compression.
    fn row(&self) -> usize {
        self.width as usize * self.channels * self.depth
    }

    /// Rows of a strip.
    fn rows(&self) -> usize {
        (STRIP_BYTES / self.row()).clamp(1, self.height as usize)
    }

    fn fields(&self, metadata: &Metadata) -> Vec<Field> {
        let Self { width, height, channels, depth, .. } = *self;
        let numbers =
            |tag: Tag, values: &[u16]| Field { tag, ifd_num: In::PRIMARY, value: Value::Short(values.to_vec()) };
        let number = |tag: Tag, value: u32| Field { tag, ifd_num: In::PRIMARY, value: Value::Long(vec![value]) };
        let mut fields = metadata.tiff_fields(width, height);
        fields.extend([
            number(Tag::ImageWidth, width),
            number(Tag::ImageLength, height),
            numbers(Tag::BitsPerSample, &vec![8 * depth as u16; channels]),
            numbers(Tag::Compression, &[8]),
            numbers(Tag::PhotometricInterpretation, &[if channels == 1 { 1 } else { 2 }]),
            numbers(Tag::SamplesPerPixel, &[channels as u16]),
            number(Tag::RowsPerStrip, self.rows() as u32),
            numbers(Tag::PlanarConfiguration, &[1]),
            // Horizontal differencing.
            numbers(Tag(Context::Tiff, 317), &[2]),
        ]);
        if channels == 4 {
            // Unassociated alpha.
            fields.push(numbers(Tag(Context::Tiff, 338), &[2]));
        }
        if let Some(profile) = metadata.icc_for(channels) {
            let value = Value::Undefined(profile.to_vec(), 0);
            fields.push(Field { tag: Tag(Context::Tiff, 34675), ifd_num: In::PRIMARY, value });
        }
        fields
    }
}

/// Position of an image in a larger canvas, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TiffPosition {
    pub(crate) left: u32,
    pub(crate) top: u32,
    /// Size of the canvas.
    pub(crate) width: u32,
    pub(crate) height: u32,
}

/// Pixels per inch of files with a position, which is stored in inches.
const POSITION_DPI: u32 = 150;

impl TiffPosition {
    fn add_to(self, fields: &mut Vec<Field>) {
        let resolution = [Tag::XResolution, Tag::YResolution, Tag::ResolutionUnit];
        fields.retain(|field| !resolution.contains(&field.tag));
        let ratio = |tag: Tag, num: u32, denom: u32| {
            let value = Value::Rational(vec![exif::Rational { num, denom }]);
            Field { tag, ifd_num: In::PRIMARY, value }
        };
        let number = |tag: u16, value: u32| Field {
            tag: Tag(Context::Tiff, tag),
            ifd_num: In::PRIMARY,
            value: Value::Long(vec![value]),
        };
        fields.extend([
            ratio(Tag::XResolution, POSITION_DPI, 1),
            ratio(Tag::YResolution, POSITION_DPI, 1),
            Field { tag: Tag::ResolutionUnit, ifd_num: In::PRIMARY, value: Value::Short(vec![2]) },
            // XPosition and YPosition.
            ratio(Tag(Context::Tiff, 286), self.left, POSITION_DPI),
            ratio(Tag(Context::Tiff, 287), self.top, POSITION_DPI),
            // ImageFullWidth and ImageFullLength, as Hugin and PTGui write them.
            number(33300, self.width),
            number(33301, self.height),
        ]);
    }
}

/// Writes a TIFF file by rows: the fields first, with places for the positions of the strips, which are written at the end.
pub(crate) struct TiffWriter<W> {
    sink: W,
    layout: TiffLayout,
    /// Rows of the next strip, before compression.
    pending: Vec<u8>,
    /// Bytes of each strip in the file.
    strips: Vec<u32>,
    /// Number of strips of the whole image.
    count: usize,
    /// Position of the first strip, and of the arrays of offsets and of byte counts.
    places: [u64; 3],
    /// End of the last strip.
    end: u64,
}

impl<W: Write + Seek> TiffWriter<W> {
    /// Writes the fields.
    ///
    /// # Errors
    /// [`FormatError::Os`].
    pub(crate) fn new(
        mut sink: W,
        layout: TiffLayout,
        metadata: &Metadata,
        position: Option<TiffPosition>,
    ) -> Result<Self, FormatError> {
        let count = (layout.height as usize).div_ceil(layout.rows());
        let mut fields = layout.fields(metadata);
        if let Some(position) = position {
            position.add_to(&mut fields);
        }
        let strips = vec![&[][..]; count];
        let mut writer = Writer::new();
        fields.iter().for_each(|field| writer.push_field(field));
        writer.set_strips(&strips, In::PRIMARY);
        let mut head = Cursor::new(Vec::new());
        writer.write(&mut head, true).map_err(|e| FormatError::corrupt("TIFF", e.to_string()))?;
        let mut head = head.into_inner();
        let no_strips = || FormatError::corrupt("TIFF", "no strips");
        let [offsets, byte_counts] = if layout.is_big {
            let big = to_big_tiff(&head).ok_or_else(no_strips)?;
            head = big.bytes;
            [big.offsets as u64, big.byte_counts as u64]
        } else {
            let place = |tag| value_position(&head, tag).ok_or_else(no_strips);
            [place(273)?, place(279)?]
        };
        let end = head.len() as u64;
        sink.write_all(&head)?;
        let strips = Vec::with_capacity(count);
        Ok(Self { sink, layout, pending: Vec::new(), strips, count, places: [end, offsets, byte_counts], end })
    }

    /// Writes the next rows: big-endian samples without padding.
    ///
    /// # Errors
    /// [`FormatError::Os`].
    pub(crate) fn write(&mut self, rows: &[u8]) -> Result<(), FormatError> {
        let strip = self.layout.rows() * self.layout.row();
        let mut rest = rows;
        while !rest.is_empty() {
            let (part, after) = rest.split_at(rest.len().min(strip - self.pending.len()));
            self.pending.extend_from_slice(part);
            rest = after;
            if self.pending.len() == strip {
                self.write_strip()?;
            }
        }
        Ok(())
    }

    fn write_strip(&mut self) -> Result<(), FormatError> {
        let TiffLayout { channels, depth, .. } = self.layout;
        for row in self.pending.chunks_exact_mut(self.layout.row()) {
            if depth == 1 { difference_u8(row, channels) } else { difference_u16(row, channels) }
        }
        let strip = miniz_oxide::deflate::compress_to_vec_zlib(&self.pending, COMPRESSION_LEVEL);
        self.pending.clear();
        self.strips.push(strip.len() as u32);
        self.end += strip.len() as u64;
        if self.end > u64::from(u32::MAX) && !self.layout.is_big {
            // Samples that Deflate cannot compress, with metadata of more than 64 MiB.
            return Err(FormatError::NotRepresentable { format: "TIFF", what: "more than 4 GiB".to_owned() });
        }
        Ok(self.sink.write_all(&strip)?)
    }

    /// Writes the last strip and the positions of all.
    ///
    /// # Errors
    /// [`FormatError::Os`]; [`FormatError::Corrupt`] where rows are missing.
    pub(crate) fn finish(mut self) -> Result<(), FormatError> {
        if !self.pending.is_empty() {
            self.write_strip()?;
        }
        if self.strips.len() != self.count {
            return Err(FormatError::corrupt("TIFF", format!("{} of {} strips", self.strips.len(), self.count)));
        }
        let [first, offsets, counts] = self.places;
        let mut at = first;
        let starts = self.strips.iter().flat_map(|n| {
            let start = at.to_le_bytes();
            at += u64::from(*n);
            // The first four bytes of a little-endian number are its 32-bit value.
            start.into_iter().take(if self.layout.is_big { 8 } else { 4 })
        });
        let starts: Vec<u8> = starts.collect();
        let lengths: Vec<u8> = self.strips.iter().flat_map(|n| n.to_le_bytes()).collect();
        for (place, bytes) in [(offsets, starts), (counts, lengths)] {
            self.sink.seek(SeekFrom::Start(place))?;
            self.sink.write_all(&bytes)?;
        }
        Ok(self.sink.flush()?)
    }
}

/// Returns the position of the values of a field of 32-bit numbers in the first directory of a little-endian TIFF.
fn value_position(head: &[u8], tag: u16) -> Option<u64> {
    let directory = u32_at(head, 4)?;
    let mut entries = (0..u16_at(head, directory)?).map(|i| directory + 2 + 12 * i);
    let entry = entries.find(|&at| u16_at(head, at) == Some(tag.into()))?;
    // One value of four bytes is in the entry itself.
    let position = if u32_at(head, entry + 4)? == 1 { entry + 8 } else { u32_at(head, entry + 8)? };
    Some(position as u64)
}

/// Applies horizontal differencing to 8-bit samples.
fn difference_u8(row: &mut [u8], channels: usize) {
    for i in (channels..row.len()).rev() {
        row[i] = row[i].wrapping_sub(row[i - channels]);
    }
}

/// Applies horizontal differencing to 16-bit samples and converts them to little-endian.
fn difference_u16(row: &mut [u8], channels: usize) {
    let words = row.as_chunks_mut::<2>().0;
    for i in (0..words.len()).rev() {
        let before = i.checked_sub(channels).map_or(0, |j| u16::from_be_bytes(words[j]));
        words[i] = u16::from_be_bytes(words[i]).wrapping_sub(before).to_le_bytes();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::Format;
    use crate::format_detection::image_format;
    use tiff::decoder::{Decoder, DecodingResult, ifd};
    use tiff::tags::Tag as TiffTag;

    fn exif_block() -> Vec<u8> {
        let text = Value::Ascii(vec![b"Makers of cameras".to_vec()]);
        let focal = Value::Rational(vec![exif::Rational { num: 35, denom: 1 }]);
        let fields = [(Tag::Make, text), (Tag::FocalLength, focal)].map(|(tag, value)| Field {
            tag,
            ifd_num: In::PRIMARY,
            value,
        });
        let (mut writer, mut block) = (Writer::new(), Cursor::new(Vec::new()));
        fields.iter().for_each(|field| writer.push_field(field));
        writer.write(&mut block, true).unwrap();
        block.into_inner()
    }

    #[test]
    fn big_tiff_has_the_pixels_and_fields_of_tiff() {
        // One strip, whose position is in its entry, and several.
        for (width, height, depth) in [(5, 4, 1), (300, 700, 1), (211, 400, 2)] {
            let samples: Vec<u8> = (0..width * height * 3 * depth).map(|i| (i * i / 7) as u8).collect();
            let mut profile = vec![7; 500];
            profile[16..20].copy_from_slice(b"RGB ");
            let metadata = Metadata { exif: Some(exif_block()), icc: Some(profile.clone()) };
            let encode = |is_big| {
                let layout = TiffLayout { is_big, ..TiffLayout::new(width, height, 3, depth).unwrap() };
                let mut file = Cursor::new(Vec::new());
                let mut writer = TiffWriter::new(&mut file, layout, &metadata, None).unwrap();
                samples.chunks(997).for_each(|part| writer.write(part).unwrap());
                writer.finish().unwrap();
                file.into_inner()
            };
            let files = [encode(false), encode(true)];
            assert_eq!([files[0][2], files[1][2]], [42, 43]);
            let read = files.each_ref().map(|bytes| {
                let mut decoder = Decoder::new(Cursor::new(bytes)).unwrap();
                let pixels = match decoder.read_image().unwrap() {
                    DecodingResult::U8(v) => v.into_iter().map(u16::from).collect(),
                    DecodingResult::U16(v) => v,
                    other => panic!("{other:?}"),
                };
                let icc = decoder.get_tag_u8_vec(TiffTag::Unknown(34675)).unwrap();
                let make = decoder.get_tag_ascii_string(TiffTag::Unknown(271)).unwrap();
                // The EXIF directory is where its entry says.
                let directory = decoder.get_tag(TiffTag::Unknown(34665)).unwrap();
                let at = match directory {
                    ifd::Value::Unsigned(at) => u64::from(at),
                    ifd::Value::Ifd(at) => u64::from(at),
                    ifd::Value::IfdBig(at) | ifd::Value::UnsignedBig(at) => at,
                    other => panic!("{other:?}"),
                };
                assert!(at > 0 && at < bytes.len() as u64);
                (pixels, icc, make)
            });
            let expected: Vec<u16> = if depth == 1 {
                samples.iter().copied().map(u16::from).collect()
            } else {
                samples.as_chunks::<2>().0.iter().map(|b| u16::from_be_bytes(*b)).collect()
            };
            assert!(read[0].0 == expected && read[0] == read[1], "{width}×{height}");
            assert!(read[1].1 == profile && read[1].2 == "Makers of cameras");
            // `decode_image` decodes such files by the same crate: see the test of all formats in `tests/formats/images.rs`.
            assert_eq!(image_format(&files[1]).unwrap(), Format::Tiff);
        }
    }

    #[test]
    fn files_are_big_where_four_gigabytes_may_not_suffice() {
        let is_big = |w, h, channels, depth| TiffLayout::new(w, h, channels, depth).unwrap().is_big;
        assert!(!is_big(40_000, 30_000, 3, 1) && is_big(40_000, 30_000, 3, 2));
        // 2³² bytes are 35,791 columns.
        assert!(!is_big(35_200, 40_000, 3, 1) && is_big(35_791, 40_000, 3, 1));
        assert!(is_big(u32::MAX as usize, u32::MAX as usize, 4, 2));
    }
}
