//! Zhang's closed form for the intrinsics from homographies of a plane.

use cv_core::{Camera, Matrix3};
use cv_numeric::symmetric_eigen;
use nalgebra::{SMatrix, SVector};

/// A pinhole without skew from three homographies or more that take the target's plane to pixels (Zhang, "A flexible new technique for camera
/// calibration", PAMI 2000, section 3.1). `None` where they determine none, as where the target is parallel to the picture in all views, or where distortion
/// makes them contradict each other.
pub(crate) fn intrinsics_from_homographies(
    homographies: &[Matrix3<f64>],
    (width, height): (usize, usize),
) -> Option<Camera> {
    // In units of the picture's size from its middle, where all numbers are of order one.
    let size = width.max(height) as f64;
    let middle = [(width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0];
    let unit = Matrix3::new(1.0 / size, 0.0, -middle[0] / size, 0.0, 1.0 / size, -middle[1] / size, 0.0, 0.0, 1.0);
    let mut vtv = SMatrix::<f64, 5, 5>::zeros();
    for h in homographies {
        let h = unit * h;
        // Columns of the target's axes, of equal and unit length together.
        let scale = (h.column(0).norm_squared() + h.column(1).norm_squared()).sqrt();
        let h = h / scale.max(f64::MIN_POSITIVE);
        // vᵢⱼ of (B11, B22, B13, B23, B33), B12 being zero without skew.
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
    // A principal point outside the picture is distortion or noise.
    let plausible = [fx, fy].iter().all(|f| (0.05..=100.0).contains(f)) && cx.abs() < 0.5 && cy.abs() < 0.5;
    plausible
        .then(|| Camera::pinhole(width, height, fx * size, fy * size, cx * size + middle[0], cy * size + middle[1]))
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
    fn exact_homographies_give_the_camera() {
        let camera = Camera::pinhole(640, 480, 531.0, 533.0, 340.0, 230.0);
        let turns = [[0.3, 0.0, 0.1], [0.0, 0.4, 0.0], [-0.3, 0.2, 1.0]];
        let views: Vec<_> = turns.iter().map(|t| homography(&camera.matrix(), Vector3::from(*t)) * 3.0).collect();
        let found = intrinsics_from_homographies(&views, (640, 480)).unwrap();
        // Squares of numbers of order one, the eigenvector of an eigenvalue a thousandth of the largest: 1e-13 of 500 px.
        assert!((found.matrix() - camera.matrix()).norm() < 1e-7, "{found:?}");
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
