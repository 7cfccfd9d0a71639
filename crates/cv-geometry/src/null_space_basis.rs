//! Bases of null spaces, as the minimal solvers want them.

/// Gram and Schmidt's method. The coefficients of the cubics are products of three entries: a basis of uneven lengths or small
/// angles costs three times its digits.
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

/// Reflects a basis at a plane that nothing else knows.
///
/// Elimination leaves ones and zeros. Where motion and points are regular (a rectified pair, a step ahead, corners of a grid), one of its vectors, or the
/// sum of two, may be the answer itself, which then has no finite coordinates in which another vector counts one.
#[inline(always)]
pub(crate) fn mix<const N: usize>(basis: &mut [[f64; 9]; N]) {
    const NORMAL: [f64; 4] = [0.7310585786, 0.3934693403, -0.5772156649, 0.9159655942];
    let squares: f64 = NORMAL[..N].iter().map(|x| x * x).sum();
    for i in 0..9 {
        let along: f64 = basis.iter().zip(NORMAL).map(|(b, x)| b[i] * x).sum::<f64>() * (2.0 / squares);
        basis.iter_mut().zip(NORMAL).for_each(|(b, x)| b[i] -= along * x);
    }
}
