//! Image metadata (EXIF and color profile) that derived images inherit.

use exif::experimental::Writer;
use exif::{Context, Exif, Field, In, Tag, Value};
use std::collections::BTreeSet;
use std::io::Cursor;

/// EXIF block and color profile of an image file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Metadata {
    /// The EXIF block (a TIFF structure).
    pub exif: Option<Vec<u8>>,
    /// The ICC color profile.
    pub icc: Option<Vec<u8>>,
}

/// Tags that derived images do not inherit: size, orientation, the 35 mm equivalent focal length, and maker notes, whose offsets break when
/// moved.
const DROPPED_TAGS: [Tag; 7] = [
    Tag::Orientation,
    Tag::ImageWidth,
    Tag::ImageLength,
    Tag::PixelXDimension,
    Tag::PixelYDimension,
    Tag::FocalLengthIn35mmFilm,
    Tag::MakerNote,
];

impl Metadata {
    /// Encodes the EXIF block for a derived image of `width` × `height` px, without the thumbnail and [`DROPPED_TAGS`]. `None` without a readable
    /// block.
    pub(crate) fn exif_for(&self, width: u32, height: u32) -> Option<Vec<u8>> {
        let exif = self.parsed()?;
        encode_block(&retained_fields(exif.fields(), width, height), exif.little_endian())
    }

    /// As [`Self::exif_for`], as the fields of a TIFF file, without those that describe the storage of pixels.
    pub(crate) fn tiff_fields(&self, width: u32, height: u32) -> Vec<Field> {
        let Some(exif) = self.parsed() else { return Vec::new() };
        retained_fields(exif.fields().filter(|field| is_descriptive(field.tag)), width, height)
    }

    fn parsed(&self) -> Option<Exif> {
        let mut reader = exif::Reader::new();
        reader.continue_on_error(true);
        match reader.read_raw(self.exif.clone()?) {
            Ok(exif) => Some(exif),
            Err(error) => error.distill_partial_result(|_| ()).ok(),
        }
    }

    /// Returns the color profile where it applies to an image with this number of channels (gray or RGB).
    pub(crate) fn icc_for(&self, channels: usize) -> Option<&[u8]> {
        let colors: &[u8] = if channels < 3 { b"GRAY" } else { b"RGB " };
        self.icc.as_deref().filter(|profile| profile.get(16..20) == Some(colors))
    }
}

/// Selects the fields that a derived image of `width` × `height` px inherits, and adds its size.
fn retained_fields<'a>(fields: impl Iterator<Item = &'a Field>, width: u32, height: u32) -> Vec<Field> {
    let mut seen = BTreeSet::new();
    let is_retained = |field: &&Field| {
        field.ifd_num == In::PRIMARY
            && !DROPPED_TAGS.contains(&field.tag)
            && !matches!(field.value, Value::Unknown(..))
            && seen.insert(field.tag)
    };
    let size = [(Tag::PixelXDimension, width), (Tag::PixelYDimension, height)];
    let size = size.map(|(tag, side)| Field { tag, ifd_num: In::PRIMARY, value: Value::Long(vec![side]) });
    fields.filter(is_retained).cloned().chain(size).collect()
}

fn encode_block(fields: &[Field], little_endian: bool) -> Option<Vec<u8>> {
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut block = Cursor::new(Vec::new());
    writer.write(&mut block, little_endian).ok()?;
    Some(block.into_inner())
}

/// Extracts the EXIF block of a TIFF file, which shares its field list. `None` where there is none, or it is damaged.
#[cfg(feature = "tiff")]
pub(crate) fn exif_of_tiff(bytes: &[u8]) -> Option<Vec<u8>> {
    let (fields, little_endian) = exif::parse_exif(bytes).ok()?;
    let readable = |field: &Field| field.ifd_num == In::PRIMARY && !matches!(field.value, Value::Unknown(..));
    let mut known = BTreeSet::new();
    let exif_fields: Vec<Field> =
        fields.into_iter().filter(|f| readable(f) && is_descriptive(f.tag) && known.insert(f.tag)).collect();
    if exif_fields.is_empty() { None } else { encode_block(&exif_fields, little_endian) }
}

/// Whether a field describes the photograph, not its storage in a TIFF file.
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
