//! JPEG, through zune-jpeg.

use super::{Format, Header, Raster, Samples};
use crate::FormatError;
use zune_jpeg::JpegDecoder;
use zune_jpeg::errors::DecodeErrors;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

pub(super) fn header(bytes: &[u8]) -> Result<Header, FormatError> {
    let decoder = decoder(bytes, DecoderOptions::default())?;
    let size = decoder.dimensions();
    let (width, height) = size.ok_or_else(|| FormatError::corrupt(Format::Jpeg.name(), "it has no size"))?;
    Ok(Header { width, height, exif: decoder.exif().cloned(), orientation: None })
}

pub(super) fn raster(bytes: &[u8]) -> Result<Raster, FormatError> {
    // Inks become lights; gray stays gray.
    let (colors, channels) = match decoder(bytes, DecoderOptions::default())?.input_colorspace() {
        Some(ColorSpace::Luma) => (ColorSpace::Luma, 1),
        _ => (ColorSpace::RGB, 3),
    };
    let mut decoder = decoder(bytes, DecoderOptions::default().jpeg_set_out_colorspace(colors))?;
    Ok(Raster { channels, samples: Samples::U8(decoder.decode().map_err(fail)?) })
}

/// A decoder that has read the headers.
fn decoder(bytes: &[u8], options: DecoderOptions) -> Result<JpegDecoder<ZCursor<&[u8]>>, FormatError> {
    // Cameras break small rules.
    let options = options.set_strict_mode(false).set_max_width(usize::MAX).set_max_height(usize::MAX);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(fail)?;
    Ok(decoder)
}

fn fail(error: DecodeErrors) -> FormatError {
    match error {
        DecodeErrors::Unsupported(what) => FormatError::unsupported_picture(Format::Jpeg.name(), format!("“{what:?}”")),
        error => FormatError::corrupt(Format::Jpeg.name(), error.to_string()),
    }
}
