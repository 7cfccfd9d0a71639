//! The solver against reference implementations: dense normal equations from numeric derivatives, inverses, repeated noise.

use crate::scene::{Between, Scene, chain, never_stop};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{
    AdjustError, AdjustOptions, Adjustment, Euclidean, Prior, Residual, RotationManifold, Termination,
};
use nalgebra::{DMatrix, DVector, SMatrix, SVector, Vector2};
use std::ops::ControlFlow;

/// The largest difference relative to the largest entry.
fn relative_difference(a: &DMatrix<f64>, b: &DMatrix<f64>) -> f64 {
    (a - b).amax() / b.amax()
}

#[test]
fn exact_scenes_are_recovered() {
    for (own, eliminate) in [(true, true), (false, true), (false, false)] {
        let scene = Scene::new(3, 6, 60, 4, own);
        let (mut problem, groups) = scene.problem(0.02, eliminate, RobustLoss::Trivial);
        let report = problem.solve(&AdjustOptions::default(), never_stop).unwrap();
        // Rounding of pixels: 1e-13, squared, of 480 residuals.
        assert!(report.converged() && report.cost < 1e-20, "{report:?}");
        for (group, truth) in groups.into_iter().zip([&scene.poses, &scene.lenses, &scene.points]) {
            let off = problem.values(group).iter().zip(truth).map(|(a, b)| (a - b).abs() / b.abs().max(1.0));
            // That rounding by a focal length of 800, times the condition of the scene, some thousands.
            assert!(off.fold(0.0, f64::max) < 1e-10, "{own} {eliminate}");
        }
    }
}

#[test]
fn a_step_by_schur_complement_equals_that_of_the_full_system() {
    for (own, loss) in [(true, RobustLoss::Trivial), (false, RobustLoss::Cauchy { scale: 1.0 })] {
        let scene = Scene::new(5, 5, 20, 3, own).noisy(8, 0.5);
        let (mut problem, groups) = scene.problem(0.01, true, loss);
        let (mut h, g) = scene.reference(&problem, groups, loss);
        for i in 0..h.nrows() {
            h[(i, i)] *= 1.0 + 1e-3;
        }
        let exact = h.cholesky().unwrap().solve(&-g);
        let mut delta = exact.iter().copied();
        let expected = Scene::parameters(&problem, groups).map(|p| p.stepped(&mut delta));
        let options = AdjustOptions { max_iterations: 1, initial_damping: 1e-3, ..AdjustOptions::default() };
        let report = problem.solve(&options, never_stop).unwrap();
        assert_eq!(report.steps, 1);
        for (group, expected) in groups.into_iter().zip(expected) {
            let off = problem.values(group).iter().zip(&expected).map(|(ours, exact)| (ours - exact).abs());
            // Numeric derivatives are good to 1e-9, and the floor of 1e-12 moves nothing.
            assert!(off.fold(0.0, f64::max) < 1e-6 * exact.amax(), "{own} {:?} {expected:?}", problem.values(group));
        }
    }
}

