//! Initial rig poses, from the target poses that each camera estimates alone.

use crate::CalibrateError;
use cv_core::{Pose, median};

/// Estimates the rig poses, first camera's frame to each camera's, from the target poses in each camera's frame
/// (`poses[c][v]`).
///
/// Cameras are connected in the order of the number of views that they share with a connected one. Of the relative
/// poses of the shared views the medoid is taken, which is robust to wrong views. `symmetries` are the rigid motions
/// that map the target to itself, the identity first: with several, each view has as many candidate relative poses.
pub(crate) fn estimate_rig_poses(
    poses: &[Vec<Option<Pose>>],
    symmetries: &[Pose],
) -> Result<Vec<Pose>, CalibrateError> {
    let relative_poses = |a: usize, b: usize| -> Vec<Vec<Pose>> {
        let pair = |(a, b): (&Option<Pose>, &Option<Pose>)| {
            let (a, b) = (a.as_ref()?, b.as_ref()?);
            Some(symmetries.iter().map(|symmetry| Pose::relative(a, &b.compose(&symmetry.inverse()))).collect())
        };
        poses[a].iter().zip(&poses[b]).filter_map(pair).collect()
    };
    let mut rig_poses: Vec<Option<Pose>> = vec![None; poses.len()];
    rig_poses[0] = Some(Pose::identity());
    while let Some(missing) = rig_poses.iter().position(Option::is_none) {
        let mut best: Option<(usize, usize, usize)> = None;
        for (a, _) in rig_poses.iter().enumerate().filter(|(_, p)| p.is_some()) {
            for (b, _) in rig_poses.iter().enumerate().filter(|(_, p)| p.is_none()) {
                let count = relative_poses(a, b).len();
                if count > best.map_or(0, |b| b.2) {
                    best = Some((a, b, count));
                }
            }
        }
        let unconnected = CalibrateError::Unconnected { camera: missing };
        let (from, to, _) = best.ok_or(unconnected)?;
        let relative = medoid(&relative_poses(from, to)).ok_or(unconnected)?;
        rig_poses[to] = rig_poses[from].map(|p| relative.compose(&p));
    }
    Ok(rig_poses.into_iter().flatten().collect())
}

/// Returns for each view and camera the index of the symmetry by which its points are numbered otherwise than in the
/// first camera that observes the target: the one whose pose is nearest to the one that the rig poses predict.
pub(crate) fn symmetries_of_views(
    poses: &[Vec<Option<Pose>>],
    rig_poses: &[Pose],
    symmetries: &[Pose],
) -> Vec<Vec<usize>> {
    let views = poses.first().map_or(0, Vec::len);
    let nearest_symmetry = |v: usize, c: usize| -> Option<usize> {
        let (first, pose) = poses.iter().enumerate().find_map(|(a, p)| Some((a, p[v]?)))?;
        let expected = rig_poses[c].compose(&rig_poses[first].inverse().compose(&pose));
        let measured = poses[c][v].filter(|_| c != first)?;
        let distance = |symmetry: &Pose| {
            pose_distance(&expected, &measured.compose(&symmetry.inverse()), expected.translation.norm())
        };
        let nearest = symmetries.iter().enumerate().min_by(|a, b| distance(a.1).total_cmp(&distance(b.1)))?;
        Some(nearest.0)
    };
    (0..views).map(|v| (0..poses.len()).map(|c| nearest_symmetry(v, c).unwrap_or(0)).collect()).collect()
}

/// Returns the distance of two poses: the angle of their rotation in radians, plus that of their translations in
/// `unit`s.
fn pose_distance(a: &Pose, b: &Pose, unit: f64) -> f64 {
    Pose::relative(a, b).rotation_angle() + (a.translation - b.translation).norm() / unit.max(f64::MIN_POSITIVE)
}

/// Returns the medoid: the pose with the smallest median distance to the views, each by its nearest candidate.
/// Translations are relative to their median length.
fn medoid(views: &[Vec<Pose>]) -> Option<Pose> {
    let mut lengths: Vec<f64> = views.iter().flatten().map(|p| p.translation.norm()).collect();
    let unit = median(&mut lengths)?;
    let median_distance = |a: &Pose| {
        let nearest = |view: &Vec<Pose>| view.iter().map(|b| pose_distance(a, b, unit)).fold(f64::INFINITY, f64::min);
        let mut all: Vec<f64> = views.iter().map(nearest).collect();
        median(&mut all).unwrap_or(f64::INFINITY)
    };
    let median_distance: Vec<(f64, Pose)> = views.iter().flatten().map(|p| (median_distance(p), *p)).collect();
    median_distance.into_iter().min_by(|a, b| a.0.total_cmp(&b.0)).map(|nearest| nearest.1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Rotation3, Vector3};

    fn pose(turn: [f64; 3], shift: [f64; 3]) -> Pose {
        Pose::new(Rotation3::new(Vector3::from(turn)), Vector3::from(shift))
    }

    #[test]
    fn cameras_are_connected_through_others_in_spite_of_rotated_views() {
        let truth =
            [Pose::identity(), pose([0.0, 0.2, 0.0], [-3.0, 0.0, 0.1]), pose([0.0, 0.4, 0.0], [-6.0, 0.1, 0.3])];
        let views: Vec<Pose> =
            (0..7).map(|v| pose([0.1 * f64::from(v), 0.2, 0.0], [0.0, 0.3 * f64::from(v), 9.0])).collect();
        let mut poses: Vec<Vec<Option<Pose>>> =
            truth.iter().map(|m| views.iter().map(|v| Some(m.compose(v))).collect()).collect();
        // The first and the last camera share no view; one view of the second is rotated by 180°.
        poses[2][..4].fill(None);
        poses[0][4..].fill(None);
        let half_turn = pose([0.0, 0.0, std::f64::consts::PI], [8.0, 5.0, 0.0]);
        poses[1][1] = poses[1][1].map(|p| p.compose(&half_turn));
        let identity_only = [Pose::identity()];
        let rig_poses = estimate_rig_poses(&poses, &identity_only).unwrap();
        for (f, t) in rig_poses.iter().zip(&truth) {
            // Rounding of products of a few rotations with lengths of ten units.
            assert!((f.matrix() - t.matrix()).norm() < 1e-12, "{f:?}");
        }
        // With 180° as symmetry of the target, most views of the second camera may be rotated, and each is identified.
        for v in [0, 1, 3, 5, 6] {
            poses[1][v] = Some(truth[1].compose(&views[v]).compose(&half_turn));
        }
        let symmetries = [Pose::identity(), half_turn];
        let rig_poses = estimate_rig_poses(&poses, &symmetries).unwrap();
        for (f, t) in rig_poses.iter().zip(&truth) {
            assert!((f.matrix() - t.matrix()).norm() < 1e-12, "{f:?}");
        }
        let of_second: Vec<usize> = symmetries_of_views(&poses, &rig_poses, &symmetries).iter().map(|v| v[1]).collect();
        // Views 4 to 6 have no image by the first camera: the second one is the reference.
        assert_eq!(of_second, [1, 1, 0, 1, 0, 0, 0]);
        poses[2].fill(None);
        assert_eq!(estimate_rig_poses(&poses, &identity_only), Err(CalibrateError::Unconnected { camera: 2 }));
    }
}
