//! The solver against reference implementations: dense normal equations from numeric derivatives, inverses, repeated noise.

use super::factor::Analysis;
use super::normal::{Normal, Reduced};
use super::residual::LossModel;
use super::structure::Structure;
use super::*;
use nalgebra::{DMatrix, DVector, Rotation3, SMatrix, SVector, Vector2, Vector3};
use std::ops::ControlFlow;

fn never_stop(_: &AdjustIteration) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// Uniform random numbers from −1 to 1.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        // splitmix64's mixing.
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    fn gauss(&mut self) -> f64 {
        let u = (self.next() + 1.0) / 2.0;
        (-2.0 * u.max(1e-300).ln()).sqrt() * (std::f64::consts::PI * self.next()).cos()
    }

    fn vector(&mut self) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.next())
    }
}

/// Reprojection errors of cameras with a focal length and one radial distortion coefficient.
#[derive(Clone)]
struct Reprojection(Vec<Vector2<f64>>);

impl Residual<2, 3, 11> for Reprojection {
    const DIMS: [usize; 3] = [6, 2, 3];

    fn evaluate(
        &self,
        item: usize,
        [pose, lens, point]: [&[f64]; 3],
        jacobian: Option<&mut SMatrix<f64, 2, 11>>,
    ) -> Option<Vector2<f64>> {
        let (rotation, translation) = RigidMotion::load(pose);
        let turned = rotation * Vector3::from_column_slice(point);
        let p = turned + translation;
        if p.z <= 0.0 {
            return None;
        }
        let n = Vector2::new(p.x, p.y) / p.z;
        let r2 = n.norm_squared();
        let radial = 1.0 + lens[1] * r2;
        if let Some(j) = jacobian {
            let by_n = (SMatrix::<f64, 2, 2>::identity() * radial + n * n.transpose() * (2.0 * lens[1])) * lens[0];
            let by_p = by_n * SMatrix::<f64, 2, 3>::new(1.0, 0.0, -n.x, 0.0, 1.0, -n.y) / p.z;
            j.fixed_columns_mut::<3>(0).copy_from(&(-by_p * turned.cross_matrix()));
            j.fixed_columns_mut::<3>(3).copy_from(&by_p);
            j.set_column(6, &(n * radial));
            j.set_column(7, &(n * (lens[0] * r2)));
            j.fixed_columns_mut::<3>(8).copy_from(&(by_p * rotation.matrix()));
        }
        Some(n * (lens[0] * radial) - self.0[item])
    }
}

struct Scene {
    poses: Vec<f64>,
    lenses: Vec<f64>,
    points: Vec<f64>,
    pixels: Vec<Vector2<f64>>,
    blocks: Vec<[u32; 3]>,
}

impl Scene {
    /// Cameras on an arc around points in a cube, every point observed by `views` of them.
    fn new(seed: u64, cameras: usize, points: usize, views: usize, own_lenses: bool) -> Self {
        let mut random = Random(seed);
        let count = if own_lenses { cameras } else { 1 };
        let lenses = (0..count).flat_map(|_| [800.0 + 20.0 * random.next(), -0.05 + 0.01 * random.next()]).collect();
        let mut poses = Vec::new();
        for c in 0..cameras {
            let angle = 1.2 * (c as f64 / (cameras - 1) as f64 - 0.5);
            let turn = Rotation3::new(Vector3::new(0.0, angle, 0.0) + random.vector() * 0.1);
            poses.extend(RigidMotion::store(&turn, &(Vector3::new(0.0, 0.0, 5.0) + random.vector() * 0.3)));
        }
        let points: Vec<f64> = (0..points * 3).map(|_| random.next()).collect();
        let mut scene = Self { poses, lenses, points, pixels: Vec::new(), blocks: Vec::new() };
        for p in 0..scene.points.len() / 3 {
            for s in 0..views {
                let c = (p * 7 + s * (1 + p % 3)) % cameras;
                if scene.blocks.iter().rev().take(views).any(|b| b[2] == p as u32 && b[0] == c as u32) {
                    continue;
                }
                scene.blocks.push([c as u32, if own_lenses { c as u32 } else { 0 }, p as u32]);
            }
        }
        let zero = Reprojection(vec![Vector2::zeros(); scene.blocks.len()]);
        scene.pixels = (0..scene.blocks.len()).map(|i| zero.evaluate(i, scene.at(i), None).unwrap()).collect();
        scene
    }

