//! Writes the seed corpus of each target under `seeds/`: small generated files of every kind. `cargo run --bin seeds`.

use cv_core::{
    Camera, Distortion, DistortionModel, GrayF32, Image, Keypoint, PointCloud, Pose, RgbU8, Rotation3, StereoRig,
    Vector3,
};
use cv_io::{CalibrationFormat, RigFile, npy, npz, pfm};
#[cfg(feature = "pipelines")]
use cv_pipeline::{Silent, segmentation::TrainOptions, train_segment};
use exif::{Field, In, Rational, Tag, Value, experimental::Writer};
// The crates are instrumented for coverage, and libfuzzer-sys has the counters.
use libfuzzer_sys as _;
use std::{fs, io::Cursor, path::Path};

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

fn main() -> Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("seeds");
    let mut total = 0;
    let all = [images()?, blocks()?, maps()?, arrays()?, texts()?, structured()];
    #[cfg(feature = "pipelines")]
    let all = all.into_iter().chain([models()?]);
    for (target, seeds) in all.into_iter().flatten() {
        fs::create_dir_all(folder.join(target))?;
        for (i, bytes) in seeds.iter().enumerate() {
            fs::write(folder.join(target).join(i.to_string()), bytes)?;
            total += bytes.len();
        }
    }
    println!("{total} bytes");
    Ok(())
}

/// Targets and their inputs.
type Seeds = Vec<(&'static str, Vec<Vec<u8>>)>;

fn ramp(w: usize, h: usize) -> RgbU8 {
    RgbU8::from_fn(w, h, |x, y| [(x * 20) as u8, (y * 30) as u8, (x * 7 + y * 11) as u8])
}

fn images() -> Result<Seeds> {
    let image = ramp(12, 7);
    let deep: Image<u16, 3> = image.map(|p| p.map(|v| u16::from(v) * 257));
    let gray: Image<u8, 1> = image.map(|[r, _, _]| [r]);
    let png = vec![
        cv_io::encode_png(image.view())?,
        cv_io::encode_png(deep.view())?,
        cv_io::encode_png(gray.view())?,
        png_of(png::ColorType::Indexed, png::BitDepth::Four, Some(&[9; 48]), &[0x12; 4 * 5], (8, 5))?,
        png_of(png::ColorType::GrayscaleAlpha, png::BitDepth::Eight, None, &[77; 8 * 5 * 2], (8, 5))?,
        png_of(png::ColorType::Grayscale, png::BitDepth::One, None, &[0x5a; 5], (8, 5))?,
    ];
    let mut jpeg = vec![cv_io::encode_jpeg(image.view(), 90)?, cv_io::encode_jpeg(gray.view(), 60)?];
    for (progressive, color, channels) in
        [(true, jpeg_encoder::ColorType::Rgb, 3), (false, jpeg_encoder::ColorType::Cmyk, 4)]
    {
        let mut bytes = Vec::new();
        let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 85);
        encoder.set_progressive(progressive);
        encoder.encode(&vec![120; 20 * 17 * channels], 20, 17, color)?;
        jpeg.push(bytes);
    }
    let mut webp = Vec::new();
    for color in [image_webp::ColorType::Rgb8, image_webp::ColorType::Rgba8] {
        let channels = if color == image_webp::ColorType::Rgb8 { 3 } else { 4 };
        let samples: Vec<u8> = (0..12 * 7 * channels).map(|i| (i * 5) as u8).collect();
        let mut bytes = Vec::new();
        image_webp::WebPEncoder::new(&mut bytes).encode(&samples, 12, 7, color)?;
        webp.push(bytes);
    }
    let channels = exr::prelude::SpecificChannels::rgb(|at: exr::prelude::Vec2<usize>| {
        (at.0 as f32 * 0.1, at.1 as f32 * 0.2, 0.5)
    });
    let mut light = Cursor::new(Vec::new());
    exr::prelude::WritableImage::write(&exr::prelude::Image::from_channels((12, 7), channels))
        .to_buffered(&mut light)?;
    let (w, h) = image.size();
    let mut ppm = format!("P6\n# a comment\n{w} {h}\n255\n").into_bytes();
    ppm.extend(image.as_slice());
    let pnm = vec![
        ppm,
        b"P3 2 2 255\n1 2 3 4 5 6 7 8 9 10 11 255\n".to_vec(),
        b"P1\n4 2\n1 0 1 0 0101\n".to_vec(),
        b"P4\n9 2\n\x80\x80\x7f\x00".to_vec(),
        b"P5 3 2 65535\n\0\x01\0\x02\0\x03\0\x04\0\x05\0\x06".to_vec(),
        b"P2 2 2 15 0 5 10 15".to_vec(),
    ];
    let mut flat = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 3\n".to_vec();
    flat.extend([90, 80, 70, 128].repeat(6));
    Ok(vec![
        ("png", png),
        ("jpeg", jpeg),
        ("tiff", tiffs(&image, &deep)?),
        ("webp", webp),
        ("bmp", bitmaps(&image)),
        ("pnm", pnm),
        ("exr", vec![light.into_inner()]),
        ("hdr", vec![hdr(&image), flat]),
    ])
}

