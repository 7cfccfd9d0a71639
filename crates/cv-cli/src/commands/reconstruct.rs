//! `cv reconstruct`: points and camera poses from two photographs.

mod report;

pub(crate) use report::sparse;

use crate::frame::{CLOUD, Context, Failure, Outcome, Output, Run, Step, named, steps, two_images};
use crate::photos::read_both;
use crate::{rig, words};
use cv_core::PointCloud;
use cv_core::nalgebra::Matrix3;
use cv_io::DynImage;
use cv_io::colmap::ModelFormat;
use cv_io::ply::PlyEncoding;
use cv_pipeline::{
    Axes, DenseOptions, DenseResult, Intrinsics, PLAUSIBLE_FOCAL, ReconstructOptions, ReconstructResult, reconstruct,
    reconstruct_dense,
};
use std::path::{Path, PathBuf};

/// Reconstruct a colored point cloud and the relative camera pose from two photographs.
///
/// The cloud is in the first camera's frame. Two views determine it up to scale: its unit is the baseline. Without --camera and --focal, the
/// focal length is taken from EXIF, or self-calibrated if one of the photographs has none.
///
/// With --dense, the pair is also rectified by the estimated geometry and matched densely; pixels that pass the left-right check form a second,
/// dense cloud in the same frame and unit.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv reconstruct a.jpg b.jpg -o cloud.ply\n  \
    cv reconstruct a.jpg b.jpg --camera cam.yaml -o cloud.ply --report out\n  \
    cv reconstruct a.jpg b.jpg --focal 2900 -o cloud.ply --axes opengl --colmap model\n  \
    cv reconstruct a.jpg b.jpg -o sparse.ply --dense dense.ply --dense-size 2400\n\n\
    A camera file is our, OpenCV's, ROS's or Kalibr's YAML, a line of COLMAP's cameras.txt, or a 3×3 matrix.")]
