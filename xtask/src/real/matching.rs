//! `cv match` and `cv estimate` on annotated pairs, from images to a model; hand-checked matches are the ground truth.

use super::{Check, estimate as annotated};
use anyhow::{Context, Result};
use cv_pipeline::{MatchingOptions, ModelKind, RobustOptions, Silent, estimate, match_photos};
use std::path::{Path, PathBuf};

/// Seeds of RANSAC; the figures are medians over them.
const SEEDS: u64 = 9;

/// The targets are the figures of OpenCV's SIFT (4000 features, ratio 0.8) with USAC_ACCURATE on the same pairs.
pub(super) fn run(data: &Path) -> Result<Vec<Check>> {
    let mut checks = Vec::new();
    for (kind, folder, name, min_successes, max_median, min_accuracy) in [
        (ModelKind::Homography, "homography", "H", 7.0, 2.18, 0.725),
        (ModelKind::Fundamental, "fundamental", "F", 6.0, 0.58, 0.814),
    ] {
        let folder = data.join(folder);
        // Error of each pair, by seed.
        let mut errors = vec![Vec::new(); SEEDS as usize];
        for pair in annotated::load(&folder)? {
            let [a, b] = [photo_path(&folder, &pair.name, "A")?, photo_path(&folder, &pair.name, "B")?];
            let (a, b) = (cv_io::read_rgb(a)?, cv_io::read_rgb(b)?);
            let matched = match_photos(a.view(), b.view(), &MatchingOptions::default(), &Silent);
            let mut line = format!("{name} {:12}", pair.name);
            match &matched {
                Ok(m) => line.push_str(&format!(
                    "{:6} {:6} features {:5} matches ",
                    m.features[0].keypoints.len(),
                    m.features[1].keypoints.len(),
                    m.matches.len()
                )),
                Err(error) => line.push_str(&format!("{error} ")),
            }
            for (seed, errors) in errors.iter_mut().enumerate() {
                let options = RobustOptions { seed: seed as u64, ..kind.options() };
                let model = matched.as_ref().ok().and_then(|m| estimate(&m.pairs(), kind, &options, &Silent).ok());
                let error = model.map_or(f64::INFINITY, |m| annotated::rms(kind, &m.robust.model, &pair.checked));
                line.push_str(&format!(" {error:7.2}"));
                errors.push(error);
            }
            println!("{line}");
        }
        let over_seeds = |figure: &dyn Fn(&[f64]) -> f64| median(errors.iter().map(|e| figure(e)).collect());
        let success = over_seeds(&|e| e.iter().filter(|e| **e < 10.0).count() as f64);
        checks.push(Check::at_least(format!("{name} pairs under 10 px"), success, min_successes));
        checks.push(Check::at_most(
            format!("{name} median error, px"),
            over_seeds(&|e| median(e.to_vec())),
            max_median,
        ));
        let accuracy = over_seeds(&annotated::mean_average_accuracy);
        checks.push(Check::at_least(format!("{name} mAA at 1 to 10 px"), accuracy, min_accuracy));
    }
    Ok(checks)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    if n == 0 { f64::NAN } else { (values[(n - 1) / 2] + values[n / 2]) / 2.0 }
}

fn photo_path(folder: &Path, name: &str, side: &str) -> Result<PathBuf> {
    ["png", "jpg"]
        .iter()
        .map(|extension| folder.join(format!("{name}{side}.{extension}")))
        .find(|path| path.exists())
        .with_context(|| format!("no photograph {name}{side} in {}", folder.display()))
}
