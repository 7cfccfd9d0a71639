//! Small image files of every format, made without the decoders.

use std::io::Cursor;

use cv_core::RgbU8;
use cv_io::{DynImage, ReadOptions, decode_image, encode_jpeg, encode_png};
use exif::experimental::Writer;
use exif::{Field, Tag, Value};

/// A test image that no flip or rotation leaves unchanged.
pub(crate) fn ramp(width: usize, height: usize) -> RgbU8 {
    RgbU8::from_fn(width, height, |x, y| [(x * 20) as u8, (y * 30) as u8, (x * 7 + y * 11) as u8])
}

pub(crate) fn decoded(bytes: &[u8]) -> DynImage {
    decode_image(bytes, &ReadOptions::default()).unwrap()
}

/// A 24-bit BMP, bottom row first (BITMAPINFOHEADER).
pub(crate) fn bmp(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let mut bytes = bmp_header(w, h, 24, 0, 54);
    for y in (0..h).rev() {
        (0..w).for_each(|x| bytes.extend(image.at(x, y).iter().rev()));
        bytes.resize(54 + (h - y) * (3 * w).next_multiple_of(4), 0);
    }
    bytes
}

/// The two headers of a BMP whose pixels begin at `at`.
pub(crate) fn bmp_header(w: usize, h: usize, bits: u16, compression: u32, at: u32) -> Vec<u8> {
    let mut bytes = b"BM\0\0\0\0\0\0\0\0".to_vec();
    bytes.extend(at.to_le_bytes());
    bytes.extend(40u32.to_le_bytes());
    bytes.extend((w as i32).to_le_bytes());
    bytes.extend((h as i32).to_le_bytes());
    bytes.extend(1u16.to_le_bytes());
    bytes.extend(bits.to_le_bytes());
    bytes.extend(compression.to_le_bytes());
    bytes.resize(54, 0);
    bytes
}

/// 32 bits with masks, in the order red, green, blue from the top, top row first.
pub(crate) fn bmp_masked(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let mut bytes = bmp_header(w, h, 32, 3, 66);
    bytes[22..26].copy_from_slice(&(-(h as i32)).to_le_bytes());
    [0xff00_0000u32, 0x00ff_0000, 0x0000_ff00].iter().for_each(|mask| bytes.extend(mask.to_le_bytes()));
    image.pixels().for_each(|[r, g, b]| bytes.extend([7, b, g, r]));
    bytes
}

pub(crate) fn ppm(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let mut bytes = format!("P6\n# a comment\n{w} {h}\n255\n").into_bytes();
    bytes.extend(image.as_slice());
    bytes
}

/// The same image as a text PPM.
pub(crate) fn ppm_text(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let numbers: Vec<String> = image.as_slice().iter().map(u8::to_string).collect();
    format!("P3 {w} {h} 255\n{}\n", numbers.join(" ")).into_bytes()
}

/// A Radiance HDR file: intensities 0 to 1 as mantissas with a common exponent of 0 (128 in the file), each channel a literal run.
pub(crate) fn hdr(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let mut bytes = format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {h} +X {w}\n").into_bytes();
    for y in 0..h {
        bytes.extend([2, 2, 0, w as u8]);
        for c in 0..3 {
            bytes.push(w as u8);
            bytes.extend((0..w).map(|x| image.at(x, y)[c]));
        }
        bytes.extend([128 + w as u8, 128]);
    }
    bytes
}

pub(crate) fn tiff<C: tiff::encoder::colortype::ColorType>(w: usize, h: usize, samples: &[C::Inner]) -> Vec<u8>
where
    [C::Inner]: tiff::encoder::TiffValue,
{
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = tiff::encoder::TiffEncoder::new(&mut bytes).unwrap();
    encoder.write_image::<C>(w as u32, h as u32, samples).unwrap();
    bytes.into_inner()
}

/// A TIFF with 64-bit offsets.
#[cfg(feature = "tiff")]
pub(crate) fn big_tiff(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = tiff::encoder::TiffEncoder::new_big(&mut bytes).unwrap();
    encoder.write_image::<tiff::encoder::colortype::RGB8>(w as u32, h as u32, image.as_slice()).unwrap();
    bytes.into_inner()
}

#[cfg(feature = "exr")]
pub(crate) fn exr(w: usize, h: usize, light: impl Fn(usize, usize) -> [f32; 3] + Sync) -> Vec<u8> {
    use exr::prelude::{Image, SpecificChannels, Vec2, WritableImage};
    let channels = SpecificChannels::rgb(|at: Vec2<usize>| {
        let [r, g, b] = light(at.0, at.1);
        (r, g, b)
    });
    let mut bytes = Cursor::new(Vec::new());
    Image::from_channels((w, h), channels).write().to_buffered(&mut bytes).unwrap();
    bytes.into_inner()
}

