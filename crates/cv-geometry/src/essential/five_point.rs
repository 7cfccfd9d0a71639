//! The five-point algorithm.

use crate::fundamental::epipolar_row;
use crate::null_space_basis::{orthonormalize, reflect_generic};
use cv_core::{Matrix3, Point2, Vector3};
use cv_numeric::{null_space, real_roots};
use fearless_simd::{Level, dispatch};

/// Polynomial of degree one in x, y, z: coefficients of x, y, z, 1.
type Linear = [f64; 4];
/// Polynomial of degree two: x², xy, y², xz, yz, z², x, y, z, 1.
type Quadratic = [f64; 10];
/// Polynomial of degree three, in the monomial order of the elimination: x³, y³, x²y, xy², x²z, x², y²z, y², xyz, xy,
/// then xz², xz, x, yz², yz, y, z³, z², z, 1.
type Cubic = [f64; 20];

/// Squared relative residual of the constraints below which a root is not refined.
const REFINEMENT_TOLERANCE: f64 = 1e-26;

/// Basis of the four-dimensional null space of the five epipolar constraints.
type Basis = [[f64; 9]; 4];
/// The last ten coefficients of six of the ten cubics after elimination.
type Reduced = [[f64; 10]; 6];

/// Computes the essential matrices (at most ten) with `bᵢᵀ E aᵢ = 0` for five matches in normalized coordinates, each
/// of Frobenius norm √2 (singular values 1, 1, 0).
///
/// Calls `emit` for each; for none if the points are degenerate. Nistér, "An efficient solution to the five-point
/// relative pose problem", 2004: null space, ten cubics, elimination, the real roots of a polynomial of degree ten.
#[inline]
pub fn essential_five_point(a: &[Point2<f64>; 5], b: &[Point2<f64>; 5], mut emit: impl FnMut(Matrix3<f64>)) {
    // No product is fused, so all instruction sets give identical results.
    let Some((basis, reduced)) = dispatch!(Level::new(), _simd => reduce(a, b)) else { return };
    // Three equations in (x, y, 1) whose coefficients are polynomials in z: in each pair of rows, z times the second
    // cancels the leading monomial of the first.
    let mut x = [[0.0; 4]; 3];
    let mut y = [[0.0; 4]; 3];
    let mut one = [[0.0; 5]; 3];
    for i in 0..3 {
        let (e, f) = (&reduced[2 * i], &reduced[2 * i + 1]);
        x[i] = [e[2], e[1] - f[2], e[0] - f[1], -f[0]];
        y[i] = [e[5], e[4] - f[5], e[3] - f[4], -f[3]];
        one[i] = [e[9], e[8] - f[9], e[7] - f[8], e[6] - f[7], -f[6]];
    }
    // The determinant, expanded along the third column.
    let mut determinant = [0.0; 11];
    for (i, third) in one.iter().enumerate() {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        let mut minor = [0.0; 7];
        for p in 0..4 {
            for q in 0..4 {
                minor[p + q] += x[j][p] * y[k][q] - x[k][p] * y[j][q];
            }
        }
        for p in 0..7 {
            for q in 0..5 {
                determinant[p + q] += minor[p] * third[q];
            }
        }
    }
    for &z in real_roots(&determinant).iter() {
        let at = |c: &[f64]| c.iter().rev().fold(0.0, |s, c| s * z + c);
        let row = |i: usize| Vector3::new(at(&x[i]), at(&y[i]), at(&one[i]));
        let r = [row(0), row(1), row(2)];
        // (x, y, 1) is orthogonal to the rows: the longest of their cross products.
        let mut best = r[0].cross(&r[1]);
        for c in [r[1].cross(&r[2]), r[2].cross(&r[0])] {
            if c.norm_squared() > best.norm_squared() {
                best = c;
            }
        }
        let e = refine_root(&basis, Vector3::new(best.x / best.z, best.y / best.z, z));
        let norm = e.norm();
        if norm.is_finite() && norm > 0.0 {
            emit(e * (std::f64::consts::SQRT_2 / norm));
        }
    }
}

