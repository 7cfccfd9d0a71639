//! The reprojection error of a corner, with its derivatives.

use crate::target::{TargetCorner, TargetPoints};
use cv_core::{Camera, Point2, Point3, Vector3};
use cv_numeric::adjust::{Residual, RigidMotion};
use nalgebra::{Matrix2x3, SMatrix, Vector2};

/// A corner: where it is on the target, how bending moves it along z, and where it was seen.
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

/// As [`Camera::with_intrinsics`], in place for each residual.
#[inline(always)]
fn with_lens<const N: usize>(camera: &Camera, lens: &[f64]) -> Camera {
    let lens = &lens[..N];
    let mut camera = Camera { fx: lens[0], fy: lens[1], cx: lens[2], cy: lens[3], ..*camera };
    // Of a length that the compiler knows: a loop up to the model's own count takes longer than the projection.
    camera.distortion.parameters_mut()[..N - 4].copy_from_slice(&lens[4..]);
    camera
}

/// Writes the columns of a motion `x ↦ turned + t`: those of the turn, then those of t.
#[inline(always)]
fn by_motion<const C: usize>(j: &mut SMatrix<f64, 2, C>, first: usize, by: &Matrix2x3<f64>, turned: &Vector3<f64>) {
    for row in 0..2 {
        // −b [x]× is the row x × b.
        let turn = turned.cross(&by.row(row).transpose());
        for k in 0..3 {
            j[(row, first + k)] = turn[k];
        }
    }
    j.fixed_columns_mut::<3>(first + 3).copy_from(by);
}

/// Writes the columns of the target's deflections, along the third axis of its frame as the camera sees it.
#[inline]
fn by_shape<const C: usize>(j: &mut SMatrix<f64, 2, C>, first: usize, along: Vector2<f64>, deflection: [f64; 2]) {
    for (k, d) in deflection.into_iter().enumerate() {
        j.set_column(first + k, &(along * d));
    }
}

/// Corners of the camera whose frame the poses lead to: blocks pose (6), lens (`N`), shape (2); `C` is their sum.
pub(crate) struct FromReference<const N: usize, const C: usize> {
    pub(crate) camera: Camera,
    pub(crate) items: Vec<Corner>,
}

impl<const N: usize, const C: usize> Residual<2, 3, C> for FromReference<N, C> {
    const DIMS: [usize; 3] = [6, N, 2];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [pose, lens, shape]: [&[f64]; 3],
        jacobian: Option<&mut SMatrix<f64, 2, C>>,
    ) -> Option<Vector2<f64>> {
        let corner = &self.items[item];
        let (rotation, translation) = RigidMotion::load(pose);
        let turned = rotation * corner.on_target(shape);
        let p = Point3::from(turned + translation);
        let camera = with_lens::<N>(&self.camera, lens);
        let Some(j) = jacobian else { return camera.project(&p).map(|seen| seen - corner.pixel) };
        let seen = camera.project_with_jacobians(&p)?;
        by_motion(j, 0, &seen.point_jacobian, &turned);
        j.fixed_columns_mut::<N>(6).copy_from(&seen.intrinsics_jacobian.fixed_columns::<N>(0));
        by_shape(j, 6 + N, seen.point_jacobian * rotation.matrix().column(2), corner.deflection);
        Some(seen.pixel - corner.pixel)
    }
}

/// Corners of another camera of a rig: blocks pose (6), mount (6), lens (`N`), shape (2).
pub(crate) struct FromMount<const N: usize, const C: usize> {
    pub(crate) camera: Camera,
    pub(crate) items: Vec<Corner>,
}

