//! Commands on small inputs: every command with every kind of input file.

use anyhow::{Context, Result};
use cv_core::{Camera, Distortion, DistortionModel, GrayF32, Image, Mask, Pose, RgbU8, Rotation3, StereoRig, Vector3};
use cv_imgproc::resize_area;
use cv_io::{ArrayCamera, CalibrationFormat, CameraArray, Metadata, RigFile, npy, npz, pfm};
use cv_synth::{RenderOptions, Sheet, Texture};
use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

/// A command.
pub(crate) struct Case {
    /// Name in messages.
    pub(crate) name: &'static str,
    /// Arguments; inputs are in `in/`, outputs in `out/`.
    pub(crate) args: &'static str,
    /// Files in `in/` that are damaged.
    pub(crate) inputs: &'static [&'static str],
}

impl Case {
    pub(crate) fn args(&self) -> impl Iterator<Item = &'static str> {
        self.args.split_whitespace()
    }

    /// Returns the outputs that are single files.
    pub(crate) fn files(&self) -> impl Iterator<Item = &'static str> {
        self.args().filter(|word| word.starts_with("out/") && Path::new(word).extension().is_some())
    }
}

const fn case(name: &'static str, args: &'static str, inputs: &'static [&'static str]) -> Case {
    Case { name, args, inputs }
}

