//! Rigid motions.

use nalgebra::{Matrix3x4, Point3, Rotation3, Vector3};

/// A rigid motion from world to camera coordinates: `x_cam = R x_world + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Pose {
    /// R, world to camera.
    pub rotation: Rotation3<f64>,
    /// t, in the unit of the world.
    pub translation: Vector3<f64>,
}

impl Pose {
    /// The pose of a camera whose frame is the world's.
    pub fn identity() -> Self {
        Self { rotation: Rotation3::identity(), translation: Vector3::zeros() }
    }

    /// From R and t.
    pub fn new(rotation: Rotation3<f64>, translation: Vector3<f64>) -> Self {
        Self { rotation, translation }
    }

    /// Makes the pose of a camera at `eye` (world) that looks at `target`, with the image's y axis as near to `down` as possible.
    ///
    /// `None` where the viewing direction is zero or parallel to `down`.
    pub fn look_at(eye: Point3<f64>, target: Point3<f64>, down: Vector3<f64>) -> Option<Self> {
        let z = (target - eye).try_normalize(1e-12)?;
        let x = down.cross(&z).try_normalize(1e-12)?;
        let y = z.cross(&x);
        let rotation = Rotation3::from_basis_unchecked(&[x, y, z]).inverse();
        Some(Self { rotation, translation: -(rotation * eye.coords) })
    }

    /// Transforms world to camera coordinates.
    #[inline]
    pub fn transform(&self, world: &Point3<f64>) -> Point3<f64> {
        self.rotation * world + self.translation
    }

    /// Returns the camera center in the world, `−Rᵀ t`.
    pub fn center(&self) -> Point3<f64> {
        Point3::from(-(self.rotation.inverse() * self.translation))
    }

    /// Returns the inverse motion, camera to world.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Composes two motions: `first`, then `self`.
    pub fn compose(&self, first: &Self) -> Self {
        Self {
            rotation: self.rotation * first.rotation,
            translation: self.rotation * first.translation + self.translation,
        }
    }

    /// Returns the relative pose, from the camera frame of `a` to that of `b`: `x_b = R x_a + t`.
    pub fn relative(a: &Self, b: &Self) -> Self {
        b.compose(&a.inverse())
    }

    /// Computes the rotation angle in radians, 0 to π.
    ///
    /// From the chordal distance to the identity: the arc cosine of the trace ([`Rotation3::angle`]) loses half of the digits at small
    /// angles, and is NaN where rounding takes the trace above three.
    pub fn rotation_angle(&self) -> f64 {
        let chord = (self.rotation.matrix() - nalgebra::Matrix3::identity()).norm() / 8f64.sqrt();
        2.0 * chord.min(1.0).asin()
    }

    /// `[R | t]`, 3×4.
    pub fn matrix(&self) -> Matrix3x4<f64> {
        let mut m = Matrix3x4::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(self.rotation.matrix());
        m.fixed_view_mut::<3, 1>(0, 3).copy_from(&self.translation);
        m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // f64 arithmetic on numbers of order one, a few operations deep.
    const TOLERANCE: f64 = 1e-12;

    #[test]
    fn the_rotation_angle_is_accurate_down_to_zero() {
        let axis = Vector3::new(2.0, -1.0, 0.5).normalize();
        for angle in [0.0, 1e-12, 1e-9, 1e-3, 1.0, 3.0] {
            let pose = Pose::new(Rotation3::new(axis * angle), Vector3::zeros());
            assert!((pose.rotation_angle() - angle).abs() < TOLERANCE * (1.0 + angle), "{angle}");
        }
        // A trace above three by rounding, and a half turn.
        let unorthogonal = Rotation3::from_matrix_unchecked(nalgebra::Matrix3::identity() * (1.0 + 1e-15));
        assert!(Pose::new(unorthogonal, Vector3::zeros()).rotation_angle() < TOLERANCE);
        let half = Pose::new(Rotation3::new(axis * std::f64::consts::PI), Vector3::zeros());
        // The arc sine at one has half of the digits.
        assert!((half.rotation_angle() - std::f64::consts::PI).abs() < 1e-7);
    }

    #[test]
    fn look_at_puts_the_target_on_the_optical_axis_and_down_along_y() {
        let pose = Pose::look_at(Point3::new(1.0, 2.0, 3.0), Point3::new(4.0, 2.0, 7.0), Vector3::y()).unwrap();
        let seen = pose.transform(&Point3::new(4.0, 2.0, 7.0));
        assert!((seen - Point3::new(0.0, 0.0, 5.0)).norm() < TOLERANCE);
        assert!(pose.transform(&Point3::new(4.0, 3.0, 7.0)).y > 0.9);
        assert!((pose.rotation.matrix().determinant() - 1.0).abs() < TOLERANCE);
        assert!((pose.center() - Point3::new(1.0, 2.0, 3.0)).norm() < TOLERANCE);
    }

    #[test]
    fn relative_motion_takes_one_frame_to_the_other() {
        let a = Pose::new(Rotation3::from_euler_angles(0.1, 0.2, 0.3), Vector3::new(1.0, 0.0, 2.0));
        let b = Pose::new(Rotation3::from_euler_angles(-0.3, 0.1, 0.0), Vector3::new(0.0, 1.0, -1.0));
        let p = Point3::new(0.3, -0.7, 5.0);
        let through = Pose::relative(&a, &b).transform(&a.transform(&p));
        assert!((through - b.transform(&p)).norm() < TOLERANCE);
    }

    #[test]
    fn look_at_refuses_degenerate_directions() {
        let p = Point3::new(1.0, 1.0, 1.0);
        assert!(Pose::look_at(p, p, Vector3::y()).is_none());
        assert!(Pose::look_at(p, p + Vector3::y(), Vector3::y()).is_none());
    }
}