/// Returns the essential matrix at (x, y, z), after up to two Gauss–Newton steps on the trace constraint: where two
/// roots are close, elimination and the polynomial of degree ten have only about five correct digits.
#[inline]
fn refine_root(basis: &Basis, mut at: Vector3<f64>) -> Matrix3<f64> {
    let parts = basis.map(|b| Matrix3::from_row_slice(&b));
    let matrix = |p: &Vector3<f64>| parts[0] * p.x + parts[1] * p.y + parts[2] * p.z + parts[3];
    let mut e = matrix(&at);
    for _ in 0..2 {
        // The trace constraint 2 E Eᵀ E − tr(E Eᵀ) E = 0; it implies det E = 0.
        let gram = e * e.transpose();
        let trace = gram.trace();
        let residual = gram * e * 2.0 - e * trace;
        if residual.norm_squared() <= REFINEMENT_TOLERANCE * trace * trace * trace {
            break;
        }
        let inner = e.transpose() * e;
        let derivative =
            |b: &Matrix3<f64>| (b * inner + e * b.transpose() * e + gram * b) * 2.0 - e * (2.0 * b.dot(&e)) - b * trace;
        let jacobian = [derivative(&parts[0]), derivative(&parts[1]), derivative(&parts[2])];
        let normal = Matrix3::from_fn(|i, j| jacobian[i].dot(&jacobian[j]));
        let rhs = Vector3::from_fn(|i, _| jacobian[i].dot(&residual));
        let Some(inverse) = normal.try_inverse() else { break };
        let next = at - inverse * rhs;
        let next_e = matrix(&next);
        if !next_e.norm_squared().is_finite() {
            break;
        }
        (at, e) = (next, next_e);
    }
    e
}

/// Computes the null space of the five epipolar constraints, and eliminates the ten cubics in its coordinates.
#[inline(always)]
fn reduce(a: &[Point2<f64>; 5], b: &[Point2<f64>; 5]) -> Option<(Basis, Reduced)> {
    let rows = std::array::from_fn(|i| epipolar_row(a[i], b[i]));
    let mut basis = null_space::<5, 9, 4>(rows)?;
    orthonormalize(&mut basis);
    reflect_generic(&mut basis);
    let reduced = eliminate(constraints(&basis))?;
    Some((basis, reduced))
}

#[inline(always)]
fn times(a: &Linear, b: &Linear) -> Quadratic {
    [
        a[0] * b[0],
        a[0] * b[1] + a[1] * b[0],
        a[1] * b[1],
        a[0] * b[2] + a[2] * b[0],
        a[1] * b[2] + a[2] * b[1],
        a[2] * b[2],
        a[0] * b[3] + a[3] * b[0],
        a[1] * b[3] + a[3] * b[1],
        a[2] * b[3] + a[3] * b[2],
        a[3] * b[3],
    ]
}

#[inline(always)]
fn times_linear(q: &Quadratic, b: &Linear) -> Cubic {
    [
        q[0] * b[0],
        q[2] * b[1],
        q[0] * b[1] + q[1] * b[0],
        q[1] * b[1] + q[2] * b[0],
        q[0] * b[2] + q[3] * b[0],
        q[0] * b[3] + q[6] * b[0],
        q[2] * b[2] + q[4] * b[1],
        q[2] * b[3] + q[7] * b[1],
        q[1] * b[2] + q[3] * b[1] + q[4] * b[0],
        q[1] * b[3] + q[6] * b[1] + q[7] * b[0],
        q[3] * b[2] + q[5] * b[0],
        q[3] * b[3] + q[6] * b[2] + q[8] * b[0],
        q[6] * b[3] + q[9] * b[0],
        q[4] * b[2] + q[5] * b[1],
        q[4] * b[3] + q[7] * b[2] + q[8] * b[1],
        q[7] * b[3] + q[9] * b[1],
        q[5] * b[2],
        q[5] * b[3] + q[8] * b[2],
        q[8] * b[3] + q[9] * b[2],
        q[9] * b[3],
    ]
}

