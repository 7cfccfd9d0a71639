//! `cv estimate`: a homography, fundamental or essential matrix from a matches file.

use super::size;
use crate::frame::{Context, Explain, Failure, Outcome, Run, named};
use crate::pictures::{Width, picture};
use crate::rig;
use cv_core::nalgebra::Matrix3;
use cv_core::{Camera, Correspondence, Named, RgbU8, named};
use cv_pipeline::{EstimateError, ModelKind, RobustModel, RobustOptions, estimate, estimate_calibrated};
use cv_report::{Raster, Report, colors};
use std::path::{Path, PathBuf};

/// The two-view models.
#[derive(Debug, Clone, Copy)]
enum Model {
    Homography,
    Fundamental,
    Essential,
}

named!(Model {
    Homography = "homography": "a planar scene, or a purely rotating camera: b ~ H a",
    Fundamental = "fundamental": "a general scene, uncalibrated cameras: bᵀ F a = 0",
    Essential = "essential": "a general scene and calibrated cameras: needs --camera, or --focal and --size",
});

impl Model {
    fn description(self) -> &'static str {
        match self {
            Self::Homography => "homography",
            Self::Fundamental => "fundamental matrix",
            Self::Essential => "essential matrix",
        }
    }
}

/// Robustly estimate a homography, fundamental or essential matrix from matches with outliers.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cv match left.jpg right.jpg -o matches.txt && cv estimate homography --matches matches.txt
  cv estimate fundamental --matches matches.txt --threshold 0.5 --json
  cv estimate essential --matches matches.txt --focal 2900 --size 2832x2128

The matches file has a row per match, `x1 y1 x2 y2` in pixels with an optional score; `#` starts a comment.")]
pub(crate) struct Args {
    /// The model to estimate.
    #[arg(value_parser = named::<Model>())]
    model: Model,
    /// Photographs, which are refused with a hint: the input is a matches file.
    #[arg(hide = true)]
    photographs: Vec<PathBuf>,
    /// The matches.
    #[arg(long, value_name = "FILE", required_unless_present = "photographs")]
    matches: Option<PathBuf>,
    /// Inlier threshold: largest residual in pixels [default: 3 for a homography, 1 otherwise].
    #[arg(long, value_name = "PX")]
    threshold: Option<f64>,
    /// Confidence: probability of having drawn an outlier-free sample at which RANSAC terminates.
    #[arg(long, value_name = "P", default_value_t = RobustOptions::default().confidence)]
    confidence: f64,
    /// Maximum number of RANSAC samples [default: 10000 for a homography, 20000 otherwise].
    #[arg(long, value_name = "N")]
    max_iterations: Option<usize>,
    /// Camera of both views, for an essential matrix: YAML, a line of COLMAP's cameras.txt, or a 3×3 matrix.
    #[arg(long, value_name = "FILE", conflicts_with = "focal")]
    camera: Option<PathBuf>,
    /// Camera of the second view, if different.
    #[arg(long, value_name = "FILE", requires = "camera")]
    camera2: Option<PathBuf>,
    /// Focal length of both views in pixels, for an essential matrix; the principal point is the center of --size.
    #[arg(long, value_name = "PX", requires = "size")]
    focal: Option<f64>,
    /// Width and height of both views in pixels, such as 2832x2128.
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<(usize, usize)>,
}

impl Args {
    /// Returns the cameras for an essential matrix; `None` for the other models.
    fn cameras(&self, context: &Context) -> Result<Option<[Camera; 2]>, Failure> {
        if !matches!(self.model, Model::Essential) {
            if self.camera.is_some() || self.focal.is_some() || self.size.is_some() {
                return Err(Failure::usage("--camera, --focal and --size apply to an essential matrix only"));
            }
            return Ok(None);
        }
        if let Some(path) = &self.camera {
            let first = rig::camera(path, self.size, context)?;
            let second = match &self.camera2 {
                Some(path) => rig::camera(path, self.size, context)?,
                None => first,
            };
            return Ok(Some([first, second]));
        }
        let (Some(focal), Some((width, height))) = (self.focal, self.size) else {
            return Err(Failure::usage("an essential matrix needs --camera, or --focal and --size"));
        };
        if !(focal > 0.0 && focal.is_finite()) {
            return Err(Failure::usage("--focal must be positive"));
        }
        Ok(Some([Camera::from_focal(width, height, focal); 2]))
    }
}

fn matrix_rows(m: &Matrix3<f64>) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
}

