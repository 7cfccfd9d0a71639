//! `cv match`: tentative matches between two photographs.

use crate::common::{Context, Explain, Failure, Outcome, Run};
use clap::ValueEnum;
use cv_core::{Keypoint, RgbU8};
use cv_pipeline::{
    FeatureMethod, MatchingError, MatchingOptions, MatchingResult, ModelKind, PhotoFeatures, RobustOptions, Silent,
    estimate, match_photos,
};
use cv_report::{Figure, MatchStyle, Note, Report, colors, draw_keypoints, draw_matches, tile_patches};
use std::path::{Path, PathBuf};

/// Which features to match.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Features {
    /// rootSIFT: photographs that turn, zoom, or change light or viewpoint
    Sift,
    /// Harris corners with upright 8×8 patches: neighbouring frames of a film or of a slowly turned camera
    Harris,
}

/// Find the same points in two photographs.
///
/// The matches are tentative: some are wrong. `cv estimate` finds the model that most of them agree on.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cv match left.jpg right.jpg -o matches.txt
  cv match left.jpg right.jpg -o matches.txt --report out
  cv match frame1.png frame2.png --features harris --max-features 1000 -o matches.txt

The matches file has a row per match: x1 y1 x2 y2 in pixels, and the ratio of the best distance to the second best as
a score (smaller is surer).")]
pub(crate) struct Args {
    /// The first photograph.
    first: PathBuf,
    /// The second photograph.
    second: PathBuf,
    /// Where to write the matches.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Which features.
    #[arg(long, value_name = "sift|harris", default_value = "sift")]
    features: Features,
    /// Most features per photograph [default: 8192 SIFT features, 500 corners].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    max_features: Option<u32>,
    /// Largest ratio of the squared distance of the best candidate to that of the second; 1 keeps all.
    #[arg(long, value_name = "R", default_value_t = 0.66)]
    ratio: f32,
    /// Keep matches that are only nearest from the first photograph to the second.
    #[arg(long)]
    one_way: bool,
}

impl Run for Args {
    fn outputs(&self) -> Vec<&Path> {
        self.output.iter().map(PathBuf::as_path).collect()
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        if !(0.0..=1.0).contains(&self.ratio) {
            return Err(Failure::usage(format!("--ratio must be from 0 to 1, not {}", self.ratio)));
        }
        let (a, b) = (cv_io::read_rgb(&self.first)?, cv_io::read_rgb(&self.second)?);
        let options = MatchingOptions {
            method: match self.features {
                Features::Sift => FeatureMethod::Sift,
                Features::Harris => FeatureMethod::Harris,
            },
            max_features: self.max_features.map(|n| n as usize),
            ratio: (self.ratio < 1.0).then_some(self.ratio),
            mutual: !self.one_way,
            ..MatchingOptions::default()
        };
        let result = match_photos(a.view(), b.view(), &options, context).map_err(|error| {
            let path = match &error {
                MatchingError::Features { index: 2, .. } | MatchingError::NoFeatures { index: 2, .. } => &self.second,
                _ => &self.first,
            };
            Failure::new(error).advice(format!("look at {}: is it sharp, with texture, and large enough?", path.display()))
        })?;
        if result.pairs.is_empty() {
            return Err(Failure::new(format!(
                "no feature of {} ({} features) matches one of {} ({})",
                self.first.display(),
                result.features[0].described.keypoints.len(),
                self.second.display(),
                result.features[1].described.keypoints.len()
            ))
            .advice("a larger --ratio, --features sift, or photographs that show more of the same"));
        }
        if let Some(path) = &self.output {
            let scores: Vec<f64> = result.matches.iter().map(|m| f64::from(m.ratio)).collect();
            cv_io::write_matches(path, &result.pairs, Some(&scores))?;
        }
        context.report(|| self.html(&a, &b, &result, context.seed))?;
        let counts = result.features.each_ref().map(|f| f.described.keypoints.len());
        let dropped = result.features.each_ref().map(|f| f.described.dropped.len());
        Ok(Outcome::new(result.stages)
            .with("matches", result.pairs.len())
            .with("features", counts)
            .with("dropped", dropped)
            .with("method", match self.features {
                Features::Sift => "sift",
                Features::Harris => "harris",
            })
            .summary(format!(
                "{} matches between {} and {} features ({} and {} points left out near the border or on flat patches)",
                result.pairs.len(),
                counts[0],
                counts[1],
                dropped[0],
                dropped[1]
            )))
    }
}

