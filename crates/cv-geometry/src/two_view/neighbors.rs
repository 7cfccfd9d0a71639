//! Which of the matches found along epipolar lines lie where their neighbors do.

use crate::{normalize_matches, triangulate};
use cv_core::{Camera, Cancelled, Correspondence, Point3, Pose, Progress, Stage};
use rayon::prelude::*;

/// Neighbors that are asked.
const NEIGHBORS: usize = 8;
/// How far beyond the inverse depths of its neighbors a point may lie, as a share of their range.
const MORE: f64 = 0.5;
/// And in radians of parallax: three pixels of a small photograph, a dozen of a large one.
const PARALLAX: f64 = 0.005;

/// Indices of the matches whose depth is that of the points around them, or that belong to one of those. `points` are known from `matches`, one each.
///
/// A feature without a true partner finds one along its epipolar line now and then, at any depth; of matches that were found without a geometry,
/// hardly any are such. On generated rooms this leaves out two in five of the wrong matches and one in a thousand of the right ones. A thin thing before a far ground that no known point is on is lost. O(more · matches).
pub(super) fn like_their_neighbors(
    more: &[Correspondence],
    matches: &[Correspondence],
    points: &[Point3<f64>],
    cameras: &[Camera; 2],
    pose: &Pose,
    progress: &dyn Progress,
) -> Result<Vec<usize>, Cancelled> {
    let stage = Stage::new(progress, "neighbors", more.len())?;
    let (normalized, _) = normalize_matches(more, &cameras[0], &cameras[1]);
    let belongs = |(m, n): (&Correspondence, &Correspondence)| {
        // The nearest of the known ones in the first photograph, the nearest first.
        let mut near = [(f64::INFINITY, 0.0); NEIGHBORS];
        for (known, point) in matches.iter().zip(points) {
            let distance = (known.a - m.a).norm_squared();
            if distance == 0.0 && known.b == m.b {
                return true;
            }
            if distance < near[NEIGHBORS - 1].0 {
                let at = near.partition_point(|other| other.0 <= distance);
                near.copy_within(at..NEIGHBORS - 1, at + 1);
                near[at] = (distance, 1.0 / point.z);
            }
        }
        let Ok(point) = triangulate(n, pose) else { return false };
        let found = near.iter().filter(|other| other.0.is_finite());
        let (low, high) = found.fold((f64::MAX, f64::MIN), |(low, high), other| (low.min(other.1), high.max(other.1)));
        let reach = MORE * (high - low) + PARALLAX;
        (low - reach..=high + reach).contains(&(1.0 / point.z))
    };
    let asked = |pair: (&Correspondence, &Correspondence)| {
        stage.add(1)?;
        Ok(belongs(pair))
    };
    let keep: Vec<bool> = more.par_iter().zip(&normalized).map(asked).collect::<Result<_, Cancelled>>()?;
    Ok((0..more.len()).filter(|&i| keep[i]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Point2, Rotation3, Silent, Vector3};

    #[test]
    fn a_point_at_another_depth_than_all_around_it_is_left_out() {
        let camera = Camera::from_focal(640, 480, 500.0);
        let pose = Pose::new(Rotation3::identity(), Vector3::new(-1.0, 0.0, 0.0));
        // A wall at ten units: a parallax of 50 px.
        let see = |x: f64, y: f64, z: f64| {
            let a = Point2::new(x, y);
            let n = camera.normalize(a);
            let p = Point3::new(n.x * z, n.y * z, z);
            (Correspondence { a, b: camera.project(&pose.transform(&p)).unwrap() }, p)
        };
        let grid = (0..100).map(|i| see(100.0 + 40.0 * f64::from(i % 10), 40.0 + 40.0 * f64::from(i / 10), 10.0));
        let (matches, points): (Vec<_>, Vec<_>) = grid.unzip();
        let more = [see(333.0, 222.0, 10.2).0, see(200.0, 210.0, 4.0).0, see(150.0, 111.0, 200.0).0, matches[7]];
        let kept = like_their_neighbors(&more, &matches, &points, &[camera; 2], &pose, &Silent).unwrap();
        // One pixel of parallax off is as good as there; 75 and 47 px off are not.
        assert_eq!(kept, [0, 3]);
        assert_eq!(like_their_neighbors(&more, &[], &[], &[camera; 2], &pose, &Silent), Ok(vec![]));
    }
}
