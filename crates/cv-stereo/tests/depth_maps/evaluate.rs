//! Scores of disparity maps worked out by hand.

use cv_core::{GrayF32, Mask};
use cv_stereo::{EvaluateError, evaluate_disparity, non_occluded};

#[test]
fn the_scores_of_a_map_worked_out_by_hand() {
    let truth = GrayF32::from_vec(5, 2, vec![1.0, 2.0, 3.0, 4.0, f32::NAN, 6.0, 7.0, 8.0, f32::INFINITY, 9.0]).unwrap();
    // Errors 0, 0.75, 1.5, 3 and 5; two missing; one of known truth missing by infinity.
    let estimate =
        GrayF32::from_vec(5, 2, vec![1.0, 2.75, 1.5, 7.0, 5.0, 1.0, f32::NAN, f32::INFINITY, 8.0, f32::NAN]).unwrap();
    let s = evaluate_disparity(estimate.view(), truth.view(), None).unwrap();
    assert_eq!(s.pixels, 8);
    assert_eq!(s.density, 5.0 / 8.0);
    assert_eq!(s.bad, [7.0 / 8.0, 6.0 / 8.0, 5.0 / 8.0, 4.0 / 8.0]);
    assert_eq!(s.bad_of_valid, [4.0 / 5.0, 3.0 / 5.0, 2.0 / 5.0, 1.0 / 5.0]);
    // Exact in binary.
    assert_eq!((s.average, s.a50, s.a90, s.a95), (10.25 / 5.0, 1.5, 5.0, 5.0));
    assert!((s.rms - ((0.5625f64 + 2.25 + 9.0 + 25.0) / 5.0).sqrt()).abs() < 1e-12);
    let mask = Mask::from_fn(5, 2, |x, _| [x == 0]);
    assert_eq!(evaluate_disparity(estimate.view(), truth.view(), Some(mask.view())).unwrap().pixels, 2);
}

#[test]
fn maps_that_cannot_be_compared_are_errors() {
    let a = GrayF32::new(3, 2, [1.0]);
    let b = GrayF32::new(2, 2, [1.0]);
    assert!(matches!(
        evaluate_disparity(a.view(), b.view(), None),
        Err(EvaluateError::SizeMismatch { estimate: (3, 2), what: "truth", other: (2, 2) })
    ));
    let unknown = GrayF32::new(3, 2, [f32::NAN]);
    assert_eq!(evaluate_disparity(a.view(), unknown.view(), None), Err(EvaluateError::NoTruth { total: 6 }));
    let none = evaluate_disparity(unknown.view(), a.view(), None).unwrap();
    assert!(none.bad == [1.0; 4] && none.average.is_nan() && none.density == 0.0);
}

#[test]
fn a_pixel_occluded_in_the_right_view_is_excluded() {
    // Background at 1, one near pixel at 3 in column 5 of the left view, in column 2 of the right one.
    let left = GrayF32::from_fn(8, 1, |x, _| [if x == 5 { 3.0 } else { 1.0 }]);
    let right = GrayF32::from_fn(8, 1, |x, _| [if x == 2 { 3.0 } else { 1.0 }]);
    let mask = non_occluded(left.view(), right.view()).unwrap();
    // Column 0 is out of view, column 3 is occluded by the near pixel.
    assert_eq!(mask.as_slice(), [false, true, true, false, true, true, true, true]);
}
