//! More matches for photographs taken from very different directions: features of simulated slanted views.

use crate::PhotoFeatures;
use crate::matching::{MatchingOptions, match_features};
use cv_core::{DMatch, GrayF32, Keypoint};
use cv_features::{Described, sift_tilted};
use std::f32::consts::PI;

/// Tilts that are simulated: with the √2 that SIFT itself bears on either side of each, up to a slant of 80°.
const TILTS: [f32; 2] = [2.0, 4.0];
/// Rotations are 72°/tilt apart (Morel & Yu).
const STEP: f32 = 0.4 * PI;
/// Two matches whose ends are nearer than this are the same, in pixels.
const SAME: f32 = 2.0;

/// Matches the slanted views of each photograph with the other as it is. The features that match are added to the photographs' own, and the matches to
/// `matches`.
pub(crate) fn match_slanted(
    photos: [&GrayF32; 2],
    features: &mut [PhotoFeatures; 2],
    matches: &mut Vec<DMatch>,
    options: &MatchingOptions,
) {
    let plain = features.clone();
    for side in [0, 1] {
        for tilt in TILTS {
            let count = (PI / (STEP / tilt)).round() as usize;
            for i in 0..count {
                let rotation = i as f32 * PI / count as f32;
                // A view that is too small to look at has nothing to add.
                let Ok(described) = sift_tilted(photos[side].view(), &options.sift, tilt, rotation) else { continue };
                let view = PhotoFeatures { described, found: 0, candidates: Vec::new() };
                let pair = if side == 0 { [&view, &plain[1]] } else { [&plain[0], &view] };
                let Ok(more) = match_features(pair[0], pair[1], options) else { continue };
                for m in more {
                    let at = |d: &Described, i: u32| -> Keypoint { d.keypoints[i as usize] };
                    let (a, b) = (at(&pair[0].described, m.query), at(&pair[1].described, m.train));
                    let known = matches.iter().any(|n| {
                        let (c, d) = (at(&features[0].described, n.query), at(&features[1].described, n.train));
                        (a.position - c.position).norm() < SAME && (b.position - d.position).norm() < SAME
                    });
                    let own = if side == 0 { m.query } else { m.train };
                    if known {
                        continue;
                    }
                    let Some(added) = features[side].described.add(&view.described, own as usize) else { continue };
                    let (query, train) = if side == 0 { (added, m.train) } else { (m.query, added) };
                    matches.push(DMatch { query, train, ..m });
                }
            }
        }
    }
}
