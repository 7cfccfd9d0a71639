//! P3P: the absolute pose from three points.

use super::WorldMatch;
use cv_core::{Matrix3, Pose, Rotation3, Vector3};
use cv_numeric::{farthest_root_cubic, real_roots_quadratic};

/// Computes the poses (at most four), world to camera, with which three world points project to three image points in
/// normalized coordinates.
///
/// Calls `emit` for each pose with all points in front of the camera; for none if the world points are collinear. The
/// three squared distances between the points are quadratic forms of the depths. The degenerate conic of the pencil of
/// their differences is a pair of planes, and on each plane the depths are roots of a quadratic (Persson & Nordberg,
/// "Lambda Twist", 2018; Ding et al., "Revisiting the P3P problem", 2023).
#[inline]
pub fn pose_three_points(m: &[WorldMatch; 3], mut emit: impl FnMut(Pose)) {
    // Unrolled, with one division per ray: faster by a tenth.
    let ray = |i: usize| {
        let v = m[i].image.to_homogeneous();
        v * (1.0 / v.norm())
    };
    let (rays, world) = ([ray(0), ray(1), ray(2)], [m[0].world.coords, m[1].world.coords, m[2].world.coords]);
    let (d01, d02) = (world[0] - world[1], world[0] - world[2]);
    let normal = d01.cross(&d02);
    let (a01, a02, a12) = (d01.norm_squared(), d02.norm_squared(), (world[1] - world[2]).norm_squared());
    let area = normal.norm_squared();
    if !area.is_finite() || area <= 1e-20 * a01 * a02 {
        return;
    }
    let (b01, b02, b12) = (rays[0].dot(&rays[1]), rays[0].dot(&rays[2]), rays[1].dot(&rays[2]));
    // Quadratic forms of the depths that vanish: distances 01 and 02 relative to 12.
    let d1 = Matrix3::new(a12, -a12 * b01, 0.0, -a12 * b01, a12 - a01, a01 * b12, 0.0, a01 * b12, -a01);
    let d2 = Matrix3::new(a12, 0.0, -a12 * b02, 0.0, -a02, a02 * b12, -a12 * b02, a02 * b12, a12 - a02);
    let (adj1, adj2) = (adjugate(&d1), adjugate(&d2));
    let trace = |a: &Matrix3<f64>, b: &Matrix3<f64>| a.component_mul(b).sum();
    let cubic =
        [d1.column(0).dot(&adj1.column(0)), trace(&adj1, &d2), trace(&adj2, &d1), d2.column(0).dot(&adj2.column(0))];
    // The best-determined degenerate member of the pencil. If it is not a pair of real planes, there is no solution.
    let pencil = if cubic[3].abs() < cubic[0].abs() {
        farthest_root_cubic([cubic[3], cubic[2], cubic[1], cubic[0]]).map(|g| d1 * g + d2)
    } else {
        farthest_root_cubic(cubic).map(|g| d1 + d2 * g)
    };
    let Some(d) = pencil else { return };
    let b = adjugate(&d);
    let i = (0..3).max_by(|&i, &j| (-b[(i, i)]).total_cmp(&-b[(j, j)])).unwrap_or(0);
    if b[(i, i)] >= 0.0 {
        return;
    }
    let axis = b.column(i) * (1.0 / (-b[(i, i)]).sqrt());
    // D + [axis]× is the outer product of the normals of the two planes.
    let product = d + axis.cross_matrix();
    let (r, c) = product.iamax_full();
    let planes: [Vector3<f64>; 2] = [product.row(r).transpose(), product.column(c).into_owned()];
    // The inverse of the matrix with the columns d01, d02 and their normal.
    let inverse = Matrix3::from_columns(&[d02.cross(&normal), normal.cross(&d01), normal]).transpose() * (1.0 / area);
    for n in planes {
        let i = n.iamax();
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        // Depths (on the plane): k-th = τ, j-th = 1, i-th = u + v τ.
        let (u, v) = (-n[j] / n[i], -n[k] / n[i]);
        let (form, other) = (&d1, &d2);
        let quadratic = |q: &Matrix3<f64>| {
            [
                q[(i, i)] * u * u + 2.0 * q[(i, j)] * u + q[(j, j)],
                2.0 * (q[(i, i)] * u * v + q[(i, j)] * v + q[(i, k)] * u + q[(j, k)]),
                q[(i, i)] * v * v + 2.0 * q[(i, k)] * v + q[(k, k)],
            ]
        };
        let size = |q: &[f64; 3]| q.iter().map(|x| x.abs()).fold(0.0, f64::max);
        let (first, second) = (quadratic(form), quadratic(other));
        let chosen = if size(&first) >= size(&second) { first } else { second };
        for &t in real_roots_quadratic(chosen).iter() {
            let mut depth = Vector3::zeros();
            depth[i] = u + v * t;
            depth[j] = 1.0;
            depth[k] = t;
            if !depth.iter().all(|x| *x > 0.0) {
                continue;
            }
            // The scale from the sum of the three squared distances, without cancellation.
            let form = depth.norm_squared() * 2.0
                - 2.0 * (b01 * depth[0] * depth[1] + b02 * depth[0] * depth[2] + b12 * depth[1] * depth[2]);
            let mut depth = depth * ((a01 + a02 + a12) / form).sqrt();
            // A second step is only needed if two solutions are close.
            for _ in 0..2 {
                if newton_step(&mut depth, [a01, a02, a12], [b01, b02, b12]) {
                    break;
                }
            }
            if !depth.iter().all(|x| *x > 0.0) {
                continue;
            }
            let first = rays[0] * depth[0];
            let (e01, e02) = (first - rays[1] * depth[1], first - rays[2] * depth[2]);
            let rotation = Matrix3::from_columns(&[e01, e02, e01.cross(&e02)]) * inverse;
            let translation = first - rotation * world[0];
            emit(Pose::new(Rotation3::from_matrix_unchecked(rotation), translation));
        }
    }
}

