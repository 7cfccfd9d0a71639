//! The upright orientation of a panorama.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// Standard deviation of camera roll in radians: hand-held photographs are level to a degree or two.
const ROLL_SIGMA: f64 = 1.5 * std::f64::consts::PI / 180.0;
/// Standard deviation of camera pitch in radians.
const PITCH_SIGMA: f64 = 15.0 * std::f64::consts::PI / 180.0;
/// Truncation of the roll residual in standard deviations: photographs beyond are outliers (portrait or slanted). Must stay below the pitch cost of a
/// vertical view (1 / 0.26² = 15), or one portrait photograph would turn another's optical axis upright.
const MAX_ROLL_SIGMAS: f64 = 3.5;
/// Maximum number of pairs tried as hypotheses.
const MAX_PAIR_HYPOTHESES: usize = 2000;

/// Computes the world rotation after which the panorama is level, upright and centered on the Z axis (wave correction; Brown & Lowe 2007, §5).
///
/// `rotations` are world to camera. The x axes of level cameras span the horizontal plane, so "up" is the direction `u` of their least variance. That is
/// ambiguous where all x axes are parallel (a camera that only tilted), hence the optical axes contribute with a larger standard deviation: `u` minimizes
/// `Σ min((x_i·u)² / σ_roll², 3.5²) + Σ (z_i·u)² / σ_pitch²`. The truncation rejects portrait photographs. Hypotheses come from minimal samples of one or two
/// photographs, at most 2000 + n, each scored on all: O(n³) for few photographs, O(n²) for many.
///
/// The result `S` maps old to new world directions: apply it as `R_i ← R_i Sᵀ`.
pub(crate) fn straighten(rotations: &[Matrix3<f64>]) -> Matrix3<f64> {
    let level_ones = level_photographs(rotations);
    let mut y = normal(level_ones.iter().map(|&i| &rotations[i]));
    // Rows of a world-to-camera rotation are the camera's axes in the world.
    let down: Vector3<f64> = level_ones.iter().map(|&i| rotations[i].row(1).transpose()).sum();
    let ahead: Vector3<f64> = rotations.iter().map(|r| r.row(2).transpose()).sum();
    if y.dot(&down) < 0.0 {
        y = -y;
    }
    let z = level(&ahead, &y)
        // The optical axes of a full circle cancel: any one of them serves as the center.
        .or_else(|| rotations.iter().find_map(|r| level(&r.row(2).transpose(), &y)))
        .unwrap_or_else(|| level(&Vector3::x(), &y).unwrap_or_else(Vector3::z));
    let x = y.cross(&z);
    Matrix3::from_rows(&[x.transpose(), y.transpose(), z.transpose()])
}

/// Estimates the vertical (of either sign) from photographs taken as level.
fn normal<'a>(rotations: impl Iterator<Item = &'a Matrix3<f64>>) -> Vector3<f64> {
    let mut spread = Matrix3::zeros();
    for r in rotations {
        let (x, z) = (r.row(0).transpose(), r.row(2).transpose());
        spread += x * x.transpose() + (ROLL_SIGMA / PITCH_SIGMA).powi(2) * z * z.transpose();
    }
    let eigen = spread.symmetric_eigen();
    eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned()
}

/// Returns the inliers of the best hypothesis: the photographs taken as level.
fn level_photographs(rotations: &[Matrix3<f64>]) -> Vec<usize> {
    let n = rotations.len();
    let roll = |r: &Matrix3<f64>, u: &Vector3<f64>| (r.row(0).transpose().dot(u) / ROLL_SIGMA).powi(2);
    let cost = |u: &Vector3<f64>| -> f64 {
        let pitch = |r: &Matrix3<f64>| (r.row(2).transpose().dot(u) / PITCH_SIGMA).powi(2);
        rotations.iter().map(|r| roll(r, u).min(MAX_ROLL_SIGMAS * MAX_ROLL_SIGMAS) + pitch(r)).sum()
    };
    let level = |u: &Vector3<f64>| -> Vec<usize> {
        (0..n).filter(|&i| roll(&rotations[i], u) < MAX_ROLL_SIGMAS * MAX_ROLL_SIGMAS).collect()
    };
    let mut best = normal(rotations.iter());
    let mut least = cost(&best);
    // Ties keep the first hypothesis, which uses all photographs.
    let mut consider = |u: Vector3<f64>| {
        let cost = cost(&u);
        if cost < least * (1.0 - 1e-9) {
            (best, least) = (u, cost);
        }
    };
    let stride = (n * n.saturating_sub(1) / 2).div_ceil(MAX_PAIR_HYPOTHESES).max(1);
    let pairs = (0..n).flat_map(|i| (i..n).map(move |j| (i, j)));
    for (_, (i, j)) in pairs.enumerate().filter(|(k, (i, j))| i == j || k % stride == 0) {
        consider(normal([&rotations[i], &rotations[j]].into_iter()));
    }
    // Refit to the inliers.
    for _ in 0..4 {
        let refined = normal(level(&best).iter().map(|&i| &rotations[i]));
        let cost = cost(&refined);
        if cost >= least {
            break;
        }
        (best, least) = (refined, cost);
    }
    match level(&best) {
        none if none.is_empty() => (0..n).collect(),
        some => some,
    }
}

/// Returns the component of `v` orthogonal to `y`, normalized.
fn level(v: &Vector3<f64>, y: &Vector3<f64>) -> Option<Vector3<f64>> {
    (v - y * v.dot(y)).try_normalize(1e-3)
}

/// Returns the rotation about the vertical that takes longitude `angle` (from Z toward X) to the Z axis.
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
    fn rotated_photographs_are_rejected_as_outliers() {
        use std::f64::consts::FRAC_PI_2;
        let degrees = |angle: f64| angle * std::f64::consts::PI / 180.0;
        for odd in [FRAC_PI_2, -FRAC_PI_2, degrees(30.0), degrees(-30.0), 2.0 * FRAC_PI_2] {
            for (count, turned) in [(2, 1), (3, 0), (3, 1), (5, 4), (9, 3)] {
                // A little roll in the others, as hands have it.
                let roll = |k: usize| if k == turned { odd } else { 0.012 * [1.0, -1.0, 0.5][k % 3] };
                let yaw = |k: usize| 0.35 * k as f64;
                let cameras: Vec<_> = (0..count).map(|k| camera(0.05, yaw(k), roll(k))).collect();
                let tilt = Rotation3::new(Vector3::new(0.4, -0.3, 1.1));
                let result = straightened(&cameras, &tilt);
                // Two horizons 0.35 rad apart whose rolls differ by 0.024 cross 0.024 / sin 0.35 = 0.07 rad off; a single level photograph has its pitch of
                // 0.05 besides.
                let world: Vec<_> = result.iter().zip(&cameras).map(|(r, truth)| r.transpose() * truth).collect();
                for w in &world {
                    let down = (w * Vector3::y()).y;
                    assert!(down > 0.07_f64.cos(), "{odd} {count} {turned}: {}", down.acos());
                }
            }
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
