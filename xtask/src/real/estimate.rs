//! `estimate` on annotated image pairs: rows with label 0 are the tentative matches, the hand-checked rows with label 1 the ground truth.

use super::Check;
use anyhow::{Context, Result, ensure};
use cv_core::{Correspondence, Matrix3, Vector3};
use cv_pipeline::{ModelKind, Silent, estimate};
use std::path::Path;

/// Number of seeds. Targets for the worst seed: homographies none over 10 px and median at most 2.2 px, fundamental matrices at most one
/// over 10 px and median at most 0.8 px; mAA is the mean over the seeds.
const SEEDS: u64 = 20;

pub(super) fn run(data: &Path) -> Result<Vec<Check>> {
    let mut checks = Vec::new();
    for (kind, folder, name, max_median, max_failures) in
        [(ModelKind::Homography, "homography", "H", 2.2, 0.0), (ModelKind::Fundamental, "fundamental", "F", 0.8, 1.0)]
    {
        let pairs = load(&data.join(folder))?;
        let (mut worst_median, mut worst_failures, mut maa) = (0.0f64, 0.0f64, 0.0);
        let mut lines: Vec<String> = pairs.iter().map(|p| format!("{name} {:12}", p.name)).collect();
        for seed in 0..SEEDS {
            let mut errors = Vec::new();
            for (pair, line) in pairs.iter().zip(&mut lines) {
                let options = cv_pipeline::RobustOptions { seed, ..kind.options() };
                let error = match estimate(&pair.tentative, kind, &options, &Silent) {
                    Ok(result) => rms(kind, &result.robust.model, &pair.checked),
                    Err(error) => {
                        println!("{}: {error}", pair.name);
                        f64::INFINITY
                    }
                };
                if seed < 5 {
                    line.push_str(&format!(" {error:8.3}"));
                }
                errors.push(error);
            }
            worst_failures = worst_failures.max(errors.iter().filter(|e| e.is_nan() || **e >= 10.0).count() as f64);
            maa += mean_average_accuracy(&errors) / SEEDS as f64;
            errors.sort_by(f64::total_cmp);
            let n = errors.len();
            worst_median = worst_median.max((errors[(n - 1) / 2] + errors[n / 2]) / 2.0);
        }
        println!("{}", lines.join("\n"));
        println!("{name} mAA@10 {maa:.3} over {SEEDS} seeds");
        checks.push(Check::at_most(format!("{name} pairs over 10 px (worst seed)"), worst_failures, max_failures));
        checks.push(Check::at_most(format!("{name} median error, px (worst seed)"), worst_median, max_median));
    }
    Ok(checks)
}

/// Annotated matches of an image pair.
pub(crate) struct Pair {
    pub(crate) name: String,
    pub(crate) tentative: Vec<Correspondence>,
    pub(crate) checked: Vec<Correspondence>,
}

/// Reads all files `NAME_pts.txt` with a `NAME_model.txt` beside them: rows `x1 y1 1 x2 y2 1 label`.
pub(crate) fn load(folder: &Path) -> Result<Vec<Pair>> {
    let mut pairs = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let path = entry?.path();
        let file = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let Some(name) = file.strip_suffix("_pts.txt") else { continue };
        if !folder.join(format!("{name}_model.txt")).exists() {
            continue;
        }
        let mut pair = Pair { name: name.to_owned(), tentative: Vec::new(), checked: Vec::new() };
        for line in std::fs::read_to_string(&path)?.lines() {
            let v: Vec<f64> = line.split_whitespace().filter_map(|w| w.parse().ok()).collect();
            let [x1, y1, _, x2, y2, _, label] = v[..] else { continue };
            let target = if label > 0.0 { &mut pair.checked } else { &mut pair.tentative };
            target.push(Correspondence::new(x1, y1, x2, y2));
        }
        ensure!(
            pair.tentative.len() >= 8 && pair.checked.len() >= 8,
            "{} has fewer than 8 rows of a label",
            path.display()
        );
        pairs.push(pair);
    }
    ensure!(!pairs.is_empty(), "no pairs in {}", folder.display());
    pairs.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(pairs)
}

/// Computes the symmetric transfer RMS of a homography or the Sampson RMS of a fundamental matrix, in pixels.
pub(crate) fn rms(kind: ModelKind, m: &Matrix3<f64>, points: &[Correspondence]) -> f64 {
    let h = |p: cv_core::Point2<f64>| Vector3::new(p.x, p.y, 1.0);
    let sum: f64 = match kind {
        ModelKind::Homography => {
            let Some(inverse) = m.try_inverse() else { return f64::INFINITY };
            let transfer = |m: &Matrix3<f64>, a, b: cv_core::Point2<f64>| {
                let p = m * h(a);
                (p.x / p.z - b.x).powi(2) + (p.y / p.z - b.y).powi(2)
            };
            points.iter().map(|c| (transfer(m, c.a, c.b) + transfer(&inverse, c.b, c.a)) / 2.0).sum()
        }
        ModelKind::Fundamental => points
            .iter()
            .map(|c| {
                let (l, k) = (m * h(c.a), m.transpose() * h(c.b));
                h(c.b).dot(&l).powi(2) / (l.x * l.x + l.y * l.y + k.x * k.x + k.y * k.y)
            })
            .sum(),
    };
    (sum / points.len() as f64).sqrt()
}

/// Computes mAA@10: the mean over k = 1 … 10 of the fraction of errors below k px.
pub(crate) fn mean_average_accuracy(errors: &[f64]) -> f64 {
    let below = |k: f64| errors.iter().filter(|e| **e < k).count() as f64 / errors.len() as f64;
    (1..=10).map(|k| below(f64::from(k))).sum::<f64>() / 10.0
}
