//! OpenEXR, through the `exr` crate: the first layer with red, green and blue.

use super::{Format, Header, Raster, Samples, sample_count};
use crate::FormatError;
use exr::block::reader::Reader;
use exr::error::Error;
use exr::prelude::{ReadChannels, ReadLayers, Text, Vec2, read};
use std::io::Cursor;

const NAME: &str = "OpenEXR";

pub(super) fn header(bytes: &[u8]) -> Result<Header, FormatError> {
    let reader = open(bytes)?;
    let (width, height) = window(&reader)?.1;
    // A block compressed, uncompressed, and as samples.
    let block = reader.headers().iter().map(|layer| layer.max_block_byte_size() as u64).max().unwrap_or(0);
    Ok(Header { width, height, channels: 3, depth: 4, working_memory: block.saturating_mul(3), ..Header::default() })
}

pub(super) fn raster(bytes: &[u8], header: &Header) -> Result<Raster, FormatError> {
    let reader = open(bytes)?;
    let (corner, (width, height)) = window(&reader)?;
    let size = sample_count(Format::OpenExr, header.width, header.height, 3)?;
    // The data window may differ from the display window.
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .rgb_channels(
            move |_, _| vec![0f32; size],
            move |samples: &mut Vec<f32>, at: Vec2<usize>, (r, g, b): (f32, f32, f32)| {
                let place = |at: usize, corner: i32, side: usize| {
                    usize::try_from(at as i64 + i64::from(corner)).ok().filter(|at| *at < side)
                };
                if let (Some(x), Some(y)) = (place(at.0, corner.0, width), place(at.1, corner.1, height)) {
                    samples[3 * (y * width + x)..][..3].copy_from_slice(&[r, g, b]);
                }
            },
        )
        .first_valid_layer()
        .all_attributes()
        .from_chunks(reader)
        .map_err(fail)?;
    Ok(Raster { channels: 3, samples: Samples::F32(image.layer_data.channel_data.pixels) })
}

fn open(bytes: &[u8]) -> Result<Reader<Cursor<&[u8]>>, FormatError> {
    exr::block::read(Cursor::new(bytes), false).map_err(fail)
}

/// Returns the offset of the data window in the display window, and the display window's width and height.
fn window(reader: &Reader<Cursor<&[u8]>>) -> Result<(Vec2<i32>, (usize, usize)), FormatError> {
    let colors = ["R", "G", "B"].map(Text::from);
    let layer = reader
        .headers()
        .iter()
        .find(|layer| !layer.deep && colors.iter().all(|color| layer.channels.find_index_of_channel(color).is_some()))
        .ok_or_else(|| FormatError::unsupported_picture(NAME, "a file without red, green and blue"))?;
    let window = layer.shared_attributes.display_window;
    Ok((layer.own_attributes.layer_position - window.position, (window.size.width(), window.size.height())))
}

fn fail(error: Error) -> FormatError {
    match error {
        Error::NotSupported(what) => FormatError::unsupported_picture(NAME, format!("“{what}”")),
        Error::Io(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => FormatError::Truncated { format: NAME },
        error => FormatError::corrupt(NAME, error.to_string()),
    }
}