    fn at(&self, item: usize) -> [&[f64]; 3] {
        let [c, l, p] = self.blocks[item].map(|i| i as usize);
        [&self.poses[12 * c..][..12], &self.lenses[2 * l..][..2], &self.points[3 * p..][..3]]
    }

    fn noisy(mut self, seed: u64, sigma: f64) -> Self {
        let mut random = Random(seed);
        self.pixels.iter_mut().for_each(|p| *p += Vector2::new(random.gauss(), random.gauss()) * sigma);
        self
    }

    /// The problem from a start perturbed by `off`; the first pose and the scale fixed.
    fn problem(&self, off: f64, eliminate: bool, loss: RobustLoss) -> (Adjustment<'static>, [GroupId; 3]) {
        let mut random = Random(99);
        let mut poses = self.poses.clone();
        for (c, pose) in poses.chunks_exact_mut(12).enumerate().skip(1) {
            let mut delta = [0.0; 6];
            delta.iter_mut().for_each(|d| *d = off * random.next());
            if c == 1 {
                delta[3] = 0.0;
            }
            let before = pose.to_vec();
            RigidMotion.step(&before, &delta, pose);
        }
        let points = self.points.iter().map(|x| x + off * random.next()).collect();
        let lenses =
            self.lenses.iter().enumerate().map(|(i, l)| if i % 2 == 0 { l * (1.0 + off) } else { 0.0 }).collect();
        let mut problem = Adjustment::default();
        let groups = [
            problem.add_group("poses", RigidMotion, poses).unwrap(),
            problem.add_group("lenses", Euclidean(2), lenses).unwrap(),
            problem.add_group("points", Euclidean(3), points).unwrap(),
        ];
        let residual = Reprojection(self.pixels.clone());
        problem.add_residuals("observations", residual, groups, self.blocks.clone(), loss).unwrap();
        if eliminate {
            problem.eliminate(groups[2]).unwrap();
        }
        problem.fix(groups[0], 0).unwrap();
        problem.fix_parameters(groups[0], 1, &[3]).unwrap();
        (problem, groups)
    }
}

/// `H = Σ w JᵀJ` and `g = Σ w Jᵀr` with numeric derivatives by every free parameter, group after group.
fn reference(scene: &Adjustment<'_>) -> (DMatrix<f64>, DVector<f64>) {
    let mut free = Vec::new();
    for (g, group) in scene.groups.iter().enumerate() {
        for b in 0..group.count {
            free.extend((0..group.size).filter(|k| group.fixed[b] >> k & 1 == 0).map(|k| (g, b, k)));
        }
    }
    let rows = |values: &Values| -> Vec<(f64, f64)> {
        let items = scene.kinds.iter().flat_map(|kind| (0..kind.len()).map(move |i| kind.reference(values, i)));
        items.flat_map(|(numbers, weight)| numbers.into_iter().map(move |r| (r, weight))).collect()
    };
    let (r, weights): (Vec<f64>, Vec<f64>) = rows(&scene.values).into_iter().unzip();
    let residuals = |values: &Values| DVector::from_iterator(r.len(), rows(values).into_iter().map(|r| r.0));
    let at = DVector::from_column_slice(&r);
    let mut j = DMatrix::zeros(r.len(), free.len());
    for (column, &(g, b, k)) in free.iter().enumerate() {
        let moved = |h: f64| {
            let mut values = scene.values.clone();
            let mut delta = vec![0.0; scene.groups[g].size];
            delta[k] = h;
            let n = values.ambient[g];
            let x = scene.values.block(g, b).to_vec();
            scene.groups[g].manifold.step(&x, &delta, &mut values.numbers[g][b * n..][..n]);
            residuals(&values)
        };
        // Richardson's extrapolation of central differences: h⁴ of truncation, 1e-13/h of rounding.
        let (one, two) = ((moved(1e-4) - moved(-1e-4)) / 2e-4, (moved(2e-4) - moved(-2e-4)) / 4e-4);
        j.set_column(column, &((one * 4.0 - two) / 3.0));
    }
    let weighted = DMatrix::from_fn(j.nrows(), j.ncols(), |i, c| j[(i, c)] * weights[i]);
    (j.transpose() * &weighted, weighted.transpose() * at)
}

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
        let (problem, groups) = scene.problem(0.01, true, loss);
        let (mut h, g) = reference(&problem);
        for i in 0..h.nrows() {
            h[(i, i)] *= 1.0 + 1e-3;
        }
        let exact = h.cholesky().unwrap().solve(&-g);
        let structure = Structure::new(&problem.groups, &problem.kinds, problem.eliminated, false);
        let (mut normal, mut reduced) = (Normal::default(), Reduced::default());
        normal.linearize(&problem.kinds, &structure, &problem.values, LossModel::Weight).unwrap();
        let step = normal.step(&structure, &Analysis::Dense, 1e-3, &mut reduced).unwrap();
        let mut ours = Vec::new();
        for group in &groups[..2] {
            for &(block, member) in &structure.location[group.0] {
                if block != structure::NONE {
                    let block = &structure.blocks[block as usize];
                    let member = block.members[member as usize];
                    ours.extend_from_slice(&step.columns[block.column + member.within..][..member.width]);
                }
            }
        }
        ours.extend(step.points);
        let ours = DVector::from_vec(ours);
        // Numeric derivatives are good to 1e-9, and the floor of 1e-12 moves nothing.
        assert!((&ours - &exact).amax() < 1e-6 * exact.amax(), "{own} {ours} {exact}");
    }
}

