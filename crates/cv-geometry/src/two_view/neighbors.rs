//! Depth consistency of guided matches with their neighbors.

use crate::{normalize_matches, triangulate};
use cv_core::{Camera, Cancelled, Correspondence, Point3, Pose, Progress, Stage};
use cv_parallel::prelude::*;

/// Number of nearest neighbors in the first image.
const NEIGHBORS: usize = 8;
/// Tolerance beyond the range of the neighbors' inverse depths, relative to that range.
const RELATIVE_TOLERANCE: f64 = 0.5;
/// Additional tolerance as a parallax in radians: three pixels of a small image, a dozen of a large one.
const PARALLAX_TOLERANCE: f64 = 0.005;

/// Returns the indices of the guided matches whose inverse depth is consistent with that of the neighboring points, or
/// that are among `matches`. `points` are the triangulated `matches`.
///
/// A feature without a true correspondence may be matched along its epipolar line, at any depth; matches that were
/// found without a geometry rarely are. On synthetic rooms this removes two in five outliers and one in a thousand
/// inliers. Thin foreground objects without a known point are lost. O(`guided` × `matches`).
pub(super) fn depth_consistent_matches(
    guided: &[Correspondence],
    matches: &[Correspondence],
    points: &[Point3<f64>],
    cameras: &[Camera; 2],
    pose: &Pose,
    progress: &dyn Progress,
) -> Result<Vec<usize>, Cancelled> {
    let stage = Stage::new(progress, "neighbors", guided.len())?;
    let (normalized, _) = normalize_matches(guided, &cameras[0], &cameras[1]);
    let is_consistent = |(m, n): (&Correspondence, &Correspondence)| {
        // Squared distance and inverse depth of the nearest known points in the first image, by increasing distance.
        let mut nearest = [(f64::INFINITY, 0.0); NEIGHBORS];
        for (known, point) in matches.iter().zip(points) {
            let distance = (known.a - m.a).norm_squared();
            if distance == 0.0 && known.b == m.b {
                return true;
            }
            if distance < nearest[NEIGHBORS - 1].0 {
                let at = nearest.partition_point(|other| other.0 <= distance);
                nearest.copy_within(at..NEIGHBORS - 1, at + 1);
                nearest[at] = (distance, 1.0 / point.z);
            }
        }
        let Ok(point) = triangulate(n, pose) else { return false };
        let neighbors = nearest.iter().filter(|other| other.0.is_finite());
        let (low, high) =
            neighbors.fold((f64::MAX, f64::MIN), |(low, high), other| (low.min(other.1), high.max(other.1)));
        let tolerance = RELATIVE_TOLERANCE * (high - low) + PARALLAX_TOLERANCE;
        (low - tolerance..=high + tolerance).contains(&(1.0 / point.z))
    };
    let test = |pair: (&Correspondence, &Correspondence)| {
        stage.add(1)?;
        Ok(is_consistent(pair))
    };
    let consistent: Vec<bool> = guided.par_iter().zip(&normalized).map(test).try_collect::<_, Cancelled>()?;
    Ok((0..guided.len()).filter(|&i| consistent[i]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Point2, Rotation3, Silent, Vector3};

    #[test]
    fn a_point_with_a_depth_unlike_its_neighbors_is_rejected() {
        let camera = Camera::from_focal(640, 480, 500.0);
        let pose = Pose::new(Rotation3::identity(), Vector3::new(-1.0, 0.0, 0.0));
        // A plane at depth 10: a disparity of 50 px.
        let observe = |x: f64, y: f64, z: f64| {
            let a = Point2::new(x, y);
            let n = camera.normalize(a);
            let p = Point3::new(n.x * z, n.y * z, z);
            (Correspondence { a, b: camera.project(&pose.transform(&p)).unwrap() }, p)
        };
        let grid = (0..100).map(|i| observe(100.0 + 40.0 * f64::from(i % 10), 40.0 + 40.0 * f64::from(i / 10), 10.0));
        let (matches, points): (Vec<_>, Vec<_>) = grid.unzip();
        let guided =
            [observe(333.0, 222.0, 10.2).0, observe(200.0, 210.0, 4.0).0, observe(150.0, 111.0, 200.0).0, matches[7]];
        let consistent = depth_consistent_matches(&guided, &matches, &points, &[camera; 2], &pose, &Silent).unwrap();
        // A disparity error of one pixel is consistent; 75 and 47 px are not.
        assert_eq!(consistent, [0, 3]);
        assert_eq!(depth_consistent_matches(&guided, &[], &[], &[camera; 2], &pose, &Silent), Ok(vec![]));
    }
}
