//! `cv undistort`: correction of lens distortion.

use super::rectify::{parse_fraction, write_image};
use super::size;
use crate::frame::{Context, Explain, Failure, Global, Outcome, Output, Run, expand_images, one_each, spare_inputs};
use crate::rig;
use cv_core::Stage;
use cv_io::{DynImage, ExifInfo, Metadata, Pixels};
use cv_pipeline::stereo::{RectifiedView, RectifyOptions, WarpError, WarpMap};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Correct the distortion of a calibrated lens.
///
/// Writes NAME.png for each photograph (NAME.tif for a TIFF), and camera.yaml, the pinhole camera of the results: same center and orientation, square pixels, no distortion. Pixels outside
/// the source image are black. The bit depth is kept.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv undistort photos/*.jpg --camera camera.yaml -o straight\n  \
    cv undistort photos --camera camera.yaml --alpha 1 --size 1280x960 -o straight")]
pub(crate) struct Args {
    /// The photographs, or folders or quoted patterns of them.
    #[arg(required = true, value_name = "IMAGES")]
    images: Vec<PathBuf>,
    /// The calibration of the camera: our, OpenCV's, ROS's, Kalibr's or COLMAP's format.
    #[arg(long, value_name = "FILE")]
    camera: PathBuf,
    /// The folder for the results; created if missing.
    #[arg(short, long, visible_alias = "out", value_name = "DIR")]
    output: PathBuf,
    /// Free scaling parameter: from 0 (only valid pixels) to 1 (all source pixels kept), as in OpenCV.
    #[arg(long, value_name = "A", default_value_t = 0.0, value_parser = parse_fraction)]
    alpha: f64,
    /// Width and height of the results [default: those of the photographs].
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<(usize, usize)>,
}

impl Args {
    /// Returns the output path of a photograph: TIFF for a TIFF, else PNG.
    fn result(&self, photo: &Path) -> PathBuf {
        let is_tiff =
            photo.extension().is_some_and(|e| ["tif", "tiff"].iter().any(|tiff| e.eq_ignore_ascii_case(tiff)));
        let ending = if is_tiff { "tif" } else { "png" };
        self.output.join(photo.file_stem().unwrap_or_default()).with_extension(ending)
    }
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        vec![Output::Folder(&self.output)]
    }

    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed, Global::Report]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let images = expand_images(&self.images)?;
        let mut results: Vec<PathBuf> = images.iter().map(|path| self.result(path)).collect();
        results.push(self.output.join("camera.yaml"));
        let inputs: Vec<&Path> = images.iter().chain([&self.camera]).map(PathBuf::as_path).collect();
        spare_inputs(&results, &inputs)?;
        one_each(&images, &results)?;
        let mut made: Option<(RectifiedView, WarpMap)> = None;
        let (mut seconds, mut done) = (0.0, Vec::new());
        let stage = Stage::new(context, "undistort", images.len())?;
        for (path, result) in images.iter().zip(&results) {
            let photo = cv_io::read_image(path)?;
            let (view, map) = match &made {
                Some(made) => made,
                None => {
                    let camera = rig::camera(&self.camera, Some(photo.size()), context)?;
                    let options = RectifyOptions { alpha: self.alpha, size: self.size };
                    let view = RectifiedView::undistorted(&camera, &options)
                        .during(self.camera.display())
                        .map_err(|f| f.advice("check the calibration file"))?;
                    rig::check_size(&self.camera, path, photo.size(), &view.source)?;
                    let start = Instant::now();
                    let map = view.map(&stage)?;
                    seconds += start.elapsed().as_secs_f64();
                    made.insert((view, map))
                }
            };
            rig::check_size(&self.camera, path, photo.size(), &view.source)?;
            let start = Instant::now();
            let pixels = undistorted_pixels(&photo.pixels, map)?;
            seconds += start.elapsed().as_secs_f64();
            let straight = DynImage { pixels, exif: ExifInfo::default(), metadata: Metadata::default() };
            context.write(Output::Folder(&self.output), |_| write_image(result, &straight, &photo.metadata))?;
            done.push(json!({ "path": path.display().to_string(), "output": result.display().to_string() }));
            stage.add(1)?;
        }
        let Some((view, _)) = made else { return Err(Failure::usage("there is no photograph")) };
        let note = "without the distortion of the lens";
        context.write(Output::Folder(&self.output), |folder| {
            cv_io::write_camera(folder.join("camera.yaml"), &view.camera, &[note])
        })?;
        let (width, height) = (view.camera.width, view.camera.height);
        Ok(Outcome::new(vec![("undistort", seconds)])
            .with("images", done)
            .with("width", width)
            .with("height", height)
            .with("focal_px", view.camera.fx)
            .summary(format!(
                "{} photographs of {width}×{height} px with a focal length of {:.2} px in {}",
                images.len(),
                view.camera.fx,
                self.output.display()
            )))
    }
}

/// Undistorts an image at its bit depth; linear float images as 8-bit sRGB.
pub(super) fn undistorted_pixels(pixels: &Pixels, map: &WarpMap) -> Result<Pixels, WarpError> {
    Ok(match pixels {
        Pixels::Gray8(image) => map.compute(image.view())?.into(),
        Pixels::Gray16(image) => map.compute(image.view())?.into(),
        Pixels::Rgb8(image) => map.compute(image.view())?.into(),
        Pixels::Rgb16(image) => map.compute(image.view())?.into(),
        other => {
            let image = DynImage { pixels: other.clone(), exif: ExifInfo::default(), metadata: Metadata::default() };
            map.compute(image.into_rgb8().view())?.into()
        }
    })
}
