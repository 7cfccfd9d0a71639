//! NumPy archives, `.npz`: a ZIP of `.npy` files, stored or deflated.

use std::path::Path;

use crate::files::{MAX_FILE_BYTES, read_bytes, write_bytes};
use crate::npy::{self, NpyArray};
use crate::{FormatError, IoError, ReadOptions, memory};
use miniz_oxide::inflate::TINFLStatus;
use miniz_oxide::inflate::core::{DecompressorOxide, decompress, inflate_flags};

const NAME: &str = "npz";
/// Maximum uncompressed size in bytes of all arrays together.
const MAX_UNPACKED: u64 = MAX_FILE_BYTES;
/// Maximum number of arrays.
const MAX_ENTRIES: usize = 10_000;

/// Little-endian fields of a record.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    /// Returns the record of `len` bytes at `at`, or an error where the file is too short.
    fn at(bytes: &'a [u8], at: u64, len: usize) -> Result<Self, FormatError> {
        let start = usize::try_from(at).ok();
        start
            .and_then(|start| bytes.get(start..start.checked_add(len)?))
            .map(Self)
            .ok_or(FormatError::Truncated { format: NAME })
    }

    fn u16(&self, at: usize) -> u16 {
        u16::from_le_bytes([self.0[at], self.0[at + 1]])
    }

    fn u32(&self, at: usize) -> u32 {
        u32::from_le_bytes([self.0[at], self.0[at + 1], self.0[at + 2], self.0[at + 3]])
    }

    fn u64(&self, at: usize) -> u64 {
        u64::from(self.u32(at)) | u64::from(self.u32(at + 4)) << 32
    }
}

/// An entry of the central directory.
struct Entry<'a> {
    name: String,
    method: u16,
    crc: u32,
    packed: u64,
    unpacked: u64,
    offset: u64,
    archive: &'a [u8],
}

/// Decodes all arrays of an archive with their names (without `.npy`), in the order of the file.
///
/// # Errors
/// [`FormatError`]: not an archive, encrypted or compressed by another method than deflate, damaged (by its checksum), larger than
/// [`MAX_FILE_BYTES`] or [`default_max_memory`](crate::default_max_memory) when uncompressed, or as [`npy::decode`].
pub fn decode(bytes: &[u8]) -> Result<Vec<(String, NpyArray)>, FormatError> {
    decode_with(bytes, &ReadOptions::default())
}

/// As [`decode`], with options: the memory limit applies to all arrays and the bytes of the largest together.
///
/// # Errors
/// As [`decode`].
pub fn decode_with(bytes: &[u8], options: &ReadOptions) -> Result<Vec<(String, NpyArray)>, FormatError> {
    let entries = directory(bytes)?;
    let total = entries.iter().fold(0u64, |sum, e| sum.saturating_add(e.unpacked));
    if total > MAX_UNPACKED {
        return Err(FormatError::TooManyBytes { bytes: total, limit: MAX_UNPACKED });
    }
    let largest = entries.iter().map(|e| e.unpacked).max().unwrap_or(0);
    let held = total.saturating_add(bytes.len() as u64);
    memory::check_limit(held.saturating_add(largest), options.max_memory, None)?;
    entries.iter().map(|entry| Ok((entry.array_name().to_owned(), entry.array(options)?))).collect()
}

/// Decodes the array of an archive with exactly one. The count is checked by the directory before anything is decompressed.
///
/// # Errors
/// [`FormatError::ArrayCount`] where there is none or more than one, or as [`decode`].
pub fn decode_single(bytes: &[u8], options: &ReadOptions) -> Result<NpyArray, FormatError> {
    match directory(bytes)?.as_slice() {
        [entry] => entry.array(options),
        entries => Err(FormatError::ArrayCount { format: NAME, got: entries.len(), wanted: 1 }),
    }
}

/// Reads the array of an archive with exactly one; see [`decode_single`].
///
/// # Errors
/// [`IoError`]: cannot be opened, or as [`decode_single`] with default [`ReadOptions`].
pub fn read_single(path: impl AsRef<Path>) -> Result<NpyArray, IoError> {
    let path = path.as_ref();
    decode_single(&read_bytes(path)?, &ReadOptions::default()).map_err(|reason| IoError::reading(path, reason))
}

