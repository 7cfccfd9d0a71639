//! Radiance RGBE (G. Ward, "Real pixels", Graphics Gems II, 1991), uncompressed and with both run-length encodings.

use super::{Format, Header, Raster, Samples, sample_count};
use crate::FormatError;

const NAME: &str = "Radiance HDR";

pub(super) fn header(bytes: &[u8]) -> Result<Header, FormatError> {
    parse_header(bytes).map(|(header, _)| header)
}

pub(super) fn raster(bytes: &[u8], header: &Header) -> Result<Raster, FormatError> {
    let (_, at) = parse_header(bytes)?;
    let mut rest = &bytes[at..];
    let mut samples = Vec::with_capacity(sample_count(Format::Hdr, header.width, header.height, 3)?);
    // Mantissas are in units of 1/256, the exponent has a bias of 128.
    let scales: [f32; 256] =
        std::array::from_fn(|exponent| if exponent == 0 { 0.0 } else { (exponent as f32 - 136.0).exp2() });
    let mut row = vec![[0u8; 4]; header.width];
    for _ in 0..header.height {
        rest = match rest {
            // The newer encoding, by channel, whose marker contains the width.
            [2, 2, high, low, after @ ..]
                if usize::from(*high) << 8 | usize::from(*low) == header.width && *high < 128 =>
            {
                decode_channel_runs(after, &mut row)?
            }
            _ => decode_pixel_runs(rest, &mut row)?,
        };
        samples.extend(row.iter().flat_map(|&[r, g, b, exponent]| {
            let scale = scales[usize::from(exponent)];
            [r, g, b].map(|mantissa| f32::from(mantissa) * scale)
        }));
    }
    Ok(Raster { channels: 3, samples: Samples::F32(samples) })
}

/// Decodes a row of the newer run-length encoding: runs and literals, channel by channel.
fn decode_channel_runs<'a>(mut rest: &'a [u8], row: &mut [[u8; 4]]) -> Result<&'a [u8], FormatError> {
    for channel in 0..4 {
        let mut x = 0;
        while x < row.len() {
            let (length, value);
            (length, value, rest) = match rest {
                [run @ 129..=255, value, after @ ..] => (usize::from(run - 128), Some(*value), after),
                [literals @ 1..=128, after @ ..] if after.len() >= usize::from(*literals) => {
                    (usize::from(*literals), None, after)
                }
                [0, ..] => return Err(FormatError::corrupt(NAME, "a run of no pixels")),
                _ => return Err(FormatError::Truncated { format: NAME }),
            };
            let Some(part) = row.get_mut(x..x + length) else {
                return Err(FormatError::corrupt(NAME, "a run beyond the end of its row"));
            };
            match value {
                Some(value) => part.iter_mut().for_each(|pixel| pixel[channel] = value),
                None => {
                    part.iter_mut().zip(rest).for_each(|(pixel, value)| pixel[channel] = *value);
                    rest = &rest[length..];
                }
            }
            x += length;
        }
    }
    Ok(rest)
}

/// Decodes a row of the older run-length encoding: whole pixels; 1, 1, 1, n repeats the preceding pixel n times, consecutive counts are digits of
/// base 256.
fn decode_pixel_runs<'a>(mut rest: &'a [u8], row: &mut [[u8; 4]]) -> Result<&'a [u8], FormatError> {
    let (mut x, mut shift) = (0, 0);
    while x < row.len() {
        let &[r, g, b, e, ref after @ ..] = rest else { return Err(FormatError::Truncated { format: NAME }) };
        rest = after;
        if [r, g, b] != [1; 3] {
            row[x] = [r, g, b, e];
            (x, shift) = (x + 1, 0);
            continue;
        }
        let end = x.saturating_add(usize::from(e).checked_shl(shift).unwrap_or(usize::MAX));
        if x == 0 || end > row.len() || shift > 24 {
            return Err(FormatError::corrupt(NAME, "a run beyond its row"));
        }
        let before = row[x - 1];
        row[x..end].fill(before);
        (x, shift) = (end, shift + 8);
    }
    Ok(rest)
}

/// Parses the header, and returns the offset of the pixel data.
fn parse_header(bytes: &[u8]) -> Result<(Header, usize), FormatError> {
    let mut at = 0;
    let mut line = || {
        let length = bytes[at..].iter().position(|&b| b == b'\n').ok_or(FormatError::Truncated { format: NAME })?;
        let line = &bytes[at..at + length];
        at += length + 1;
        Ok::<_, FormatError>(String::from_utf8_lossy(line).trim_end().to_owned())
    };
    loop {
        let line = line()?;
        if let Some(format) = line.strip_prefix("FORMAT=")
            && format != "32-bit_rle_rgbe"
        {
            return Err(FormatError::unsupported_picture(NAME, format!("the format {format}")));
        }
        if line.is_empty() {
            break;
        }
    }
    let size = line()?;
    match size.split_whitespace().collect::<Vec<_>>()[..] {
        ["-Y", height, "+X", width] => {
            let side =
                |text: &str| text.parse::<u32>().map_err(|_| FormatError::corrupt(NAME, "the size is no number"));
            let (width, height) = (side(width)? as usize, side(height)? as usize);
            Ok((
                Header { width, height, channels: 3, depth: 4, working_memory: 4 * width as u64, ..Header::default() },
                at,
            ))
        }
        _ => Err(FormatError::unsupported_picture(NAME, format!("the order of pixels “{size}”"))),
    }
}
