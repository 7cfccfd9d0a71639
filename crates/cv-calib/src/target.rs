//! The flat target and what cameras see of it.

use crate::CalibrateError;
use cv_core::{Point2, Point3, Pose, Rotation3, Vector2, Vector3};

/// The points of a flat calibration target, such as the inner corners of a chessboard.
///
/// Frame of the target: x right and y down on its face, z away from whoever looks at the face. The unit is the caller's, and becomes that of
/// the poses.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetPoints {
    points: Vec<Point2<f64>>,
    middle: Point2<f64>,
    half: Vector2<f64>,
    /// Each further turn after which the target looks the same, in radians from x to y, and what each point becomes.
    turns: Vec<(f64, Vec<usize>)>,
}

impl TargetPoints {
    /// From positions on the target.
    ///
    /// # Errors
    /// [`CalibrateError::Target`] where there are fewer than four points, one is not finite, or all have one x or one y.
    pub fn new(points: Vec<Point2<f64>>) -> Result<Self, CalibrateError> {
        let bad = CalibrateError::Target { points: points.len() };
        if points.len() < 4 || points.iter().any(|p| !(p.x.abs() <= 1e9 && p.y.abs() <= 1e9)) {
            return Err(bad);
        }
        let (mut low, mut high) = (points[0], points[0]);
        for p in &points {
            (low, high) = (low.inf(p), high.sup(p));
        }
        let half = (high - low) / 2.0;
        if half.x <= 0.0 || half.y <= 0.0 {
            return Err(bad);
        }
        Ok(Self { points, middle: low + half, half, turns: Vec::new() })
    }

    /// A grid of `columns × rows` points, row by row, `spacing` apart.
    ///
    /// # Errors
    /// [`CalibrateError::Target`] where a side has fewer than two points or the spacing is not a positive number.
    pub fn grid(columns: usize, rows: usize, spacing: f64) -> Result<Self, CalibrateError> {
        let count = columns.saturating_mul(rows);
        if columns < 2 || rows < 2 || count > 1_000_000 || spacing.is_nan() || spacing <= 0.0 {
            return Err(CalibrateError::Target { points: count });
        }
        let at = |i: usize| Point2::new((i % columns) as f64 * spacing, (i / columns) as f64 * spacing);
        Self::new((0..count).map(at).collect())
    }

    /// Says that the target looks the same after each of `count` equal parts of a whole turn: 2 for a board that cannot be told from itself upside down, 4 for
    /// one that looks the same after a quarter turn. Then cameras may have numbered its points differently in one view, which [`calibrate`](crate::calibrate) puts right. Turns
    /// that do not take points to points are left out.
    pub fn with_equal_turns(mut self, count: usize) -> Self {
        let near = 1e-6 * self.half.norm();
        let turned = |turn: usize| -> Option<(f64, Vec<usize>)> {
            let angle = turn as f64 * std::f64::consts::TAU / count as f64;
            let (sin, cos) = angle.sin_cos();
            let place = |p: &Point2<f64>| {
                let d = p - self.middle;
                self.middle + Vector2::new(cos * d.x - sin * d.y, sin * d.x + cos * d.y)
            };
            let index = |p: Point2<f64>| self.points.iter().position(|q| (p - q).norm() <= near);
            Some((angle, self.points.iter().map(|p| index(place(p))).collect::<Option<_>>()?))
        };
        self.turns = (1..count).filter_map(turned).collect();
        self
    }

    /// The turns after which the target looks the same, as motions of its plane; the first is none.
    pub(crate) fn turns(&self) -> Vec<Pose> {
        let of = |angle: f64| {
            let turn = Rotation3::new(Vector3::new(0.0, 0.0, angle));
            let middle = Vector3::new(self.middle.x, self.middle.y, 0.0);
            Pose::new(turn, middle - turn * middle)
        };
        std::iter::once(0.0).chain(self.turns.iter().map(|turn| turn.0)).map(of).collect()
    }

    /// The number of a point after turn `turn` ([`CalibratedPicture::turn`](crate::CalibratedPicture::turn)); itself after turn 0.
    pub fn turned(&self, point: usize, turn: usize) -> usize {
        let turned = turn.checked_sub(1).and_then(|turn| self.turns.get(turn)?.1.get(point));
        turned.copied().unwrap_or(point)
    }

    /// The positions on a flat target.
    pub fn points(&self) -> &[Point2<f64>] {
        &self.points
    }

    /// The sides of the rectangle around the points.
    pub fn size(&self) -> Vector2<f64> {
        2.0 * self.half
    }

    /// By how much the deflections in x and y ([`TargetPoints::bent`]) move a point along z: `1 − u²`, `1 − v²` with u and v from −1 to 1 across the target.
    pub fn deflection(&self, index: usize) -> [f64; 2] {
        let d = (self.points[index] - self.middle).component_div(&self.half);
        [1.0 - d.x * d.x, 1.0 - d.y * d.y]
    }

