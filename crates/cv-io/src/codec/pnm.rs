//! Netpbm's PBM, PGM and PPM in text and binary: P1 to P6.

use super::{Format, Header, Raster, Samples, sample_count};
use crate::FormatError;

const NAME: &str = "PNM";

/// The file header.
struct FileHeader {
    kind: u8,
    width: usize,
    height: usize,
    /// The maximum sample, white.
    white: u32,
    /// Offset of the samples.
    at: usize,
}

impl FileHeader {
    fn channels(&self) -> usize {
        if matches!(self.kind, b'3' | b'6') { 3 } else { 1 }
    }

    /// Scales a sample from 0 to white to 0 to `full`.
    fn scale_to(&self, v: u32, full: u32) -> u32 {
        (v.min(self.white) * full + self.white / 2) / self.white
    }
}

pub(super) fn header(bytes: &[u8]) -> Result<Header, FormatError> {
    let start = parse_header(bytes)?;
    let depth = if start.white < 256 { 1 } else { 2 };
    Ok(Header { width: start.width, height: start.height, channels: start.channels(), depth, ..Header::default() })
}

pub(super) fn raster(bytes: &[u8]) -> Result<Raster, FormatError> {
    let start = parse_header(bytes)?;
    let channels = start.channels();
    let n = sample_count(Format::Pnm, start.width, start.height, channels)?;
    let samples = if start.white < 256 {
        Samples::U8(samples(bytes, &start, n, |v| start.scale_to(v, 255) as u8)?)
    } else {
        Samples::U16(samples(bytes, &start, n, |v| start.scale_to(v, 65535) as u16)?)
    };
    Ok(Raster { channels, samples })
}

/// Decodes `n` samples, scaled to the full range of the type.
fn samples<T>(bytes: &[u8], start: &FileHeader, n: usize, store: impl Fn(u32) -> T) -> Result<Vec<T>, FormatError> {
    let stored = &bytes[start.at..];
    let samples: Vec<T> = match start.kind {
        // A digit per pixel, with or without white space.
        b'1' => {
            let bits = stored.iter().filter(|b| !b.is_ascii_whitespace()).take(n);
            let bit =
                |&b: &u8| if b == b'0' || b == b'1' { Ok(store(u32::from(b == b'0'))) } else { Err(invalid("a bit")) };
            bits.map(bit).collect::<Result<_, _>>()?
        }
        b'2' | b'3' => {
            let mut at = start.at;
            let left = bytes.len() - at;
            // A sample takes at least a digit and a space.
            (0..n.min(left)).map(|_| number(bytes, &mut at).map(&store)).collect::<Result<_, _>>()?
        }
        b'4' => {
            let row = start.width.div_ceil(8);
            let rows = stored.chunks_exact(row).take(start.height);
            let bit = |row: &[u8], x: usize| store(u32::from(row[x / 8] >> (7 - x % 8) & 1 == 0));
            rows.flat_map(|row| (0..start.width).map(move |x| (row, x))).map(|(row, x)| bit(row, x)).collect()
        }
        _ if start.white < 256 => stored.iter().take(n).map(|&b| store(u32::from(b))).collect(),
        _ => stored.chunks_exact(2).take(n).map(|b| store(u32::from(u16::from_be_bytes([b[0], b[1]])))).collect(),
    };
    if samples.len() < n { Err(FormatError::Truncated { format: NAME }) } else { Ok(samples) }
}

fn parse_header(bytes: &[u8]) -> Result<FileHeader, FormatError> {
    let kind = bytes.get(1).copied().unwrap_or(0);
    let mut at = 2;
    let width = number(bytes, &mut at)? as usize;
    let height = number(bytes, &mut at)? as usize;
    let white = if matches!(kind, b'1' | b'4') { 1 } else { number(bytes, &mut at)? };
    if !(1..65536).contains(&white) {
        return Err(invalid("the maximum sample value"));
    }
    // One white space ends the header.
    if !bytes.get(at).is_some_and(u8::is_ascii_whitespace) {
        return Err(FormatError::Truncated { format: NAME });
    }
    Ok(FileHeader { kind, width, height, white, at: at + 1 })
}

/// Parses the next number after white space and comments.
fn number(bytes: &[u8], at: &mut usize) -> Result<u32, FormatError> {
    loop {
        match bytes.get(*at) {
            Some(b'#') => *at += bytes[*at..].iter().take_while(|&&b| b != b'\n').count(),
            Some(b) if b.is_ascii_whitespace() => *at += 1,
            Some(b) if b.is_ascii_digit() => break,
            Some(_) => return Err(invalid("a number")),
            None => return Err(FormatError::Truncated { format: NAME }),
        }
    }
    let digits = bytes[*at..].iter().take_while(|b| b.is_ascii_digit()).count();
    let text = std::str::from_utf8(&bytes[*at..*at + digits]).unwrap_or_default();
    *at += digits;
    text.parse().map_err(|_| invalid("a number"))
}

fn invalid(what: &str) -> FormatError {
    FormatError::corrupt(NAME, format!("{what} is invalid"))
}