impl Run for Args {
    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let (Some(file), []) = (&self.matches, &self.photographs[..]) else {
            return Err(Failure::usage("models are estimated from matches, not from photographs")
                .advice("cv match A B -o matches.txt, then --matches matches.txt"));
        };
        let matches = cv_io::read_matches(file)?;
        let cameras = self.cameras(context)?;
        let name = self.model.description();
        let (kind, options) = match self.model {
            Model::Homography => (ModelKind::Homography, RobustOptions::homography()),
            Model::Fundamental => (ModelKind::Fundamental, RobustOptions::fundamental()),
            Model::Essential => (ModelKind::Fundamental, RobustOptions::essential()),
        };
        let mut options = RobustOptions { confidence: self.confidence, ..options };
        options.max_iterations = self.max_iterations.unwrap_or(options.max_iterations);
        if let Some(threshold) = self.threshold {
            options.threshold = threshold;
        }
        if let Some(seed) = context.seed {
            options.seed = seed;
        }
        let pairs: &[Correspondence] = &matches.pairs;
        let result = match &cameras {
            None => estimate(pairs, kind, &options, context).map(|r| (r.robust, None, r.stages)),
            Some(cameras) => {
                estimate_calibrated(pairs, cameras, &options, context).map(|r| (r.robust, Some(r.pose), r.stages))
            }
        };
        let result = result.map_err(|error| match error {
            EstimateError::Option(_) => Failure::usage(error),
            _ => Failure::new(error),
        });
        let (robust, pose, stages) = result
            .during(format!("no {name} from {}", file.display()))
            .advice("check the matches by eye with `cv match A B --report DIR`, or pass a larger --threshold")?;
        let model = matrix_rows(&robust.model);
        let total = pairs.len();
        let text: String = model.iter().map(|r| format!("{:>16.9e} {:>16.9e} {:>16.9e}\n", r[0], r[1], r[2])).collect();
        context.report(|| report(file, name, pairs, &robust))?;
        let mut outcome = Outcome::new(stages)
            .with("kind", self.model.name())
            .with("model", model)
            .with("inliers", &robust.inliers)
            .with("matches", total)
            .with("iterations", robust.iterations)
            .with("rms_px", robust.rms)
            .with("log10_false_alarms", robust.log_nfa);
        if let Some(pose) = pose {
            let t = pose.translation;
            outcome =
                outcome.with("rotation", matrix_rows(pose.rotation.matrix())).with("translation", [t.x, t.y, t.z]);
        }
        Ok(outcome.summary(format!(
            "{text}{name}: {} of {total} matches within {} px, {:.3} px RMS, {} samples",
            robust.inliers.len(),
            options.threshold,
            robust.rms,
            robust.iterations
        )))
    }
}

/// Builds the page: the model, its inliers and their positions.
fn report(
    file: &Path,
    name: &str,
    pairs: &[Correspondence],
    found: &RobustModel<Matrix3<f64>>,
) -> Result<Report, Failure> {
    let mut page = Report::new(&format!("Estimate: {name}"));
    page.subtitle(&file.display().to_string())
        .headline("inliers", &format!("{} of {}", found.inliers.len(), pairs.len()))
        .headline("residuals", &format!("{:.3} px RMS", found.rms))
        .headline("samples drawn", &found.iterations.to_string());
    let rows: Vec<Vec<String>> =
        matrix_rows(&found.model).iter().map(|row| row.iter().map(|v| format!("{v:.5e}")).collect()).collect();
    page.section("Model").table(&format!("The {name}, row by row."), &["column 1", "column 2", "column 3"], &rows);
    page.section("Matches").figure(picture(
        &draw_displacements(pairs, &found.inliers),
        Width::Full,
        "Displacement of each match from the first view to the second: inliers green, outliers red.",
    )?);
    Ok(page)
}

/// Draws every match as a line from its position in the first view to that in the second, in one image of at most about 1000 px a side.
fn draw_displacements(pairs: &[Correspondence], inliers: &[usize]) -> RgbU8 {
    let mut is_inlier = vec![false; pairs.len()];
    inliers.iter().for_each(|&i| is_inlier[i] = true);
    // The bounding box of the inliers: outliers may lie anywhere.
    let ends = inliers.iter().flat_map(|&i| [pairs[i].a, pairs[i].b]);
    let mut frame = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    ends.for_each(|p| frame = [frame[0].min(p.x), frame[1].min(p.y), frame[2].max(p.x), frame[3].max(p.y)]);
    let (width, height) = (frame[2] - frame[0], frame[3] - frame[1]);
    let scale = (1000.0 / width.max(height).max(1.0)).min(1.0);
    let side = |length: f64| ((length * scale).ceil() as usize).clamp(1, 1000) + 20;
    let background = RgbU8::new(side(width), side(height), [24; 3]);
    let mut raster = Raster::from_rgb(background.view());
    // Inliers are drawn over outliers.
    for good in [false, true] {
        for (m, _) in pairs.iter().zip(&is_inlier).filter(|(_, inlier)| **inlier == good) {
            let at = |x: f64, y: f64| [((x - frame[0]) * scale + 10.0) as f32, ((y - frame[1]) * scale + 10.0) as f32];
            let color = if good { colors::GREEN } else { colors::RED };
            raster.line(at(m.a.x, m.a.y), at(m.b.x, m.b.y), 1.0, color);
        }
    }
    raster.into_image()
}
