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
            problem.fix(group, number[root] as usize)?;
            let relative = Relative(links.iter().map(|l| l.pose.rotation).collect());
            let blocks = links.iter().map(|l| [number[l.a], number[l.b]]).collect();
            problem.add_residuals("relative rotations", relative, [group, group], blocks, loss)?;
            let options =
                AdjustOptions { max_iterations: ITERATIONS, cost_tolerance: 1e-5, ..AdjustOptions::default() };
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

    /// Numbers from 0 to 1, the same for a seed.
    fn numbers(seed: u64) -> impl FnMut() -> f64 {
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

    /// Rotations of 40 views and of half of their pairs, of which so many are wrong, the others off by up to `noise` radians on each axis.
    fn graph(seed: u64, wrong: f64, noise: f64) -> (Vec<Rotation3<f64>>, ViewGraph) {
        let mut random = numbers(seed);
        let truth: Vec<Rotation3<f64>> = (0..40).map(|_| Rotation3::new(vector(&mut random, 2.0))).collect();
        let mut links = Vec::new();
        for (a, b) in (0..40).flat_map(|a| (a + 1..40).map(move |b| (a, b))) {
            // A ring holds all together.
            if random() < 0.5 || b == a + 1 {
                let off = if random() < wrong { vector(&mut random, 2.0) } else { vector(&mut random, noise) };
                let pose = Pose::new(Rotation3::new(off) * truth[b] * truth[a].inverse(), Vector3::x());
                links.push(Link { pair: links.len(), a, b, pose, matches: 50 + links.len() % 7 });
            }
        }
        (truth, ViewGraph { views: 40, links })
    }

    /// The largest angle between a relative rotation and the true one, in radians.
    fn worst(found: &[Option<Rotation3<f64>>], truth: &[Rotation3<f64>]) -> f64 {
        let angle = |a: usize, b: usize| {
            let left = (found[b].unwrap() * found[a].unwrap().inverse()).inverse() * truth[b] * truth[a].inverse();
            Pose::new(left, Vector3::zeros()).rotation_angle()
        };
        (1..truth.len()).map(|b| angle(0, b)).fold(0.0, f64::max)
    }

    #[test]
    fn rotations_are_found_among_wrong_pairs() {
        for seed in 1..=5 {
            // Exact pairs, then three in ten wrong: as long as right ones have the majority around each view, the least sum of angles is at the truth.
            for wrong in [0.0, 0.3] {
                let (truth, graph) = graph(seed, wrong, 0.0);
                let found = average_rotations(&graph, &Stage::new(&Silent, "test", 1).unwrap()).unwrap();
                // Geman and McClure's weight of a wrong pair is not quite zero: (5°/60°)⁴ of 60 degrees is 0.003 degrees, and a few of twenty are wrong.
                assert!(worst(&found, &truth) < 1e-3, "{seed} {wrong}: {}", worst(&found, &truth));
            }
            // Errors of up to 0.01 on each axis, a standard deviation of 0.0058: sixteen right pairs of a view leave 0.0014, of two views 0.002. Five of them, which a pair's own error of up to
            // 0.017 is above.
            let (truth, noisy) = graph(seed, 0.2, 0.01);
            let found = average_rotations(&noisy, &Stage::new(&Silent, "test", 1).unwrap()).unwrap();
            assert!(worst(&found, &truth) < 0.01, "{seed}: {}", worst(&found, &truth));
        }
    }

    #[test]
    fn derivatives_are_those_of_the_residual() {
        let mut random = numbers(3);
        for size in [1e-6, 0.1, 1.5] {
            let relative = Rotation3::new(vector(&mut random, size));
            let [a, b] = [0, 1].map(|_| RotationManifold::store(&Rotation3::new(vector(&mut random, 1.0))));
            let problem = Relative(vec![relative]);
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
                // Central differences: h² of truncation, 1e-16/h of rounding, with third derivatives of order one.
                assert!((numeric - jacobian.column(k)).norm() < 1e-8, "{size} {k}: {numeric} {}", jacobian.column(k));
            }
        }
    }
}
