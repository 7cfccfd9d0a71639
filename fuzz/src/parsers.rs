//! Fuzzes the readers of `cv-io` with the bytes or text of a file.

use crate::keep_if;
use arbitrary::Arbitrary;
use cv_core::{PointCloud, RgbU8};
use cv_io::{CalibrationFormat, DynImage, Pixels, ReadOptions, npy, npz, pfm, ply};
use libfuzzer_sys::Corpus;

/// Limits that allow thousands of images per second.
const OPTIONS: ReadOptions = ReadOptions { max_pixels: 1 << 18, max_memory: 32 << 20 };

/// Fuzzes the decoder of an image format.
pub fn image(format: &str, bytes: &[u8]) -> Corpus {
    let magic = match format {
        "png" => bytes.starts_with(b"\x89PNG\r\n\x1a\n"),
        "jpeg" => bytes.starts_with(b"\xff\xd8\xff"),
        "tiff" => bytes.starts_with(b"II") || bytes.starts_with(b"MM"),
        "bmp" => bytes.starts_with(b"BM"),
        "pnm" => bytes.first() == Some(&b'P'),
        "exr" => bytes.starts_with(b"\x76\x2f\x31\x01"),
        "hdr" => bytes.starts_with(b"#?"),
        "webp" => bytes.starts_with(b"RIFF"),
        _ => true,
    };
    if magic && let Ok(image) = cv_io::decode_image(bytes, &OPTIONS) {
        check_image(&image);
        assert_round_trip(image);
    }
    keep_if(magic)
}

fn check_image(image: &DynImage) {
    let (w, h) = image.size();
    assert!(w > 0 && h > 0 && (w * h) as u64 <= OPTIONS.max_pixels, "{w}×{h}");
    let focal = image.exif.focal.map(|focal| focal.pixels);
    assert!(focal.is_none_or(|px| px.is_finite() && px > 0.0), "{focal:?}");
}

/// Asserts that a decoded image survives encoding to PNG.
fn assert_round_trip(image: DynImage) {
    let (w, h) = image.size();
    if w * h <= 1 << 10 {
        let written = match &image.pixels {
            Pixels::Gray16(deep) => cv_io::encode_png(deep.view()),
            Pixels::Rgb16(deep) => cv_io::encode_png(deep.view()),
            _ => cv_io::encode_png(image.clone().into_rgb8().view()),
        };
        let again = cv_io::decode_image(&written.expect("a decoded image can be encoded"), &OPTIONS)
            .expect("an encoded image can be decoded");
        assert!(again.into_rgb8() == image.clone().into_rgb8(), "the round trip changed the image");
    }
    assert!(image.into_gray8().size() == (w, h));
}

/// Fuzzes an EXIF block in a JPEG and in a PNG.
pub fn exif(block: &[u8]) -> Corpus {
    if block.len() > 60_000 {
        return Corpus::Reject;
    }
    let image = RgbU8::new(8, 6, [90, 120, 30]);
    let jpeg = cv_io::encode_jpeg(image.view(), 80).expect("a small image");
    let length = (block.len() + 8) as u16;
    let segment = [&[0xff, 0xe1], &length.to_be_bytes()[..], b"Exif\0\0", block].concat();
    let mut info = png::Info::with_size(8, 6);
    info.exif_metadata = Some(block.to_vec().into());
    let mut png = Vec::new();
    let mut encoder = png::Encoder::with_info(&mut png, info).expect("a size");
    encoder.set_color(png::ColorType::Rgb);
    let mut writer = encoder.write_header().expect("in memory");
    writer.write_image_data(image.as_slice()).expect("in memory");
    writer.finish().expect("in memory");
    for bytes in [[&jpeg[..2], &segment, &jpeg[2..]].concat(), png] {
        // Invalid metadata must not prevent the decoding of the pixels.
        check_image(&cv_io::decode_image(&bytes, &OPTIONS).expect("a valid image"));
    }
    Corpus::Keep
}

/// Fuzzes the reader of float maps in any format, with and without a scale.
pub fn map(bytes: &[u8]) -> Corpus {
    for scale in [None, Some(4.0)] {
        if let Ok(map) = cv_io::decode_map(bytes, scale) {
            assert_eq!(map.width() * map.height(), map.as_slice().len());
        }
    }
    Corpus::Keep
}

pub fn pfm_map(bytes: &[u8]) -> Corpus {
    if let Ok(pfm::Pfm::Gray(map)) = pfm::decode_with(bytes, &OPTIONS) {
        let mut again = Vec::new();
        pfm::encode(map.view(), &mut again).expect("in memory");
        let Ok(pfm::Pfm::Gray(read)) = pfm::decode(&again) else { panic!("a written map cannot be read") };
        let same = |(a, b): (&f32, &f32)| a == b || (a.is_nan() && b.is_nan());
        assert!(map.as_slice().iter().zip(read.as_slice()).all(same));
    }
    keep_if(bytes.starts_with(b"P"))
}

pub fn npy_array(bytes: &[u8]) -> Corpus {
    if let Ok(array) = npy::decode_with(bytes, &OPTIONS) {
        let again = npy::encode(&array).expect("a decoded array can be encoded");
        assert_eq!(npy::encode(&npy::decode(&again).expect("an encoded array can be decoded")).ok(), Some(again));
        let _ = (array.to_gray(), cv_io::keypoints_from_npy(&array), cv_io::descriptors_from_npy(&array));
    }
    keep_if(bytes.starts_with(b"\x93NUMPY"))
}

