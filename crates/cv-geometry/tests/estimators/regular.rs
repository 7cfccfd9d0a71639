//! Minimal solvers on regular configurations: points on grids, and motions along and about the axes, for which
//! coefficients vanish that are nonzero in general. Such input must be solved whenever a slightly perturbed input is.

use cv_core::{Matrix3, Point2, Point3, Pose, Rotation3, Vector3};
use cv_geometry::{essential_five_point, fundamental_seven_point, fundamental_six_point};
use nalgebra::DMatrix;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

type ImagePoints = [Vec<Point2<f64>>; 2];

/// The projections of seven of eight points in two views, and their relative pose.
fn problems() -> Vec<(ImagePoints, Pose)> {
    let cube = [(-1, -1, 4), (1, -1, 4), (-1, 1, 4), (1, 1, 4), (-1, -1, 6), (1, -1, 6), (-1, 1, 6), (1, 1, 6)];
    let steps = [(0, 0, 4), (1, 0, 5), (0, 1, 6), (2, 1, 4), (1, 2, 5), (2, 2, 7), (-1, 1, 7), (1, -1, 6)];
    let (x, y, z) = (Vector3::x(), Vector3::y(), Vector3::z());
    let project = |p: Point3<f64>| Point2::new(p.x / p.z, p.y / p.z);
    let mut all = Vec::new();
    for shape in [cube, steps] {
        let points = shape.map(|(x, y, z)| Point3::new(f64::from(x), f64::from(y), f64::from(z)));
        for translation in [x, -x, y, z, -z, (x + y).normalize(), (x - z).normalize()] {
            for rotation in [Vector3::zeros(), 0.1 * x, 0.1 * y, 0.1 * z, -0.2 * y] {
                let pose = Pose::new(Rotation3::new(rotation), translation);
                for skip in 0..8 {
                    let seven = || points.iter().enumerate().filter(|(i, _)| *i != skip).map(|(_, p)| *p);
                    all.push((
                        [seven().map(project).collect(), seven().map(|p| project(pose.transform(&p))).collect()],
                        pose,
                    ));
                }
            }
        }
    }
    all
}

/// The image points perturbed by up to 1e-10.
fn perturbed([a, b]: &ImagePoints, seed: u64) -> ImagePoints {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut e = || 2e-10 * (f64::from(rng.next_u32()) / 4294967296.0 - 0.5);
    let mut all = |p: &[Point2<f64>]| p.iter().map(|p| Point2::new(p.x + e(), p.y + e())).collect();
    [all(a), all(b)]
}

/// Computes the angle between two matrices as vectors, up to sign (as a chord).
fn error(found: &Matrix3<f64>, pose: &Pose) -> f64 {
    let truth = pose.translation.cross_matrix() * pose.rotation.matrix();
    let (f, t) = (found / found.norm(), truth / truth.norm());
    (f - t).norm().min((f + t).norm())
}

fn first<const N: usize>(p: &[Point2<f64>]) -> [Point2<f64>; N] {
    p[..N].try_into().unwrap()
}

/// Asserts that problems that are solved with three perturbations are solved without; returns their number. `solve`
/// returns the error of each solution.
fn check(solve: impl Fn(&ImagePoints, &Pose) -> Vec<f64>) -> usize {
    // A perturbation of 1e-10 changes a solution by that times the condition number: problems beyond 1e6 are skipped.
    // So are double roots, which rounding may make complex.
    const SOLVED: f64 = 1e-4;
    let count_solved = |points: &ImagePoints, pose: &Pose| solve(points, pose).iter().filter(|e| **e < SOLVED).count();
    let mut solved = 0;
    for (points, pose) in problems() {
        if (0..3).all(|seed| count_solved(&perturbed(&points, seed), &pose) == 1) {
            assert_eq!(count_solved(&points, &pose), 1, "{pose:?} {points:?}");
            solved += 1;
        }
    }
    solved
}

#[test]
fn the_five_point_solver_handles_regular_configurations() {
    let solved = check(|[a, b], pose| {
        let mut errors = Vec::new();
        essential_five_point(&first(a), &first(b), |e| errors.push(error(&e, pose)));
        errors
    });
    // Of 560; the others have double roots.
    assert!(solved > 450, "{solved}");
}

#[test]
fn the_seven_point_solver_handles_regular_configurations() {
    let solved = check(|[a, b], pose| {
        let row = |i: usize, j: usize| a[i].to_homogeneous()[j % 3] * b[i].to_homogeneous()[j / 3];
        // Padded to nine rows, for nine right singular vectors.
        let svd = DMatrix::from_fn(9, 9, |i, j| if i < 7 { row(i, j) } else { 0.0 }).svd(false, true);
        let v = svd.v_t.unwrap();
        let mut order: Vec<usize> = (0..9).collect();
        order.sort_by(|i, j| svd.singular_values[*i].total_cmp(&svd.singular_values[*j]));
        let [f, g] = [0, 1].map(|k: usize| Matrix3::from_fn(|r, c| v[(order[k], 3 * r + c)]));
        // Critical configurations (for example seven points and both cameras on a cone): every member of the pencil is
        // singular.
        let at = |t: f64| (f * t.cos() + g * t.sin()).determinant().abs();
        if (0..8).all(|k| at(0.4 * f64::from(k)) < 1e-9) {
            return Vec::new();
        }
        let mut errors = Vec::new();
        fundamental_seven_point(&first(a), &first(b), |f| errors.push(error(&f, pose)));
        errors
    });
    // Fewer than with five points: the corners of a cube and a camera in front of it lie on more than one quadric.
    assert!(solved > 350, "{solved}");
}

#[test]
fn the_six_point_solver_handles_regular_configurations() {
    let solved = check(|[a, b], pose| {
        // Degenerate motions: optical axes that are parallel or intersect at equal distances.
        let axis = pose.rotation.inverse() * Vector3::z();
        let center = pose.center().coords;
        let normal = Vector3::z().cross(&axis);
        if normal.norm() < 1e-9 || (center.dot(&(axis + Vector3::z()))).abs() < 1e-9 {
            return Vec::new();
        }
        let pixels = |p: &[Point2<f64>]| first::<6>(p).map(|p| p * 500.0);
        let mut errors = Vec::new();
        fundamental_six_point(&pixels(a), &pixels(b), |_, focal| errors.push((focal / 500.0 - 1.0).abs()));
        errors
    });
    // Half of the motions are degenerate.
    assert!(solved > 230, "{solved}");
}