impl Args {
    fn html(&self, a: &RgbU8, b: &RgbU8, result: &MatchingResult, seed: Option<u64>) -> Result<String, Failure> {
        let picture = |image: RgbU8, caption: &str| -> Result<Figure, Failure> {
            Ok(Figure::new(cv_io::encode_jpeg(image.view(), 88).during("cannot encode a picture")?, caption))
        };
        let mut report = Report::new("Matches");
        report.subtitle(&format!("{} and {}", self.first.display(), self.second.display()));
        let (model, inliers) = agreed(result, seed);
        report
            .headline("matches", &result.pairs.len().to_string())
            .headline("that agree", &inliers.iter().filter(|i| **i).count().to_string());
        report.section("Features");
        for (name, image, features) in [("first", a, &result.features[0]), ("second", b, &result.features[1])] {
            let kept = &features.described.keypoints;
            let mut figures = Vec::new();
            if !features.candidates.is_empty() {
                let all = draw_keypoints(image.view(), &thinned(&features.candidates), colors::RED);
                figures.push(picture(all, &format!("{name}: {} corners before spacing", features.candidates.len()))?);
            }
            let spaced = draw_keypoints(image.view(), &thinned(kept), colors::GREEN);
            figures.push(picture(spaced, &format!("{name}: {} features that are described", kept.len()))?);
            report.figures(figures);
        }
        if matches!(self.features, Features::Harris) {
            let tiles = |f: &PhotoFeatures| {
                let n = f.described.descriptors.as_slice().len().min(120 * 64);
                tile_patches(&f.described.descriptors.as_slice()[..n], 8, 24, 4)
            };
            report.section("Descriptors");
            report.figures(vec![
                picture(tiles(&result.features[0]), "8×8 patches of the first photograph (the first 120)")?,
                picture(tiles(&result.features[1]), "and of the second")?,
            ]);
        }
        report.section("Matches");
        let style = MatchStyle::default();
        let before = draw_matches(a.view(), b.view(), &result.pairs, None, &style);
        report.figure(picture(before, "Tentative matches, each in a colour of its own.")?);
        match model {
            Some(model) => {
                let after = draw_matches(a.view(), b.view(), &result.pairs, Some(&inliers), &style);
                report.figure(picture(after, &format!("The same after RANSAC: those that fit one {model} green, others red."))?);
            }
            None => {
                report.note(Note::Warning, "No homography and no fundamental matrix explains enough of these matches.");
            }
        }
        report.facts(&result.stages.iter().map(|(name, s)| (*name, format!("{s:.3} s"))).collect::<Vec<_>>());
        Ok(report.to_html())
    }
}

/// At most 3000 points, evenly taken: more would hide the picture.
fn thinned(points: &[Keypoint]) -> Vec<Keypoint> {
    points.iter().step_by((points.len() / 3000).max(1)).copied().collect()
}

/// The model that most matches agree on, and which those are. A fundamental matrix always fits somewhat more matches
/// than a homography of the same scene: it must win clearly.
fn agreed(result: &MatchingResult, seed: Option<u64>) -> (Option<&'static str>, Vec<bool>) {
    let fit = |kind: ModelKind| {
        let options = RobustOptions { seed: seed.unwrap_or(RobustOptions::default().seed), ..kind.options() };
        estimate(&result.pairs, kind, &options, &Silent).map(|r| r.robust.inliers).unwrap_or_default()
    };
    let (h, f) = (fit(ModelKind::Homography), fit(ModelKind::Fundamental));
    let (model, inliers) = match (h.len(), f.len()) {
        (0, 0) => (None, h),
        (h_count, f_count) if h_count * 10 >= f_count * 9 => (Some("homography"), h),
        _ => (Some("fundamental matrix"), f),
    };
    let mut mask = vec![false; result.pairs.len()];
    inliers.into_iter().for_each(|i| mask[i] = true);
    (model, mask)
}
