//! The six-point algorithm: relative pose of two views with a shared unknown focal length.

use crate::fundamental::epipolar_row;
use crate::null_space_basis::{orthonormalize, reflect_generic};
use cv_core::{Matrix3, Point2};
use cv_numeric::{null_space, null_vector_lu, real_quadratic_eigenvalues};
use nalgebra::DMatrix;

/// Polynomial of degree one in x, y: coefficients of x, y, 1.
type Linear = [f64; 3];
/// Polynomial of degree two: x², xy, y², x, y, 1.
type Quadratic = [f64; 6];
/// Polynomial of degree three: x³, x²y, xy², y³, x², xy, y², x, y, 1.
type Cubic = [f64; 10];

/// Computes the fundamental matrices `F` (Frobenius norm 1) and focal lengths `f` (in the unit of the points) of two
/// cameras with the same focal length, for six matches with coordinates relative to the principal points and square
/// pixels: `bᵢᵀ F aᵢ = 0`, and `diag(f, f, 1) F diag(f, f, 1)` is essential.
///
/// Calls `emit` for each, at most fifteen times; rarely more than five have a positive f. For none if the points are
/// degenerate. Stewénius, Nistér, Kahl & Schaffalitzky, "A minimal solution for relative pose with unknown focal
/// length", CVPR 2005: the ten cubic constraints of an essential matrix in two unknowns, with coefficients quadratic in
/// `1/f²`, solved as a quadratic eigenvalue problem (Kukelova, Bujnak & Pajdla, "Polynomial eigenvalue solutions to the
/// 5-pt and 6-pt relative pose problems", BMVC 2008).
///
/// Degenerate motions: if the optical axes are parallel, or intersect at the same distance from both cameras, every
/// focal length is a solution (Sturm, "On focal length calibration from two views", CVPR 2001), and the results are
/// arbitrary.
pub fn fundamental_six_point(a: &[Point2<f64>; 6], b: &[Point2<f64>; 6], mut emit: impl FnMut(Matrix3<f64>, f64)) {
    // Scale to units in which the focal length is of order one: a normal lens has one of about the image diagonal.
    let size = a.iter().chain(b).map(|p| p.coords.norm()).fold(0.0f64, f64::max);
    if !(size > 0.0 && size.is_finite()) {
        return;
    }
    let scaled = |p: &Point2<f64>| Point2::from(p.coords / size);
    let rows = std::array::from_fn(|i| epipolar_row(scaled(&a[i]), scaled(&b[i])));
    let Some(mut basis) = null_space::<6, 9, 3>(rows) else { return };
    // Twice: the second pass corrects the loss of orthogonality of the first on ill-conditioned bases.
    orthonormalize(&mut basis);
    orthonormalize(&mut basis);
    reflect_generic(&mut basis);
    if !basis.iter().flatten().all(|v| v.is_finite()) {
        return;
    }
    let pencil = constraints(&basis);
    // The shift is negative, so it is not a solution: w = 1/f² is positive.
    for w in real_quadratic_eigenvalues(pencil.each_ref(), -1.0) {
        if !(w > MIN_INVERSE_SQUARED_FOCAL && w < 1.0 / MIN_INVERSE_SQUARED_FOCAL) {
            continue;
        }
        let Some(v) = null_vector_lu(&(&pencil[0] + &pencil[1] * w + &pencil[2] * (w * w))) else { continue };
        let (x, y) = (v[7] / v[9], v[8] / v[9]);
        let f = Matrix3::from_fn(|i, j| {
            let k = 3 * i + j;
            let entry = x * basis[0][k] + y * basis[1][k] + basis[2][k];
            // Back to the unit of the points: the entries are of degree one in each image's third coordinate.
            entry * [1.0, size][usize::from(i == 2)] * [1.0, size][usize::from(j == 2)]
        });
        let norm = f.norm();
        if norm.is_finite() && norm > 0.0 {
            emit(f / norm, size / w.sqrt());
        }
    }
}

