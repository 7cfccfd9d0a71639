//! Where the cameras of a rig are, from the poses that each has by itself.

use crate::CalibrateError;
use cv_core::{Pose, median};

/// The mounts of all cameras, which take the first camera's frame to theirs, from the poses of the views in each camera's frame (`poses[c][v]`).
///
/// Cameras are joined to those that are placed already by the views that both saw, most of them first. Of the relative poses of those views the one nearest to
/// all others is taken: some views may be wrong, as by a target that looks the same turned by half a turn.
pub(crate) fn mounts(poses: &[Vec<Option<Pose>>]) -> Result<Vec<Pose>, CalibrateError> {
    let shared = |a: usize, b: usize| -> Vec<Pose> {
        poses[a].iter().zip(&poses[b]).filter_map(|(a, b)| Some(Pose::relative(a.as_ref()?, b.as_ref()?))).collect()
    };
    let mut placed: Vec<Option<Pose>> = vec![None; poses.len()];
    placed[0] = Some(Pose::identity());
    while let Some(missing) = placed.iter().position(Option::is_none) {
        let mut best: Option<(usize, usize, usize)> = None;
        for (a, _) in placed.iter().enumerate().filter(|(_, p)| p.is_some()) {
            for (b, _) in placed.iter().enumerate().filter(|(_, p)| p.is_none()) {
                let count = shared(a, b).len();
                if count > best.map_or(0, |b| b.2) {
                    best = Some((a, b, count));
                }
            }
        }
        let unconnected = CalibrateError::Unconnected { camera: missing };
        let (from, to, _) = best.ok_or(unconnected)?;
        let relative = medoid(&shared(from, to)).ok_or(unconnected)?;
        placed[to] = placed[from].map(|p| relative.compose(&p));
    }
    Ok(placed.into_iter().flatten().collect())
}

/// The pose with the least median distance to the others: an angle in radians, and a length as a share of the typical one.
fn medoid(poses: &[Pose]) -> Option<Pose> {
    let mut lengths: Vec<f64> = poses.iter().map(|p| p.translation.norm()).collect();
    let unit = median(&mut lengths)?.max(f64::MIN_POSITIVE);
    let far = |a: &Pose| {
        let of = |b: &Pose| Pose::relative(a, b).rotation_angle() + (a.translation - b.translation).norm() / unit;
        let mut all: Vec<f64> = poses.iter().map(of).collect();
        median(&mut all).unwrap_or(f64::INFINITY)
    };
    let farness: Vec<f64> = poses.iter().map(far).collect();
    let nearest = farness.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1))?.0;
    Some(poses[nearest])
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Rotation3, Vector3};

    fn pose(turn: [f64; 3], shift: [f64; 3]) -> Pose {
        Pose::new(Rotation3::new(Vector3::from(turn)), Vector3::from(shift))
    }

    #[test]
    fn cameras_are_placed_through_others_though_some_views_are_turned_round() {
        let truth =
            [Pose::identity(), pose([0.0, 0.2, 0.0], [-3.0, 0.0, 0.1]), pose([0.0, 0.4, 0.0], [-6.0, 0.1, 0.3])];
        let views: Vec<Pose> =
            (0..7).map(|v| pose([0.1 * f64::from(v), 0.2, 0.0], [0.0, 0.3 * f64::from(v), 9.0])).collect();
        let mut seen: Vec<Vec<Option<Pose>>> =
            truth.iter().map(|m| views.iter().map(|v| Some(m.compose(v))).collect()).collect();
        // The first and the last camera share no view; one view of the second is turned by half a turn.
        seen[2][..4].fill(None);
        seen[0][4..].fill(None);
        let turned = pose([0.0, 0.0, std::f64::consts::PI], [8.0, 5.0, 0.0]);
        seen[1][1] = seen[1][1].map(|p| p.compose(&turned));
        let found = mounts(&seen).unwrap();
        for (f, t) in found.iter().zip(&truth) {
            // Products of a few rotations and lengths of ten units.
            assert!((f.matrix() - t.matrix()).norm() < 1e-12, "{f:?}");
        }
        seen[2].fill(None);
        assert_eq!(mounts(&seen), Err(CalibrateError::Unconnected { camera: 2 }));
    }
}
