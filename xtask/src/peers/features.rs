//! Features of OpenCV, of Rust libraries and ours on the same photograph, alternating (A B A B); then repeatability and matching score on photographs and
//! warps with known homographies.
//! Writes the section "Features" of `docs/benchmarks.md`.

use super::feature_quality::{self, Quality};
use crate::checks::Check;
use anyhow::{Context, Result, ensure};
use cv_core::{GrayF32, ImageView, Keypoint, Silent};
use cv_features::{
    ByteDescriptors, CornerMeasure, DescriptorKind, Descriptors, HarrisOptions, MatchOptions, RatioTest, SiftOptions,
    anms, harris, harris_response, match_byte_descriptors, match_descriptors, sift,
};
use cv_parallel::prelude::*;
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

/// Time of a stage of OpenCV's or of a Rust library's.
#[derive(Deserialize)]
struct Timing {
    seconds: f64,
    #[serde(default)]
    version: String,
}

/// Our stages and their counterparts in the program `peers/rust`. imageproc has no Harris and no SIFT. These have no targets.
const RUST: &[(&str, &str)] = &[
    ("Harris response", "kornia Harris"),
    ("500 spaced Shi-Tomasi corners", "kornia Shi-Tomasi"),
    ("two nearest neighbors, 2000×2000×64", "kornia nearest 2000"),
    ("2000 SIFT features", "kornia SIFT"),
    ("2000 MOPS features", "kornia ORB"),
    ("2000 MOPS features", "imageproc FAST and BRIEF"),
];

/// A stage of ours and its counterpart of OpenCV's.
struct Stage<'a> {
    name: &'static str,
    peer: &'static str,
    /// Largest ratio of our time to the peer's; infinite without a target.
    max_ratio: f64,
    ours: Box<dyn Fn() + Send + Sync + 'a>,
    repeats: usize,
    best: [f64; 2],
}