#[test]
fn covariances_equal_the_inverse_of_the_full_system() {
    for own in [true, false] {
        let scene = Scene::new(11, 5, 24, 4, own);
        let (problem, groups) = scene.problem(0.0, true, RobustLoss::Trivial);
        let [poses, lenses, points] = groups;
        // At the start of `problem`, which has no distortion: any point would do.
        let exact = scene.reference(&problem, groups, RobustLoss::Trivial).0.try_inverse().unwrap() * 0.25;
        let covariance = problem.covariance(0.25).unwrap();
        let (lens_count, first_lens) = (scene.lenses.len() / 2, 5 + 3 * 6);
        let part = |i: usize, j: usize, n: usize, m: usize| exact.view((i, j), (n, m)).into_owned();
        assert_eq!(covariance.of(poses, 0).unwrap().amax(), 0.0);
        let pose = covariance.of(poses, 2).unwrap();
        // Numeric derivatives to 1e-9, times the condition of the scaled system, about a thousand.
        assert!(relative_difference(&pose, &part(5, 5, 6, 6)) < 1e-5, "{own}");
        let lens = covariance.of(lenses, 0).unwrap();
        assert!(relative_difference(&lens, &part(first_lens, first_lens, 2, 2)) < 1e-5);
        let cross = covariance.between((lenses, 0), (points, 3)).unwrap();
        let first_point = first_lens + 2 * lens_count;
        assert!(relative_difference(&cross, &part(first_lens, first_point + 9, 2, 3)) < 1e-5);
        let cross = covariance.between((points, 2), (points, 3)).unwrap();
        assert!(relative_difference(&cross, &part(first_point + 6, first_point + 9, 3, 3)) < 1e-5);
        for (p, all) in covariance.of_group(points).into_iter().enumerate() {
            let truth = part(first_point + 3 * p, first_point + 3 * p, 3, 3);
            assert!(relative_difference(&all.unwrap(), &truth) < 1e-5);
            assert!(relative_difference(&covariance.of(points, p).unwrap(), &truth) < 1e-5);
        }
        let fixed = covariance.of(poses, 1).unwrap();
        assert_eq!(fixed.row(3).amax(), 0.0);
        assert!(fixed[(4, 4)] > 0.0);
    }
}

#[test]
fn errors_agree_with_the_covariances() {
    let (mut sum, mut within, mut count) = (0.0, 0.0, 0.0);
    for seed in 0..60 {
        let scene = Scene::new(17, 5, 40, 4, false).noisy(1000 + seed, 0.5);
        let (mut problem, [_, lenses, points]) = scene.problem(0.002, true, RobustLoss::Trivial);
        problem.solve(&AdjustOptions::default(), never_stop).unwrap();
        let covariance = problem.covariance(problem.variance().unwrap()).unwrap();
        let mut add = |estimate: &[f64], truth: &[f64], c: DMatrix<f64>, limit: f64| {
            let d = DVector::from_iterator(truth.len(), estimate.iter().zip(truth).map(|(a, b)| a - b));
            let squared = d.dot(&(c.try_inverse().unwrap() * &d));
            sum += squared / truth.len() as f64;
            within += f64::from(u8::from(squared < limit));
            count += 1.0;
        };
        // 95 % of chi-squared with two and three degrees of freedom.
        add(problem.values(lenses), &scene.lenses, covariance.of(lenses, 0).unwrap(), 5.991);
        for p in [0, 13, 29] {
            let truth = &scene.points[3 * p..][..3];
            add(problem.block(points, p).unwrap(), truth, covariance.of(points, p).unwrap(), 7.815);
        }
    }
    // Means of 240 (not quite independent) squares of normal numbers: 1 ± 0.08, twice; of 0.95: ± 0.02, twice.
    assert!((0.8..1.25).contains(&(sum / count)), "{}", sum / count);
    assert!((0.9..0.99).contains(&(within / count)), "{}", within / count);
}

#[test]
fn a_robust_loss_tolerates_ten_percent_outliers() {
    let mut scene = Scene::new(23, 6, 80, 5, false).noisy(4, 0.3);
    scene.pixels.iter_mut().step_by(10).for_each(|p| *p += Vector2::new(60.0, -45.0));
    let (mut problem, [poses, lenses, _]) = scene.problem(0.005, true, RobustLoss::Cauchy { scale: 1.0 });
    problem.solve(&AdjustOptions::default(), never_stop).unwrap();
    // 0.3 px of noise in 400 observations make about 0.3 px/√400 of the focal length's 800 px, times ten for its weak base.
    assert!((problem.values(lenses)[0] / scene.lenses[0] - 1.0).abs() < 0.01, "{:?}", problem.values(lenses));
    for (pose, truth) in problem.values(poses).chunks(12).zip(scene.poses.chunks(12)) {
        let turn = RotationManifold::load(pose).rotation_to(&RotationManifold::load(truth)).angle();
        assert!(turn < 0.01, "{turn}");
    }
    let (mut squares, [_, lenses, _]) = scene.problem(0.005, true, RobustLoss::Trivial);
    squares.solve(&AdjustOptions::default(), never_stop).unwrap();
    // Without a robust loss the focal length is off.
    assert!((squares.values(lenses)[0] / scene.lenses[0] - 1.0).abs() > 0.01);
}

