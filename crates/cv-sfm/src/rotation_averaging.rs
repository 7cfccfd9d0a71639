//! The rotations of views from those of their pairs.

use crate::view_graph::ViewGraph;
use cv_core::{Cancelled, Rotation3, Stage, Vector3};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustIteration, AdjustOptions, Adjustment, Residual, RotationManifold};
use nalgebra::{Matrix3, SMatrix, UnitQuaternion};
use std::ops::ControlFlow;

/// Where the cost of an angle begins to grow less than by its square, in radians, first and then. A tenth of a degree is below nearly all errors, so that the sum of angles is minimized, which
/// is right with many wrong pairs (L1); then five degrees, Chatterjee & Govindu's: a pair's weight falls to a quarter there, and right ones add up with all their weight.
const LOSSES: [RobustLoss; 2] = [RobustLoss::Huber { scale: 0.0017 }, RobustLoss::GemanMcClure { scale: 0.087 }];
/// Iterations of each.
const ITERATIONS: usize = 30;

/// Relative rotations: the residual is the rotation vector of what is left between a pair's and that of its views.
struct Relative(Vec<Rotation3<f64>>);

/// The inverse of the left Jacobian of SO(3) at a rotation vector.
fn inverse_left_jacobian(r: &Vector3<f64>) -> Matrix3<f64> {
    let angle = r.norm();
    let cross = r.cross_matrix();
    // (1/θ² − cot(θ/2)/2θ), which is 1/12 at zero.
    let k = if angle < 1e-4 {
        1.0 / 12.0
    } else {
        (1.0 - 0.5 * angle * (0.5 * angle).cos() / (0.5 * angle).sin()) / (angle * angle)
    };
    Matrix3::identity() - cross * 0.5 + cross * cross * k
}

impl Residual<3, 2, 6> for Relative {
    const DIMS: [usize; 2] = [3, 3];

    fn evaluate(
        &self,
        item: usize,
        [a, b]: [&[f64]; 2],
        jacobian: Option<&mut SMatrix<f64, 3, 6>>,
    ) -> Option<Vector3<f64>> {
        let (from, to) = (RotationManifold::load(a), RotationManifold::load(b));
        let relative = &self.0[item];
        // exp(R ω_a) · E · exp(−ω_b).
        let left = relative * from * to.inverse();
        let residual = UnitQuaternion::from_rotation_matrix(&left).scaled_axis();
        if let Some(j) = jacobian {
            let inverse = inverse_left_jacobian(&residual);
            j.fixed_view_mut::<3, 3>(0, 0).copy_from(&(inverse * relative.matrix()));
            j.fixed_view_mut::<3, 3>(0, 3).copy_from(&-inverse.transpose());
        }
        Some(residual)
    }
}

/// World-to-camera rotations of the views of a connected graph, `R_b ≈ R_ab R_a`; `None` of views that are not in it. Along the tree of firmest links first, then all links: the least sum of
/// angles and, from there, of squares of those that agree (Chatterjee & Govindu, "Efficient and robust large-scale rotation averaging", ICCV 2013). O(links) for an iteration.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn average_rotations(
    graph: &ViewGraph,
    stage: &Stage<'_>,
) -> Result<Vec<Option<Rotation3<f64>>>, Cancelled> {
    let mut rotations: Vec<Option<Rotation3<f64>>> = vec![None; graph.views];
    let Some(edges) = graph.edges(|i| graph.links[i].matches as f64) else { return Ok(rotations) };
    let tree = edges.maximum_spanning_forest();
    let Some(root) = edges.center(&tree) else { return Ok(rotations) };
    rotations[root] = Some(Rotation3::identity());
    for step in edges.breadth_first(&tree, root) {
        let link = &graph.links[step.edge];
        let relative = link.pose.rotation;
        let forward = if link.a == step.parent { relative } else { relative.inverse() };
        rotations[step.node] = rotations[step.parent].map(|parent| forward * parent);
    }
    let views: Vec<usize> = (0..graph.views).filter(|v| rotations[*v].is_some()).collect();
    let mut number = vec![0u32; graph.views];
    views.iter().zip(0..).for_each(|(v, n)| number[*v] = n);
    let links: Vec<_> = graph.links.iter().filter(|l| rotations[l.a].is_some() && rotations[l.b].is_some()).collect();
    for loss in LOSSES {
        let store = |v: &usize| rotations[*v].map_or([0.0; 9], |r| RotationManifold::store(&r));
        let solved = (|| {
            let mut problem = Adjustment::default();
            let group = problem.add_group("rotations", RotationManifold, views.iter().flat_map(store).collect())?;
            problem.hold(group, number[root] as usize)?;
            let relative = Relative(links.iter().map(|l| l.pose.rotation).collect());
            let blocks = links.iter().map(|l| [number[l.a], number[l.b]]).collect();
            problem.add_residuals("relative rotations", relative, [group, group], blocks, loss)?;
            let options = AdjustOptions { max_iterations: ITERATIONS, cost_tolerance: 1e-5, ..AdjustOptions::default() };
            problem.solve(&options, |_: &AdjustIteration| match stage.check() {
                Ok(()) => ControlFlow::Continue(()),
                Err(Cancelled) => ControlFlow::Break(()),
            })?;
            Ok::<_, cv_numeric::adjust::AdjustError>(problem.values(group).to_vec())
        })();
        stage.check()?;
        let Ok(values) = solved else { break };
        for (view, x) in views.iter().zip(values.chunks_exact(9)) {
            rotations[*view] = Some(RotationManifold::load(x));
        }
    }
    Ok(rotations)
}

