//! OpenCV's features, those of Rust libraries and ours on the same photograph in turns (A B A B), then repeatability and matching on photographs and
//! warps of known truth.
//! Writes the section "Features" of `docs/benchmarks.md`.

use super::feature_quality::{self, Quality};
use crate::checks::Check;
use anyhow::{Context, Result, ensure};
use cv_core::{GrayF32, ImageView, Keypoint, Silent};
use cv_features::{
    ByteDescriptors, CornerMeasure, DescriptorKind, Descriptors, HarrisOptions, MatchOptions, RatioTest, SiftOptions,
    anms, harris, harris_response, match_byte_descriptors, match_descriptors, sift,
};
use rayon::prelude::*;
use serde::Deserialize;
use std::{
    fmt::Write as _,
    hint::black_box,
    path::{Path, PathBuf},
    process::Command,
    sync::{Mutex, PoisonError},
    time::Instant,
};

const ROUNDS: usize = 4;

/// Seconds of a stage of OpenCV's or of a Rust library's.
#[derive(Deserialize)]
struct Line {
    seconds: f64,
    #[serde(default)]
    version: String,
}

/// Stages of the program in `peers/rust` by our stage's name. imageproc has no Harris and no SIFT; no bar hangs on these.
const RUST: &[(&str, &str)] = &[
    ("Harris response", "kornia Harris"),
    ("500 spaced Shi-Tomasi corners", "kornia Shi-Tomasi"),
    ("two nearest, 2000×2000×64", "kornia nearest 2000"),
    ("2000 SIFT features", "kornia SIFT"),
    ("2000 MOPS features", "kornia ORB"),
    ("2000 MOPS features", "imageproc FAST and BRIEF"),
];

/// A stage of ours beside one of OpenCV's.
struct Stage<'a> {
    name: &'static str,
    peer: &'static str,
    /// Largest ratio of ours to the peer's; infinite where there is none.
    bar: f64,
    ours: Box<dyn Fn() + Send + Sync + 'a>,
    repeats: usize,
    best: [f64; 2],
}