#[test]
fn fixed_parameters_do_not_change() {
    let scene = Scene::new(31, 5, 30, 4, true).noisy(2, 0.5);
    let (mut problem, [poses, lenses, points]) = scene.problem(0.01, true, RobustLoss::Trivial);
    problem.fix(points, 4).unwrap();
    problem.fix_parameters(points, 5, &[1]).unwrap();
    problem.fix_parameters(lenses, 2, &[0]).unwrap();
    problem.fix(lenses, 3).unwrap();
    let before = |g| problem.values(g).to_vec();
    let (p, l, x) = (before(poses), before(lenses), before(points));
    let report = problem.solve(&AdjustOptions::default(), never_stop).unwrap();
    assert!(report.converged() && report.cost < 0.5 * report.initial_cost);
    assert_eq!(problem.values(poses)[..12], p[..12]);
    assert_eq!(problem.values(poses)[12 + 9], p[12 + 9]);
    assert_eq!((problem.values(lenses)[4], &problem.values(lenses)[6..8]), (l[4], &l[6..8]));
    assert_eq!((&problem.values(points)[12..15], problem.values(points)[16]), (&x[12..15], x[16]));
    assert!(
        problem.values(lenses)[5] != l[5] && problem.values(points)[15] != x[15] && problem.values(points)[17] != x[17]
    );
}

#[test]
fn a_sparse_system_has_the_solution_and_covariance_of_the_dense_system() {
    let (mut problem, positions, (h, g)) = chain(300);
    let inverse = h.try_inverse().unwrap();
    let exact = &inverse * -g;
    // Hardly damped, the first step of a linear problem is the solution.
    problem.solve(&AdjustOptions { initial_damping: 1e-14, ..AdjustOptions::default() }, never_stop).unwrap();
    let ours = DVector::from_column_slice(&problem.values(positions)[2..]);
    // Rounding times the condition of the chain, some 10⁴, and that of numeric derivatives.
    assert!((ours - exact).amax() < 1e-8);
    let covariance = problem.covariance(1.0).unwrap();
    let cross = covariance.between((positions, 120), (positions, 200)).unwrap();
    assert!(relative_difference(&cross, &inverse.view((2 * 119, 2 * 199), (2, 2)).into_owned()) < 1e-8);
    let all = covariance.of_group(positions);
    assert!(relative_difference(all[150].as_ref().unwrap(), &inverse.view((298, 298), (2, 2)).into_owned()) < 1e-8);
    assert_eq!(all[0].as_ref().unwrap().amax(), 0.0);
}

#[test]
fn a_residual_may_depend_on_a_block_twice() {
    struct Sum;
    impl Residual<1, 2, 2> for Sum {
        const DIMS: [usize; 2] = [1, 1];
        fn evaluate(
            &self,
            _: usize,
            [a, b]: [&[f64]; 2],
            jacobian: Option<&mut SMatrix<f64, 1, 2>>,
        ) -> Option<SVector<f64, 1>> {
            if let Some(j) = jacobian {
                j.copy_from_slice(&[1.0, 2.0]);
            }
            Some(SVector::from([a[0] + 2.0 * b[0] - 12.0]))
        }
    }
    let mut problem = Adjustment::default();
    let x = problem.add_group("x", Euclidean(1), vec![0.0]).unwrap();
    problem.add_residuals("sum", Sum, [x, x], vec![[0, 0]], RobustLoss::Trivial).unwrap();
    problem.solve(&AdjustOptions::default(), never_stop).unwrap();
    // 3 x = 12, of which the variance is a ninth.
    assert!((problem.values(x)[0] - 4.0).abs() < 1e-9);
    assert!((problem.covariance(1.0).unwrap().of(x, 0).unwrap()[(0, 0)] - 1.0 / 9.0).abs() < 1e-12);
}

