//! Estimates the vertical direction of a scene from camera poses.

use crate::{Matrix3, Pose, Rotation3, Vector3};

/// Computes the rigid motion from the world of the poses to an upright frame: origin at the first camera, Y down, Z horizontal along its
/// viewing direction. The identity for no poses.
///
/// Down is the principal axis of the cameras' y axes, or of their x axes where those agree much better (portrait format): people hold a
/// camera level to a few degrees.
pub fn upright_frame(poses: &[Pose]) -> Pose {
    let axis = |pose: &Pose, i: usize| pose.rotation.inverse() * Vector3::ith(i, 1.0);
    let Some(first) = poses.first() else { return Pose::identity() };
    // Principal axis (by power iteration) of camera axis `i` over all poses, and its normalized eigenvalue: 1 where all are parallel, 1/3
    // where they are isotropic.
    let principal_axis = |i: usize| {
        let scatter = poses.iter().fold(Matrix3::zeros(), |sum, pose| {
            let axis = axis(pose, i);
            sum + axis * axis.transpose()
        });
        let step = |v: Vector3<f64>, _| (scatter * v).try_normalize(0.0).unwrap_or(v);
        let principal = (0..100).fold(axis(first, i), step);
        // The sign of the majority.
        let sum: f64 = poses.iter().map(|pose| axis(pose, i).dot(&principal)).sum();
        (principal * sum.signum(), (scatter * principal).norm() / poses.len() as f64)
    };
    // In portrait format the x axis is vertical.
    let (down, portrait_down) = (principal_axis(1), principal_axis(0));
    let down = if portrait_down.1 > down.1 + 0.2 { portrait_down.0 } else { down.0 };
    let eye = first.center();
    let ahead = axis(first, 2);
    // For a first camera that looks straight down, ahead is toward the top of its image.
    let ahead = if ahead.cross(&down).norm() > 0.1 * down.norm() { ahead } else { -axis(first, 1) };
    let horizontal = ahead - down * (ahead.dot(&down) / down.norm_squared());
    Pose::look_at(eye, eye + horizontal, down)
        .filter(|pose| pose.translation.iter().all(|v| v.is_finite()))
        .unwrap_or(Pose { rotation: Rotation3::identity(), translation: -eye.coords })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Point3;
    use std::f64::consts::FRAC_PI_2;

    #[test]
    fn down_is_the_mean_image_y_axis() {
        // Cameras on a circle that look at its center, a little down, in a rotated world.
        let turned = Pose::new(Rotation3::from_euler_angles(0.4, -0.9, 1.3), Vector3::new(3.0, -1.0, 0.5));
        let poses: Vec<Pose> = (0..8)
            .map(|k| {
                let (sin, cos) = f64::from(k).sin_cos();
                let eye = Point3::new(4.0 * sin, -0.5, -4.0 * cos);
                Pose::look_at(eye, Point3::origin(), Vector3::y()).unwrap().compose(&turned)
            })
            .collect();
        let down = upright_frame(&poses).rotation * turned.rotation.inverse() * Vector3::y();
        // Each camera's y axis is tilted by 7 degrees, in a different direction: over the circle that nearly cancels.
        assert!(down.y > 0.999, "{down}");
        // Ahead of the first camera.
        let ahead = upright_frame(&poses).transform(&poses[0].inverse().transform(&Point3::new(0.0, 0.0, 2.0)));
        assert!(ahead.x.abs() < 0.1 && ahead.z > 1.9, "{ahead}");
        assert_eq!(upright_frame(&[]), Pose::identity());
    }

    #[test]
    fn portrait_photographs_give_a_vertical_too() {
        // On a ring around the world's X axis, every third camera rolled the other way.
        let ring: Vec<Pose> = (0..12)
            .map(|k| {
                let eye = Point3::from(
                    Rotation3::from_axis_angle(&Vector3::x_axis(), f64::from(k) * 0.5) * Vector3::y() * 4.0,
                );
                let turn = if k % 3 == 0 { FRAC_PI_2 } else { -FRAC_PI_2 };
                let side = Rotation3::from_axis_angle(&Vector3::z_axis(), turn);
                let ahead = Pose::look_at(eye, Point3::origin(), -Vector3::x()).unwrap();
                Pose::new(side, Vector3::zeros()).compose(&ahead)
            })
            .collect();
        let vertical = upright_frame(&ring).rotation * Vector3::x();
        assert!((vertical.y.abs() - 1.0).abs() < 1e-9, "{vertical}");
    }
}