/// All cases. An argument that begins with `out/` and has an extension is an output file.
pub(crate) const CASES: &[Case] = &[
    case(
        "depth",
        "depth in/left.jpg in/right.png -o out/d.pfm --disparities 32 --focal 100 --baseline 0.1 --depth out/z.npy --cloud out/c.ply",
        &["left.jpg", "right.png"],
    ),
    case(
        "depth, 16 bits",
        "depth in/left16.png in/right.ppm -o out/d.png --disparities 32 --confidence out/sure.png",
        &["left16.png", "right.ppm"],
    ),
    case(
        "depth by rig",
        "depth in/left.jpg in/right.png --rig in/rig.yaml -o out/d.npy --cloud out/c.ply --disparities 32",
        &["rig.yaml"],
    ),
    case(
        "rectify, OpenCV",
        "rectify in/left.jpg in/right.png --rig in/opencv.yml -o out/rectified",
        &["opencv.yml", "left.jpg"],
    ),
    case("rectify, Kalibr", "rectify in/left.jpg in/right.png --rig in/kalibr.yaml -o out/rectified", &["kalibr.yaml"]),
    case("undistort", "undistort in/left.jpg --camera in/lens.yaml -o out/straight", &["left.jpg", "lens.yaml"]),
    case("calibration of a rig", "calibration convert in/rig.yaml -o out/rig.yml --format opencv", &["rig.yaml"]),
    case(
        "calibration of three cameras",
        "calibration convert in/three.yaml -o out/c.yaml --format kalibr",
        &["three.yaml"],
    ),
    case("board", "board -o out/b.pdf --board 9x6 --square 20", &[]),
    case("board, PNG", "board -o out/b.png --kind aprilgrid --board 4x3 --marker 30 --dpi 60", &[]),
    case(
        "calibrate mono",
        "calibrate mono --board 7x5 --square 30 in/board1.png in/board2.png in/board3.png in/board4.png -o out/camera.yaml",
        &["board1.png", "board2.png"],
    ),
    case(
        "calibrate stereo",
        "calibrate stereo --board 7x5 --left in/board1.png in/board2.png in/board3.png --right in/board1.png in/board2.png in/board3.png -o out/rig.yaml",
        &["board3.png"],
    ),
    case("match", "match in/a.jpg in/b.jpg -o out/m.txt --save-features out/features", &["a.jpg", "b.jpg"]),
    case(
        "match of stored features",
        "match in/a.jpg in/b.jpg --load-features in/arrays -o out/m.txt",
        &["arrays/a.keypoints.npy", "arrays/a.rootsift.npy", "arrays/b.keypoints.npy", "arrays/b.rootsift.npy"],
    ),
    case(
        "match of COLMAP's features",
        "match in/a.jpg in/b.jpg --load-features in/texts -o out/m.txt",
        &["texts/a.txt", "texts/b.txt"],
    ),
    case("match by a file of options", "match in/a.jpg in/b.jpg -o out/m.txt --config in/cv.toml", &["cv.toml"]),
    case("homography", "estimate homography --matches in/m.txt --json", &["m.txt"]),
    case("fundamental matrix", "estimate fundamental --matches in/m.txt --report out", &["m.txt"]),
    case("essential matrix, ROS", "estimate essential --matches in/m.txt --camera in/ros.yaml", &["ros.yaml", "m.txt"]),
    case("essential matrix, COLMAP", "estimate essential --matches in/m.txt --camera in/cameras.txt", &["cameras.txt"]),
    case(
        "essential matrix, matrix",
        "estimate essential --matches in/m.txt --camera in/K.txt --size 480x360",
        &["K.txt"],
    ),
    case(
        "reconstruct",
        "reconstruct in/a.jpg in/b.jpg --focal 490 -o out/c.ply --colmap out/model --report out",
        &["a.jpg", "b.jpg"],
    ),
    case("reconstruct by camera", "reconstruct in/a.jpg in/b.jpg --camera in/cam.yaml -o out/c.ply", &["cam.yaml"]),
    case(
        "sfm",
        "sfm in/a.jpg in/c.jpg --focal 490 --features 2000 --distance a.jpg c.jpg 1 -o out/sparse --cloud out/c.ply --covariance out/s.json",
        &["a.jpg", "c.jpg"],
    ),
    case(
        "sfm from a model",
        "sfm in/a.jpg in/c.jpg --from in/sparse --features 2000 -o out/sparse",
        &["sparse/cameras.txt", "sparse/images.txt"],
    ),
    case("panorama", "panorama in/1.jpg in/2.jpg -o out/p.png --report out", &["1.jpg", "2.jpg"]),
    case("panorama by camera", "panorama in/1.jpg in/2.jpg -o out/p.jpg --camera in/wide.yaml", &["wide.yaml"]),
    case(
        "segment train",
        "segment train --images in/ball1.jpg in/ball2.jpg --masks in/masks -o out/m.json",
        &["ball1.jpg", "masks/ball1.png"],
    ),
    case(
        "segment predict",
        "segment predict --model in/model.json in/ball2.jpg -o out/found",
        &["model.json", "ball2.jpg"],
    ),
    case(
        "segment eval",
        "segment eval --model in/model.json --images in/ball2.jpg --masks in/masks --json",
        &["model.json", "masks/ball2.png"],
    ),
    case("eval, PFM", "eval disparity --estimate in/d.pfm --truth in/t.npy -o out/e.png", &["d.pfm", "t.npy"]),
    case("eval, npz", "eval disparity --estimate in/d.npz --truth in/t.npy", &["d.npz"]),
    case(
        "eval, KITTI",
        "eval disparity --estimate in/kitti.png --truth in/t.npy --mask in/seen.png",
        &["kitti.png", "seen.png"],
    ),
    case("BMP", "segment predict --model in/model.json in/seed.bmp -o out/found", &["seed.bmp"]),
    case("TIFF", "segment predict --model in/model.json in/seed.tiff -o out/found", &["seed.tiff"]),
    case("WebP", "segment predict --model in/model.json in/seed.webp -o out/found", &["seed.webp"]),
    case("HDR", "segment predict --model in/model.json in/seed.hdr -o out/found", &["seed.hdr"]),
];

