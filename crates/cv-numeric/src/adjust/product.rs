//! Products of the small matrices that normal equations are summed of. Not generic over the residuals, so that they are compiled once, here: of sizes that are
//! known where they are frequent, so that the sums stay in vector registers.

/// Columns that are worked on at once.
const COLUMNS: usize = 8;

/// Calls a function that is generic over a number of columns from 1 to [`COLUMNS`].
macro_rules! of_size {
    ($size:expr, $function:ident::<$first:tt>, $arguments:tt) => {
        match $size {
            1 => $function::<$first, 1> $arguments,
            2 => $function::<$first, 2> $arguments,
            3 => $function::<$first, 3> $arguments,
            4 => $function::<$first, 4> $arguments,
            5 => $function::<$first, 5> $arguments,
            6 => $function::<$first, 6> $arguments,
            7 => $function::<$first, 7> $arguments,
            _ => $function::<$first, COLUMNS> $arguments,
        }
    };
}

/// `out[c * height + a] += Σ_r left[r][a] · right[r][c]`, where `left` and `right` are columns (the first, and how many) of the same rows, which are `stride` long.
pub(super) fn add_product(
    (rows, stride): (&[f64], usize),
    (left, lefts): (usize, usize),
    right: (usize, usize),
    out: &mut [f64],
    height: usize,
) {
    for from in (0..lefts).step_by(COLUMNS) {
        let out = &mut out[from..];
        for rows in rows.chunks(2 * stride) {
            let rows = (rows, stride);
            if rows.0.len() == 2 * stride {
                of_size!(lefts - from, add_rows::<2>, (rows, left + from, right, out, height));
            } else {
                of_size!(lefts - from, add_rows::<1>, (rows, left + from, right, out, height));
            }
        }
    }
}

/// `R` rows, of `L` columns on the left.
#[inline(always)]
fn add_rows<const R: usize, const L: usize>(
    (rows, stride): (&[f64], usize),
    left: usize,
    (right, rights): (usize, usize),
    out: &mut [f64],
    height: usize,
) {
    let (mut a, mut x) = ([[0.0; L]; R], [&rows[..0]; R]);
    for ((a, x), row) in a.iter_mut().zip(&mut x).zip(rows.chunks_exact(stride)) {
        a.copy_from_slice(&row[left..][..L]);
        *x = &row[right..][..rights];
    }
    for c in 0..rights {
        let out = &mut out[c * height..][..L];
        let mut sum = [0.0; L];
        sum.copy_from_slice(out);
        for (a, x) in a.iter().zip(&x) {
            for (sum, a) in sum.iter_mut().zip(a) {
                *sum += a * x[c];
            }
        }
        out.copy_from_slice(&sum);
    }
}

/// `y[c] = V⁻¹ w[·][c]` of `E` rows `w` of as many numbers as there are in `y`, one after the other.
#[inline(always)]
pub(super) fn times_inverse<const E: usize>(inverse: &[[f64; E]; E], w: &[f64], y: &mut [[f64; E]]) {
    let size = y.len();
    for from in (0..size).step_by(COLUMNS) {
        of_size!(size - from, times_rows::<E>, (inverse, &w[from..], size, &mut y[from..]));
    }
}

/// The first `A` numbers of rows that are `size` apart.
#[inline(always)]
fn times_rows<const E: usize, const A: usize>(inverse: &[[f64; E]; E], w: &[f64], size: usize, y: &mut [[f64; E]]) {
    let mut rows = [[0.0; A]; E];
    for (k, row) in rows.iter_mut().enumerate() {
        row.copy_from_slice(&w[k * size..][..A]);
    }
    let mut products = [[0.0; A]; E];
    for (product, inverse) in products.iter_mut().zip(inverse) {
        for (row, factor) in rows.iter().zip(inverse) {
            for (product, w) in product.iter_mut().zip(row) {
                *product += factor * w;
            }
        }
    }
    for (c, y) in y[..A].iter_mut().enumerate() {
        for (y, product) in y.iter_mut().zip(&products) {
            *y = product[c];
        }
    }
}

