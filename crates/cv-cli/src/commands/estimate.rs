//! `cv estimate`: a homography or fundamental matrix from a matches file.

use crate::common::{Context, Explain, Failure, Outcome, Run};
use clap::ValueEnum;
use cv_pipeline::{EstimateError, ModelKind, RobustOptions, estimate};
use std::path::PathBuf;

/// Which model to estimate.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Model {
    /// A plane, or a camera that only turned: b ~ H a
    Homography,
    /// A general scene: bᵀ F a = 0
    Fundamental,
}

/// Estimate a homography or fundamental matrix from matches of which many may be wrong.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cv match left.jpg right.jpg -o matches.txt && cv estimate homography --matches matches.txt
  cv estimate fundamental --matches matches.txt --threshold 0.5 --json

The matches file has a row per match, `x1 y1 x2 y2` in pixels with an optional score; `#` starts a comment.")]
pub(crate) struct Args {
    /// What the two views have in common.
    model: Model,
    /// The matches.
    #[arg(long, value_name = "FILE")]
    matches: PathBuf,
    /// Largest error of an inlier in pixels [default: 3 for a homography, 1 for a fundamental matrix].
    #[arg(long, value_name = "PX")]
    threshold: Option<f64>,
    /// Probability with which a sample without outliers is drawn before the search stops.
    #[arg(long, value_name = "P", default_value_t = RobustOptions::default().confidence)]
    confidence: f64,
    /// Most samples drawn.
    #[arg(long, value_name = "N", default_value_t = RobustOptions::default().max_iterations)]
    max_iterations: usize,
}

impl Run for Args {
    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let matches = cv_io::read_matches(&self.matches)?;
        let (kind, name) = match self.model {
            Model::Homography => (ModelKind::Homography, "homography"),
            Model::Fundamental => (ModelKind::Fundamental, "fundamental matrix"),
        };
        let mut options =
            RobustOptions { confidence: self.confidence, max_iterations: self.max_iterations, ..kind.options() };
        if let Some(threshold) = self.threshold {
            options.threshold = threshold;
        }
        if let Some(seed) = context.seed {
            options.seed = seed;
        }
        let result = estimate(&matches.pairs, kind, &options, context).map_err(|error| match error {
            EstimateError::BadOption { .. } => Failure::usage(error),
            _ => Failure::new(error),
        });
        let result = result.during(format!("no {name} from {}", self.matches.display())).advice(
            "check the matches by eye with `cv match A B --report DIR`, or pass a larger --threshold",
        )?;
        let robust = &result.robust;
        let m = &robust.model;
        let rows: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]));
        let total = matches.pairs.len();
        let text: String = rows.iter().map(|r| format!("{:>16.9e} {:>16.9e} {:>16.9e}\n", r[0], r[1], r[2])).collect();
        Ok(Outcome::new(result.stages)
            .with("kind", if matches!(self.model, Model::Homography) { "homography" } else { "fundamental" })
            .with("model", rows)
            .with("inliers", &robust.inliers)
            .with("matches", total)
            .with("iterations", robust.iterations)
            .with("rms_px", robust.rms)
            .summary(format!(
                "{text}{name}: {} of {total} matches within {} px, {:.3} px RMS, {} samples",
                robust.inliers.len(),
                options.threshold,
                robust.rms,
                robust.iterations
            )))
    }
}
