//! Camera centers for known rotations: from the directions and lengths of baselines, then together with the points from
//! rays (global positioning).

use crate::scene::Scene;
use crate::tree_paths::TreePaths;
use crate::view_graph::ViewGraph;
use cv_core::{Cancelled, Point3, Pose, Rotation3, Stage, Vector3};
use cv_geometry::{PairEdge, PairGraph};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustError, AdjustIteration, AdjustOptions, Adjustment, Euclidean, Residual};
use nalgebra::{Matrix3, SMatrix};
use std::ops::ControlFlow;

/// Scale of the Huber loss of a baseline, in baseline lengths.
const BASELINE_LOSS_SCALE: f64 = 0.1;
/// Scale of the Cauchy loss of a ray, in radians: a fifth of a degree.
const RAY_LOSS_SCALE: f64 = 0.0035;

/// A link is left out if the path between its views through links with at least this many times its matches contradicts
/// it: accidental matches on repeated texture, some tens between views far apart, pull whole parts of a street to the
/// wrong place.
const MIN_PATH_STRENGTH: f64 = 4.0;
/// Largest difference of a link's baseline from that of the path, in lengths of the path: more than such paths drift.
const MAX_PATH_ERROR: f64 = 0.2;

/// Residuals of relative centers: the baseline from one center to the other in the world frame, and its inverse length
/// as weight.
struct BaselineResidual(Vec<(Vector3<f64>, f64)>);

impl Residual<3, 2, 6> for BaselineResidual {
    const DIMS: [usize; 2] = [3, 3];

    fn evaluate(
        &self,
        item: usize,
        [a, b]: [&[f64]; 2],
        jacobian: Option<&mut SMatrix<f64, 3, 6>>,
    ) -> Option<Vector3<f64>> {
        let (baseline, inverse) = self.0[item];
        if let Some(j) = jacobian {
            for k in 0..3 {
                (j[(k, k)], j[(k, 3 + k)]) = (-inverse, inverse);
            }
        }
        Some((Vector3::from_column_slice(b) - Vector3::from_column_slice(a) - baseline) * inverse)
    }
}

/// Residuals of unit rays in the world frame: the chord to the direction from the center to the point.
struct RayResidual(Vec<Vector3<f64>>);

impl Residual<3, 2, 6> for RayResidual {
    const DIMS: [usize; 2] = [3, 3];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [center, point]: [&[f64]; 2],
        jacobian: Option<&mut SMatrix<f64, 3, 6>>,
    ) -> Option<Vector3<f64>> {
        let to = Vector3::from_column_slice(point) - Vector3::from_column_slice(center);
        let distance = to.norm();
        if distance <= 0.0 || distance.is_nan() {
            return None;
        }
        let direction = to / distance;
        if let Some(j) = jacobian {
            let across = (Matrix3::identity() - direction * direction.transpose()) / distance;
            j.fixed_view_mut::<3, 3>(0, 0).copy_from(&-across);
            j.fixed_view_mut::<3, 3>(0, 3).copy_from(&across);
        }
        Some(direction - self.0[item])
    }
}

/// Returns a solver callback that stops when the job is cancelled.
fn stop_if_cancelled<'s>(stage: &'s Stage<'_>) -> impl FnMut(&AdjustIteration) -> ControlFlow<()> + 's {
    |_| match stage.check() {
        Ok(()) => ControlFlow::Continue(()),
        Err(Cancelled) => ControlFlow::Break(()),
    }
}

