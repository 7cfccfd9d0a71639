//! `cv eval`: scores of results against ground truth.

use super::depth::{fractions, read_map};
use crate::frame::{Context, Failure, Global, Outcome, Output, PNG, Run};
use crate::pictures::{Width, map, picture};
use cv_core::Mask;
use cv_pipeline::stereo::{BAD_THRESHOLDS, DisparityScores, evaluate_disparity, non_occluded};
use cv_report::{MapStyle, Report, draw_error_map};
use serde_json::{Value, json};
use std::path::PathBuf;

/// Compare a result with ground truth.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv eval disparity --estimate disparity.pfm --truth truth.pfm")]
pub(crate) struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    Disparity(Disparity),
}

/// Score a disparity map: bad pixels, averages and quantiles, as defined by Middlebury and KITTI.
///
/// A pixel without an estimate counts as bad; averages and quantiles are over pixels with an estimate. Each measure is
/// given over all pixels with ground truth and, with --mask or --truth-right, over the non-occluded ones.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv eval disparity --estimate disparity.pfm --truth disp0.pfm --mask mask0nocc.png\n  \
    cv eval disparity --estimate d.pfm --truth disp2.png --truth-right disp6.png --truth-scale 4\n  \
    cv eval disparity --estimate d.png --truth truth.npz --error error.png --json\n\n\
    The extension selects the format: .pfm, .npy, .npz (one array), else an image: KITTI's 16-bit PNG without a scale,\n\
    gray value / scale with one.")]
struct Disparity {
    /// The disparity map to score.
    #[arg(long, value_name = "FILE")]
    estimate: PathBuf,
    /// Divisor of its values [default: 256 for images, 1 for floats].
    #[arg(long, value_name = "S")]
    estimate_scale: Option<f64>,
    /// The true disparity; unknown values are not finite, or 0 in images.
    #[arg(long, value_name = "FILE")]
    truth: PathBuf,
    /// Divisor of the true values [default: 256 for images, 1 for floats].
    #[arg(long, value_name = "S")]
    truth_scale: Option<f64>,
    /// The true disparity of the right view: pixels consistent with it within 1 px are non-occluded.
    #[arg(long, value_name = "FILE", conflicts_with = "mask")]
    truth_right: Option<PathBuf>,
    /// Mask of the non-occluded pixels: white (255).
    #[arg(long, value_name = "FILE")]
    mask: Option<PathBuf>,
    /// Where to write an error image: gray up to 2 px, red and yellow above, blue without an estimate.
    #[arg(short = 'o', long, visible_alias = "output", value_name = "PNG")]
    error: Option<PathBuf>,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        match &self.what {
            What::Disparity(args) => args.error.iter().map(|path| Output::File(path, PNG)).collect(),
        }
    }

    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        match self.what {
            What::Disparity(args) => args.run(context),
        }
    }
}

