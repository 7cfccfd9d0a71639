//! `cv segment`: color segmentation.

mod files;

use crate::frame::{
    Context, Explain, Failure, Global, JSON, Outcome, Output, Run, Step, expand_images, named, one_each, same_file,
    steps,
};
use crate::masks::{stem, without_masks};
use crate::pictures::{Width, picture};
use cv_core::{Mask, Named, RgbU8, Stage};
use cv_pipeline::segmentation::{
    ColorModel, ColorSpace, ConfusionMatrix, DetectOptions, Detection, Labeled, Regions, Rule, SegmentError,
    TrainOptions,
};
use cv_pipeline::{detect, segment, train_segment};
use cv_report::{Figure, Note, Report, colors, overlay_comparison, overlay_mask};
use files::{Pair, pair, read_pair};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Maximum number of photographs shown in a report.
const REPORT_PHOTOS: usize = 40;

/// Segment an object by its color: train a color model on masks, predict masks, evaluate them.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv segment train --images photos --masks masks --model ball.json\n  \
    cv segment predict --model ball.json new/*.jpg -o found\n  \
    cv segment eval --model ball.json --images test --masks test-masks")]
pub(crate) struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    Train(Train),
    Predict(Predict),
    Eval(Eval),
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        match &self.what {
            What::Train(args) => vec![Output::File(&args.model, JSON)],
            What::Predict(args) => vec![Output::Folder(&args.output)],
            What::Eval(_) => Vec::new(),
        }
    }

    fn has_no_use_for(&self) -> &'static [Global] {
        match &self.what {
            What::Train(_) => &[],
            What::Predict(_) | What::Eval(_) => &[Global::Seed],
        }
    }

    fn steps(&self) -> Vec<Step> {
        match &self.what {
            What::Train(_) => vec![steps::READ, steps::COLORS, steps::REGIONS, steps::THRESHOLD],
            What::Predict(_) => vec![steps::PREDICT],
            What::Eval(_) => vec![steps::SCORE],
        }
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        match self.what {
            What::Train(args) => args.run(context),
            What::Predict(args) => args.run(context),
            What::Eval(args) => args.run(context),
        }
    }
}

/// Photographs and the folder of their masks.
#[derive(Debug, clap::Args)]
struct Labels {
    /// Photographs, or folders of them.
    #[arg(long, value_name = "DIR|FILES", num_args = 1.., required = true)]
    images: Vec<PathBuf>,
    /// The folder of the masks, white where the object is. The mask of NAME.jpg is NAME_mask.png or NAME.png.
    #[arg(long, value_name = "DIR")]
    masks: PathBuf,
}

/// Train a color model on photographs and masks.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv segment train --images photos --masks masks --model ball.json\n  \
    cv segment train --images a.jpg b.jpg --masks . --space lab --components 3 --model ball.json --report out")]
struct Train {
    #[command(flatten)]
    labels: Labels,
    /// Where to write the model.
    #[arg(short = 'o', long, visible_alias = "output", value_name = "JSON")]
    model: PathBuf,
    /// Color space.
    #[arg(long, value_parser = named::<ColorSpace>(), default_value_t = TrainOptions::default().space)]
    space: ColorSpace,
    /// Components of the Gaussian mixture of the object's colors, 1 to 64.
    #[arg(long, value_name = "K", default_value_t = TrainOptions::default().components)]
    components: usize,
    /// Components of the Gaussian mixture of the background's colors, 1 to 63.
    #[arg(long, value_name = "K", default_value_t = TrainOptions::default().background_components)]
    background_components: usize,
    /// Decision rule for a pixel.
    #[arg(long, value_parser = named::<Rule>(), default_value_t = TrainOptions::default().rule)]
    rule: Rule,
    /// Connected components to keep.
    #[arg(long, value_parser = named::<Regions>(), default_value_t = TrainOptions::default().regions)]
    regions: Regions,
    /// Radius of the disc of the morphological opening; 0 disables it.
    #[arg(long, value_name = "PX", default_value_t = TrainOptions::default().open_radius)]
    open: usize,
    /// Radius of the disc of the morphological closing; 0 disables it.
    #[arg(long, value_name = "PX", default_value_t = TrainOptions::default().close_radius)]
    close: usize,
    /// Sigma of the Gaussian smoothing of pixel scores.
    #[arg(long, value_name = "PX", default_value_t = TrainOptions::default().smoothing)]
    smoothing: f32,
}

impl Train {
    fn options(&self, context: &Context) -> TrainOptions {
        let default = TrainOptions::default();
        TrainOptions {
            space: self.space,
            components: self.components,
            background_components: self.background_components,
            rule: self.rule,
            regions: self.regions,
            open_radius: self.open,
            close_radius: self.close,
            smoothing: self.smoothing,
            seed: context.seed.unwrap_or(default.seed),
            ..default
        }
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let pairs = pair(&self.labels.images, &self.labels.masks, context)?;
        let mut photos = Vec::with_capacity(pairs.len());
        let stage = Stage::new(context, "read", pairs.len())?;
        for pair in &pairs {
            photos.push(read_pair(pair, context)?);
            stage.add(1)?;
        }
        let labeled: Vec<Labeled<'_>> = photos.iter().map(|(photo, mask)| (photo.view(), mask.view())).collect();
        let options = self.options(context);
        let training = train_segment(&labeled, &options, context).map_err(|error| training_failure(error, &pairs))?;
        let trained = &training.trained;
        context.write(Output::File(&self.model, JSON), |path| write_model(path, &trained.model))?;
        let total: ConfusionMatrix = trained.scores.iter().copied().sum();
        if total.f1() < 0.5 {
            context.warn(format!(
                "even on the training photographs, F1 is only {:.3}: the colors of object and background are not separable",
                total.f1()
            ));
        }
        context.report(|| {
            let mut page = Report::new("Segmentation: training");
            headline(&mut page, &total, photos.len());
            page.note(Note::Info, "These are scores on the training photographs. Scores on other photographs will be lower: use cv segment eval.");
            page.section("Model").facts("Parameters of the trained model.", &[
                ("color space", options.space.name().to_uppercase()),
                ("mixture components of the object", trained.model.foreground().components.len().to_string()),
                ("mixture components of the background", trained.model.background().map_or(0, |b| b.components.len()).to_string()),
                ("threshold", format!("{:.2} nats", trained.model.threshold())),
                ("connected components kept", if trained.model.cleanup().largest { "the largest" } else { "all" }.to_owned()),
                ("pixels of the object", trained.foreground_pixels.to_string()),
                ("other pixels", trained.background_pixels.to_string()),
            ]);
            let shown: Result<Vec<Figure>, Failure> = pairs
                .iter()
                .zip(&photos)
                .zip(&trained.scores)
                .take(REPORT_PHOTOS)
                .map(|((pair, (photo, mask)), scores)| {
                    comparison(&pair.photo, photo, &trained.model.predict(photo.view(), context)?, mask, scores)
                })
                .collect();
            page.section("Photographs").paragraph(LEGEND).figures(shown?);
            Ok(page)
        })?;
        let summary =
            format!("{} photographs, training F1 {:.3}; model: {}", pairs.len(), total.f1(), self.model.display());
        Ok(with_scores(Outcome::new(training.stages), &pairs, &trained.scores)
            .with("model", &self.model)
            .with("foreground_pixels", trained.foreground_pixels)
            .with("background_pixels", trained.background_pixels)
            .with("threshold", trained.model.threshold())
            .with("largest", trained.model.cleanup().largest)
            .summary(summary))
    }
}

/// Detect the object in photographs, write its masks and measure it.
///
/// The mask of NAME.jpg is written as NAME_mask.png, white where the object is; all black if it is not found. A region of the object's color is accepted as the
/// object if its score, the agreement in color and shape with the training objects, is at least --min-score.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv segment predict --model ball.json a.jpg b.jpg -o found\n  \
    cv segment predict --model ball.json photos -o found --report found\n  \
    cv segment predict --model ball.json photos -o found --min-score 0")]
struct Predict {
    /// The model.
    #[arg(long, value_name = "JSON")]
    model: PathBuf,
    /// Photographs, or folders of them.
    #[arg(required = true)]
    images: Vec<PathBuf>,
    /// The folder to write the masks into; created if missing.
    #[arg(short, long, visible_alias = "out", value_name = "DIR")]
    output: PathBuf,
    /// Smallest score of an object, 0 to 1: the expected fraction of missed training objects, if their features are Gaussian. 0 accepts every region.
    #[arg(long, value_name = "P", default_value_t = DetectOptions::default().min_score)]
    min_score: f64,
}

impl Predict {
    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let options = DetectOptions { min_score: self.min_score };
        options.validate().map_err(Failure::usage)?;
        let given = expand_images(&self.images)?;
        let photos = without_masks(given.clone());
        let outputs: Vec<PathBuf> = photos.iter().map(|p| self.output.join(format!("{}_mask.png", stem(p)))).collect();
        one_each(&photos, &outputs)?;
        let model = read_model(&self.model)?;
        for (i, output) in outputs.iter().enumerate() {
            // Hand-drawn masks are often in the folder of their photographs, and must not be overwritten.
            // A bare file name has an empty parent, which means the current folder.
            let folder = Path::new(".").join(photos[i].parent().unwrap_or(Path::new("")));
            let beside = output.exists() && same_file(&folder, &self.output);
            if beside || given.iter().any(|path| same_file(path, output)) {
                return Err(Failure::new(format!("{} exists and would be overwritten", output.display()))
                    .advice("name another folder with -o"));
            }
        }
        let mut stages: Vec<(&'static str, f64)> = Vec::new();
        let (mut images, mut figures, mut rows, mut found) = (Vec::new(), Vec::new(), Vec::new(), 0);
        let mut missing = Vec::new();
        // Encoded masks are small: they are written at the end, so that an unreadable photograph leaves no partial output.
        let mut masks = Vec::new();
        let stage = Stage::new(context, "predict", photos.len())?;
        for (path, output) in photos.iter().zip(&outputs) {
            let photo = cv_io::read_rgb(path)?;
            let result = detect(photo.view(), &model, &options, &stage)?;
            masks.push(cv_io::encode_png(result.mask.view()).during(path.display())?);
            let is_found = result.objects.iter().any(|o| o.found);
            found += usize::from(is_found);
            let mut image = json!({ "path": path, "mask": output, "fraction": result.fraction, "found": is_found });
            let best = result.objects.first();
            image["score"] = json!(best.and_then(|b| b.score));
            image["objects"] = result.objects.iter().map(region_json).collect();
            // Measures of the best region; null if it is not accepted as the object.
            for key in ["box", "center", "area", "axes", "angle_degrees"] {
                image[key] = if is_found { image["objects"][0][key].clone() } else { Value::Null };
            }
            images.push(image);
            rows.push(row(path, best));
            if let (false, Some(score)) = (is_found, best.and_then(|b| b.score)) {
                missing.push(format!("{} (best score {score:.1e})", path.display()));
            } else if !is_found {
                missing.push(path.display().to_string());
            }
            if context.wants_report() && figures.len() < REPORT_PHOTOS {
                let overlay = overlay_mask(photo.view(), result.mask.view(), colors::GREEN, 0.35);
                let score = best.and_then(|b| b.score).map_or_else(String::new, |s| format!(", score {s:.3}"));
                let words = if is_found {
                    format!("{}: {:.2} % marked{score}", name(path), 100.0 * result.fraction)
                } else {
                    format!("{}: not found{score}", name(path))
                };
                figures.push(picture(&overlay, Width::Half, &words)?);
            }
            add_stages(&mut stages, &result.stages);
            stage.add(1)?;
        }
        context.write(Output::Folder(&self.output), |_| {
            outputs.iter().zip(&masks).try_for_each(|(output, mask)| cv_io::write_bytes(output, mask))
        })?;
        context.report(|| {
            let mut page = Report::new("Segmentation");
            page.headline("photographs", &photos.len().to_string()).headline("with the object", &found.to_string());
            page.section("Objects").table(
                "The best region of each photograph; axes are the semi-axes of the ellipse of the same moments.",
                &["photograph", "result", "score", "center, px", "area, px", "axes, px", "angle"],
                &rows,
            );
            page.section("Photographs").paragraph("Predicted masks in green.").figures(figures);
            Ok(page)
        })?;
        let mut summary =
            format!("{} photographs, the object found in {found}; masks: {}", photos.len(), self.output.display());
        if let [first, rest @ ..] = missing.as_slice() {
            summary.push_str(&format!("; not found in {first}"));
            if !rest.is_empty() {
                summary.push_str(&format!(" and {} more", rest.len()));
            }
        }
        Ok(Outcome::new(stages).with("images", images).summary(summary))
    }
}

/// Returns the file name of a path, for tables.
fn name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Formats a row of the report's table of objects.
fn row(path: &Path, best: Option<&Detection>) -> Vec<String> {
    let mut row = vec![name(path)];
    let Some(best) = best else {
        row.push("not found".to_owned());
        row.resize(7, String::new());
        return row;
    };
    let region = &best.region;
    row.extend([
        if best.found { "found" } else { "not found" }.to_owned(),
        best.score.map_or_else(|| "unknown".to_owned(), |score| format!("{score:.3}")),
        format!("{:.1}, {:.1}", region.center.x, region.center.y),
        region.area.to_string(),
        format!("{:.1}, {:.1}", region.axes[0], region.axes[1]),
        format!("{:.0}°", region.angle.to_degrees()),
    ]);
    row
}

/// Returns a region as JSON: box `[x, y, width, height]`, center, area and semi-axes in pixels, angle in degrees, color in nats, extent and axis ratio from 0 to 1.
fn region_json(object: &Detection) -> Value {
    let region = &object.region;
    json!({
        "found": object.found,
        "score": object.score,
        "box": [region.left, region.top, region.width, region.height],
        "center": [region.center.x, region.center.y],
        "area": region.area,
        "axes": region.axes,
        "angle_degrees": region.angle.to_degrees(),
        "truncated": region.truncated,
        "color": object.color,
        "extent": region.extent(),
        "axis_ratio": region.axis_ratio(),
    })
}

/// Evaluate a model on photographs with masks: precision, recall and F1.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv segment eval --model ball.json --images test --masks test-masks\n  \
    cv segment eval --model ball.json --images a.jpg b.jpg --masks masks --json --report out")]
struct Eval {
    /// The model.
    #[arg(long, value_name = "JSON")]
    model: PathBuf,
    #[command(flatten)]
    labels: Labels,
}

impl Eval {
    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let model = read_model(&self.model)?;
        let pairs = pair(&self.labels.images, &self.labels.masks, context)?;
        let mut stages: Vec<(&'static str, f64)> = Vec::new();
        let (mut scores, mut figures) = (Vec::new(), Vec::new());
        let stage = Stage::new(context, "score", pairs.len())?;
        for (i, pair) in pairs.iter().enumerate() {
            let (photo, truth) = read_pair(pair, context)?;
            if photo.size() != truth.size() {
                let error = SegmentError::SizeMismatch { index: i, photo: photo.size(), mask: truth.size() };
                return Err(training_failure(error, &pairs));
            }
            let result = segment(photo.view(), &model, &stage)?;
            let score = ConfusionMatrix::new(result.mask.view(), truth.view())?;
            if context.wants_report() && figures.len() < REPORT_PHOTOS {
                figures.push(comparison(&pair.photo, &photo, &result.mask, &truth, &score)?);
            }
            scores.push(score);
            add_stages(&mut stages, &result.stages);
            stage.add(1)?;
        }
        let total: ConfusionMatrix = scores.iter().copied().sum();
        context.report(|| {
            let mut page = Report::new("Segmentation: scores");
            headline(&mut page, &total, pairs.len());
            let row = |(pair, s): (&Pair, &ConfusionMatrix)| {
                let number = |v: f64| format!("{v:.4}");
                vec![name(&pair.photo), number(s.precision()), number(s.recall()), number(s.f1())]
            };
            let rows: Vec<Vec<String>> = pairs.iter().zip(&scores).map(row).collect();
            page.section("Scores").table(
                "Scores of each photograph.",
                &["photograph", "precision", "recall", "F1"],
                &rows,
            );
            page.section("Photographs").paragraph(LEGEND).figures(figures);
            Ok(page)
        })?;
        let summary = format!(
            "{} photographs: precision {:.4}, recall {:.4}, F1 {:.4}",
            pairs.len(),
            total.precision(),
            total.recall(),
            total.f1()
        );
        Ok(with_scores(Outcome::new(stages), &pairs, &scores).summary(summary))
    }
}

const LEGEND: &str = "Green: true positive. Red: false positive. Blue: false negative.";

/// Adds the scores over all pixels, and of each photograph.
fn with_scores(outcome: Outcome, pairs: &[Pair], scores: &[ConfusionMatrix]) -> Outcome {
    let total: ConfusionMatrix = scores.iter().copied().sum();
    let images: Vec<Value> = pairs
        .iter()
        .zip(scores)
        .map(|(pair, s)| {
            json!({ "path": pair.photo, "mask": pair.mask, "precision": s.precision(), "recall": s.recall(), "f1": s.f1() })
        })
        .collect();
    outcome
        .with("precision", total.precision())
        .with("recall", total.recall())
        .with("f1", total.f1())
        .with("images", images)
}

fn headline(page: &mut Report, total: &ConfusionMatrix, photos: usize) {
    page.headline("F1", &format!("{:.3}", total.f1()))
        .headline("precision", &format!("{:.3}", total.precision()))
        .headline("recall", &format!("{:.3}", total.recall()))
        .headline("photographs", &photos.to_string());
}

fn comparison(
    path: &Path,
    photo: &RgbU8,
    mask: &Mask,
    truth: &Mask,
    scores: &ConfusionMatrix,
) -> Result<Figure, Failure> {
    let drawn = overlay_comparison(photo.view(), mask.view(), truth.view());
    picture(&drawn, Width::Half, &format!("{}: F1 {:.3}", name(path), scores.f1()))
}

fn add_stages(sums: &mut Vec<(&'static str, f64)>, stages: &[(&'static str, f64)]) {
    for &(name, seconds) in stages {
        match sums.iter_mut().find(|(n, _)| *n == name) {
            Some((_, sum)) => *sum += seconds,
            None => sums.push((name, seconds)),
        }
    }
}

/// Words an error, with the names of the files and a remedy.
fn training_failure(error: SegmentError, pairs: &[Pair]) -> Failure {
    match &error {
        SegmentError::SizeMismatch { index, photo, mask } if *index < pairs.len() => Failure::new(format!(
            "{} has {}×{} pixels, its mask {} has {}×{}",
            pairs[*index].photo.display(),
            photo.0,
            photo.1,
            pairs[*index].mask.display(),
            mask.0,
            mask.1
        ))
        .advice("a mask of the photograph's full size, in the orientation shown by viewers"),
        SegmentError::NoForeground { .. } => {
            Failure::from(error).advice("masks that are white (255) on the object and black elsewhere")
        }
        SegmentError::NoBackground { .. } => {
            Failure::from(error).advice("masks that are black (0) where the object is not")
        }
        SegmentError::Option(_) => Failure::usage(error),
        _ => error.into(),
    }
}

fn write_model(path: &Path, model: &ColorModel) -> Result<(), Failure> {
    let mut text = serde_json::to_string_pretty(model).during("cannot write the model as JSON")?;
    text.push('\n');
    Ok(cv_io::write_bytes(path, text.as_bytes())?)
}

fn read_model(path: &Path) -> Result<ColorModel, Failure> {
    let bytes = cv_io::read_bytes(path)?;
    // Parsed as a generic value first: another version is reported as such, not as a missing field.
    let value: Result<Value, _> = serde_json::from_slice(&bytes);
    let value = value.during(format!("{} is not a segmentation model", path.display())).advice(TRAIN)?;
    ColorModel::check_schema(value["schema"].as_u64()).during(path.display()).advice(TRAIN)?;
    serde_json::from_value(value).during(format!("{} is not a segmentation model", path.display())).advice(TRAIN)
}

const TRAIN: &str = "name a file written by cv segment train";
