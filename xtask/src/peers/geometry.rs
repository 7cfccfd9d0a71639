//! OpenCV, PoseLib, COLMAP, DEGENSAC and ours on the same annotated matches, and PoseLib and ours on generated relative poses. Writes the
//! section “Robust geometry” of `docs/benchmarks.md`.

use crate::checks::Check;
use crate::real::estimate::{Pair, load, mean_average_accuracy, rms};
use anyhow::{Context, Result, ensure};
use cv_core::nalgebra::{Rotation3, Vector3};
use cv_core::{Camera, Correspondence, Point2, Point3, Pose};
use cv_pipeline::{ModelKind, RobustOptions, Silent, estimate, estimate_calibrated};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde::Deserialize;
use std::{fmt::Write as _, path::Path, process::Command, time::Instant};

/// Seeds, each with its own order of the input, that our figures are averaged over.
const SEEDS: u64 = 20;
/// Repeats; the fastest counts.
const REPEATS: usize = 5;
/// Default number of generated problems of each kind; the environment variable `CV_PEERS_PROBLEMS` overrides it.
const PROBLEMS: usize = 1000;
const KINDS: [&str; 4] = ["general", "plane and parallax", "forward motion", "small baseline"];
const MATCHES: usize = 300;
/// Focal length in pixels, size and inlier threshold in pixels of the generated problems.
const FOCAL: f64 = 1000.0;
const SIZE: (usize, usize) = (1200, 900);
const THRESHOLD: f64 = 2.0;

/// Result of one method on one pair or problem.
#[derive(Debug, Clone, Deserialize)]
struct Line {
    kind: String,
    #[serde(default)]
    pair: String,
    method: String,
    error: f64,
    seconds: f64,
}

pub(crate) fn run(python: &Path, data: &Path) -> Result<Vec<Check>> {
    let problems: usize = std::env::var("CV_PEERS_PROBLEMS").ok().and_then(|v| v.parse().ok()).unwrap_or(PROBLEMS);
    let generated: Vec<Problem> =
        (0..KINDS.len()).flat_map(|kind| (0..problems as u64).map(move |seed| Problem::new(kind, seed))).collect();
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("problems.bin");
    std::fs::write(&file, encode_problems(&generated))?;
    println!("ours");
    let mut text = String::new();
    let mut ours = Vec::new();
    let mut spread = Vec::new();
    for (kind, model) in [("H", ModelKind::Homography), ("F", ModelKind::Fundamental)] {
        let pairs = load(&data.join(if kind == "H" { "homography" } else { "fundamental" }))?;
        let (lines, deviation) = run_annotated(kind, model, &pairs)?;
        ours.extend(lines);
        spread.push((kind, deviation));
    }
    let poses: Vec<(usize, f64, f64)> = generated.iter().map(Problem::solve).collect();
    println!("peers");
    let script = crate::root().join("peers/geometry_peers.py");
    let args = [data.join("homography"), data.join("fundamental"), file];
    let output = Command::new(python).arg(&script).args(&args).output().context("cannot start Python")?;
    ensure!(output.status.success(), "{}: {}", script.display(), String::from_utf8_lossy(&output.stderr));
    let peers: Vec<Line> = String::from_utf8(output.stdout)?
        .lines()
        .filter(|line| line.starts_with("{\"kind\""))
        .map(|line| serde_json::from_str(line).with_context(|| line.to_owned()))
        .collect::<Result<_>>()?;

    let _ = writeln!(
        text,
        "Written by `cargo xtask peers geometry`; one run, load {} at its end (compare times as ratios). Input: tentative matches (label 0); error: on \
         the hand-checked matches (label 1), symmetric transfer RMS (H, threshold 3 px) or Sampson RMS (F, threshold 1 px). Ours: the mean over {SEEDS} seeds, each \
         with another order of the input; the spread is the relative standard deviation of the mean error over the seeds.\n",
        super::machine_load()
    );
    let mut checks = Vec::new();
    for (kind, deviation) in &spread {
        let _ = writeln!(text, "| {kind} | median error, px | mAA@10 | median time, ms |\n|---|---|---|---|");
        let mut rows: Vec<(String, [f64; 3])> = Vec::new();
        for line in ours.iter().chain(&peers).filter(|l| l.kind == *kind) {
            if !rows.iter().any(|r| r.0 == line.method) {
                rows.push((line.method.clone(), summary(ours.iter().chain(&peers), kind, &line.method)));
            }
        }
        for (name, [median, maa, ms]) in &rows {
            let _ = writeln!(text, "| {name} | {median:.3} | {maa:.3} | {ms:.3} |");
        }
        let of = |name: &str| rows.iter().find(|r| r.0 == name).map_or([f64::NAN; 3], |r| r.1);
        let best =
            ["OpenCV USAC_ACCURATE", "PoseLib", "DEGENSAC"].iter().map(|n| of(n)[0]).fold(f64::INFINITY, f64::min);
        let maa = rows.iter().filter(|r| r.0 != "ours").map(|r| r.1[1]).fold(0.0, f64::max);
        let mine = of("ours");
        let targets = [
            ("mAA@10, best peer − ours", maa - mine[1], 0.0),
            ("median error / best of USAC_ACCURATE, PoseLib, DEGENSAC", mine[0] / best, 1.05),
            ("median time / OpenCV USAC_MAGSAC", mine[2] / of("OpenCV USAC_MAGSAC")[2], 1.0),
            ("spread over seeds and orders", *deviation, 0.05),
        ];
        let _ = writeln!(text, "\n| {kind}: figure | measured | at most |\n|---|---|---|");
        for (name, figure, limit) in targets {
            let check = Check::at_most(format!("{kind}: {name}"), figure, limit + 1e-9);
            let _ = writeln!(text, "| {name} | {figure:.3}{} | {limit} |", if check.ok { "" } else { " (not met)" });
            checks.push(check);
        }
        text.push('\n');
    }
    let _ = writeln!(
        text,
        "Generated relative poses, {problems} of each kind: {MATCHES} matches, 20 to 95 % outliers, noise 0.1 to 2 px, known camera, threshold {THRESHOLD} px. Error: the larger \
         of the rotation error and the error of the translation direction.\n\n| kind | ours AUC 5°, 10°, 20° | PoseLib | ours, median ms | PoseLib |\n|---|---|---|---|---|"
    );
    for (kind, name) in KINDS.iter().enumerate() {
        let mine: Vec<(f64, f64)> = poses.iter().filter(|p| p.0 == kind).map(|p| (p.1, p.2)).collect();
        let theirs: Vec<(f64, f64)> =
            peers.iter().filter(|l| l.kind == kind.to_string()).map(|l| (l.error, l.seconds)).collect();
        let show = |v: &[(f64, f64)]| [5.0, 10.0, 20.0].map(|limit| 100.0 * auc(v, limit));
        let (a, b) = (show(&mine), show(&theirs));
        let ms = |v: &[(f64, f64)]| 1e3 * median(v.iter().map(|p| p.1).collect());
        for (degrees, (ours, theirs)) in [5, 10, 20].into_iter().zip(a.iter().zip(&b)) {
            checks.push(Check::at_most(format!("{name}: AUC at {degrees}°, PoseLib − ours"), theirs - ours, 0.0));
        }
        checks.push(Check::at_most(format!("{name}: median time / PoseLib"), ms(&mine) / ms(&theirs), 1.0));
        let _ = writeln!(
            text,
            "| {name} | {:.1}, {:.1}, {:.1} | {:.1}, {:.1}, {:.1} | {:.2} | {:.2} |",
            a[0],
            a[1],
            a[2],
            b[0],
            b[1],
            b[2],
            ms(&mine),
            ms(&theirs)
        );
    }
    print!("{text}");
    super::write_section("Robust geometry", &text)?;
    Ok(checks)
}

