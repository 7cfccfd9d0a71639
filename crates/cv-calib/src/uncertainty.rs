//! Projection uncertainty over the image, and coverage by corners.

use cv_core::{Camera, Point2, Point3, Vector3};
use cv_parallel::prelude::*;
use nalgebra::{DMatrix, Matrix2, Matrix6, SMatrix, SVector};

/// Maximum number of corners that the implied transformation is fitted to.
const MAX_POINTS: usize = 2000;

/// Projection uncertainty of a distant point, over the image.
///
/// A change of the intrinsics that a motion of the camera compensates for is no error, since a user estimates the pose
/// with the same intrinsics. So the motion that fits the corners best is subtracted from the change of a pixel by the
/// intrinsics (the implied transformation of mrcal). Only the noise of the corners is propagated, not errors of the
/// lens model.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct UncertaintyMap {
    /// Columns of the grid; the first and last are the left and right edge pixels.
    pub columns: usize,
    /// Rows of the grid.
    pub rows: usize,
    /// Standard deviation in the worst direction, in pixels, row by row; NaN where the pixel has no ray.
    pub pixels: Vec<f64>,
}

impl UncertaintyMap {
    /// Returns the pixel of an entry, in an image of the given size.
    pub fn position(&self, index: usize, (width, height): (usize, usize)) -> Point2<f64> {
        let along = |i: usize, n: usize, size: usize| i as f64 * (size as f64 - 1.0) / (n - 1) as f64;
        Point2::new(along(index % self.columns, self.columns, width), along(index / self.columns, self.rows, height))
    }

    /// Returns the largest value and its index; `None` if all are NaN.
    pub fn worst(&self) -> Option<(usize, f64)> {
        let finite = self.pixels.iter().copied().enumerate().filter(|(_, v)| !v.is_nan());
        finite.max_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// Returns the median; NaN if all are NaN.
    pub fn median(&self) -> f64 {
        let mut finite: Vec<f64> = self.pixels.iter().copied().filter(|v| !v.is_nan()).collect();
        cv_core::median(&mut finite).unwrap_or(f64::NAN)
    }
}

/// Returns the derivatives of a pixel by a motion of the camera (rotation, translation), for a point in its frame.
fn by_motion(by_point: &SMatrix<f64, 2, 3>, point: &Vector3<f64>) -> SMatrix<f64, 2, 6> {
    let mut j = SMatrix::<f64, 2, 6>::zeros();
    j.fixed_columns_mut::<3>(0).copy_from(&(-by_point * point.cross_matrix()));
    j.fixed_columns_mut::<3>(3).copy_from(by_point);
    j
}

/// Computes the map on a grid. `covariance` is that of the camera's intrinsics, `points` are the corners in the
/// camera's frame.
pub(crate) fn uncertainty_map(
    camera: &Camera,
    covariance: &DMatrix<f64>,
    points: &[Point3<f64>],
    (columns, rows): (usize, usize),
) -> UncertaintyMap {
    let n = camera.intrinsic_count();
    let mut normal = Matrix6::<f64>::zeros();
    let mut motion_by_intrinsics = DMatrix::<f64>::zeros(6, n);
    // Scaled to the mean distance, so that rotations and translations are of order one.
    let distance = points.iter().map(|p| p.z).sum::<f64>() / points.len().max(1) as f64;
    for p in points.iter().step_by(points.len().div_ceil(MAX_POINTS).max(1)) {
        let p = p / distance;
        let Some(projection) = camera.project_with_jacobians(&p) else { continue };
        let motion = by_motion(&projection.point_jacobian, &p.coords);
        normal += motion.transpose() * motion;
        motion_by_intrinsics += motion.transpose() * projection.intrinsics_jacobian.columns(0, n);
    }
    // The motion that compensates for a change of the intrinsics: −(MᵀM)⁻¹ MᵀI.
    let rotation_by_intrinsics = match normal.try_inverse() {
        Some(inverse) => -(inverse.fixed_rows::<3>(0) * motion_by_intrinsics),
        None => SMatrix::<f64, 3, 6>::zeros() * motion_by_intrinsics,
    };
    let map = UncertaintyMap { columns, rows, pixels: Vec::new() };
    let size = (camera.width, camera.height);
    let sigma_at = |i: usize| {
        let ray = camera.normalize(map.position(i, size));
        let direction = Point3::new(ray.x, ray.y, 1.0);
        let Some(projection) = camera.project_with_jacobians(&direction).filter(|_| ray.x.is_finite()) else {
            return f64::NAN;
        };
        // A distant point does not depend on the translation.
        let motion = by_motion(&projection.point_jacobian, &direction.coords);
        let change =
            projection.intrinsics_jacobian.columns(0, n) + motion.fixed_columns::<3>(0) * &rotation_by_intrinsics;
        let c = &change * covariance * change.transpose();
        max_sigma(&Matrix2::new(c[(0, 0)], c[(0, 1)], c[(1, 0)], c[(1, 1)]))
    };
    let pixels = (0..columns * rows).into_par_iter().map(sigma_at).collect();
    UncertaintyMap { pixels, ..map }
}

/// Returns the standard deviation in the worst direction: the square root of the larger eigenvalue.
fn max_sigma(c: &Matrix2<f64>) -> f64 {
    let (mean, half_difference) = (0.5 * c.trace(), 0.5 * (c.m11 - c.m22));
    (mean + half_difference.hypot(0.5 * (c.m12 + c.m21))).max(0.0).sqrt()
}

/// Number of corners in each cell of the image.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CoverageMap {
    /// Columns of the grid of cells.
    pub columns: usize,
    /// Rows of the grid of cells.
    pub rows: usize,
    /// Corners in each cell, row by row.
    pub corners: Vec<u32>,
}