/// Creates a folder `in` with the commands' inputs and an empty folder `out`. Photographs are from the real data if it exists, else from `fixtures/`.
pub(crate) fn prepare(folder: &Path, program: &Path) -> Result<()> {
    for name in ["in/masks", "in/arrays", "in/texts", "out"] {
        fs::create_dir_all(folder.join(name))?;
    }
    let to = folder.join("in");
    let real = crate::data_dir();
    println!("photographs: {}", if real.is_some() { "real ones, reduced" } else { "those of fixtures/, reduced" });
    let pick = |of_data: &str, of_fixtures: &str| -> PathBuf {
        real.as_ref()
            .map(|data| data.join(of_data))
            .filter(|path| path.is_file())
            .unwrap_or_else(|| crate::root().join("fixtures").join(of_fixtures))
    };

    let (left, _) = read_reduced(&pick("stereo/cones/im2.png", "stereo/left.jpg"), 150)?;
    let (right, _) = read_reduced(&pick("stereo/cones/im6.png", "stereo/right.jpg"), 150)?;
    cv_io::write_jpeg(to.join("left.jpg"), left.view())?;
    cv_io::write_png(to.join("right.png"), right.view())?;
    let deep: Image<u16, 3> = left.map(|p| p.map(|v| u16::from(v) * 257));
    cv_io::write_png(to.join("left16.png"), deep.view())?;
    fs::write(
        to.join("right.ppm"),
        [format!("P6\n{} {}\n255\n", right.width(), right.height()).as_bytes(), right.as_slice()].concat(),
    )?;
    rigs(&to, left.size())?;
    boards(&to)?;

    for (name, of_data, of_fixtures, width) in [
        ("a", "sfm/sceaux/100_7101.JPG", "two-view/a.jpg", 480),
        ("b", "sfm/sceaux/100_7102.JPG", "two-view/b.jpg", 480),
        // A larger baseline, so that two photographs suffice for a model.
        ("c", "sfm/sceaux/100_7103.JPG", "two-view/b.jpg", 480),
        ("1", "panorama/weir/weir_1.jpg", "panorama/view0.jpg", 240),
        ("2", "panorama/weir/weir_2.jpg", "panorama/view1.jpg", 240),
        ("ball1", "segmentation/orange-ball/train/106.jpg", "ball/ball1.jpg", 120),
        ("ball2", "segmentation/orange-ball/train/121.jpg", "ball/ball2.jpg", 120),
    ] {
        let (photo, metadata) = read_reduced(&pick(of_data, of_fixtures), width)?;
        cv_io::write_image(to.join(format!("{name}.jpg")), photo.view(), &metadata)?;
    }
    for (name, of_data, of_fixtures) in [
        ("ball1", "segmentation/orange-ball/train/106_mask.png", "oracle/ball-masks/ball1_mask.png"),
        ("ball2", "segmentation/orange-ball/train/121_mask.png", "oracle/ball-masks/ball2_mask.png"),
    ] {
        let (mask, _) = read_reduced(&pick(of_data, of_fixtures), 120)?;
        let mask: Mask = mask.map(|[r, _, _]| [r > 127]);
        cv_io::write_png(to.join(format!("masks/{name}.png")), mask.view())?;
    }
    cameras(&to, folder)?;
    maps(&to)?;
    fs::write(
        to.join("cv.toml"),
        "quiet = true\nseed = 7\n[match]\nratio = 0.7\nfeatures = \"mops\"\nmax-features = 400\n",
    )?;
    for format in ["bmp", "tiff", "webp", "hdr"] {
        fs::copy(crate::root().join(format!("fuzz/seeds/{format}/0")), to.join(format!("seed.{format}")))?;
    }

    // Inputs that are outputs of other commands.
    let run = |args: &str| -> Result<()> {
        let output = Command::new(program).current_dir(folder).args(args.split_whitespace()).output()?;
        anyhow::ensure!(output.status.success(), "cv {args}: {}", String::from_utf8_lossy(&output.stderr));
        Ok(())
    };
    run("match in/a.jpg in/b.jpg -o in/m.txt --save-features in/arrays")?;
    run("sfm in/a.jpg in/c.jpg --focal 490 --features 2000 -o in/sparse")?;
    for name in ["a", "b"] {
        fs::rename(to.join(format!("arrays/{name}.txt")), to.join(format!("texts/{name}.txt")))?;
    }
    run(
        "segment train --images in/ball1.jpg --masks in/masks -o in/model.json --components 2 --background-components 3",
    )
}