pub fn npz_arrays(bytes: &[u8]) -> Corpus {
    let _ = npz::decode_single(bytes, &OPTIONS);
    if let Ok(arrays) = npz::decode_with(bytes, &OPTIONS) {
        let arrays: Vec<_> = arrays.iter().map(|(name, array)| (name.as_str(), array)).collect();
        if let Ok(again) = npz::encode(&arrays, true) {
            assert_eq!(npz::decode(&again).expect("an encoded archive can be decoded").len(), arrays.len());
        }
    }
    keep_if(bytes.starts_with(b"PK"))
}

/// Fuzzes the PLY writer with any cloud; asserts that the header's counts are those of the data.
pub fn ply_cloud(bytes: &[u8]) -> Corpus {
    let mut input = arbitrary::Unstructured::new(bytes);
    let Ok((positions, colors, normals, edges)) = Arbitrary::arbitrary(&mut input) else { return Corpus::Reject };
    let cloud = PointCloud { positions, colors, normals, edges };
    for encoding in [ply::PlyEncoding::Ascii, ply::PlyEncoding::Binary] {
        let mut file = Vec::new();
        if ply::encode(&cloud, encoding, &mut file).is_ok() {
            let end = file.windows(11).position(|w| w == b"end_header\n").expect("a header") + 11;
            let header = String::from_utf8_lossy(&file[..end]);
            assert!(header.contains(&format!("element vertex {}\n", cloud.len())), "{header}");
            if encoding == ply::PlyEncoding::Ascii {
                let lines = file[end..].iter().filter(|b| **b == b'\n').count();
                assert_eq!(lines, cloud.len() + cloud.edges.len());
            }
        }
    }
    Corpus::Keep
}

/// Fuzzes the reader of cameras in every format; asserts that a parsed camera round-trips through each.
pub fn camera(bytes: &[u8]) -> Corpus {
    let Ok(text) = std::str::from_utf8(bytes) else { return Corpus::Reject };
    for size in [None, Some((640, 480))] {
        let Ok(camera) = cv_io::parse_camera(text, size) else { continue };
        camera.validate().expect("a parsed camera is valid");
        for format in CalibrationFormat::all().filter(|format| format.writes_cameras()) {
            let Ok(written) = format.camera_text(&camera, &[]) else { continue };
            let again = cv_io::parse_camera(&written, Some((camera.width, camera.height)));
            assert!(again.is_ok(), "{}: {again:?}\n{written}", format.name());
        }
    }
    Corpus::Keep
}

pub fn rig(bytes: &[u8]) -> Corpus {
    let Ok(text) = std::str::from_utf8(bytes) else { return Corpus::Reject };
    for size in [None, Some((640, 480))] {
        let Ok(file) = cv_io::parse_rig(text, size) else { continue };
        for format in CalibrationFormat::all().filter(|format| format.writes_rigs()) {
            let Ok(written) = format.rig_text(&file, &[]) else { continue };
            let again = cv_io::parse_rig(&written, Some((file.rig.left.width, file.rig.left.height)));
            assert!(again.is_ok(), "{}: {again:?}\n{written}", format.name());
        }
    }
    Corpus::Keep
}

/// Fuzzes the reader of rigs of two or more cameras: `schema: cv-rig/2`, and Kalibr's chains.
pub fn camera_array(bytes: &[u8]) -> Corpus {
    let Ok(text) = std::str::from_utf8(bytes) else { return Corpus::Reject };
    let Ok(file) = cv_io::parse_camera_array(text) else { return Corpus::Keep };
    for format in CalibrationFormat::all().filter(|format| format.writes_arrays()) {
        let Ok(written) = format.array_text(&file, &[]) else { continue };
        let again = cv_io::parse_camera_array(&written);
        assert!(
            again.as_ref().is_ok_and(|again| again.cameras.len() == file.cameras.len()),
            "{}: {again:?}\n{written}",
            format.name()
        );
    }
    Corpus::Keep
}

/// Fuzzes the readers of the three files of a COLMAP model, binary and text.
pub fn colmap(bytes: &[u8]) -> Corpus {
    use cv_io::colmap::{parse_cameras_binary, parse_images_binary, parse_points_binary};
    let binary =
        [parse_cameras_binary(bytes).is_ok(), parse_images_binary(bytes).is_ok(), parse_points_binary(bytes).is_ok()];
    if binary.contains(&true) {
        return Corpus::Keep;
    }
    let Ok(text) = std::str::from_utf8(bytes) else { return Corpus::Reject };
    let _ = cv_io::colmap::parse_cameras(text);
    let _ = cv_io::colmap::parse_images(text);
    let _ = cv_io::colmap::parse_points(text);
    Corpus::Keep
}

pub fn matches(bytes: &[u8]) -> Corpus {
    let Ok(text) = std::str::from_utf8(bytes) else { return Corpus::Reject };
    if let Ok(matches) = cv_io::parse_matches(text) {
        assert!(matches.scores.as_ref().is_none_or(|scores| scores.len() == matches.pairs.len()));
    }
    Corpus::Keep
}

pub fn features(bytes: &[u8]) -> Corpus {
    let Ok(text) = std::str::from_utf8(bytes) else { return Corpus::Reject };
    let _ = cv_io::parse_colmap_features(text);
    Corpus::Keep
}

pub fn places(bytes: &[u8]) -> Corpus {
    let Ok(text) = std::str::from_utf8(bytes) else { return Corpus::Reject };
    if let Ok(places) = cv_io::parse_camera_positions(text) {
        assert!(places.iter().all(|(_, place)| place.coords.iter().all(|v| v.is_finite())));
        let names: std::collections::HashSet<&String> = places.iter().map(|(name, _)| name).collect();
        assert!(!places.is_empty() && names.len() == places.len());
    }
    Corpus::Keep
}
