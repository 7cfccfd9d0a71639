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