/// Reads a photograph, reduced to a width, with its metadata.
fn read_reduced(path: &Path, width: usize) -> Result<(RgbU8, Metadata)> {
    let photo = cv_io::read_image(path).with_context(|| path.display().to_string())?;
    let metadata = photo.metadata.clone();
    let photo = photo.into_rgb8();
    let height = (photo.height() * width).div_ceil(photo.width());
    Ok((resize_area(photo.view(), width, height)?, metadata))
}

fn format(name: &str) -> Result<CalibrationFormat> {
    CalibrationFormat::from_name(name).with_context(|| format!("there is no format {name}"))
}

fn rigs(to: &Path, (w, h): (usize, usize)) -> Result<()> {
    let camera = Camera::from_focal(w, h, 120.0);
    let lens = Distortion::new(DistortionModel::RadialTangential4, &[-0.02, 0.01, 0.001, -0.001])?;
    let pose = Pose::new(Rotation3::new(Vector3::new(0.001, -0.002, 0.001)), Vector3::new(-0.1, 0.0, 0.0));
    let rig = StereoRig { left: camera, right: Camera { distortion: lens, ..camera }, right_from_left: pose };
    let file = RigFile { rig, unit: "m".to_owned() };
    for (name, of) in [("rig.yaml", "own"), ("opencv.yml", "opencv"), ("kalibr.yaml", "kalibr")] {
        fs::write(to.join(name), format(of)?.rig_text(&file, &[])?)?;
    }
    fs::write(to.join("lens.yaml"), format("own")?.camera_text(&rig.right, &[])?)?;
    let one = |name: &str, camera, from_first| ArrayCamera { name: name.to_owned(), camera, from_first };
    let far = Pose::new(pose.rotation, 2.0 * pose.translation);
    let cameras = vec![one("a", rig.left, Pose::identity()), one("b", rig.right, pose), one("c", rig.left, far)];
    let file = CameraArray { cameras, unit: "m".to_owned() };
    Ok(fs::write(to.join("three.yaml"), format("own")?.array_text(&file, &[])?)?)
}

/// Renders photographs of a chessboard of 8 × 6 squares by one camera.
fn boards(to: &Path) -> Result<()> {
    let sheet = Sheet {
        texture: Texture::Board { squares: (8, 6), square: 0.03 },
        size: (0.27, 0.21),
        bend: 0.0,
        behind: Texture::Paint { color: [0.4; 3], seed: 1 },
        light: [0.1, -0.1],
        glare: None,
    };
    let camera = Camera::from_focal(320, 240, 280.0);
    for i in 1..=4 {
        let angle = 1.6 * f64::from(i);
        let rotation = Rotation3::new(Vector3::new(0.5 * angle.sin(), 0.5 * angle.cos(), 0.1));
        let pose = Pose::new(rotation, Vector3::new(0.0, 0.0, 0.36) - rotation * Vector3::new(0.135, 0.105, 0.0));
        let photo = sheet.photo(&camera, &pose, &RenderOptions::default())?;
        cv_io::write_png(to.join(format!("board{i}.png")), photo.view())?;
    }
    Ok(())
}

