//! `cv demo`: every pipeline on rendered scenes with exact ground truth.

mod calibrate;
mod depth;
mod homography;
mod many_views;
mod panorama;
mod reconstruct;
mod segment;

use crate::frame::{Context, Failure, Outcome, Output, Run, Step, steps};
use crate::pictures::{Width, map, picture};
use cv_core::{Camera, GrayF32, RgbU8, Stage};
use cv_report::{Figure, MapStyle, Note, Report, draw_map};
use serde::Serialize;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Run every pipeline on rendered scenes and compare the results with the ground truth.
///
/// Renders images of synthetic rooms with noise, lens blur and uneven illumination, runs each pipeline on them and
/// measures the exact error of every result. Writes the images, the results and report.html into a folder. The exit
/// code is 1 if an error exceeds its limit.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  cv demo\n  cv demo -o /tmp/demo --seed 7\n  cv demo --json --quiet > demo.json")]
pub(crate) struct Args {
    /// The folder to write into; created if missing.
    #[arg(short, long, visible_alias = "out", value_name = "DIR", default_value = "cv-demo")]
    output: PathBuf,
}

/// A measured error or score of a result, with its limit.
#[derive(Debug, Serialize)]
struct Check {
    job: &'static str,
    measure: &'static str,
    truth: String,
    result: String,
    /// The measured value: an error (at most `bar`) or a fraction (at least `bar`).
    value: f64,
    bar: f64,
    at_most: bool,
    unit: &'static str,
    passed: bool,
}

impl Check {
    /// An error that must not exceed the limit.
    fn at_most(job: &'static str, measure: &'static str, value: f64, bar: f64, unit: &'static str) -> Self {
        let passed = value <= bar;
        Self { job, measure, truth: String::new(), result: String::new(), value, bar, at_most: true, unit, passed }
    }

    /// A fraction that must reach the limit.
    fn at_least(job: &'static str, measure: &'static str, value: f64, bar: f64, unit: &'static str) -> Self {
        Self { at_most: false, passed: value >= bar, ..Self::at_most(job, measure, value, bar, unit) }
    }

    /// Adds the two compared values as text.
    fn of(self, truth: impl Into<String>, result: impl Into<String>) -> Self {
        Self { truth: truth.into(), result: result.into(), ..self }
    }

    fn value_text(&self) -> String {
        with_unit(self.value, self.unit)
    }

    fn bar_text(&self) -> String {
        format!("{}\u{a0}{}", if self.at_most { "≤" } else { "≥" }, with_unit(self.bar, self.unit))
    }
}

fn with_unit(value: f64, unit: &str) -> String {
    match unit {
        "%" => format!("{:.1}\u{a0}%", 100.0 * value),
        "°" => format!("{value:.3}°"),
        "" => format!("{value:.3}"),
        _ => format!("{value:.3}\u{a0}{unit}"),
    }
}

/// Shared inputs of the jobs.
struct Demo<'a> {
    context: &'a Context,
    seed: u64,
    out: &'a Path,
}

/// Adds a job's section to the report.
type Section = Box<dyn FnOnce(&mut Report)>;

/// The result of a job.
struct Part {
    checks: Vec<Check>,
    /// Adds the job's section to the report.
    section: Section,
}

impl Part {
    fn new(checks: Vec<Check>, section: impl FnOnce(&mut Report) + 'static) -> Self {
        Self { checks, section: Box::new(section) }
    }

    /// A pipeline that failed: a failed check, with its error in the report.
    fn failed(job: &'static str, reason: &impl std::fmt::Display) -> Self {
        let reason = reason.to_string();
        let check = Check::at_most(job, "a result at all", f64::INFINITY, 0.0, "").of("", reason.clone());
        Self::new(vec![check], move |page| {
            page.section(job).note(Note::Failure, &reason);
        })
    }
}

/// Renders, runs a pipeline, and compares.
type Job = fn(&Demo<'_>) -> Result<Part, Failure>;

/// In the order of the report.
const JOBS: [(&str, Job); 7] = [
    ("segment", segment::run),
    ("homography", homography::run),
    ("panorama", panorama::run),
    ("reconstruct", reconstruct::run),
    ("sfm", many_views::run),
    ("depth", depth::run),
    ("calibrate", calibrate::run),
];

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        vec![Output::Folder(&self.output)]
    }

    fn steps(&self) -> Vec<Step> {
        vec![steps::DEMO]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        context.write(Output::Folder(&self.output), |out| run(out, context))
    }
}