pub(crate) struct Args {
    /// Two photographs, or a folder or quoted pattern of two.
    #[arg(required = true, value_name = "PHOTOGRAPHS")]
    photographs: Vec<PathBuf>,
    #[arg(skip)]
    first: PathBuf,
    #[arg(skip)]
    second: PathBuf,
    /// Where to write the cloud, as PLY.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Camera of both photographs.
    #[arg(long, value_name = "FILE", conflicts_with = "focal")]
    camera: Option<PathBuf>,
    /// Camera of the second photograph, if different.
    #[arg(long, value_name = "FILE", requires = "camera")]
    camera2: Option<PathBuf>,
    /// The photographs have no lens distortion. For calibration matrices, which do not state it.
    #[arg(long, requires = "camera")]
    undistorted: bool,
    /// Approximate focal length of both photographs in pixels: a prior.
    #[arg(long, value_name = "PX")]
    focal: Option<f64>,
    /// Ignore the focal lengths of EXIF and self-calibrate.
    #[arg(long, conflicts_with_all = ["camera", "focal"])]
    ignore_exif: bool,
    /// Inlier threshold: largest distance of a match from its epipolar line, in pixels.
    #[arg(long, value_name = "PX", default_value_t = ReconstructOptions::default().two_view.robust.threshold)]
    threshold: f64,
    /// Largest reprojection error of a point, in pixels.
    #[arg(long, value_name = "PX", default_value_t = ReconstructOptions::default().two_view.max_reprojection)]
    max_error: f64,
    /// Smallest triangulation angle of a point, in degrees.
    #[arg(long, value_name = "DEGREES", default_value_t = 0.1)]
    min_angle: f64,
    /// Maximum number of features per photograph [default: 8192].
    #[arg(long, value_name = "N")]
    features: Option<usize>,
    /// Axis convention of the cloud.
    #[arg(long, value_name = "WHICH", value_parser = named::<Axes>(), default_value_t = Axes::Opencv)]
    axes: Axes,
    /// Where to write the cameras and points as a COLMAP text model: a folder.
    #[arg(long, value_name = "DIR")]
    colmap: Option<PathBuf>,
    /// Where to write a dense cloud, as PLY.
    #[arg(long, value_name = "FILE")]
    dense: Option<PathBuf>,
    /// Longer side in pixels to which the photographs are downscaled for the dense cloud.
    #[arg(long, value_name = "PX", default_value_t = DenseOptions::default().max_size, requires = "dense")]
    dense_size: usize,
    /// Fill the depth of pixels that fail the left-right check from their surroundings.
    #[arg(long, requires = "dense")]
    dense_fill: bool,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        let clouds = std::iter::once(&self.output).chain(&self.dense).map(|path| Output::File(path, CLOUD));
        clouds.chain(self.colmap.iter().map(|folder| Output::Folder(folder))).collect()
    }

    fn steps(&self) -> Vec<Step> {
        let mut all = vec![steps::FEATURES, steps::MATCH, steps::POSE, steps::ADJUST, steps::GUIDED, steps::POINTS];
        if self.dense.is_some() {
            all.extend([steps::RECTIFY, steps::DISPARITIES, steps::CLOUD]);
        }
        all
    }

    fn run(mut self, context: &Context) -> Result<Outcome, Failure> {
        [self.first, self.second] = two_images(&self.photographs)?;
        for (name, value) in [("--threshold", self.threshold), ("--max-error", self.max_error)] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(Failure::usage(format!("{name} must be positive, not {value}")));
            }
        }
        if self.focal.is_some_and(|f| !(f > 0.0 && f.is_finite())) {
            return Err(Failure::usage("--focal must be positive"));
        }
        let photos = read_both([&self.first, &self.second], cv_io::read_image)?;
        let (intrinsics, source) = self.intrinsics(&photos, context)?;
        context.note(&source);
        let mut options = ReconstructOptions::new(intrinsics);
        options.two_view.robust.threshold = self.threshold;
        options.two_view.max_reprojection = self.max_error;
        options.two_view.min_angle = self.min_angle.to_radians();
        if let Some(n) = self.features {
            options.matching.features = options.matching.features.at_most(n);
        }
        if let Some(seed) = context.seed {
            options.two_view.robust.seed = seed;
        }
        let [a, b] = photos.map(DynImage::into_rgb8);
        let result = reconstruct(a.view(), b.view(), &options, context)
            .map_err(|error| words::no_reconstruction(&error, [&self.first, &self.second]))?;
        // Before any output is written: if the dense cloud fails, there must be no partial outputs.
        let dense = self.dense(&a, &b, &result, context)?;
        let write = |path: &Path, mut cloud: PointCloud| {
            self.axes.turn(&mut cloud);
            let cloud = |path: &Path| cv_io::ply::write_cloud(path, &cloud, PlyEncoding::Binary);
            context.write(Output::File(path, CLOUD), cloud)
        };
        write(&self.output, result.cloud())?;
        if let (Some(path), Some(dense)) = (&self.dense, &dense) {
            write(path, dense.cloud.clone())?;
        }
        if let Some(folder) = &self.colmap {
            let name = |path: &Path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
            let model = result.model([name(&self.first), name(&self.second)]);
            context
                .write(Output::Folder(folder), |folder| cv_io::colmap::replace(folder, &model, ModelFormat::Text))?;
        }
        if let Some(text) = focal_warning(&result) {
            context.warn(format!("{text}; give --focal or --camera if known"));
        }
        context.report(|| report::report([&self.first, &self.second], [&a, &b], &result, dense.as_ref(), &source))?;
        Ok(self.outcome(&result, dense.as_ref()))
    }
}

/// Returns a warning if the focal length is poorly constrained or unusual.
fn focal_warning(result: &ReconstructResult) -> Option<String> {
    let percent = 100.0 * result.scene.focal_deviation;
    let degrees = result.scene.pose_deviation[1].to_degrees();
    let (low, high) = PLAUSIBLE_FOCAL;
    let unusual = result.scene.unusual_focal().map_or_else(String::new, |ratio| {
        format!(
            "; at {ratio:.1} times the image's longer side it is unusual ({low} to {high} are usual), which weak perspective in the matches leads to"
        )
    });
    (result.focal_is_doubtful() || !unusual.is_empty()).then(|| {
        format!(
            "the focal length has a standard deviation of {percent:.0} %, and the depth of the cloud may be stretched by as much; that of the translation direction is \
             {degrees:.1} degrees{unusual}"
        )
    })
}

