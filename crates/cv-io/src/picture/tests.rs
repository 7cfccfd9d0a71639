use super::*;
use crate::{ExifFocal, FocalSource, encode_jpeg, encode_png};
use exif::experimental::Writer;
use exif::{Field, Rational, Tag, Value};
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};
use proptest::prelude::*;

/// A picture whose every pixel differs from its neighbors in a way that no flip keeps.
fn ramp(width: usize, height: usize) -> RgbU8 {
    RgbU8::from_fn(width, height, |x, y| [(x * 20) as u8, (y * 30) as u8, (x * 7 + y * 11) as u8])
}

fn decoded(bytes: &[u8]) -> DynImage {
    decode_image(bytes, &ReadOptions::default()).unwrap()
}

fn encode_as(format: ImageFormat, picture: &DynamicImage) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn dynamic(image: &RgbU8) -> DynamicImage {
    let (w, h) = image.size();
    image::RgbImage::from_raw(w as u32, h as u32, image.as_slice().to_vec()).unwrap().into()
}

/// One small file of every format and kind that is understood.
fn samples() -> Vec<(&'static str, Vec<u8>)> {
    let image = ramp(12, 7);
    let rgb = dynamic(&image);
    vec![
        ("png", encode_png(image.view()).unwrap()),
        ("png 16", encode_png(image.map(|p| p.map(|v| u16::from(v) * 257)).view()).unwrap()),
        ("png gray alpha", encode_as(ImageFormat::Png, &rgb.to_luma_alpha8().into())),
        ("jpeg", encode_jpeg(image.view(), 90).unwrap()),
        ("progressive", {
            let mut bytes = Vec::new();
            let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 90);
            encoder.set_progressive(true);
            encoder.encode(image.as_slice(), 12, 7, jpeg_encoder::ColorType::Rgb).unwrap();
            bytes
        }),
        ("cmyk", cmyk(&image, jpeg_encoder::ColorType::Cmyk)),
        ("tiff", encode_as(ImageFormat::Tiff, &rgb)),
        ("bmp", encode_as(ImageFormat::Bmp, &rgb)),
        ("pnm", encode_as(ImageFormat::Pnm, &rgb)),
        ("hdr", encode_as(ImageFormat::Hdr, &rgb.to_rgb32f().into())),
        ("exr", encode_as(ImageFormat::OpenExr, &rgb.to_rgb32f().into())),
    ]
}

/// A JPEG of four inks without black: cyan, magenta and yellow are what red, green and blue lack.
fn cmyk(image: &RgbU8, color: jpeg_encoder::ColorType) -> Vec<u8> {
    let inks: Vec<u8> = image.pixels().flat_map(|[r, g, b]| [255 - r, 255 - g, 255 - b, 0]).collect();
    let mut bytes = Vec::new();
    let (w, h) = image.size();
    jpeg_encoder::Encoder::new(&mut bytes, 95).encode(&inks, w as u16, h as u16, color).unwrap();
    bytes
}

/// An EXIF block from fields of the first directory and the EXIF directory.
fn exif_block(fields: &[(Tag, Value)]) -> Vec<u8> {
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

fn png_with_exif(image: &RgbU8, fields: &[(Tag, Value)]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = PngEncoder::new(&mut bytes);
    encoder.set_exif_metadata(exif_block(fields)).unwrap();
    let (w, h) = image.size();
    encoder.write_image(image.as_slice(), w as u32, h as u32, ExtendedColorType::Rgb8).unwrap();
    bytes
}

fn jpeg_with_exif(image: &RgbU8, fields: &[(Tag, Value)]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 100);
    encoder.add_exif_metadata(&exif_block(fields)).unwrap();
    let (w, h) = image.size();
    encoder.encode(image.as_slice(), w as u16, h as u16, jpeg_encoder::ColorType::Rgb).unwrap();
    bytes
}

fn rational(num: u32, denom: u32) -> Value {
    Value::Rational(vec![Rational { num, denom }])
}