impl Disparity {
    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        for scale in [self.estimate_scale, self.truth_scale].into_iter().flatten() {
            if !(scale.is_finite() && scale > 0.0) {
                return Err(Failure::usage(format!("the scale {scale} is not a positive number")));
            }
        }
        let estimate = read_map(&self.estimate, self.estimate_scale)?;
        let truth = read_map(&self.truth, self.truth_scale)?;
        let mask = match (&self.mask, &self.truth_right) {
            (Some(path), _) => {
                let gray = cv_io::read_gray_u8(path)?;
                // Middlebury marks occluded pixels 128 and unknown ones 0.
                Some(Mask::from_fn(gray.width(), gray.height(), |x, y| [gray.at(x, y)[0] == 255]))
            }
            (None, Some(path)) => Some(non_occluded(truth.view(), read_map(path, self.truth_scale)?.view())?),
            (None, None) => None,
        };
        let all = evaluate_disparity(estimate.view(), truth.view(), None)?;
        let visible = match &mask {
            Some(mask) => Some(evaluate_disparity(estimate.view(), truth.view(), Some(mask.view()))?),
            None => None,
        };
        let errors = || draw_error_map(estimate.view(), truth.view(), 2.0);
        if let Some(path) = &self.error {
            context.write(Output::File(path, PNG), |path| cv_io::write_png(path, errors().view()))?;
        }
        context.report(|| {
            let style = MapStyle::disparity();
            let range = cv_report::quantile_range(truth.view(), 0.0, 1.0);
            let style = range.map_or(style.clone(), |(low, high)| style.with_range(low, high));
            let mut page = Report::new("Disparity and ground truth");
            page.headline("bad-2.0", &format!("{:.2} %", 100.0 * all.bad[2]))
                .headline("average", &format!("{:.3} px", all.average))
                .headline("density", &format!("{:.2} %", 100.0 * all.density));
            // One measure per row, to fit narrow screens.
            let columns = rows(&all, visible.as_ref());
            let head: Vec<&str> = std::iter::once("measure").chain(columns.iter().map(|c| c[0].as_str())).collect();
            let measures: Vec<Vec<&str>> = (1..HEAD.len())
                .map(|i| std::iter::once(HEAD[i]).chain(columns.iter().map(|c| c[i].as_str())).collect())
                .collect();
            page.section("Scores").table(
                "Bad pixels are fractions of all pixels with ground truth; averages and quantiles are over pixels with an estimate.",
                &head,
                &measures,
            );
            page.section("Maps").figures(vec![
                map(estimate.view(), &style, Width::Half, "Estimate.")?,
                map(truth.view(), &style, Width::Half, "Ground truth.")?,
                picture(
                    &errors(),
                    Width::Half,
                    "Errors: gray up to 2 px, red and yellow above, blue without an estimate, black without ground truth.",
                )?,
            ]);
            page.folded("Subpixel distribution", |page| {
                page.plots(&[
                    (
                        &fractions(estimate.as_slice().iter().copied()),
                        "Distribution of the fractional part of the estimate. Peaks at whole pixels (pixel locking) indicate a \
                         biased subpixel interpolation, unless the ground truth has them too.",
                    ),
                    (&fractions(truth.as_slice().iter().copied()), "The same for the true disparities."),
                ]);
            });
            Ok(page)
        })?;
        let mut outcome = Outcome::default().with("all", scores_json(&all));
        if let Some(visible) = &visible {
            outcome = outcome.with("non_occluded", scores_json(visible));
        }
        let text: Vec<String> = std::iter::once(HEAD.map(str::to_owned).to_vec())
            .chain(rows(&all, visible.as_ref()))
            .map(|row| row.iter().map(|cell| format!("{cell:>13}")).collect())
            .collect();
        Ok(outcome.summary(text.join("\n")))
    }
}

const HEAD: [&str; 12] =
    ["pixels", "number", "density", "bad-0.5", "bad-1.0", "bad-2.0", "bad-4.0", "average", "RMS", "A50", "A90", "A95"];

fn rows(all: &DisparityScores, visible: Option<&DisparityScores>) -> Vec<Vec<String>> {
    let row = |name: &str, s: &DisparityScores| {
        let percent = |v: f64| format!("{:.2} %", 100.0 * v);
        let px = |v: f64| format!("{v:.3} px");
        let mut cells = vec![name.to_owned(), s.pixels.to_string(), percent(s.density)];
        cells.extend(s.bad.map(percent));
        cells.extend([s.average, s.rms, s.a50, s.a90, s.a95].map(px));
        cells
    };
    std::iter::once(row("all", all)).chain(visible.map(|s| row("non-occluded", s))).collect()
}

fn scores_json(s: &DisparityScores) -> Value {
    let fractions = |values: &[f64; 4]| -> serde_json::Map<String, Value> {
        BAD_THRESHOLDS.iter().zip(values).map(|(limit, v)| (format!("{limit:.1}"), json!(v))).collect()
    };
    json!({
        "pixels": s.pixels, "density": s.density, "bad": fractions(&s.bad), "bad_of_valid": fractions(&s.bad_of_valid),
        "average_px": s.average, "rms_px": s.rms, "a50_px": s.a50, "a90_px": s.a90, "a95_px": s.a95,
    })
}
