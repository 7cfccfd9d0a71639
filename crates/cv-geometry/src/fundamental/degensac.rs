//! Recovery from samples that lie on one plane (Chum, Werner & Matas, "Two-view geometry estimation unaffected by a
//! dominant plane", 2005).

use crate::epipolar::second_epipole;
use crate::homography::refine_on_plane;
use crate::match_blocks::below;
use cv_core::{Matrix3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Of seven points of which five are on a plane, one of these triples is on it.
const TRIPLES: [[usize; 3]; 5] = [[0, 1, 2], [3, 4, 5], [0, 1, 6], [3, 4, 6], [2, 5, 6]];
/// Distance from the plane's homography up to which a point is taken to lie on it, in thresholds: two coordinates in two images where
/// the epipolar distance has one, with a margin.
const ON_PLANE: f64 = 3.0;
/// Pairs of points off the plane that are tried.
const PAIRS: usize = 200;

/// Appends fundamental matrices made of the plane's homography and two points off it, where five points of the sample are on a plane.
pub(super) fn alternatives(
    pairs: &[[f64; 4]],
    f: &Matrix3<f64>,
    sample: &[u32],
    threshold: f64,
    models: &mut Vec<Matrix3<f64>>,
) {
    let Some(h) = degenerate_plane(pairs, f, sample, ON_PLANE * threshold) else { return };
    let limit = ON_PLANE * threshold;
    let h = refine_on_plane(pairs, &h, limit);
    let lines: Vec<Vector3<f64>> = pairs
        .iter()
        .filter(|p| transfer2(&h, p) > limit * limit)
        .map(|p| (h * Vector3::new(p[0], p[1], 1.0)).cross(&Vector3::new(p[2], p[3], 1.0)))
        .collect();
    let n = lines.len();
    if n < 2 {
        return;
    }
    let mut push = |i: usize, j: usize| {
        // Both lines go through the epipole.
        let e = lines[i].cross(&lines[j]);
        let f = e.cross_matrix() * h;
        let norm = f.norm();
        if norm > 0.0 {
            models.push(f / norm);
        }
    };
    if n * (n - 1) / 2 <= PAIRS {
        for i in 0..n {
            for j in 0..i {
                push(i, j);
            }
        }
    } else {
        let mut rng = ChaCha8Rng::seed_from_u64(n as u64);
        for _ in 0..PAIRS {
            let i = below(&mut rng, n as u32) as usize;
            let j = (i + 1 + below(&mut rng, n as u32 - 1) as usize) % n;
            push(i, j);
        }
    }
}

/// A homography compatible with `f` that at least five points of the sample obey.
fn degenerate_plane(pairs: &[[f64; 4]], f: &Matrix3<f64>, sample: &[u32], limit: f64) -> Option<Matrix3<f64>> {
    let e = second_epipole(f).normalize();
    let a = e.cross_matrix() * f;
    for triple in TRIPLES {
        let Some(h) = plane_of_three(&a, &e, triple.map(|i| &pairs[sample[i] as usize])) else { continue };
        let on = sample.iter().filter(|&&i| transfer2(&h, &pairs[i as usize]) < limit * limit).count();
        if on >= 5 {
            return Some(h);
        }
    }
    None
}

/// The homography of the plane through three matches that obeys the epipolar geometry (Hartley & Zisserman, result 13.6).
fn plane_of_three(a: &Matrix3<f64>, e: &Vector3<f64>, three: [&[f64; 4]; 3]) -> Option<Matrix3<f64>> {
    let first = |p: &[f64; 4]| Vector3::new(p[0], p[1], 1.0);
    let second = |p: &[f64; 4]| Vector3::new(p[2], p[3], 1.0);
    let m = Matrix3::from_rows(&three.map(|p| first(p).transpose()));
    let b = Vector3::from_iterator(three.iter().map(|p| {
        let across = second(p).cross(e);
        second(p).cross(&(a * first(p))).dot(&across) / across.norm_squared()
    }));
    let h = a - e * (m.try_inverse()? * b).transpose();
    h.iter().all(|v| v.is_finite()).then_some(h)
}

/// Squared distance in the second image from where `h` sends the point.
fn transfer2(h: &Matrix3<f64>, p: &[f64; 4]) -> f64 {
    let q = h * Vector3::new(p[0], p[1], 1.0);
    let (dx, dy) = (q.x / q.z - p[2], q.y / q.z - p[3]);
    dx * dx + dy * dy
}
