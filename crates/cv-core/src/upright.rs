//! Which way is up in photographs whose poses are known.

use crate::{Matrix3, Pose, Rotation3, Vector3};

/// The motion from the world of some poses to one with its origin at the first camera, Y down and Z level ahead of it.
///
/// Down is the direction that the cameras' own are nearest to, or where they agree much better on a line across, as of photographs taken on their side, that one: people
/// level a camera to some degrees. Of no poses the identity.
pub fn upright(poses: &[Pose]) -> Pose {
    let axis = |pose: &Pose, i: usize| pose.rotation.inverse() * Vector3::ith(i, 1.0);
    let Some(first) = poses.first() else { return Pose::identity() };
    // The line that an axis of all photographs is nearest to, and the mean square of its share along it: 1 where all are on the line, 1/3 where they are turned every way.
    let line = |i: usize| {
        let spread = poses.iter().fold(Matrix3::zeros(), |sum, pose| {
            let axis = axis(pose, i);
            sum + axis * axis.transpose()
        });
        let step = |v: Vector3<f64>, _| (spread * v).try_normalize(0.0).unwrap_or(v);
        let line = (0..100).fold(axis(first, i), step);
        // To the side of most.
        let sum: f64 = poses.iter().map(|pose| axis(pose, i).dot(&line)).sum();
        (line * sum.signum(), (spread * line).norm() / poses.len() as f64)
    };
    // Photographs that were taken on their side agree on a line across.
    let (down, across) = (line(1), line(0));
    let down = if across.1 > down.1 + 0.2 { across.0 } else { down.0 };
    let eye = first.center();
    let ahead = axis(first, 2);
    // One that looks straight down has its own top for ahead.
    let ahead = if ahead.cross(&down).norm() > 0.1 * down.norm() { ahead } else { -axis(first, 1) };
    let level = ahead - down * (ahead.dot(&down) / down.norm_squared());
    Pose::look_at(eye, eye + level, down)
        .filter(|pose| pose.translation.iter().all(|v| v.is_finite()))
        .unwrap_or(Pose { rotation: Rotation3::identity(), translation: -eye.coords })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Point3;
    use std::f64::consts::FRAC_PI_2;

    #[test]
    fn down_is_what_is_down_in_the_photographs() {
        // Cameras on a circle that look to its middle, a little down, in a world that lies on its side.
        let turned = Pose::new(Rotation3::from_euler_angles(0.4, -0.9, 1.3), Vector3::new(3.0, -1.0, 0.5));
        let poses: Vec<Pose> = (0..8)
            .map(|k| {
                let (sin, cos) = f64::from(k).sin_cos();
                let eye = Point3::new(4.0 * sin, -0.5, -4.0 * cos);
                Pose::look_at(eye, Point3::origin(), Vector3::y()).unwrap().compose(&turned)
            })
            .collect();
        let down = upright(&poses).rotation * turned.rotation.inverse() * Vector3::y();
        // The cameras' own down is 7 degrees off, each to another side: on eight of the circle's 2π that nearly cancels.
        assert!(down.y > 0.999, "{down}");
        // Ahead of the first camera.
        let ahead = upright(&poses).transform(&poses[0].inverse().transform(&Point3::new(0.0, 0.0, 2.0)));
        assert!(ahead.x.abs() < 0.1 && ahead.z > 1.9, "{ahead}");
        assert_eq!(upright(&[]), Pose::identity());
    }

    #[test]
    fn photographs_taken_on_their_side_stand() {
        // On a ring around the world's X, every third one turned the other way.
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
        let vertical = upright(&ring).rotation * Vector3::x();
        assert!((vertical.y.abs() - 1.0).abs() < 1e-9, "{vertical}");
    }
}
