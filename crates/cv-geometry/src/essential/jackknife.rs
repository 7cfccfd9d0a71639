//! Uncertainty of a relative pose by the block jackknife, and a test whether two poses are distinguishable.

use super::refine_relative_pose;
use crate::epipolar::sampson;
use crate::essential_from_pose;
use crate::ransac::{Scorer, TukeyBiweight};
use cv_core::{Cancelled, Correspondence, Pose, Progress, Stage};
use cv_parallel::prelude::*;

/// Number of blocks of the first image that are left out in turn.
const BLOCKS: usize = 8;

/// Computes the angle between two rotations and the angle between two directions of translation, in radians.
pub fn pose_difference(a: &Pose, b: &Pose) -> [f64; 2] {
    // By the chord and the cross product: the arc cosine is inaccurate at small angles.
    let chord = (a.rotation.matrix() - b.rotation.matrix()).norm() / 8f64.sqrt();
    let direction = a.translation.cross(&b.translation).norm().atan2(a.translation.dot(&b.translation));
    [2.0 * chord.min(1.0).asin(), direction]
}

/// Estimates the standard deviations, in radians, of the rotation and of the direction of the translation of a refined
/// pose by the block jackknife with eight blocks of the first image (Künsch, "The jackknife and the bootstrap for
/// general stationary observations", 1989).
///
/// A covariance from residuals assumes independent errors. Lens model errors, moving vegetation and repetitive
/// structure have spatially correlated errors, which this includes. `matches` are the inliers of `pose` in normalized
/// coordinates; `threshold` as in [`refine_relative_pose`].
///
/// # Errors
/// [`Cancelled`].
pub fn jackknife_pose_deviation(
    pose: &Pose,
    matches: &[Correspondence],
    threshold: f64,
    progress: &dyn Progress,
) -> Result<[f64; 2], Cancelled> {
    let stage = Stage::new(progress, "stability", BLOCKS)?;
    let mut order: Vec<usize> = (0..matches.len()).collect();
    partition_spatially(&mut order, matches, BLOCKS);
    let bounds: Vec<usize> = (0..=BLOCKS).map(|k| k * order.len() / BLOCKS).collect();
    let squares: Vec<[f64; 2]> = (0..BLOCKS)
        .into_par_iter()
        .map(|k| {
            let remaining = order[..bounds[k]].iter().chain(&order[bounds[k + 1]..]);
            let subset: Vec<Correspondence> = remaining.map(|&i| matches[i]).collect();
            let (other, _) = refine_relative_pose(pose, &subset, threshold);
            stage.add(1)?;
            Ok(pose_difference(&other, pose).map(|d| d * d))
        })
        .try_collect::<_, Cancelled>()?;
    let factor = (BLOCKS - 1) as f64 / BLOCKS as f64;
    Ok([0, 1].map(|i| (factor * squares.iter().map(|s| s[i]).sum::<f64>()).sqrt()))
}

/// Reorders `order` so that `parts` (a power of two) consecutive ranges of equal length are spatially compact in the
/// first image: recursive bisection along the longer side.
fn partition_spatially(order: &mut [usize], matches: &[Correspondence], parts: usize) {
    if parts < 2 || order.len() < 2 {
        return;
    }
    let along = |axis: usize| move |i: &usize| matches[*i].a[axis];
    let extent = |axis: usize| {
        let (low, high) = order.iter().map(along(axis)).fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
        high - low
    };
    let axis = usize::from(extent(1) > extent(0));
    // Ties by index, for a deterministic order.
    order.sort_unstable_by(|a, b| matches[*a].a[axis].total_cmp(&matches[*b].a[axis]).then(a.cmp(b)));
    let middle = order.len() / 2;
    let (left, right) = order.split_at_mut(middle);
    partition_spatially(left, matches, parts / 2);
    partition_spatially(right, matches, parts / 2);
}

/// Tests whether the matches (normalized) cannot distinguish two poses: the difference of their losses is below two
/// standard deviations of it (Vuong, "Likelihood ratio tests for model selection and non-nested hypotheses", 1989).
pub fn poses_are_indistinguishable(a: &Pose, b: &Pose, matches: &[Correspondence], threshold: f64) -> bool {
    let (ea, eb) = (essential_from_pose(a), essential_from_pose(b));
    let loss = |e, m| {
        let r = sampson(e, m) / threshold;
        f64::from(TukeyBiweight.loss((r * r) as f32))
    };
    let (sum, squares) = matches.iter().fold((0.0, 0.0), |(s, q), m| {
        let d = loss(&ea, m) - loss(&eb, m);
        (s + d, q + d * d)
    });
    sum * sum < 4.0 * squares
}
