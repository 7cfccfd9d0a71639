//! How far a result is from the truth, in the measures that results are judged by.

use cv_core::{GrayF32, Mask, Point2, Rotation3};
use nalgebra::{Matrix3, Vector3};

/// Mean distance in pixels between where two homographies send the four corners of a `width` × `height` picture, the
/// measure of HPatches (Balntas et al. 2017). Infinite where one sends a corner to infinity or is not finite.
pub fn homography_corner_error(estimate: &Matrix3<f64>, truth: &Matrix3<f64>, width: usize, height: usize) -> f64 {
    let (w, h) = (width as f64 - 1.0, height as f64 - 1.0);
    let sum: f64 = [(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)]
        .into_iter()
        .map(|(x, y)| match (apply(estimate, x, y), apply(truth, x, y)) {
            (Some(a), Some(b)) => (a - b).norm(),
            _ => f64::INFINITY,
        })
        .sum();
    sum / 4.0
}

/// A homography at a point; `None` where that is no finite point.
fn apply(h: &Matrix3<f64>, x: f64, y: f64) -> Option<Point2<f64>> {
    let q = h * Vector3::new(x, y, 1.0);
    let p = Point2::new(q.x / q.z, q.y / q.z);
    (p.x.is_finite() && p.y.is_finite()).then_some(p)
}

/// The angle in radians, 0 to π, of the turn that takes one rotation to the other.
pub fn rotation_error(estimate: &Rotation3<f64>, truth: &Rotation3<f64>) -> f64 {
    // The chord rather than the trace: the arc cosine has no digits left at small angles.
    let chord = (estimate.matrix() - truth.matrix()).norm() / 8f64.sqrt();
    2.0 * chord.min(1.0).asin()
}

/// The angle in radians, 0 to π, between two directions; π for a zero vector, which has none.
pub fn direction_error(estimate: &Vector3<f64>, truth: &Vector3<f64>) -> f64 {
    match (estimate.try_normalize(0.0), truth.try_normalize(0.0)) {
        (Some(a), Some(b)) => (a.cross(&b).norm()).atan2(a.dot(&b)),
        _ => std::f64::consts::PI,
    }
}

/// Which share of a depth map is right.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthScore {
    /// Pixels that count: visible, with a true depth under the limit.
    pub pixels: usize,
    /// Of those, the share whose estimate is within the tolerance.
    pub within: f64,
    /// Of those, the share that has an estimate at all.
    pub dense: f64,
}

/// The share of visible pixels with a true depth below `limit` meters whose estimate is within a share `tolerance` of
/// it. A pixel without an estimate counts as wrong. `None` where the sizes differ or no pixel counts.
pub fn depth_score(
    estimate: &GrayF32,
    truth: &GrayF32,
    visible: &Mask,
    limit: f32,
    tolerance: f32,
) -> Option<DepthScore> {
    if estimate.size() != truth.size() || truth.size() != visible.size() {
        return None;
    }
    let (mut pixels, mut right, mut dense) = (0, 0, 0);
    for ((e, t), v) in estimate.as_slice().iter().zip(truth.as_slice()).zip(visible.as_slice()) {
        if *v && *t < limit {
            pixels += 1;
            dense += usize::from(e.is_finite());
            right += usize::from((e - t).abs() <= tolerance * t);
        }
    }
    let share = |n: usize| n as f64 / pixels as f64;
    (pixels > 0).then(|| DepthScore { pixels, within: share(right), dense: share(dense) })
}

/// Precision, recall and their harmonic mean.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MaskScore {
    /// Pixels marked by both.
    pub both: usize,
    /// Pixels marked by the estimate only.
    pub estimate_only: usize,
    /// Pixels marked by the truth only.
    pub truth_only: usize,
}

impl MaskScore {
    /// Counts two masks against each other; `None` where their sizes differ.
    pub fn new(estimate: &Mask, truth: &Mask) -> Option<Self> {
        let mut score = Self::default();
        for (&e, &t) in estimate.as_slice().iter().zip(truth.as_slice()) {
            match (e, t) {
                (true, true) => score.both += 1,
                (true, false) => score.estimate_only += 1,
                (false, true) => score.truth_only += 1,
                (false, false) => {}
            }
        }
        (estimate.size() == truth.size()).then_some(score)
    }

    /// Both counted together, as over the pixels of several pictures.
    pub fn plus(self, other: Self) -> Self {
        Self {
            both: self.both + other.both,
            estimate_only: self.estimate_only + other.estimate_only,
            truth_only: self.truth_only + other.truth_only,
        }
    }

    /// The share of the estimate that is true; 1 where nothing was marked.
    pub fn precision(&self) -> f64 {
        ratio(self.both, self.both + self.estimate_only)
    }

