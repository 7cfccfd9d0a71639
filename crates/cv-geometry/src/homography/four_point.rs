//! Homography from four points, in closed form.

use cv_core::{Matrix3, Point2, Vector3};

/// Computes the homography that maps four points `a` to four points `b`, up to scale.
///
/// `None` if three points of an image are collinear (an area below `1e-9` of the squared extent), or if the
/// orientations of the point triples differ, which no pair of views of a plane allows (Chum, Werner & Matas, "Epipolar
/// geometry estimation via RANSAC benefits from the oriented epipolar constraint", 2004, applied to homographies).
///
/// Each image's points are expressed in the projective basis of the first three (Heckbert 1989; Hartley & Zisserman,
/// §2.3): about 150 multiplications, no matrix decomposition.
#[inline]
pub fn homography_four_point(a: &[Point2<f64>; 4], b: &[Point2<f64>; 4]) -> Option<Matrix3<f64>> {
    let (la, da, size_a) = barycentric_coordinates(a);
    let (lb, db, size_b) = barycentric_coordinates(b);
    const COLLINEAR: f64 = 1e-9;
    let (ea, eb) = (COLLINEAR * size_a, COLLINEAR * size_b);
    let is_nondegenerate = |l: &[f64; 3], d: f64, e: f64| d.abs() > e && l.iter().all(|v| v.abs() > e);
    if !(is_nondegenerate(&la, da, ea) && is_nondegenerate(&lb, db, eb)) {
        return None;
    }
    // Relative to the first triangle, so that a mirrored image is accepted.
    if (0..3).any(|i| (la[i] * da > 0.0) != (lb[i] * db > 0.0)) {
        return None;
    }
    // H = Σ b_i (λb_i / λa_i) (a_j × a_k)ᵀ; the ratio of the determinants is a common scale.
    let mut h = Matrix3::zeros();
    for i in 0..3 {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        let row = Vector3::new(a[j].y - a[k].y, a[k].x - a[j].x, a[j].x * a[k].y - a[k].x * a[j].y);
        let s = lb[i] / la[i];
        let (x, y) = (b[i].x * s, b[i].y * s);
        for c in 0..3 {
            h[(0, c)] += x * row[c];
            h[(1, c)] += y * row[c];
            h[(2, c)] += s * row[c];
        }
    }
    Some(h)
}

/// Computes the (unnormalized) barycentric coordinates of the fourth point with respect to the first three, their sum
/// (twice the area of the triangle), and the squared extent of the points.
#[inline]
fn barycentric_coordinates(p: &[Point2<f64>; 4]) -> ([f64; 3], f64, f64) {
    let area = |a: Point2<f64>, b: Point2<f64>, c: Point2<f64>| (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    let l = [area(p[3], p[1], p[2]), area(p[0], p[3], p[2]), area(p[0], p[1], p[3])];
    let size = (1..4).map(|i| (p[i] - p[0]).norm_squared()).fold(0.0, f64::max);
    // The sum is the area of the first triangle.
    (l, l[0] + l[1] + l[2], size)
}