#[test]
fn every_orientation_is_applied_as_the_standard_defines_it() {
    // EXIF 2.32, tag 274: where the stored row 0 and column 0 are in the picture as it is to be seen. The stored pixel
    // (x, y) of a w × h picture is seen at:
    type Seen = fn(usize, usize, usize, usize) -> (usize, usize);
    let places: [Seen; 8] = [
        |x, y, _, _| (x, y),                 // top, left
        |x, y, w, _| (w - 1 - x, y),         // top, right
        |x, y, w, h| (w - 1 - x, h - 1 - y), // bottom, right
        |x, y, _, h| (x, h - 1 - y),         // bottom, left
        |x, y, _, _| (y, x),                 // left, top
        |x, y, _, h| (h - 1 - y, x),         // right, top
        |x, y, w, h| (h - 1 - y, w - 1 - x), // right, bottom
        |x, y, w, _| (y, w - 1 - x),         // left, bottom
    ];
    // Blocks of 8 × 8 pixels, so that a JPEG keeps their colors.
    let stored = RgbU8::from_fn(24, 16, |x, y| ramp(3, 2).at(x / 8, y / 8).map(|v| v * 4));
    for (k, place) in places.iter().enumerate() {
        let fields = [(Tag::Orientation, Value::Short(vec![k as u16 + 1]))];
        for bytes in [png_with_exif(&stored, &fields), jpeg_with_exif(&stored, &fields)] {
            let picture = decoded(&bytes);
            assert_eq!(picture.exif.orientation, k as u8 + 1);
            let seen = picture.into_rgb8();
            assert_eq!(seen.size(), if k >= 4 { (16, 24) } else { (24, 16) });
            for (x, y) in [(0, 0), (23, 0), (0, 15), (12, 9)] {
                let (sx, sy) = place(x, y, 24, 16);
                let (a, b) = (stored.at(x, y), seen.at(sx, sy));
                // Quality 100 rounds each of three channels once or twice.
                assert!((0..3).all(|c| a[c].abs_diff(b[c]) <= 3), "{}: {a:?} {b:?}", k + 1);
            }
        }
    }
}

#[test]
fn the_focal_length_comes_from_the_better_tag() {
    let image = ramp(600, 400);
    let mm = (Tag::FocalLength, rational(50, 1));
    // A 36 mm wide sensor: 600 px over 36 mm, in the three units and the default one.
    let by = |unit: u16, num: u32, denom: u32| {
        vec![
            mm.clone(),
            (Tag::FocalPlaneXResolution, rational(num, denom)),
            (Tag::FocalPlaneResolutionUnit, Value::Short(vec![unit])),
        ]
    };
    let focal = |fields: &[(Tag, Value)]| decoded(&png_with_exif(&image, fields)).exif.focal;
    let truth = 50.0 * 600.0 / 36.0;
    let near = |found: Option<ExifFocal>, pixels: f64, source: FocalSource| {
        let found = found.unwrap();
        // The tags' fractions below carry five digits.
        assert!((found.pixels / pixels - 1.0).abs() < 1e-4 && found.source == source, "{found:?} {pixels}");
    };
    near(focal(&by(2, 4_233_333, 10_000)), truth, FocalSource::SensorResolution);
    near(focal(&by(3, 1_666_667, 10_000)), truth, FocalSource::SensorResolution);
    near(focal(&by(4, 1_666_667, 100_000)), truth, FocalSource::SensorResolution);
    // The same photograph made four times smaller since it was taken.
    let mut smaller = by(4, 6_666_667, 100_000);
    smaller.push((Tag::PixelXDimension, Value::Long(vec![2400])));
    near(focal(&smaller), truth, FocalSource::SensorResolution);
    // The 35 mm equivalent, by diagonals: 50 mm over 43.27 mm for a diagonal of 721 px.
    let equivalent = (Tag::FocalLengthIn35mmFilm, Value::Short(vec![50]));
    near(focal(&[mm.clone(), equivalent.clone()]), 50.0 * 600.0 / 36.0, FocalSource::Equivalent35mm);
    // Tags that contradict each other, and a resolution that no sensor has.
    let mut wrong = by(4, 3_000_000, 100_000);
    wrong.push(equivalent);
    near(focal(&wrong), truth, FocalSource::Equivalent35mm);
    assert_eq!(focal(&by(2, 72, 1)), None);
    assert_eq!(focal(&[mm]), None);
    assert_eq!(focal(&[(Tag::FocalLengthIn35mmFilm, Value::Short(vec![0]))]), None);
    assert_eq!(focal(&[(Tag::FocalLength, rational(50, 0)), (Tag::FocalPlaneXResolution, rational(0, 0))]), None);
}

