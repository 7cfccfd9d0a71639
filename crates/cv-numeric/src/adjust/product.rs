//! Products of the small matrices that normal equations are summed of. Not generic over the residuals, so that they are compiled once, here: of sizes that are
//! known where they are frequent, so that the sums stay in vector registers.

/// `out[c * height + a] += Σ_r left[r][a] · right[r][c]`, where `left` and `right` are columns (the first, and how many) of the same rows, which are `stride` long.
pub(super) fn add_product(
    (rows, stride): (&[f64], usize),
    (left, lefts): (usize, usize),
    (right, rights): (usize, usize),
    out: &mut [f64],
    height: usize,
) {
    if rows.len() == 2 * stride {
        let (above, below) = rows.split_at(stride);
        let (xs, ys) = (&above[right..][..rights], &below[right..][..rights]);
        let (above, below) = (&above[left..][..lefts], &below[left..][..lefts]);
        match lefts {
            2 => return add_two::<2>([above, below], [xs, ys], out, height),
            3 => return add_two::<3>([above, below], [xs, ys], out, height),
            4 => return add_two::<4>([above, below], [xs, ys], out, height),
            5 => return add_two::<5>([above, below], [xs, ys], out, height),
            6 => return add_two::<6>([above, below], [xs, ys], out, height),
            8 => return add_two::<8>([above, below], [xs, ys], out, height),
            _ => {}
        }
    }
    for c in 0..rights {
        let out = &mut out[c * height..][..lefts];
        for row in rows.chunks_exact(stride) {
            let x = row[right + c];
            for (o, l) in out.iter_mut().zip(&row[left..][..lefts]) {
                *o += l * x;
            }
        }
    }
}

/// Two rows, of `L` columns on the left.
#[inline(always)]
fn add_two<const L: usize>([above, below]: [&[f64]; 2], [xs, ys]: [&[f64]; 2], out: &mut [f64], height: usize) {
    let (mut a, mut b) = ([0.0; L], [0.0; L]);
    a.copy_from_slice(above);
    b.copy_from_slice(below);
    for (c, (x, y)) in xs.iter().zip(ys).enumerate() {
        let out = &mut out[c * height..][..L];
        for i in 0..L {
            out[i] = (out[i] + a[i] * x) + b[i] * y;
        }
    }
}

/// `y[c] = V⁻¹ w[·][c]` of `E` rows `w` of as many numbers as there are in `y`, one after the other.
#[inline(always)]
pub(super) fn times_inverse<const E: usize>(inverse: &[[f64; E]; E], w: &[f64], y: &mut [[f64; E]]) {
    let mut rows = [&w[..0]; E];
    let size = y.len();
    for (k, row) in rows.iter_mut().enumerate() {
        *row = &w[k * size..][..size];
    }
    for (c, y) in y.iter_mut().enumerate() {
        for (y, inverse) in y.iter_mut().zip(inverse) {
            let mut sum = 0.0;
            for (row, factor) in rows.iter().zip(inverse) {
                sum += factor * row[c];
            }
            *y = sum;
        }
    }
}

/// `out[c * height + a] −= Σ_k wide[k][a] · y[c][k]`, of `E` rows `wide`, one after the other.
#[inline(always)]
pub(super) fn subtract_product<const E: usize>(wide: &[f64], y: &[[f64; E]], out: &mut [f64], height: usize) {
    match wide.len() / E {
        5 => subtract_rows::<E, 5>(wide, y, out, height),
        6 => subtract_rows::<E, 6>(wide, y, out, height),
        8 => subtract_rows::<E, 8>(wide, y, out, height),
        size => {
            for (c, y) in y.iter().enumerate() {
                let out = &mut out[c * height..][..size];
                for (row, y) in wide.chunks_exact(size).zip(y) {
                    for (o, w) in out.iter_mut().zip(row) {
                        *o -= w * y;
                    }
                }
            }
        }
    }
}

/// Rows of `A` numbers.
#[inline(always)]
fn subtract_rows<const E: usize, const A: usize>(wide: &[f64], y: &[[f64; E]], out: &mut [f64], height: usize) {
    let mut rows = [[0.0; A]; E];
    rows.as_flattened_mut().copy_from_slice(wide);
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
        for (count, lefts, rights) in [1, 2, 3].iter().flat_map(|r| (1..10).map(move |l| (*r, l, 1 + l * 5 % 7))) {
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
        for (size, columns) in (1..10).map(|size| (size, 1 + size * 5 % 7)) {
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