pub(crate) fn run(python: &Path, data: &Path) -> Result<Vec<Check>> {
    let script = crate::root().join("peers/features_opencv.py");
    let rust = build_rust_peers()?;
    let photo = data.join("panorama/weir/weir_1.jpg");
    let gray = cv_io::read_gray_u8(&photo)?;
    let (w, h) = gray.size();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().context("cannot start two threads")?;
    let options = HarrisOptions::default();
    let shi = HarrisOptions { measure: CornerMeasure::ShiTomasi, ..options.clone() };
    let sift_options = SiftOptions { max_features: 2000, ..SiftOptions::default() };
    let match_options = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
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
    // Our time includes the conversion from bytes, which OpenCV reads directly. The buffer is reused, as for the frames of a video.
    let buffer = Mutex::new(GrayF32::new(w, h, [0.0]));
    let with_float_image = |call: &dyn Fn(ImageView<'_, f32, 1>)| {
        let mut buffer = buffer.lock().unwrap_or_else(PoisonError::into_inner);
        let rows = buffer.as_mut_slice().par_chunks_mut(64 * w).zip(gray.as_slice().par_chunks(64 * w));
        rows.for_each(|(out, bytes)| out.iter_mut().zip(bytes).for_each(|(o, b)| *o = f32::from(*b) * (1.0 / 255.0)));
        call(buffer.view());
    };
    let stage = |name, peer, max_ratio, repeats, ours: Box<dyn Fn() + Send + Sync>| Stage {
        name,
        peer,
        max_ratio,
        ours,
        repeats,
        best: [f64::INFINITY; 2],
    };
    let detect = |options: &HarrisOptions| {
        with_float_image(&|view| {
            let corners = harris(view, options, &Silent).unwrap_or_default();
            black_box(anms(&corners, 500, 0.9));
        });
    };
    let match_sets = |sets: &[Descriptors; 2]| {
        black_box(match_descriptors(&sets[0], &sets[1], &match_options, &Silent)).ok();
    };
    let mut stages = vec![
        stage(
            "Harris response",
            "cornerHarris",
            0.6,
            20,
            Box::new(|| {
                with_float_image(&|view| {
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
        stage("two nearest neighbors, 2000×2000×64", "BFMatcher 2000", 0.5, 20, Box::new(|| match_sets(&small))),
        stage(
            "two nearest neighbors, 8192×8192×128",
            "BFMatcher 8192",
            f64::INFINITY,
            4,
            Box::new(|| match_sets(&large)),
        ),
        // An approximate index (four randomized k-d trees, 32 checks: OpenCV's defaults) against our exact search.
        stage(
            "two nearest neighbors, 20,000×20,000×128",
            "FlannBasedMatcher 20000",
            f64::INFINITY,
            1,
            Box::new(|| match_sets(&huge)),
        ),
        stage(
            "2000 SIFT features",
            "SIFT",
            0.6,
            5,
            Box::new(|| {
                with_float_image(&|view| {
                    black_box(sift(view, &sift_options, &Silent)).ok();
                });
            }),
        ),
        stage(
            "2000 MOPS features",
            "ORB",
            f64::INFINITY,
            5,
            Box::new(|| {
                with_float_image(&|view| {
                    black_box(feature_quality::mops(view, 2000)).ok();
                });
            }),
        ),
        stage(
            "ANMS, 20,000 to 500 corners",
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
                let timing = run_stage(Command::new(python).arg(&script).arg("speed").arg(&photo).arg(stage.peer))?;
                stage.best[1] = stage.best[1].min(timing.seconds);
                version = timing.version;
            }
        }
        for (best, (_, what)) in others.iter_mut().zip(RUST) {
            *best = best.min(run_stage(Command::new(&rust).arg(&photo).arg(what))?.seconds);
        }
    }
    let time = |name: &str, of: usize| {
        stages.iter().find(|s| s.name == name || s.peer == name).map_or(f64::NAN, |s| s.best[of])
    };
    let peak_flops = 2.0 * 4096f64.powi(3) / time("matrix product 4096", 1);
    let match_flops = 2.0 * 8192.0 * 8192.0 * 128.0 / time("two nearest neighbors, 8192×8192×128", 0);
    let mut targets: Vec<(String, f64, f64)> = stages
        .iter()
        .filter(|s| s.max_ratio.is_finite())
        .map(|s| (format!("{} / OpenCV {}", s.name, s.peer), s.best[0] / s.best[1], s.max_ratio))
        .collect();
    targets.push(("ANMS, 20,000 to 500 corners, ms".into(), 1e3 * time("ANMS, 20,000 to 500 corners", 0), 3.0));
    // As a ratio with an upper limit, like the others.
    targets.push((
        "measured peak of f32 matrix products / rate of two nearest neighbors, 8192×8192×128".into(),
        peak_flops / match_flops,
        1.0 / 0.6,
    ));
    let quality = feature_quality::run(python, &script, data)?;
    for (name, ours, theirs) in quality.comparisons() {
        targets.push((format!("OpenCV / ours: {name}"), theirs / ours, 1.0));
    }
    let mut text = page(&stages, &others, &targets, &quality, (w, h), &version, (match_flops, peak_flops));
    let recall = byte_descriptor_recall(&data.join("panorama/weir"), &sift_options, &match_options)?;
    let _ = writeln!(
        text,
        "\nByte descriptors (`ByteDescriptors`): of 2000 RootSIFT features of one photograph, {:.1} % have the same nearest neighbor among 2000 features of the \
         next photograph as with f32 descriptors.",
        100.0 * recall
    );
    print!("{text}");
    super::write_section("Features", &text)?;
    Ok(targets.into_iter().map(|(name, figure, limit)| Check::at_most(name, figure, limit)).collect())
}

/// Returns the fraction of features with an unchanged nearest neighbor after quantization of the descriptors to bytes.
fn byte_descriptor_recall(folder: &Path, sift_options: &SiftOptions, match_options: &MatchOptions) -> Result<f64> {
    let mut sets = Vec::new();
    for name in ["weir_1.jpg", "weir_2.jpg"] {
        let image = cv_imgproc::gray_to_f32(cv_io::read_gray_u8(folder.join(name))?.view());
        sets.push(sift(image.view(), sift_options, &Silent)?.descriptors);
    }
    let bytes = |d: &Descriptors| ByteDescriptors::new(d).context("bytes");
    let exact = match_descriptors(&sets[0], &sets[1], match_options, &Silent)?;
    let rounded = match_byte_descriptors(&bytes(&sets[0])?, &bytes(&sets[1])?, match_options, &Silent)?;
    let same = exact.iter().zip(&rounded).filter(|(a, b)| a.train == b.train).count();
    Ok(same as f64 / exact.len() as f64)
}

fn page(
    stages: &[Stage<'_>],
    others: &[f64],
    targets: &[(String, f64, f64)],
    quality: &Quality,
    (w, h): (usize, usize),
    version: &str,
    (match_flops, peak_flops): (f64, f64),
) -> String {
    let mut text = String::new();
    // `fmt::Write` on a String cannot fail.
    let _ = writeln!(
        text,
        "Written by `cargo xtask peers features`. {}. Two threads, input of {w}×{h} px with 8-bit gray levels, ours and OpenCV {version} alternating, the fastest of \
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
    text.push_str("\n| stage | library, stage | time | ratio |\n|---|---|---|---|\n");
    for ((name, what), theirs) in RUST.iter().zip(others) {
        let ours = stages.iter().find(|s| s.name == *name).map_or(f64::NAN, |s| s.best[0]);
        let _ = writeln!(text, "| {name} | {what} | {:.2} ms | {:.2} |", 1e3 * theirs, ours / theirs);
    }
    let _ = writeln!(
        text,
        "\nkornia-rs 0.2.0 and imageproc 0.27.0; kornia's Shi-Tomasi: response and non-maximum suppression only, without a minimum distance.\n\nTwo nearest neighbors of 8192×8192×128: {:.0} GFlop/s, {:.0} % of NumPy's product of two 4096×4096 matrices ({:.0} GFlop/s).\n\n{}\n| figure | measured | target |\n|---|---|---|",
        match_flops * 1e-9,
        100.0 * match_flops / peak_flops,
        peak_flops * 1e-9,
        quality.text()
    );
    for (name, figure, limit) in targets {
        let verdict = if figure <= limit { "" } else { " (not met)" };
        let _ = writeln!(text, "| {name} | {figure:.3} | {limit:.3}{verdict} |");
    }
    text
}

/// Uniform pseudorandom numbers in [0, 1) from a linear congruential generator; the field is its state.
pub(super) struct Random(pub(super) u32);

impl Random {
    pub(super) fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (self.0 >> 8) as f32 / (1 << 24) as f32
    }
}

/// Runs a program that prints one timing as JSON.
fn run_stage(command: &mut Command) -> Result<Timing> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).with_context(|| format!("output of {command:?}"))
}

/// Builds the program of the Rust libraries for this machine's processor, since not all of them select instructions at run time as ours does.
fn build_rust_peers() -> Result<PathBuf> {
    let target = crate::root().join("target/peers-rust");
    crate::process::check(
        Command::new("cargo")
            .args(["build", "--release", "--quiet", "--locked", "--manifest-path"])
            .arg(crate::root().join("peers/rust/Cargo.toml"))
            .env("CARGO_TARGET_DIR", &target)
            .env("RUSTFLAGS", "-C target-cpu=native"),
    )?;
    Ok(target.join("release/rust-peers"))
}