/// Decodes the only two-dimensional array of an archive; of other arrays only the headers are decompressed.
pub(crate) fn decode_map(bytes: &[u8], options: &ReadOptions) -> Result<NpyArray, FormatError> {
    let entries = directory(bytes)?;
    let mut map: Option<&Entry<'_>> = None;
    for entry in &entries {
        if !matches!(npy::shape_of(&entry.unpack_prefix()?)?[..], [_, _] | [_, _, 1]) {
            continue;
        }
        if let Some(first) = map {
            let names = format!("more than one map in a file ({}, {})", first.array_name(), entry.array_name());
            return Err(FormatError::unsupported(NAME, names));
        }
        map = Some(entry);
    }
    map.ok_or_else(|| FormatError::missing(NAME, "two-dimensional array"))?.array(options)
}

/// Parses the entries of the central directory.
fn directory(bytes: &[u8]) -> Result<Vec<Entry<'_>>, FormatError> {
    if !bytes.starts_with(b"PK") {
        return Err(FormatError::UnknownFormat { expected: "a NumPy archive (.npz)" });
    }
    // The end-of-directory record, which a comment of up to 65535 bytes may follow.
    let earliest = bytes.len().saturating_sub(22 + 65_535);
    let end = bytes[earliest..]
        .windows(4)
        .rposition(|w| w == b"PK\x05\x06")
        .map(|at| (at + earliest) as u64)
        .ok_or(FormatError::Truncated { format: NAME })?;
    let record = Fields::at(bytes, end, 22)?;
    let (mut count, mut offset) = (u64::from(record.u16(10)), u64::from(record.u32(16)));
    if count == 0xffff || offset == 0xffff_ffff {
        // ZIP64: a locator before the record points to one with wider fields.
        let locator = Fields::at(bytes, end.wrapping_sub(20), 20)?;
        let wide = Fields::at(bytes, locator.u64(8), 56)?;
        if locator.0[..4] != *b"PK\x06\x07" || wide.0[..4] != *b"PK\x06\x06" {
            return Err(FormatError::corrupt(NAME, "the ZIP64 directory is not at its offset"));
        }
        (count, offset) = (wide.u64(32), wide.u64(48));
    }
    if count > MAX_ENTRIES as u64 {
        return Err(FormatError::corrupt(NAME, format!("{count} entries")));
    }
    let mut entries = Vec::new();
    for _ in 0..count {
        let header = Fields::at(bytes, offset, 46)?;
        if header.0[..4] != *b"PK\x01\x02" {
            return Err(FormatError::corrupt(NAME, "the directory does not parse"));
        }
        if header.u16(8) & 1 != 0 {
            return Err(FormatError::unsupported(NAME, "encryption"));
        }
        let (name_len, extra_len, comment_len) =
            (usize::from(header.u16(28)), usize::from(header.u16(30)), usize::from(header.u16(32)));
        let tail = Fields::at(bytes, offset + 46, name_len + extra_len)?;
        let mut entry = Entry {
            name: String::from_utf8_lossy(&tail.0[..name_len]).into_owned(),
            method: header.u16(10),
            crc: header.u32(16),
            packed: u64::from(header.u32(20)),
            unpacked: u64::from(header.u32(24)),
            offset: u64::from(header.u32(42)),
            archive: bytes,
        };
        apply_zip64(&mut entry, &tail.0[name_len..])?;
        entries.push(entry);
        offset = offset.saturating_add((46 + name_len + extra_len + comment_len) as u64);
    }
    Ok(entries)
}

/// Replaces fields that exceed 32 bits by those of the ZIP64 extra field.
fn apply_zip64(entry: &mut Entry<'_>, mut extra: &[u8]) -> Result<(), FormatError> {
    while let [a, b, c, d, rest @ ..] = extra {
        let (id, len) = (u16::from_le_bytes([*a, *b]), usize::from(u16::from_le_bytes([*c, *d])));
        let body = rest.get(..len).ok_or(FormatError::Truncated { format: NAME })?;
        if id == 1 {
            let mut wide = body.as_chunks::<8>().0.iter().map(|v| u64::from_le_bytes(*v));
            for field in [&mut entry.unpacked, &mut entry.packed, &mut entry.offset] {
                if *field == 0xffff_ffff {
                    *field = wide.next().ok_or(FormatError::Truncated { format: NAME })?;
                }
            }
        }
        extra = &rest[len..];
    }
    Ok(())
}