#[test]
fn the_focal_length_of_a_turned_picture_is_that_of_the_picture_seen() {
    let fields = [(Tag::Orientation, Value::Short(vec![6])), (Tag::FocalLengthIn35mmFilm, Value::Short(vec![28]))];
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("turned.jpg");
    std::fs::write(&path, jpeg_with_exif(&ramp(60, 40), &fields)).unwrap();
    let (size, info) = read_image_info(&path).unwrap();
    assert_eq!((size, info.orientation), ((40, 60), 6));
    let picture = read_image(&path).unwrap();
    assert_eq!((picture.size(), picture.exif.focal), (size, info.focal));
}

#[test]
fn every_depth_and_kind_gives_the_same_picture() {
    let image = ramp(12, 7);
    let rgb = dynamic(&image);
    let exact = [
        encode_png(image.map(|p| p.map(|v| u16::from(v) * 257)).view()).unwrap(),
        encode_png(
            Image::<u8, 4>::from_fn(12, 7, |x, y| {
                let [r, g, b] = image.at(x, y);
                [r, g, b, (x * 20) as u8]
            })
            .view(),
        )
        .unwrap(),
        encode_as(ImageFormat::Tiff, &rgb),
        encode_as(ImageFormat::Tiff, &rgb.to_rgb16().into()),
        encode_as(ImageFormat::Bmp, &rgb),
        encode_as(ImageFormat::Bmp, &rgb.to_rgba8().into()),
        encode_as(ImageFormat::Pnm, &rgb),
    ];
    for (i, bytes) in exact.iter().enumerate() {
        assert_eq!(decoded(bytes).into_rgb8(), image, "file {i}");
    }
    // 16 bits are not lost on the way.
    let deep = Image::<u16, 3>::from_fn(5, 3, |x, y| [x as u16 * 9999, y as u16 * 20000, 1]);
    assert_eq!(decoded(&encode_png(deep.view()).unwrap()).pixels, Pixels::Rgb16(deep));
    let deep = Image::<u16, 1>::from_fn(5, 3, |x, y| [x as u16 * 9999 + y as u16]);
    assert_eq!(decoded(&encode_png(deep.view()).unwrap()).pixels, Pixels::Gray16(deep));
    let gray = image.map(|[r, _, _]| [r]);
    assert_eq!(decoded(&encode_png(gray.view()).unwrap()).into_rgb8(), gray.map(|[v]| [v; 3]));
    let alpha = image::GrayAlphaImage::from_fn(12, 7, |x, y| image::LumaA([(x * 20) as u8, y as u8]));
    assert_eq!(decoded(&encode_as(ImageFormat::Png, &alpha.into())).into_gray8(), gray);
}

