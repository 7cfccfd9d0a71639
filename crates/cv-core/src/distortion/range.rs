//! The range in which a lens model is monotonic.
//!
//! Beyond the first turning point of its radial function a lens model folds back: rays far from the axis project into the image a
//! second time. The turning point is the first positive root of a polynomial ([`Lens::monotonicity_polynomial`]). It is isolated in the
//! Bernstein basis: an interval without a negative coefficient has no root inside, any other is bisected (Farin, "Curves and Surfaces
//! for CAGD", 4.3 and 6.10). Exact up to rounding; the usual case of no root costs a few additions.

use std::f64::consts::FRAC_PI_2;

use nalgebra::Point2;

use super::lens::{Lens, LensProjection, Parameters};
use super::terms::squared_radius;

/// Maximum number of coefficients of [`Lens::monotonicity_polynomial`].
const MAX_COEFFICIENTS: usize = 10;
/// Maximum bisections of an interval: the mantissa bits of an `f64`.
const MAX_BISECTIONS: u32 = 52;

/// Reciprocals of the binomial coefficients, `[n][i]`.
const INVERSE_BINOMIALS: [[f64; MAX_COEFFICIENTS]; MAX_COEFFICIENTS] = {
    let mut out = [[0.0; MAX_COEFFICIENTS]; MAX_COEFFICIENTS];
    let mut n = 0;
    while n < MAX_COEFFICIENTS {
        let (mut i, mut binomial) = (0, 1);
        while i <= n {
            out[n][i] = 1.0 / binomial as f64;
            binomial = binomial * (n - i) / (i + 1);
            i += 1;
        }
        n += 1;
    }
    out
};

/// Whether a polynomial, positive at 0, has no root in `0 ..= x`.
#[inline(always)]
fn is_positive_up_to(c: &[f64], x: f64) -> bool {
    let n = c.len() - 1;
    // The sum of the negative terms decreases monotonically, so its value at x bounds the polynomial from below on 0 ..= x. This
    // decides most points.
    if c[0] + x * c[1..].iter().rev().fold(0.0, |sum, &c| sum * x + if c > 0.0 { 0.0 } else { c }) > 0.0 {
        return true;
    }
    let mut b = [0.0; MAX_COEFFICIENTS];
    let mut power = 1.0;
    for (i, c) in c.iter().enumerate() {
        b[i] = c * power * INVERSE_BINOMIALS[n][i];
        power *= x;
    }
    to_bernstein(&mut b, n);
    if b[..=n].iter().all(|v| *v > 0.0) {
        return true;
    }
    // The last coefficient is the value at x.
    b[n] > 0.0 && first_root(b, n, (0.0, 1.0), MAX_BISECTIONS).is_none()
}

/// Finds the first positive root of a polynomial that is positive at 0.
fn first_positive_root(c: &[f64]) -> Option<f64> {
    let n = c.iter().rposition(|v| *v != 0.0)?;
    // x = t/(1 − t): (1 − t)ⁿ times the polynomial has these Bernstein coefficients over t in 0 … 1.
    let mut b = [0.0; MAX_COEFFICIENTS];
    for i in 0..=n {
        b[i] = c[i] * INVERSE_BINOMIALS[n][i];
    }
    if b.iter().any(|v| v.is_nan()) {
        return Some(0.0);
    }
    first_root(b, n, (0.0, 1.0), MAX_BISECTIONS).map(|t| t / (1.0 - t))
}

/// Converts monomial coefficients on 0 … 1, each divided by its binomial, to the Bernstein basis.
#[inline(always)]
fn to_bernstein(b: &mut [f64; MAX_COEFFICIENTS], n: usize) {
    for pass in 1..=n {
        for j in (pass..=n).rev() {
            b[j] += b[j - 1];
        }
    }
}

