//! Bit depth, EXIF and color profiles from input to output.

use crate::support::{done, fixture, json};
use cv_core::{Image, RgbU8};
use cv_io::{DynImage, Pixels, read_image};
use std::{fs, path::Path};

/// Returns a little-endian EXIF block: maker, orientation and a comment; then a thumbnail.
fn exif(orientation: u8) -> Vec<u8> {
    let entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &count.to_le_bytes(), &value].concat()
    };
    // Two directories of 2 entries each: 2 + 2·12 + 4 bytes.
    let (maker, thumbnail) = (8 + 2 * 30, 8 + 2 * 30 + 12);
    let mut block = b"II*\0\x08\0\0\0".to_vec();
    block.extend(2u16.to_le_bytes());
    block.extend(entry(0x010f, 2, 10, u32::to_le_bytes(maker)));
    block.extend(entry(0x0112, 3, 1, [orientation, 0, 0, 0]));
    block.extend(38u32.to_le_bytes());
    block.extend(2u16.to_le_bytes());
    block.extend(entry(0x0201, 4, 1, u32::to_le_bytes(thumbnail)));
    block.extend(entry(0x0202, 4, 1, 9u32.to_le_bytes()));
    block.extend(0u32.to_le_bytes());
    block.extend(b"Testmaker\0\0\0");
    block.extend(b"THUMBNAIL");
    block
}

/// Returns a minimal color profile: a header of an RGB profile with `id`.
fn profile(id: u8) -> Vec<u8> {
    let mut profile = vec![id; 200];
    profile[16..20].copy_from_slice(b"RGB ");
    profile
}

fn write_jpeg(path: &Path, image: &RgbU8, orientation: u8, icc: u8) {
    let mut bytes = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 95);
    encoder.add_app_segment(1, [b"Exif\0\0", &exif(orientation)[..]].concat()).unwrap();
    encoder.add_icc_profile(&profile(icc)).unwrap();
    let (width, height) = (image.width() as u16, image.height() as u16);
    encoder.encode(image.as_slice(), width, height, jpeg_encoder::ColorType::Rgb).unwrap();
    fs::write(path, bytes).unwrap();
}

fn write_deep_png(path: &Path, image: &Image<u16, 3>) {
    let mut info = png::Info::with_size(image.width() as u32, image.height() as u32);
    info.exif_metadata = Some(exif(1).into());
    info.icc_profile = Some(profile(7).into());
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::with_info(&mut bytes, info).unwrap();
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Sixteen);
    let samples: Vec<u8> = image.as_slice().iter().flat_map(|v| v.to_be_bytes()).collect();
    encoder.write_header().unwrap().write_image_data(&samples).unwrap();
    fs::write(path, bytes).unwrap();
}

/// The EXIF of a result is that of the original without orientation and thumbnail, and has the result's size.
fn check_exif(path: &Path) -> DynImage {
    let image = read_image(path).unwrap();
    assert_eq!((image.exif.camera.as_deref(), image.exif.orientation), (Some("Testmaker"), 1), "{}", path.display());
    let block = image.metadata.exif.clone().unwrap();
    assert!(!block.windows(9).any(|bytes| bytes == b"THUMBNAIL"), "{}", path.display());
    let side = |tag: u16| {
        let entry = [&tag.to_le_bytes()[..], &[4, 0, 1, 0, 0, 0]].concat();
        let at = block.windows(8).position(|bytes| bytes == entry).unwrap() + 8;
        u32::from_le_bytes(block[at..at + 4].try_into().unwrap()) as usize
    };
    assert_eq!((side(0xa002), side(0xa003)), image.size(), "{}", path.display());
    image
}

const RIG: &str = "schema: cv-rig/1\nunit: m\n\
    left: {width: 200, height: 150, fx: 150, fy: 150, cx: 99.5, cy: 74.5, distortion: radial, coefficients: [-0.1, 0.01]}\n\
    right: {width: 200, height: 150, fx: 150, fy: 150, cx: 99.5, cy: 74.5, distortion: radial, coefficients: [-0.1, 0.01]}\n\
    rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\ntranslation: [-0.12, 0, 0]\n";

const CAMERA: &str = "schema: cv-camera/1\nwidth: 200\nheight: 150\nfx: 150\nfy: 150\ncx: 99.5\ncy: 74.5\n\
    distortion: radial\ncoefficients: [-0.1, 0.01]\n";

