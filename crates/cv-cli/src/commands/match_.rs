//! `cv match`: tentative matches between two photographs.

use crate::frame::{Context, Explain, Failure, Outcome, Output, Run, Step, TEXT, named, steps, two_images};
use crate::photos::read_both;
use crate::pictures::{Width, picture};
use crate::words;
use cv_core::{Keypoint, Named, RgbU8};
use cv_io::FeatureRows;
use cv_pipeline::features::{CornerMeasure, DescriptorKind, Descriptors, HarrisFeatures, RatioTest, Suppression};
use cv_pipeline::{
    AffineSimulation, FeatureMethod, FeatureOptions, Features, MatchingError, MatchingOptions, MatchingResult,
    ModelKind, PrevailingModel, match_extracted, match_photos, prevailing_model,
};
use cv_report::{MatchStyle, Plot, Report, colors, draw_keypoints, draw_matches, tile_patches};
use std::path::{Path, PathBuf};

/// Match features between two photographs.
///
/// The matches are tentative and contain outliers. `cv estimate` fits a model to them robustly.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cv match left.jpg right.jpg -o matches.txt
  cv match left.jpg right.jpg -o matches.txt --report out
  cv match frame1.png frame2.png --features harris --corners shi-tomasi --max-features 1000 -o matches.txt
  cv match left.jpg right.jpg --guided fundamental -o matches.txt
  cv match left.jpg right.jpg --save-features features
  cv match left.jpg right.jpg --load-features features -o matches.txt

The matches file has a row per match: x1 y1 x2 y2 in pixels, and the ratio of the best to the second best squared
distance as a score (smaller is more distinctive).