/// One small file of every supported format and variant.
pub(crate) fn samples() -> Vec<(&'static str, Vec<u8>)> {
    let image = ramp(12, 7);
    #[cfg(feature = "tiff")]
    let wide: Vec<u16> = image.as_slice().iter().map(|v| u16::from(*v) * 257).collect();
    vec![
        ("png", encode_png(image.view()).unwrap()),
        ("png 16", encode_png(image.map(|p| p.map(|v| u16::from(v) * 257)).view()).unwrap()),
        ("png gray alpha", gray_alpha(12, 7)),
        ("jpeg", encode_jpeg(image.view(), 90).unwrap()),
        ("progressive", {
            let mut bytes = Vec::new();
            let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 90);
            encoder.set_progressive(true);
            encoder.encode(image.as_slice(), 12, 7, jpeg_encoder::ColorType::Rgb).unwrap();
            bytes
        }),
        ("cmyk", cmyk(&image, jpeg_encoder::ColorType::Cmyk)),
        #[cfg(feature = "tiff")]
        ("tiff", tiff::<tiff::encoder::colortype::RGB8>(12, 7, image.as_slice())),
        #[cfg(feature = "tiff")]
        ("tiff 16", tiff::<tiff::encoder::colortype::RGB16>(12, 7, &wide)),
        ("bmp", bmp(&image)),
        ("bmp with masks", bmp_masked(&image)),
        ("pnm", ppm(&image)),
        ("pnm as text", ppm_text(&image)),
        ("hdr", hdr(&image)),
        #[cfg(feature = "exr")]
        ("exr", exr(12, 7, |x, y| image.at(x, y).map(f32::from))),
    ]
}

/// Gray increases with x, alpha with y.
pub(crate) fn gray_alpha(w: usize, h: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, w as u32, h as u32);
    encoder.set_color(png::ColorType::GrayscaleAlpha);
    let samples: Vec<u8> = (0..w * h).flat_map(|i| [(i % w * 20) as u8, (i / w) as u8]).collect();
    encoder.write_header().unwrap().write_image_data(&samples).unwrap();
    bytes
}

/// A CMYK JPEG with zero black: cyan, magenta and yellow are the complements of red, green and blue.
pub(crate) fn cmyk(image: &RgbU8, color: jpeg_encoder::ColorType) -> Vec<u8> {
    let inks: Vec<u8> = image.pixels().flat_map(|[r, g, b]| [255 - r, 255 - g, 255 - b, 0]).collect();
    let mut bytes = Vec::new();
    let (w, h) = image.size();
    jpeg_encoder::Encoder::new(&mut bytes, 95).encode(&inks, w as u16, h as u16, color).unwrap();
    bytes
}

/// An EXIF block from fields of the first directory and the EXIF directory.
pub(crate) fn exif_block(fields: &[(Tag, Value)]) -> Vec<u8> {
    let fields: Vec<Field> = fields
        .iter()
        .map(|(tag, value)| Field { tag: *tag, ifd_num: exif::In::PRIMARY, value: value.clone() })
        .collect();
    let mut writer = Writer::new();
    fields.iter().for_each(|f| writer.push_field(f));
    let mut bytes = Cursor::new(Vec::new());
    writer.write(&mut bytes, false).unwrap();
    bytes.into_inner()
}

pub(crate) fn png_with_exif(image: &RgbU8, fields: &[(Tag, Value)]) -> Vec<u8> {
    let (w, h) = image.size();
    let mut info = png::Info::with_size(w as u32, h as u32);
    info.exif_metadata = Some(exif_block(fields).into());
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::with_info(&mut bytes, info).unwrap();
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(image.as_slice()).unwrap();
    bytes
}

pub(crate) fn jpeg_with_exif(image: &RgbU8, fields: &[(Tag, Value)]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 100);
    encoder.add_exif_metadata(&exif_block(fields)).unwrap();
    let (w, h) = image.size();
    encoder.encode(image.as_slice(), w as u16, h as u16, jpeg_encoder::ColorType::Rgb).unwrap();
    bytes
}

/// Files of `w × h` pixels of one color, for every format.
pub(crate) fn plain(w: usize, h: usize) -> Vec<(&'static str, Vec<u8>)> {
    let image = RgbU8::new(w, h, [10, 200, 90]);
    vec![
        ("png", encode_png(image.view()).unwrap()),
        ("png 16", encode_png(image.map(|p| p.map(|v| u16::from(v) * 257)).view()).unwrap()),
        ("jpeg", encode_jpeg(image.view(), 90).unwrap()),
        ("progressive", {
            let mut bytes = Vec::new();
            let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 90);
            encoder.set_progressive(true);
            encoder.encode(image.as_slice(), w as u16, h as u16, jpeg_encoder::ColorType::Rgb).unwrap();
            bytes
        }),
        #[cfg(feature = "tiff")]
        ("tiff", tiff::<tiff::encoder::colortype::RGB8>(w, h, image.as_slice())),
        ("bmp", bmp(&image)),
        ("pnm", ppm(&image)),
        ("hdr", hdr_of_runs(w, h)),
        #[cfg(feature = "exr")]
        ("exr", exr(w, h, |_, _| [0.1, 0.2, 0.3])),
    ]
}

/// Rows of one pixel and its repetitions, in the older run-length encoding: the smallest possible files of the format.
pub(crate) fn hdr_of_runs(w: usize, h: usize) -> Vec<u8> {
    let mut row = vec![128, 64, 32, 129];
    let mut left = w - 1;
    while left > 0 {
        row.extend([1, 1, 1, (left % 256) as u8]);
        left /= 256;
    }
    let mut bytes = format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {h} +X {w}\n").into_bytes();
    bytes.extend(row.repeat(h));
    bytes
}