/// Minimum of `1/f²` in units of the largest coordinate, and inverse of the maximum: fields of view from a tenth of a
/// degree to nearly 180.
const MIN_INVERSE_SQUARED_FOCAL: f64 = 1e-6;

fn times(a: &Linear, b: &Linear) -> Quadratic {
    [
        a[0] * b[0],
        a[0] * b[1] + a[1] * b[0],
        a[1] * b[1],
        a[0] * b[2] + a[2] * b[0],
        a[1] * b[2] + a[2] * b[1],
        a[2] * b[2],
    ]
}

fn times_linear(q: &Quadratic, b: &Linear) -> Cubic {
    [
        q[0] * b[0],
        q[0] * b[1] + q[1] * b[0],
        q[1] * b[1] + q[2] * b[0],
        q[2] * b[1],
        q[0] * b[2] + q[3] * b[0],
        q[1] * b[2] + q[3] * b[1] + q[4] * b[0],
        q[2] * b[2] + q[4] * b[1],
        q[3] * b[2] + q[5] * b[0],
        q[4] * b[2] + q[5] * b[1],
        q[5] * b[2],
    ]
}

/// Computes `a + s b`.
fn add_scaled<const N: usize>(a: [f64; N], s: f64, b: &[f64; N]) -> [f64; N] {
    std::array::from_fn(|i| a[i] + s * b[i])
}

/// Expands `2 F Q Fᵀ Q F − tr(F Q Fᵀ Q) F = 0` with `Q = diag(1, 1, w)`, `w = 1/f²`, and `det F = 0` for `F = x F₀ + y
/// F₁ + F₂` to ten cubics in x and y; returns the coefficient matrices of the powers of w.
fn constraints(basis: &[[f64; 9]; 3]) -> [DMatrix<f64>; 3] {
    let f: [[Linear; 3]; 3] =
        std::array::from_fn(|i| std::array::from_fn(|j| std::array::from_fn(|k| basis[k][3 * i + j])));
    // F Q Fᵀ = G + w H.
    let g: [[Quadratic; 3]; 3] = std::array::from_fn(|i| {
        std::array::from_fn(|j| add_scaled(times(&f[i][0], &f[j][0]), 1.0, &times(&f[i][1], &f[j][1])))
    });
    let h: [[Quadratic; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| times(&f[i][2], &f[j][2])));
    // The trace by powers of w.
    let trace =
        [add_scaled(g[0][0], 1.0, &g[1][1]), add_scaled(add_scaled(h[0][0], 1.0, &h[1][1]), 1.0, &g[2][2]), h[2][2]];
    let mut pencil = [(); 3].map(|()| DMatrix::zeros(10, 10));
    for i in 0..3 {
        for j in 0..3 {
            let product = |q: &Quadratic, k: usize| times_linear(q, &f[k][j]);
            let twice = [
                add_scaled(product(&g[i][0], 0), 1.0, &product(&g[i][1], 1)),
                add_scaled(add_scaled(product(&h[i][0], 0), 1.0, &product(&h[i][1], 1)), 1.0, &product(&g[i][2], 2)),
                product(&h[i][2], 2),
            ];
            for (power, matrix) in pencil.iter_mut().enumerate() {
                let row = add_scaled(twice[power].map(|v| 2.0 * v), -1.0, &times_linear(&trace[power], &f[i][j]));
                (0..10).for_each(|c| matrix[(3 * i + j, c)] = row[c]);
            }
        }
    }
    // The determinant, expanded along the first row.
    for j in 0..3 {
        let (k, l) = ((j + 1) % 3, (j + 2) % 3);
        let minor = add_scaled(times(&f[1][k], &f[2][l]), -1.0, &times(&f[1][l], &f[2][k]));
        let row = times_linear(&minor, &f[0][j]);
        (0..10).for_each(|c| pencil[0][(9, c)] += row[c]);
    }
    pencil
}
