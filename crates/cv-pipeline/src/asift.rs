//! ASIFT (Morel & Yu 2009): more matches for photographs taken from very different directions, by SIFT features of affine-simulated views.

use crate::matching::{MatchingOptions, match_features};
use cv_core::{Cancelled, DMatch, GrayF32, Progress, Stage};
use cv_features::{FeatureError, Features, MatchError, SiftOptions, sift_affine_view};
use std::f32::consts::PI;

/// Tilts that are simulated: with the √2 that SIFT itself bears on either side of each, up to a slant of 80°.
const TILTS: [f32; 2] = [2.0, 4.0];
/// Rotations are 72°/tilt apart (Morel & Yu).
const STEP: f32 = 0.4 * PI;
/// Two matches whose ends are nearer than this are the same, in pixels.
const SAME: f32 = 2.0;

/// Matches the simulated views of each photograph with the other as it is. The features that match are added to the photographs' own, and the matches to
/// `matches`, unless they are there already or the other photograph's feature has a match at a smaller distance.
pub(crate) fn match_asift(
    photos: [&GrayF32; 2],
    sift: &SiftOptions,
    features: &mut [Features; 2],
    matches: &mut Vec<DMatch>,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<(), Cancelled> {
    let count = |tilt: f32| (PI / (STEP / tilt)).round() as usize;
    let stage = Stage::new(progress, "slanted views", 2 * TILTS.map(count).iter().sum::<usize>())?;
    let plain = features.clone();
    for side in [0, 1] {
        for tilt in TILTS {
            for i in 0..count(tilt) {
                let rotation = i as f32 * PI / count(tilt) as f32;
                // A view that is too small to look at has nothing to add.
                let view = match sift_affine_view(photos[side].view(), sift, tilt, rotation, &stage) {
                    Err(FeatureError::Cancelled(stop)) => return Err(stop),
                    Err(_) => continue,
                    Ok(view) => view,
                };
                // The view asks, the whole photograph answers: among the few features of a view, the second best would be far too often.
                let more = match match_features(&view, &plain[1 - side], options, &stage) {
                    Err(MatchError::Cancelled(stop)) => return Err(stop),
                    Err(_) => continue,
                    Ok(more) => more,
                };
                for m in more {
                    let new = view.keypoints[m.query as usize].position;
                    let old = plain[1 - side].keypoints[m.train as usize].position;
                    let known = matches.iter().any(|n| {
                        let at = |side: usize, i: u32| features[side].keypoints[i as usize].position;
                        let ends = [at(0, n.query), at(1, n.train)];
                        (ends[side] - new).norm() < SAME && (ends[1 - side] - old).norm() < SAME
                    });
                    let taken =
                        matches.iter().any(|n| [n.query, n.train][1 - side] == m.train && n.distance <= m.distance);
                    if known || taken {
                        continue;
                    }
                    let Some(added) = features[side].add(&view, m.query as usize) else { continue };
                    let (query, train) = if side == 0 { (added, m.train) } else { (m.train, added) };
                    matches.push(DMatch { query, train, ..m });
                }
                stage.add(1)?;
            }
        }
    }
    Ok(())
}
