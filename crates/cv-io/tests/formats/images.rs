//! Image files of every format.

use std::io::Cursor;

use cv_core::{GrayF32, GrayU8, Image, RgbF32, RgbU8};
use cv_io::{
    DynImage, ExifInfo, FormatError, Metadata, Pixels, ReadOptions, decode_image, encode_jpeg, encode_png, encode_tiff,
    read_rgb,
};
use proptest::prelude::*;

#[cfg(feature = "exr")]
use crate::samples::exr;
#[cfg(feature = "tiff")]
use crate::samples::{big_tiff, tiff};
use crate::samples::{bmp, bmp_header, bmp_masked, cmyk, decoded, gray_alpha, hdr, ppm, ppm_text, ramp, samples};

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
        #[cfg(feature = "tiff")]
        big_tiff(&image),
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
    fn damaged_files_never_panic(
        which in any::<prop::sample::Index>(),
        edits in prop::collection::vec((any::<u16>(), any::<u8>()), 1..6),
        cut in any::<u16>(),
        cuts in any::<bool>(),
    ) {
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
