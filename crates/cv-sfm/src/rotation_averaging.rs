//! Rotation averaging: absolute rotations of views from the relative rotations of pairs.

use crate::view_graph::ViewGraph;
use cv_core::{Cancelled, Rotation3, Stage, Vector3};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustIteration, AdjustOptions, Adjustment, Residual, RotationManifold};
use nalgebra::{Matrix3, SMatrix, UnitQuaternion};
use std::ops::ControlFlow;

/// The loss of each stage, with scales in radians. The first one is L1-like: its 0.1 degrees are below nearly all
/// errors, which is robust to many outliers. The second one, with 5 degrees (Chatterjee & Govindu), gives inliers
/// nearly their full weight; at its scale the weight falls to a quarter.
const LOSSES: [RobustLoss; 2] = [RobustLoss::Huber { scale: 0.0017 }, RobustLoss::GemanMcClure { scale: 0.087 }];
/// Maximum number of iterations of each stage.
const MAX_ITERATIONS: usize = 30;

/// Residuals of relative rotations: the rotation vector between the measured relative rotation and that of the views.
struct RelativeRotationResidual(Vec<Rotation3<f64>>);

/// Returns the inverse of the left Jacobian of SO(3) at a rotation vector.
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

impl Residual<3, 2, 6> for RelativeRotationResidual {
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
        let error = relative * from * to.inverse();
        let residual = UnitQuaternion::from_rotation_matrix(&error).scaled_axis();
        if let Some(j) = jacobian {
            let inverse = inverse_left_jacobian(&residual);
            j.fixed_view_mut::<3, 3>(0, 0).copy_from(&(inverse * relative.matrix()));
            j.fixed_view_mut::<3, 3>(0, 3).copy_from(&-inverse.transpose());
        }
        Some(residual)
    }
}