pub(crate) fn run(python: &Path, data: &Path) -> Result<Vec<Check>> {
    let script = crate::root().join("peers/features_opencv.py");
    let rust = rust_peers()?;
    let photo = data.join("panorama/weir/weir_1.jpg");
    let gray = cv_io::read_gray_u8(&photo)?;
    let (w, h) = gray.size();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().context("cannot start two threads")?;
    let options = HarrisOptions::default();
    let shi = HarrisOptions { measure: CornerMeasure::ShiTomasi, ..options.clone() };
    let settings = SiftOptions { max_features: 2000, ..SiftOptions::default() };
    let nearest = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
    let mut random = Random(1);
    let mut set = |kind: DescriptorKind, n: usize| {
        let data = (0..n * kind.dimension).map(|_| random.next()).collect();
        Descriptors::from_vec(kind, data).context("descriptors")
    };
    let small = [set(DescriptorKind::PATCH, 2000)?, set(DescriptorKind::PATCH, 2000)?];
    let large = [set(DescriptorKind::ROOT_SIFT, 8192)?, set(DescriptorKind::ROOT_SIFT, 8192)?];
    let huge = [set(DescriptorKind::ROOT_SIFT, 20_000)?, set(DescriptorKind::ROOT_SIFT, 20_000)?];
    let corners: Vec<Keypoint> = (0..20_000)
        .map(|_| Keypoint::new(1333.0 * random.next(), 750.0 * random.next(), random.next().powi(3)))
        .collect();
    // The conversion from bytes counts as ours: OpenCV reads them. Into a buffer that is there, as for the frames of a film.
    let buffer = Mutex::new(GrayF32::new(w, h, [0.0]));
    let float = |call: &dyn Fn(ImageView<'_, f32, 1>)| {
        let mut buffer = buffer.lock().unwrap_or_else(PoisonError::into_inner);
        let rows = buffer.as_mut_slice().par_chunks_mut(64 * w).zip(gray.as_slice().par_chunks(64 * w));
        rows.for_each(|(out, bytes)| out.iter_mut().zip(bytes).for_each(|(o, b)| *o = f32::from(*b) * (1.0 / 255.0)));
        call(buffer.view());
    };
    let stage = |name, peer, bar, repeats, ours: Box<dyn Fn() + Send + Sync>| Stage {
        name,
        peer,
        bar,
        ours,
        repeats,
        best: [f64::INFINITY; 2],
    };
    let detect = |options: &HarrisOptions| {
        float(&|view| {
            let corners = harris(view, options, &Silent).unwrap_or_default();
            black_box(anms(&corners, 500, 0.9));
        });
    };
    let two = |sets: &[Descriptors; 2]| {
        black_box(match_descriptors(&sets[0], &sets[1], &nearest, &Silent)).ok();
    };
    let mut stages = vec![
        stage(
            "Harris response",
            "cornerHarris",
            0.6,
            20,
            Box::new(|| {
                float(&|view| {
                    black_box(harris_response(view, &options)).ok();
                });
            }),
        ),
        stage("500 spaced Harris corners", "goodFeaturesToTrack", 0.6, 20, Box::new(|| detect(&options))),
        stage(
            "500 spaced Shi-Tomasi corners",
            "goodFeaturesToTrack, Shi-Tomasi",
            f64::INFINITY,
            10,
            Box::new(|| {
                detect(&shi);
            }),
        ),
        stage("two nearest, 2000×2000×64", "BFMatcher 2000", 0.5, 20, Box::new(|| two(&small))),
        stage("two nearest, 8192×8192×128", "BFMatcher 8192", f64::INFINITY, 4, Box::new(|| two(&large))),
        // An approximate index (a forest of four k-d trees, 32 checks: OpenCV's defaults) beside the exact search.
        stage("two nearest, 20,000×20,000×128", "FlannBasedMatcher 20000", f64::INFINITY, 1, Box::new(|| two(&huge))),
        stage(
            "2000 SIFT features",
            "SIFT",
            0.6,
            5,
            Box::new(|| {
                float(&|view| {
                    black_box(sift(view, &settings, &Silent)).ok();
                });
            }),
        ),
        stage(
            "2000 MOPS features",
            "ORB",
            f64::INFINITY,
            5,
            Box::new(|| {
                float(&|view| {
                    black_box(feature_quality::mops(view, 2000)).ok();
                });
            }),
        ),
        stage(
            "20,000 corners to 500",
            "",
            f64::INFINITY,
            20,
            Box::new(|| {
                black_box(anms(&corners, 500, 0.9));
            }),
        ),
        stage("", "matrix product 4096", f64::INFINITY, 0, Box::new(|| ())),
    ];
    let mut version = String::new();
    let mut others = [f64::INFINITY; RUST.len()];
    for round in 0..ROUNDS {
        println!("round {} of {ROUNDS}", round + 1);
        for stage in &mut stages {
            for repeat in 0..=stage.repeats {
                let start = Instant::now();
                pool.install(|| (stage.ours)());
                if repeat > 0 {
                    stage.best[0] = stage.best[0].min(start.elapsed().as_secs_f64());
                }
            }
            if !stage.peer.is_empty() {
                let line = line(Command::new(python).arg(&script).arg("speed").arg(&photo).arg(stage.peer))?;
                stage.best[1] = stage.best[1].min(line.seconds);
                version = line.version;
            }
        }
        for (best, (_, what)) in others.iter_mut().zip(RUST) {
            *best = best.min(line(Command::new(&rust).arg(&photo).arg(what))?.seconds);
        }
    }
    let time = |name: &str, of: usize| {
        stages.iter().find(|s| s.name == name || s.peer == name).map_or(f64::NAN, |s| s.best[of])
    };
    let peak = 2.0 * 4096f64.powi(3) / time("matrix product 4096", 1);
    let reached = 2.0 * 8192.0 * 8192.0 * 128.0 / time("two nearest, 8192×8192×128", 0);
    let mut bars: Vec<(String, f64, f64)> = stages
        .iter()
        .filter(|s| s.bar.is_finite())
        .map(|s| (format!("{} / OpenCV {}", s.name, s.peer), s.best[0] / s.best[1], s.bar))
        .collect();
    bars.push(("20,000 corners to 500, ms".into(), 1e3 * time("20,000 corners to 500", 0), 3.0));
    // Written as a quotient that must be small, like the others.
    bars.push(("measured peak of f32 products / rate of two nearest, 8192×8192×128".into(), peak / reached, 1.0 / 0.6));
    let quality = feature_quality::run(python, &script, data)?;
    for (name, ours, theirs) in quality.bars() {
        bars.push((format!("OpenCV / ours: {name}"), theirs / ours, 1.0));
    }
    let mut text = page(&stages, &others, &bars, &quality, (w, h), &version, (reached, peak));
    let recall = recall(&data.join("panorama/weir"), &settings, &nearest)?;
    let _ = writeln!(
        text,
        "\nDescriptors in bytes (`ByteDescriptors`): of 2000 rootSIFT features of one photograph, {:.1} % have the same nearest neighbor among 2000 of the \
         next as in f32.",
        100.0 * recall
    );
    print!("{text}");
    super::write_section("Features", &text)?;
    Ok(bars.into_iter().map(|(name, figure, bar)| Check::at_most(name, figure, bar)).collect())
}