--save-features writes for left.jpg: left.keypoints.npy (x, y, scale, angle, response), left.KIND.npy (a descriptor per row) and,
for SIFT, left.txt in COLMAP's text format. --load-features reads left.keypoints.npy with left.KIND.npy or
left.descriptors.npy, else left.txt.")]
pub(crate) struct Args {
    /// Two photographs, or a folder or quoted pattern of two.
    #[arg(required = true, value_name = "PHOTOGRAPHS")]
    photographs: Vec<PathBuf>,
    #[arg(skip)]
    first: PathBuf,
    #[arg(skip)]
    second: PathBuf,
    /// Where to write the matches.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Feature method.
    #[arg(long, value_name = "KIND", value_parser = named::<FeatureMethod>(), default_value_t)]
    features: FeatureMethod,
    /// Corner measure of mops and harris.
    #[arg(long, value_name = "MEASURE", value_parser = named::<CornerMeasure>(), default_value_t = HarrisFeatures::default().corners.measure)]
    corners: CornerMeasure,
    /// Spatial suppression of the corners of harris.
    #[arg(long, value_name = "HOW", value_parser = named::<Suppression>(), default_value_t = Suppression::default())]
    spacing: Suppression,
    /// Affine simulation of viewpoint changes (ASIFT), for sift: for very different viewing directions; about five times slower.
    #[arg(long = "asift", alias = "slanted", value_name = "WHEN", value_parser = named::<AffineSimulation>(), default_value_t = MatchingOptions::default().affine_simulation)]
    slanted: AffineSimulation,
    /// Guided matching: estimate this model and match again under its constraint. Gives more matches, few outliers, and none that contradict the model.
    #[arg(long, value_name = "MODEL", value_parser = named::<ModelKind>())]
    guided: Option<ModelKind>,
    /// Write the features of both photographs to this folder, for other programs.
    #[arg(long, value_name = "DIR")]
    save_features: Option<PathBuf>,
    /// Load the features from this folder instead of detecting them.
    #[arg(long, value_name = "DIR", conflicts_with = "save_features")]
    load_features: Option<PathBuf>,
    /// Maximum number of features per photograph [default: 8192 SIFT, 2000 MOPS, 500 Harris].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    max_features: Option<u32>,
    /// Ratio test: largest ratio of the squared distances of the best and the second best candidate; 1 disables it [default: 0.66].
    #[arg(long, value_name = "R")]
    ratio: Option<f32>,
    /// Disable the cross-check: keep matches that are not mutual nearest neighbors.
    #[arg(long)]
    one_way: bool,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        let matches = self.output.iter().map(|path| Output::File(path, TEXT));
        matches.chain(self.save_features.iter().map(|folder| Output::Folder(folder))).collect()
    }

    fn steps(&self) -> Vec<Step> {
        let guided = self.guided.map(|_| steps::GUIDED);
        [steps::FEATURES, steps::MATCH].into_iter().chain(guided).collect()
    }

    fn run(mut self, context: &Context) -> Result<Outcome, Failure> {
        [self.first, self.second] = two_images(&self.photographs)?;
        if let Some(ratio) = self.ratio.filter(|ratio| !(0.0..=1.0).contains(ratio)) {
            return Err(Failure::usage(format!("--ratio must be from 0 to 1, not {ratio}")));
        }
        let [a, b] = read_both([&self.first, &self.second], cv_io::read_rgb)?;
        let mut features = FeatureOptions::from(self.features);
        match &mut features {
            FeatureOptions::Harris(harris) => {
                harris.corners.measure = self.corners;
                harris.suppression = self.spacing;
            }
            FeatureOptions::Mops(mops) => mops.corners.measure = self.corners,
            FeatureOptions::Sift(_) | FeatureOptions::Other(_) => {}
        }
        if let Some(n) = self.max_features {
            features = features.at_most(n as usize);
        }
        let ratio = match self.ratio {
            None => RatioTest::Kind,
            Some(ratio) if ratio < 1.0 => RatioTest::Below(ratio),
            Some(_) => RatioTest::Off,
        };
        let options = MatchingOptions {
            features,
            ratio,
            mutual: !self.one_way,
            affine_simulation: self.slanted,
            guided: self.guided,
            seed: context.seed.unwrap_or(MatchingOptions::default().seed),
        };
        let result = match &self.load_features {
            Some(folder) => {
                let features = [load_features(folder, &self.first)?, load_features(folder, &self.second)?];
                match_extracted(features, &options, context)
            }
            None => match_photos(a.view(), b.view(), &options, context),
        };
        let result =
            result.map_err(|error| {
                let path =
                    match &error {
                        MatchingError::Features { index, .. } | MatchingError::NoFeatures { index, .. } => {
                            if *index == 2 { &self.second } else { &self.first }
                        }
                        _ => return words::no_matches(error, [&self.first, &self.second]),
                    };
                Failure::new(error).advice(format!("check that {} is sharp, textured and large enough", path.display()))
            })?;
        if result.matches.is_empty() {
            return Err(Failure::new(format!(
                "no feature of {} ({} features) matches one of {} ({})",
                self.first.display(),
                result.features[0].keypoints.len(),
                self.second.display(),
                result.features[1].keypoints.len()
            ))
            .advice("a larger --ratio, --features sift, or photographs with more overlap"));
        }
        if let Some(folder) = &self.save_features {
            context.write(Output::Folder(folder), |folder| {
                let photos = [&self.first, &self.second].into_iter().zip(&result.features);
                photos.into_iter().try_for_each(|(photo, features)| save_features(folder, photo, features))
            })?;
        }
        if let Some(path) = &self.output {
            let scores: Vec<f64> = result.matches.iter().map(|m| f64::from(m.ratio)).collect();
            context
                .write(Output::File(path, TEXT), |path| cv_io::write_matches(path, &result.pairs(), Some(&scores)))?;
        }
        let agreed = prevailing_model(&result.pairs(), options.seed, context)?;
        if agreed.is_none() {
            context.warn(format!(
                "no homography or fundamental matrix explains more of the {} matches than chance would: the photographs may show different scenes",
                result.matches.len()
            ));
        }
        context.report(|| self.html([&a, &b], &result, agreed.as_ref()))?;
        let inliers = agreed.as_ref().map_or_else(String::new, |model| {
            format!(", {} of which are inliers of a {}", model.robust.inliers.len(), model_words(model.kind))
        });
        let unsaved = self.output.is_none() && self.save_features.is_none() && !context.wants_report();
        let unsaved = if unsaved { "; nothing was written (-o FILE)" } else { "" };
        let counts = result.features.each_ref().map(|f| f.keypoints.len());
        let dropped = result.features.each_ref().map(|f| f.dropped.len());
        Ok(Outcome::new(result.stages)
            .with("matches", result.matches.len())
            .with("model", agreed.as_ref().map(|model| model.kind.name()))
            .with("agree", agreed.as_ref().map_or(0, |model| model.robust.inliers.len()))
            .with("features", counts)
            .with("found", result.features.each_ref().map(|f| f.detected_count()))
            .with("dropped", dropped)
            .with("method", if self.load_features.is_some() { "loaded" } else { self.features.name() })
            .with("beyond_limit", result.features.each_ref().map(|f| f.beyond_limit))
            .summary(format!(
                "{} matches{inliers}, between {} and {} features ({} and {} keypoints dropped near the border or in low-texture patches){unsaved}",
                result.matches.len(),
                counts[0],
                counts[1],
                dropped[0],
                dropped[1]
            )))
    }
}