#[test]
fn consider_parameters_increase_the_variance_of_dependent_ones() {
    // By hand: b is measured at 3 from a with variance 1; a has a standard deviation of 2. Then var b = 1 + 4, cov(a, b) = 4.
    let mut problem = Adjustment::default();
    let x = problem.add_group("x", Euclidean(2), vec![0.0; 4]).unwrap();
    let steps = Between(vec![Vector2::new(3.0, 0.0)]);
    problem.add_residuals("steps", steps, [x, x], vec![[0, 1]], RobustLoss::Trivial).unwrap();
    problem.consider(x, 0, &[2.0, 0.5]).unwrap();
    problem.solve(&AdjustOptions::default(), never_stop).unwrap();
    assert!((problem.values(x)[2] - 3.0).abs() < 1e-6 && problem.values(x)[0] == 0.0);
    let covariance = problem.covariance(1.0).unwrap();
    let near = |m: DMatrix<f64>, x: f64, y: f64| {
        assert!((m - DMatrix::from_diagonal(&DVector::from_vec(vec![x, y]))).amax() < 1e-12)
    };
    near(covariance.of(x, 1).unwrap(), 5.0, 1.25);
    near(covariance.between((x, 0), (x, 1)).unwrap(), 4.0, 0.25);
    near(covariance.of(x, 0).unwrap(), 4.0, 0.25);
    problem.release(x, 0).unwrap();
    assert!(matches!(problem.covariance(1.0).err(), Some(AdjustError::RankDeficient { .. })));
}

#[test]
fn priors_are_averaged_by_their_weights() {
    // x measured at 1 with weight 1 and at 4 with weight 1/2: the mean by weights squared is 1.6.
    let mut problem = Adjustment::default();
    let x = problem.add_group("x", Euclidean(1), vec![9.0]).unwrap();
    let prior = Prior { items: vec![([1.0], [1.0]), ([4.0], [0.5])] };
    problem.add_residuals("prior", prior, [x], vec![[0]; 2], RobustLoss::Trivial).unwrap();
    let report = problem.solve(&AdjustOptions::default(), never_stop).unwrap();
    assert!((problem.values(x)[0] - 1.6).abs() < 1e-6 && report.cost <= report.initial_cost);
    let sums = problem.residual_sums().unwrap();
    assert!((sums[0].cost - (0.36 + 1.44)).abs() < 1e-9 && sums[0].count == 2);
}

#[test]
fn results_are_identical_on_one_thread_and_on_four() {
    let scene = Scene::new(41, 9, 700, 4, true).noisy(6, 0.5);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let (mut problem, groups) = scene.problem(0.01, true, RobustLoss::Huber { scale: 1.0 });
            let report = problem.solve(&AdjustOptions::default(), never_stop).unwrap();
            let covariance = problem.covariance(1.0).unwrap().of_group(groups[2]);
            let covariance: Vec<f64> = covariance.into_iter().flat_map(|c| c.unwrap().as_slice().to_vec()).collect();
            (groups.map(|g| problem.values(g).to_vec()), report, covariance)
        })
    };
    assert_eq!(run(1), run(4));
}

#[test]
fn a_callback_stops_the_solver_at_the_present_values() {
    let scene = Scene::new(43, 5, 30, 4, false).noisy(6, 0.5);
    let (mut problem, _) = scene.problem(0.02, true, RobustLoss::Trivial);
    let mut costs = Vec::new();
    let report = problem
        .solve(&AdjustOptions::default(), |i| {
            costs.push(i.cost);
            if i.iterations == 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        })
        .unwrap();
    assert!(report.termination == Termination::Stopped && !report.converged());
    assert_eq!((report.iterations, costs.last()), (3, Some(&report.cost)));
    assert!(costs.windows(2).all(|c| c[1] <= c[0]));
    // The same residuals in the same order, chunk by chunk.
    assert_eq!(problem.residual_sums().unwrap()[0].cost, report.cost);
}

