//! Taking a lens's distortion out.

use nalgebra::{Point2, Vector2};

use super::lens::{Lens, LensProjection, Parameters};
use super::range;

const NOWHERE: Point2<f64> = Point2::new(f64::NAN, f64::NAN);
/// Steps of Newton's method; a lens as it is sold takes four to six.
const STEPS: usize = 20;
/// Steps of the bracketed search, each of which at least halves the bracket.
const HALVINGS: usize = 100;
/// Ten digits below the smallest sub-pixel quantity of any real lens.
const EXACT: f64 = 1e-13;
/// What is taken for the answer: at a turning point rounding leaves half of the digits.
const ENOUGH: f64 = 1e-9;

/// Distorted to ideal normalized coordinates; NaN where no ray within the lens's range lands there.
///
/// Newton's method from the distorted point finds the ideal one of nearly every lens. What it does not find is looked for along the
/// ray's direction, between the axis and the end of the lens's range, which cannot miss.
pub(super) fn undistort<L: Lens>(k: &Parameters, q: Point2<f64>) -> Point2<f64> {
    let start = match L::INFO.projection {
        LensProjection::Perspective => q,
        // The radius of a fisheye grows as tan θ: start from the inverse of the equidistant part.
        LensProjection::Fisheye => {
            let r = q.coords.norm();
            if r > 1e-12 { Point2::from(q.coords * (r.min(1.5).tan() / r)) } else { q }
        }
    };
    match newton::<L>(k, q, start, EXACT) {
        Some(p) => p,
        None => bracketed::<L>(k, q).and_then(|start| newton::<L>(k, q, start, ENOUGH)).unwrap_or(NOWHERE),
    }
}

/// Newton's method in the plane; `None` where it does not come to a residual of `enough` within the lens's range.
#[inline(always)]
fn newton<L: Lens>(k: &Parameters, q: Point2<f64>, mut p: Point2<f64>, enough: f64) -> Option<Point2<f64>> {
    let scale = 1.0 + q.coords.norm();
    let mut steps = 0;
    loop {
        let (d, j) = L::evaluate(k, p, None);
        let error: Vector2<f64> = d - q;
        let residual = error.norm();
        if residual < EXACT * scale || steps == STEPS {
            let found = residual < enough * scale && range::contains::<L>(k, p, j.determinant());
            return found.then_some(p);
        }
        let step = j.try_inverse()? * error;
        // Damped, so that a step never leaves the neighborhood where the model means something.
        let limit = 0.5 * (1.0 + p.coords.norm());
        let norm = step.norm();
        p -= if norm > limit { step * (limit / norm) } else { step };
        steps += 1;
    }
}

/// The ideal point in the direction of `q` whose distorted distance from the axis is that of `q`, or as near to it as the lens's range allows.
#[cold]
fn bracketed<L: Lens>(k: &Parameters, q: Point2<f64>) -> Option<Point2<f64>> {
    let distance = q.coords.norm();
    if !(distance > 0.0 && distance.is_finite()) {
        return None;
    }
    let direction = q.coords / distance;
    let fisheye = L::INFO.projection == LensProjection::Fisheye;
    let ideal = |u: f64| Point2::from(direction * if fisheye { u.tan() } else { u });
    let reached = |u: f64| L::evaluate(k, ideal(u), None).0.coords.dot(&direction);
    let end = range::end::<L>(k).min(if fisheye { std::f64::consts::FRAC_PI_2 } else { f64::INFINITY });
    let (mut low, mut high) = (0.0, end);
    if high.is_infinite() {
        high = distance;
        // Where 2⁶⁰ times as far is not enough, nothing is.
        while reached(high) < distance {
            high *= 2.0;
            if high > distance * (1u64 << 60) as f64 {
                return None;
            }
        }
    }
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        // A pole or an overflow counts as beyond.
        if reached(middle) < distance { low = middle } else { high = middle }
    }
    Some(ideal(low))
}
