//! `cv rectify`: rectification of a pair by the calibration of its rig.

use super::size;
use crate::frame::{Context, Failure, Global, Outcome, Output, Run, Step, spare_inputs, steps, two_images};
use crate::photos::{Photos, at_own_depth};
use crate::pictures::{Width, picture};
use crate::{rig, words};
use cv_core::{RgbU8, StereoRig};
use cv_io::{DynImage, ExifInfo, IoError, Metadata, Pixels, RigFile};
use cv_pipeline::rectify;
use cv_pipeline::stereo::RectifyOptions;
use cv_report::{Raster, Report, colors, side_by_side};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Formats the examples and the syntax of a rig file; distortion models are listed from the table.
fn help() -> String {
    let lenses: Vec<String> = (cv_core::DistortionModel::ALL.iter().map(|model| model.info()))
        .filter(|lens| !lens.parameters.is_empty())
        .map(|lens| format!("  distortion: {}, coefficients: [{}]", lens.name, lens.parameters.join(", ")))
        .collect();
    format!(
        "Examples:\n  \
        cv rectify left.jpg right.jpg --rig rig.yaml -o rectified\n  \
        cv rectify left.jpg right.jpg --rig opencv-stereo.yml --alpha 1 --size 1280x960 -o rectified --report page\n\n\
        Our rig file:\n  \
        schema: cv-rig/1\n  \
        unit: m\n  \
        left: {{width: 640, height: 480, fx: 560, fy: 560, cx: 319.5, cy: 239.5}}\n  \
        right: {{width: 640, height: 480, fx: 555, fy: 555, cx: 325, cy: 236}}\n  \
        rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]   # x_right = rotation · x_left + translation\n  \
        translation: [-0.12, 0, 0]                    # the right camera is 0.12 m to the right\n\
        A camera may also have distortion coefficients:\n{}\n\
        Or the file is OpenCV's YAML, with M1, D1, M2, D2, R and T in one or in two (--rig intrinsics.yml --rig extrinsics.yml), or Kalibr's\n\
        camchain.yaml. A skew that displaces no pixel by more than 0.25 px is ignored.",
        lenses.join("\n")
    )
}

/// Rectify a pair of a calibrated rig: corresponding points come to lie in the same row.
///
/// Writes left.png, right.png, rig.yaml (the rectified cameras) and q.txt (the 4×4 matrix Q that reprojects (column, row,
/// disparity, 1) to 3D) to a folder. The vertical residual is measured on feature matches of the rectified images. Bit
/// depth, EXIF (without orientation and thumbnail) and color profiles are kept.
///
/// For a vertical rig, both results are rotated by 90 degrees counterclockwise, so that rows correspond: down in the scene is
/// right in the images. The upper image becomes left.png.
#[derive(Debug, clap::Args)]
#[command(after_help = help())]
pub(crate) struct Args {
    /// The left (or upper) photograph and the right (or lower) one, or a folder or quoted pattern of the two.
    #[arg(required = true, value_name = "LEFT RIGHT")]
    photographs: Vec<PathBuf>,
    #[arg(skip)]
    left: PathBuf,
    #[arg(skip)]
    right: PathBuf,
    /// Calibration of the rig: our, OpenCV's or Kalibr's YAML; twice for OpenCV's two files.
    #[arg(long, value_name = "FILE", required = true)]
    rig: Vec<PathBuf>,
    /// The folder for the results; created if missing.
    #[arg(short, long, visible_alias = "out", value_name = "DIR")]
    output: PathBuf,
    /// Free scaling parameter: from 0 (only valid pixels) to 1 (all source pixels kept), as in OpenCV.
    #[arg(long, value_name = "A", default_value_t = 0.0, value_parser = parse_fraction)]
    alpha: f64,
    /// Width and height of the rectified images [default: those of the left photograph, exchanged for a vertical rig].
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<(usize, usize)>,
    /// The first camera of the rig file took the right (or lower) photograph.
    #[arg(long)]
    exchange: bool,
}

pub(super) fn parse_fraction(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|value| (0.0..=1.0).contains(value)).ok_or_else(|| "give a number from 0 to 1".to_owned())
}

/// Names of the output files.
const NAMES: [&str; 4] = ["left.png", "right.png", "rig.yaml", "q.txt"];