impl<const N: usize, const C: usize> Residual<2, 4, C> for FromMount<N, C> {
    const DIMS: [usize; 4] = [6, 6, N, 2];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [pose, mount, lens, shape]: [&[f64]; 4],
        jacobian: Option<&mut SMatrix<f64, 2, C>>,
    ) -> Option<Vector2<f64>> {
        let corner = &self.items[item];
        let (rotation, translation) = RigidMotion::load(pose);
        let (mount, offset) = RigidMotion::load(mount);
        let turned = rotation * corner.on_target(shape);
        let in_mount = mount * (turned + translation);
        let p = Point3::from(in_mount + offset);
        let camera = with_lens::<N>(&self.camera, lens);
        let Some(j) = jacobian else { return camera.project(&p).map(|seen| seen - corner.pixel) };
        let seen = camera.project_with_jacobians(&p)?;
        let by_reference = seen.point_jacobian * mount.matrix();
        by_motion(j, 0, &by_reference, &turned);
        by_motion(j, 6, &seen.point_jacobian, &in_mount);
        j.fixed_columns_mut::<N>(12).copy_from(&seen.intrinsics_jacobian.fixed_columns::<N>(0));
        by_shape(j, 12 + N, by_reference * rotation.matrix().column(2), corner.deflection);
        Some(seen.pixel - corner.pixel)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Distortion, Pose, Rotation3};
    use cv_numeric::adjust::{Euclidean, Manifold};

    #[test]
    fn derivatives_are_those_of_the_residuals() {
        let target = TargetPoints::grid(9, 6, 1.0).unwrap();
        let pose = Pose::new(Rotation3::new(Vector3::new(0.3, -0.4, 0.2)), Vector3::new(-3.0, -2.0, 12.0));
        let mount = Pose::new(Rotation3::new(Vector3::new(-0.05, 0.1, 0.02)), Vector3::new(-2.0, 0.1, 0.3));
        let rational = [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, -0.05, 0.02];
        let prism = [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, -0.05, 0.02, 1e-3, 2e-3, -1e-3, 3e-3];
        check::<8, 16, 22>(&target, &pose, &mount, Distortion::radial_tangential4([-0.2, 0.05, 1e-3, -2e-3]));
        check::<8, 16, 22>(&target, &pose, &mount, Distortion::fisheye4([0.05, -0.02, 0.01, -0.003]));
        check::<9, 17, 23>(&target, &pose, &mount, Distortion::radial_tangential5([-0.2, 0.05, 1e-3, -2e-3, 0.01]));
        check::<12, 20, 26>(&target, &pose, &mount, Distortion::rational8(rational));
        check::<16, 24, 30>(&target, &pose, &mount, Distortion::thin_prism12(prism));
    }

    fn check<const N: usize, const ONE: usize, const MORE: usize>(
        target: &TargetPoints,
        pose: &Pose,
        mount: &Pose,
        distortion: Distortion,
    ) {
        let camera = Camera { distortion, ..Camera::pinhole(640, 480, 500.0, 510.0, 310.0, 245.0) };
        let store = |p: &Pose| RigidMotion::store(&p.rotation, &p.translation).to_vec();
        let blocks = [store(pose), store(mount), camera.intrinsics()[..N].to_vec(), vec![0.05, -0.03]];
        let corner = TargetCorner { point: 13, pixel: Point2::new(300.0, 200.0) };
        let items = vec![Corner::new(target, &corner)];
        let one = FromReference::<N, ONE> { camera, items: items.clone() };
        let more = FromMount::<N, MORE> { camera, items };
        let at = |b: &[Vec<f64>; 4]| {
            let first = one.evaluate(0, [&b[0], &b[2], &b[3]], None).unwrap();
            (first, more.evaluate(0, [&b[0], &b[1], &b[2], &b[3]], None).unwrap())
        };
        let (mut j, mut k) = (SMatrix::zeros(), SMatrix::zeros());
        one.evaluate(0, [&blocks[0], &blocks[2], &blocks[3]], Some(&mut j)).unwrap();
        more.evaluate(0, [&blocks[0], &blocks[1], &blocks[2], &blocks[3]], Some(&mut k)).unwrap();
        let mut column = 0;
        for (b, size) in [6, 6, N, 2].into_iter().enumerate() {
            for i in 0..size {
                let moved = |h: f64| {
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
                let (plus, minus) = (moved(1e-6), moved(-1e-6));
                // Pixels of some hundreds: 1e-13 of rounding by 1e-6, and h² of truncation by derivatives of some thousands.
                let near = |a: Vector2<f64>, b: Vector2<f64>| (a - b).norm() < 1e-6 * (1.0 + b.norm());
                assert!(near((plus.1 - minus.1) / 2e-6, k.column(column).into()), "mount: block {b}, {i}");
                let within = [Some(i), None, Some(6 + i), Some(6 + N + i)][b];
                if let Some(within) = within {
                    assert!(near((plus.0 - minus.0) / 2e-6, j.column(within).into()), "block {b}, {i}");
                }
                column += 1;
            }
        }
    }
}
