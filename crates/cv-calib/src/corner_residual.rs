//! Reprojection residuals of target corners, with their Jacobians.

use crate::target::{TargetCorner, TargetPoints};
use cv_core::{Camera, Point2, Point3, Vector3};
use cv_numeric::adjust::{Residual, RigidMotion};
use nalgebra::{Matrix2x3, SMatrix, Vector2};

/// A corner: its position on the target, the derivatives of its z by the deflections, and the detected pixel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Corner {
    point: Point2<f64>,
    deflection: [f64; 2],
    pixel: Point2<f64>,
}

impl Corner {
    pub(crate) fn new(target: &TargetPoints, corner: &TargetCorner) -> Self {
        Self { point: target.points()[corner.point], deflection: target.deflection(corner.point), pixel: corner.pixel }
    }

    #[inline]
    fn on_target(&self, shape: &[f64]) -> Vector3<f64> {
        Vector3::new(self.point.x, self.point.y, shape[0] * self.deflection[0] + shape[1] * self.deflection[1])
    }
}

/// As [`Camera::with_intrinsics`], inlined for each residual.
#[inline(always)]
fn with_intrinsics<const N: usize>(camera: &Camera, intrinsics: &[f64]) -> Camera {
    let intrinsics = &intrinsics[..N];
    let mut camera = Camera { fx: intrinsics[0], fy: intrinsics[1], cx: intrinsics[2], cy: intrinsics[3], ..*camera };
    // A constant length: a loop over the model's own number of coefficients takes longer than the projection.
    camera.distortion.parameters_mut()[..N - 4].copy_from_slice(&intrinsics[4..]);
    camera
}

/// Writes the Jacobian by a rigid motion `x ↦ rotated + t`: the columns of the rotation, then those of t.
#[inline(always)]
fn by_motion<const C: usize>(j: &mut SMatrix<f64, 2, C>, first: usize, by: &Matrix2x3<f64>, rotated: &Vector3<f64>) {
    for row in 0..2 {
        // −b [x]× is the row x × b.
        let by_rotation = rotated.cross(&by.row(row).transpose());
        for k in 0..3 {
            j[(row, first + k)] = by_rotation[k];
        }
    }
    j.fixed_columns_mut::<3>(first + 3).copy_from(by);
}

/// Writes the Jacobian by the target's deflections; `along` is the derivative by the z axis of the target.
#[inline]
fn by_shape<const C: usize>(j: &mut SMatrix<f64, 2, C>, first: usize, along: Vector2<f64>, deflection: [f64; 2]) {
    for (k, d) in deflection.into_iter().enumerate() {
        j.set_column(first + k, &(along * d));
    }
}

/// Residuals of the first camera: blocks target pose (6), intrinsics (`N`), shape (2); `C` is their sum.
pub(crate) struct FirstCameraResidual<const N: usize, const C: usize> {
    pub(crate) camera: Camera,
    pub(crate) items: Vec<Corner>,
}

impl<const N: usize, const C: usize> Residual<2, 3, C> for FirstCameraResidual<N, C> {
    const DIMS: [usize; 3] = [6, N, 2];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [pose, intrinsics, shape]: [&[f64]; 3],
        jacobian: Option<&mut SMatrix<f64, 2, C>>,
    ) -> Option<Vector2<f64>> {
        let corner = &self.items[item];
        let (rotation, translation) = RigidMotion::load(pose);
        let rotated = rotation * corner.on_target(shape);
        let p = Point3::from(rotated + translation);
        let camera = with_intrinsics::<N>(&self.camera, intrinsics);
        let Some(j) = jacobian else { return camera.project(&p).map(|projection| projection - corner.pixel) };
        let projection = camera.project_with_jacobians(&p)?;
        by_motion(j, 0, &projection.point_jacobian, &rotated);
        j.fixed_columns_mut::<N>(6).copy_from(&projection.intrinsics_jacobian.fixed_columns::<N>(0));
        by_shape(j, 6 + N, projection.point_jacobian * rotation.matrix().column(2), corner.deflection);
        Some(projection.pixel - corner.pixel)
    }
}

/// Residuals of another camera of a rig: blocks target pose (6), rig pose (6), intrinsics (`N`), shape (2).
pub(crate) struct RigCameraResidual<const N: usize, const C: usize> {
    pub(crate) camera: Camera,
    pub(crate) items: Vec<Corner>,
}