impl CoverageMap {
    pub(crate) fn new(
        pixels: impl Iterator<Item = Point2<f64>>,
        (width, height): (usize, usize),
        (columns, rows): (usize, usize),
    ) -> Self {
        let mut corners = vec![0; columns * rows];
        let cell = |x: f64, size: usize, n: usize| (((x + 0.5) / size as f64 * n as f64) as usize).min(n - 1);
        for p in pixels {
            corners[cell(p.y, height, rows) * columns + cell(p.x, width, columns)] += 1;
        }
        Self { columns, rows, corners }
    }

    /// Returns the fraction of cells with a corner, among the cells with centers in these ranges, relative to the width
    /// and height.
    pub fn covered_fraction(&self, x: [f64; 2], y: [f64; 2]) -> f64 {
        let is_within = |i: usize, n: usize, range: [f64; 2]| {
            let center = (i as f64 + 0.5) / n as f64;
            range[0] <= center && center <= range[1]
        };
        let cells = self.corners.iter().enumerate();
        let counts: SVector<f64, 2> = cells
            .filter(|(i, _)| is_within(i % self.columns, self.columns, x) && is_within(i / self.columns, self.rows, y))
            .map(|(_, n)| SVector::from([1.0, f64::from(u8::from(*n > 0))]))
            .sum();
        counts[1] / counts[0].max(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_of_the_principal_point_is_mostly_a_rotation() {
        let camera = Camera::from_focal(640, 480, 500.0);
        let points: Vec<Point3<f64>> = (0..48)
            .map(|i| Point3::new(f64::from(i % 8) - 3.5, f64::from(i / 8) - 2.5, 10.0 + f64::from(i % 5)))
            .collect();
        let mut covariance = DMatrix::zeros(4, 4);
        covariance[(2, 2)] = 1.0;
        let map = uncertainty_map(&camera, &covariance, &points, (9, 7));
        // A rotation by 1/500 moves the center by a pixel, and the border at 32° by 1/cos² of that: 1.41. The best
        // rotation leaves well below a pixel.
        assert!(map.worst().unwrap().1 < 0.5 && map.median() < 0.25, "{map:?}");
        let mut covariance = DMatrix::zeros(4, 4);
        covariance[(0, 0)] = 1.0;
        covariance[(1, 1)] = 1.0;
        covariance[(0, 1)] = 1.0;
        covariance[(1, 0)] = 1.0;
        let map = uncertainty_map(&camera, &covariance, &points, (9, 7));
        // A relative change of the focal length by 1/500 moves the image corner, 399 px from the center, by 0.8; no
        // rotation compensates for it.
        assert!((map.worst().unwrap().1 - 0.8).abs() < 0.05, "{map:?}");
    }

    #[test]
    fn coverage_counts_cells() {
        let pixels = [(0.0, 0.0), (639.0, 479.0), (700.0, -5.0)].map(|(x, y)| Point2::new(x, y));
        let map = CoverageMap::new(pixels.into_iter(), (640, 480), (4, 2));
        assert_eq!(map.corners, [1, 0, 0, 1, 0, 0, 0, 1]);
        assert_eq!(map.covered_fraction([0.0, 0.25], [0.0, 1.0]), 0.5);
        assert_eq!(map.covered_fraction([0.75, 1.0], [0.0, 1.0]), 1.0);
    }
}
