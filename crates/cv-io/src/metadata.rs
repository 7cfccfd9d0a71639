//! What a picture's file says beside its pixels, for pictures that are made of it.

use exif::experimental::Writer;
use exif::{Context, Exif, Field, In, Tag, Value};
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
        let exif = self.parsed()?;
        block(&kept(exif.fields(), width, height), exif.little_endian())
    }

    /// The same as the fields of a TIFF file: without those that say how another file stores its pixels.
    pub(crate) fn tiff_fields(&self, width: u32, height: u32) -> Vec<Field> {
        let Some(exif) = self.parsed() else { return Vec::new() };
        kept(exif.fields().filter(|field| is_descriptive(field.tag)), width, height)
    }

    fn parsed(&self) -> Option<Exif> {
        let mut reader = exif::Reader::new();
        reader.continue_on_error(true);
        match reader.read_raw(self.exif.clone()?) {
            Ok(exif) => Some(exif),
            Err(error) => error.distill_partial_result(|_| ()).ok(),
        }
    }

    /// The color profile for a picture of so many channels: that of another kind of color is none for it.
    pub(crate) fn icc_for(&self, channels: usize) -> Option<&[u8]> {
        let colors: &[u8] = if channels < 3 { b"GRAY" } else { b"RGB " };
        self.icc.as_deref().filter(|profile| profile.get(16..20) == Some(colors))
    }
}

/// The fields that hold for a picture of `width` × `height` px made of the one they are of.
fn kept<'a>(fields: impl Iterator<Item = &'a Field>, width: u32, height: u32) -> Vec<Field> {
    let mut known = BTreeSet::new();
    let holds = |field: &&Field| {
        field.ifd_num == In::PRIMARY
            && !LEFT_OUT.contains(&field.tag)
            && !matches!(field.value, Value::Unknown(..))
            && known.insert(field.tag)
    };
    let size = [(Tag::PixelXDimension, width), (Tag::PixelYDimension, height)];
    let size = size.map(|(tag, side)| Field { tag, ifd_num: In::PRIMARY, value: Value::Long(vec![side]) });
    fields.filter(holds).cloned().chain(size).collect()
}

fn block(fields: &[Field], little_endian: bool) -> Option<Vec<u8>> {
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut block = Cursor::new(Vec::new());
    writer.write(&mut block, little_endian).ok()?;
    Some(block.into_inner())
}

/// The EXIF block of a TIFF file, whose own fields it shares a list with. `None` where there is none, or it is damaged.
#[cfg(feature = "tiff")]
pub(crate) fn exif_of_tiff(bytes: &[u8]) -> Option<Vec<u8>> {
    let (fields, little_endian) = exif::parse_exif(bytes).ok()?;
    let readable = |field: &Field| field.ifd_num == In::PRIMARY && !matches!(field.value, Value::Unknown(..));
    let mut known = BTreeSet::new();
    let own: Vec<Field> =
        fields.into_iter().filter(|f| readable(f) && is_descriptive(f.tag) && known.insert(f.tag)).collect();
    if own.is_empty() { None } else { block(&own, little_endian) }
}

/// Whether a field describes the photograph, not how a TIFF file stores it.
fn is_descriptive(tag: Tag) -> bool {
    const DESCRIPTIVE: [Tag; 10] = [
        Tag::ImageDescription,
        Tag::Make,
        Tag::Model,
        Tag::XResolution,
        Tag::YResolution,
        Tag::ResolutionUnit,
        Tag::Software,
        Tag::DateTime,
        Tag::Artist,
        Tag::Copyright,
    ];
    tag.context() != Context::Tiff || DESCRIPTIVE.contains(&tag)
}
