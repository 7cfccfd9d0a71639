//! Error measures against ground truth.

use cv_core::{GrayF32, Mask, Point2, Rotation3};
use nalgebra::{Matrix3, Vector3};

/// Returns the mean distance in pixels between the corners of a `width` × `height` image transferred by two
/// homographies, as in HPatches (Balntas et al. 2017). Infinite if a corner is transferred to infinity or a homography
/// is not finite.
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

/// Applies a homography to a point; `None` if the result is not finite.
fn apply(h: &Matrix3<f64>, x: f64, y: f64) -> Option<Point2<f64>> {
    let q = h * Vector3::new(x, y, 1.0);
    let p = Point2::new(q.x / q.z, q.y / q.z);
    (p.x.is_finite() && p.y.is_finite()).then_some(p)
}

/// Returns the angle in radians, 0 to π, between two rotations.
pub fn rotation_error(estimate: &Rotation3<f64>, truth: &Rotation3<f64>) -> f64 {
    // By the chord: the arc cosine of the trace has no precision at small angles.
    let chord = (estimate.matrix() - truth.matrix()).norm() / 8f64.sqrt();
    2.0 * chord.min(1.0).asin()
}

/// Returns the angle in radians, 0 to π, between two directions; π for a zero vector.
pub fn direction_error(estimate: &Vector3<f64>, truth: &Vector3<f64>) -> f64 {
    match (estimate.try_normalize(0.0), truth.try_normalize(0.0)) {
        (Some(a), Some(b)) => (a.cross(&b).norm()).atan2(a.dot(&b)),
        _ => std::f64::consts::PI,
    }
}

/// Accuracy of a depth map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthScore {
    /// Number of evaluated pixels: visible, with a true depth below the limit.
    pub pixels: usize,
    /// Fraction of these with an estimate within the tolerance.
    pub within: f64,
    /// Fraction of these with an estimate.
    pub dense: f64,
}

/// Returns the fraction of visible pixels with a true depth below `limit` meters whose estimate is within the relative
/// `tolerance`. A pixel without an estimate counts as wrong. `None` if the sizes differ or no pixel is evaluated.
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
    let (mut pixels, mut accurate, mut dense) = (0, 0, 0);
    for ((e, t), v) in estimate.as_slice().iter().zip(truth.as_slice()).zip(visible.as_slice()) {
        if *v && *t < limit {
            pixels += 1;
            dense += usize::from(e.is_finite());
            accurate += usize::from((e - t).abs() <= tolerance * t);
        }
    }
    let fraction = |n: usize| n as f64 / pixels as f64;
    (pixels > 0).then(|| DepthScore { pixels, within: fraction(accurate), dense: fraction(dense) })
}

/// Precision, recall and F1 of a mask.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MaskScore {
    /// True positives: pixels in both masks.
    pub true_positives: usize,
    /// False positives: pixels in the estimate only.
    pub false_positives: usize,
    /// False negatives: pixels in the ground truth only.
    pub false_negatives: usize,
}

impl MaskScore {
    /// Counts the pixels of two masks; `None` if their sizes differ.
    pub fn new(estimate: &Mask, truth: &Mask) -> Option<Self> {
        let mut score = Self::default();
        for (&e, &t) in estimate.as_slice().iter().zip(truth.as_slice()) {
            match (e, t) {
                (true, true) => score.true_positives += 1,
                (true, false) => score.false_positives += 1,
                (false, true) => score.false_negatives += 1,
                (false, false) => {}
            }
        }
        (estimate.size() == truth.size()).then_some(score)
    }

    /// Returns the sum of the counts, as over the pixels of several images.
    pub fn plus(self, other: Self) -> Self {
        Self {
            true_positives: self.true_positives + other.true_positives,
            false_positives: self.false_positives + other.false_positives,
            false_negatives: self.false_negatives + other.false_negatives,
        }
    }

    /// Returns the precision; 1 for an empty estimate.
    pub fn precision(&self) -> f64 {
        ratio(self.true_positives, self.true_positives + self.false_positives)
    }

    /// Returns the recall; 1 for an empty ground truth.
    pub fn recall(&self) -> f64 {
        ratio(self.true_positives, self.true_positives + self.false_negatives)
    }

    /// Returns F1, `2 TP / (2 TP + FP + FN)`; 1 for two empty masks.
    pub fn f1(&self) -> f64 {
        ratio(2 * self.true_positives, 2 * self.true_positives + self.false_positives + self.false_negatives)
    }
}

fn ratio(part: usize, whole: usize) -> f64 {
    if whole == 0 { 1.0 } else { part as f64 / whole as f64 }
}

/// Returns the root mean square transfer error in pixels over a 17 × 17 grid on a first image, at the points that a
/// second image of the same size shows too; infinite if `estimate` transfers one of them nowhere. `None` if the images
/// do not overlap.
pub fn alignment_error(
    estimate: impl Fn(Point2<f64>) -> Option<Point2<f64>>,
    truth: impl Fn(Point2<f64>) -> Option<Point2<f64>>,
    width: usize,
    height: usize,
) -> Option<f64> {
    let (mut sum, mut n) = (0.0, 0.0);
    let is_inside = |v: f64, n: usize| v >= 0.0 && v <= n as f64 - 1.0;
    for (i, j) in (0..17).flat_map(|j| (0..17).map(move |i| (i, j))) {
        let here = Point2::new(f64::from(i) / 16.0 * (width as f64 - 1.0), f64::from(j) / 16.0 * (height as f64 - 1.0));
        if let Some(there) = truth(here).filter(|p| is_inside(p.x, width) && is_inside(p.y, height)) {
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
    fn angles_are_measured_exactly() {
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
    fn the_error_of_a_translation_is_its_length() {
        let shift = Matrix3::new(1.0, 0.0, 3.0, 0.0, 1.0, 4.0, 0.0, 0.0, 1.0);
        assert_eq!(homography_corner_error(&shift, &Matrix3::identity(), 640, 480), 5.0);
        let translated = |by: f64| move |p: Point2<f64>| Some(Point2::new(p.x + by, p.y));
        assert_eq!(alignment_error(translated(3.0), translated(8.0), 640, 480), Some(5.0));
        assert_eq!(alignment_error(|_| None, translated(8.0), 640, 480), Some(f64::INFINITY));
        assert_eq!(alignment_error(Some, translated(1e4), 640, 480), None);
        assert_eq!(alignment_error(Some, |_| None, 640, 480), None);
        assert_eq!(homography_corner_error(&Matrix3::zeros(), &shift, 640, 480), f64::INFINITY);
    }

    #[test]
    fn the_depth_score_is_of_visible_nearby_pixels() {
        let image = |values: [f32; 5]| GrayF32::from_vec(5, 1, values.to_vec()).unwrap();
        let truth = image([1.0, 2.0, 4.0, 20.0, 3.0]);
        let estimate = image([1.04, 2.2, f32::NAN, 20.0, 3.0]);
        let visible = Mask::from_vec(5, 1, vec![true, true, true, true, false]).unwrap();
        let score = depth_score(&estimate, &truth, &visible, 10.0, 0.05).unwrap();
        // Of three evaluated pixels one is accurate, and one has no estimate.
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