/// Estimates the centers of the largest component of links with known baseline length; `None` for the other views.
/// Minimizes the Huber loss of the distances from the centers that the pairs predict, in baselines.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn centers_from_baselines(
    graph: &ViewGraph,
    rotations: &[Option<Rotation3<f64>>],
    lengths: &[Option<f64>],
    stage: &Stage<'_>,
) -> Result<Vec<Option<Point3<f64>>>, Cancelled> {
    let mut centers: Vec<Option<Point3<f64>>> = vec![None; graph.views];
    let (mut edges, mut baselines) = (Vec::new(), Vec::new());
    for (link, length) in graph.links.iter().zip(lengths) {
        if let (Some(length), Some(_), Some(to)) = (length, rotations[link.a], rotations[link.b]) {
            // c_b − c_a = −R_bᵀ t.
            baselines.push((-(to.inverse() * link.pose.translation) * *length, 1.0 / length));
            edges.push(PairEdge { a: link.a, b: link.b, weight: link.matches as f64 });
        }
    }
    let Ok(edges) = PairGraph::new(graph.views, edges) else { return Ok(centers) };
    let tree = edges.maximum_spanning_forest();
    let Some(root) = edges.center(&tree) else { return Ok(centers) };
    centers[root] = Some(Point3::origin());
    // By view: length and strength of the edge to its parent.
    let mut to_parent = vec![(0.0, f64::INFINITY); graph.views];
    let mut paths = TreePaths::new(graph.views);
    for step in edges.breadth_first(&tree, root) {
        let (edge, baseline) = (&edges.edges()[step.edge], baselines[step.edge].0);
        let forward = if edge.a == step.parent { baseline } else { -baseline };
        centers[step.node] = centers[step.parent].map(|parent| parent + forward);
        to_parent[step.node] = (baseline.norm(), edge.weight);
        paths.add(&step);
    }
    let is_plausible = |e: &PairEdge, baseline: &Vector3<f64>| {
        let (Some(a), Some(b), Some(path)) = (centers[e.a], centers[e.b], paths.between(e.a, e.b)) else {
            return false;
        };
        let (length, weakest) = path.fold((0.0, f64::INFINITY), |(length, weakest): (f64, f64), node| {
            (length + to_parent[node].0, weakest.min(to_parent[node].1))
        });
        MIN_PATH_STRENGTH * e.weight > weakest || (b - a - baseline).norm() <= MAX_PATH_ERROR * length
    };
    let views: Vec<usize> = (0..graph.views).filter(|v| centers[*v].is_some()).collect();
    let mut block_of = vec![0u32; graph.views];
    views.iter().zip(0..).for_each(|(v, n)| block_of[*v] = n);
    let usable = edges.edges().iter().zip(&baselines).filter(|(e, (baseline, _))| is_plausible(e, baseline));
    let (blocks, items): (Vec<[u32; 2]>, Vec<_>) = usable.map(|(e, b)| ([block_of[e.a], block_of[e.b]], *b)).unzip();
    let start: Vec<f64> = views.iter().filter_map(|v| centers[*v]).flat_map(|c| [c.x, c.y, c.z]).collect();
    let solved = (|| {
        let mut problem = Adjustment::default();
        let group = problem.add_group("centers", Euclidean(3), start)?;
        problem.fix(group, block_of[root] as usize)?;
        let loss = RobustLoss::Huber { scale: BASELINE_LOSS_SCALE };
        problem.add_residuals("baselines", BaselineResidual(items), [group, group], blocks, loss)?;
        let settings = AdjustOptions { max_iterations: 30, cost_tolerance: 1e-4, ..AdjustOptions::default() };
        problem.solve(&settings, stop_if_cancelled(stage))?;
        Ok::<_, AdjustError>(problem.values(group).to_vec())
    })();
    stage.check()?;
    for (v, x) in views.iter().zip(solved.iter().flat_map(|x| x.chunks_exact(3))) {
        centers[*v] = Some(Point3::new(x[0], x[1], x[2]));
    }
    Ok(centers)
}

