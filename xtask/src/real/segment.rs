//! `segment` on photographs of an orange ball with hand-labeled masks: trained on every other photograph, tested on the rest, and vice versa.

use super::Check;
use anyhow::{Context, Result, ensure};
use cv_core::{Mask, RgbU8};
use cv_pipeline::segmentation::{ColorSpace, ConfusionMatrix, Labeled, Rule, TrainOptions};
use cv_pipeline::{Silent, segment, train_segment};
use std::{fs, path::Path, time::Instant};

/// Smallest F1.
const MIN_F1: f64 = 0.93;
/// Best F1 of scikit-learn's Gaussian mixtures on the same halves (HSV, five components, posterior).
const PEER_F1: f64 = 0.969;

pub(crate) fn run(data: &Path) -> Result<Vec<Check>> {
    let folder = data.join("segmentation/orange-ball/train");
    let photos = load(&folder)?;
    let mut checks = Vec::new();
    for (space, rule) in [
        (ColorSpace::Hsv, Rule::Tuned),
        (ColorSpace::Hsv, Rule::Posterior),
        (ColorSpace::Hsv, Rule::Density),
        (ColorSpace::Rgb, Rule::Tuned),
        (ColorSpace::Lab, Rule::Tuned),
    ] {
        let options = TrainOptions { space, rule, ..TrainOptions::default() };
        for first in [0, 1] {
            let (scores, seconds) = score(&photos, first, &options)?;
            let name = format!("{space:?}, {rule:?}, trained on photos {first}, {}, …", first + 2).to_lowercase();
            println!(
                "{name:46} precision {:.3}  recall {:.3}  F1 {:.4}  {:.1} ms a photo",
                scores.precision(),
                scores.recall(),
                scores.f1(),
                1e3 * seconds
            );
            if options == TrainOptions::default() {
                checks.push(Check::at_least(format!("F1, {name}"), scores.f1(), MIN_F1));
                if first == 0 {
                    checks.push(Check::at_least("F1, the best of scikit-learn's", scores.f1(), PEER_F1));
                }
            }
        }
    }
    Ok(checks)
}

/// Reads the photographs and masks, in the order of their names.
fn load(folder: &Path) -> Result<Vec<(RgbU8, Mask)>> {
    let entries = fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    let names: Result<Vec<_>, _> =
        entries.map(|entry| entry.map(|e| e.file_name().to_string_lossy().into_owned())).collect();
    let mut masks: Vec<String> = names?.into_iter().filter(|name| name.ends_with("_mask.png")).collect();
    masks.sort();
    ensure!(masks.len() == 12, "{} has {} masks, not 12", folder.display(), masks.len());
    let pair = |mask: &String| -> Result<(RgbU8, Mask)> {
        let photo = mask.replace("_mask.png", ".jpg");
        Ok((cv_io::read_rgb(folder.join(photo))?, cv_io::read_mask(folder.join(mask))?))
    };
    masks.iter().map(pair).collect()
}

/// Trains on every other photograph from `first` on and scores the rest over all pixels; also returns the smallest time of a photograph in seconds.
fn score(photos: &[(RgbU8, Mask)], first: usize, options: &TrainOptions) -> Result<(ConfusionMatrix, f64)> {
    let half = |first: usize| photos.iter().skip(first).step_by(2);
    let labeled: Vec<Labeled<'_>> = half(first).map(|(photo, mask)| (photo.view(), mask.view())).collect();
    let model = train_segment(&labeled, options, &Silent)?.trained.model;
    let mut seconds = f64::INFINITY;
    let scores: Result<Vec<ConfusionMatrix>> = half(1 - first)
        .map(|(photo, mask)| {
            let start = Instant::now();
            let result = segment(photo.view(), &model, &Silent)?;
            seconds = seconds.min(start.elapsed().as_secs_f64());
            Ok(ConfusionMatrix::new(result.mask.view(), mask.view())?)
        })
        .collect();
    Ok((scores?.into_iter().sum(), seconds))
}
