//! Radial, tangential, rational and thin prism terms of the lens models, and their derivatives.

use nalgebra::{Matrix2, Point2, Vector2};

use super::lens::{Distorted, ParameterJacobian};

#[inline(always)]
pub(super) fn squared_radius(p: Point2<f64>) -> f64 {
    p.x * p.x + p.y * p.y
}

/// Evaluates `1 + k₁ r² + k₂ r⁴ + …` and its derivative by r².
#[inline(always)]
pub(super) fn radial_polynomial<const N: usize>(k: [f64; N], r2: f64) -> (f64, f64) {
    let last = N - 1;
    let (mut value, mut derivative) = (k[last], (last + 1) as f64 * k[last]);
    for i in (0..last).rev() {
        value = k[i] + r2 * value;
        derivative = (i + 1) as f64 * k[i] + r2 * derivative;
    }
    (1.0 + r2 * value, derivative)
}

/// Computes `p g(r²)` and its Jacobian, given the factor g and its derivative by r².
#[inline(always)]
pub(super) fn apply_radial_factor(p: Point2<f64>, (g, dg): (f64, f64)) -> Distorted {
    let (x, y) = (p.x, p.y);
    let off_diagonal = 2.0 * x * y * dg;
    (Point2::new(x * g, y * g), Matrix2::new(g + 2.0 * x * x * dg, off_diagonal, off_diagonal, g + 2.0 * y * y * dg))
}

/// Sets `count` columns from `first`: the derivatives of `p · scale · (k₁ r² + k₂ r⁴ + …)` by the k.
#[inline(always)]
pub(super) fn set_radial_columns(
    out: &mut ParameterJacobian,
    first: usize,
    count: usize,
    p: Point2<f64>,
    r2: f64,
    scale: f64,
) {
    let mut column = p.coords * (r2 * scale);
    for i in first..first + count {
        out.set_column(i, &column);
        column *= r2;
    }
}

/// Adds the tangential terms `(2 p₁xy + p₂(r² + 2x²), p₁(r² + 2y²) + 2 p₂xy)`.
#[inline(always)]
pub(super) fn add_tangential((q, j): &mut Distorted, p: Point2<f64>, r2: f64, [p1, p2]: [f64; 2]) {
    let (x, y) = (p.x, p.y);
    q.x += 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
    q.y += p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
    let off_diagonal = 2.0 * p1 * x + 2.0 * p2 * y;
    j[(0, 0)] += 2.0 * p1 * y + 6.0 * p2 * x;
    j[(0, 1)] += off_diagonal;
    j[(1, 0)] += off_diagonal;
    j[(1, 1)] += 6.0 * p1 * y + 2.0 * p2 * x;
}

/// Sets the columns of p₁ and p₂.
#[inline(always)]
pub(super) fn set_tangential_columns(out: &mut ParameterJacobian, first: usize, p: Point2<f64>, r2: f64) {
    let off_diagonal = 2.0 * p.x * p.y;
    out.set_column(first, &Vector2::new(off_diagonal, r2 + 2.0 * p.y * p.y));
    out.set_column(first + 1, &Vector2::new(r2 + 2.0 * p.x * p.x, off_diagonal));
}

/// Adds the thin prism terms `(s₁r² + s₂r⁴, s₃r² + s₄r⁴)`.
#[inline(always)]
pub(super) fn add_prism((q, j): &mut Distorted, p: Point2<f64>, r2: f64, s: [f64; 4]) {
    for (axis, s) in [[s[0], s[1]], [s[2], s[3]]].into_iter().enumerate() {
        q[axis] += r2 * (s[0] + r2 * s[1]);
        let by_r2 = s[0] + 2.0 * r2 * s[1];
        j[(axis, 0)] += 2.0 * p.x * by_r2;
        j[(axis, 1)] += 2.0 * p.y * by_r2;
    }
}

/// Sets the columns of s₁ to s₄.
#[inline(always)]
pub(super) fn set_prism_columns(out: &mut ParameterJacobian, first: usize, r2: f64) {
    let columns =
        [Vector2::new(r2, 0.0), Vector2::new(r2 * r2, 0.0), Vector2::new(0.0, r2), Vector2::new(0.0, r2 * r2)];
    for (i, column) in columns.iter().enumerate() {
        out.set_column(first + i, column);
    }
}

/// A rational factor `N(r²)/D(r²)`.
pub(super) struct Rational {
    /// The factor and its derivative by r².
    pub(super) factor: (f64, f64),
    /// `1/D`.
    pub(super) inverse: f64,
}

#[inline(always)]
pub(super) fn rational_factor(numerator: [f64; 3], denominator: [f64; 3], r2: f64) -> Rational {
    let ((n, dn), (d, dd)) = (radial_polynomial(numerator, r2), radial_polynomial(denominator, r2));
    let inverse = 1.0 / d;
    let g = n * inverse;
    Rational { factor: (g, (dn - g * dd) * inverse), inverse }
}

/// Returns the polynomial in s = r² that vanishes where `r N(s)/D(s)` has a turning point or a pole: `((N + 2sN')D − 2sND')·D`.
pub(super) fn rational_monotonicity_polynomial(numerator: [f64; 3], denominator: [f64; 3]) -> [f64; 10] {
    let n = [1.0, numerator[0], numerator[1], numerator[2]];
    let d = [1.0, denominator[0], denominator[1], denominator[2]];
    let mut out = [0.0; 10];
    for (i, n) in n.iter().enumerate() {
        for (j, dj) in d.iter().enumerate() {
            let turn = n * dj * (1.0 + 2.0 * i as f64 - 2.0 * j as f64);
            for (l, dl) in d.iter().enumerate() {
                out[i + j + l] += turn * dl;
            }
        }
    }
    out
}
