//! `cv demo`: every pipeline on generated scenes, whose truth is known exactly.

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

/// Run every pipeline on generated scenes and compare the results with the truth.
///
/// Renders photographs of rooms that do not exist, with noise, lens blur and uneven light, and runs each pipeline on
/// them as on anybody's photographs. Since the scenes are known exactly, so is the error of every result. Writes the
/// photographs, the results and report.html into a folder. The exit code is 1 where an error is above its bar.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  cv demo\n  cv demo -o /tmp/demo --seed 7\n  cv demo --json --quiet > demo.json")]
pub(crate) struct Args {
    /// The folder to write into; made where it is not there.
    #[arg(short, long, visible_alias = "out", value_name = "DIR", default_value = "cv-demo")]
    output: PathBuf,
}

/// A result against the truth.
#[derive(Debug, Serialize)]
struct Check {
    job: &'static str,
    measure: &'static str,
    truth: String,
    result: String,
    /// The measure: an error that must be small, or a share that must be large.
    value: f64,
    bar: f64,
    at_most: bool,
    unit: &'static str,
    passed: bool,
}

impl Check {
    /// An error that must not exceed the bar.
    fn at_most(job: &'static str, measure: &'static str, value: f64, bar: f64, unit: &'static str) -> Self {
        let passed = value <= bar;
        Self { job, measure, truth: String::new(), result: String::new(), value, bar, at_most: true, unit, passed }
    }

    /// A share that must reach the bar.
    fn at_least(job: &'static str, measure: &'static str, value: f64, bar: f64, unit: &'static str) -> Self {
        Self { at_most: false, passed: value >= bar, ..Self::at_most(job, measure, value, bar, unit) }
    }

    /// The two values that are compared, in words.
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

/// What the jobs share.
struct Demo<'a> {
    context: &'a Context,
    seed: u64,
    out: &'a Path,
}

/// Writes a job's part of the report.
type Section = Box<dyn FnOnce(&mut Report)>;

/// What a job hands back.
struct Part {
    checks: Vec<Check>,
    /// Adds the job's section to the report.
    section: Section,
}

impl Part {
    fn new(checks: Vec<Check>, section: impl FnOnce(&mut Report) + 'static) -> Self {
        Self { checks, section: Box::new(section) }
    }

    /// A pipeline that gave up: a missed bar, and its words in the report.
    fn gave_up(job: &'static str, reason: &impl std::fmt::Display) -> Self {
        let reason = reason.to_string();
        let check = Check::at_most(job, "a result at all", f64::INFINITY, 0.0, "").of("", reason.clone());
        Self::new(vec![check], move |page| {
            page.section(job).note(Note::Failure, &reason);
        })
    }
}

/// Renders, runs a pipeline, and compares.
type Job = fn(&Demo<'_>) -> Result<Part, Failure>;

/// In the order in which a reader learns them.
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

/// All jobs, with what they write.
fn run(out: &Path, context: &Context) -> Result<Outcome, Failure> {
    let demo = Demo { context, seed: context.seed.unwrap_or(1), out };
    let (mut checks, mut sections, mut stages) = (Vec::new(), Vec::new(), Vec::new());
    let stage = Stage::new(context, "demo", JOBS.len())?;
    for (name, job) in JOBS {
        context.note(format!("{name} …"));
        let start = Instant::now();
        let part = job(&demo)?;
        // A job that was stopped is no job that gave up.
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
        n => outcome.but(
            Failure::new(format!("{n} of the results missed their bar")).advice(format!("look at {}", path.display())),
        ),
    })
}

impl Demo<'_> {
    /// The camera all jobs photograph with.
    fn camera(&self) -> Camera {
        Camera::from_focal(640, 480, 520.0)
    }

    /// Writes a picture into the folder and returns it as a figure of the report.
    fn figure(&self, name: &str, image: &RgbU8, caption: &str) -> Result<Figure, Failure> {
        cv_io::write_png(self.out.join(name), image.view())?;
        picture(image, Width::Full, caption)
    }

    /// The same of a map of numbers in colors.
    fn map(&self, name: &str, values: &GrayF32, style: &MapStyle, caption: &str) -> Result<Figure, Failure> {
        cv_io::write_png(self.out.join(name), draw_map(values.view(), style).view())?;
        map(values.view(), style, Width::Full, caption)
    }

    /// The report: all checks first, then the sections of the jobs.
    fn page(&self, checks: &[Check], sections: Vec<Section>) -> Report {
        let missed = checks.iter().filter(|c| !c.passed).count();
        let mut page = Report::new("cv demo");
        page.subtitle(&format!("Every pipeline on generated photographs with exact truth · seed {}", self.seed));
        page.headline("results within their bar", &format!("{} of {}", checks.len() - missed, checks.len()));
        for check in checks {
            page.headline(&format!("{}: {}", check.job, check.measure), &check.value_text());
        }
        page.section("Truth against result");
        let rows: Vec<Vec<String>> = checks.iter().map(row).collect();
        page.table("All measures and their bars.", &HEAD, &rows);
        match missed {
            0 => page.note(Note::Good, "Every result is within its bar."),
            n => page.note(Note::Failure, &format!("{n} of the results missed their bar.")),
        };
        sections.into_iter().for_each(|section| section(&mut page));
        page
    }
}

const HEAD: [&str; 7] = ["Job", "Measure", "Truth", "Result", "Measured", "Bar", "Held"];

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

/// The checks as text in columns.
fn table(checks: &[Check]) -> String {
    let mut rows = vec![HEAD.map(str::to_owned).to_vec()];
    rows.extend(checks.iter().map(row));
    let width = |column: usize| rows.iter().map(|r| r[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..HEAD.len()).map(width).collect();
    let mut text = String::new();
    for (i, row) in rows.iter().enumerate() {
        // Words to the left, figures to the right.
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
