//! How far a lens is monotonic.
//!
//! Beyond the first turning point of its radial function a lens model folds back: rays from far outside land inside the picture a
//! second time. Where the turning point lies is a question of a polynomial's first positive root ([`Lens::slope`]). It is answered in the
//! Bernstein basis: coefficients without a negative one have no root between, and what has one is halved (Farin, "Curves and Surfaces
//! for CAGD", 4.3 and 6.10). Both answers are exact up to rounding; the usual "none" costs a few additions.

use std::f64::consts::FRAC_PI_2;

use nalgebra::Point2;

use super::lens::{Lens, LensProjection, Parameters};
use super::terms::squared_radius;

/// The most coefficients of [`Lens::slope`].
const MAX: usize = 10;
/// Halvings of an interval: as many as a number has bits.
const DEPTH: u32 = 52;

/// One over the binomial coefficients of each degree.
const INVERSE_BINOMIALS: [[f64; MAX]; MAX] = {
    let mut out = [[0.0; MAX]; MAX];
    let mut n = 0;
    while n < MAX {
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
fn positive_up_to(c: &[f64], x: f64) -> bool {
    let n = c.len() - 1;
    // What the negative terms take away at the end, they do not take away before it. This is the whole answer for most points.
    if c[0] + x * c[1..].iter().rev().fold(0.0, |sum, &c| sum * x + if c > 0.0 { 0.0 } else { c }) > 0.0 {
        return true;
    }
    let mut b = [0.0; MAX];
    let mut power = 1.0;
    for (i, c) in c.iter().enumerate() {
        b[i] = c * power * INVERSE_BINOMIALS[n][i];
        power *= x;
    }
    to_bernstein(&mut b, n);
    if b[..=n].iter().all(|v| *v > 0.0) {
        return true;
    }
    // The last one is the value at x itself.
    b[n] > 0.0 && first_root(b, n, (0.0, 1.0), DEPTH).is_none()
}

/// The first positive root of a polynomial that is positive at 0.
fn first_positive_root(c: &[f64]) -> Option<f64> {
    let n = c.iter().rposition(|v| *v != 0.0)?;
    // x = t/(1 − t): (1 − t)ⁿ times the polynomial has these Bernstein coefficients over t in 0 … 1.
    let mut b = [0.0; MAX];
    for i in 0..=n {
        b[i] = c[i] * INVERSE_BINOMIALS[n][i];
    }
    if b.iter().any(|v| v.is_nan()) {
        return Some(0.0);
    }
    first_root(b, n, (0.0, 1.0), DEPTH).map(|t| t / (1.0 - t))
}

/// Coefficients of powers on 0 … 1, each divided by its binomial, to those of the Bernstein basis.
#[inline(always)]
fn to_bernstein(b: &mut [f64; MAX], n: usize) {
    for pass in 1..=n {
        for j in (pass..=n).rev() {
            b[j] += b[j - 1];
        }
    }
}

/// The first root of Bernstein coefficients over an interval at whose start they are positive.
fn first_root(b: [f64; MAX], n: usize, (low, high): (f64, f64), depth: u32) -> Option<f64> {
    if b[..=n].iter().all(|v| *v >= 0.0) {
        return (b[n] == 0.0).then_some(high);
    }
    let middle = 0.5 * (low + high);
    if depth == 0 {
        return Some(middle);
    }
    // De Casteljau: the triangle's left side belongs to the left half, what remains to the right one.
    let (mut left, mut right) = ([0.0; MAX], b);
    for (i, end) in left[..=n].iter_mut().enumerate() {
        *end = right[0];
        for j in 0..n - i {
            right[j] = 0.5 * (right[j] + right[j + 1]);
        }
    }
    first_root(left, n, (low, middle), depth - 1).or_else(|| first_root(right, n, (middle, high), depth - 1))
}

/// Whether a lens is monotonic from the axis to an ideal point: its radial part by its polynomial, the rest by its derivative there.
#[inline(always)]
pub(super) fn contains<L: Lens>(k: &Parameters, p: Point2<f64>, determinant: f64) -> bool {
    let r2 = squared_radius(p);
    let slope = L::slope(k);
    let positive = |x: f64| positive_up_to(slope.as_ref(), x);
    determinant > 0.0
        && match L::INFO.projection {
            LensProjection::Perspective => positive(r2),
            // A fisheye that is monotonic up to 90° needs no angle.
            LensProjection::Fisheye => {
                r2.is_finite() && (positive(FRAC_PI_2.powi(2)) || positive(r2.sqrt().atan().powi(2)))
            }
        }
}

/// Where the radial part stops to be monotonic, as a distance from the axis (perspective) or an angle (fisheye); infinity where it nowhere does.
pub(super) fn end<L: Lens>(k: &Parameters) -> f64 {
    first_positive_root(L::slope(k).as_ref()).map_or(f64::INFINITY, f64::sqrt)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn roots_that_are_known_by_construction() {
        // (1 − x/2)(1 − x/3)(1 + x): 2 comes first.
        let c = [1.0, 1.0 / 6.0, -2.0 / 3.0, 1.0 / 6.0];
        // Halving stops at the last bit of t = x/(1 + x).
        assert!((first_positive_root(&c).unwrap() - 2.0).abs() < 1e-14);
        assert!(positive_up_to(&c, 1.999999) && !positive_up_to(&c, 2.000001) && !positive_up_to(&c, 3.5));
        assert_eq!(first_positive_root(&[1.0, 0.0, 2.0, 0.0]), None);
        assert!(positive_up_to(&[1.0, 0.0, 2.0, 0.0], 1e6));
        assert!(!positive_up_to(&[1.0, f64::NAN], 1.0));
    }

    proptest! {
        #[test]
        fn the_first_root_is_where_a_scan_first_finds_a_change_of_sign(c in prop::collection::vec(-2.0..2.0f64, 1..MAX)) {
            let c: Vec<f64> = std::iter::once(1.0).chain(c).collect();
            let value = |x: f64| c.iter().rev().fold(0.0, |v, c| v * x + c);
            let step = 1e-3;
            let scanned = (1..5000).map(|i| f64::from(i) * step).find(|x| value(*x) <= 0.0);
            let found = first_positive_root(&c).unwrap_or(f64::INFINITY);
            match scanned {
                // Two roots within a step are seen by the exact search only: then it finds them before.
                Some(x) => prop_assert!(found <= x + 1e-9, "{found} {x}"),
                None => prop_assert!(found > 4.99 || value(found).abs() < 1e-9, "{found}"),
            }
            prop_assert!(found.is_infinite() || value(found).abs() < 1e-9 * (1.0 + found.powi(9)), "{found}");
            for x in [0.3, 1.0, 2.5] {
                prop_assert_eq!(positive_up_to(&c, x), found > x);
            }
        }
    }
}
