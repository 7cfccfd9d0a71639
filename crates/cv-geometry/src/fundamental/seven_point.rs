//! The seven-point algorithm.

use crate::null_space_basis::reflect_generic;
use cv_core::{Matrix3, Point2};
use cv_numeric::{null_space, real_roots_cubic};

/// Computes the one to three fundamental matrices with `bᵢᵀ F aᵢ = 0` for seven matches, each of Frobenius norm 1 and
/// rank 2 (Hartley & Zisserman, §11.1.2).
///
/// Calls `emit` for each; for none if the points are degenerate. Coordinates should be of order one: see
/// `estimate_fundamental`, which normalizes them. The null space is computed by elimination, the rank constraint is a
/// cubic.
#[inline]
pub fn fundamental_seven_point(a: &[Point2<f64>; 7], b: &[Point2<f64>; 7], mut emit: impl FnMut(Matrix3<f64>)) {
    let rows = std::array::from_fn(|i| epipolar_row(a[i], b[i]));
    let Some(mut basis) = null_space::<7, 9, 2>(rows) else { return };
    reflect_generic(&mut basis);
    let [f, g] = basis;
    // det(f + t g) = det f + t tr(adj(f) g) + t² tr(adj(g) f) + t³ det g.
    let (adj_f, adj_g) = (adjugate(&f), adjugate(&g));
    let trace = |m: &[f64; 9], n: &[f64; 9]| (0..9).map(|i| m[i] * n[3 * (i % 3) + i / 3]).sum::<f64>();
    let det = |m: &[f64; 9], adj: &[f64; 9]| m[0] * adj[0] + m[1] * adj[3] + m[2] * adj[6];
    let cubic = [det(&f, &adj_f), trace(&adj_f, &g), trace(&adj_g, &f), det(&g, &adj_g)];
    for &t in real_roots_cubic(cubic).iter() {
        let m = Matrix3::from_fn(|r, c| f[3 * r + c] + t * g[3 * r + c]);
        emit(m / m.norm());
    }
}

/// Returns the coefficients of the entries of F (row-major) in `bᵀ F a`.
#[inline]
pub(crate) fn epipolar_row(a: Point2<f64>, b: Point2<f64>) -> [f64; 9] {
    [b.x * a.x, b.x * a.y, b.x, b.y * a.x, b.y * a.y, b.y, a.x, a.y, 1.0]
}

/// Computes the adjugate; both matrices are row-major.
#[inline]
fn adjugate(m: &[f64; 9]) -> [f64; 9] {
    [
        m[4] * m[8] - m[5] * m[7],
        m[2] * m[7] - m[1] * m[8],
        m[1] * m[5] - m[2] * m[4],
        m[5] * m[6] - m[3] * m[8],
        m[0] * m[8] - m[2] * m[6],
        m[2] * m[3] - m[0] * m[5],
        m[3] * m[7] - m[4] * m[6],
        m[1] * m[6] - m[0] * m[7],
        m[0] * m[4] - m[1] * m[3],
    ]
}
