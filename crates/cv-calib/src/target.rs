//! The planar target and its observations.

use crate::CalibrateError;
use cv_core::{Point2, Point3, Pose, Rotation3, Vector2, Vector3};

/// The points of a planar calibration target, such as the inner corners of a chessboard.
///
/// Target frame: x right and y down on its face, z into it. The unit is the caller's, and that of the poses.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetPoints {
    points: Vec<Point2<f64>>,
    center: Point2<f64>,
    half_size: Vector2<f64>,
    /// Rotational symmetries other than the identity: the angle in radians from x to y, and the permutation of the
    /// points.
    symmetries: Vec<(f64, Vec<usize>)>,
}

impl TargetPoints {
    /// Creates a target from the positions of its points.
    ///
    /// # Errors
    /// [`CalibrateError::Target`] with fewer than four points, a coordinate that is not finite or too large, or no
    /// extent in x or y.
    pub fn new(points: Vec<Point2<f64>>) -> Result<Self, CalibrateError> {
        let degenerate = CalibrateError::Target { points: points.len() };
        if points.len() < 4 || points.iter().any(|p| !(p.x.abs() <= 1e9 && p.y.abs() <= 1e9)) {
            return Err(degenerate);
        }
        let (mut low, mut high) = (points[0], points[0]);
        for p in &points {
            (low, high) = (low.inf(p), high.sup(p));
        }
        let half_size = (high - low) / 2.0;
        if half_size.x <= 0.0 || half_size.y <= 0.0 {
            return Err(degenerate);
        }
        Ok(Self { points, center: low + half_size, half_size, symmetries: Vec::new() })
    }

    /// Creates a grid of `columns × rows` points in row-major order, `spacing` apart.
    ///
    /// # Errors
    /// [`CalibrateError::Target`] if a side has fewer than two points or the spacing is not positive.
    pub fn grid(columns: usize, rows: usize, spacing: f64) -> Result<Self, CalibrateError> {
        let count = columns.saturating_mul(rows);
        if columns < 2 || rows < 2 || count > 1_000_000 || spacing.is_nan() || spacing <= 0.0 {
            return Err(CalibrateError::Target { points: count });
        }
        let at = |i: usize| Point2::new((i % columns) as f64 * spacing, (i / columns) as f64 * spacing);
        Self::new((0..count).map(at).collect())
    }

    /// Declares a rotational symmetry of order `count`: the target maps to itself under rotations by 1/`count` of a
    /// turn about its center. It is 2 for a board that looks the same upside down, 4 for one that looks the same after
    /// a quarter turn. Cameras may then number the points differently in one view, which
    /// [`calibrate`](crate::calibrate) corrects. Rotations that do not map points to points are ignored.
    pub fn with_rotational_symmetry(mut self, count: usize) -> Self {
        let tolerance = 1e-6 * self.half_size.norm();
        let symmetry = |index_of_rotation: usize| -> Option<(f64, Vec<usize>)> {
            let angle = index_of_rotation as f64 * std::f64::consts::TAU / count as f64;
            let (sin, cos) = angle.sin_cos();
            let rotate = |p: &Point2<f64>| {
                let d = p - self.center;
                self.center + Vector2::new(cos * d.x - sin * d.y, sin * d.x + cos * d.y)
            };
            let index = |p: Point2<f64>| self.points.iter().position(|q| (p - q).norm() <= tolerance);
            Some((angle, self.points.iter().map(|p| index(rotate(p))).collect::<Option<_>>()?))
        };
        self.symmetries = (1..count).filter_map(symmetry).collect();
        self
    }

    /// Returns the rotational symmetries as rigid motions of the target; the first is the identity.
    pub(crate) fn symmetries(&self) -> Vec<Pose> {
        let motion = |angle: f64| {
            let rotation = Rotation3::new(Vector3::new(0.0, 0.0, angle));
            let center = Vector3::new(self.center.x, self.center.y, 0.0);
            Pose::new(rotation, center - rotation * center)
        };
        std::iter::once(0.0).chain(self.symmetries.iter().map(|symmetry| symmetry.0)).map(motion).collect()
    }

    /// Returns the index of a point after symmetry `symmetry`
    /// ([`CalibratedImage::symmetry`](crate::CalibratedImage::symmetry)); 0 is the identity.
    pub fn symmetric_index(&self, point: usize, symmetry: usize) -> usize {
        let mapped = symmetry.checked_sub(1).and_then(|s| self.symmetries.get(s)?.1.get(point));
        mapped.copied().unwrap_or(point)
    }

    /// Returns the positions of the points on the planar target.
    pub fn points(&self) -> &[Point2<f64>] {
        &self.points
    }

    /// Returns the size of the bounding rectangle of the points.
    pub fn size(&self) -> Vector2<f64> {
        2.0 * self.half_size
    }

    /// Returns the derivatives of the z of a point by the deflections in x and y ([`TargetPoints::bent`]): `1 − u²`, `1
    /// − v²` with u and v from −1 to 1 over the target.
    pub fn deflection(&self, index: usize) -> [f64; 2] {
        let d = (self.points[index] - self.center).component_div(&self.half_size);
        [1.0 - d.x * d.x, 1.0 - d.y * d.y]
    }

    /// Returns a point of the deflected target (board warp), a parabola in x and one in y: `z = kx (1 − u²) + ky (1 −
    /// v²)`, the model of mrcal. `[kx, ky]` are the deflections of the center relative to the borders, in the unit of
    /// the target.
    pub fn bent(&self, index: usize, shape: [f64; 2]) -> Point3<f64> {
        let (p, d) = (self.points[index], self.deflection(index));
        Point3::new(p.x, p.y, shape[0] * d[0] + shape[1] * d[1])
    }
}