#[inline(always)]
fn add<const N: usize>(a: &mut [f64; N], b: &[f64; N]) {
    for (x, y) in a.iter_mut().zip(b) {
        *x += y;
    }
}

/// Expands `(E Eᵀ − ½ tr(E Eᵀ)) E = 0` and `det E = 0` for `E = x e₀ + y e₁ + z e₂ + e₃` to ten cubics.
#[inline(always)]
fn constraints(basis: &Basis) -> [Cubic; 10] {
    let entry = |i: usize, j: usize| -> Linear { std::array::from_fn(|k| basis[k][3 * i + j]) };
    let e: [[Linear; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)));
    // The upper triangle of E Eᵀ: 00, 01, 02, 11, 12, 22.
    let dot = |i: usize, j: usize| {
        let mut sum = times(&e[i][0], &e[j][0]);
        add(&mut sum, &times(&e[i][1], &e[j][1]));
        add(&mut sum, &times(&e[i][2], &e[j][2]));
        sum
    };
    let mut gram = [dot(0, 0), dot(0, 1), dot(0, 2), dot(1, 1), dot(1, 2), dot(2, 2)];
    let half_trace: Quadratic = std::array::from_fn(|k| 0.5 * (gram[0][k] + gram[3][k] + gram[5][k]));
    for d in [0, 3, 5] {
        for k in 0..10 {
            gram[d][k] -= half_trace[k];
        }
    }
    const INDEX: [[usize; 3]; 3] = [[0, 1, 2], [1, 3, 4], [2, 4, 5]];
    let mut rows = [[0.0; 20]; 10];
    for i in 0..3 {
        for j in 0..3 {
            let row = &mut rows[3 * i + j];
            *row = times_linear(&gram[INDEX[i][0]], &e[0][j]);
            add(row, &times_linear(&gram[INDEX[i][1]], &e[1][j]));
            add(row, &times_linear(&gram[INDEX[i][2]], &e[2][j]));
        }
    }
    // The determinant, expanded along the first row.
    for j in 0..3 {
        let (k, l) = ((j + 1) % 3, (j + 2) % 3);
        let mut minor = times(&e[1][k], &e[2][l]);
        let other = times(&e[1][l], &e[2][k]);
        for (m, o) in minor.iter_mut().zip(other) {
            *m -= o;
        }
        add(&mut rows[9], &times_linear(&minor, &e[0][j]));
    }
    rows
}

/// Applies Gauss–Jordan elimination to the first ten columns, and returns the remaining ten columns of the last six
/// rows. `None` if a pivot vanishes.
#[inline(always)]
fn eliminate(mut rows: [Cubic; 10]) -> Option<Reduced> {
    for c in 0..10 {
        let mut pivot = c;
        for r in c + 1..10 {
            if rows[r][c].abs() > rows[pivot][c].abs() {
                pivot = r;
            }
        }
        rows.swap(c, pivot);
        let lead = rows[c][c];
        if lead.is_nan() || lead == 0.0 {
            return None;
        }
        let inverse = 1.0 / lead;
        let row = rows[c].map(|v| v * inverse);
        rows[c] = row;
        // The result does not use rows above the fifth, so they need no back-substitution. Whole rows are updated, also
        // left of the pivot, because a fixed length vectorizes.
        for (r, other) in rows.iter_mut().enumerate() {
            if r > c || (r >= 4 && r < c) {
                let factor = other[c];
                for (v, p) in other.iter_mut().zip(&row) {
                    *v -= factor * p;
                }
            }
        }
    }
    Some(std::array::from_fn(|i| std::array::from_fn(|j| rows[4 + i][10 + j])))
}