fn png_of(
    color: png::ColorType,
    depth: png::BitDepth,
    palette: Option<&[u8]>,
    data: &[u8],
    (w, h): (u32, u32),
) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, w, h);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if let Some(palette) = palette {
        encoder.set_palette(palette.to_vec());
    }
    let mut writer = encoder.write_header()?;
    writer.write_image_data(data)?;
    writer.finish()?;
    Ok(bytes)
}

fn tiffs(image: &RgbU8, deep: &Image<u16, 3>) -> Result<Vec<Vec<u8>>> {
    use tiff::encoder::{Compression, TiffEncoder, colortype};
    let mut all = Vec::new();
    for compression in [Compression::Uncompressed, Compression::Lzw, Compression::Packbits] {
        let mut bytes = Cursor::new(Vec::new());
        TiffEncoder::new(&mut bytes)?.with_compression(compression).write_image::<colortype::RGB8>(
            12,
            7,
            image.as_slice(),
        )?;
        all.push(bytes.into_inner());
    }
    let mut bytes = Cursor::new(Vec::new());
    TiffEncoder::new(&mut bytes)?.write_image::<colortype::RGB16>(12, 7, deep.as_slice())?;
    all.push(bytes.into_inner());
    let mut bytes = Cursor::new(Vec::new());
    TiffEncoder::new(&mut bytes)?.write_image::<colortype::Gray32Float>(3, 2, &[0.5, 1.0, f32::NAN, 0.0, 2.0, -1.0])?;
    all.push(bytes.into_inner());
    let mut bytes = Cursor::new(Vec::new());
    TiffEncoder::new_big(&mut bytes)?.write_image::<colortype::Gray8>(3, 2, &[1, 2, 3, 4, 5, 6])?;
    all.push(bytes.into_inner());
    Ok(all)
}

fn bitmaps(image: &RgbU8) -> Vec<Vec<u8>> {
    let (w, h) = image.size();
    let header = |bits: u16, compression: u32, at: u32| {
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
    };
    let mut plain = header(24, 0, 54);
    plain.extend(vec![99; (3 * w).next_multiple_of(4) * h]);
    let mut masked = header(32, 3, 66);
    [0xff00_0000u32, 0x00ff_0000, 0x0000_ff00].iter().for_each(|mask| masked.extend(mask.to_le_bytes()));
    masked.extend(vec![99; 4 * w * h]);
    let mut palette = header(8, 0, 54 + 1024);
    palette.extend((0..1024).map(|i| i as u8));
    palette.extend(vec![9; w.next_multiple_of(4) * h]);
    vec![plain, masked, palette]
}

/// Encodes each channel of a row as one literal run.
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

fn blocks() -> Result<Seeds> {
    let rational = |num, denom| Value::Rational(vec![Rational { num, denom }]);
    let fields = [
        (Tag::Orientation, Value::Short(vec![6])),
        (Tag::FocalLength, rational(35, 10)),
        (Tag::FocalLengthIn35mmFilm, Value::Short(vec![28])),
        (Tag::FocalPlaneXResolution, rational(4000, 1)),
        (Tag::FocalPlaneResolutionUnit, Value::Short(vec![2])),
        (Tag::PixelXDimension, Value::Long(vec![8])),
        (Tag::Make, Value::Ascii(vec![b"Canon".to_vec()])),
        (Tag::Model, Value::Ascii(vec![b"Canon EOS 5D".to_vec()])),
    ];
    let mut blocks = Vec::new();
    for (few, little) in [(8, false), (8, true), (3, true)] {
        let fields: Vec<Field> = fields
            .iter()
            .take(few)
            .map(|(tag, value)| Field { tag: *tag, ifd_num: In::PRIMARY, value: value.clone() })
            .collect();
        let mut writer = Writer::new();
        fields.iter().for_each(|field| writer.push_field(field));
        let mut bytes = Cursor::new(Vec::new());
        writer.write(&mut bytes, little)?;
        blocks.push(bytes.into_inner());
    }
    Ok(vec![("exif", blocks)])
}