/// Runs ours on every pair and seed; returns the results and the relative standard deviation of the mean error over the seeds.
fn run_annotated(kind: &str, model: ModelKind, pairs: &[Pair]) -> Result<(Vec<Line>, f64)> {
    let mut lines = Vec::new();
    let mut means = vec![0.0; SEEDS as usize];
    for seed in 0..SEEDS {
        for pair in pairs {
            let mut input = pair.tentative.clone();
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for i in (1..input.len()).rev() {
                input.swap(i, (rng.next_u32() as usize) % (i + 1));
            }
            let options = RobustOptions { seed, ..model.options() };
            let (mut seconds, mut error) = (f64::INFINITY, f64::INFINITY);
            for _ in 0..REPEATS {
                let start = Instant::now();
                let found = estimate(&input, model, &options, &Silent);
                seconds = seconds.min(start.elapsed().as_secs_f64());
                error = found.map_or(1e9, |f| rms(model, &f.robust.model, &pair.checked));
            }
            means[seed as usize] += error.min(10.0) / pairs.len() as f64;
            lines.push(Line {
                kind: kind.to_owned(),
                pair: format!("{} {seed}", pair.name),
                method: "ours".to_owned(),
                error,
                seconds,
            });
        }
    }
    let mean = means.iter().sum::<f64>() / SEEDS as f64;
    let variance = means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / (SEEDS - 1) as f64;
    Ok((lines, variance.sqrt() / mean))
}

/// Computes median error, mAA@10 and median time in ms for each seed and averages them.
fn summary<'a>(lines: impl Iterator<Item = &'a Line>, kind: &str, method: &str) -> [f64; 3] {
    let mut runs: Vec<(String, Vec<(f64, f64)>)> = Vec::new();
    for line in lines.filter(|l| l.kind == kind && l.method == method) {
        let seed = line.pair.split_once(' ').map_or("", |p| p.1).to_owned();
        match runs.iter_mut().find(|r| r.0 == seed) {
            Some(run) => run.1.push((line.error, line.seconds)),
            None => runs.push((seed, vec![(line.error, line.seconds)])),
        }
    }
    let mut sums = [0.0; 3];
    for (_, run) in &runs {
        let errors: Vec<f64> = run.iter().map(|r| r.0).collect();
        sums[0] += median(errors.clone());
        sums[1] += mean_average_accuracy(&errors);
        sums[2] += 1e3 * median(run.iter().map(|r| r.1).collect());
    }
    sums.map(|s| s / runs.len() as f64)
}