#[test]
fn a_palette_is_resolved() {
    // The smallest palette PNG: 2 × 1 pixels of one bit, by the PNG specification; red, then blue.
    let mut png = b"\x89PNG\r\n\x1a\n".to_vec();
    let mut chunk = |kind: &[u8; 4], data: &[u8]| {
        png.extend((data.len() as u32).to_be_bytes());
        let tagged = [&kind[..], data].concat();
        png.extend(&tagged);
        png.extend(crc32fast::hash(&tagged).to_be_bytes());
    };
    chunk(b"IHDR", &[0, 0, 0, 2, 0, 0, 0, 1, 1, 3, 0, 0, 0]);
    chunk(b"PLTE", &[255, 0, 0, 0, 0, 255]);
    chunk(b"IDAT", &miniz_oxide::deflate::compress_to_vec_zlib(&[0, 0b0100_0000], 6));
    chunk(b"IEND", &[]);
    assert_eq!(decoded(&png).into_rgb8().as_slice(), [255, 0, 0, 0, 0, 255]);
}

#[test]
fn four_inks_become_three_lights() {
    let image = RgbU8::from_fn(32, 32, |x, y| [(x * 8) as u8, (y * 8) as u8, 128]);
    for color in [jpeg_encoder::ColorType::Cmyk, jpeg_encoder::ColorType::CmykAsYcck] {
        let back = decoded(&cmyk(&image, color)).into_rgb8();
        let worst = image.as_slice().iter().zip(back.as_slice()).map(|(a, b)| a.abs_diff(*b)).max();
        // A smooth ramp at quality 95 is coded to a few gray levels.
        assert!(worst <= Some(12), "{worst:?}");
    }
}

#[test]
fn linear_light_is_encoded_for_the_eye() {
    let light = image::Rgb32FImage::from_raw(
        4,
        1,
        vec![0.0, 1.0, 0.5, 0.0031308, 2.0, -1.0, 0.18, 0.18, 0.18, f32::NAN, 0.0, 1.0],
    );
    let bytes = encode_as(ImageFormat::OpenExr, &light.unwrap().into());
    // IEC 61966-2-1 at 0.5, at its corner, and at the photographer's gray.
    let expected = [0, 255, 188, 10, 255, 0, 118, 118, 118, 0, 0, 255];
    assert_eq!(decoded(&bytes).into_rgb8().as_slice(), expected);
}

#[test]
fn gray_is_opencvs() {
    // cv2.cvtColor(…, COLOR_RGB2GRAY) of OpenCV 5.0.
    let image = RgbU8::from_vec(4, 1, vec![255, 0, 0, 0, 255, 0, 0, 0, 255, 10, 200, 90]).unwrap();
    assert_eq!(decoded(&encode_png(image.view()).unwrap()).into_gray8().as_slice(), [76, 150, 29, 131]);
}

#[test]
fn a_file_cut_anywhere_is_an_error_and_never_half_a_picture() {
    for (name, bytes) in samples() {
        // What stands behind the last pixel: PNG's end chunk, TIFF's directory is in front, EXR's none.
        for len in 0..bytes.len() - 16 {
            let result = decode_image(&bytes[..len], &ReadOptions::default());
            assert!(result.is_err(), "{name}: {len} of {} bytes", bytes.len());
        }
    }
}

#[test]
fn too_many_pixels_are_refused_by_the_header() {
    let limit = ReadOptions { max_pixels: 83 };
    for (name, bytes) in samples() {
        let error = decode_image(&bytes, &limit).unwrap_err();
        assert!(matches!(error, FormatError::TooManyPixels { width: 12, height: 7, limit: 83 }), "{name}: {error}");
        assert!(decode_image(&bytes, &ReadOptions { max_pixels: 84 }).is_ok(), "{name}");
    }
}

#[test]
fn a_header_that_promises_more_than_the_file_holds_is_refused() {
    let mut png = encode_png(ramp(12, 7).view()).unwrap();
    png[16..24].copy_from_slice(&[0, 0, 0x3f, 0, 0, 0, 0x3f, 0]);
    let crc = crc32fast::hash(&png[12..29]);
    png[29..33].copy_from_slice(&crc.to_be_bytes());
    let error = decode_image(&png, &ReadOptions::default()).unwrap_err().to_string();
    assert!(error.contains("cannot hold"), "{error}");
    let mut jpeg = encode_jpeg(ramp(12, 7).view(), 90).unwrap();
    let at = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    jpeg[at + 5..at + 9].copy_from_slice(&[0x3f, 0xff, 0x3f, 0xff]);
    let error = decode_image(&jpeg, &ReadOptions::default()).unwrap_err().to_string();
    assert!(error.contains("cannot hold"), "{error}");
}

