//! How well a camera's projection is known, over its picture.

use cv_core::{Camera, Point2, Point3, Vector3};
use nalgebra::{DMatrix, Matrix2, Matrix6, SMatrix, SVector};
use rayon::prelude::*;

/// Corners that the implied motion is fitted to.
const MOST_POINTS: usize = 2000;

/// How far off a pixel may be that a calibrated camera says for a far point, over the picture.
///
/// An error of the lens that a turned or shifted camera would explain as well is none: whoever uses the camera finds its pose by the same lens. So of the
/// change of a pixel with the intrinsics, that of the motion of the camera is taken off that fits the corners best (Kogan's mrcal calls it the implied
/// transformation). Noise of the corners is all that is counted, not that a lens may be of another model.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct UncertaintyMap {
    /// Columns of the grid; the first and last are the left and right edge pixels.
    pub columns: usize,
    /// Rows of the grid.
    pub rows: usize,
    /// Standard deviation in the worst direction, in pixels, row by row; NaN where the lens has no ray.
    pub pixels: Vec<f64>,
}

impl UncertaintyMap {
    /// The pixel of an entry, in a picture of this size.
    pub fn position(&self, index: usize, (width, height): (usize, usize)) -> Point2<f64> {
        let along = |i: usize, n: usize, size: usize| i as f64 * (size as f64 - 1.0) / (n - 1) as f64;
        Point2::new(along(index % self.columns, self.columns, width), along(index / self.columns, self.rows, height))
    }

    /// The largest value and its index; `None` where no entry is a number.
    pub fn worst(&self) -> Option<(usize, f64)> {
        let known = self.pixels.iter().copied().enumerate().filter(|(_, v)| !v.is_nan());
        known.max_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// The middle value; NaN of nothing.
    pub fn median(&self) -> f64 {
        let mut known: Vec<f64> = self.pixels.iter().copied().filter(|v| !v.is_nan()).collect();
        cv_core::median(&mut known).unwrap_or(f64::NAN)
    }
}

/// Derivatives of a pixel by a motion of the camera (turn, shift) for a point in its frame.
fn by_motion(by_point: &SMatrix<f64, 2, 3>, point: &Vector3<f64>) -> SMatrix<f64, 2, 6> {
    let mut j = SMatrix::<f64, 2, 6>::zeros();
    j.fixed_columns_mut::<3>(0).copy_from(&(-by_point * point.cross_matrix()));
    j.fixed_columns_mut::<3>(3).copy_from(by_point);
    j
}

/// The map on a grid. `covariance` is of the camera's intrinsics in their order, `points` are the corners in the camera's frame.
pub(crate) fn uncertainty(
    camera: &Camera,
    covariance: &DMatrix<f64>,
    points: &[Point3<f64>],
    (columns, rows): (usize, usize),
) -> UncertaintyMap {
    let n = camera.intrinsic_count();
    let mut normal = Matrix6::<f64>::zeros();
    let mut across = DMatrix::<f64>::zeros(6, n);
    // Turns and shifts in units of one: by the typical distance.
    let distance = points.iter().map(|p| p.z).sum::<f64>() / points.len().max(1) as f64;
    for p in points.iter().step_by(points.len().div_ceil(MOST_POINTS).max(1)) {
        let p = p / distance;
        let Some(seen) = camera.project_with_jacobians(&p) else { continue };
        let motion = by_motion(&seen.point_jacobian, &p.coords);
        normal += motion.transpose() * motion;
        across += motion.transpose() * seen.intrinsics_jacobian.columns(0, n);
    }
    // The motion that makes up for a change of the intrinsics: −(MᵀM)⁻¹ MᵀI.
    let turn = match normal.try_inverse() {
        Some(inverse) => -(inverse.fixed_rows::<3>(0) * across),
        None => SMatrix::<f64, 3, 6>::zeros() * across,
    };
    let map = UncertaintyMap { columns, rows, pixels: Vec::new() };
    let size = (camera.width, camera.height);
    let of = |i: usize| {
        let ray = camera.normalize(map.position(i, size));
        let direction = Point3::new(ray.x, ray.y, 1.0);
        let Some(seen) = camera.project_with_jacobians(&direction).filter(|_| ray.x.is_finite()) else {
            return f64::NAN;
        };
        // A far point: shifts do not move it.
        let motion = by_motion(&seen.point_jacobian, &direction.coords);
        let change = seen.intrinsics_jacobian.columns(0, n) + motion.fixed_columns::<3>(0) * &turn;
        let c = &change * covariance * change.transpose();
        worst_deviation(&Matrix2::new(c[(0, 0)], c[(0, 1)], c[(1, 0)], c[(1, 1)]))
    };
    let pixels = (0..columns * rows).into_par_iter().map(of).collect();
    UncertaintyMap { pixels, ..map }
}

/// Square root of the larger eigenvalue.
fn worst_deviation(c: &Matrix2<f64>) -> f64 {
    let (middle, half) = (0.5 * c.trace(), 0.5 * (c.m11 - c.m22));
    (middle + half.hypot(0.5 * (c.m12 + c.m21))).max(0.0).sqrt()
}

/// How many corners fell into each cell of a picture.
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