    /// A point of the target bent as a sheet is, by a parabola in x and one in y: `z = kx (1 − u²) + ky (1 − v²)`, the model of mrcal. `[kx, ky]` are the
    /// deflections of the middle against the ends, in the unit of the target.
    pub fn bent(&self, index: usize, shape: [f64; 2]) -> Point3<f64> {
        let (p, d) = (self.points[index], self.deflection(index));
        Point3::new(p.x, p.y, shape[0] * d[0] + shape[1] * d[1])
    }
}

/// A point of the target in a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct TargetCorner {
    /// Which point of the target ([`TargetPoints::points`]).
    pub point: usize,
    /// Where it is in the picture, pixel centers at integers.
    pub pixel: Point2<f64>,
}

/// What is known before a calibration: a target, cameras of certain picture sizes, and where each saw which points of it in each view.
#[derive(Debug, Clone, PartialEq)]
pub struct Sightings {
    /// The target.
    pub target: TargetPoints,
    /// Width and height of each camera's pictures, in pixels.
    pub sizes: Vec<(usize, usize)>,
    /// Corners by view and then by camera: `views[v][c]`. The cameras of one view took their pictures at the same time. Empty where a camera
    /// saw nothing.
    pub views: Vec<Vec<Vec<TargetCorner>>>,
}

impl Sightings {
    /// What one camera saw, as a calibration of its own, and the numbers of the views in which it saw something.
    pub fn of_camera(&self, camera: usize) -> (Self, Vec<usize>) {
        let seen: Vec<usize> = (0..self.views.len()).filter(|v| !self.views[*v][camera].is_empty()).collect();
        let views = seen.iter().map(|v| vec![self.views[*v][camera].clone()]).collect();
        (Self { target: self.target.clone(), sizes: vec![self.sizes[camera]], views }, seen)
    }

    /// Some of the views.
    pub(crate) fn subset(&self, views: &[usize]) -> Self {
        let views = views.iter().map(|v| self.views[*v].clone()).collect();
        Self { target: self.target.clone(), sizes: self.sizes.clone(), views }
    }

    /// Refuses what no calibration can start from.
    pub(crate) fn check(&self) -> Result<(), CalibrateError> {
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
                let mut seen = vec![false; points];
                for (corner, c) in corners.iter().enumerate() {
                    let Some(seen) = seen.get_mut(c.point) else {
                        return Err(CalibrateError::Point { view, camera, point: c.point, points });
                    };
                    if std::mem::replace(seen, true) {
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
    fn a_bent_target_bends_by_its_parabolas() {
        let target = TargetPoints::grid(5, 3, 2.0).unwrap();
        assert_eq!(target.size(), Vector2::new(8.0, 4.0));
        // The middle has the whole deflection of both, a corner none, the middle of the upper side that in x.
        assert_eq!(target.bent(7, [0.5, 0.25]), Point3::new(4.0, 2.0, 0.75));
        assert_eq!(target.bent(0, [0.5, 0.25]), Point3::new(0.0, 0.0, 0.0));
        assert_eq!(target.bent(2, [0.5, 0.25]), Point3::new(4.0, 0.0, 0.5));
        assert_eq!(target.deflection(1), [0.75, 0.0]);
    }

    #[test]
    fn points_change_places_by_the_turns_of_a_target() {
        let target = TargetPoints::grid(4, 3, 2.0).unwrap();
        assert_eq!((target.turned(1, 0), target.turned(1, 1)), (1, 1));
        let half = target.clone().with_equal_turns(2);
        assert_eq!((0..12).map(|i| half.turned(i, 1)).collect::<Vec<_>>(), (0..12).rev().collect::<Vec<_>>());
        let turns = half.turns();
        for (i, p) in target.points().iter().enumerate() {
            let q = target.points()[half.turned(i, 1)];
            let moved = turns[1].transform(&Point3::new(p.x, p.y, 0.0));
            // A rotation of lengths below ten.
            assert!((moved - Point3::new(q.x, q.y, 0.0)).norm() < 1e-12);
        }
        // A quarter turn takes no oblong grid to itself, and a square one four times.
        assert_eq!(target.with_equal_turns(4).turns().len(), 2);
        assert_eq!(TargetPoints::grid(3, 3, 1.0).unwrap().with_equal_turns(4).turns().len(), 4);
    }

    #[test]
    fn targets_without_area_are_refused() {
        for (columns, rows, spacing) in [(1, 6, 1.0), (9, 6, 0.0), (9, 6, f64::NAN), (usize::MAX, 6, 1.0)] {
            assert!(matches!(TargetPoints::grid(columns, rows, spacing), Err(CalibrateError::Target { .. })));
        }
        let line = (0..5).map(|i| Point2::new(f64::from(i), 1.0)).collect();
        assert_eq!(TargetPoints::new(line), Err(CalibrateError::Target { points: 5 }));
    }
}