/// `out[c * height + a] −= Σ_k wide[k][a] · y[c][k]`, of `E` rows `wide`, one after the other.
#[inline(always)]
pub(super) fn subtract_product<const E: usize>(wide: &[f64], y: &[[f64; E]], out: &mut [f64], height: usize) {
    let size = wide.len() / E;
    for from in (0..size).step_by(COLUMNS) {
        of_size!(size - from, subtract_rows::<E>, (&wide[from..], size, y, &mut out[from..], height));
    }
}

/// The first `A` numbers of rows that are `size` apart.
#[inline(always)]
fn subtract_rows<const E: usize, const A: usize>(
    wide: &[f64],
    size: usize,
    y: &[[f64; E]],
    out: &mut [f64],
    height: usize,
) {
    let mut rows = [[0.0; A]; E];
    for (k, row) in rows.iter_mut().enumerate() {
        row.copy_from_slice(&wide[k * size..][..A]);
    }
    for (c, y) in y.iter().enumerate() {
        let out = &mut out[c * height..][..A];
        let mut sum = [0.0; A];
        sum.copy_from_slice(out);
        for (row, y) in rows.iter().zip(y) {
            for (sum, w) in sum.iter_mut().zip(row) {
                *sum -= w * y;
            }
        }
        out.copy_from_slice(&sum);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Small whole numbers, whose products and sums are exact in any order.
    fn numbers(n: usize, seed: usize) -> Vec<f64> {
        (0..n).map(|i| ((i * 37 + seed * 11 + i * i * 5) % 23) as f64 - 11.0).collect()
    }

    #[test]
    fn sums_of_every_size_are_those_of_the_definition() {
        for (count, lefts, rights) in [1, 2, 3].iter().flat_map(|r| (1..20).map(move |l| (*r, l, 1 + l * 5 % 7))) {
            let (stride, height) = (lefts + rights + 3, lefts + 2);
            let rows = numbers(count * stride, lefts);
            let before = numbers(rights * height, 3);
            let mut out = before.clone();
            let right = lefts + 2;
            add_product((&rows, stride), (1, lefts), (right, rights), &mut out, height);
            for (at, (out, before)) in out.iter().zip(&before).enumerate() {
                let (c, a) = (at / height, at % height);
                let sum: f64 = (0..count).map(|r| rows[r * stride + 1 + a] * rows[r * stride + right + c]).sum();
                assert_eq!(*out, before + if a < lefts { sum } else { 0.0 }, "{count} {lefts} {rights}: {c}, {a}");
            }
        }
    }

    #[test]
    fn differences_of_every_size_are_those_of_the_definition() {
        let inverse = [[2.0, -1.0, 3.0], [-1.0, 5.0, 4.0], [3.0, 4.0, -7.0]];
        for (size, columns) in (1..20).map(|size| (size, 1 + size * 5 % 7)) {
            let (wide, own, height) = (numbers(3 * size, 1), numbers(3 * columns, 2), size + 2);
            let before = numbers(columns * height, 3);
            let (mut out, mut y) = (before.clone(), vec![[0.0; 3]; columns]);
            times_inverse(&inverse, &own, &mut y);
            subtract_product(&wide, &y, &mut out, height);
            for (at, (out, before)) in out.iter().zip(&before).enumerate() {
                let (c, a) = (at / height, at % height);
                let pairs = (0..9).map(|i| (i / 3, i % 3));
                let sum = |a: usize| -> f64 {
                    pairs.map(|(k, l)| wide[k * size + a] * inverse[k][l] * own[l * columns + c]).sum()
                };
                assert_eq!(*out, before - if a < size { sum(a) } else { 0.0 }, "{size} {columns}: {c}, {a}");
            }
        }
    }
}
