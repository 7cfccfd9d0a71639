//! Products of the small matrices that accumulate normal equations. Not generic over the residuals, so that they are compiled only once;
//! tile sizes are compile-time constants, so that sums stay in vector registers.

/// Maximum number of left columns per tile.
const LEFT_TILE_COLUMNS: usize = 8;

/// Calls a function that is generic over a number of columns, 1 to [`LEFT_TILE_COLUMNS`].
macro_rules! dispatch_columns {
    ($size:expr, $function:ident::<$first:tt>, $arguments:tt) => {
        match $size {
            1 => $function::<$first, 1> $arguments,
            2 => $function::<$first, 2> $arguments,
            3 => $function::<$first, 3> $arguments,
            4 => $function::<$first, 4> $arguments,
            5 => $function::<$first, 5> $arguments,
            6 => $function::<$first, 6> $arguments,
            7 => $function::<$first, 7> $arguments,
            _ => $function::<$first, LEFT_TILE_COLUMNS> $arguments,
        }
    };
}

/// Accumulates `out[c * height + a] += Σ_r left[r][a] · right[r][c]`, where `left` and `right` are column ranges (first, count) of the
/// same rows of `stride` numbers. Rows are added in order, so that batching residuals does not change a bit.
pub(super) fn add_product(
    rows: (&[f64], usize),
    (left, left_count): (usize, usize),
    right: (usize, usize),
    out: &mut [f64],
    height: usize,
) {
    for from in (0..left_count).step_by(LEFT_TILE_COLUMNS) {
        let out = &mut out[from..];
        dispatch_columns!(
            left_count - from,
            add_product_tiles::<RIGHT_TILE_COLUMNS>,
            (rows, left + from, right, out, height)
        );
    }
}

/// Number of right columns per tile: enough independent sums to hide latency, few enough for sixteen registers of two numbers.
const RIGHT_TILE_COLUMNS: usize = 2;

/// Accumulates `L` left columns, `K` right columns at a time.
#[inline(always)]
fn add_product_tiles<const K: usize, const L: usize>(
    rows: (&[f64], usize),
    left: usize,
    (right, right_count): (usize, usize),
    out: &mut [f64],
    height: usize,
) {
    let whole = right_count - right_count % K;
    for c in (0..whole).step_by(K) {
        add_product_tile::<K, L>(rows, left, right + c, &mut out[c * height..], height);
    }
    for c in whole..right_count {
        add_product_tile::<1, L>(rows, left, right + c, &mut out[c * height..], height);
    }
}

#[inline(always)]
fn add_product_tile<const K: usize, const L: usize>(
    (rows, stride): (&[f64], usize),
    left: usize,
    right: usize,
    out: &mut [f64],
    height: usize,
) {
    let mut sums = [[0.0; L]; K];
    for (k, sum) in sums.iter_mut().enumerate() {
        sum.copy_from_slice(&out[k * height..][..L]);
    }
    for row in rows.chunks_exact(stride) {
        let (a, x) = (&row[left..][..L], &row[right..][..K]);
        for (sum, x) in sums.iter_mut().zip(x) {
            for (sum, a) in sum.iter_mut().zip(a) {
                *sum += a * x;
            }
        }
    }
    for (k, sum) in sums.iter().enumerate() {
        out[k * height..][..L].copy_from_slice(sum);
    }
}

/// Accumulates `out[a] += Σ_r left[r][a] · residuals[r]`, with `left` as in [`add_product`].
pub(super) fn add_gradient(
    rows: (&[f64], usize),
    (left, left_count): (usize, usize),
    residuals: &[f64],
    out: &mut [f64],
) {
    for from in (0..left_count).step_by(LEFT_TILE_COLUMNS) {
        dispatch_columns!(left_count - from, add_gradient_tile::<1>, (rows, left + from, residuals, &mut out[from..]));
    }
}

#[inline(always)]
fn add_gradient_tile<const ONE: usize, const L: usize>(
    (rows, stride): (&[f64], usize),
    left: usize,
    residuals: &[f64],
    out: &mut [f64],
) {
    let mut sum = [0.0; L];
    sum.copy_from_slice(&out[..L]);
    for (row, r) in rows.chunks_exact(stride).zip(residuals) {
        for (sum, a) in sum.iter_mut().zip(&row[left..][..L]) {
            *sum += a * r;
        }
    }
    out[..L].copy_from_slice(&sum);
}