    /// The share of the truth that was found; 1 where there was nothing to find.
    pub fn recall(&self) -> f64 {
        ratio(self.both, self.both + self.truth_only)
    }

    /// `2 · both / (estimate + truth)`; 1 where both are empty.
    pub fn f1(&self) -> f64 {
        ratio(2 * self.both, 2 * self.both + self.estimate_only + self.truth_only)
    }
}

fn ratio(part: usize, whole: usize) -> f64 {
    if whole == 0 { 1.0 } else { part as f64 / whole as f64 }
}

/// Root mean square in pixels, over the pixels of a 17 × 17 grid on a first picture that a second one of the same size
/// sees too, of the distance between where `estimate` and `truth` say that the second one sees them; infinite where the
/// estimate names no place. `None` where the pictures do not overlap.
pub fn alignment_error(
    estimate: impl Fn(Point2<f64>) -> Option<Point2<f64>>,
    truth: impl Fn(Point2<f64>) -> Option<Point2<f64>>,
    width: usize,
    height: usize,
) -> Option<f64> {
    let (mut sum, mut n) = (0.0, 0.0);
    let inside = |v: f64, n: usize| v >= 0.0 && v <= n as f64 - 1.0;
    for (i, j) in (0..17).flat_map(|j| (0..17).map(move |i| (i, j))) {
        let here = Point2::new(f64::from(i) / 16.0 * (width as f64 - 1.0), f64::from(j) / 16.0 * (height as f64 - 1.0));
        if let Some(there) = truth(here).filter(|p| inside(p.x, width) && inside(p.y, height)) {
            sum += estimate(here).map_or(f64::INFINITY, |p| (p - there).norm_squared());
            n += 1.0;
        }
    }
    (n > 0.0).then(|| (sum / n).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_are_those_that_were_put_in() {
        for angle in [0.0, 1e-9, 0.003, 1.0, 3.1] {
            let a = Rotation3::from_euler_angles(0.3, -0.5, 0.2);
            let axis = nalgebra::Unit::new_normalize(Vector3::new(1.0, 2.0, -0.5));
            let b = a * Rotation3::from_axis_angle(&axis, angle);
            // The arc sine is steep near π: 1e-16 in the chord is 1e-14 there.
            assert!((rotation_error(&a, &b) - angle).abs() < 1e-13, "{angle}");
            let v = Vector3::new(angle.cos(), angle.sin(), 0.0);
            assert!((direction_error(&(2.0 * v), &(3.0 * Vector3::x())) - angle).abs() < 1e-15);
        }
        assert_eq!(direction_error(&Vector3::zeros(), &Vector3::x()), std::f64::consts::PI);
    }

    #[test]
    fn a_shift_is_its_length_at_every_corner() {
        let shift = Matrix3::new(1.0, 0.0, 3.0, 0.0, 1.0, 4.0, 0.0, 0.0, 1.0);
        assert_eq!(homography_corner_error(&shift, &Matrix3::identity(), 640, 480), 5.0);
        let moved = |by: f64| move |p: Point2<f64>| Some(Point2::new(p.x + by, p.y));
        assert_eq!(alignment_error(moved(3.0), moved(8.0), 640, 480), Some(5.0));
        assert_eq!(alignment_error(|_| None, moved(8.0), 640, 480), Some(f64::INFINITY));
        assert_eq!(alignment_error(Some, moved(1e4), 640, 480), None);
        assert_eq!(alignment_error(Some, |_| None, 640, 480), None);
        assert_eq!(homography_corner_error(&Matrix3::zeros(), &shift, 640, 480), f64::INFINITY);
    }

    #[test]
    fn depth_counts_what_is_visible_near_and_close() {
        let image = |values: [f32; 5]| GrayF32::from_vec(5, 1, values.to_vec()).unwrap();
        let truth = image([1.0, 2.0, 4.0, 20.0, 3.0]);
        let estimate = image([1.04, 2.2, f32::NAN, 20.0, 3.0]);
        let visible = Mask::from_vec(5, 1, vec![true, true, true, true, false]).unwrap();
        let score = depth_score(&estimate, &truth, &visible, 10.0, 0.05).unwrap();
        // Of three pixels that count one is right, and one has no value.
        assert_eq!((score.pixels, score.within, score.dense), (3, 1.0 / 3.0, 2.0 / 3.0));
    }

    #[test]
    fn masks_are_counted() {
        let mask = |bits: [bool; 4]| Mask::from_vec(2, 2, bits.to_vec()).unwrap();
        let s = MaskScore::new(&mask([true, true, false, false]), &mask([true, false, true, false])).unwrap();
        assert_eq!((s.precision(), s.recall(), s.f1()), (0.5, 0.5, 0.5));
        assert_eq!(MaskScore::default().f1(), 1.0);
        assert!(MaskScore::new(&mask([true; 4]), &Mask::new(1, 4, [true])).is_none());
    }
}
