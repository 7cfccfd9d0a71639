//! Where the cameras of a rig are, from the poses that each has by itself.

use crate::CalibrateError;
use cv_core::{Pose, median};

/// The mounts of all cameras, which take the first camera's frame to theirs, from the poses of the views in each camera's frame (`poses[c][v]`).
///
/// Cameras are joined to those that are placed already by the views that both saw, most of them first. Of the relative poses of those views the one nearest to
/// all others is taken: some views may be wrong. `turns` are the motions of the target after which it looks the same, the first of them none: where there are others, a
/// view says as many relative poses, of which one is right.
pub(crate) fn mounts(poses: &[Vec<Option<Pose>>], turns: &[Pose]) -> Result<Vec<Pose>, CalibrateError> {
    let shared = |a: usize, b: usize| -> Vec<Vec<Pose>> {
        let pair = |(a, b): (&Option<Pose>, &Option<Pose>)| {
            let (a, b) = (a.as_ref()?, b.as_ref()?);
            Some(turns.iter().map(|turn| Pose::relative(a, &b.compose(&turn.inverse()))).collect())
        };
        poses[a].iter().zip(&poses[b]).filter_map(pair).collect()
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

/// For each view and camera the turn of the target by which its points are numbered otherwise than in the picture of the first camera that saw it: the one that brings its
/// pose nearest to where the mounts have it.
pub(crate) fn turns_of_views(poses: &[Vec<Option<Pose>>], mounts: &[Pose], turns: &[Pose]) -> Vec<Vec<usize>> {
    let views = poses.first().map_or(0, Vec::len);
    let of = |v: usize, c: usize| -> Option<usize> {
        let (first, seen) = poses.iter().enumerate().find_map(|(a, p)| Some((a, p[v]?)))?;
        let expected = mounts[c].compose(&mounts[first].inverse().compose(&seen));
        let own = poses[c][v].filter(|_| c != first)?;
        let off = |turn: &Pose| far(&expected, &own.compose(&turn.inverse()), expected.translation.norm());
        let nearest = turns.iter().enumerate().min_by(|a, b| off(a.1).total_cmp(&off(b.1)))?;
        Some(nearest.0)
    };
    (0..views).map(|v| (0..poses.len()).map(|c| of(v, c).unwrap_or(0)).collect()).collect()
}

/// How far apart two poses are: an angle in radians, and a length in `unit`s.
fn far(a: &Pose, b: &Pose, unit: f64) -> f64 {
    Pose::relative(a, b).rotation_angle() + (a.translation - b.translation).norm() / unit.max(f64::MIN_POSITIVE)
}

/// The pose with the least median distance to the views, of each of which the nearest pose counts; lengths as shares of the typical one.
fn medoid(views: &[Vec<Pose>]) -> Option<Pose> {
    let mut lengths: Vec<f64> = views.iter().flatten().map(|p| p.translation.norm()).collect();
    let unit = median(&mut lengths)?;
    let farness = |a: &Pose| {
        let nearest = |view: &Vec<Pose>| view.iter().map(|b| far(a, b, unit)).fold(f64::INFINITY, f64::min);
        let mut all: Vec<f64> = views.iter().map(nearest).collect();
        median(&mut all).unwrap_or(f64::INFINITY)
    };
    let farness: Vec<(f64, Pose)> = views.iter().flatten().map(|p| (farness(p), *p)).collect();
    farness.into_iter().min_by(|a, b| a.0.total_cmp(&b.0)).map(|nearest| nearest.1)
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
        let none = [Pose::identity()];
        let found = mounts(&seen, &none).unwrap();
        for (f, t) in found.iter().zip(&truth) {
            // Products of a few rotations and lengths of ten units.
            assert!((f.matrix() - t.matrix()).norm() < 1e-12, "{f:?}");
        }
        // Half a turn as the symmetry of the target: most views of the second camera may be turned, and each is known.
        for v in [0, 1, 3, 5, 6] {
            seen[1][v] = Some(truth[1].compose(&views[v]).compose(&turned));
        }
        let turns = [Pose::identity(), turned];
        let found = mounts(&seen, &turns).unwrap();
        for (f, t) in found.iter().zip(&truth) {
            assert!((f.matrix() - t.matrix()).norm() < 1e-12, "{f:?}");
        }
        let of_second: Vec<usize> = turns_of_views(&seen, &found, &turns).iter().map(|v| v[1]).collect();
        // Views 4 to 6 have no picture by the first camera: the second one begins to count.
        assert_eq!(of_second, [1, 1, 0, 1, 0, 0, 0]);
        seen[2].fill(None);
        assert_eq!(mounts(&seen, &none), Err(CalibrateError::Unconnected { camera: 2 }));
    }
}
