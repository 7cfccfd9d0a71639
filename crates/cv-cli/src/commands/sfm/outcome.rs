//! The outcome of a run: registration of each photograph, statistics and JSON.

use super::photographs::Photograph;
use super::places::Frame;
use crate::frame::Outcome;
use crate::words;
use cv_core::SparseModel;
use cv_pipeline::SfmResult;
use cv_pipeline::many_views::ViewOutcome;
use serde_json::{Value, json};

/// The outcome of a photograph: the index of its model, or why it is not registered.
pub(super) type Registration = Result<usize, String>;

pub(super) fn registration_outcomes(all: &[Photograph], used: &[usize], outcomes: &[ViewOutcome]) -> Vec<Registration> {
    let mut registered: Vec<Registration> = all.iter().map(|p| Err(p.refused.clone().unwrap_or_default())).collect();
    for (at, outcome) in used.iter().zip(outcomes) {
        registered[*at] = match outcome {
            ViewOutcome::Registered { model } => Ok(*model),
            other => Err(words::many_views::left_out(other).unwrap_or_default()),
        };
    }
    registered
}

/// Returns a warning if there are several models, or if less than half of the photographs are registered.
pub(super) fn completeness_warning(models: &[SparseModel], registered: &[Registration]) -> Option<String> {
    let inside = registered.iter().filter(|model| **model == Ok(0)).count();
    let more = "add photographs in between";
    match models.len() {
        1 if 2 * inside >= registered.len() => None,
        1 => Some(format!("only {inside} of {} photographs are in the model; {more}", registered.len())),
        n => Some(format!(
            "the photographs form {n} models without a common frame; {inside} of {} are in the largest; {more}",
            registered.len()
        )),
    }
}

/// Computes the RMS reprojection error in pixels over all observations.
pub(super) fn reprojection_rms(model: &SparseModel) -> f64 {
    let errors: Vec<f64> = reprojections(model).collect();
    (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
}

/// Returns the reprojection error of each observation in pixels.
pub(super) fn reprojections(model: &SparseModel) -> impl Iterator<Item = f64> + '_ {
    model.points.values().flat_map(move |point| {
        point.track.iter().filter_map(move |(id, index)| {
            let image = model.images.get(id)?;
            let at = image.points.get(*index as usize)?.0;
            let pixel = model.cameras.get(&image.camera)?.project(&image.pose.transform(&point.position))?;
            Some((pixel - at).norm())
        })
    })
}

pub(super) fn outcome(
    all: &[Photograph],
    registered: &[Registration],
    models: &[SparseModel],
    frames: &[Frame],
    result: &SfmResult,
    (reused, pairs_reused): (usize, bool),
    stages: Vec<(&'static str, f64)>,
) -> Outcome {
    let image = |(one, outcome): (&Photograph, &Registration)| {
        let model = outcome.as_ref().ok();
        json!({ "path": one.path.display().to_string(), "used": model.is_some(), "model": model, "reason": outcome.as_ref().err() })
    };
    let images: Vec<Value> = all.iter().zip(registered).map(image).collect();
    let used = registered.iter().filter(|outcome| outcome.is_ok()).count();
    let main = result.models.first();
    let (points, observations) = main.map_or((0, 0), |m| (m.points.len(), m.observations()));
    let (length, error) = main.map_or((0.0, 0.0), |m| (m.mean_track_length(), m.mean_reprojection_error()));
    let rms = models.first().map_or(f64::NAN, reprojection_rms);
    let focal: Vec<f64> = models.first().map_or_else(Vec::new, |m| m.cameras.values().map(|c| c.fx).collect());
    let mut summary = format!(
        "{used} of {} photographs in {} model{}; {points} points, mean track length {length:.1}, {rms:.3} px RMS",
        all.len(),
        models.len(),
        if models.len() == 1 { "" } else { "s" },
    );
    if reused > 0 {
        let pairs = if pairs_reused { ", and the pairs," } else { "" };
        summary += &format!("\nthe features of {reused} photographs{pairs} are from an earlier run");
    }
    let refused = words::many_views::RefusedPairs::of(&result.refused);
    summary.extend(refused.text(result.pairs.len()).map(|text| format!("\n{text}")));
    if let Some(frame) = frames.first() {
        summary += &format!("\nthe model is {}", frame.text);
    }
    // Refused photographs have been warned of already.
    for (one, outcome) in all.iter().zip(registered) {
        if let (Err(reason), None) = (outcome, &one.refused) {
            summary += &format!("\n{}: left out: {reason}", one.path.display());
        }
    }
    Outcome::new(stages)
        .with("images", images)
        .with("models", models.len())
        .with("points", points)
        .with("observations", observations)
        .with("mean_track_length", length)
        .with("reprojection_rms_px", rms)
        .with("mean_reprojection_px", error)
        .with("focal_px", focal)
        .with("solvers", result.solvers.iter().map(ToString::to_string).collect::<Vec<_>>())
        .with("refused_pairs", json!({ "triplets": refused.triplets, "repeated": refused.repeated }))
        .with("resumed", json!({ "features": reused, "pairs": pairs_reused }))
        .with("alignment", frames.first().map(|frame| &frame.json))
        .summary(summary)
}