fn median(mut v: Vec<f64>) -> f64 {
    if v.is_empty() {
        return f64::NAN;
    }
    v.sort_by(f64::total_cmp);
    (v[(v.len() - 1) / 2] + v[v.len() / 2]) / 2.0
}

/// Computes the area under the recall curve up to `limit` degrees, normalized to 0 to 1.
fn auc(v: &[(f64, f64)], limit: f64) -> f64 {
    v.iter().map(|p| (1.0 - p.0 / limit).max(0.0)).sum::<f64>() / v.len() as f64
}

/// Matches of random points in two views, with outliers.
struct Problem {
    kind: usize,
    pose: Pose,
    matches: Vec<Correspondence>,
    seed: u64,
}

impl Problem {
    fn new(kind: usize, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed * 4 + kind as u64);
        let mut u = || f64::from(rng.next_u32()) / 4294967296.0;
        let camera = Camera::from_focal(SIZE.0, SIZE.1, FOCAL);
        let (outlier_ratio, noise) = (0.2 + 0.75 * u(), 0.1 * 20f64.powf(u()));
        let mut g = || (-2.0 * u().max(1e-12).ln()).sqrt() * (std::f64::consts::TAU * u()).cos();
        let rotation = Rotation3::new(Vector3::new(0.1 * g(), 0.1 * g(), 0.1 * g()));
        let direction =
            if kind == 2 { Vector3::new(0.1 * g(), 0.1 * g(), 1.0) } else { Vector3::new(g(), g(), 0.4 * g()) };
        let direction = direction.normalize();
        let pose = Pose::new(rotation, direction * [0.8, 0.8, 1.0, 0.1][kind]);
        let plane = Vector3::new(0.05 * g(), 0.05 * g(), 0.15);
        let mut matches = Vec::new();
        while matches.len() < MATCHES {
            let pixel = Point2::new(1200.0 * u() - 0.5, 900.0 * u() - 0.5);
            if (matches.len() as f64) < outlier_ratio * MATCHES as f64 {
                matches.push(Correspondence { a: pixel, b: Point2::new(1200.0 * u() - 0.5, 900.0 * u() - 0.5) });
                continue;
            }
            let ray = camera.normalize(pixel).to_homogeneous();
            // Kind 1: four in five points on the plane.
            let depth = if kind == 1 && u() < 0.8 { 1.0 / plane.dot(&ray) } else { 4.0 + 8.0 * u() };
            let projection = camera.project(&pose.transform(&Point3::from(ray * depth)));
            let Some(b) = projection.filter(|b| depth > 0.5 && b.x > 0.0 && b.y > 0.0 && b.x < 1200.0 && b.y < 900.0)
            else {
                continue;
            };
            let mut e = || noise * (-2.0 * u().max(1e-12).ln()).sqrt() * (std::f64::consts::TAU * u()).cos();
            matches.push(Correspondence::new(pixel.x + e(), pixel.y + e(), b.x + e(), b.y + e()));
        }
        Self { kind, pose: Pose::new(rotation, direction), matches, seed }
    }

    /// Solves it with ours; returns the kind, the error in degrees and the seconds.
    fn solve(&self) -> (usize, f64, f64) {
        let camera = Camera::from_focal(SIZE.0, SIZE.1, FOCAL);
        let options = RobustOptions { threshold: THRESHOLD, seed: self.seed, ..RobustOptions::essential() };
        let start = Instant::now();
        let found = estimate_calibrated(&self.matches, &[camera; 2], &options, &Silent);
        let seconds = start.elapsed().as_secs_f64();
        let error = found.map_or(180.0, |f| {
            let rotation_error = cv_synth::rotation_error(&f.pose.rotation, &self.pose.rotation);
            rotation_error.max(cv_synth::direction_error(&f.pose.translation, &self.pose.translation)).to_degrees()
        });
        (self.kind, error, seconds)
    }
}

/// Encodes the problems as the script reads them: little-endian f64.
fn encode_problems(problems: &[Problem]) -> Vec<u8> {
    let mut numbers = vec![FOCAL, SIZE.0 as f64, SIZE.1 as f64, THRESHOLD];
    for p in problems {
        numbers.extend([p.kind as f64, p.matches.len() as f64]);
        numbers.extend(p.pose.rotation.matrix().transpose().iter());
        numbers.extend(p.pose.translation.iter());
        numbers.extend(p.matches.iter().flat_map(|m| [m.a.x, m.a.y, m.b.x, m.b.y]));
    }
    numbers.iter().flat_map(|v| v.to_le_bytes()).collect()
}
