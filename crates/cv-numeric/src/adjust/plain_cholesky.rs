//! Cholesky factor of a small dense matrix, by plain multiplications and additions in a fixed order: the same bytes on every processor, where a library that
//! fuses the two on those that can gives others.

/// `L` of `L Lᵀ`, by rows of `n` entries.
pub(super) struct PlainCholesky {
    n: usize,
    rows: Vec<f64>,
}

impl PlainCholesky {
    /// The factor of a symmetric matrix of rows of `n` entries, of which the lower triangle is read; `None` where it is not positive definite. O(n³/3).
    pub(super) fn new(n: usize, mut rows: Vec<f64>) -> Option<Self> {
        for i in 0..n {
            let (above, rest) = rows.split_at_mut(i * n);
            let row = &mut rest[..n];
            for (j, other) in above.chunks_exact(n).enumerate() {
                row[j] = (row[j] - dot(&row[..j], &other[..j])) / other[j];
            }
            let square = row[i] - dot(&row[..i], &row[..i]);
            if !square.is_finite() || square <= 0.0 {
                return None;
            }
            row[i] = square.sqrt();
        }
        Some(Self { n, rows })
    }

    /// Solves `L Lᵀ x = b` for as many right sides as there are, in place.
    pub(super) fn solve(&self, b: &mut [f64]) {
        for x in b.chunks_exact_mut(self.n) {
            for (i, row) in self.rows.chunks_exact(self.n).enumerate() {
                x[i] = (x[i] - dot(&row[..i], &x[..i])) / row[i];
            }
            for (i, row) in self.rows.chunks_exact(self.n).enumerate().rev() {
                let (before, rest) = x.split_at_mut(i);
                rest[0] /= row[i];
                before.iter_mut().zip(row).for_each(|(x, l)| *x -= l * rest[0]);
            }
        }
    }
}

/// Eight sums side by side, which the least vector unit can keep.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut sums = [0.0; 8];
    for (a, b) in a.iter().zip(b) {
        sums.iter_mut().zip(a).zip(b).for_each(|((sum, a), b)| *sum += a * b);
    }
    let rest: f64 = rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum();
    let [a, b, c, d, e, f, g, h] = sums;
    ((a + e) + (b + f)) + ((c + g) + (d + h)) + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `AᵀA + n I` of an `A` of small whole numbers, so that the matrix is exact.
    fn matrix(n: usize) -> Vec<f64> {
        let a = |i: usize, j: usize| ((i * 7 + j * 13 + i * j) % 11) as f64 - 5.0;
        let entry = |i, j| (0..n).map(|k| a(k, i) * a(k, j)).sum::<f64>() + if i == j { n as f64 } else { 0.0 };
        (0..n * n).map(|at| entry(at / n, at % n)).collect()
    }

    #[test]
    fn the_factor_times_its_transpose_is_the_matrix_and_solves() {
        for n in [1, 2, 7, 8, 9, 40] {
            let m = matrix(n);
            let factor = PlainCholesky::new(n, m.clone()).unwrap();
            let l = |i: usize, j: usize| if j <= i { factor.rows[i * n + j] } else { 0.0 };
            for i in 0..n {
                for j in 0..=i {
                    let product: f64 = (0..n).map(|k| l(i, k) * l(j, k)).sum();
                    // Rounding of n products of the size of the diagonal, some 50 n.
                    assert!((product - m[i * n + j]).abs() < 1e-13 * 50.0 * (n * n) as f64, "{n}: {i}, {j}");
                }
            }
            let truth: Vec<f64> = (0..2 * n).map(|i| i as f64 - 3.0).collect();
            let times = |x: &[f64], i: usize| (0..n).map(|j| m[i * n + j] * x[j]).sum::<f64>();
            let mut b: Vec<f64> =
                truth.chunks(n).flat_map(|x| (0..n).map(|i| times(x, i)).collect::<Vec<_>>()).collect();
            factor.solve(&mut b);
            // The condition is below 100 n: the identity is as large as that below the rest.
            assert!(b.iter().zip(&truth).all(|(b, x)| (b - x).abs() < 1e-11 * n as f64), "{n}: {b:?}");
        }
    }

    #[test]
    fn what_is_not_positive_definite_has_none() {
        assert!(PlainCholesky::new(2, vec![1.0, 0.0, 2.0, 4.0]).is_none());
        assert!(PlainCholesky::new(1, vec![0.0]).is_none());
        assert!(
            PlainCholesky::new(1, vec![f64::NAN]).is_none() && PlainCholesky::new(1, vec![f64::INFINITY]).is_none()
        );
        assert!(PlainCholesky::new(0, Vec::new()).is_some());
    }
}
