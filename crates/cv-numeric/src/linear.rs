//! Small dense linear algebra: null vectors, 3×3 SVD, symmetric eigenvectors.

use faer::Side;
use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, SMatrix, SVector, Vector3};

/// Why a decomposition did not succeed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum LinearError {
    /// An entry is NaN or infinite.
    #[error("the matrix has an entry that is not finite")]
    NotFinite,
    /// The iteration did not converge, or a pivot vanished.
    #[error("the decomposition did not converge")]
    NoConvergence,
    /// There are no columns.
    #[error("the matrix is empty")]
    Empty,
    /// The matrix is not positive definite.
    #[error("the matrix is not positive definite")]
    NotPositiveDefinite,
}

/// Computes the unit vector `v` that minimizes `‖A v‖`: the right singular vector of the smallest singular value.
///
/// `A` is any m×n matrix with n ≥ 1, also with m < n. O(m n²).
///
/// # Errors
/// [`LinearError`] on empty or non-finite input.
pub fn null_vector(a: &DMatrix<f64>) -> Result<DVector<f64>, LinearError> {
    let n = a.ncols();
    if n == 0 {
        return Err(LinearError::Empty);
    }
    if !a.iter().all(|v| v.is_finite()) {
        return Err(LinearError::NotFinite);
    }
    // Zero rows pad a wide matrix to a square one without changing ‖A v‖.
    let rows = a.nrows().max(n);
    let m = faer::Mat::from_fn(rows, n, |i, j| if i < a.nrows() { a[(i, j)] } else { 0.0 });
    let svd = m.thin_svd().map_err(|_| LinearError::NoConvergence)?;
    let v = svd.V();
    Ok(DVector::from_fn(n, |i, _| v[(i, n - 1)]))
}

/// Computes the eigenvalues, ascending, and the unit eigenvectors, as columns, of a symmetric matrix of fixed size.
///
/// Only the lower triangle is read. Cyclic Jacobi rotations (Golub & Van Loan, §8.5): slower than a tridiagonal
/// method above 20 or so, but accurate to the last digits and free of allocation at the sizes of vision problems.
/// Each eigenvector's sign is such that its largest component is positive.
pub fn symmetric_eigen<const N: usize>(m: &SMatrix<f64, N, N>) -> (SVector<f64, N>, SMatrix<f64, N, N>) {
    let mut a = *m;
    a.fill_upper_triangle_with_lower_triangle();
    let mut v = SMatrix::<f64, N, N>::identity();
    for _ in 0..60 {
        let mut off = 0.0;
        let mut diagonal = 0.0;
        for j in 0..N {
            diagonal += a[(j, j)] * a[(j, j)];
            for i in j + 1..N {
                off += a[(i, j)] * a[(i, j)];
            }
        }
        if off.is_nan() || off <= 1e-34 * diagonal {
            break;
        }
        for q in 1..N {
            for p in 0..q {
                let apq = a[(q, p)];
                if apq == 0.0 {
                    continue;
                }
                let theta = (a[(q, q)] - a[(p, p)]) / (2.0 * apq);
                let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
                let c = 1.0 / (t * t + 1.0).sqrt();
                let s = t * c;
                for k in 0..N {
                    let (x, y) = (a[(k, p)], a[(k, q)]);
                    a[(k, p)] = c * x - s * y;
                    a[(k, q)] = s * x + c * y;
                }
                for k in 0..N {
                    let (x, y) = (a[(p, k)], a[(q, k)]);
                    a[(p, k)] = c * x - s * y;
                    a[(q, k)] = s * x + c * y;
                    let (x, y) = (v[(k, p)], v[(k, q)]);
                    v[(k, p)] = c * x - s * y;
                    v[(k, q)] = s * x + c * y;
                }
            }
        }
    }
    let mut order: [usize; N] = std::array::from_fn(|i| i);
    sort_by_value(&mut order, &std::array::from_fn::<_, N, _>(|i| a[(i, i)]));
    let values = SVector::from_fn(|i, _| a[(order[i], order[i])]);
    let mut vectors = SMatrix::<f64, N, N>::zeros();
    for (i, &k) in order.iter().enumerate() {
        let column = v.column(k);
        let sign = if column[column.icamax()] < 0.0 { -1.0 } else { 1.0 };
        vectors.set_column(i, &(column * sign));
    }
    (values, vectors)
}

/// Sorts indices of `values` in ascending order of these. Not generic over their number: sorting is compiled once.
fn sort_by_value(indices: &mut [usize], values: &[f64]) {
    indices.sort_by(|&i, &j| values[i].total_cmp(&values[j]));
}

