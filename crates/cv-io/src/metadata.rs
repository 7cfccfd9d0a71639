//! What a picture's file says beside its pixels, for pictures that are made of it.

use exif::experimental::Writer;
use exif::{Exif, Field, In, Tag, Value};
use std::collections::BTreeSet;
use std::io::Cursor;

/// The EXIF block and the color profile of a picture's file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Metadata {
    /// The EXIF block (a TIFF structure).
    pub exif: Option<Vec<u8>>,
    /// The ICC color profile.
    pub icc: Option<Vec<u8>>,
}

/// What holds for the photograph as it was taken only: its size and turn, the focal length as a multiple of its size, and the
/// maker's notes, which break when they are moved.
const LEFT_OUT: [Tag; 7] = [
    Tag::Orientation,
    Tag::ImageWidth,
    Tag::ImageLength,
    Tag::PixelXDimension,
    Tag::PixelYDimension,
    Tag::FocalLengthIn35mmFilm,
    Tag::MakerNote,
];

impl Metadata {
    /// The EXIF block for a picture of `width` × `height` px made of this one: without the thumbnail and what no longer holds. `None` where there is
    /// none that can be read.
    pub(crate) fn exif_for(&self, width: u32, height: u32) -> Option<Vec<u8>> {
        let mut reader = exif::Reader::new();
        reader.continue_on_error(true);
        let exif: Exif = match reader.read_raw(self.exif.clone()?) {
            Ok(exif) => exif,
            Err(error) => error.distill_partial_result(|_| ()).ok()?,
        };
        let size = [(Tag::PixelXDimension, width), (Tag::PixelYDimension, height)].map(|(tag, side)| Field {
            tag,
            ifd_num: In::PRIMARY,
            value: Value::Long(vec![side]),
        });
        let mut known = BTreeSet::new();
        let kept = exif.fields().filter(|field| {
            field.ifd_num == In::PRIMARY
                && !LEFT_OUT.contains(&field.tag)
                && !matches!(field.value, Value::Unknown(..))
                && known.insert(field.tag)
        });
        let mut writer = Writer::new();
        kept.chain(&size).for_each(|field| writer.push_field(field));
        let mut block = Cursor::new(Vec::new());
        writer.write(&mut block, exif.little_endian()).ok()?;
        Some(block.into_inner())
    }

    /// The color profile for a picture of so many channels: that of another kind of color is none for it.
    pub(crate) fn icc_for(&self, channels: usize) -> Option<&[u8]> {
        let colors: &[u8] = if channels < 3 { b"GRAY" } else { b"RGB " };
        self.icc.as_deref().filter(|profile| profile.get(16..20) == Some(colors))
    }
}