fn cameras(to: &Path, folder: &Path) -> Result<()> {
    let size = cv_io::read_rgb(folder.join("in/a.jpg"))?.size();
    let camera = Camera::from_focal(size.0, size.1, 1.02 * size.0 as f64);
    for (name, of) in [("cam.yaml", "own"), ("cameras.txt", "colmap")] {
        fs::write(to.join(name), format(of)?.camera_text(&camera, &[])?)?;
    }
    // The ROS format, which the program cannot write.
    let (w, h, f) = (camera.width, camera.height, camera.fx);
    let matrix = format!("camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{f}, 0, 240, 0, {f}, 180, 0, 0, 1]\n");
    let lens = "distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.01, 0.002, 0, 0, 0]\n";
    fs::write(to.join("ros.yaml"), format!("image_width: {w}\nimage_height: {h}\ncamera_name: left\n{matrix}{lens}"))?;
    fs::write(to.join("K.txt"), format!("{f} 0 240\n0 {f} 180\n0 0 1\n"))?;
    let size = cv_io::read_rgb(folder.join("in/1.jpg"))?.size();
    let wide = Camera::from_focal(size.0, size.1, 0.9 * size.0 as f64);
    Ok(fs::write(to.join("wide.yaml"), format("own")?.camera_text(&wide, &[])?)?)
}

fn maps(to: &Path) -> Result<()> {
    let truth = GrayF32::from_fn(60, 44, |x, y| [if x < 4 { f32::NAN } else { 3.0 + (x + y) as f32 / 8.0 }]);
    let found = truth.map(|[d]| [d + 0.25]);
    let array = npy::NpyArray::from_view(found.view());
    npy::write(to.join("t.npy"), &npy::NpyArray::from_view(truth.view()))?;
    npz::write(to.join("d.npz"), &[("disparity", &array)], true)?;
    pfm::write(to.join("d.pfm"), found.view())?;
    cv_io::kitti::write(to.join("kitti.png"), found.view())?;
    Ok(cv_io::write_png(to.join("seen.png"), Mask::from_fn(60, 44, |x, _| [x > 9]).view())?)
}

/// Returns paths and bytes of all files below a folder, sorted.
pub(crate) fn snapshot(folder: &Path) -> Result<Vec<(PathBuf, Vec<u8>)>> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let path = entry?.path();
        if path.is_dir() {
            files.extend(snapshot(&path)?);
        } else {
            let bytes = fs::read(&path)?;
            files.push((path, bytes));
        }
    }
    files.sort();
    Ok(files)
}

/// Returns whether a path is a temporary file of the program, or in a temporary folder.
pub(crate) fn is_temporary(path: &Path) -> bool {
    path.components().any(|part| part.as_os_str().to_string_lossy().starts_with(".cv-"))
}

/// Checks that a file written by a command is complete; returns the problem if it is not.
pub(crate) fn find_problem(path: &Path, bytes: &[u8]) -> Option<String> {
    let shown = path.display();
    if is_temporary(path) {
        return Some(format!("{shown} was left behind"));
    }
    let is_complete = match path.extension().and_then(|extension| extension.to_str()) {
        Some("png" | "jpg") => cv_io::decode_image(bytes, &cv_io::ReadOptions::default()).is_ok(),
        Some("pfm") => pfm::decode(bytes).is_ok(),
        Some("npy") => npy::decode(bytes).is_ok(),
        Some("pdf") => bytes.trim_ascii_end().ends_with(b"%%EOF"),
        Some("json") => serde_json::from_slice::<serde_json::Value>(bytes).is_ok(),
        Some("html") => bytes.trim_ascii_end().ends_with(b"</html>"),
        Some("ply") => is_complete_ply(bytes),
        _ => bytes.ends_with(b"\n"),
    };
    (!is_complete).then(|| format!("{shown}, {} bytes, is not complete", bytes.len()))
}

/// Returns whether a binary PLY file has as many bytes as its header requires.
fn is_complete_ply(bytes: &[u8]) -> bool {
    let end = b"end_header\n";
    let Some(start) = bytes.windows(end.len()).position(|window| window == end) else { return false };
    let header = String::from_utf8_lossy(&bytes[..start]);
    let (mut count, mut needed) = (0, 0);
    for line in header.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        match words[..] {
            ["element", _, n] => count = n.parse().unwrap_or(0),
            ["property", "float" | "int", _] => needed += 4 * count,
            ["property", "uchar", _] => needed += count,
            _ => {}
        }
    }
    bytes.len() == start + end.len() + needed
}