/// Computes the unit vector `v` that minimizes `vᵀ M v` for a symmetric positive semi-definite `M` of fixed size, such as `AᵀA`.
///
/// Only the lower triangle is read. Inverse iteration with a Cholesky factor, a few hundred nanoseconds
/// at 9×9, and [`symmetric_eigen`] where that does not converge (the two smallest eigenvalues nearly equal).
/// The sign is such that the largest component is positive.
///
/// # Errors
/// [`LinearError::NotFinite`] on NaN or infinite entries.
pub fn smallest_eigenvector<const N: usize>(m: &SMatrix<f64, N, N>) -> Result<SVector<f64, N>, LinearError> {
    let trace = m.trace();
    if !m.iter().all(|v| v.is_finite()) {
        return Err(LinearError::NotFinite);
    }
    let oriented = |v: SVector<f64, N>| if v[v.icamax()] < 0.0 { -v } else { v };
    // The shift makes a singular matrix factorizable and is below the rounding of the entries.
    if let Some(l) = cholesky_lower(m, 4.0 * f64::EPSILON * trace) {
        // The start is no coordinate axis: those are exact eigenvectors of matrices with structural zeros.
        let mut v = SVector::<f64, N>::from_fn(|i, _| 1.0 + 0.1 * i as f64).normalize();
        for _ in 0..24 {
            let mut next = solve_lower(&l, &v);
            let norm = next.norm();
            if !(norm > 0.0 && norm.is_finite()) {
                break;
            }
            next /= norm;
            let change = (next - v).norm();
            v = next;
            if change < 1e-13 {
                return Ok(oriented(v));
            }
        }
    }
    Ok(symmetric_eigen(m).1.column(0).into_owned())
}

/// Computes the lower Cholesky factor of `m + shift·I`, its diagonal inverted.
pub(crate) fn cholesky_lower<const N: usize>(m: &SMatrix<f64, N, N>, shift: f64) -> Option<SMatrix<f64, N, N>> {
    let mut l = *m;
    for j in 0..N {
        let mut pivot = l[(j, j)] + shift;
        for k in 0..j {
            pivot -= l[(j, k)] * l[(j, k)];
        }
        if pivot.is_nan() || pivot <= 0.0 {
            return None;
        }
        let inverse = 1.0 / pivot.sqrt();
        for i in j + 1..N {
            let mut sum = l[(i, j)];
            for k in 0..j {
                sum -= l[(i, k)] * l[(j, k)];
            }
            l[(i, j)] = sum * inverse;
        }
        l[(j, j)] = inverse;
    }
    Some(l)
}

/// Solves `L Lᵀ x = b` with the factor of [`cholesky_lower`].
fn solve_lower<const N: usize>(l: &SMatrix<f64, N, N>, b: &SVector<f64, N>) -> SVector<f64, N> {
    let mut x = *b;
    for i in 0..N {
        let mut sum = x[i];
        for k in 0..i {
            sum -= l[(i, k)] * x[k];
        }
        x[i] = sum * l[(i, i)];
    }
    for i in (0..N).rev() {
        let mut sum = x[i];
        for k in i + 1..N {
            sum -= l[(k, i)] * x[k];
        }
        x[i] = sum * l[(i, i)];
    }
    x
}

/// Solves `M x = b` for a symmetric positive definite `M` of fixed size. Only the lower triangle is read.
///
/// # Errors
/// [`LinearError::NotPositiveDefinite`] where a pivot is not positive (also on NaN).
pub fn solve_positive_definite<const N: usize>(
    m: &SMatrix<f64, N, N>,
    b: &SVector<f64, N>,
) -> Result<SVector<f64, N>, LinearError> {
    cholesky_lower(m, 0.0).map(|l| solve_lower(&l, b)).ok_or(LinearError::NotPositiveDefinite)
}

/// A 3×3 singular value decomposition `U diag(s) Vᵀ`, `s` descending, with `U` and `V` proper rotations.
///
/// The last singular value carries the sign that makes both determinants +1: it is negative where `det M < 0`, and
/// `U diag(s) Vᵀ = M` always.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Svd3 {
    /// Left singular vectors as columns, `det U = 1`.
    pub u: Matrix3<f64>,
    /// Singular values, by descending absolute value; only the last may be negative.
    pub s: Vector3<f64>,
    /// Right singular vectors as columns, `det V = 1`.
    pub v: Matrix3<f64>,
}

impl Svd3 {
    /// Computes the rotation nearest to the matrix in the Frobenius norm, `U Vᵀ` (orthogonal Procrustes problem).
    pub fn nearest_rotation(&self) -> Rotation3<f64> {
        Rotation3::from_matrix_unchecked(self.u * self.v.transpose())
    }
}

