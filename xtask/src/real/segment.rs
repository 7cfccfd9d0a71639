//! `segment` on photographs of an orange ball with masks by hand, scored as `peers/` scores others: trained on every other photograph, tested on the
//! rest, and the other way round.

use super::Check;
use anyhow::{Context, Result, ensure};
use cv_core::{Mask, RgbU8};
use cv_pipeline::segmentation::{ColorSpace, ConfusionMatrix, Labeled, Rule, TrainOptions};
use cv_pipeline::{Silent, segment, train_segment};
use std::{fs, path::Path, time::Instant};

/// F1 that is asked for.
const BAR: f64 = 0.93;
/// The best F1 of scikit-learn's mixtures on the same halves: HSV, five components, posterior.
const PEER: f64 = 0.969;

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
                checks.push(Check::at_least(format!("F1, {name}"), scores.f1(), BAR));
                if first == 0 {
                    checks.push(Check::at_least("F1, the best of scikit-learn's", scores.f1(), PEER));
                }
            }
        }
    }
    Ok(checks)
}

/// The photographs and masks, by name.
fn load(folder: &Path) -> Result<Vec<(RgbU8, Mask)>> {
    let entries = fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    let names: Result<Vec<_>, _> =
        entries.map(|entry| entry.map(|e| e.file_name().to_string_lossy().into_owned())).collect();
    let mut masks: Vec<String> = names?.into_iter().filter(|name| name.ends_with("_mask.png")).collect();
    masks.sort();
    ensure!(masks.len() == 12, "{} holds {} masks, not 12", folder.display(), masks.len());
    let pair = |mask: &String| -> Result<(RgbU8, Mask)> {
        let photo = mask.replace("_mask.png", ".jpg");
        Ok((cv_io::read_rgb(folder.join(photo))?, cv_io::read_mask(folder.join(mask))?))
    };
    masks.iter().map(pair).collect()
}

/// Trains on every other photograph from `first` on and scores the rest, all their pixels together; also the least seconds a photograph took.
fn score(photos: &[(RgbU8, Mask)], first: usize, options: &TrainOptions) -> Result<(ConfusionMatrix, f64)> {
    let half = |odd: usize| photos.iter().skip(odd).step_by(2);
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