impl Run for Args {
    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed]
    }

    fn steps(&self) -> Vec<Step> {
        vec![steps::RECTIFY, steps::FEATURES, steps::MATCH]
    }

    fn run(mut self, context: &Context) -> Result<Outcome, Failure> {
        [self.left, self.right] = two_images(&self.photographs)?;
        let exchange = self.exchange;
        let inputs: Vec<&Path> = [&self.left, &self.right].into_iter().chain(&self.rig).map(PathBuf::as_path).collect();
        spare_inputs(&NAMES.map(|name| self.output.join(name)), &inputs)?;
        let photos = Photos::read(&self.left, &self.right)?;
        let [left, right] = photos.sizes();
        let RigFile { rig, unit, .. } = rig::read(&self.rig, left, exchange, context)?;
        let calibration: &Path = &self.rig[0];
        rig::check_size(calibration, &self.left, left, &rig.left)?;
        rig::check_size(calibration, &self.right, right, &rig.right)?;
        let options = RectifyOptions { alpha: self.alpha, size: self.size };
        let rectified = |pixels| DynImage { pixels, exif: ExifInfo::default(), metadata: Metadata::default() };
        let result = at_own_depth!(photos, |a, b| {
            rectify(a, b, &rig, &options, context).map(|result| result.map_images(|image| rectified(image.into())))
        })
        .map_err(|error| words::no_rectification(error, calibration, exchange))?;
        let r = &result.rectification;
        let rotation = cv_core::Rotation3::identity();
        let translation = cv_core::Vector3::new(-r.geometry.baseline, 0.0, 0.0);
        let rectified = StereoRig {
            left: r.left.camera,
            right: r.right.camera,
            right_from_left: cv_core::Pose::new(rotation, translation),
        };
        let q = r.q();
        let rows: Vec<String> =
            q.row_iter().map(|row| row.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")).collect();
        context.write(Output::Folder(&self.output), |out| {
            cv_io::write_together(out, &NAMES, |folder| {
                write_image(&folder.join("left.png"), &result.images[0], &photos.left.metadata)?;
                write_image(&folder.join("right.png"), &result.images[1], &photos.right.metadata)?;
                cv_io::write_rig(folder.join("rig.yaml"), &RigFile { rig: rectified, unit }, &["rectified"])?;
                cv_io::write_bytes(folder.join("q.txt"), format!("{}\n", rows.join("\n")).as_bytes())
            })
        })?;
        let residual = match (result.vertical_px, &result.fault) {
            (Some((median, p95)), _) => {
                format!("{median:.2} px median, {p95:.2} px at 95 %, over {} features", result.matches)
            }
            (None, Some(cause)) => format!("unknown ({cause})"),
            (None, None) => "unknown (too few features)".to_owned(),
        };
        context.report(|| {
            let mut page = Report::new("Rectification");
            let quality = match (result.vertical_px, &result.fault) {
                (Some((median, p95)), _) => format!("{median:.2} px, 95 % under {p95:.2} px"),
                (None, Some(_)) => "unknown: see below".to_owned(),
                (None, None) => "unknown: too few features".to_owned(),
            };
            page.headline("vertical residual", &quality).headline(
                "valid area",
                &format!("{:.1} % and {:.1} %", 100.0 * result.valid_area[0], 100.0 * result.valid_area[1]),
            );
            page.section("Rectified pair").figure(picture(
                &with_rows(&result.images.clone().map(DynImage::into_rgb8)),
                Width::Full,
                "Both images with common scanlines: corresponding points lie on the same line.",
            )?);
            if let Some(cause) = &result.fault {
                page.warn(&format!("feature matches show: {cause}"));
            }
            page.section("Time").times(&result.stages);
            Ok(page)
        })?;
        let (width, height) = result.images[0].size();
        let outcome = Outcome::new(result.stages)
            .with("width", width)
            .with("height", height)
            .with("vertical", r.vertical)
            .with("focal_px", r.geometry.focal)
            .with("baseline", r.geometry.baseline)
            .with("principal_point", [r.geometry.cx, r.geometry.cy])
            .with("q", q.row_iter().map(|row| row.iter().copied().collect::<Vec<f64>>()).collect::<Vec<_>>())
            .with("valid_area", json!({ "left": result.valid_area[0], "right": result.valid_area[1] }))
            .with("matches", result.matches)
            .with(
                "vertical_residual_px",
                result.vertical_px.map(|(median, p95)| json!({ "median": median, "p95": p95 })),
            )
            .with("fault", result.fault.map(|cause| cause.to_string()))
            .summary(format!(
                "{width}×{height} px; vertical residual {residual}; valid area {:.1} % left, {:.1} % right",
                100.0 * result.valid_area[0],
                100.0 * result.valid_area[1]
            ));
        Ok(rig::checked(outcome, calibration, result.fault))
    }

    fn outputs(&self) -> Vec<Output<'_>> {
        vec![Output::Folder(&self.output)]
    }
}

/// Writes an image at its bit depth, with the metadata of the original file.
pub(super) fn write_image(path: &Path, file: &DynImage, metadata: &Metadata) -> Result<(), IoError> {
    match &file.pixels {
        Pixels::Gray8(image) => cv_io::write_image(path, image.view(), metadata),
        Pixels::Gray16(image) => cv_io::write_image(path, image.view(), metadata),
        Pixels::Rgb16(image) => cv_io::write_image(path, image.view(), metadata),
        _ => cv_io::write_image(path, file.clone().into_rgb8().view(), metadata),
    }
}

/// Draws both views side by side with a line every sixteenth of the height.
pub(super) fn with_rows(images: &[RgbU8; 2]) -> RgbU8 {
    let joined = side_by_side(&[images[0].view(), images[1].view()], 4);
    let mut canvas = Raster::from_rgb(joined.view());
    let (width, height) = (canvas.width() as f32, canvas.height() as f32);
    for line in 1..16 {
        let y = height * line as f32 / 16.0;
        canvas.line([0.0, y], [width, y], 1.0, colors::GREEN);
    }
    canvas.into_image()
}
