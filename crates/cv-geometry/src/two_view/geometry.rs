//! The cameras and the relative pose, from all tentative matches.

use super::degeneracy::DegeneracyTest;
use super::lens::{Found, Rival, USUAL_FOCALS, find_lens};
use super::{Intrinsics, MatchedViews, TwoViewError, TwoViewOptions};
use crate::{
    EstimateError, RobustModel, RobustOptions, estimate_relative_pose, normalize_matches, pose_difference,
    poses_are_rivals, refine_relative_pose,
};
use cv_core::{Camera, Correspondence, Distortion, Pose, Progress, Stage};
use rayon::prelude::*;

/// Cameras, relative pose, and the matches that agree with them. Not adjusted yet: see [`TwoViewAdjustment`](super::TwoViewAdjustment).
#[derive(Debug, Clone, PartialEq)]
pub struct TwoViewGeometry {
    /// The cameras; focal lengths and radial distortion estimated where they were not known.
    pub cameras: [Camera; 2],
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// Indices of the matches that obey the epipolar geometry, ascending.
    pub inliers: Vec<usize>,
    /// Largest relative change of the focal length that the matches do not exclude; 0 where it was given.
    pub focal_range: f64,
    /// Share of the inliers that one homography explains.
    pub planar_share: f64,
}

