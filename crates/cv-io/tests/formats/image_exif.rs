//! EXIF data of image files.

use cv_core::{Image, RgbU8};
use cv_io::{ExifFocal, FocalSource, Metadata, read_image, read_image_info};
use exif::{Rational, Tag, Value};

use crate::samples::{decoded, exif_block, jpeg_with_exif, png_with_exif, ramp};

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
    cv_io::write_image(&path, ramp(12, 7).view(), &metadata).unwrap();
    let read = read_image(&path).unwrap();
    assert_eq!(read.metadata.icc, Some(icc));
    assert_eq!(read.exif.camera.as_deref(), Some("Testmaker"));
    assert_eq!(read.exif.focal, Some(ExifFocal { pixels: 25.0, source: FocalSource::SensorResolution }));
    let again = exif::Reader::new().read_raw(read.metadata.exif.unwrap()).unwrap();
    let field = |tag| again.get_field(tag, exif::In::PRIMARY).map(|f| f.value.get_uint(0));
    assert_eq!(field(Tag::ISOSpeed), Some(Some(400)));
    assert_eq!([field(Tag::PixelXDimension), field(Tag::Compression)], [Some(Some(12)), None]);
    let refused = cv_io::write_image(folder.path().join("a.jpg"), Image::<u16, 1>::new(2, 2, [0]).view(), &metadata);
    assert!(refused.unwrap_err().to_string().contains("16 bits"));
}
