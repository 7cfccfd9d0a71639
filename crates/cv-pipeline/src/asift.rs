//! ASIFT (Morel & Yu, "ASIFT: a new framework for fully affine invariant image comparison", 2009): SIFT features of
//! simulated affine views, for photographs from very different viewpoints.

use crate::matching::{MatchingOptions, match_features};
use cv_core::{Cancelled, DMatch, GrayF32, Progress, Stage};
use cv_features::{FeatureError, Features, MatchError, SiftOptions, sift_affine_view};
use cv_imgproc::resize_area;
use std::f32::consts::PI;

/// Simulated tilts: with the √2 that SIFT tolerates on either side, up to a latitude of 80°.
const TILTS: [f32; 2] = [2.0, 4.0];
/// Rotation step in radians, for a tilt of 1: 72°/tilt (Morel & Yu).
const ROTATION_STEP: f32 = 0.4 * PI;
/// Distance in pixels below which two matches are duplicates.
const DUPLICATE_RADIUS_PX: f32 = 2.0;

/// Longer image side in pixels from which on views are selected at reduced resolution first.
const TWO_RESOLUTION_MIN_SIDE: usize = 900;
/// Reduction factor of the selection (Morel & Yu, section 7).
const REDUCTION: usize = 3;
/// Number of views selected for full resolution (Morel & Yu, section 7).
const FULL_RESOLUTION_VIEWS: usize = 5;

/// A simulated view: the index of its image, its tilt and its rotation.
type AffineView = (usize, f32, f32);

/// Matches the simulated views of each image with the other image. Adds the features that match to `features` and the
/// matches to `matches`, unless they are duplicates or the other image's feature has a match of a smaller distance.
///
/// For large images only the views that match best at reduced resolution are processed.
pub(crate) fn match_asift(
    photos: [&GrayF32; 2],
    sift: &SiftOptions,
    features: &mut [Features; 2],
    matches: &mut Vec<DMatch>,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<(), Cancelled> {
    let views = select_views(photos, sift, options, progress)?;
    let stage = Stage::new(progress, "slanted views", views.len())?;
    let plain = features.clone();
    for (side, tilt, rotation) in views {
        if let Some((view, view_matches)) =
            match_view(photos[side], &plain[1 - side], (tilt, rotation), sift, options, &stage)?
        {
            for m in view_matches {
                stage.check()?;
                let position = view.keypoints[m.query as usize].position;
                let other_position = plain[1 - side].keypoints[m.train as usize].position;
                let is_duplicate = matches.iter().any(|n| {
                    let position_of = |side: usize, i: u32| features[side].keypoints[i as usize].position;
                    let ends = [position_of(0, n.query), position_of(1, n.train)];
                    (ends[side] - position).norm() < DUPLICATE_RADIUS_PX
                        && (ends[1 - side] - other_position).norm() < DUPLICATE_RADIUS_PX
                });
                let has_better =
                    matches.iter().any(|n| [n.query, n.train][1 - side] == m.train && n.distance <= m.distance);
                if is_duplicate || has_better {
                    continue;
                }
                let Some(added) = features[side].add(&view, m.query as usize) else { continue };
                let (query, train) = if side == 0 { (added, m.train) } else { (m.train, added) };
                matches.push(DMatch { query, train, ..m });
            }
        }
        stage.add(1)?;
    }
    Ok(())
}

/// Returns the views to process at full resolution, in order: all views of small images, for large ones those with most
/// matches at reduced resolution.
fn select_views(
    photos: [&GrayF32; 2],
    sift: &SiftOptions,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<Vec<AffineView>, Cancelled> {
    let rotations = |tilt: f32| {
        let count = (PI / (ROTATION_STEP / tilt)).round() as usize;
        (0..count).map(move |i| (tilt, i as f32 * PI / count as f32))
    };
    let all: Vec<AffineView> = [0, 1]
        .into_iter()
        .flat_map(|side| TILTS.into_iter().flat_map(rotations).map(move |(t, r)| (side, t, r)))
        .collect();
    if photos.iter().all(|photo| photo.width().max(photo.height()) < TWO_RESOLUTION_MIN_SIDE) {
        return Ok(all);
    }
    let reduced = photos.map(|photo| {
        let side = |n: usize| n.div_ceil(REDUCTION);
        resize_area(photo.view(), side(photo.width()), side(photo.height())).unwrap_or_else(|_| photo.clone())
    });
    let extract = |photo: &GrayF32| match cv_features::sift(photo.view(), sift, progress) {
        Err(FeatureError::Cancelled(stop)) => Err(stop),
        other => Ok(other.ok()),
    };
    let [Some(a), Some(b)] = [extract(&reduced[0])?, extract(&reduced[1])?] else { return Ok(all) };
    let plain = [a, b];
    let stage = Stage::new(progress, "slanted views", all.len())?;
    let mut match_counts = Vec::with_capacity(all.len());
    for &(side, tilt, rotation) in &all {
        let matched = match_view(&reduced[side], &plain[1 - side], (tilt, rotation), sift, options, &stage)?;
        match_counts.push(matched.map_or(0, |(_, matches)| matches.len()));
        stage.add(1)?;
    }
    let mut best: Vec<usize> = (0..all.len()).collect();
    best.sort_by_key(|&i| std::cmp::Reverse(match_counts[i]));
    best.truncate(FULL_RESOLUTION_VIEWS);
    best.sort_unstable();
    Ok(best.into_iter().map(|i| all[i]).collect())
}

/// Returns the features of a view and their matches in the other image; `None` for a view that is too small.
fn match_view(
    photo: &GrayF32,
    other: &Features,
    (tilt, rotation): (f32, f32),
    sift: &SiftOptions,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<Option<(Features, Vec<DMatch>)>, Cancelled> {
    let view = match sift_affine_view(photo.view(), sift, tilt, rotation, progress) {
        Err(FeatureError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok(None),
        Ok(view) => view,
    };
    // The view's features are the queries: in the ratio test, the second nearest neighbor among the few features of a
    // view would be too far.
    match match_features(&view, other, options, progress) {
        Err(MatchError::Cancelled(stop)) => Err(stop),
        found => Ok(found.ok().map(|matches| (view, matches))),
    }
}