/// Adjusts the centers and points of a scene to the inlier rays, with constant rotations (global positioning). The
/// residual is of directions and independent of depth, which makes it robust to a bad initialization (Zhuang, Cheong &
/// Lee, "Baseline desensitizing in translation averaging", CVPR 2018; for cameras and points Pan, Baráth, Pollefeys &
/// Schönberger, "Global structure-from-motion revisited", ECCV 2024).
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn adjust_rays(scene: &mut Scene<'_>, stage: &Stage<'_>) -> Result<(), Cancelled> {
    let tracks: Vec<usize> = (0..scene.points.len()).filter(|t| scene.points[*t].is_some()).collect();
    let views = scene.registered();
    let mut block_of = vec![0u32; scene.views.len()];
    views.iter().zip(0..).for_each(|(v, n)| block_of[*v] = n);
    let (mut blocks, mut rays, mut points) = (Vec::new(), Vec::new(), Vec::new());
    for (&track, n) in tracks.iter().zip(0..) {
        points.extend(scene.points[track].iter().flat_map(|p| [p.x, p.y, p.z]));
        for (i, pose) in scene.posed_observations(track).filter(|(i, _)| scene.active[*i]) {
            blocks.push([block_of[scene.view_of(i)], n]);
            rays.push((pose.rotation.inverse() * scene.ray(i).to_homogeneous()).normalize());
        }
    }
    let start: Vec<Point3<f64>> = views.iter().filter_map(|v| scene.poses[*v]).map(|p| p.center()).collect();
    let Some(first) = start.first().copied() else { return Ok(()) };
    let farthest = (0..start.len()).max_by(|a, b| {
        let distance = |n: &usize| (start[*n] - first).norm_squared();
        distance(a).total_cmp(&distance(b))
    });
    let solved = (|| {
        let mut problem = Adjustment::default();
        let centers =
            problem.add_group("centers", Euclidean(3), start.iter().flat_map(|c| [c.x, c.y, c.z]).collect())?;
        let group = problem.add_group("points", Euclidean(3), points)?;
        problem.eliminate(group)?;
        problem.fix(centers, 0)?;
        if let Some(n) = farthest.filter(|n| *n > 0) {
            problem.fix_parameters(centers, n, &[(start[n] - first).iamax()])?;
        }
        problem.add_residuals(
            "rays",
            RayResidual(rays),
            [centers, group],
            blocks,
            RobustLoss::Cauchy { scale: RAY_LOSS_SCALE },
        )?;
        let settings = AdjustOptions { max_iterations: 30, cost_tolerance: 1e-3, ..AdjustOptions::default() };
        problem.solve(&settings, stop_if_cancelled(stage))?;
        Ok::<_, AdjustError>((problem.values(centers).to_vec(), problem.values(group).to_vec()))
    })();
    stage.check()?;
    let Ok((centers, points)) = solved else { return Ok(()) };
    for (v, x) in views.iter().zip(centers.chunks_exact(3)) {
        if let Some(pose) = &mut scene.poses[*v] {
            *pose = Pose::new(pose.rotation, -(pose.rotation * Vector3::from_column_slice(x)));
        }
    }
    for (t, x) in tracks.iter().zip(points.chunks_exact(3)) {
        scene.points[*t] = Some(Point3::new(x[0], x[1], x[2]));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view_graph::Link;
    use cv_core::Silent;

    #[test]
    fn centers_are_estimated_from_baselines_with_outliers() {
        let center = |v: usize| Point3::new(v as f64, (v as f64 * 0.7).sin(), 0.2 * (v % 3) as f64);
        let rotation = |v: usize| Rotation3::from_euler_angles(0.1 * v as f64, 0.2, -0.05 * v as f64);
        let pairs = (0..10).flat_map(|a| (a + 1..10).map(move |b| (a, b)));
        let link = |(pair, (a, b)): (usize, (usize, usize))| {
            let mut baseline: Vector3<f64> = center(b) - center(a);
            // One pair in six is an outlier.
            if pair % 6 == 4 {
                baseline = Vector3::new(baseline.y, 2.0, -baseline.x);
            }
            let pose = Pose::new(rotation(b) * rotation(a).inverse(), -(rotation(b) * baseline.normalize()));
            Link { pair, a, b, pose, matches: 100 - b + a }
        };
        let graph = ViewGraph { views: 11, links: pairs.enumerate().map(link).collect() };
        let rotations: Vec<_> = (0..11).map(|v| Some(rotation(v))).collect();
        let lengths: Vec<Option<f64>> =
            graph.links.iter().map(|l| (l.pair % 7 != 5).then(|| (center(l.b) - center(l.a)).norm())).collect();
        let stage = Stage::new(&Silent, "test", 1).unwrap();
        let centers = centers_from_baselines(&graph, &rotations, &lengths, &stage).unwrap();
        // The tenth view has no link.
        assert!(centers[10].is_none());
        for v in 1..10 {
            // Each view has one or two outliers, each with the influence of a tenth of a baseline at most (Huber),
            // against eight inliers; the same holds for the first view, the reference. Twice a few hundredths for
            // baselines of some units.
            let off = (centers[v].unwrap() - centers[0].unwrap()) - (center(v) - center(0));
            assert!(off.norm() < 0.2, "{v}: {off}");
        }
    }

    #[test]
    fn accidental_links_of_views_far_apart_do_not_fold_a_long_walk() {
        let center = |v: usize| Point3::new(v as f64, 0.2 * (v as f64 * 0.3).sin(), 0.0);
        // Each view has pairs with the next three.
        let near =
            (0..60).flat_map(|a| (a + 1..60.min(a + 4)).map(move |b| (a, b, 2000 / (b - a), center(b) - center(a))));
        // And those of half the walk seem to be near views 30 later, by a few matches on a facade that looks alike.
        let accidental = (0..30).flat_map(|a| (0..3).map(move |k| (a, a + 30 + k, 25)));
        let accidental = accidental.filter(|l| l.1 < 60).map(|(a, b, n)| (a, b, n, Vector3::new(1.0, 0.0, 0.1)));
        let links: Vec<(usize, usize, usize, Vector3<f64>)> = near.chain(accidental).collect();
        let link = |(pair, l): (usize, &(usize, usize, usize, Vector3<f64>))| {
            let pose = Pose::new(Rotation3::identity(), -l.3.normalize());
            Link { pair, a: l.0, b: l.1, pose, matches: l.2 }
        };
        let graph = ViewGraph { views: 60, links: links.iter().enumerate().map(link).collect() };
        let lengths: Vec<Option<f64>> = links.iter().map(|l| Some(l.3.norm())).collect();
        let stage = Stage::new(&Silent, "test", 1).unwrap();
        let centers = centers_from_baselines(&graph, &[Some(Rotation3::identity()); 60], &lengths, &stage).unwrap();
        for v in 0..60 {
            // All other baselines are exact.
            let error = (centers[v].unwrap() - centers[0].unwrap()) - (center(v) - center(0));
            assert!(error.norm() < 1e-6, "{v}: {error}");
        }
    }

    #[test]
    fn rays_restore_perturbed_centers_and_points() {
        let camera = cv_core::Camera::from_focal(1000, 800, 900.0);
        let pose = |v: usize| {
            let rotation = Rotation3::from_euler_angles(0.02 * v as f64, -0.05 * v as f64, 0.0);
            Pose::new(rotation, -(rotation * Vector3::new(0.5 * v as f64, 0.1 * (v * v) as f64, 0.0)))
        };
        let points: Vec<Point3<f64>> = (0..80)
            .map(|k| Point3::new((k % 10) as f64 * 0.4 - 1.5, (k / 10) as f64 * 0.3 - 1.0, 6.0 + (k % 7) as f64))
            .collect();
        let pixel = |v: usize, p: &Point3<f64>| camera.project(&pose(v).transform(p)).unwrap();
        let keypoints: Vec<Vec<cv_core::Keypoint>> = (0..5)
            .map(|v| {
                points
                    .iter()
                    .map(|p| pixel(v, p))
                    .map(|q| cv_core::Keypoint::new(q.x as f32, q.y as f32, 1.0))
                    .collect()
            })
            .collect();
        let views: Vec<crate::SfmView<'_>> =
            keypoints.iter().map(|k| crate::SfmView { camera: 0, keypoints: k }).collect();
        let seen = |k: u32| (0..5).map(|view| crate::Observation { view, keypoint: k }).collect();
        let tracks = crate::Tracks::from_lists((0..80).map(seen));
        let mut scene = Scene::new(&views, &[camera], &[crate::CameraKnowledge::Known], tracks);
        for v in 0..5 {
            // All but the first are off by a fifth of a baseline and more.
            let off = if v == 0 { Vector3::zeros() } else { Vector3::new(0.1, -0.1, 0.05 * v as f64) };
            scene.poses[v] = Some(Pose::new(pose(v).rotation, pose(v).translation + off));
        }
        scene.points = points.iter().map(|p| Some(Point3::from(p.coords * 1.2))).collect();
        scene.active.fill(true);
        adjust_rays(&mut scene, &Stage::new(&Silent, "test", 1).unwrap()).unwrap();
        let centers: Vec<Point3<f64>> = (0..5).map(|v| scene.poses[v].unwrap().center()).collect();
        let truth: Vec<Point3<f64>> = (0..5).map(|v| pose(v).center()).collect();
        let scale = (truth[4] - truth[0]).norm() / (centers[4] - centers[0]).norm();
        for (f, t) in centers.iter().zip(&truth) {
            // Keypoints are f32, exact to 3e-5 px or 3e-8 of the focal length; the adjustment stops at a relative cost
            // change of 1e-3.
            assert!(((f - centers[0]) * scale - (t - truth[0])).norm() < 1e-3, "{f} {t}");
        }
    }
}
