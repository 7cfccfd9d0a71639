//! Quadratic eigenvalue problems, and null vectors by LU decomposition.

use nalgebra::{DMatrix, DVector, Schur};

/// Maximum number of QR iterations; two or three per eigenvalue are usual.
const MAX_QR_ITERATIONS: usize = 1000;

/// Solves the quadratic eigenvalue problem: the real `w`, ascending, at which `C(w) = c[0] + w c[1] + w² c[2]` is singular, for square
/// matrices of one size.
///
/// Substitutes `w = shift + 1/μ`, so that infinite eigenvalues become `μ = 0` and are left out, and computes the eigenvalues of the
/// companion matrix of twice the size (Kukelova, Bujnak & Pajdla, "Polynomial eigenvalue solutions to minimal problems in computer
/// vision", PAMI 2012). `shift` must not be a solution. Eigenvalues whose imaginary part is below `1e-6` of their modulus count as real:
/// a double root splits into a pair with half of the digits. Empty where `C(shift)` is singular or an entry is not finite. O(n³).
pub fn real_quadratic_eigenvalues(c: [&DMatrix<f64>; 3], shift: f64) -> Vec<f64> {
    let n = c[0].nrows();
    let at_shift = c[0] + c[1] * shift + c[2] * (shift * shift);
    let derivative = c[1] + c[2] * (2.0 * shift);
    if !at_shift.iter().all(|v| v.is_finite()) {
        return Vec::new();
    }
    let lu = at_shift.lu();
    let (Some(a), Some(b)) = (lu.solve(&derivative), lu.solve(c[2])) else { return Vec::new() };
    let companion = DMatrix::from_fn(2 * n, 2 * n, |i, j| match (i < n, j < n) {
        (true, true) => -a[(i, j)],
        (true, false) => -b[(i, j - n)],
        (false, _) => f64::from(u8::from(j + n == i)),
    });
    if !companion.iter().all(|v| v.is_finite()) {
        return Vec::new();
    }
    let Some(schur) = Schur::try_new(companion, 1e-15, MAX_QR_ITERATIONS) else { return Vec::new() };
    let values = schur.complex_eigenvalues();
    let largest = values.iter().map(|v| v.norm()).fold(0.0, f64::max);
    let mut real: Vec<f64> = values
        .iter()
        .filter(|v| v.im.abs() <= 1e-6 * v.norm() && v.re.abs() > 1e-12 * largest)
        .map(|v| shift + 1.0 / v.re)
        .collect();
    real.sort_by(f64::total_cmp);
    real
}

/// Computes the unit null vector of a square matrix of numerical rank n − 1, by LU decomposition with full pivoting. `None` where the rank
/// is lower, or an entry is not finite. O(n³), faster than [`crate::null_vector`].
pub fn null_vector_lu(m: &DMatrix<f64>) -> Option<DVector<f64>> {
    let n = m.nrows();
    let lu = m.clone().full_piv_lu();
    let u = lu.u();
    let last = n.checked_sub(1)?;
    let mut v = DVector::zeros(n);
    v[last] = 1.0;
    for i in (0..last).rev() {
        let pivot = u[(i, i)];
        if pivot.is_nan() || pivot.abs() <= 1e-13 * u[(0, 0)].abs() {
            return None;
        }
        let sum: f64 = (i + 1..n).map(|j| u[(i, j)] * v[j]).sum();
        v[i] = -sum / pivot;
    }
    lu.q().inv_permute_rows(&mut v);
    let norm = v.norm();
    (norm.is_finite() && norm > 0.0).then(|| v / norm)
}
