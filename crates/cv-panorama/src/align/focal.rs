//! Focal lengths from the homography between two views of a rotating camera (Szeliski & Shum 1997).

use nalgebra::Matrix3;

/// Estimates the focal lengths `(fa, fb)`, in pixels, for which `h` (pixels of a to pixels of b, both relative to their principal
/// points) is `K_b R K_a⁻¹`; each is `None` where the homography does not determine it.
///
/// The columns of R are orthogonal and of equal length: two equations in `1/fb²`; its rows give two in `fa²`. Each pair is solved by
/// least squares and accepted where the two equations are consistent.
pub(crate) fn focals_from_homography(h: &Matrix3<f64>) -> (Option<f64>, Option<f64>) {
    // fb² · B + A = 0, with A from the upper two entries and B from the last of the first two columns.
    let solve = |a: [f64; 2], b: [f64; 2]| -> Option<f64> {
        let (dot, aa, bb) = (a[0] * b[0] + a[1] * b[1], a[0] * a[0] + a[1] * a[1], b[0] * b[0] + b[1] * b[1]);
        // Beyond 60° between the two equations, parallax and noise dominate.
        let is_consistent = -dot > 0.5 * (aa * bb).sqrt() && bb > 0.0;
        Some((-dot / bb).sqrt()).filter(|f| is_consistent && f.is_finite())
    };
    let columns = |m: &Matrix3<f64>| {
        let a = [
            2.0 * (m[(0, 0)] * m[(0, 1)] + m[(1, 0)] * m[(1, 1)]),
            m[(0, 0)].powi(2) + m[(1, 0)].powi(2) - m[(0, 1)].powi(2) - m[(1, 1)].powi(2),
        ];
        let b = [2.0 * m[(2, 0)] * m[(2, 1)], m[(2, 0)].powi(2) - m[(2, 1)].powi(2)];
        solve(a, b)
    };
    // The inverse homography swaps the two images.
    (h.try_inverse().and_then(|inverse| columns(&inverse)), columns(h))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    fn homography(fa: f64, fb: f64, r: &Rotation3<f64>) -> Matrix3<f64> {
        let k = |f: f64| Matrix3::from_diagonal(&nalgebra::Vector3::new(f, f, 1.0));
        k(fb) * r.matrix() * k(1.0 / fa)
    }

    #[test]
    fn a_turn_gives_both_focal_lengths_whatever_the_scale_of_the_matrix() {
        for r in [(0.05, 0.4, 0.02), (0.3, -0.2, 0.7), (-0.1, 0.3, 0.0)] {
            let h = homography(800.0, 650.0, &Rotation3::from_euler_angles(r.0, r.1, r.2)) * -3.7;
            let (a, b) = focals_from_homography(&h);
            // Closed form in f64; entries span 1e-4 to 1e3.
            assert!((a.unwrap() - 800.0).abs() < 1e-6 && (b.unwrap() - 650.0).abs() < 1e-6, "{a:?} {b:?}");
        }
    }

    #[test]
    fn undetermined_focal_lengths_are_none() {
        assert_eq!(focals_from_homography(&Matrix3::identity()), (None, None));
        // A shift and a turn about the optical axis: no perspective.
        let flat = Matrix3::new(0.8, -0.6, 40.0, 0.6, 0.8, -7.0, 0.0, 0.0, 1.0);
        assert_eq!(focals_from_homography(&flat), (None, None));
        assert_eq!(focals_from_homography(&Matrix3::zeros()), (None, None));
        assert_eq!(focals_from_homography(&Matrix3::from_element(f64::NAN)), (None, None));
    }
}