fn maps() -> Result<Seeds> {
    let map = GrayF32::from_fn(5, 4, |x, y| [if x == y { f32::INFINITY } else { (x * 4 + y) as f32 * 0.5 }]);
    let mut gray = Vec::new();
    pfm::encode(map.view(), &mut gray)?;
    let mut color = Vec::new();
    pfm::encode(ramp(3, 2).map(|p| p.map(f32::from)).view(), &mut color)?;
    let big = b"PF\n1 1\n1.0\n\0\0\0\0\0\0\0\0\0\0\0\0".to_vec();
    let disparities: Image<u16, 1> = Image::from_fn(6, 4, |x, y| [(x * 300 + y) as u16]);
    let png = cv_io::encode_png(disparities.view())?;
    let array = npy::encode(&npy::NpyArray::from_view(map.view()))?;
    Ok(vec![("pfm", vec![gray.clone(), color, big]), ("map", vec![gray, png, array])])
}

fn arrays() -> Result<Seeds> {
    let map = GrayF32::from_fn(5, 4, |x, y| [(x + y) as f32]);
    let keypoints = cv_io::keypoints_to_npy(&[Keypoint::new(1.0, 2.0, 0.5), Keypoint::new(3.0, 4.0, 0.25)]);
    let descriptors = cv_io::descriptors_to_npy(4, &[0.5; 8]);
    let of_map = npy::NpyArray::from_view(map.view());
    let header = |text: &str, data: &[u8]| {
        let text = format!("{text:<117}\n");
        [b"\x93NUMPY\x01\0", &(text.len() as u16).to_le_bytes()[..], text.as_bytes(), data].concat()
    };
    let npy = vec![
        npy::encode(&of_map)?,
        npy::encode(&keypoints)?,
        npy::encode(&descriptors)?,
        header("{'descr': '<i4', 'fortran_order': True, 'shape': (2, 2), }", &[1; 16]),
        header("{'descr': '>f8', 'fortran_order': False, 'shape': (2,), }", &[1; 16]),
        header("{'descr': '|u1', 'fortran_order': False, 'shape': (), }", &[1]),
    ];
    let two = [("disparity", &of_map), ("points", &keypoints)];
    Ok(vec![("npy", npy), ("npz", vec![npz::encode(&two, false)?, npz::encode(&two, true)?])])
}

fn texts() -> Result<Seeds> {
    let camera = Camera::from_focal(640, 480, 500.0);
    let lens = Distortion::new(DistortionModel::RadialTangential5, &[-0.1, 0.05, 0.001, -0.002, 0.01]);
    let bent = Camera { distortion: lens?, ..camera };
    let fish = Camera { distortion: Distortion::new(DistortionModel::Fisheye4, &[0.1, 0.02, 0.0, 0.0])?, ..camera };
    let pose = Pose::new(Rotation3::new(Vector3::new(0.01, -0.02, 0.03)), Vector3::new(-0.12, 0.001, 0.0));
    let mut cameras = vec![b"500 0 320\n0 510 240\n0 0 1\n".to_vec(), b"640 480 500 500 320 240\n".to_vec()];
    let mut rigs = Vec::new();
    for format in CalibrationFormat::all() {
        for camera in [camera, bent, fish] {
            if format.writes_cameras() {
                cameras.extend(format.camera_text(&camera, &["made for the fuzzer"]).map(String::into_bytes));
            }
            let rig = StereoRig { left: camera, right: bent, right_from_left: pose };
            if format.writes_rigs() {
                let file = RigFile { rig, unit: "m".to_owned() };
                rigs.extend(format.rig_text(&file, &[]).map(String::into_bytes));
            }
        }
    }
    let colmap = [
        "# comment\n1 PINHOLE 640 480 500 500 320 240\n2 SIMPLE_RADIAL 640 480 500 320 240 0.1\n",
        "3 OPENCV 640 480 500 510 320 240 0.1 0.01 0.001 0.002\n",
        "1 1 0 0 0 0.1 0.2 0.3 1 a.jpg\n10.5 20.5 1 30.5 40.5 -1\n2 0.7 0.7 0 0 0 0 0 1 b c.jpg\n\n",
        "1 0.5 0.25 3 255 128 0 0.4 1 0 2 0\n2 1 1 5 0 0 0 0.1\n",
    ];
    let matches = ["# x1 y1 x2 y2\n10 20 30 40\n1.5 2.5 3.5 4.5\n", "1 2 3 4 0.9\n5,6,7,8,0.5\n", "1e3 -2 nan 4\n"];
    let features = ["2 4\n10 20 1.5 0.3 1 2 3 4\n11 21 2.5 -0.3 5 6 7 255\n", "0 128\n"];
    let bytes = |texts: &[&str]| -> Vec<Vec<u8>> { texts.iter().map(|text| text.as_bytes().to_vec()).collect() };
    Ok(vec![
        ("camera", cameras),
        ("rig", rigs),
        ("colmap", bytes(&colmap).into_iter().chain(binary_model()?).collect()),
        ("matches", bytes(&matches)),
        ("features", bytes(&features)),
        ("places", bytes(&["a.jpg 1 -2.5 300\nb.jpg 0 0 0\n", "# c\nname,x,y,z\n\"b c.jpg\",0,1e3,-0 # d\n"])),
        (
            "toml",
            bytes(&[
                "threads = 2\n\n[sfm]\norder = \"sequence\"\ndistance = [\"a\", \"b\", 2.5]\n",
                "seed = 0x1f\n[depth]\nfill = false\n",
            ]),
        ),
    ])
}

