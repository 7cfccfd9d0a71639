//! The upright orientation of a panorama.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// How surely photographers hold the camera: the variance of roll over that of pitch. People level the picture's sides to a degree
/// or two but tilt it up and down by fifteen; (1.5° / 15°)².
const ROLL_TO_PITCH: f64 = 0.01;

/// The rotation of the world after which the panorama is level, the right side up and centered on the Z axis (Brown & Lowe 2007, §5).
///
/// `rotations` are world to camera. Their horizontal axes should all lie in the horizon's plane, so its normal, "up", is the
/// direction in which they vary least. Where they all agree (a camera tilted straight up and down, or hardly turned) that leaves a
/// choice, which the views' own middle decides: `up` minimizes `Σ (x_i·u)² + 0.01 Σ (z_i·u)²`.
///
/// The answer `S` is to be applied as `R_i ← R_i Sᵀ`: `S` takes old world directions to new ones.
pub(crate) fn straighten(rotations: &[Matrix3<f64>]) -> Matrix3<f64> {
    let mut spread = Matrix3::zeros();
    let (mut down, mut ahead) = (Vector3::zeros(), Vector3::zeros());
    for r in rotations {
        // Rows of a world-to-camera rotation are the camera's axes in the world.
        let (x, y, z) = (r.row(0).transpose(), r.row(1).transpose(), r.row(2).transpose());
        spread += x * x.transpose() + ROLL_TO_PITCH * z * z.transpose();
        down += y;
        ahead += z;
    }
    let eigen = spread.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let mut y: Vector3<f64> = eigen.eigenvectors.column(least).into_owned();
    if y.dot(&down) < 0.0 {
        y = -y;
    }
    let z = level(&ahead, &y)
        // Views all around add up to nothing: any of them is as good a middle.
        .or_else(|| rotations.iter().find_map(|r| level(&r.row(2).transpose(), &y)))
        .unwrap_or_else(|| level(&Vector3::x(), &y).unwrap_or_else(Vector3::z));
    let x = y.cross(&z);
    Matrix3::from_rows(&[x.transpose(), y.transpose(), z.transpose()])
}

/// The part of `v` at right angles to `y`, of unit length.
fn level(v: &Vector3<f64>, y: &Vector3<f64>) -> Option<Vector3<f64>> {
    (v - y * v.dot(y)).try_normalize(1e-3)
}

/// The turn about the vertical that brings longitude `angle` (from Z toward X) to the middle.
pub(crate) fn turn(angle: f64) -> Matrix3<f64> {
    Rotation3::from_axis_angle(&Vector3::y_axis(), -angle).into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(pitch: f64, yaw: f64, roll: f64) -> Matrix3<f64> {
        // Yaw about the world's vertical first, then pitch, then roll in the camera.
        (Rotation3::from_axis_angle(&Vector3::z_axis(), roll)
            * Rotation3::from_axis_angle(&Vector3::x_axis(), pitch)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw))
        .into_inner()
    }

    fn straightened(cameras: &[Matrix3<f64>], tilt: &Rotation3<f64>) -> Vec<Matrix3<f64>> {
        let tilted: Vec<_> = cameras.iter().map(|r| r * tilt.matrix()).collect();
        let s = straighten(&tilted);
        assert!((s.determinant() - 1.0).abs() < 1e-12);
        tilted.iter().map(|r| r * s.transpose()).collect()
    }

    #[test]
    fn a_tilted_sweep_comes_out_level_and_upright_whatever_the_world_frame_was() {
        let cameras: Vec<_> = (-2..=2).map(|k| camera(0.25, f64::from(k) * 0.4, 0.0)).collect();
        for tilt in [
            Rotation3::identity(),
            Rotation3::new(Vector3::new(0.8, -0.4, 2.5)),
            Rotation3::new(Vector3::new(3.1, 0.0, 0.0)),
        ] {
            let result = straightened(&cameras, &tilt);
            for (r, truth) in result.iter().zip(&cameras) {
                // The pull of the pitch prior: 0.01·sin 0.25·cos 0.25 against the spread of x, some 0.3: 0.02 rad at most.
                assert!((r - truth).norm() < 0.03, "{r} {truth}");
            }
        }
    }

    #[test]
    fn a_camera_tilted_straight_up_and_down_keeps_its_sides_upright() {
        let cameras: Vec<_> = (-1..=1).map(|k| camera(f64::from(k) * 0.5, 0.0, 0.0)).collect();
        let result = straightened(&cameras, &Rotation3::new(Vector3::new(0.3, 1.0, -2.0)));
        for (r, truth) in result.iter().zip(&cameras) {
            // Symmetric about the horizon: exact but for rounding in the eigenvectors.
            assert!((r - truth).norm() < 1e-7, "{r} {truth}");
        }
    }

    #[test]
    fn a_full_circle_has_a_middle() {
        let cameras: Vec<_> = (0..12).map(|k| camera(0.0, f64::from(k) * std::f64::consts::TAU / 12.0, 0.0)).collect();
        let result = straightened(&cameras, &Rotation3::new(Vector3::new(0.1, 0.2, 0.3)));
        // y of every camera is the world's down.
        assert!(result.iter().all(|r| (r.row(1).transpose() - Vector3::y()).norm() < 1e-9));
    }

    #[test]
    fn turning_brings_a_longitude_to_the_middle() {
        let ray = Vector3::new(0.7_f64.sin(), 0.0, 0.7_f64.cos());
        assert!((turn(0.7) * ray - Vector3::z()).norm() < 1e-12);
    }
}