#[test]
fn undetermined_blocks_are_reported_and_left_unchanged() {
    let mut scene = Scene::new(47, 5, 30, 4, false).noisy(6, 0.2);
    // Point 7 is seen by one camera, point 9 by none.
    let mut seen = false;
    let keep: Vec<bool> = scene
        .blocks
        .iter()
        .map(|b| match b[2] {
            7 => !std::mem::replace(&mut seen, true),
            9 => false,
            _ => true,
        })
        .collect();
    let mut kept = keep.iter();
    scene.blocks.retain(|_| *kept.next().unwrap());
    let mut kept = keep.iter();
    scene.pixels.retain(|_| *kept.next().unwrap());
    let (mut problem, [poses, _, points]) = scene.problem(0.005, true, RobustLoss::Trivial);
    let before = problem.block(points, 9).unwrap().to_vec();
    assert!(problem.solve(&AdjustOptions::default(), never_stop).unwrap().converged());
    assert_eq!(problem.block(points, 9).unwrap(), before);
    let covariance = problem.covariance(1.0).unwrap();
    for p in [7, 9] {
        let deficient = AdjustError::RankDeficient { group: "points".to_owned(), block: p };
        assert_eq!(covariance.of(points, p).err(), Some(deficient));
    }
    assert!(covariance.of(points, 8).is_ok());
    assert_eq!(covariance.of_group(points).iter().filter(|c| c.is_err()).count(), 2);
    // The gauge is not fixed.
    problem.release(poses, 0).unwrap();
    problem.release(poses, 1).unwrap();
    let error = problem.covariance(1.0).err();
    assert!(matches!(&error, Some(AdjustError::RankDeficient { group, .. }) if group == "poses"), "{error:?}");
    // The damped solution needs no fixed gauge.
    assert!(problem.solve(&AdjustOptions::default(), never_stop).unwrap().converged());
}

#[test]
fn an_invalid_start_is_refused_and_left_unchanged() {
    let mut scene = Scene::new(53, 5, 20, 4, false);
    scene.points[3 * 6 + 2] = -50.0;
    let (mut problem, _) = scene.problem(0.01, true, RobustLoss::Trivial);
    let error = problem.solve(&AdjustOptions::default(), never_stop).err();
    assert!(
        matches!(&error, Some(AdjustError::Undefined { residuals, item }) if residuals == "observations" && scene.blocks[*item][2] == 6)
    );
    scene.points[3 * 6 + 2] = f64::NAN;
    let (mut problem, _) = scene.problem(0.01, true, RobustLoss::Trivial);
    let error = problem.solve(&AdjustOptions::default(), never_stop).err();
    assert_eq!(error, Some(AdjustError::NotFinite { group: "points".to_owned(), block: 6 }));
    let mut empty = Adjustment::default();
    let x = empty.add_group("x", Euclidean(2), vec![0.0; 2]).unwrap();
    assert_eq!(empty.solve(&AdjustOptions::default(), never_stop).err(), Some(AdjustError::NoResiduals));
    assert!(matches!(
        empty.add_group("y", Euclidean(3), vec![0.0; 4]),
        Err(AdjustError::Length { got: 4, block: 3, .. })
    ));
    assert!(matches!(empty.add_group("y", Euclidean(0), vec![]), Err(AdjustError::Size { got: 0, .. })));
    assert!(matches!(empty.fix(x, 1), Err(AdjustError::Index { index: 1, len: 1, .. })));
    assert!(matches!(empty.fix_parameters(x, 0, &[2]), Err(AdjustError::Index { index: 2, len: 2, .. })));
    let steps = || Between(vec![Vector2::zeros()]);
    let add = empty.add_residuals("steps", steps(), [x, x], vec![[0, 3]], RobustLoss::Trivial);
    assert!(matches!(add, Err(AdjustError::Index { index: 3, .. })));
    let wide = empty.add_group("wide", Euclidean(3), vec![0.0; 3]).unwrap();
    let add = empty.add_residuals("steps", steps(), [x, wide], vec![[0, 0]], RobustLoss::Trivial);
    assert!(matches!(add, Err(AdjustError::Dimension { expected: 2, got: 3, .. })));
    empty.add_residuals("steps", steps(), [x, x], vec![[0, 0]], RobustLoss::Trivial).unwrap();
    empty.eliminate(x).unwrap();
    let error = empty.solve(&AdjustOptions::default(), never_stop).err();
    assert_eq!(error, Some(AdjustError::TwoEliminated { residuals: "steps".to_owned() }));
}