/// Estimates the world-to-camera rotations of the views of a connected graph, `R_b ≈ R_ab R_a`; `None` for views
/// outside the largest component. Initialized along the maximum spanning tree by number of matches, then by iteratively
/// reweighted least squares over all links with two robust losses (Chatterjee & Govindu, "Efficient and robust
/// large-scale rotation averaging", ICCV 2013). O(links) per iteration.
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
    let mut block_of = vec![0u32; graph.views];
    views.iter().zip(0..).for_each(|(v, n)| block_of[*v] = n);
    let links: Vec<_> = graph.links.iter().filter(|l| rotations[l.a].is_some() && rotations[l.b].is_some()).collect();
    for loss in LOSSES {
        let store = |v: &usize| rotations[*v].map_or([0.0; 9], |r| RotationManifold::store(&r));
        let solved = (|| {
            let mut problem = Adjustment::default();
            let group = problem.add_group("rotations", RotationManifold, views.iter().flat_map(store).collect())?;
            problem.fix(group, block_of[root] as usize)?;
            let relative = RelativeRotationResidual(links.iter().map(|l| l.pose.rotation).collect());
            let blocks = links.iter().map(|l| [block_of[l.a], block_of[l.b]]).collect();
            problem.add_residuals("relative rotations", relative, [group, group], blocks, loss)?;
            let options =
                AdjustOptions { max_iterations: MAX_ITERATIONS, cost_tolerance: 1e-5, ..AdjustOptions::default() };
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view_graph::Link;
    use cv_core::{Pose, Silent};

    /// Returns a pseudo-random generator of numbers from 0 to 1.
    fn random_numbers(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ 0xD1B5_4A32_D192_ED03;
        move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    fn vector(random: &mut impl FnMut() -> f64, length: f64) -> Vector3<f64> {
        Vector3::new(random() - 0.5, random() - 0.5, random() - 0.5) * (2.0 * length)
    }

    /// Rotations of 40 views and the relative rotations of half of their pairs. A fraction of `outliers` is random; the
    /// others have errors of up to `noise` radians on each axis.
    fn graph(seed: u64, outliers: f64, noise: f64) -> (Vec<Rotation3<f64>>, ViewGraph) {
        let mut random = random_numbers(seed);
        let truth: Vec<Rotation3<f64>> = (0..40).map(|_| Rotation3::new(vector(&mut random, 2.0))).collect();
        let mut links = Vec::new();
        for (a, b) in (0..40).flat_map(|a| (a + 1..40).map(move |b| (a, b))) {
            // Consecutive views are always linked, so that the graph is connected.
            if random() < 0.5 || b == a + 1 {
                let error = if random() < outliers { vector(&mut random, 2.0) } else { vector(&mut random, noise) };
                let pose = Pose::new(Rotation3::new(error) * truth[b] * truth[a].inverse(), Vector3::x());
                links.push(Link { pair: links.len(), a, b, pose, matches: 50 + links.len() % 7 });
            }
        }
        (truth, ViewGraph { views: 40, links })
    }

    /// Returns the largest angle between an estimated relative rotation and the true one, in radians.
    fn max_error(estimated: &[Option<Rotation3<f64>>], truth: &[Rotation3<f64>]) -> f64 {
        let angle = |a: usize, b: usize| {
            let error =
                (estimated[b].unwrap() * estimated[a].unwrap().inverse()).inverse() * truth[b] * truth[a].inverse();
            Pose::new(error, Vector3::zeros()).rotation_angle()
        };
        (1..truth.len()).map(|b| angle(0, b)).fold(0.0, f64::max)
    }

    #[test]
    fn rotations_are_estimated_among_outlier_pairs() {
        for seed in 1..=5 {
            // Exact pairs, then 30 % outliers: while inliers are the majority around each view, the L1 minimum is at
            // the truth.
            for outliers in [0.0, 0.3] {
                let (truth, graph) = graph(seed, outliers, 0.0);
                let rotations = average_rotations(&graph, &Stage::new(&Silent, "test", 1).unwrap()).unwrap();
                // The Geman-McClure weight of an outlier is not quite zero: (5°/60°)⁴ of 60 degrees is 0.003 degrees,
                // for a few of twenty.
                assert!(max_error(&rotations, &truth) < 1e-3, "{seed} {outliers}: {}", max_error(&rotations, &truth));
            }
            // Errors of up to 0.01 on each axis have a standard deviation of 0.0058: sixteen inliers of a view leave
            // 0.0014, of two views 0.002. The limit is five of them; a pair's own error is up to 0.017.
            let (truth, noisy) = graph(seed, 0.2, 0.01);
            let rotations = average_rotations(&noisy, &Stage::new(&Silent, "test", 1).unwrap()).unwrap();
            assert!(max_error(&rotations, &truth) < 0.01, "{seed}: {}", max_error(&rotations, &truth));
        }
    }

    #[test]
    fn derivatives_are_those_of_the_residual() {
        let mut random = random_numbers(3);
        for size in [1e-6, 0.1, 1.5] {
            let relative = Rotation3::new(vector(&mut random, size));
            let [a, b] = [0, 1].map(|_| RotationManifold::store(&Rotation3::new(vector(&mut random, 1.0))));
            let problem = RelativeRotationResidual(vec![relative]);
            let mut jacobian = SMatrix::zeros();
            problem.evaluate(0, [&a, &b], Some(&mut jacobian)).unwrap();
            for k in 0..6 {
                let at = |h: f64| {
                    let (mut x, mut y, mut step) = (a, b, [0.0; 3]);
                    step[k % 3] = h;
                    use cv_numeric::adjust::Manifold;
                    if k < 3 {
                        RotationManifold.step(&a, &step, &mut x)
                    } else {
                        RotationManifold.step(&b, &step, &mut y)
                    }
                    problem.evaluate(0, [&x, &y], None).unwrap()
                };
                let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
                // Central differences: truncation error h², rounding error 1e-16/h, with third derivatives of order
                // one.
                assert!((numeric - jacobian.column(k)).norm() < 1e-8, "{size} {k}: {numeric} {}", jacobian.column(k));
            }
        }
    }
}