    /// The share of the cells between these shares of the width and of the height that has a corner.
    pub fn share(&self, x: [f64; 2], y: [f64; 2]) -> f64 {
        let within = |i: usize, n: usize, range: [f64; 2]| {
            let middle = (i as f64 + 0.5) / n as f64;
            range[0] <= middle && middle <= range[1]
        };
        let cells = self.corners.iter().enumerate();
        let inside: SVector<f64, 2> = cells
            .filter(|(i, _)| within(i % self.columns, self.columns, x) && within(i / self.columns, self.rows, y))
            .map(|(_, n)| SVector::from([1.0, f64::from(u8::from(*n > 0))]))
            .sum();
        inside[1] / inside[0].max(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_of_the_principal_point_is_mostly_a_turn() {
        let camera = Camera::from_focal(640, 480, 500.0);
        let points: Vec<Point3<f64>> = (0..48)
            .map(|i| Point3::new(f64::from(i % 8) - 3.5, f64::from(i / 8) - 2.5, 10.0 + f64::from(i % 5)))
            .collect();
        let mut covariance = DMatrix::zeros(4, 4);
        covariance[(2, 2)] = 1.0;
        let map = uncertainty(&camera, &covariance, &points, (9, 7));
        // A turn by 1/500 moves the middle by a pixel, the edge at 32° by 1/cos² of that: 1.41. What the best turn leaves is well below the pixel.
        assert!(map.worst().unwrap().1 < 0.5 && map.median() < 0.25, "{map:?}");
        let mut covariance = DMatrix::zeros(4, 4);
        covariance[(0, 0)] = 1.0;
        covariance[(1, 1)] = 1.0;
        covariance[(0, 1)] = 1.0;
        covariance[(1, 0)] = 1.0;
        let map = uncertainty(&camera, &covariance, &points, (9, 7));
        // A relative change of the focal length by 1/500 moves the corner of the picture, 399 px out, by 0.8; no turn makes up for that.
        assert!((map.worst().unwrap().1 - 0.8).abs() < 0.05, "{map:?}");
    }

    #[test]
    fn coverage_counts_cells() {
        let pixels = [(0.0, 0.0), (639.0, 479.0), (700.0, -5.0)].map(|(x, y)| Point2::new(x, y));
        let map = CoverageMap::new(pixels.into_iter(), (640, 480), (4, 2));
        assert_eq!(map.corners, [1, 0, 0, 1, 0, 0, 0, 1]);
        assert_eq!(map.share([0.0, 0.25], [0.0, 1.0]), 0.5);
        assert_eq!(map.share([0.75, 1.0], [0.0, 1.0]), 1.0);
    }
}