/// Applies a Newton step to the depths; returns true (without a step) if the three squared distances are already exact
/// to rounding.
#[inline]
fn newton_step(l: &mut Vector3<f64>, [a01, a02, a12]: [f64; 3], [b01, b02, b12]: [f64; 3]) -> bool {
    let r = Vector3::new(
        l[0] * l[0] + l[1] * l[1] - 2.0 * b01 * l[0] * l[1] - a01,
        l[0] * l[0] + l[2] * l[2] - 2.0 * b02 * l[0] * l[2] - a02,
        l[1] * l[1] + l[2] * l[2] - 2.0 * b12 * l[1] * l[2] - a12,
    );
    if r.amax() <= 4.0 * f64::EPSILON * l.norm_squared() {
        return true;
    }
    // Half of the derivatives.
    let (p, q) = (l[0] - b01 * l[1], l[1] - b01 * l[0]);
    let (s, t) = (l[0] - b02 * l[2], l[2] - b02 * l[0]);
    let (v, w) = (l[1] - b12 * l[2], l[2] - b12 * l[1]);
    let determinant = -p * t * v - q * s * w;
    // Singular at a double root: no step.
    if determinant.abs() > 1e-12 * (l.norm_squared() * l.norm()) {
        let i = 0.5 / determinant;
        l[0] -= i * (-t * v * r[0] - q * w * r[1] + q * t * r[2]);
        l[1] -= i * (-s * w * r[0] + p * w * r[1] - p * t * r[2]);
        l[2] -= i * (s * v * r[0] - p * v * r[1] - q * s * r[2]);
    }
    false
}