#[test]
fn bit_depth_and_metadata_are_preserved() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::write(at("rig.yaml"), RIG).unwrap();
    // A ramp of small steps: bytes have one value in 257.
    let deep = Image::<u16, 3>::from_fn(200, 150, |x, y| [20_000 + (x * 13 + y * 7) as u16, 30_000 + x as u16, 40_000]);
    for name in ["a.png", "b.png"] {
        write_deep_png(&at(name), &deep);
    }
    done(folder.path(), &["rectify", "a.png", "b.png", "--rig", "rig.yaml", "-o", "out"]);
    for name in ["out/left.png", "out/right.png"] {
        let image = check_exif(&at(name));
        assert_eq!(image.metadata.icc, Some(profile(7)));
        let Pixels::Rgb16(image) = image.pixels else { panic!("16 bits") };
        // The distortion displaces the ramp by a few pixels; interpolation on a ramp is exact up to rounding.
        let [red, green, blue] = image.at(100, 75);
        assert!(red.abs_diff(20_000 + 100 * 13 + 75 * 7) < 20 && green.abs_diff(30_100) < 2 && blue == 40_000);
        let steps = image.row(75).chunks_exact(3).map(|p| p[0]).collect::<std::collections::BTreeSet<_>>();
        assert!(steps.len() > 150, "{} values in a row", steps.len());
    }
    // The output format is that of the input.
    let metadata = read_image(at("a.png")).unwrap().metadata;
    cv_io::write_image(at("deep.tif"), deep.view(), &metadata).unwrap();
    fs::write(at("camera.yaml"), CAMERA).unwrap();
    done(folder.path(), &["undistort", "deep.tif", "--camera", "camera.yaml", "-o", "straight"]);
    let image = check_exif(&at("straight/deep.tif"));
    assert!(matches!(image.pixels, Pixels::Rgb16(_)) && image.metadata.icc == Some(profile(7)));
    // 8-bit images stay 8-bit; the orientation is applied once.
    let bytes = RgbU8::from_fn(150, 200, |x, y| [x as u8, y as u8, 90]);
    for name in ["a.jpg", "b.jpg"] {
        write_jpeg(&at(name), &bytes, 6, 9);
    }
    done(folder.path(), &["rectify", "a.jpg", "b.jpg", "--rig", "rig.yaml", "-o", "out"]);
    let image = check_exif(&at("out/left.png"));
    assert!(matches!(image.pixels, Pixels::Rgb8(_)) && image.metadata.icc == Some(profile(9)));
}

#[test]
fn a_panorama_has_the_exif_of_one_photograph_and_the_profile_of_all() {
    let folder = tempfile::tempdir().unwrap();
    let views = ["panorama/view0.jpg", "panorama/view1.jpg"].map(|name| cv_io::read_rgb(fixture(name)).unwrap());
    for (profiles, kept) in [([3, 3], Some(profile(3))), ([3, 4], None)] {
        for (i, view) in views.iter().enumerate() {
            write_jpeg(&folder.path().join(format!("in{i}.jpg")), view, 1, profiles[i]);
        }
        for output in ["pano.jpg", "pano.png", "pano.tif"] {
            done(folder.path(), &["panorama", "in0.jpg", "in1.jpg", "-o", output]);
            assert_eq!(check_exif(&folder.path().join(output)).metadata.icc, kept, "{output}");
        }
    }
}

#[test]
fn a_16_bit_panorama_has_16_bits_and_the_metadata_of_its_photographs() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    // A ramp over two 8-bit levels is lost if an intermediate image has 8 bits.
    let deepened = |v: u8, x: usize| 257 * u16::from(v).min(240) + 2 * x as u16;
    for i in 0..2 {
        let view = cv_io::read_rgb(fixture(&format!("panorama/view{i}.jpg"))).unwrap();
        let deep = Image::<u16, 3>::from_fn(view.width(), view.height(), |x, y| view.at(x, y).map(|v| deepened(v, x)));
        write_deep_png(&at(&format!("deep{i}.png")), &deep);
        cv_io::write_png(
            at(&format!("bytes{i}.png")),
            deep.map(|p| p.map(|v| ((u32::from(v) + 128) / 257) as u8)).view(),
        )
        .unwrap();
    }
    done(folder.path(), &["panorama", "bytes0.png", "bytes1.png", "-o", "bytes.png", "--exposure", "none"]);
    done(folder.path(), &["panorama", "deep0.png", "deep1.png", "-o", "deep.jpg", "--exposure", "none"]);
    let Pixels::Rgb8(bytes) = read_image(at("bytes.png")).unwrap().pixels else { panic!("8 bits") };
    for (photos, output) in [
        (["deep0.png", "deep1.png"], "pano.png"),
        (["deep0.png", "deep1.png"], "pano.tif"),
        (["bytes0.png", "deep1.png"], "mixed.tif"),
    ] {
        let value = json(folder.path(), &["panorama", photos[0], photos[1], "-o", output, "--exposure", "none"]);
        assert_eq!(value["bits"], 16);
        let image = if output == "mixed.tif" { read_image(at(output)).unwrap() } else { check_exif(&at(output)) };
        // The reference photograph of the mixed set has no profile.
        assert_eq!(image.metadata.icc, (output != "mixed.tif").then(|| profile(7)), "{output}");
        let Pixels::Rgb16(image) = image.pixels else { panic!("16 bits") };
        assert_eq!(image.size(), bytes.size());
        let pairs = || image.as_slice().iter().zip(bytes.as_slice());
        // Rounding to bytes changes at most one level, except where features or a seam differ.
        let far = pairs().filter(|(deep, byte)| (f64::from(**deep) / 257.0 - f64::from(**byte)).abs() > 1.5).count();
        assert!(far * 500 < bytes.as_slice().len(), "{output}: {far}");
        // Values of 8-bit images are multiples of 257: by chance one sample in 257.
        let coarse = image.as_slice().iter().filter(|v| **v > 0 && **v % 257 == 0).count();
        assert!(output == "mixed.tif" || coarse * 50 < bytes.as_slice().len(), "{output}: {coarse}");
    }
    let Pixels::Rgb8(jpeg) = check_exif(&at("deep.jpg")).pixels else { panic!("8 bits") };
    assert_eq!(jpeg.size(), bytes.size());
    done(folder.path(), &["panorama", "deep0.png", "deep1.png", "-o", "clear.png", "--alpha", "--scale", "0.5"]);
    let file = fs::File::open(at("clear.png")).unwrap();
    let reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().unwrap();
    assert_eq!(reader.output_color_type(), (png::ColorType::Rgba, png::BitDepth::Sixteen));
}