/// The cameras and the relative pose of two views, and which matches agree with them.
///
/// The lens is searched where it is not known, then the pose from several seeds; a scene that is one plane and a camera that only
/// turned are refused, as are directions that the matches do not tell from others. O(samples × matches).
///
/// # Errors
/// [`TwoViewError`], each with its numbers.
pub fn estimate_two_view_geometry(
    views: &MatchedViews<'_>,
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewGeometry, TwoViewError> {
    let prior = options.intrinsics.cameras(views.sizes)?;
    let pairs = &views.correspondences(views.matches)?;
    if pairs.len() < options.min_inliers {
        return Err(TwoViewError::TooFewMatches { got: pairs.len(), needed: options.min_inliers });
    }
    let degeneracy = DegeneracyTest::new(pairs, views.sizes, prior, options, progress)?;
    // Nothing can have more inliers than there are matches.
    degeneracy.check(pairs.len(), options)?;
    let found = search(pairs, views.sizes, prior, options, progress);
    // Of a turn, a search for a moving camera finds but a part: half of the points are behind whatever it supposes.
    if let Err(
        TwoViewError::TooFewInliers { inliers, .. }
        | TwoViewError::UncertainPose { inliers, .. }
        | TwoViewError::WrongFocal { inliers, .. },
    ) = &found
    {
        degeneracy.check(*inliers, options)?;
    }
    let mut found = found?;
    degeneracy.check(found.inliers.len(), options)?;
    found.planar_share = degeneracy.planar as f64 / found.inliers.len() as f64;
    Ok(found)
}

/// The lens where it is not known, and the pose.
fn search(
    pairs: &[Correspondence],
    sizes: [(usize, usize); 2],
    prior: Option<[Camera; 2]>,
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewGeometry, TwoViewError> {
    match (options.intrinsics, prior) {
        (Intrinsics::Known(_), Some(cameras)) => calibrated(pairs, cameras, options, progress),
        (_, Some(cameras)) => with_cameras(pairs, cameras, options, progress, MOST_RIVALS),
        (_, None) => without_focal(pairs, sizes, options, progress),
    }
}

/// Focal lengths that are tried in turn where each fits worse than the next: what is advised must hold when it is given.
const MOST_RIVALS: usize = 2;

/// Cameras whose distortion is to be found, and whose focal length may be wrong altogether.
fn with_cameras(
    pairs: &[Correspondence],
    cameras: [Camera; 2],
    options: &TwoViewOptions,
    progress: &dyn Progress,
    rivals: usize,
) -> Result<TwoViewGeometry, TwoViewError> {
    let found = find_lens(pairs, cameras, false, &options.robust, progress)?;
    let Some(Found { cameras: with_lens, rival, .. }) = found else {
        return calibrated(pairs, cameras, options, progress);
    };
    if let (Some(Rival { focal, deviations, inliers }), 1..) = (rival, rivals) {
        // As it will be given.
        let better = focal.round();
        let other = cameras.map(|c| Camera { fx: better, fy: better * (c.fy / c.fx), ..c });
        match with_cameras(pairs, other, options, progress, rivals - 1) {
            Ok(_) => return Err(TwoViewError::WrongFocal { given: cameras[0].fx, better, deviations, inliers }),
            Err(TwoViewError::WrongFocal { better, deviations, inliers, .. }) => {
                return Err(TwoViewError::WrongFocal { given: cameras[0].fx, better, deviations, inliers });
            }
            Err(TwoViewError::Cancelled(stop)) => return Err(stop.into()),
            // Nothing better can be advised.
            Err(_) => {}
        }
    }
    TwoViewError::check_focal(cameras[0].fx, cameras[0].width.max(cameras[0].height))?;
    calibrated(pairs, with_lens, options, progress)
}

/// Photographs of one unknown focal length.
fn without_focal(
    pairs: &[Correspondence],
    sizes: [(usize, usize); 2],
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewGeometry, TwoViewError> {
    let longest = sizes[0].0.max(sizes[0].1) as f64;
    let of = |share: f64| {
        let camera = |(width, height)| Camera::from_focal(width, height, share * longest);
        sizes.map(camera).map(|camera| Camera { distortion: Distortion::radial(0.0, 0.0), ..camera })
    };
    let found =
        find_lens(pairs, sizes.map(|(w, h)| Camera::from_focal(w, h, longest)), true, &options.robust, progress)?;
    let first = match found {
        Some(Found { cameras, focal_range, .. }) => {
            calibrated(pairs, cameras, options, progress).map(|found| TwoViewGeometry { focal_range, ..found })
        }
        // Where no lens has a pose, the search with an ordinary one says why.
        None => calibrated(pairs, of(1.2), options, progress),
    };
    let Err(uncertain @ TwoViewError::UncertainPose { .. }) = first else { return first };
    // Where two poses fit as well with the best focal length, another may tell them apart.
    let mut best: Option<TwoViewGeometry> = None;
    for share in USUAL_FOCALS {
        match calibrated(pairs, of(share), options, progress) {
            Ok(found) if best.as_ref().is_none_or(|b| found.inliers.len() > b.inliers.len()) => best = Some(found),
            Err(TwoViewError::Cancelled(stop)) => return Err(stop.into()),
            _ => {}
        }
    }
    best.map(|found| TwoViewGeometry { focal_range: 1.0, ..found }).ok_or(uncertain)
}

/// Refuses where fewer agree than were asked for.
fn enough(inliers: usize, matches: usize, options: &TwoViewOptions) -> Result<(), TwoViewError> {
    let needed = options.min_inliers.max((options.min_inlier_share * matches as f64).ceil() as usize);
    if inliers < needed {
        return Err(TwoViewError::TooFewInliers { inliers, matches, needed });
    }
    Ok(())
}

/// The pose of two cameras that are known, from several seeds.
fn calibrated(
    pairs: &[Correspondence],
    cameras: [Camera; 2],
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewGeometry, TwoViewError> {
    let (normalized, unit) = normalize_matches(pairs, &cameras[0], &cameras[1]);
    // A pixel that no ray reaches (beyond the range of the lens model) is no match.
    let usable: Vec<usize> = (0..normalized.len()).filter(|&i| normalized[i].is_finite()).collect();
    let normalized: Vec<_> = usable.iter().map(|&i| normalized[i]).collect();
    let threshold = options.robust.threshold * unit;
    let stage = Stage::new(progress, "pose", SEARCHES as usize)?;
    let search = |k: u64| {
        let seed = options.robust.seed.wrapping_add(k);
        let options = RobustOptions { threshold, seed, ..options.robust };
        let found = estimate_relative_pose(&normalized, &options, &stage)?;
        let (pose, loss) = refine_relative_pose(&found.model, &normalized, threshold);
        stage.add(1)?;
        Ok((RobustModel { model: pose, ..found }, loss))
    };
    let searches: Vec<_> = (0..SEARCHES).into_par_iter().map(search).collect();
    let mut found: Vec<(RobustModel<Pose>, f64)> =
        searches.into_iter().collect::<Result<_, _>>().map_err(|error| failed(error, pairs.len(), options))?;
    found.sort_by(|a, b| a.1.total_cmp(&b.1));
    let (best, others) = (&found[0].0, &found[1..]);
    enough(best.inliers.len(), pairs.len(), options)?;
    // As far as another search got, where the matches do not say that it got to a worse place.
    let apart = others
        .iter()
        .filter(|other| poses_are_rivals(&best.model, &other.0.model, &normalized, threshold))
        .map(|other| pose_difference(&best.model, &other.0.model)[1])
        .fold(0.0, f64::max);
    if apart > options.max_deviation {
        return Err(TwoViewError::UncertainPose {
            degrees: apart.to_degrees(),
            allowed: options.max_deviation.to_degrees(),
            inliers: best.inliers.len(),
            matches: pairs.len(),
        });
    }
    let inliers = best.inliers.iter().map(|&i| usable[i]).collect();
    Ok(TwoViewGeometry { cameras, pose: best.model, inliers, focal_range: 0.0, planar_share: 0.0 })
}

/// Searches from different seeds. Where the matches determine a pose, all find it; five miss a second one that is found as often as
/// the first in one case of sixteen.
const SEARCHES: u64 = 5;

/// Too few matches that agree is the reason a person understands.
fn failed(error: EstimateError, matches: usize, options: &TwoViewOptions) -> TwoViewError {
    match error {
        EstimateError::NoConsensus { inliers, needed, .. } => {
            TwoViewError::TooFewInliers { inliers, matches, needed: needed.max(options.min_inliers) }
        }
        EstimateError::NotEnoughMatches { got, .. } => TwoViewError::TooFewMatches { got, needed: options.min_inliers },
        EstimateError::Cancelled(stop) => stop.into(),
        other => TwoViewError::Estimate(other),
    }
}