#[test]
fn covariances_equal_the_inverse_of_the_full_system() {
    for own in [true, false] {
        let scene = Scene::new(11, 5, 24, 4, own);
        let (problem, [poses, lenses, points]) = scene.problem(0.0, true, RobustLoss::Trivial);
        // At the start of `problem`, which has no distortion: any point would do.
        let exact = reference(&problem).0.try_inverse().unwrap() * 0.25;
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

/// The difference of two plane positions.
struct Between(Vec<Vector2<f64>>);

impl Residual<2, 2, 4> for Between {
    const DIMS: [usize; 2] = [2, 2];

    fn evaluate(
        &self,
        item: usize,
        [a, b]: [&[f64]; 2],
        jacobian: Option<&mut SMatrix<f64, 2, 4>>,
    ) -> Option<Vector2<f64>> {
        if let Some(j) = jacobian {
            *j = SMatrix::from_row_slice(&[-1.0, 0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 1.0]);
        }
        Some(Vector2::new(b[0] - a[0], b[1] - a[1]) - self.0[item])
    }
}

/// A closed chain of positions with shortcuts: large and sparse.
fn chain(n: u32) -> (Adjustment<'static>, GroupId) {
    let mut random = Random(7);
    let mut problem = Adjustment::default();
    let positions = problem.add_group("positions", Euclidean(2), vec![0.0; 2 * n as usize]).unwrap();
    let mut blocks: Vec<[u32; 2]> = (0..n).map(|i| [i, (i + 1) % n]).collect();
    blocks.extend((0..n).step_by(9).map(|i| [i, (i + 20) % n]));
    let steps = blocks.iter().map(|_| Vector2::new(random.next(), random.next())).collect();
    problem.add_residuals("steps", Between(steps), [positions; 2], blocks, RobustLoss::Trivial).unwrap();
    problem.fix(positions, 0).unwrap();
    (problem, positions)
}

#[test]
fn a_sparse_system_has_the_solution_and_covariance_of_the_dense_system() {
    let (mut problem, positions) = chain(300);
    let structure = Structure::new(&problem.groups, &problem.kinds, None, false);
    assert!(!structure.pattern.dense);
    let (h, g) = reference(&problem);
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
    let scene = Scene::new(53, 5, 20, 4, false);
    let (mut problem, [_, _, points]) = scene.problem(0.01, true, RobustLoss::Trivial);
    problem.values.numbers[points.0][3 * 6 + 2] = -50.0;
    let error = problem.solve(&AdjustOptions::default(), never_stop).err();
    assert!(
        matches!(&error, Some(AdjustError::Undefined { residuals, item }) if residuals == "observations" && scene.blocks[*item][2] == 6)
    );
    problem.values.numbers[points.0][3 * 6 + 2] = f64::NAN;
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