/// Computes the singular value decomposition of a 3×3 matrix by one-sided Jacobi rotations, accurate also for tiny singular values.
///
/// # Errors
/// [`LinearError::NotFinite`] on NaN or infinite entries.
pub fn svd3(m: &Matrix3<f64>) -> Result<Svd3, LinearError> {
    if !m.iter().all(|v| v.is_finite()) {
        return Err(LinearError::NotFinite);
    }
    // Scale, so that no square overflows or underflows.
    let scale = m.amax();
    if scale == 0.0 {
        return Ok(Svd3 { u: Matrix3::identity(), s: Vector3::zeros(), v: Matrix3::identity() });
    }
    let mut a = m / scale;
    let mut v = Matrix3::<f64>::identity();
    for _ in 0..40 {
        let mut rotated = false;
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let (x, y): (Vector3<f64>, Vector3<f64>) = (a.column(p).into_owned(), a.column(q).into_owned());
            let (alpha, beta, gamma) = (x.norm_squared(), y.norm_squared(), x.dot(&y));
            if gamma.abs() <= 1e-16 * (alpha * beta).sqrt() || gamma == 0.0 {
                continue;
            }
            rotated = true;
            let zeta = (beta - alpha) / (2.0 * gamma);
            let t = if zeta >= 0.0 { 1.0 } else { -1.0 } / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
            let c = 1.0 / (1.0 + t * t).sqrt();
            let s = c * t;
            a.set_column(p, &(x * c - y * s));
            a.set_column(q, &(x * s + y * c));
            let (x, y): (Vector3<f64>, Vector3<f64>) = (v.column(p).into_owned(), v.column(q).into_owned());
            v.set_column(p, &(x * c - y * s));
            v.set_column(q, &(x * s + y * c));
        }
        if !rotated {
            break;
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a.column(j).norm_squared().total_cmp(&a.column(i).norm_squared()));
    let mut sorted_v = Matrix3::from_columns(&order.map(|i| v.column(i)));
    let mut columns = order.map(|i| a.column(i).into_owned());
    if sorted_v.determinant() < 0.0 {
        sorted_v.set_column(2, &-sorted_v.column(2));
        columns[2] = -columns[2];
    }
    let u0 = columns[0].normalize();
    let s1 = columns[1].norm();
    // Below this its square underflows and the column is not orthogonalized: use any perpendicular.
    let u1 = if s1 > 1e-140 {
        columns[1] / s1
    } else {
        let axis = if u0.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
        u0.cross(&axis).normalize()
    };
    let u2 = u0.cross(&u1).normalize();
    let s = Vector3::new(columns[0].norm(), s1, columns[2].dot(&u2)) * scale;
    Ok(Svd3 { u: Matrix3::from_columns(&[u0, u1, u2]), s, v: sorted_v })
}

/// Solves `M x = b` for a symmetric positive definite `M` of any size by Cholesky. Only the lower triangle is read. O(n³).
///
/// # Errors
/// [`LinearError`] on non-finite input or a matrix that is not positive definite.
pub fn solve_positive_definite_dense(m: &DMatrix<f64>, b: &DVector<f64>) -> Result<DVector<f64>, LinearError> {
    if !(m.iter().all(|v| v.is_finite()) && b.iter().all(|v| v.is_finite())) {
        return Err(LinearError::NotFinite);
    }
    let n = m.nrows();
    let a = faer::Mat::from_fn(n, n, |i, j| m[(i, j)]);
    let factor = a.llt(Side::Lower).map_err(|_| LinearError::NotPositiveDefinite)?;
    let mut x = faer::Mat::from_fn(n, 1, |i, _| b[i]);
    faer::linalg::solvers::Solve::solve_in_place(&factor, x.as_mut());
    Ok(DVector::from_fn(n, |i, _| x[(i, 0)]))
}

/// Computes a basis (not orthogonal) of the null space of an `R × C` matrix of full rank `R`: `K = C − R` vectors.
///
/// Gauss–Jordan elimination, each row with its largest entry as the pivot; `None` where a pivot is below `1e-9` of its
/// row's largest entry (rank below `R`). About R²C multiplications, for the minimal solvers.
#[inline(always)]
pub fn null_space<const R: usize, const C: usize, const K: usize>(mut rows: [[f64; C]; R]) -> Option<[[f64; C]; K]> {
    const { assert!(R + K == C, "a full-rank R x C matrix has a null space of dimension C - R") };
    const PIVOT_TOLERANCE: f64 = 1e-9;
    let mut pivots = [0usize; R];
    let sizes: [f64; R] = std::array::from_fn(|r| rows[r].iter().fold(0.0f64, |m, v| m.max(v.abs())));
    for r in 0..R {
        // Pivot columns are zero in later rows.
        let mut column = 0;
        let mut largest = 0.0;
        for (c, v) in rows[r].iter().enumerate() {
            if v.abs() > largest {
                (column, largest) = (c, v.abs());
            }
        }
        // Also where the row has a NaN.
        if largest.is_nan() || largest <= PIVOT_TOLERANCE * sizes[r] {
            return None;
        }
        pivots[r] = column;
        let inverse = 1.0 / rows[r][column];
        let mut pivot_row = rows[r];
        for v in &mut pivot_row {
            *v *= inverse;
        }
        pivot_row[column] = 1.0;
        rows[r] = pivot_row;
        for (other, row) in rows.iter_mut().enumerate() {
            if other != r {
                let factor = row[column];
                for (v, p) in row.iter_mut().zip(&pivot_row) {
                    *v -= factor * p;
                }
                row[column] = 0.0;
            }
        }
    }
    let mut basis = [[0.0; C]; K];
    let mut free = (0..C).filter(|c| !pivots.contains(c));
    for vector in &mut basis {
        let column = free.next()?;
        vector[column] = 1.0;
        for (row, pivot) in rows.iter().zip(pivots) {
            vector[pivot] = -row[column];
        }
    }
    Some(basis)
}
