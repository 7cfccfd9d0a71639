//! Undistortion of normalized points.

use nalgebra::{Point2, Vector2};

use super::lens::{Lens, LensProjection, Parameters};
use super::range;

const NO_RAY: Point2<f64> = Point2::new(f64::NAN, f64::NAN);
/// Maximum number of Newton steps; commercial lenses take four to six.
const MAX_NEWTON_STEPS: usize = 20;
/// Maximum number of bisection steps.
const MAX_BISECTIONS: usize = 100;
/// Relative residual at which Newton's method stops.
const RESIDUAL_TOLERANCE: f64 = 1e-13;
/// Relative residual accepted after bisection: near a turning point rounding leaves half of the digits.
const ACCEPTED_RESIDUAL: f64 = 1e-9;

/// Converts distorted to undistorted normalized coordinates; NaN where no ray within the lens's valid range maps to `q`.
///
/// Newton's method from the distorted point converges for nearly every lens. Where it does not, it restarts from a bisection of the
/// radius between the axis and the limit of the valid range.
pub(super) fn undistort<L: Lens>(k: &Parameters, q: Point2<f64>) -> Point2<f64> {
    let start = match L::INFO.projection {
        LensProjection::Perspective => q,
        // Start from the inverse of the equidistant projection without distortion.
        LensProjection::Fisheye => {
            let r = q.coords.norm();
            if r > 1e-12 { Point2::from(q.coords * (r.min(1.5).tan() / r)) } else { q }
        }
    };
    match solve_newton::<L>(k, q, start, RESIDUAL_TOLERANCE) {
        Some(p) => p,
        None => bisect_radius::<L>(k, q)
            .and_then(|start| solve_newton::<L>(k, q, start, ACCEPTED_RESIDUAL))
            .unwrap_or(NO_RAY),
    }
}

/// Solves `distort(p) = q` by Newton's method from `p`; `None` where the relative residual stays above `accepted` or the
/// solution is outside the lens's valid range.
#[inline(always)]
fn solve_newton<L: Lens>(k: &Parameters, q: Point2<f64>, mut p: Point2<f64>, accepted: f64) -> Option<Point2<f64>> {
    let scale = 1.0 + q.coords.norm();
    let mut steps = 0;
    loop {
        let (d, j) = L::evaluate(k, p, None);
        let error: Vector2<f64> = d - q;
        let residual = error.norm();
        if residual < RESIDUAL_TOLERANCE * scale || steps == MAX_NEWTON_STEPS {
            let is_solution = residual < accepted * scale && range::is_in_range::<L>(k, p, j.determinant());
            return is_solution.then_some(p);
        }
        let step = j.try_inverse()? * error;
        // Limit the step length, so that it stays in the neighborhood where the model is valid.
        let limit = 0.5 * (1.0 + p.coords.norm());
        let norm = step.norm();
        p -= if norm > limit { step * (limit / norm) } else { step };
        steps += 1;
    }
}

/// Finds by bisection the undistorted point in the direction of `q` whose distorted radius is that of `q`, or the nearest
/// radius within the lens's valid range.
#[cold]
fn bisect_radius<L: Lens>(k: &Parameters, q: Point2<f64>) -> Option<Point2<f64>> {
    let distance = q.coords.norm();
    if !(distance > 0.0 && distance.is_finite()) {
        return None;
    }
    let direction = q.coords / distance;
    let fisheye = L::INFO.projection == LensProjection::Fisheye;
    let ideal = |u: f64| Point2::from(direction * if fisheye { u.tan() } else { u });
    let distorted_radius = |u: f64| L::evaluate(k, ideal(u), None).0.coords.dot(&direction);
    let end = range::radial_limit::<L>(k).min(if fisheye { std::f64::consts::FRAC_PI_2 } else { f64::INFINITY });
    let (mut low, mut high) = (0.0, end);
    if high.is_infinite() {
        high = distance;
        // Bracket the root by doubling, up to 2⁶⁰ times the distorted radius.
        while distorted_radius(high) < distance {
            high *= 2.0;
            if high > distance * (1u64 << 60) as f64 {
                return None;
            }
        }
    }
    for _ in 0..MAX_BISECTIONS {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        // A pole or an overflow (NaN) counts as above the root.
        if distorted_radius(middle) < distance { low = middle } else { high = middle }
    }
    Some(ideal(low))
}
