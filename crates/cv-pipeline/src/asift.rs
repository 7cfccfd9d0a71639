//! ASIFT (Morel & Yu 2009): more matches for photographs taken from very different directions, by SIFT features of affine-simulated views.

use crate::matching::{MatchingOptions, match_features};
use cv_core::{Cancelled, DMatch, GrayF32, Progress, Stage};
use cv_features::{FeatureError, Features, MatchError, SiftOptions, sift_affine_view};
use cv_imgproc::resize_area;
use std::f32::consts::PI;

/// Tilts that are simulated: with the √2 that SIFT itself bears on either side of each, up to a slant of 80°.
const TILTS: [f32; 2] = [2.0, 4.0];
/// Rotations are 72°/tilt apart (Morel & Yu).
const STEP: f32 = 0.4 * PI;
/// Two matches whose ends are nearer than this are the same, in pixels.
const SAME: f32 = 2.0;

/// Photographs whose longer side is at least this many pixels are looked at reduced first.
const LARGE: usize = 900;
/// By how much they are reduced then, and how many of the views are looked at in full after that (Morel & Yu, section 7: 3 and 5).
const REDUCTION: usize = 3;
const FULL_VIEWS: usize = 5;

/// A simulated view: of which photograph, its tilt and its rotation.
type View = (usize, f32, f32);

/// Matches the simulated views of each photograph with the other as it is. The features that match are added to the photographs' own, and the matches to
/// `matches`, unless they are there already or the other photograph's feature has a match at a smaller distance.
///
/// Of large photographs only the views that match best at a third of the size are looked at.
pub(crate) fn match_asift(
    photos: [&GrayF32; 2],
    sift: &SiftOptions,
    features: &mut [Features; 2],
    matches: &mut Vec<DMatch>,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<(), Cancelled> {
    let views = promising(photos, sift, options, progress)?;
    let stage = Stage::new(progress, "slanted views", views.len())?;
    let plain = features.clone();
    for (side, tilt, rotation) in views {
        if let Some((view, more)) = matched(photos[side], &plain[1 - side], (tilt, rotation), sift, options, &stage)? {
            for m in more {
                // Each looks at all there are.
                stage.check()?;
                let new = view.keypoints[m.query as usize].position;
                let old = plain[1 - side].keypoints[m.train as usize].position;
                let known = matches.iter().any(|n| {
                    let at = |side: usize, i: u32| features[side].keypoints[i as usize].position;
                    let ends = [at(0, n.query), at(1, n.train)];
                    (ends[side] - new).norm() < SAME && (ends[1 - side] - old).norm() < SAME
                });
                let taken = matches.iter().any(|n| [n.query, n.train][1 - side] == m.train && n.distance <= m.distance);
                if known || taken {
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

/// The views to look at in full, in their order: all of small photographs, of large ones those with the most matches when both are reduced.
fn promising(
    photos: [&GrayF32; 2],
    sift: &SiftOptions,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<Vec<View>, Cancelled> {
    let rotations = |tilt: f32| {
        let count = (PI / (STEP / tilt)).round() as usize;
        (0..count).map(move |i| (tilt, i as f32 * PI / count as f32))
    };
    let all: Vec<View> = [0, 1]
        .into_iter()
        .flat_map(|side| TILTS.into_iter().flat_map(rotations).map(move |(t, r)| (side, t, r)))
        .collect();
    if photos.iter().all(|photo| photo.width().max(photo.height()) < LARGE) {
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
    let mut counted = Vec::with_capacity(all.len());
    for &(side, tilt, rotation) in &all {
        let found = matched(&reduced[side], &plain[1 - side], (tilt, rotation), sift, options, &stage)?;
        counted.push(found.map_or(0, |(_, matches)| matches.len()));
        stage.add(1)?;
    }
    let mut best: Vec<usize> = (0..all.len()).collect();
    best.sort_by_key(|&i| std::cmp::Reverse(counted[i]));
    best.truncate(FULL_VIEWS);
    best.sort_unstable();
    Ok(best.into_iter().map(|i| all[i]).collect())
}

/// The features of a view and their matches in the other photograph; `None` for a view that is too small to look at, and has nothing to add.
fn matched(
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
    // The view asks, the whole photograph answers: among the few features of a view, the second best would be far too often.
    match match_features(&view, other, options, progress) {
        Err(MatchError::Cancelled(stop)) => Err(stop),
        found => Ok(found.ok().map(|matches| (view, matches))),
    }
}

#[cfg(test)]
mod tests {
    use crate::{AffineSimulation, MatchingOptions, Silent, match_photos};
    use cv_core::RgbU8;

    /// A large plane seen from the front and under a slant of 75°: which views to look at in full is found on the reduced photographs.
    #[test]
    fn a_large_plane_under_a_slant_matches_where_it_should() {
        let mut state = 5u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        // Wide enough for a plane that is compressed four times to keep them.
        let spots: Vec<[f32; 4]> =
            (0..500).map(|_| [960.0 * random(), 540.0 * random(), 6.0 + 8.0 * random(), random() - 0.5]).collect();
        let plane = |x: f32, y: f32| {
            let near = |s: &&[f32; 4]| (x - s[0]).abs() < 4.0 * s[2] && (y - s[1]).abs() < 4.0 * s[2];
            let value = |s: &[f32; 4]| s[3] * (-((x - s[0]).powi(2) + (y - s[1]).powi(2)) / (2.0 * s[2] * s[2])).exp();
            [(128.0 + 100.0 * spots.iter().filter(near).map(value).sum::<f32>()).clamp(0.0, 255.0) as u8; 3]
        };
        let front = RgbU8::from_fn(960, 540, |x, y| plane(x as f32, y as f32));
        let slanted = RgbU8::from_fn(240, 540, |x, y| plane(4.0 * x as f32, y as f32));
        let right = |affine_simulation| {
            let options = MatchingOptions { affine_simulation, ..MatchingOptions::default() };
            let pairs = match_photos(front.view(), slanted.view(), &options, &Silent).unwrap().pairs();
            // Two pixels of either photograph: that is how near two features count as one.
            let holds = |p: &&cv_core::Correspondence| (p.a.x - 4.0 * p.b.x).abs() < 8.0 && (p.a.y - p.b.y).abs() < 2.0;
            (pairs.iter().filter(holds).count(), pairs.len())
        };
        let (plain, with) = (right(AffineSimulation::Never), right(AffineSimulation::Always));
        // A hundred of the 500 spots, and nearly all of what is found in its place.
        assert!(with.0 >= 100 && 10 * with.0 >= 9 * with.1, "{with:?}, plain {plain:?}");
        assert!(with.0 > 3 * plain.0, "{with:?}, plain {plain:?}");
    }
}