impl Args {
    /// Returns the prior knowledge of the intrinsics, and its source.
    fn intrinsics(&self, photos: &[DynImage; 2], context: &Context) -> Result<(Intrinsics, String), Failure> {
        if let Some(path) = &self.camera {
            let (first, first_known) = rig::camera_and_lens(path, Some(photos[0].size()), self.undistorted, context)?;
            let (second, second_known) = match &self.camera2 {
                Some(path) => rig::camera_and_lens(path, Some(photos[1].size()), self.undistorted, context)?,
                None => (first, first_known),
            };
            let cameras = [first, second];
            let source = format!("camera from {}", path.display());
            return Ok(if first_known && second_known {
                (Intrinsics::Known(cameras), source)
            } else {
                let open = "a matrix without distortion coefficients: distortion is estimated (--undistorted if there is none)";
                (Intrinsics::Matrix(cameras), format!("{source}, {open}"))
            });
        }
        if let Some(focal) = self.focal {
            let source = format!("focal length about {focal} px as given, refined by bundle adjustment");
            return Ok((Intrinsics::Focal([focal; 2]), source));
        }
        let exif = photos.each_ref().map(|p| p.exif.focal.map(|f| f.pixels).filter(|_| !self.ignore_exif));
        let intrinsics = Intrinsics::from_focal_lengths(exif);
        let source = match intrinsics {
            Intrinsics::Focal([a, _]) => {
                format!(
                    "focal length about {a:.0} px from EXIF, refined by bundle adjustment (--focal or --camera to change it)"
                )
            }
            _ => "focal length unknown: self-calibrated from the matches".to_owned(),
        };
        Ok((intrinsics, source))
    }

    /// Computes the dense cloud, if requested.
    fn dense(
        &self,
        a: &cv_core::RgbU8,
        b: &cv_core::RgbU8,
        sparse: &ReconstructResult,
        context: &Context,
    ) -> Result<Option<DenseResult>, Failure> {
        if self.dense.is_none() {
            return Ok(None);
        }
        let default = DenseOptions::default();
        let options = DenseOptions {
            max_size: self.dense_size,
            fill: self.dense_fill,
            max_memory: context.max_memory.unwrap_or(default.max_memory),
            ..default
        };
        let dense = reconstruct_dense(a.view(), b.view(), sparse, &options, context);
        dense.map(Some).map_err(|error| words::no_dense_cloud(&error, [&self.first, &self.second]))
    }

    fn outcome(&self, result: &ReconstructResult, dense: Option<&DenseResult>) -> Outcome {
        let rows = |m: &Matrix3<f64>| -> [[f64; 3]; 3] { std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)])) };
        let t = result.scene.pose.translation;
        let degrees = result.scene.pose_deviation.map(f64::to_degrees);
        let mut summary = format!(
            "{} points from {} of {} matches, {:.3} px RMS; rotation {:.2} degrees, median triangulation angle {:.2} degrees",
            result.scene.points.len(),
            result.scene.inliers.len(),
            result.matching.matches.len(),
            result.scene.reprojection_rms,
            result.scene.pose.rotation_angle().to_degrees(),
            result.scene.median_angle.to_degrees(),
        );
        if result.scene.focal_deviation > 0.0 {
            let (focal, percent) = (result.scene.cameras[0].fx, 100.0 * result.scene.focal_deviation);
            summary += &format!("; focal length {focal:.0} px ± {percent:.1} %");
        }
        let mut stages = result.stages.clone();
        stages.extend(dense.iter().flat_map(|d| dense_stages(d)));
        let outcome = Outcome::new(stages)
            .with("points", result.scene.points.len())
            .with("matches", result.matching.matches.len())
            .with("inliers", result.scene.inliers.len())
            .with("guided", result.scene.guided)
            .with("reprojection_rms_px", result.scene.reprojection_rms)
            .with("rotation", rows(result.scene.pose.rotation.matrix()))
            .with("translation", [t.x, t.y, t.z])
            .with("rotation_deviation_degrees", degrees[0])
            .with("translation_deviation_degrees", degrees[1])
            .with("focal_px", result.scene.cameras.map(|c| c.fx))
            .with("focal_deviation", result.scene.focal_deviation)
            .with("median_angle_degrees", result.scene.median_angle.to_degrees())
            .with("planar_share", result.scene.planar_ratio);
        let Some(dense) = dense else { return outcome.summary(summary) };
        let (width, height) = dense.size;
        let (first, count) = dense.disparities;
        let percent = 100.0 * dense.coverage;
        summary += &format!("; {} dense points, {percent:.0} % of the overlap", dense.cloud.len());
        outcome
            .with("dense_points", dense.cloud.len())
            .with("dense_coverage", dense.coverage)
            .with("dense_size", [width, height])
            .with("dense_disparities", [i64::from(first), i64::from(first) + count as i64 - 1])
            .summary(summary)
    }
}

/// Renames the stages of the dense cloud, to distinguish them from those of the sparse one.
fn dense_stages(dense: &DenseResult) -> impl Iterator<Item = (&'static str, f64)> {
    let name = |name: &str| match name {
        "rectify" => "dense_rectify",
        "match" => "dense_match",
        _ => "dense_cloud",
    };
    dense.stages.iter().map(move |(stage, seconds)| (name(stage), *seconds))
}