impl<const N: usize, const C: usize> Residual<2, 4, C> for RigCameraResidual<N, C> {
    const DIMS: [usize; 4] = [6, 6, N, 2];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [pose, rig_pose, intrinsics, shape]: [&[f64]; 4],
        jacobian: Option<&mut SMatrix<f64, 2, C>>,
    ) -> Option<Vector2<f64>> {
        let corner = &self.items[item];
        let (rotation, translation) = RigidMotion::load(pose);
        let (rig_pose, offset) = RigidMotion::load(rig_pose);
        let rotated = rotation * corner.on_target(shape);
        let in_rig_camera = rig_pose * (rotated + translation);
        let p = Point3::from(in_rig_camera + offset);
        let camera = with_intrinsics::<N>(&self.camera, intrinsics);
        let Some(j) = jacobian else { return camera.project(&p).map(|projection| projection - corner.pixel) };
        let projection = camera.project_with_jacobians(&p)?;
        let by_reference = projection.point_jacobian * rig_pose.matrix();
        by_motion(j, 0, &by_reference, &rotated);
        by_motion(j, 6, &projection.point_jacobian, &in_rig_camera);
        j.fixed_columns_mut::<N>(12).copy_from(&projection.intrinsics_jacobian.fixed_columns::<N>(0));
        by_shape(j, 12 + N, by_reference * rotation.matrix().column(2), corner.deflection);
        Some(projection.pixel - corner.pixel)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Distortion, Pose, Rotation3};
    use cv_numeric::adjust::{Euclidean, Manifold};

    #[test]
    fn jacobians_agree_with_finite_differences() {
        let target = TargetPoints::grid(9, 6, 1.0).unwrap();
        let pose = Pose::new(Rotation3::new(Vector3::new(0.3, -0.4, 0.2)), Vector3::new(-3.0, -2.0, 12.0));
        let rig_pose = Pose::new(Rotation3::new(Vector3::new(-0.05, 0.1, 0.02)), Vector3::new(-2.0, 0.1, 0.3));
        let rational = [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, -0.05, 0.02];
        let prism = [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, -0.05, 0.02, 1e-3, 2e-3, -1e-3, 3e-3];
        check::<8, 16, 22>(&target, &pose, &rig_pose, Distortion::radial_tangential4([-0.2, 0.05, 1e-3, -2e-3]));
        check::<8, 16, 22>(&target, &pose, &rig_pose, Distortion::fisheye4([0.05, -0.02, 0.01, -0.003]));
        check::<9, 17, 23>(&target, &pose, &rig_pose, Distortion::radial_tangential5([-0.2, 0.05, 1e-3, -2e-3, 0.01]));
        check::<12, 20, 26>(&target, &pose, &rig_pose, Distortion::rational8(rational));
        check::<16, 24, 30>(&target, &pose, &rig_pose, Distortion::thin_prism12(prism));
    }

    fn check<const N: usize, const FIRST_DIMS: usize, const RIG_DIMS: usize>(
        target: &TargetPoints,
        pose: &Pose,
        rig_pose: &Pose,
        distortion: Distortion,
    ) {
        let camera = Camera { distortion, ..Camera::pinhole(640, 480, 500.0, 510.0, 310.0, 245.0) };
        let store = |p: &Pose| RigidMotion::store(&p.rotation, &p.translation).to_vec();
        let blocks = [store(pose), store(rig_pose), camera.intrinsics()[..N].to_vec(), vec![0.05, -0.03]];
        let corner = TargetCorner { point: 13, pixel: Point2::new(300.0, 200.0) };
        let items = vec![Corner::new(target, &corner)];
        let first_camera = FirstCameraResidual::<N, FIRST_DIMS> { camera, items: items.clone() };
        let rig_camera = RigCameraResidual::<N, RIG_DIMS> { camera, items };
        let at = |b: &[Vec<f64>; 4]| {
            let first = first_camera.evaluate(0, [&b[0], &b[2], &b[3]], None).unwrap();
            (first, rig_camera.evaluate(0, [&b[0], &b[1], &b[2], &b[3]], None).unwrap())
        };
        let (mut j, mut k) = (SMatrix::zeros(), SMatrix::zeros());
        first_camera.evaluate(0, [&blocks[0], &blocks[2], &blocks[3]], Some(&mut j)).unwrap();
        rig_camera.evaluate(0, [&blocks[0], &blocks[1], &blocks[2], &blocks[3]], Some(&mut k)).unwrap();
        let mut column = 0;
        for (b, size) in [6, 6, N, 2].into_iter().enumerate() {
            for i in 0..size {
                let perturbed = |h: f64| {
                    let mut all = blocks.clone();
                    let mut delta = vec![0.0; size];
                    delta[i] = h;
                    if b < 2 {
                        RigidMotion.step(&blocks[b], &delta, &mut all[b]);
                    } else {
                        Euclidean(size).step(&blocks[b], &delta, &mut all[b]);
                    }
                    at(&all)
                };
                let (plus, minus) = (perturbed(1e-6), perturbed(-1e-6));
                // Pixels of some hundreds: rounding 1e-13 over 1e-6, and truncation h² times derivatives of some
                // thousands.
                let is_close = |a: Vector2<f64>, b: Vector2<f64>| (a - b).norm() < 1e-6 * (1.0 + b.norm());
                assert!(is_close((plus.1 - minus.1) / 2e-6, k.column(column).into()), "rig_pose: block {b}, {i}");
                let first_camera_column = [Some(i), None, Some(6 + i), Some(6 + N + i)][b];
                if let Some(first_camera_column) = first_camera_column {
                    assert!(
                        is_close((plus.0 - minus.0) / 2e-6, j.column(first_camera_column).into()),
                        "block {b}, {i}"
                    );
                }
                column += 1;
            }
        }
    }
}