/// Runs all jobs and writes their results.
fn run(out: &Path, context: &Context) -> Result<Outcome, Failure> {
    let demo = Demo { context, seed: context.seed.unwrap_or(1), out };
    let (mut checks, mut sections, mut stages) = (Vec::new(), Vec::new(), Vec::new());
    let stage = Stage::new(context, "demo", JOBS.len())?;
    for (name, job) in JOBS {
        context.note(format!("{name} …"));
        let start = Instant::now();
        let part = job(&demo)?;
        // A cancelled job is not a failed one.
        stage.add(1)?;
        checks.extend(part.checks);
        sections.push(part.section);
        stages.push((name, start.elapsed().as_secs_f64()));
    }
    let page = demo.page(&checks, sections);
    let html = context.page(page.clone());
    let path = out.join("report.html");
    cv_io::write_bytes(&path, html.as_bytes())?;
    context.report(|| Ok(page))?;
    let missed = checks.iter().filter(|c| !c.passed).count();
    let outcome = Outcome::new(stages)
        .summary(format!("\n{}\nreport: {}", table(&checks), path.display()))
        .with("passed", missed == 0)
        .with("seed", demo.seed)
        .with("checks", checks);
    Ok(match missed {
        0 => outcome,
        n => outcome.with_failure(
            Failure::new(format!("{n} of the results exceed their limit"))
                .advice(format!("look at {}", path.display())),
        ),
    })
}

impl Demo<'_> {
    /// The camera of all rendered images.
    fn camera(&self) -> Camera {
        Camera::from_focal(640, 480, 520.0)
    }

    /// Writes an image into the folder and returns it as a figure of the report.
    fn figure(&self, name: &str, image: &RgbU8, caption: &str) -> Result<Figure, Failure> {
        cv_io::write_png(self.out.join(name), image.view())?;
        picture(image, Width::Full, caption)
    }

    /// As [`Demo::figure`], for a color-mapped array of floats.
    fn map(&self, name: &str, values: &GrayF32, style: &MapStyle, caption: &str) -> Result<Figure, Failure> {
        cv_io::write_png(self.out.join(name), draw_map(values.view(), style).view())?;
        map(values.view(), style, Width::Full, caption)
    }

    /// The report: all checks first, then the sections of the jobs.
    fn page(&self, checks: &[Check], sections: Vec<Section>) -> Report {
        let missed = checks.iter().filter(|c| !c.passed).count();
        let mut page = Report::new("cv demo");
        page.subtitle(&format!("Every pipeline on rendered images with exact ground truth · seed {}", self.seed));
        page.headline("results within their limits", &format!("{} of {}", checks.len() - missed, checks.len()));
        for check in checks {
            page.headline(&format!("{}: {}", check.job, check.measure), &check.value_text());
        }
        page.section("Ground truth and results");
        let rows: Vec<Vec<String>> = checks.iter().map(row).collect();
        page.table("All measures and their limits.", &HEAD, &rows);
        match missed {
            0 => page.note(Note::Good, "Every result is within its limit."),
            n => page.note(Note::Failure, &format!("{n} of the results exceed their limit.")),
        };
        sections.into_iter().for_each(|section| section(&mut page));
        page
    }
}

const HEAD: [&str; 7] = ["Job", "Measure", "Truth", "Result", "Measured", "Limit", "Passed"];

fn row(check: &Check) -> Vec<String> {
    vec![
        check.job.to_owned(),
        check.measure.to_owned(),
        check.truth.clone(),
        check.result.clone(),
        check.value_text(),
        check.bar_text(),
        if check.passed { "✓" } else { "✗" }.to_owned(),
    ]
}

/// Formats the checks as a table of text.
fn table(checks: &[Check]) -> String {
    let mut rows = vec![HEAD.map(str::to_owned).to_vec()];
    rows.extend(checks.iter().map(row));
    let width = |column: usize| rows.iter().map(|r| r[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..HEAD.len()).map(width).collect();
    let mut text = String::new();
    for (i, row) in rows.iter().enumerate() {
        // Text is left-aligned, numbers right-aligned.
        for (column, cell) in row.iter().enumerate() {
            let pad = widths[column];
            let _ =
                if matches!(column, 4 | 5) { write!(text, "{cell:>pad$}  ") } else { write!(text, "{cell:<pad$}  ") };
        }
        text.truncate(text.trim_end().len());
        text.push('\n');
        if i == 0 {
            let _ = writeln!(text, "{}", "─".repeat(widths.iter().sum::<usize>() + 2 * (widths.len() - 1)));
        }
    }
    text
}