impl Args {
    fn html(
        &self,
        [a, b]: [&RgbU8; 2],
        result: &MatchingResult,
        agreed: Option<&PrevailingModel>,
    ) -> Result<Report, Failure> {
        let mut report = Report::new("Matches");
        report.subtitle(&format!("{} and {}", self.first.display(), self.second.display()));
        let pairs = result.pairs();
        let mut inliers = vec![false; pairs.len()];
        let model = agreed.map(|found| {
            found.robust.inliers.iter().for_each(|&i| inliers[i] = true);
            model_words(found.kind)
        });
        report
            .headline("matches", &pairs.len().to_string())
            .headline("inliers", &inliers.iter().filter(|i| **i).count().to_string());
        report.section("Features");
        for (name, image, features) in [("first", a, &result.features[0]), ("second", b, &result.features[1])] {
            let kept = &features.keypoints;
            let mut figures = Vec::new();
            if !features.candidates.is_empty() {
                let some = thinned(&features.candidates);
                let all = draw_keypoints(image.view(), &some, colors::RED);
                let caption = format!(
                    "{name}: {} corners before suppression{}",
                    features.candidates.len(),
                    shown(some.len(), features.candidates.len())
                );
                figures.push(picture(&all, Width::Half, &caption)?);
            }
            let some = thinned(kept);
            let spaced = draw_keypoints(image.view(), &some, colors::GREEN);
            let caption = format!("{name}: {} described features{}", kept.len(), shown(some.len(), kept.len()));
            figures.push(picture(&spaced, Width::Half, &caption)?);
            report.figures(figures);
        }
        if let Some(side) = result.features[0].descriptors.kind().patch {
            let tiles = |f: &Features| {
                let n = f.descriptors.as_slice().len().min(120 * side * side);
                tile_patches(&f.descriptors.as_slice()[..n], side, 24, 4)
            };
            report.section("Descriptors");
            report.figures(vec![
                picture(&tiles(&result.features[0]), Width::Half, "Patches of the first image (the first 120).")?,
                picture(&tiles(&result.features[1]), Width::Half, "Patches of the second image.")?,
            ]);
        }
        report.section("Matches");
        let style = MatchStyle::default();
        let before = draw_matches(a.view(), b.view(), &pairs, None, &style);
        report.figure(picture(&before, Width::Full, "Tentative matches, each in its own color.")?);
        if let Some(model) = model {
            let after = draw_matches(a.view(), b.view(), &pairs, Some(&inliers), &style);
            let caption = format!("After RANSAC: inliers of one {model} green, outliers red.");
            report.figure(picture(&after, Width::Full, &caption)?);
        }
        statistics(&mut report, result);
        Ok(report)
    }
}

fn model_words(kind: ModelKind) -> &'static str {
    match kind {
        ModelKind::Homography => "homography",
        ModelKind::Fundamental => "fundamental matrix",
    }
}

/// `FOLDER/STEM.ending` for a photograph.
fn beside(folder: &Path, photo: &Path, ending: &str) -> PathBuf {
    let mut name = photo.file_stem().unwrap_or_default().to_owned();
    name.push(".");
    name.push(ending);
    folder.join(name)
}