/// Computes the adjugate of a symmetric matrix.
#[inline]
fn adjugate(m: &Matrix3<f64>) -> Matrix3<f64> {
    let c = [m.column(0).into_owned(), m.column(1).into_owned(), m.column(2).into_owned()];
    Matrix3::from_columns(&[c[1].cross(&c[2]), c[2].cross(&c[0]), c[0].cross(&c[1])])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TwoViews, uniform};
    use cv_core::{Point2, Point3};
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn one_of_the_poses_is_the_truth_and_all_reproject_exactly() {
        let mut worst = 0.0f64;
        let (mut total, mut missed) = (0, 0);
        for seed in 0..2000 {
            let views = TwoViews::random(seed);
            let m = [(); 3].map(|()| {
                let (p, pair) = views.point(None);
                WorldMatch { world: p, image: views.normalize(&pair).b }
            });
            let (mut count, mut best) = (0, f64::INFINITY);
            pose_three_points(&m, |pose| {
                count += 1;
                for m in &m {
                    let q = pose.transform(&m.world);
                    assert!(q.z > 0.0 && (Point2::new(q.x / q.z, q.y / q.z) - m.image).norm() < 1e-6);
                }
                assert!((pose.rotation.matrix().determinant() - 1.0).abs() < 1e-6);
                let e = (pose.rotation.matrix() - views.pose.rotation.matrix()).norm()
                    + (pose.translation - views.pose.translation).norm();
                best = best.min(e);
            });
            assert!(count <= 4);
            total += count;
            missed += usize::from(best > 1e-5);
            if best < 1e-5 {
                worst = worst.max(best);
            }
        }
        // Near the danger cylinder two solutions coincide and half of the digits are lost; one in a thousand random
        // triples has fewer than five correct digits.
        assert!(missed <= 4 && worst < 1e-5, "{missed} {worst}");
        // Gao et al. 2003 report 1.7 positive solutions on average over random triples.
        assert!((2000..6000).contains(&total), "{total}");
    }

    #[test]
    fn fronto_parallel_symmetric_triangles_are_solved() {
        // Symmetry makes coefficients of the cubic vanish, and above the circumscribed circle (danger cylinder) two
        // solutions coincide.
        let side = 3f64.sqrt();
        let shapes = [
            [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
            [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]],
            [[-1.0, -1.0], [1.0, -1.0], [0.0, side - 1.0]],
            [[1.0, 0.0], [-0.5, 0.5 * side], [-0.5, -0.5 * side]],
            [[-1.0, 0.0], [1.0, 0.0], [0.0, 3.0]],
        ];
        for shape in shapes {
            for turn in [0.0, 0.25, 0.5, 1.0] {
                for (axis, distance) in [(Vector3::x(), 4.0), (Vector3::y(), 4.0), (Vector3::z(), 40.0)] {
                    let truth = Pose::new(Rotation3::new(axis * turn), Vector3::new(0.0, 0.0, distance));
                    let m = shape.map(|[x, y]| {
                        let world = Point3::new(x, y, 0.0);
                        let q = truth.transform(&world);
                        WorldMatch { world, image: Point2::new(q.x / q.z, q.y / q.z) }
                    });
                    let mut best = f64::INFINITY;
                    pose_three_points(&m, |pose| {
                        let e = (pose.rotation.matrix() - truth.rotation.matrix()).norm()
                            + (pose.translation - truth.translation).norm() / distance;
                        best = best.min(e);
                    });
                    // Where two solutions coincide, half of the digits are lost, and two more at a distance of forty
                    // times the triangle's size.
                    assert!(best < 1e-5, "{shape:?} {turn} {axis:?}: {best}");
                }
            }
        }
    }

    #[test]
    fn degenerate_triples_have_no_solution() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let image = [(); 3].map(|()| Point2::new(uniform(&mut rng), uniform(&mut rng)));
        let with = |world: [Point3<f64>; 3]| {
            let m = [0, 1, 2].map(|i: usize| WorldMatch { world: world[i], image: image[i] });
            let mut count = 0;
            pose_three_points(&m, |_| count += 1);
            count
        };
        let line = [0.0, 1.0, 2.0].map(|t| Point3::new(t, 2.0 * t, 5.0));
        assert_eq!(with(line), 0);
        assert_eq!(with([Point3::new(1.0, 2.0, 3.0); 3]), 0);
        assert_eq!(with([Point3::new(f64::NAN, 0.0, 1.0); 3]), 0);
        assert_eq!(with([Point3::new(f64::INFINITY, 0.0, 1.0), Point3::origin(), Point3::new(0.0, 1.0, 0.0)]), 0);
    }
}
