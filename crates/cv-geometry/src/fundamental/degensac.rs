//! DEGENSAC: recovery from H-degenerate samples (Chum, Werner & Matas, "Two-view geometry estimation unaffected by a
//! dominant plane", 2005).

use crate::epipolar::second_epipole;
use crate::homography::refine_robustly;
use crate::match_blocks::{NormalizedMatches, random_below};
use cv_core::{Matrix3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// If five of seven points are on a plane, all points of at least one of these triples are.
const TRIPLES: [[usize; 3]; 5] = [[0, 1, 2], [3, 4, 5], [0, 1, 6], [3, 4, 6], [2, 5, 6]];
/// Inlier threshold of the plane's homography, in epipolar thresholds: the residual is two-dimensional, the epipolar
/// distance one-dimensional; with a margin.
const PLANE_THRESHOLD_RATIO: f64 = 3.0;
/// Maximum number of pairs of off-plane points that are tried (plane and parallax).
const MAX_PAIRS: usize = 200;

/// Appends the fundamental matrices of the plane's homography and two off-plane points (plane and parallax), if five
/// points of the sample are coplanar.
pub(super) fn alternatives(
    set: &NormalizedMatches,
    f: &Matrix3<f64>,
    sample: &[u32],
    threshold: f64,
    models: &mut Vec<Matrix3<f64>>,
) {
    let Some(h) = degenerate_plane(&set.pairs, f, sample, PLANE_THRESHOLD_RATIO * threshold) else { return };
    let limit = PLANE_THRESHOLD_RATIO * threshold;
    let h = refine_robustly(&set.pair_blocks, &h, limit);
    let parallax_lines: Vec<Vector3<f64>> = set
        .pairs
        .iter()
        .filter(|p| squared_transfer_error(&h, p) > limit * limit)
        .map(|p| (h * Vector3::new(p[0], p[1], 1.0)).cross(&Vector3::new(p[2], p[3], 1.0)))
        .collect();
    let n = parallax_lines.len();
    if n < 2 {
        return;
    }
    let mut push = |i: usize, j: usize| {
        // The lines intersect in the epipole.
        let e = parallax_lines[i].cross(&parallax_lines[j]);
        let f = e.cross_matrix() * h;
        let norm = f.norm();
        if norm > 0.0 {
            models.push(f / norm);
        }
    };
    if n * (n - 1) / 2 <= MAX_PAIRS {
        for i in 0..n {
            for j in 0..i {
                push(i, j);
            }
        }
    } else {
        let mut rng = ChaCha8Rng::seed_from_u64(n as u64);
        for _ in 0..MAX_PAIRS {
            let i = random_below(&mut rng, n as u32) as usize;
            let j = (i + 1 + random_below(&mut rng, n as u32 - 1) as usize) % n;
            push(i, j);
        }
    }
}

/// Finds a homography compatible with `f` of which at least five points of the sample are inliers.
fn degenerate_plane(pairs: &[[f64; 4]], f: &Matrix3<f64>, sample: &[u32], limit: f64) -> Option<Matrix3<f64>> {
    let e = second_epipole(f).normalize();
    let a = e.cross_matrix() * f;
    for triple in TRIPLES {
        let Some(h) = induced_homography(&a, &e, triple.map(|i| &pairs[sample[i] as usize])) else { continue };
        let inliers =
            sample.iter().filter(|&&i| squared_transfer_error(&h, &pairs[i as usize]) < limit * limit).count();
        if inliers >= 5 {
            return Some(h);
        }
    }
    None
}

/// Computes the homography compatible with the epipolar geometry that is induced by the plane through three matches
/// (Hartley & Zisserman, result 13.6).
fn induced_homography(a: &Matrix3<f64>, e: &Vector3<f64>, three: [&[f64; 4]; 3]) -> Option<Matrix3<f64>> {
    let first = |p: &[f64; 4]| Vector3::new(p[0], p[1], 1.0);
    let second = |p: &[f64; 4]| Vector3::new(p[2], p[3], 1.0);
    let m = Matrix3::from_rows(&three.map(|p| first(p).transpose()));
    let b = Vector3::from_iterator(three.iter().map(|p| {
        let normal = second(p).cross(e);
        second(p).cross(&(a * first(p))).dot(&normal) / normal.norm_squared()
    }));
    let h = a - e * (m.try_inverse()? * b).transpose();
    h.iter().all(|v| v.is_finite()).then_some(h)
}

/// Computes the squared transfer error in the second image.
fn squared_transfer_error(h: &Matrix3<f64>, p: &[f64; 4]) -> f64 {
    let q = h * Vector3::new(p[0], p[1], 1.0);
    let (dx, dy) = (q.x / q.z - p[2], q.y / q.z - p[3]);
    dx * dx + dy * dy
}