/// Bytes decompressed to read the shape: longer than any header that NumPy writes.
const HEADER_PREFIX_BYTES: usize = 4096;

impl Entry<'_> {
    /// Returns the name without `.npy`.
    fn array_name(&self) -> &str {
        self.name.strip_suffix(".npy").unwrap_or(&self.name)
    }

    /// Decodes the array within the memory limit.
    fn array(&self, options: &ReadOptions) -> Result<NpyArray, FormatError> {
        let held = memory::saturating_product(&[2, self.unpacked]).saturating_add(self.archive.len() as u64);
        memory::check_limit(held, options.max_memory, None)?;
        npy::decode_with(&self.unpack()?, options)
    }

    /// Returns the compressed bytes.
    fn packed(&self) -> Result<&[u8], FormatError> {
        let local = Fields::at(self.archive, self.offset, 30)?;
        if local.0[..4] != *b"PK\x03\x04" {
            return Err(FormatError::corrupt(
                NAME,
                format!("{}: there is no file at the offset of the directory", self.name),
            ));
        }
        let start = self.offset + 30 + u64::from(local.u16(26)) + u64::from(local.u16(28));
        let packed = usize::try_from(self.packed).map_err(|_| FormatError::Truncated { format: NAME })?;
        Ok(Fields::at(self.archive, start, packed)?.0)
    }

    /// Decompresses at most the first `limit` bytes.
    fn unpack_up_to(&self, limit: usize) -> Result<Vec<u8>, FormatError> {
        let data = self.packed()?;
        match self.method {
            0 => Ok(data[..limit.min(data.len())].to_vec()),
            8 => {
                // Deflate compresses at most 1032 to 1, which bounds the allocation whatever the directory claims.
                let possible = data.len().saturating_add(1).saturating_mul(1032);
                let mut bytes = vec![0; limit.min(possible)];
                let flags = inflate_flags::TINFL_FLAG_USING_NON_WRAPPING_OUTPUT_BUF;
                let (status, _, length) = decompress(&mut DecompressorOxide::new(), data, &mut bytes, 0, flags);
                if !matches!(status, TINFLStatus::Done | TINFLStatus::HasMoreOutput) {
                    return Err(FormatError::corrupt(
                        NAME,
                        format!("{}: it cannot be decompressed ({status:?})", self.name),
                    ));
                }
                bytes.truncate(length);
                Ok(bytes)
            }
            method => Err(FormatError::unsupported(NAME, format!("compression method {method}"))),
        }
    }

    /// Decompresses the first bytes, without checksum.
    fn unpack_prefix(&self) -> Result<Vec<u8>, FormatError> {
        self.unpack_up_to(HEADER_PREFIX_BYTES)
    }

    /// Decompresses all bytes and verifies the checksum.
    fn unpack(&self) -> Result<Vec<u8>, FormatError> {
        let length = usize::try_from(self.unpacked).unwrap_or(usize::MAX);
        let possible = self.packed.saturating_add(1).saturating_mul(1032);
        if self.method == 8 && self.unpacked > possible {
            return Err(FormatError::corrupt(NAME, format!("{}: the uncompressed size is impossible", self.name)));
        }
        // One more byte than declared detects excess data.
        let bytes = self.unpack_up_to(length.saturating_add(1))?;
        if bytes.len() as u64 != self.unpacked || crc32fast::hash(&bytes) != self.crc {
            return Err(FormatError::corrupt(NAME, format!("{}: the checksum does not agree", self.name)));
        }
        Ok(bytes)
    }
}

