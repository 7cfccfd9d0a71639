//! The centers of views whose rotations are known: from the directions and lengths of their pairs, then together with the points from the directions of rays.

use crate::scene::Scene;
use crate::view_graph::ViewGraph;
use cv_core::{Cancelled, Point3, Pose, Rotation3, Stage, Vector3};
use cv_geometry::{PairEdge, PairGraph};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustError, AdjustIteration, AdjustOptions, Adjustment, Euclidean, Residual};
use nalgebra::{Matrix3, SMatrix};
use std::ops::ControlFlow;

/// A distance from where a pair puts a center, in baselines, from which on it counts less than by its square.
const OFF: f64 = 0.1;
/// An angle between a ray and the direction of its point from which on it counts less than by its square, in radians: a fifth of a degree.
const RAY: f64 = 0.0035;

/// From one center to the other, by the pair, and one over its length.
struct Baselines(Vec<(Vector3<f64>, f64)>);

impl Residual<3, 2, 6> for Baselines {
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

/// Rays in the world, of length one: the residual is the chord to the direction from the center to the point.
struct Rays(Vec<Vector3<f64>>);

impl Residual<3, 2, 6> for Rays {
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

fn go_on<'s>(stage: &'s Stage<'_>) -> impl FnMut(&AdjustIteration) -> ControlFlow<()> + 's {
    |_| match stage.check() {
        Ok(()) => ControlFlow::Continue(()),
        Err(Cancelled) => ControlFlow::Break(()),
    }
}

/// The centers of the views that links of known length connect with most others, by those; of the others `None`. The sum of distances from where the pairs put them, in baselines, is made least.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn centers_of_baselines(
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
    for step in edges.breadth_first(&tree, root) {
        let baseline = baselines[step.edge].0;
        let forward = if edges.edges()[step.edge].a == step.parent { baseline } else { -baseline };
        centers[step.node] = centers[step.parent].map(|parent| parent + forward);
    }
    let views: Vec<usize> = (0..graph.views).filter(|v| centers[*v].is_some()).collect();
    let mut number = vec![0u32; graph.views];
    views.iter().zip(0..).for_each(|(v, n)| number[*v] = n);
    let inside = edges.edges().iter().zip(&baselines).filter(|(e, _)| centers[e.a].is_some());
    let (blocks, items): (Vec<[u32; 2]>, Vec<_>) = inside.map(|(e, b)| ([number[e.a], number[e.b]], *b)).unzip();
    let start: Vec<f64> = views.iter().filter_map(|v| centers[*v]).flat_map(|c| [c.x, c.y, c.z]).collect();
    let solved = (|| {
        let mut problem = Adjustment::default();
        let group = problem.add_group("centers", Euclidean(3), start)?;
        problem.hold(group, number[root] as usize)?;
        let loss = RobustLoss::Huber { scale: OFF };
        problem.add_residuals("baselines", Baselines(items), [group, group], blocks, loss)?;
        let settings = AdjustOptions { max_iterations: 30, cost_tolerance: 1e-4, ..AdjustOptions::default() };
        problem.solve(&settings, go_on(stage))?;
        Ok::<_, AdjustError>(problem.values(group).to_vec())
    })();
    stage.check()?;
    for (v, x) in views.iter().zip(solved.iter().flat_map(|x| x.chunks_exact(3))) {
        centers[*v] = Some(Point3::new(x[0], x[1], x[2]));
    }
    Ok(centers)
}

/// Moves centers and points of a scene to where the rays that agree meet best, rotations held: angles count, not depths, so that a wrong start far away hinders less than with distances in
/// pixels (the residual of Zhuang, Cheong & Lee, "Baseline desensitizing in translation averaging", CVPR 2018, on cameras and points as in Pan, Baráth, Pollefeys & Schönberger, "Global
/// structure-from-motion revisited", ECCV 2024).
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn adjust_rays(scene: &mut Scene<'_>, stage: &Stage<'_>) -> Result<(), Cancelled> {
    let tracks: Vec<usize> = (0..scene.points.len()).filter(|t| scene.points[*t].is_some()).collect();
    let views = scene.registered();
    let mut number = vec![0u32; scene.views.len()];
    views.iter().zip(0..).for_each(|(v, n)| number[*v] = n);
    let (mut blocks, mut rays, mut points) = (Vec::new(), Vec::new(), Vec::new());
    for (&track, n) in tracks.iter().zip(0..) {
        points.extend(scene.points[track].iter().flat_map(|p| [p.x, p.y, p.z]));
        for (i, pose) in scene.seen(track).filter(|(i, _)| scene.active[*i]) {
            blocks.push([number[scene.view_of(i)], n]);
            rays.push((pose.rotation.inverse() * scene.ray(i).to_homogeneous()).normalize());
        }
    }
    let start: Vec<Point3<f64>> = views.iter().filter_map(|v| scene.poses[*v]).map(|p| p.center()).collect();
    let Some(first) = start.first().copied() else { return Ok(()) };
    let far = (0..start.len()).max_by(|a, b| {
        let apart = |n: &usize| (start[*n] - first).norm_squared();
        apart(a).total_cmp(&apart(b))
    });
    let solved = (|| {
        let mut problem = Adjustment::default();
        let centers = problem.add_group("centers", Euclidean(3), start.iter().flat_map(|c| [c.x, c.y, c.z]).collect())?;
        let group = problem.add_group("points", Euclidean(3), points)?;
        problem.eliminate(group)?;
        problem.hold(centers, 0)?;
        if let Some(n) = far.filter(|n| *n > 0) {
            problem.hold_parameters(centers, n, &[(start[n] - first).iamax()])?;
        }
        problem.add_residuals("rays", Rays(rays), [centers, group], blocks, RobustLoss::Cauchy { scale: RAY })?;
        let settings = AdjustOptions { max_iterations: 30, cost_tolerance: 1e-3, ..AdjustOptions::default() };
        problem.solve(&settings, go_on(stage))?;
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