fn save_features(folder: &Path, photo: &Path, features: &Features) -> Result<(), Failure> {
    let (keypoints, descriptors) = (&features.keypoints, &features.descriptors);
    let name =
        if DescriptorKind::BUILT_IN.contains(&descriptors.kind()) { descriptors.kind().name } else { "descriptors" };
    cv_io::npy::write(beside(folder, photo, "keypoints.npy"), &cv_io::keypoints_to_npy(keypoints))?;
    let array = cv_io::descriptors_to_npy(descriptors.dimension(), descriptors.as_slice());
    cv_io::npy::write(beside(folder, photo, &format!("{name}.npy")), &array)?;
    if [DescriptorKind::SIFT, DescriptorKind::ROOT_SIFT].contains(&descriptors.kind()) {
        let rows = FeatureRows {
            keypoints: keypoints.clone(),
            dimension: descriptors.dimension(),
            descriptors: descriptors.as_slice().to_vec(),
        };
        cv_io::write_colmap_features(beside(folder, photo, "txt"), &rows)?;
    }
    Ok(())
}

fn load_features(folder: &Path, photo: &Path) -> Result<Features, Failure> {
    let points = beside(folder, photo, "keypoints.npy");
    let (rows, kind, path) = if points.exists() {
        let keypoints = cv_io::keypoints_from_npy(&cv_io::npy::read(&points)?).during(points.display().to_string())?;
        let named =
            DescriptorKind::BUILT_IN.map(|kind| (Some(kind), beside(folder, photo, &format!("{}.npy", kind.name))));
        let (kind, path) = named
            .into_iter()
            .chain([(None, beside(folder, photo, "descriptors.npy"))])
            .find(|(_, path)| path.exists())
            .ok_or_else(|| Failure::new(format!("there are no descriptors beside {}", points.display())))?;
        let array = cv_io::npy::read(&path)?;
        let (dimension, descriptors) = cv_io::descriptors_from_npy(&array).during(path.display().to_string())?;
        (FeatureRows { keypoints, dimension, descriptors }, kind, path)
    } else {
        let path = beside(folder, photo, "txt");
        (cv_io::read_colmap_features(&path)?, None, path)
    };
    let kind = kind.unwrap_or(DescriptorKind::foreign(rows.dimension));
    let counts = (rows.keypoints.len(), rows.descriptors.len().checked_div(rows.dimension).unwrap_or(0));
    let finite = rows.descriptors.iter().all(|v| v.is_finite());
    let fits = kind.dimension == rows.dimension && counts.0 == counts.1 && finite;
    let descriptors = Descriptors::from_vec(kind, rows.descriptors).filter(|_| fits).ok_or_else(|| {
        let reason = format!(
            "{}: {} keypoints with {} descriptors of dimension {} are not {kind} features (or a value is not finite)",
            path.display(),
            counts.0,
            counts.1,
            rows.dimension
        );
        Failure::new(reason)
    })?;
    Ok(Features { keypoints: rows.keypoints, descriptors, ..Features::new(kind) })
}

/// Subsamples points evenly to at most 1000, so that they do not hide the image.
fn thinned(points: &[Keypoint]) -> Vec<Keypoint> {
    points.iter().step_by(points.len().div_ceil(1000).max(1)).copied().collect()
}

/// Notes that only some of the points are drawn.
fn shown(some: usize, all: usize) -> String {
    if some < all { format!(", {some} of them drawn") } else { String::new() }
}

/// Adds feature counts, the distribution of ratios, and times.
fn statistics(report: &mut Report, result: &MatchingResult) {
    report.section("Statistics");
    let row = |name: &str, count: &dyn Fn(&Features) -> usize| {
        let [first, second] = result.features.each_ref().map(|f| count(f).to_string());
        vec![name.to_owned(), first, second]
    };
    report.table(
        "Features",
        &["number of", "first", "second"],
        &[
            row("keypoints detected", &|f| f.detected_count()),
            row("dropped near the border or in low-texture patches", &|f| f.dropped.len()),
            row("beyond the maximum number", &|f| f.beyond_limit),
            row("described", &|f| f.keypoints.len()),
        ],
    );
    let ratios: Vec<f64> = result.matches.iter().map(|m| f64::from(m.ratio)).collect();
    let plot = Plot::new("Distinctiveness of the matches", "ratio", "matches").histogram_within(
        "matches",
        &ratios,
        20,
        (0.0, 1.0),
    );
    report.plot(
        &plot,
        "Ratio of the squared distances of the best and the second best candidate: small ratios are distinctive.",
    );
    report.times(&result.stages);
}