/// Encodes named arrays (names without `.npy`), deflated where `compress`.
///
/// # Errors
/// [`FormatError::NotRepresentable`] beyond 65534 arrays or 4 GiB, or as [`npy::encode`].
pub fn encode(arrays: &[(&str, &NpyArray)], compress: bool) -> Result<Vec<u8>, FormatError> {
    let too_large =
        || FormatError::NotRepresentable { format: NAME, what: "more than 4 GiB or 65534 arrays".to_owned() };
    let mut out = Vec::new();
    let mut directory = Vec::new();
    for (name, array) in arrays {
        let name = format!("{name}.npy");
        let plain = npy::encode(array)?;
        let crc = crc32fast::hash(&plain);
        let unpacked = u32::try_from(plain.len()).map_err(|_| too_large())?;
        let (method, data) =
            if compress { (8u16, miniz_oxide::deflate::compress_to_vec(&plain, 6)) } else { (0, plain) };
        let packed = u32::try_from(data.len()).map_err(|_| too_large())?;
        let offset = u32::try_from(out.len()).ok().filter(|v| *v < u32::MAX).ok_or_else(too_large)?;
        let name_len = u16::try_from(name.len()).map_err(|_| too_large())?;
        // Version 2.0; bit 11: the name is UTF-8; no time (1980-01-01), so that equal arrays give equal files.
        let mut common = Vec::with_capacity(26);
        for v in [20u16, 1 << 11, method, 0, 0x21] {
            common.extend(v.to_le_bytes());
        }
        for v in [crc, packed, unpacked] {
            common.extend(v.to_le_bytes());
        }
        common.extend(name_len.to_le_bytes());
        common.extend([0, 0]);
        out.extend(b"PK\x03\x04");
        out.extend(&common);
        out.extend(name.as_bytes());
        out.extend(&data);
        directory.extend(b"PK\x01\x02\x14\x00");
        directory.extend(&common);
        directory.extend([0; 10]);
        directory.extend(offset.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let count = u16::try_from(arrays.len()).ok().filter(|n| *n < u16::MAX).ok_or_else(too_large)?;
    let start = u32::try_from(out.len()).ok().filter(|v| *v < u32::MAX).ok_or_else(too_large)?;
    let size = u32::try_from(directory.len()).map_err(|_| too_large())?;
    out.extend(&directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    out.extend(count.to_le_bytes());
    out.extend(count.to_le_bytes());
    out.extend(size.to_le_bytes());
    out.extend(start.to_le_bytes());
    out.extend([0, 0]);
    Ok(out)
}

/// Reads an `.npz` file.
///
/// # Errors
/// [`IoError`]: cannot be opened, or as [`decode`].
pub fn read(path: impl AsRef<Path>) -> Result<Vec<(String, NpyArray)>, IoError> {
    let path = path.as_ref();
    decode(&read_bytes(path)?).map_err(|reason| IoError::reading(path, reason))
}

/// Writes an `.npz` file.
///
/// # Errors
/// As [`encode`] and [`crate::write_atomic`].
pub fn write(path: impl AsRef<Path>, arrays: &[(&str, &NpyArray)], compress: bool) -> Result<(), IoError> {
    let path = path.as_ref();
    write_bytes(path, &encode(arrays, compress).map_err(|reason| IoError::writing(path, reason))?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::npy::NpyData;

    #[test]
    fn the_number_of_arrays_is_checked_before_decompression() {
        let large = NpyArray { shape: vec![1 << 16], data: NpyData::U8(vec![0; 1 << 16]) };
        let names: Vec<String> = (0..60).map(|i| format!("a{i}")).collect();
        let arrays: Vec<_> = names.iter().map(|name| (name.as_str(), &large)).collect();
        let bytes = encode(&arrays, true).unwrap();
        // Too little for one of them.
        let little = ReadOptions { max_memory: 1 << 16, ..ReadOptions::default() };
        let error = decode_single(&bytes, &little).unwrap_err();
        assert!(matches!(error, FormatError::ArrayCount { got: 60, wanted: 1, .. }), "{error}");
        let error = decode_with(&bytes, &ReadOptions { max_memory: 32 << 16, ..little }).unwrap_err();
        assert!(matches!(error, FormatError::TooMuchMemory { needed, .. } if needed > 61 << 16), "{error}");
        let one = encode(&arrays[..1], true).unwrap();
        assert!(matches!(decode_single(&one, &little), Err(FormatError::TooMuchMemory { .. })));
        assert_eq!(decode_single(&one, &ReadOptions { max_memory: 3 << 16, ..little }).unwrap(), large);
        // A map among other arrays is found by the headers.
        let map = NpyArray { shape: vec![2, 2], data: NpyData::F32(vec![1.0; 4]) };
        let mixed: Vec<_> = arrays.iter().copied().chain([("map", &map)]).collect();
        for compress in [false, true] {
            let bytes = encode(&mixed, compress).unwrap();
            assert_eq!(decode_map(&bytes, &ReadOptions { max_memory: 62 << 16, ..little }).unwrap(), map);
        }
    }
}