/// The share of features whose nearest neighbor stays the same when descriptors are rounded to bytes.
fn recall(folder: &Path, settings: &SiftOptions, nearest: &MatchOptions) -> Result<f64> {
    let mut sets = Vec::new();
    for name in ["weir_1.jpg", "weir_2.jpg"] {
        let image = cv_imgproc::gray_to_f32(cv_io::read_gray_u8(folder.join(name))?.view());
        sets.push(sift(image.view(), settings, &Silent)?.descriptors);
    }
    let bytes = |d: &Descriptors| ByteDescriptors::new(d).context("bytes");
    let exact = match_descriptors(&sets[0], &sets[1], nearest, &Silent)?;
    let rounded = match_byte_descriptors(&bytes(&sets[0])?, &bytes(&sets[1])?, nearest, &Silent)?;
    let same = exact.iter().zip(&rounded).filter(|(a, b)| a.train == b.train).count();
    Ok(same as f64 / exact.len() as f64)
}

fn page(
    stages: &[Stage<'_>],
    others: &[f64],
    bars: &[(String, f64, f64)],
    quality: &Quality,
    (w, h): (usize, usize),
    version: &str,
    (reached, peak): (f64, f64),
) -> String {
    let mut text = String::new();
    // `fmt::Write` on a String cannot fail.
    let _ = writeln!(
        text,
        "Written by `cargo xtask peers features`. {}. Two threads, {w}×{h} gray bytes in, ours and OpenCV {version} in turns, the fastest of \
         {ROUNDS} rounds of warm repeats.\n\n| stage | ours | OpenCV | ratio |\n|---|---|---|---|",
        super::machine()
    );
    for stage in stages.iter().filter(|s| !s.name.is_empty()) {
        let [ours, theirs] = stage.best;
        let _ = if theirs.is_finite() {
            writeln!(
                text,
                "| {} / {} | {:.2} ms | {:.2} ms | {:.2} |",
                stage.name,
                stage.peer,
                1e3 * ours,
                1e3 * theirs,
                ours / theirs
            )
        } else {
            writeln!(text, "| {} | {:.2} ms | | |", stage.name, 1e3 * ours)
        };
    }
    text.push_str("\n| stage | library, stage | time | ours / it |\n|---|---|---|---|\n");
    for ((name, what), theirs) in RUST.iter().zip(others) {
        let ours = stages.iter().find(|s| s.name == *name).map_or(f64::NAN, |s| s.best[0]);
        let _ = writeln!(text, "| {name} | {what} | {:.2} ms | {:.2} |", 1e3 * theirs, ours / theirs);
    }
    let _ = writeln!(
        text,
        "\nkornia-rs 0.2.0 and imageproc 0.27.0; kornia's Shi-Tomasi is the response with suppression only, without spacing.\n\nTwo nearest of 8192×8192×128: {:.0} GFlop/s, {:.0} % of NumPy's product of two 4096×4096 matrices ({:.0} GFlop/s).\n\n{}\n| figure | measured | bar |\n|---|---|---|",
        reached * 1e-9,
        100.0 * reached / peak,
        peak * 1e-9,
        quality.text()
    );
    for (name, figure, bar) in bars {
        let verdict = if figure <= bar { "" } else { " (missed)" };
        let _ = writeln!(text, "| {name} | {figure:.3} | {bar:.3}{verdict} |");
    }
    text
}

/// Numbers from 0 to 1, always the same.
pub(super) struct Random(pub(super) u32);

impl Random {
    pub(super) fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (self.0 >> 8) as f32 / (1 << 24) as f32
    }
}

/// Runs a program that prints one line.
fn line(command: &mut Command) -> Result<Line> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).with_context(|| format!("what {command:?} printed"))
}

/// Builds the program of the Rust libraries, for this machine's processor: they have no dispatch at run time everywhere, as ours has.
fn rust_peers() -> Result<PathBuf> {
    let target = crate::root().join("target/peers-rust");
    super::check(
        Command::new("cargo")
            .args(["build", "--release", "--quiet", "--locked", "--manifest-path"])
            .arg(crate::root().join("peers/rust/Cargo.toml"))
            .env("CARGO_TARGET_DIR", &target)
            .env("RUSTFLAGS", "-C target-cpu=native"),
    )?;
    Ok(target.join("release/rust-peers"))
}
