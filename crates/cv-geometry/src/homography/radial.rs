//! Homographies between images with radial distortion, by the division model with one coefficient for both images (Fitzgibbon 2001, "Simultaneous linear estimation of
//! multiple view geometry and lens distortion").

use crate::homography::homography_from_points;
use cv_core::{Correspondence, Matrix3, Point2, Vector2};

/// Coefficients that are tried: strong barrel distortion, of action cameras, to strong pincushion distortion.
const COEFFICIENTS: std::ops::RangeInclusive<f64> = -0.6..=0.3;
/// Their spacing; the best one is refined to a quarter of it.
const SPACING: f64 = 0.05;
/// Thresholds of the local optimization, relative to the final one: the first inliers are those of a homography of a part of the images.
const THRESHOLDS: [f64; 5] = [4.0, 3.0, 2.0, 1.0, 1.0];

/// Radial distortion by the division model: an undistorted pixel is `center + d / (1 + λ r²)` for a pixel `center + d`, with r = |d| relative to half the
/// diagonal.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Division {
    center: Vector2<f64>,
    half_diagonal: f64,
    /// λ.
    pub(crate) coefficient: f64,
}

impl Division {
    pub(crate) fn new((width, height): (usize, usize), coefficient: f64) -> Self {
        let center = Vector2::new((width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0);
        Self { center, half_diagonal: 0.5 * (width as f64).hypot(height as f64), coefficient }
    }

    pub(crate) fn undistort(&self, pixel: Point2<f64>) -> Point2<f64> {
        if self.coefficient == 0.0 {
            return pixel;
        }
        let d = pixel.coords - self.center;
        let r2 = d.norm_squared() / self.half_diagonal.powi(2);
        (self.center + d / (1.0 + self.coefficient * r2)).into()
    }

    /// Inverse of [`undistort`](Self::undistort); NaN where there is none.
    pub(crate) fn distort(&self, pixel: Point2<f64>) -> Point2<f64> {
        if self.coefficient == 0.0 {
            return pixel;
        }
        let d = pixel.coords - self.center;
        let r2 = d.norm_squared() / self.half_diagonal.powi(2);
        (self.center + d * (2.0 / (1.0 + (1.0 - 4.0 * self.coefficient * r2).sqrt()))).into()
    }
}

/// A homography between undistorted pixels.
#[derive(Debug, Clone)]
pub(crate) struct RadialHomography {
    /// The distortions of the two images, with the same coefficient.
    pub(crate) lenses: [Division; 2],
    /// Maps undistorted pixels of the first image to those of the second.
    pub(crate) matrix: Matrix3<f64>,
    inverse: Matrix3<f64>,
}

impl RadialHomography {
    /// `None` if the matrix is singular.
    pub(crate) fn new(matrix: Matrix3<f64>, lenses: [Division; 2]) -> Option<Self> {
        let inverse = matrix.try_inverse()?;
        // H[2][2] = 1, so the denominator is positive in front of the camera; the sign of the inverse is chosen accordingly.
        let inverse = if inverse[(2, 2)] < 0.0 { -inverse } else { inverse };
        Some(Self { lenses, matrix, inverse })
    }

    /// Maps a pixel of the first image to the second; `None` behind the camera.
    pub(crate) fn transfer(&self, a: Point2<f64>) -> Option<Point2<f64>> {
        map(&self.matrix, self.lenses[0].undistort(a)).map(|b| self.lenses[1].distort(b))
    }

    /// Maps a pixel of the second image to the first.
    pub(crate) fn transfer_back(&self, b: Point2<f64>) -> Option<Point2<f64>> {
        map(&self.inverse, self.lenses[1].undistort(b)).map(|a| self.lenses[0].distort(a))
    }

    /// The symmetric transfer error in (distorted) pixels, as of [`homography_residual`](crate::homography_residual), squared.
    fn squared_residual(&self, m: &Correspondence) -> f64 {
        match (self.transfer(m.a), self.transfer_back(m.b)) {
            (Some(b), Some(a)) => 0.5 * ((b - m.b).norm_squared() + (a - m.a).norm_squared()),
            _ => f64::INFINITY,
        }
    }

    fn inliers(&self, matches: &[Correspondence], threshold: f64) -> Vec<usize> {
        (0..matches.len()).filter(|&i| self.squared_residual(&matches[i]) <= threshold * threshold).collect()
    }
}

fn map(h: &Matrix3<f64>, p: Point2<f64>) -> Option<Point2<f64>> {
    let q = h * p.to_homogeneous();
    (q.z > 0.0).then(|| Point2::new(q.x / q.z, q.y / q.z))
}

/// A model and its inliers.
type Found = (RadialHomography, Vec<usize>);

/// Estimates homography and distortion from tentative matches, starting from the inliers of a homography without distortion: those of a part of the images, where
/// the distortion is strong. Returns it with its inliers, at a symmetric transfer error of at most `threshold` pixels; `None` if none has more
/// inliers than `start`.
///
/// O(coefficients · matches).
pub(crate) fn estimate_radial_homography(
    matches: &[Correspondence],
    sizes: [(usize, usize); 2],
    start: &[usize],
    threshold: f64,
) -> Option<Found> {
    let fit = |coefficient: f64| -> Option<Found> {
        let lenses = sizes.map(|size| Division::new(size, coefficient));
        let mut inliers = start.to_vec();
        let mut model = None;
        for ratio in THRESHOLDS {
            let undistorted: Vec<Correspondence> = inliers
                .iter()
                .map(|&i| Correspondence { a: lenses[0].undistort(matches[i].a), b: lenses[1].undistort(matches[i].b) })
                .collect();
            let found = RadialHomography::new(homography_from_points(&undistorted).ok()?, lenses)?;
            inliers = found.inliers(matches, ratio * threshold);
            model = Some(found);
        }
        Some((model?, inliers))
    };
    let count = |found: &Option<Found>| found.as_ref().map_or(start.len(), |(_, inliers)| inliers.len());
    let mut best = None;
    // Without distortion, two coefficients are tried in vain.
    for direction in [-SPACING, SPACING] {
        let mut coefficient = direction;
        while COEFFICIENTS.contains(&coefficient) {
            let found = fit(coefficient);
            if count(&found) <= count(&best) {
                break;
            }
            best = found;
            coefficient += direction;
        }
    }
    for step in [0.5 * SPACING, 0.25 * SPACING] {
        let center = best.as_ref()?.0.lenses[0].coefficient;
        for coefficient in [center - step, center + step] {
            let found = fit(coefficient);
            if count(&found) > count(&best) {
                best = found;
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distortion_and_its_inverse_cancel() {
        for coefficient in [-0.6, -0.1, 0.0, 0.2] {
            let lens = Division::new((640, 480), coefficient);
            for p in [Point2::new(0.0, 0.0), Point2::new(319.5, 239.5), Point2::new(600.0, 20.0)] {
                // Closed form in f64.
                assert!((lens.distort(lens.undistort(p)) - p).norm() < 1e-9, "{coefficient} {p}");
            }
        }
    }
}