/// Finds the first root, by recursive bisection, of a polynomial given by its Bernstein coefficients over `low ..= high` and positive
/// at `low`.
fn first_root(b: [f64; MAX_COEFFICIENTS], n: usize, (low, high): (f64, f64), depth: u32) -> Option<f64> {
    if b[..=n].iter().all(|v| *v >= 0.0) {
        return (b[n] == 0.0).then_some(high);
    }
    let middle = 0.5 * (low + high);
    if depth == 0 {
        return Some(middle);
    }
    // De Casteljau subdivision: the triangle's left side is the left half's coefficients, the last row the right half's.
    let (mut left, mut right) = ([0.0; MAX_COEFFICIENTS], b);
    for (i, end) in left[..=n].iter_mut().enumerate() {
        *end = right[0];
        for j in 0..n - i {
            right[j] = 0.5 * (right[j] + right[j + 1]);
        }
    }
    first_root(left, n, (low, middle), depth - 1).or_else(|| first_root(right, n, (middle, high), depth - 1))
}

/// Whether a lens is monotonic from the axis to an undistorted point: its radial terms by their polynomial, all terms by the
/// `determinant` of the Jacobian at the point.
#[inline(always)]
pub(super) fn is_in_range<L: Lens>(k: &Parameters, p: Point2<f64>, determinant: f64) -> bool {
    let r2 = squared_radius(p);
    let polynomial = L::monotonicity_polynomial(k);
    let positive = |x: f64| is_positive_up_to(polynomial.as_ref(), x);
    determinant > 0.0
        && match L::INFO.projection {
            LensProjection::Perspective => positive(r2),
            // A fisheye that is monotonic up to 90° needs no arc tangent.
            LensProjection::Fisheye => {
                r2.is_finite() && (positive(FRAC_PI_2.powi(2)) || positive(r2.sqrt().atan().powi(2)))
            }
        }
}

/// Computes the radius (perspective) or angle (fisheye) up to which the radial terms are monotonic; infinity where they are everywhere.
pub(super) fn radial_limit<L: Lens>(k: &Parameters) -> f64 {
    first_positive_root(L::monotonicity_polynomial(k).as_ref()).map_or(f64::INFINITY, f64::sqrt)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn first_root_of_polynomials_with_known_roots() {
        // (1 − x/2)(1 − x/3)(1 + x): 2 comes first.
        let c = [1.0, 1.0 / 6.0, -2.0 / 3.0, 1.0 / 6.0];
        // Halving stops at the last bit of t = x/(1 + x).
        assert!((first_positive_root(&c).unwrap() - 2.0).abs() < 1e-14);
        assert!(is_positive_up_to(&c, 1.999999) && !is_positive_up_to(&c, 2.000001) && !is_positive_up_to(&c, 3.5));
        assert_eq!(first_positive_root(&[1.0, 0.0, 2.0, 0.0]), None);
        assert!(is_positive_up_to(&[1.0, 0.0, 2.0, 0.0], 1e6));
        assert!(!is_positive_up_to(&[1.0, f64::NAN], 1.0));
    }

    proptest! {
        #[test]
        fn the_first_root_is_the_first_sign_change_of_a_dense_scan(c in prop::collection::vec(-2.0..2.0f64, 1..MAX_COEFFICIENTS)) {
            let c: Vec<f64> = std::iter::once(1.0).chain(c).collect();
            let value = |x: f64| c.iter().rev().fold(0.0, |v, c| v * x + c);
            let step = 1e-3;
            let scanned = (1..5000).map(|i| f64::from(i) * step).find(|x| value(*x) <= 0.0);
            let found = first_positive_root(&c).unwrap_or(f64::INFINITY);
            match scanned {
                // The scan misses two roots within one step; the exact search then returns an earlier root.
                Some(x) => prop_assert!(found <= x + 1e-9, "{found} {x}"),
                None => prop_assert!(found > 4.99 || value(found).abs() < 1e-9, "{found}"),
            }
            prop_assert!(found.is_infinite() || value(found).abs() < 1e-9 * (1.0 + found.powi(9)), "{found}");
            for x in [0.3, 1.0, 2.5] {
                prop_assert_eq!(is_positive_up_to(&c, x), found > x);
            }
        }
    }
}