#[test]
fn names_do_not_matter_and_other_formats_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    std::fs::write(&path, encode_as(ImageFormat::Bmp, &dynamic(&ramp(4, 3)))).unwrap();
    assert_eq!(read_rgb(&path).unwrap(), ramp(4, 3));
    for (bytes, word) in [
        (&b"GIF89a____________"[..], "GIF"),
        (b"RIFF____WEBPVP8 ", "WebP"),
        (b"\0\0\0\x20ftypheic\0\0\0\0", "HEIC"),
        (b"%PDF-1.7", "PDF"),
        (b"Pf\n2 2\n-1\n", "PFM"),
        (b"\x93NUMPY\x01\x00", "npy"),
        (b"hello, world", "first bytes"),
        (b"x", "first bytes"),
        (b"", "empty"),
    ] {
        let error = decode_image(bytes, &ReadOptions::default()).unwrap_err().to_string();
        assert!(error.contains(word), "{error}");
    }
}

#[test]
fn the_smallest_pictures() {
    let one = RgbU8::new(1, 1, [9, 8, 7]);
    assert_eq!(decoded(&encode_png(one.view()).unwrap()).into_rgb8(), one);
    assert_eq!(decoded(&encode_jpeg(one.view(), 95).unwrap()).size(), (1, 1));
    assert!(encode_png(RgbU8::new(0, 4, [0; 3]).view()).is_err());
    assert!(encode_jpeg(RgbU8::new(4, 0, [0; 3]).view(), 90).is_err());
    assert!(encode_jpeg(GrayU8::new(70_000, 1, [0]).view(), 90).is_err());
}

proptest! {
    /// Damage anywhere: an error or a picture within the limit, never a panic that escapes.
    #[test]
    fn damaged_files_do_no_harm(which in 0usize..11, edits in prop::collection::vec((any::<u16>(), any::<u8>()), 1..6), cut in any::<u16>(), cuts in any::<bool>()) {
        let (name, mut bytes) = samples().swap_remove(which);
        let len = bytes.len();
        for (at, value) in edits {
            bytes[usize::from(at) % len] = value;
        }
        if cuts {
            bytes.truncate(usize::from(cut) % len);
        }
        let limit = 1 << 16;
        if let Ok(picture) = decode_image(&bytes, &ReadOptions { max_pixels: limit }) {
            let (w, h) = picture.size();
            prop_assert!((w * h) as u64 <= limit && w * h > 0, "{}: {}×{}", name, w, h);
        }
    }

    #[test]
    fn png_keeps_every_sample(w in 1usize..9, h in 1usize..9, data in prop::collection::vec(any::<u16>(), 192)) {
        let deep = Image::<u16, 3>::from_fn(w, h, |x, y| std::array::from_fn(|c| data[(y * 8 + x) * 3 + c]));
        prop_assert_eq!(decoded(&encode_png(deep.view()).unwrap()).pixels, Pixels::Rgb16(deep.clone()));
        let bytes = deep.map(|p| p.map(|v| v as u8));
        let png = encode_png(bytes.view()).unwrap();
        prop_assert_eq!(decoded(&png).into_rgb8(), bytes.clone());
        // A window into the middle, whose rows lie apart in memory.
        if w > 2 && h > 2 {
            let window = bytes.view().crop(1, 1, w - 2, h - 2).unwrap();
            prop_assert_eq!(decoded(&encode_png(window).unwrap()).into_rgb8(), window.to_image());
        }
    }
}
