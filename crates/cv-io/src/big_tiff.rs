//! BigTIFF headers: TIFF with 64-bit offsets (Aldus and AWare Systems, "BigTIFF Design").

/// Tags of the positions and byte counts of the strips.
const STRIP_OFFSETS: u16 = 273;
const STRIP_BYTE_COUNTS: u16 = 279;
/// Tags whose value is the position of a directory: EXIF, GPS and interoperability.
const DIRECTORIES: [u16; 3] = [34665, 34853, 40965];
/// Types of 64-bit integers, and of 64-bit positions of directories.
const LONG8: u16 = 16;
const IFD8: u16 = 18;
/// Bytes of the header before the first directory.
const HEADER_BYTES: usize = 16;
const ENTRY_BYTES: usize = 20;

/// The header and directories of a BigTIFF file.
pub(crate) struct BigTiffHead {
    pub(crate) bytes: Vec<u8>,
    /// Position of the array of 64-bit strip positions, in `bytes`.
    pub(crate) offsets: usize,
    /// Position of the array of 32-bit strip sizes.
    pub(crate) byte_counts: usize,
}

/// An entry of a directory.
struct Entry {
    tag: u16,
    kind: u16,
    count: usize,
    value: Content,
}

enum Content {
    Bytes(Vec<u8>),
    Directory(Vec<Entry>),
}

/// Converts the header and the first directory of a little-endian TIFF, with its EXIF and GPS directories, to BigTIFF with strip positions of zero. `None` where
/// the bytes are not such a header.
pub(crate) fn to_big_tiff(head: &[u8]) -> Option<BigTiffHead> {
    let entries = read_directory(head, u32_at(head, 4)?, 0)?;
    let mut bytes = vec![0; HEADER_BYTES];
    bytes[..8].copy_from_slice(&[b'I', b'I', 43, 0, 8, 0, 0, 0]);
    bytes[8..].copy_from_slice(&(HEADER_BYTES as u64).to_le_bytes());
    let mut places = [None; 2];
    write_directory(&mut bytes, &entries, &mut places);
    let [offsets, byte_counts] = places;
    Some(BigTiffHead { bytes, offsets: offsets?, byte_counts: byte_counts? })
}

pub(crate) fn u16_at(bytes: &[u8], at: usize) -> Option<usize> {
    Some(u16::from_le_bytes(*bytes.get(at..at + 2)?.first_chunk()?).into())
}

pub(crate) fn u32_at(bytes: &[u8], at: usize) -> Option<usize> {
    Some(u32::from_le_bytes(*bytes.get(at..at + 4)?.first_chunk()?) as usize)
}

/// Reads the directory at `at` of a classic TIFF, and the directories it refers to, to a depth of 2.
fn read_directory(head: &[u8], at: usize, depth: usize) -> Option<Vec<Entry>> {
    let entry = |i: usize| {
        let at = at + 2 + 12 * i;
        let (tag, kind, count) = (u16_at(head, at)? as u16, u16_at(head, at + 2)? as u16, u32_at(head, at + 4)?);
        if DIRECTORIES.contains(&tag) && depth < 2 {
            let value = Content::Directory(read_directory(head, u32_at(head, at + 8)?, depth + 1)?);
            return Some(Entry { tag, kind: IFD8, count: 1, value });
        }
        let size = match kind {
            1 | 2 | 6 | 7 => 1,
            3 | 8 => 2,
            4 | 9 | 11 | 13 => 4,
            5 | 10 | 12 => 8,
            _ => return None,
        };
        if tag == STRIP_OFFSETS {
            return Some(Entry { tag, kind: LONG8, count, value: Content::Bytes(vec![0; 8 * count]) });
        }
        let length = size * count;
        let start = if length <= 4 { at + 8 } else { u32_at(head, at + 8)? };
        Some(Entry { tag, kind, count, value: Content::Bytes(head.get(start..start.checked_add(length)?)?.to_vec()) })
    };
    (0..u16_at(head, at)?).map(entry).collect()
}

/// Appends a directory and its values, and returns its position. `places` receives the positions of the arrays of strip positions and sizes.
fn write_directory(bytes: &mut Vec<u8>, entries: &[Entry], places: &mut [Option<usize>; 2]) -> usize {
    let at = bytes.len();
    bytes.extend_from_slice(&(entries.len() as u64).to_le_bytes());
    // The last eight: there is no next directory.
    bytes.resize(at + 8 + ENTRY_BYTES * entries.len() + 8, 0);
    for (i, entry) in entries.iter().enumerate() {
        let place = at + 8 + ENTRY_BYTES * i;
        bytes[place..place + 2].copy_from_slice(&entry.tag.to_le_bytes());
        bytes[place + 2..place + 4].copy_from_slice(&entry.kind.to_le_bytes());
        bytes[place + 4..place + 12].copy_from_slice(&(entry.count as u64).to_le_bytes());
        let position = match &entry.value {
            // Values of up to eight bytes are in the entry itself.
            Content::Bytes(value) if value.len() <= 8 => {
                bytes[place + 12..place + 12 + value.len()].copy_from_slice(value);
                place + 12
            }
            value => {
                bytes.resize(bytes.len().next_multiple_of(8), 0);
                let start = match value {
                    Content::Bytes(value) => {
                        let start = bytes.len();
                        bytes.extend_from_slice(value);
                        start
                    }
                    Content::Directory(entries) => write_directory(bytes, entries, places),
                };
                bytes[place + 12..place + 20].copy_from_slice(&(start as u64).to_le_bytes());
                start
            }
        };
        match entry.tag {
            STRIP_OFFSETS => places[0] = Some(position),
            STRIP_BYTE_COUNTS => places[1] = Some(position),
            _ => {}
        }
    }
    bytes.resize(bytes.len().next_multiple_of(8), 0);
    at
}
