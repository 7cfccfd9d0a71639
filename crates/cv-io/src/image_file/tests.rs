use super::*;
use crate::{ExifFocal, FocalSource, Metadata, encode_jpeg, encode_png, encode_tiff};
use exif::experimental::Writer;
use exif::{Field, Rational, Tag, Value};
use proptest::prelude::*;
use std::io::Cursor;

/// A test image that no flip or rotation leaves unchanged.
fn ramp(width: usize, height: usize) -> RgbU8 {
    RgbU8::from_fn(width, height, |x, y| [(x * 20) as u8, (y * 30) as u8, (x * 7 + y * 11) as u8])
}

fn decoded(bytes: &[u8]) -> DynImage {
    decode_image(bytes, &ReadOptions::default()).unwrap()
}

/// A 24-bit BMP, bottom row first (BITMAPINFOHEADER).
fn bmp(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let mut bytes = bmp_header(w, h, 24, 0, 54);
    for y in (0..h).rev() {
        (0..w).for_each(|x| bytes.extend(image.at(x, y).iter().rev()));
        bytes.resize(54 + (h - y) * (3 * w).next_multiple_of(4), 0);
    }
    bytes
}

/// The two headers of a BMP whose pixels begin at `at`.
fn bmp_header(w: usize, h: usize, bits: u16, compression: u32, at: u32) -> Vec<u8> {
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
fn bmp_masked(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let mut bytes = bmp_header(w, h, 32, 3, 66);
    bytes[22..26].copy_from_slice(&(-(h as i32)).to_le_bytes());
    [0xff00_0000u32, 0x00ff_0000, 0x0000_ff00].iter().for_each(|mask| bytes.extend(mask.to_le_bytes()));
    image.pixels().for_each(|[r, g, b]| bytes.extend([7, b, g, r]));
    bytes
}

fn ppm(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let mut bytes = format!("P6\n# a comment\n{w} {h}\n255\n").into_bytes();
    bytes.extend(image.as_slice());
    bytes
}

/// The same image as a text PPM.
fn ppm_text(image: &RgbU8) -> Vec<u8> {
    let (w, h) = image.size();
    let numbers: Vec<String> = image.as_slice().iter().map(u8::to_string).collect();
    format!("P3 {w} {h} 255\n{}\n", numbers.join(" ")).into_bytes()
}

/// A Radiance HDR file: intensities 0 to 1 as mantissas with a common exponent of 0 (128 in the file), each channel a literal run.
fn hdr(image: &RgbU8) -> Vec<u8> {
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

fn tiff<C: tiff::encoder::colortype::ColorType>(w: usize, h: usize, samples: &[C::Inner]) -> Vec<u8>
where
    [C::Inner]: tiff::encoder::TiffValue,
{
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = tiff::encoder::TiffEncoder::new(&mut bytes).unwrap();
    encoder.write_image::<C>(w as u32, h as u32, samples).unwrap();
    bytes.into_inner()
}

#[cfg(feature = "exr")]
fn exr(w: usize, h: usize, light: impl Fn(usize, usize) -> [f32; 3] + Sync) -> Vec<u8> {
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
fn samples() -> Vec<(&'static str, Vec<u8>)> {
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
fn gray_alpha(w: usize, h: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, w as u32, h as u32);
    encoder.set_color(png::ColorType::GrayscaleAlpha);
    let samples: Vec<u8> = (0..w * h).flat_map(|i| [(i % w * 20) as u8, (i / w) as u8]).collect();
    encoder.write_header().unwrap().write_image_data(&samples).unwrap();
    bytes
}

/// A CMYK JPEG with zero black: cyan, magenta and yellow are the complements of red, green and blue.
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
    let (w, h) = image.size();
    let mut info = png::Info::with_size(w as u32, h as u32);
    info.exif_metadata = Some(exif_block(fields).into());
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::with_info(&mut bytes, info).unwrap();
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(image.as_slice()).unwrap();
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
fn every_exif_orientation_is_applied() {
    // EXIF 2.32, tag 274: position of the stored row 0 and column 0 in the upright image. The stored pixel
    // (x, y) of a w × h image maps to:
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
    // Blocks of 8 × 8 pixels, so that JPEG preserves their colors.
    let stored = RgbU8::from_fn(24, 16, |x, y| ramp(3, 2).at(x / 8, y / 8).map(|v| v * 4));
    for (k, place) in places.iter().enumerate() {
        let fields = [(Tag::Orientation, Value::Short(vec![k as u16 + 1]))];
        for bytes in [png_with_exif(&stored, &fields), jpeg_with_exif(&stored, &fields)] {
            let file = decoded(&bytes);
            assert_eq!(file.exif.orientation, k as u8 + 1);
            let seen = file.into_rgb8();
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
fn gps_positions_are_parsed_from_degrees_minutes_and_seconds() {
    let image = ramp(4, 4);
    let degrees = |d: u32, m: u32, s: u32| {
        Value::Rational([(d, 1), (m, 1), (s, 100)].map(|(num, denom)| Rational { num, denom }).to_vec())
    };
    let letter = |letter: &str| Value::Ascii(vec![letter.as_bytes().to_vec()]);
    let fields = |latitude: Value, reference: &str| {
        vec![
            (Tag::GPSLatitudeRef, letter(reference)),
            (Tag::GPSLatitude, latitude),
            (Tag::GPSLongitudeRef, letter("W")),
            (Tag::GPSLongitude, degrees(8, 30, 3600)),
        ]
    };
    let gps = |fields: &[(Tag, Value)]| {
        let found = decoded(&jpeg_with_exif(&image, fields)).exif.gps;
        assert_eq!(found, decoded(&png_with_exif(&image, fields)).exif.gps);
        found
    };
    let mut north = fields(degrees(47, 15, 1800), "N");
    let found = gps(&north).unwrap();
    // 47° 15′ 18″ and 8° 30′ 36″ west.
    assert!((found.latitude.to_degrees() - 47.255).abs() < 1e-12, "{found:?}");
    assert!((found.longitude.to_degrees() + 8.51).abs() < 1e-12, "{found:?}");
    assert_eq!((found.altitude, found.dilution, found.position().altitude), (None, None, 0.0));

    north.extend([(Tag::GPSAltitude, rational(4125, 10)), (Tag::GPSDOP, rational(21, 10))]);
    let found = gps(&north).unwrap();
    assert_eq!((found.altitude, found.dilution, found.position().altitude), (Some(412.5), Some(2.1), 412.5));
    north.push((Tag::GPSAltitudeRef, Value::Byte(vec![1])));
    assert_eq!(gps(&north).unwrap().altitude, Some(-412.5));

    assert!(gps(&fields(degrees(47, 15, 1800), "S")).unwrap().latitude < 0.0);
    // Decimal degrees alone, and degrees with decimal minutes.
    let parts =
        |parts: &[(u32, u32)]| Value::Rational(parts.iter().map(|&(num, denom)| Rational { num, denom }).collect());
    for value in [parts(&[(47_255, 1000)]), parts(&[(47, 1), (153, 10)])] {
        assert!((gps(&fields(value, "N")).unwrap().latitude.to_degrees() - 47.255).abs() < 1e-12);
    }
    // No hemisphere, no fix, beyond the pole, nothing, another type.
    let none = [(degrees(47, 15, 0), "?"), (parts(&[(0, 0), (0, 0), (0, 0)]), "N"), (degrees(90, 0, 1), "N")];
    for (value, reference) in none.into_iter().chain([(parts(&[]), "N"), (Value::Short(vec![47]), "N")]) {
        assert_eq!(gps(&fields(value.clone(), reference)), None, "{value:?}");
    }
    assert_eq!(gps(&north[1..]), None);
}

#[test]
fn the_focal_length_is_computed_from_the_most_accurate_tag() {
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
    // The same image downscaled by four.
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
    assert_eq!(focal(std::slice::from_ref(&mm)), None);
    // Millimeters alone: the sensor width by the camera model, where known.
    let model = |name: &str| (Tag::Model, Value::Ascii(vec![name.as_bytes().to_vec()]));
    near(focal(&[mm.clone(), model("Canon EOS 5D")]), truth, FocalSource::SensorTable);
    near(focal(&[mm.clone(), model("NIKON D90")]), 50.0 * 600.0 / 23.6, FocalSource::SensorTable);
    assert_eq!(focal(&[mm, model("No such camera")]), None);
    assert_eq!(focal(&[(Tag::FocalLengthIn35mmFilm, Value::Short(vec![0]))]), None);
    assert_eq!(focal(&[(Tag::FocalLength, rational(50, 0)), (Tag::FocalPlaneXResolution, rational(0, 0))]), None);
}

#[test]
fn the_focal_length_refers_to_the_upright_image() {
    let fields = [(Tag::Orientation, Value::Short(vec![6])), (Tag::FocalLengthIn35mmFilm, Value::Short(vec![28]))];
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("turned.jpg");
    std::fs::write(&path, jpeg_with_exif(&ramp(60, 40), &fields)).unwrap();
    let (size, info) = read_image_info(&path).unwrap();
    assert_eq!((size, info.orientation), ((40, 60), 6));
    let file = read_image(&path).unwrap();
    assert_eq!((file.size(), file.exif.focal), (size, info.focal));
}

#[test]
fn every_bit_depth_and_format_gives_the_same_image() {
    let image = ramp(12, 7);
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
        bmp(&image),
        bmp_masked(&image),
        ppm(&image),
        ppm_text(&image),
        #[cfg(feature = "tiff")]
        tiff::<tiff::encoder::colortype::RGB8>(12, 7, image.as_slice()),
        #[cfg(feature = "tiff")]
        tiff::<tiff::encoder::colortype::RGB16>(
            12,
            7,
            &image.as_slice().iter().map(|v| u16::from(*v) * 257).collect::<Vec<_>>(),
        ),
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
    assert_eq!(decoded(&gray_alpha(12, 7)).into_gray8(), gray);
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
fn cmyk_jpegs_are_converted_to_rgb() {
    let image = RgbU8::from_fn(32, 32, |x, y| [(x * 8) as u8, (y * 8) as u8, 128]);
    for color in [jpeg_encoder::ColorType::Cmyk, jpeg_encoder::ColorType::CmykAsYcck] {
        let back = decoded(&cmyk(&image, color)).into_rgb8();
        let worst = image.as_slice().iter().zip(back.as_slice()).map(|(a, b)| a.abs_diff(*b)).max();
        // A smooth ramp at quality 95 is coded to a few gray levels.
        assert!(worst <= Some(12), "{worst:?}");
    }
}

#[test]
fn linear_intensity_is_srgb_encoded() {
    let light = [[0.0, 1.0, 0.5], [0.0, 0.003_130_8, 2.0], [-1.0, 0.18, 0.18], [f32::NAN, 0.0, 1.0]];
    let file = DynImage {
        pixels: Pixels::RgbF32(RgbF32::from_fn(4, 1, |x, _| light[x])),
        exif: ExifInfo::default(),
        metadata: Metadata::default(),
    };
    // IEC 61966-2-1 at 0.5, at its corner, and at the photographer's gray.
    let expected = [0, 255, 188, 0, 10, 255, 0, 118, 118, 0, 0, 255];
    assert_eq!(file.into_rgb8().as_slice(), expected);
}

#[test]
fn float_formats_are_read_unchanged() {
    let image = ramp(12, 7);
    let expected = RgbF32::from_fn(12, 7, |x, y| image.at(x, y).map(|v| f32::from(v) / 256.0));
    assert_eq!(decoded(&hdr(&image)).pixels, Pixels::RgbF32(expected.clone()));
    // Flat pixels, the second of which is repeated three times: the older code.
    let flat = b"#?RGBE\n\n-Y 1 +X 5\n\x80\x40\x20\x81\x20\x20\x20\x80\x01\x01\x01\x03";
    let row = [[1.0, 0.5, 0.25], [0.125; 3], [0.125; 3], [0.125; 3], [0.125; 3]];
    assert_eq!(decoded(flat).pixels, Pixels::RgbF32(RgbF32::from_fn(5, 1, |x, _| row[x])));
    #[cfg(feature = "exr")]
    assert_eq!(decoded(&exr(12, 7, |x, y| expected.at(x, y))).pixels, Pixels::RgbF32(expected));
    #[cfg(feature = "tiff")]
    assert_eq!(
        decoded(&tiff::<tiff::encoder::colortype::Gray32Float>(2, 1, &[-1.5, 300.25])).pixels,
        Pixels::GrayF32(GrayF32::from_fn(2, 1, |x, _| [[-1.5, 300.25][x]]))
    );
}

#[test]
fn low_bit_depths_are_scaled_to_the_full_range() {
    let gray = |bytes: &[u8]| decoded(bytes).into_gray8().as_slice().to_vec();
    // In a bitmap of Netpbm 1 is black.
    assert_eq!(gray(b"P1 3 2\n101\n0 1 0\n"), [0, 255, 0, 255, 0, 255]);
    assert_eq!(gray(b"P4 3 2\n\xa0\x40"), [0, 255, 0, 255, 0, 255]);
    assert_eq!(gray(b"P2 3 1 2\n0 1 2"), [0, 128, 255]);
    // 10 bits in 16.
    let deep = decoded(b"P5 2 1 1023\n\x03\xff\x02\x00").pixels;
    assert_eq!(deep, Pixels::Gray16(Image::from_fn(2, 1, |x, _| [[65535, 32800][x]])));
    // Two entries of a palette, and 5 bits a color.
    let mut bytes = bmp_header(3, 1, 1, 0, 62);
    bytes.extend([255, 0, 0, 0, 1, 2, 3, 0, 0b1010_0000, 0, 0, 0]);
    assert_eq!(decoded(&bytes).into_rgb8().as_slice(), [3, 2, 1, 0, 0, 255, 3, 2, 1]);
    let mut bytes = bmp_header(2, 1, 16, 0, 54);
    bytes.extend([0x1f, 0, 0, 0x7c]);
    assert_eq!(decoded(&bytes).into_rgb8().as_slice(), [0, 0, 255, 255, 0, 0]);
}

#[cfg(feature = "tiff")]
#[test]
fn cmyk_tiffs_are_converted_to_rgb() {
    // No ink, all of cyan, half of all with half of black.
    let inks = [0, 0, 0, 0, 255, 0, 0, 0, 51, 51, 51, 51];
    let bytes = tiff::<tiff::encoder::colortype::CMYK8>(3, 1, &inks);
    assert_eq!(decoded(&bytes).into_rgb8().as_slice(), [255, 255, 255, 0, 255, 255, 163, 163, 163]);
}

#[test]
fn gray_conversion_matches_opencv() {
    // cv2.cvtColor(…, COLOR_RGB2GRAY) of OpenCV 5.0.
    let image = RgbU8::from_vec(4, 1, vec![255, 0, 0, 0, 255, 0, 0, 0, 255, 10, 200, 90]).unwrap();
    assert_eq!(decoded(&encode_png(image.view()).unwrap()).into_gray8().as_slice(), [76, 150, 29, 131]);
}

#[test]
fn truncated_files_are_errors() {
    for (name, bytes) in samples() {
        // Bytes after the last pixel: PNG's end chunk; none in TIFF, whose directory comes first, and EXR.
        for len in 0..bytes.len() - 16 {
            let result = decode_image(&bytes[..len], &ReadOptions::default());
            assert!(result.is_err(), "{name}: {len} of {} bytes", bytes.len());
        }
    }
}

#[test]
fn too_many_pixels_are_refused_by_the_header() {
    let limit = ReadOptions { max_pixels: 83, ..ReadOptions::default() };
    for (name, bytes) in samples() {
        let error = decode_image(&bytes, &limit).unwrap_err();
        assert!(matches!(error, FormatError::TooManyPixels { width: 12, height: 7, limit: 83 }), "{name}: {error}");
        assert!(decode_image(&bytes, &ReadOptions { max_pixels: 84, ..limit }).is_ok(), "{name}");
    }
}

#[test]
fn a_header_with_more_pixels_than_the_file_can_hold_is_refused() {
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
fn formats_are_detected_by_content_and_unsupported_ones_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    std::fs::write(&path, bmp(&ramp(4, 3))).unwrap();
    assert_eq!(read_rgb(&path).unwrap(), ramp(4, 3));
    for (bytes, word) in [
        (&b"GIF89a____________"[..], "GIF"),
        (b"RIFF\x08\0\0\0WEBPVP8 ", "WebP"),
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

/// Decoded independently: several strips with a partial last one, and alpha.
#[test]
fn a_tiff_of_several_strips_with_alpha_round_trips() {
    let image = Image::<u8, 4>::from_fn(700, 301, |x, y| [x as u8, y as u8, (x * y) as u8, (x + y) as u8]);
    let bytes = encode_tiff(image.view()).unwrap();
    let mut decoder = tiff::decoder::Decoder::new(Cursor::new(&bytes)).unwrap();
    assert_eq!(decoder.colortype().unwrap(), tiff::ColorType::RGBA(8));
    // 2800 bytes a row: 93 rows a strip.
    assert_eq!(decoder.strip_count().unwrap(), 4);
    let tiff::decoder::DecodingResult::U8(samples) = decoder.read_image().unwrap() else { panic!("other samples") };
    assert_eq!(samples, image.as_slice());
    assert!(encode_tiff(GrayU8::new(3, 0, [0]).view()).is_err());
}

/// Metadata of a JPEG are written to a TIFF and read back.
#[test]
fn a_tiff_preserves_camera_focal_length_and_color_profile() {
    let mut icc = vec![3; 300];
    icc[16..20].copy_from_slice(b"RGB ");
    // The compression tag is that of a dropped thumbnail.
    let exif = exif_block(&[
        (Tag::Make, Value::Ascii(vec![b"Testmaker".to_vec()])),
        (Tag::Orientation, Value::Short(vec![6])),
        (Tag::Compression, Value::Short(vec![6])),
        (Tag::ISOSpeed, Value::Long(vec![400])),
        (Tag::FocalLength, Value::Rational(vec![Rational { num: 50, denom: 1 }])),
        (Tag::FocalPlaneXResolution, Value::Rational(vec![Rational { num: 1, denom: 2 }])),
        // Per millimeter: the sensor is 24 mm wide.
        (Tag::FocalPlaneResolutionUnit, Value::Short(vec![4])),
    ]);
    let metadata = Metadata { exif: Some(exif), icc: Some(icc.clone()) };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tif");
    crate::write_image(&path, ramp(12, 7).view(), &metadata).unwrap();
    let read = read_image(&path).unwrap();
    assert_eq!(read.metadata.icc, Some(icc));
    assert_eq!(read.exif.camera.as_deref(), Some("Testmaker"));
    assert_eq!(read.exif.focal, Some(ExifFocal { pixels: 25.0, source: FocalSource::SensorResolution }));
    let again = exif::Reader::new().read_raw(read.metadata.exif.unwrap()).unwrap();
    let field = |tag| again.get_field(tag, exif::In::PRIMARY).map(|f| f.value.get_uint(0));
    assert_eq!(field(Tag::ISOSpeed), Some(Some(400)));
    assert_eq!([field(Tag::PixelXDimension), field(Tag::Compression)], [Some(Some(12)), None]);
    let refused = crate::write_image(folder.path().join("a.jpg"), Image::<u16, 1>::new(2, 2, [0]).view(), &metadata);
    assert!(refused.unwrap_err().to_string().contains("16 bits"));
}

#[test]
fn images_of_one_pixel_and_empty_images() {
    let one = RgbU8::new(1, 1, [9, 8, 7]);
    assert_eq!(decoded(&encode_png(one.view()).unwrap()).into_rgb8(), one);
    assert_eq!(decoded(&encode_jpeg(one.view(), 95).unwrap()).size(), (1, 1));
    assert!(encode_png(RgbU8::new(0, 4, [0; 3]).view()).is_err());
    assert!(encode_jpeg(RgbU8::new(4, 0, [0; 3]).view(), 90).is_err());
    assert!(encode_jpeg(GrayU8::new(70_000, 1, [0]).view(), 90).is_err());
}

proptest! {
    /// Any damage gives an error or an image within the limit, never a panic.
    #[test]
    fn damaged_files_never_panic(which in any::<prop::sample::Index>(), edits in prop::collection::vec((any::<u16>(), any::<u8>()), 1..6), cut in any::<u16>(), cuts in any::<bool>()) {
        let mut samples = samples();
        let which = which.index(samples.len());
        let (name, mut bytes) = samples.swap_remove(which);
        let len = bytes.len();
        for (at, value) in edits {
            bytes[usize::from(at) % len] = value;
        }
        if cuts {
            bytes.truncate(usize::from(cut) % len);
        }
        let limit = 1 << 16;
        if let Ok(file) = decode_image(&bytes, &ReadOptions { max_pixels: limit, ..ReadOptions::default() }) {
            let (w, h) = file.size();
            prop_assert!((w * h) as u64 <= limit && w * h > 0, "{}: {}×{}", name, w, h);
        }
    }

    #[test]
    fn png_and_tiff_are_lossless(w in 1usize..9, h in 1usize..9, data in prop::collection::vec(any::<u16>(), 192)) {
        let deep = Image::<u16, 3>::from_fn(w, h, |x, y| std::array::from_fn(|c| data[(y * 8 + x) * 3 + c]));
        prop_assert_eq!(decoded(&encode_png(deep.view()).unwrap()).pixels, Pixels::Rgb16(deep.clone()));
        prop_assert_eq!(decoded(&encode_tiff(deep.view()).unwrap()).pixels, Pixels::Rgb16(deep.clone()));
        let gray = deep.map(|p| [p[0]]);
        prop_assert_eq!(decoded(&encode_tiff(gray.view()).unwrap()).pixels, Pixels::Gray16(gray));
        let bytes = deep.map(|p| p.map(|v| v as u8));
        prop_assert_eq!(decoded(&encode_tiff(bytes.view()).unwrap()).into_rgb8(), bytes.clone());
        let gray = bytes.map(|p| [p[0]]);
        prop_assert_eq!(decoded(&encode_tiff(gray.view()).unwrap()).pixels, Pixels::Gray8(gray));
        let png = encode_png(bytes.view()).unwrap();
        prop_assert_eq!(decoded(&png).into_rgb8(), bytes.clone());
        // A strided view of the interior.
        if w > 2 && h > 2 {
            let window = bytes.view().crop(1, 1, w - 2, h - 2).unwrap();
            prop_assert_eq!(decoded(&encode_png(window).unwrap()).into_rgb8(), window.to_image());
        }
    }
}

/// Files of `w × h` pixels of one color, for every format.
fn plain(w: usize, h: usize) -> Vec<(&'static str, Vec<u8>)> {
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
fn hdr_of_runs(w: usize, h: usize) -> Vec<u8> {
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

/// Returns the estimated memory for reading, from the error under a limit of one byte.
fn estimated_memory(bytes: &[u8]) -> u64 {
    match decode_image(bytes, &ReadOptions { max_memory: 1, ..ReadOptions::default() }) {
        Err(FormatError::TooMuchMemory { needed, allowed: 1, .. }) => needed,
        other => panic!("{other:?}"),
    }
}

#[test]
fn memory_is_estimated_from_the_header_in_every_format() {
    let within = |max_memory| ReadOptions { max_memory, ..ReadOptions::default() };
    for (name, bytes) in plain(640, 480) {
        let needed = estimated_memory(&bytes);
        let pixels = 640 * 480;
        // At least the file and the samples, at most three copies of float samples.
        assert!(needed >= bytes.len() as u64 + 3 * pixels, "{name}: {needed}");
        assert!(needed <= bytes.len() as u64 + 3 * 12 * pixels, "{name}: {needed}");
        assert!(decode_image(&bytes, &within(needed)).is_ok(), "{name}");
        let error = decode_image(&bytes, &within(needed - 1)).unwrap_err();
        assert!(
            matches!(error, FormatError::TooMuchMemory { allowed, size: Some((640, 480)), .. } if allowed == needed - 1),
            "{name}: {error}"
        );
    }
    // Progressive JPEGs keep all coefficients.
    let files = plain(640, 480);
    let of = |name: &str| estimated_memory(&files.iter().find(|(n, _)| *n == name).unwrap().1);
    assert!(of("progressive") > of("jpeg") + 640 * 480 * 3);
}

#[test]
fn a_small_file_with_many_pixels_is_refused_quickly() {
    let start = std::time::Instant::now();
    let bytes = hdr_of_runs(16_000, 16_000);
    let limit = ReadOptions { max_memory: 1 << 30, ..ReadOptions::default() };
    let error = decode_image(&bytes, &limit).unwrap_err();
    let FormatError::TooMuchMemory { needed, size: Some((16_000, 16_000)), .. } = error else { panic!("{error}") };
    assert!(needed > 16_000 * 16_000 * 12);
    // Missing rows are an error of the file, not of memory.
    let truncated = b"#?RADIANCE\n\n-Y 16000 +X 16000\n\x80\x40\x20\x81";
    assert!(matches!(decode_image(truncated, &limit), Err(FormatError::Corrupt { .. })));
    for w in [20_000usize, 60_000] {
        let header = bmp_header(w, 8000, 24, 0, 54);
        assert!(decode_image(&header, &limit).is_err());
        assert!(decode_image(format!("P6 {w} 8000 255\n").as_bytes(), &limit).is_err());
    }
    assert!(start.elapsed().as_secs_f64() < 1.0);
}

#[test]
fn the_file_size_counts_towards_the_memory_limit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.bmp");
    std::fs::write(&path, bmp(&ramp(100, 100))).unwrap();
    let error = read_image_with(&path, &ReadOptions { max_memory: 30_000, ..ReadOptions::default() }).unwrap_err();
    assert!(matches!(error.reason, FormatError::TooMuchMemory { size: None, .. }), "{error}");
    assert!(error.to_string().contains("allow more memory"), "{error}");
    let error = read_image_with(&path, &ReadOptions { max_memory: 60_000, ..ReadOptions::default() }).unwrap_err();
    assert!(matches!(error.reason, FormatError::TooMuchMemory { size: Some((100, 100)), .. }), "{error}");
}
