//! What became of the photographs, as it is told.

use super::photographs::Photograph;
use super::places::Frame;
use crate::frame::Outcome;
use crate::words;
use cv_core::SparseModel;
use cv_pipeline::SfmResult;
use cv_pipeline::many_views::ViewOutcome;
use serde_json::{Value, json};

/// What became of a photograph: the model it is in, or why it is in none.
pub(super) type Fate = Result<usize, String>;

pub(super) fn fates(all: &[Photograph], used: &[usize], outcomes: &[ViewOutcome]) -> Vec<Fate> {
    let mut fates: Vec<Fate> = all.iter().map(|p| Err(p.refused.clone().unwrap_or_default())).collect();
    for (at, outcome) in used.iter().zip(outcomes) {
        fates[*at] = match outcome {
            ViewOutcome::Registered { model } => Ok(*model),
            other => Err(words::many_views::left_out(other).unwrap_or_default()),
        };
    }
    fates
}

/// What to think of a model that is not of most photographs.
pub(super) fn doubt(models: &[SparseModel], fates: &[Fate]) -> Option<String> {
    let inside = fates.iter().filter(|fate| **fate == Ok(0)).count();
    let more = "photographs in between join them";
    match models.len() {
        1 if 2 * inside >= fates.len() => None,
        1 => Some(format!("only {inside} of {} photographs are in the model; {more}", fates.len())),
        n => Some(format!(
            "the photographs fall apart into {n} models, whose places to each other are unknown; {inside} of {} are in the largest; {more}",
            fates.len()
        )),
    }
}

/// Root mean square distance in pixels between the points' projections and where they were seen, over all observations.
pub(super) fn reprojection_rms(model: &SparseModel) -> f64 {
    let errors: Vec<f64> = reprojections(model).collect();
    (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
}

/// The distance of each observation from its point's projection, in pixels.
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
    fates: &[Fate],
    models: &[SparseModel],
    frames: &[Frame],
    result: &SfmResult,
    (taken, pairs_taken): (usize, bool),
    stages: Vec<(&'static str, f64)>,
) -> Outcome {
    let image = |(one, fate): (&Photograph, &Fate)| {
        let model = fate.as_ref().ok();
        json!({ "path": one.path.display().to_string(), "used": model.is_some(), "model": model, "reason": fate.as_ref().err() })
    };
    let images: Vec<Value> = all.iter().zip(fates).map(image).collect();
    let used = fates.iter().filter(|fate| fate.is_ok()).count();
    let main = result.models.first();
    let (points, observations) = main.map_or((0, 0), |m| (m.points.len(), m.observations()));
    let (length, error) = main.map_or((0.0, 0.0), |m| (m.mean_track_length(), m.mean_reprojection_error()));
    let rms = models.first().map_or(f64::NAN, reprojection_rms);
    let focal: Vec<f64> = models.first().map_or_else(Vec::new, |m| m.cameras.values().map(|c| c.fx).collect());
    let mut summary = format!(
        "{used} of {} photographs in {} model{}; {points} points seen {length:.1} times each, {rms:.3} px RMS",
        all.len(),
        models.len(),
        if models.len() == 1 { "" } else { "s" },
    );
    if taken > 0 {
        let pairs = if pairs_taken { ", and the pairs," } else { "" };
        summary += &format!("\nthe features of {taken} photographs{pairs} are of an earlier run");
    }
    let refused = words::many_views::RefusedPairs::of(&result.refused);
    summary.extend(refused.text(result.pairs.len()).map(|text| format!("\n{text}")));
    if let Some(frame) = frames.first() {
        summary += &format!("\nthe model is {}", frame.text);
    }
    // What was refused has been warned of.
    for (one, fate) in all.iter().zip(fates) {
        if let (Err(reason), None) = (fate, &one.refused) {
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
        .with("resumed", json!({ "features": taken, "pairs": pairs_taken }))
        .with("alignment", frames.first().map(|frame| &frame.json))
        .summary(summary)
}
