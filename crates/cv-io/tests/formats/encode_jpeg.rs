//! Writing JPEG.

use cv_core::{Image, ImageView};
use cv_io::{JpegPixels, ReadOptions, decode_image, encode_jpeg};
use jpeg_encoder::{ColorType, Encoder};

use crate::encode_rows::write_in_rows;

/// Encodes an image by one call of the encoder, without restart markers.
fn in_one_piece<const C: usize>(image: &Image<u8, C>, quality: u8) -> Vec<u8> {
    let mut bytes = Vec::new();
    let (width, height) = image.size();
    let color = if C == 1 { ColorType::Luma } else { ColorType::Rgb };
    Encoder::new(&mut bytes, quality).encode(image.as_slice(), width as u16, height as u16, color).unwrap();
    bytes
}

/// Checks that the strips of an image decode to the pixels of one piece.
fn check_strips<const C: usize>(image: &Image<u8, C>, quality: u8)
where
    for<'a> ImageView<'a, u8, C>: JpegPixels,
{
    let markers = |bytes: &[u8]| bytes.windows(2).filter(|w| w[0] == 0xFF && (0xD0..=0xD7).contains(&w[1])).count();
    let files = [encode_jpeg(image.view(), quality).unwrap(), in_one_piece(image, quality)];
    assert_eq!(files.each_ref().map(|bytes| markers(bytes)), [9, 0]);
    let [strips, whole] = files.map(|bytes| decode_image(&bytes, &ReadOptions::default()).unwrap());
    assert_eq!(strips, whole);
}

/// That they do not depend on how the rows arrive is tested beside the encoder.
#[test]
fn strips_decode_to_the_pixels_of_one_piece() {
    // Ten strips, so that the markers go round, the last one of three rows; with and without subsampled chroma.
    let color = Image::<u8, 3>::from_fn(11_000, 9 * 48 + 3, |x, y| {
        [(x / 63) as u8, (y * 3 % 256) as u8, ((x ^ y) % 256) as u8]
    });
    check_strips(&color, 95);
    check_strips(&color, 80);
    check_strips(&color.map(|p| [p[2]]), 95);
}

#[test]
fn a_small_image_is_one_piece() {
    let image = Image::<u8, 3>::from_fn(700, 500, |x, y| [x as u8, y as u8, (x + y) as u8]);
    assert_eq!(encode_jpeg(image.view(), 95).unwrap(), in_one_piece(&image, 95));
}

#[test]
fn the_largest_sides_have_strips() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.jpg");
    let wide = Image::<u8, 1>::from_fn(65_535, 40, |x, y| [(x * (y + 1) / 97) as u8]);
    let tall = Image::<u8, 1>::from_fn(9, 65_535, |x, y| [(x * y / 97) as u8]);
    for image in [wide, tall] {
        write_in_rows(&path, &image, 7).unwrap();
        // The quality of files is 95.
        let [strips, whole] = [std::fs::read(&path).unwrap(), in_one_piece(&image, 95)]
            .map(|bytes| decode_image(&bytes, &ReadOptions::default()).unwrap());
        assert_eq!(strips, whole);
    }
}
