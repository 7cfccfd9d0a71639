//! Undistortion and rectification of a pair of images: ours and OpenCV's `remap` with precomputed fixed-point maps.

use super::calibration::{Page, run_script};
use super::features::Random;
use crate::checks::Check;
use anyhow::{Context, Result};
use cv_core::{Camera, Distortion, Image, Rotation3, Silent, Vector3};
use cv_stereo::RectifiedView;
use serde::Deserialize;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Instant;

const SIZE: (usize, usize) = (1280, 800);
const REPEATS: usize = 100;
/// Rounds in which both systems alternate.
const ROUNDS: usize = 4;

#[derive(Debug, Deserialize)]
struct Remap {
    kind: String,
    threads: usize,
    seconds: f64,
}

/// Measures the seconds for a pair on one thread and on two; also returns the first image's result.
fn run_ours<const C: usize>(view: &RectifiedView, pair: &[Image<u8, C>; 2]) -> Result<([f64; 2], Image<u8, C>)> {
    let maps = [view.map(&Silent)?, view.map(&Silent)?];
    let mut out = pair.clone();
    let mut best = [f64::INFINITY; 2];
    for (threads, best) in best.iter_mut().enumerate() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads + 1).build()?;
        pool.install(|| -> Result<()> {
            for _ in 0..REPEATS {
                let start = Instant::now();
                for ((map, image), out) in maps.iter().zip(pair).zip(&mut out) {
                    map.compute_into(image.view(), out)?;
                }
                *best = best.min(start.elapsed().as_secs_f64());
            }
            Ok(())
        })?;
    }
    let [first, _] = out;
    Ok((best, first))
}

/// Generates a pair of images: sums of sinusoids plus a checkerboard.
fn generate_images<const C: usize>() -> [Image<u8, C>; 2] {
    [1, 2].map(|seed| {
        let mut random = Random(seed);
        let waves: Vec<[f32; 4]> = (0..6 * C).map(|_| std::array::from_fn(|_| random.next())).collect();
        Image::from_fn(SIZE.0, SIZE.1, |x, y| {
            std::array::from_fn(|c| {
                let sum: f32 = waves[6 * c..6 * c + 6]
                    .iter()
                    .map(|w| (0.2 * (w[0] - 0.5) * x as f32 + 0.2 * (w[1] - 0.5) * y as f32 + 6.3 * w[2]).sin())
                    .sum();
                let edge = if (x / 37 + y / 29) % 2 == 0 { 40.0 } else { -40.0 };
                (128.0 + 25.0 * sum + edge).clamp(0.0, 255.0) as u8
            })
        })
    })
}

pub(super) fn run(python: &Path, page: &mut Page) -> Result<()> {
    println!("undistorting a pair");
    // The camera of peers/calibration_opencv.py.
    let distortion = Distortion::radial_tangential5([-0.3, 0.1, 1e-3, -5e-4, 0.0]);
    let source = Camera { distortion, ..Camera::pinhole(SIZE.0, SIZE.1, 900.0, 902.0, 650.0, 390.0) };
    let rotation = Rotation3::new(Vector3::new(0.01, 0.02, 0.005));
    let view = RectifiedView { source, camera: Camera { distortion: Distortion::NONE, ..source }, rotation };
    let scratch = tempfile::tempdir()?;
    let (gray, color) = (generate_images::<1>(), generate_images::<3>());
    for i in 0..2 {
        std::fs::write(scratch.path().join(format!("gray{i}.bytes")), gray[i].as_slice())?;
        std::fs::write(scratch.path().join(format!("rgb{i}.bytes")), color[i].as_slice())?;
    }
    // Best seconds, indexed by system, kind and threads.
    let mut best = [[[f64::INFINITY; 2]; 2]; 2];
    let mut means = [f64::NAN; 2];
    for _ in 0..ROUNDS {
        let peers: Vec<Remap> =
            run_script(python, &[&"remap", &SIZE.0.to_string(), &SIZE.1.to_string(), &scratch.path()])?;
        for p in &peers {
            let slot = &mut best[1][usize::from(p.kind == "rgb")][p.threads - 1];
            *slot = slot.min(p.seconds);
        }
        let (a, b) = (run_ours(&view, &gray)?, run_ours(&view, &color)?);
        for (kind, times) in [a.0, b.0].into_iter().enumerate() {
            for (threads, seconds) in times.into_iter().enumerate() {
                best[0][kind][threads] = best[0][kind][threads].min(seconds);
            }
        }
        let theirs = |name: &str| std::fs::read(scratch.path().join(name)).context("a result of the peer's");
        means = [
            mean_difference(a.1.as_slice(), &theirs("gray.result")?),
            mean_difference(b.1.as_slice(), &theirs("rgb.result")?),
        ];
    }
    let _ = writeln!(
        page.text,
        "\nA pair of {}×{} undistorted and rectified in one pass with precomputed maps; the fastest of {ROUNDS} times {REPEATS} runs, alternating. The results differ by {:.2} (gray) and \
         {:.2} (RGB) gray levels on average: OpenCV's maps are quantized to 1/32 px.\n\n| pixels | threads | ours, ms | OpenCV `remap`, ms | ratio |\n|---|---|---|---|---|",
        SIZE.0, SIZE.1, means[0], means[1]
    );
    let kinds = ["gray", "RGB"].into_iter().zip(best[0].iter().zip(&best[1]));
    for (name, (ours, theirs)) in kinds {
        for (threads, (ours, theirs)) in (1..).zip(ours.iter().zip(theirs)) {
            let ratio = ours / theirs;
            let _ =
                writeln!(page.text, "| {name} | {threads} | {:.2} | {:.2} | {ratio:.3} |", 1e3 * ours, 1e3 * theirs);
            let plural = if threads == 1 { "thread" } else { "threads" };
            let name = format!("undistorting a pair of 1 Mpx, {name}, {threads} {plural} / remap");
            page.checks.push(Check::at_most(name, ratio, 0.6));
        }
    }
    Ok(())
}

/// Computes the mean absolute difference of two images in gray levels.
fn mean_difference(a: &[u8], b: &[u8]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    sum / a.len().max(1) as f64
}
