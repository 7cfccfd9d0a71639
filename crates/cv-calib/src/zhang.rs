//! Zhang's closed form for the intrinsics from homographies of a plane.

use cv_core::{Camera, Matrix3};
use cv_numeric::symmetric_eigen;
use nalgebra::{SMatrix, SVector};

/// Estimates a pinhole camera without skew from at least three homographies from the target plane to pixels (Zhang, "A
/// flexible new technique for camera calibration", PAMI 2000, section 3.1). `None` in a degenerate configuration, such
/// as a target parallel to the image plane in all views, or if distortion makes the homographies contradictory.
pub(crate) fn intrinsics_from_homographies(
    homographies: &[Matrix3<f64>],
    (width, height): (usize, usize),
) -> Option<Camera> {
    // Normalized by the image size about its center, for numbers of order one.
    let size = width.max(height) as f64;
    let center = [(width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0];
    let normalization =
        Matrix3::new(1.0 / size, 0.0, -center[0] / size, 0.0, 1.0 / size, -center[1] / size, 0.0, 0.0, 1.0);
    let mut vtv = SMatrix::<f64, 5, 5>::zeros();
    for h in homographies {
        let h = normalization * h;
        // Joint scale of the columns of the target's axes.
        let scale = (h.column(0).norm_squared() + h.column(1).norm_squared()).sqrt();
        let h = h / scale.max(f64::MIN_POSITIVE);
        // vᵢⱼ of (B11, B22, B13, B23, B33); B12 is zero without skew.
        let v = |i: usize, j: usize| {
            let (a, b) = (h.column(i), h.column(j));
            SVector::<f64, 5>::from([
                a[0] * b[0],
                a[1] * b[1],
                a[0] * b[2] + a[2] * b[0],
                a[1] * b[2] + a[2] * b[1],
                a[2] * b[2],
            ])
        };
        for row in [v(0, 1), v(0, 0) - v(1, 1)] {
            vtv.ger(1.0, &row, &row, 1.0);
        }
    }
    let (values, vectors) = symmetric_eigen(&vtv);
    if values[1].is_nan() || values[1] <= 1e-13 * values[4] {
        return None;
    }
    let mut b: SVector<f64, 5> = vectors.column(0).into_owned();
    if b[0] < 0.0 {
        b = -b;
    }
    let (cx, cy) = (-b[2] / b[0], -b[3] / b[1]);
    let lambda = b[4] - b[2] * b[2] / b[0] - b[3] * b[3] / b[1];
    let (fx, fy) = ((lambda / b[0]).sqrt(), (lambda / b[1]).sqrt());
    // A principal point outside the image indicates distortion or noise.
    let is_plausible = [fx, fy].iter().all(|f| (0.05..=100.0).contains(f)) && cx.abs() < 0.5 && cy.abs() < 0.5;
    is_plausible
        .then(|| Camera::pinhole(width, height, fx * size, fy * size, cx * size + center[0], cy * size + center[1]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Rotation3, Vector3};

    fn homography(k: &Matrix3<f64>, turn: Vector3<f64>) -> Matrix3<f64> {
        let r = Rotation3::new(turn);
        k * Matrix3::from_columns(&[
            r.matrix().column(0).into(),
            r.matrix().column(1).into(),
            Vector3::new(-4.0, -3.0, 12.0),
        ])
    }

    #[test]
    fn exact_homographies_determine_the_camera() {
        let camera = Camera::pinhole(640, 480, 531.0, 533.0, 340.0, 230.0);
        let turns = [[0.3, 0.0, 0.1], [0.0, 0.4, 0.0], [-0.3, 0.2, 1.0]];
        let views: Vec<_> = turns.iter().map(|t| homography(&camera.matrix(), Vector3::from(*t)) * 3.0).collect();
        let estimated = intrinsics_from_homographies(&views, (640, 480)).unwrap();
        // Squares of numbers of order one, the eigenvector of an eigenvalue a thousandth of the largest: 1e-13 of 500
        // px.
        assert!((estimated.matrix() - camera.matrix()).norm() < 1e-7, "{estimated:?}");
    }

    #[test]
    fn parallel_planes_give_none() {
        let k = Camera::from_focal(640, 480, 500.0).matrix();
        let views: Vec<_> = [0.0, 0.5, 1.0].map(|t| homography(&k, Vector3::new(0.0, 0.0, t))).to_vec();
        assert_eq!(intrinsics_from_homographies(&views, (640, 480)), None);
        assert_eq!(intrinsics_from_homographies(&[Matrix3::zeros(); 3], (640, 480)), None);
        assert_eq!(intrinsics_from_homographies(&[], (640, 480)), None);
    }
}
