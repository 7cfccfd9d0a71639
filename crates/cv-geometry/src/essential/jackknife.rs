//! The block jackknife of a relative pose: how far it can be trusted.

use super::refine_relative_pose;
use crate::epipolar::sampson;
use crate::essential_from_pose;
use crate::ransac::{Scorer, TukeyBiweight};
use cv_core::{Cancelled, Correspondence, Pose, Progress, Stage};
use rayon::prelude::*;

/// Parts of the first image that are left out in turn.
const BLOCKS: usize = 8;

/// Angles between two rotations and between two directions of translation, in radians.
pub fn pose_difference(a: &Pose, b: &Pose) -> [f64; 2] {
    // The chord and the cross product, not arc cosines: those have no digits left at small angles.
    let chord = (a.rotation.matrix() - b.rotation.matrix()).norm() / 8f64.sqrt();
    let direction = a.translation.cross(&b.translation).norm().atan2(a.translation.dot(&b.translation));
    [2.0 * chord.min(1.0).asin(), direction]
}

/// Standard deviations, in radians, of the rotation and of the direction of the translation of a refined pose, by leaving out one
/// eighth of the first image at a time (the block jackknife: Künsch, "The jackknife and the bootstrap for general stationary
/// observations", 1989).
///
/// A covariance from residuals supposes errors that know nothing of each other. Those of a lens that bends rays a little otherwise than
/// its model says, of leaves in the wind, or of a repeated facade are alike all over a part of the image; where such a part moves
/// the pose, this tells. `matches` in normalized coordinates, those that agree with `pose`; `threshold` as in [`refine_relative_pose`].
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
    split(&mut order, matches, BLOCKS);
    let bounds: Vec<usize> = (0..=BLOCKS).map(|k| k * order.len() / BLOCKS).collect();
    let squares: Vec<[f64; 2]> = (0..BLOCKS)
        .into_par_iter()
        .map(|k| {
            let kept = order[..bounds[k]].iter().chain(&order[bounds[k + 1]..]);
            let rest: Vec<Correspondence> = kept.map(|&i| matches[i]).collect();
            let (other, _) = refine_relative_pose(pose, &rest, threshold);
            stage.add(1)?;
            Ok(pose_difference(&other, pose).map(|d| d * d))
        })
        .collect::<Result<_, Cancelled>>()?;
    let factor = (BLOCKS - 1) as f64 / BLOCKS as f64;
    Ok([0, 1].map(|i| (factor * squares.iter().map(|s| s[i]).sum::<f64>()).sqrt()))
}

/// Orders `order` so that `parts` (a power of two) equal stretches of it are compact in the first image: halves across the longer side.
fn split(order: &mut [usize], matches: &[Correspondence], parts: usize) {
    if parts < 2 || order.len() < 2 {
        return;
    }
    let along = |axis: usize| move |i: &usize| matches[*i].a[axis];
    let extent = |axis: usize| {
        let (low, high) = order.iter().map(along(axis)).fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
        high - low
    };
    let axis = usize::from(extent(1) > extent(0));
    // Ties by index, so that the order is the same everywhere.
    order.sort_unstable_by(|a, b| matches[*a].a[axis].total_cmp(&matches[*b].a[axis]).then(a.cmp(b)));
    let middle = order.len() / 2;
    let (left, right) = order.split_at_mut(middle);
    split(left, matches, parts / 2);
    split(right, matches, parts / 2);
}

/// Whether the matches (normalized) do not tell which of two poses is right: the difference of their losses is below twice its own
/// standard deviation (Vuong, "Likelihood ratio tests for model selection and non-nested hypotheses", 1989).
pub fn poses_are_rivals(a: &Pose, b: &Pose, matches: &[Correspondence], threshold: f64) -> bool {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::TwoViews;
    use cv_core::{Rotation3, Silent, Vector3};

    #[test]
    fn the_blocks_tell_of_a_part_that_disagrees() {
        let views = TwoViews::random(3);
        let mut matches = views.normalized_matches(400, 2e-4);
        let fine =
            jackknife_pose_deviation(&refine_relative_pose(&views.pose, &matches, 4e-3).0, &matches, 4e-3, &Silent)
                .unwrap();
        // A fifth of a pixel at 500 px on 400 points: hundredths of a degree for the rotation, tenths for the direction at most.
        assert!(fine[0] < 2e-3 && fine[1] < 1e-2, "{fine:?}");
        // The left of the image is displaced by one pixel, five times the noise: the lens is not what its model says.
        for m in matches.iter_mut().filter(|m| m.a.x < -0.3) {
            m.b.y += 2e-3;
        }
        let off =
            jackknife_pose_deviation(&refine_relative_pose(&views.pose, &matches, 4e-3).0, &matches, 4e-3, &Silent)
                .unwrap();
        assert!(off[1] > 2.0 * fine[1], "{off:?} {fine:?}");
    }

    #[test]
    fn only_a_worse_pose_is_no_rival() {
        let views = TwoViews::random(5);
        let matches = views.normalized_matches(100, 5e-4);
        let nearly =
            Pose::new(views.pose.rotation * Rotation3::new(Vector3::new(1e-6, 0.0, 0.0)), views.pose.translation);
        let other =
            Pose::new(views.pose.rotation * Rotation3::new(Vector3::new(0.1, 0.0, 0.0)), views.pose.translation);
        assert!(poses_are_rivals(&views.pose, &nearly, &matches, 3e-3));
        assert!(!poses_are_rivals(&views.pose, &other, &matches, 3e-3));
        assert!((pose_difference(&views.pose, &other)[0] - 0.1).abs() < 1e-9);
    }
}