/// Computes `y[c] = V⁻¹ w[·][c]` for `E` consecutive rows `w` of `y.len()` numbers each.
#[inline(always)]
pub(super) fn multiply_inverse<const E: usize>(inverse: &[[f64; E]; E], w: &[f64], y: &mut [[f64; E]]) {
    let size = y.len();
    for from in (0..size).step_by(LEFT_TILE_COLUMNS) {
        dispatch_columns!(size - from, multiply_inverse_tile::<E>, (inverse, &w[from..], size, &mut y[from..]));
    }
}

/// Processes the first `A` numbers of rows of stride `size`.
#[inline(always)]
fn multiply_inverse_tile<const E: usize, const A: usize>(
    inverse: &[[f64; E]; E],
    w: &[f64],
    size: usize,
    y: &mut [[f64; E]],
) {
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

/// Computes `out[c * height + a] −= Σ_k wide[k][a] · y[c][k]` for `E` consecutive rows `wide`.
#[inline(always)]
pub(super) fn subtract_product<const E: usize>(wide: &[f64], y: &[[f64; E]], out: &mut [f64], height: usize) {
    let size = wide.len() / E;
    for from in (0..size).step_by(LEFT_TILE_COLUMNS) {
        dispatch_columns!(size - from, subtract_product_tile::<E>, (&wide[from..], size, y, &mut out[from..], height));
    }
}

/// Processes the first `A` numbers of rows of stride `size`.
#[inline(always)]
fn subtract_product_tile<const E: usize, const A: usize>(
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

    /// Small integers, whose products and sums are exact in any order.
    fn numbers(n: usize, seed: usize) -> Vec<f64> {
        (0..n).map(|i| ((i * 37 + seed * 11 + i * i * 5) % 23) as f64 - 11.0).collect()
    }

    #[test]
    fn accumulated_products_equal_the_definition_for_every_size() {
        for (count, left_count, right_count) in
            [1, 2, 3].iter().flat_map(|r| (1..20).map(move |l| (*r, l, 1 + l * 5 % 7)))
        {
            let (stride, height) = (left_count + right_count + 3, left_count + 2);
            let rows = numbers(count * stride, left_count);
            let before = numbers(right_count * height, 3);
            let mut out = before.clone();
            let right = left_count + 2;
            add_product((&rows, stride), (1, left_count), (right, right_count), &mut out, height);
            for (at, (out, before)) in out.iter().zip(&before).enumerate() {
                let (c, a) = (at / height, at % height);
                let sum: f64 = (0..count).map(|r| rows[r * stride + 1 + a] * rows[r * stride + right + c]).sum();
                assert_eq!(
                    *out,
                    before + if a < left_count { sum } else { 0.0 },
                    "{count} {left_count} {right_count}: {c}, {a}"
                );
            }
            let residuals = numbers(count, 5);
            let mut out = before.clone();
            add_gradient((&rows, stride), (1, left_count), &residuals, &mut out);
            for (a, (out, before)) in out.iter().zip(&before).enumerate() {
                let times = |r: usize| if a < left_count { rows[r * stride + 1 + a] * residuals[r] } else { 0.0 };
                assert_eq!(*out, before + (0..count).map(times).sum::<f64>(), "{count} {left_count}: gradient, {a}");
            }
        }
    }

    #[test]
    fn subtracted_products_equal_the_definition_for_every_size() {
        let inverse = [[2.0, -1.0, 3.0], [-1.0, 5.0, 4.0], [3.0, 4.0, -7.0]];
        for (size, columns) in (1..20).map(|size| (size, 1 + size * 5 % 7)) {
            let (wide, own, height) = (numbers(3 * size, 1), numbers(3 * columns, 2), size + 2);
            let before = numbers(columns * height, 3);
            let (mut out, mut y) = (before.clone(), vec![[0.0; 3]; columns]);
            multiply_inverse(&inverse, &own, &mut y);
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