/// COLMAP's three binary files: two cameras, two images, a point.
fn binary_model() -> Result<Vec<Vec<u8>>> {
    let text = std::env::temp_dir().join(format!("cv-seeds-{}", std::process::id()));
    std::fs::create_dir_all(&text)?;
    std::fs::write(
        text.join("cameras.txt"),
        "1 PINHOLE 640 480 500 500 320 240\n2 SIMPLE_RADIAL 640 480 500 320 240 0.1\n",
    )?;
    std::fs::write(
        text.join("images.txt"),
        "1 1 0 0 0 0.1 0.2 0.3 1 a.jpg\n10.5 20.5 1 30.5 40.5 -1\n2 0.7 0.7 0 0 0 0 0 2 b c.jpg\n\n",
    )?;
    std::fs::write(text.join("points3D.txt"), "1 0.5 0.25 3 255 128 0 0.4 1 0\n")?;
    cv_io::colmap::write_binary(&text, &cv_io::colmap::read(&text)?)?;
    let files = ["cameras.bin", "images.bin", "points3D.bin"].map(|name| std::fs::read(text.join(name)));
    std::fs::remove_dir_all(&text)?;
    files.into_iter().map(|file| Ok(file?)).collect()
}

#[cfg(feature = "pipelines")]
fn models() -> Result<Seeds> {
    let photo =
        RgbU8::from_fn(
            24,
            18,
            |x, y| if x / 8 == 1 { [250, (90 + y * 3) as u8, 20] } else { [40, (x * 4) as u8, 120] },
        );
    let mask = cv_core::Mask::from_fn(24, 18, |x, _| [x / 8 == 1]);
    let mut models = Vec::new();
    for components in [1, 2] {
        let options = TrainOptions { components, background_components: components, ..TrainOptions::default() };
        let model = train_segment(&[(photo.view(), mask.view())], &options, &Silent)?.trained.model;
        models.push(serde_json::to_vec(&model)?);
    }
    let options = serde_json::to_vec(&cv_pipeline::RobustOptions::homography())?;
    Ok(vec![("model", models), ("options", vec![options])])
}

/// Pseudorandom bytes, interpreted by `structured.rs`.
fn structured() -> Seeds {
    let cloud = PointCloud::colored(vec![[1.0, 2.0, 3.0]; 3], vec![[1, 2, 3]; 3]);
    let targets = [
        "estimate",
        "homography_pair",
        "relative_pose",
        "two_view",
        "depth",
        "rig_depth",
        "panorama",
        "segment",
        "match_photos",
        "board",
        "checkpoint",
    ];
    let bytes = |seed: u64| -> Vec<u8> {
        let mut v = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        let mut next = || {
            v ^= v << 13;
            v ^= v >> 7;
            v ^= v << 17;
            (v >> 32) as u8
        };
        (0..160).map(|_| next()).collect()
    };
    let mut all: Seeds = targets.iter().map(|target| (*target, (1..=12).map(bytes).collect())).collect();
    all.push(("ply", vec![bytes(20), bytes(21), vec![cloud.len() as u8; 90]]));
    all
}
