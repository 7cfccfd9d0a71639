//! Conditioning of null space bases for the minimal solvers.

/// Orthonormalizes a basis by the modified Gram–Schmidt method. The coefficients of the cubics are products of three
/// entries, so a badly conditioned basis loses three times its digits.
#[inline(always)]
pub(crate) fn orthonormalize<const N: usize>(basis: &mut [[f64; 9]; N]) {
    for i in 0..N {
        let (done, rest) = basis.split_at_mut(i);
        let v = &mut rest[0];
        for u in done.iter() {
            let dot: f64 = u.iter().zip(v.iter()).map(|(a, b)| a * b).sum();
            v.iter_mut().zip(u).for_each(|(a, b)| *a -= dot * b);
        }
        let inverse = 1.0 / v.iter().map(|a| a * a).sum::<f64>().sqrt();
        v.iter_mut().for_each(|a| *a *= inverse);
    }
}

/// Applies a Householder reflection with a fixed generic normal to a basis.
///
/// Elimination leaves ones and zeros. For regular motions and points (a rectified pair, forward motion, corners of a
/// grid), the solution may be one of its vectors or the sum of two. Its coordinates are then infinite, since the
/// solvers fix the coefficient of the last vector to 1.
#[inline(always)]
pub(crate) fn reflect_generic<const N: usize>(basis: &mut [[f64; 9]; N]) {
    const NORMAL: [f64; 4] = [0.7310585786, 0.3934693403, -0.5772156649, 0.9159655942];
    let squares: f64 = NORMAL[..N].iter().map(|x| x * x).sum();
    for i in 0..9 {
        let projection: f64 = basis.iter().zip(NORMAL).map(|(b, x)| b[i] * x).sum::<f64>() * (2.0 / squares);
        basis.iter_mut().zip(NORMAL).for_each(|(b, x)| b[i] -= projection * x);
    }
}