/// A detected point of the target in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct TargetCorner {
    /// Index of the point of the target ([`TargetPoints::points`]).
    pub point: usize,
    /// Its pixel, with pixel centers at integers.
    pub pixel: Point2<f64>,
}

/// The input of a calibration: a target, the image sizes of the cameras, and the detected corners in each view and
/// camera.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetObservations {
    /// The target.
    pub target: TargetPoints,
    /// Image width and height of each camera, in pixels.
    pub sizes: Vec<(usize, usize)>,
    /// Corners by view and camera: `views[v][c]`. The cameras of a view are exposed at the same time. Empty where a
    /// camera has no corners.
    pub views: Vec<Vec<Vec<TargetCorner>>>,
}

impl TargetObservations {
    /// Returns the observations of one camera as an input of its own, and the indices of its views with corners.
    pub fn of_camera(&self, camera: usize) -> (Self, Vec<usize>) {
        let observed: Vec<usize> = (0..self.views.len()).filter(|v| !self.views[*v][camera].is_empty()).collect();
        let views = observed.iter().map(|v| vec![self.views[*v][camera].clone()]).collect();
        (Self { target: self.target.clone(), sizes: vec![self.sizes[camera]], views }, observed)
    }

    /// Returns the observations of some of the views.
    pub(crate) fn subset(&self, views: &[usize]) -> Self {
        let views = views.iter().map(|v| self.views[*v].clone()).collect();
        Self { target: self.target.clone(), sizes: self.sizes.clone(), views }
    }

    /// Validates the input.
    pub(crate) fn validate(&self) -> Result<(), CalibrateError> {
        if self.views.is_empty() || self.sizes.is_empty() {
            return Err(CalibrateError::NoViews);
        }
        for (camera, &(width, height)) in self.sizes.iter().enumerate() {
            if width < 2 || height < 2 || width > 1_000_000 || height > 1_000_000 {
                return Err(CalibrateError::Size { camera, width, height });
            }
        }
        let points = self.target.points.len();
        for (view, cameras) in self.views.iter().enumerate() {
            if cameras.len() != self.sizes.len() {
                return Err(CalibrateError::Cameras { view, got: cameras.len(), needed: self.sizes.len() });
            }
            for (camera, corners) in cameras.iter().enumerate() {
                let mut observed = vec![false; points];
                for (corner, c) in corners.iter().enumerate() {
                    let Some(observed) = observed.get_mut(c.point) else {
                        return Err(CalibrateError::Point { view, camera, point: c.point, points });
                    };
                    if std::mem::replace(observed, true) {
                        return Err(CalibrateError::Twice { view, camera, point: c.point });
                    }
                    if !(c.pixel.x.abs() <= 1e7 && c.pixel.y.abs() <= 1e7) {
                        return Err(CalibrateError::NotFinite { view, camera, corner });
                    }
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deflections_follow_the_two_parabolas() {
        let target = TargetPoints::grid(5, 3, 2.0).unwrap();
        assert_eq!(target.size(), Vector2::new(8.0, 4.0));
        // The center has both deflections in full, a corner none, the center of the upper side that in x.
        assert_eq!(target.bent(7, [0.5, 0.25]), Point3::new(4.0, 2.0, 0.75));
        assert_eq!(target.bent(0, [0.5, 0.25]), Point3::new(0.0, 0.0, 0.0));
        assert_eq!(target.bent(2, [0.5, 0.25]), Point3::new(4.0, 0.0, 0.5));
        assert_eq!(target.deflection(1), [0.75, 0.0]);
    }

    #[test]
    fn rotational_symmetries_permute_the_points() {
        let target = TargetPoints::grid(4, 3, 2.0).unwrap();
        assert_eq!((target.symmetric_index(1, 0), target.symmetric_index(1, 1)), (1, 1));
        let half = target.clone().with_rotational_symmetry(2);
        assert_eq!((0..12).map(|i| half.symmetric_index(i, 1)).collect::<Vec<_>>(), (0..12).rev().collect::<Vec<_>>());
        let symmetries = half.symmetries();
        for (i, p) in target.points().iter().enumerate() {
            let q = target.points()[half.symmetric_index(i, 1)];
            let rotated = symmetries[1].transform(&Point3::new(p.x, p.y, 0.0));
            // Rounding of a rotation of lengths below ten.
            assert!((rotated - Point3::new(q.x, q.y, 0.0)).norm() < 1e-12);
        }
        // A quarter turn maps a square grid to itself, and no other.
        assert_eq!(target.with_rotational_symmetry(4).symmetries().len(), 2);
        assert_eq!(TargetPoints::grid(3, 3, 1.0).unwrap().with_rotational_symmetry(4).symmetries().len(), 4);
    }

    #[test]
    fn targets_without_area_are_errors() {
        for (columns, rows, spacing) in [(1, 6, 1.0), (9, 6, 0.0), (9, 6, f64::NAN), (usize::MAX, 6, 1.0)] {
            assert!(matches!(TargetPoints::grid(columns, rows, spacing), Err(CalibrateError::Target { .. })));
        }
        let line = (0..5).map(|i| Point2::new(f64::from(i), 1.0)).collect();
        assert_eq!(TargetPoints::new(line), Err(CalibrateError::Target { points: 5 }));
    }
}
