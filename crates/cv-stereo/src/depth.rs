//! Depth from disparity, and triangulation of the pixels of a depth map.

use cv_core::{GrayF32, ImageView, PointCloud};
use cv_parallel::prelude::*;
use nalgebra::Matrix4;

/// The parameters that relate disparity and depth of a rectified pair.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct StereoGeometry {
    /// Focal length of both rectified cameras in px.
    pub focal: f64,
    /// Principal point of the left camera, x.
    pub cx: f64,
    /// Principal point of both cameras, y.
    pub cy: f64,
    /// Distance between the cameras; its unit is the unit of depth.
    pub baseline: f64,
    /// Principal point of the right camera minus that of the left one, x, in px (`doffs` of Middlebury's calibration
    /// files); 0 for pairs rectified here.
    pub offset: f64,
}

/// Why numbers are not a valid stereo geometry.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum GeometryError {
    /// Focal length or baseline is not a positive number.
    #[error("focal length {focal} px and baseline {baseline} must both be positive")]
    NotPositive {
        /// Focal length in px.
        focal: f64,
        /// Baseline.
        baseline: f64,
    },
    /// A value is NaN or infinite.
    #[error("the principal point ({cx}, {cy}) with offset {offset} px is not finite")]
    NotFinite {
        /// Principal point, x.
        cx: f64,
        /// Principal point, y.
        cy: f64,
        /// Offset of the right camera's.
        offset: f64,
    },
}

impl StereoGeometry {
    /// Creates a geometry whose principal point is the center of images of this size.
    ///
    /// # Errors
    /// As [`StereoGeometry::validate`].
    pub fn from_focal(width: usize, height: usize, focal: f64, baseline: f64) -> Result<Self, GeometryError> {
        let middle = |n: usize| (n as f64 - 1.0) / 2.0;
        let geometry = Self { focal, cx: middle(width), cy: middle(height), baseline, offset: 0.0 };
        geometry.validate()?;
        Ok(geometry)
    }

    /// Checks that focal length and baseline are positive and all numbers are finite.
    ///
    /// # Errors
    /// [`GeometryError`] with the numbers.
    pub fn validate(&self) -> Result<(), GeometryError> {
        let Self { focal, cx, cy, baseline, offset } = *self;
        if !(focal > 0.0 && focal.is_finite() && baseline > 0.0 && baseline.is_finite()) {
            return Err(GeometryError::NotPositive { focal, baseline });
        }
        if !(cx.is_finite() && cy.is_finite() && offset.is_finite()) {
            return Err(GeometryError::NotFinite { cx, cy, offset });
        }
        Ok(())
    }

    /// Returns the depth of a disparity; NaN for a NaN disparity, and for points at infinity or behind the camera.
    pub fn depth(&self, disparity: f32) -> f32 {
        let d = f64::from(disparity) + self.offset;
        if d > 0.0 { (self.focal * self.baseline / d) as f32 } else { f32::NAN }
    }

    /// Returns the disparity of a depth: the inverse of [`StereoGeometry::depth`].
    pub fn disparity(&self, depth: f64) -> f64 {
        self.focal * self.baseline / depth - self.offset
    }

    /// Returns the standard deviation of a depth whose disparity has a standard deviation of `sigma` px: `Z² / (f B) σ`, to first order.
    pub fn depth_uncertainty(&self, depth: f32, sigma: f32) -> f32 {
        let z = f64::from(depth);
        (z * z / (self.focal * self.baseline) * f64::from(sigma)) as f32
    }

    /// Returns the matrix that maps `(x, y, d, 1)` to the homogeneous coordinates of the point (`Q` in OpenCV).
    pub fn q(&self) -> Matrix4<f64> {
        let b = self.baseline;
        Matrix4::new(
            1.0,
            0.0,
            0.0,
            -self.cx, //
            0.0,
            1.0,
            0.0,
            -self.cy, //
            0.0,
            0.0,
            0.0,
            self.focal, //
            0.0,
            0.0,
            1.0 / b,
            self.offset / b,
        )
    }

    /// Returns the depth of every pixel; NaN where the disparity is NaN or the depth outside `range` (nearest, farthest).
    pub fn depth_map(&self, disparity: ImageView<'_, f32, 1>, range: (f32, f32)) -> GrayF32 {
        let (width, height) = disparity.size();
        let mut depth = GrayF32::new(width, height, [f32::NAN]);
        if !depth.is_empty() {
            depth.as_mut_slice().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
                for (z, &d) in row.iter_mut().zip(disparity.row(y)) {
                    let value = self.depth(d);
                    *z = if value >= range.0 && value <= range.1 { value } else { f32::NAN };
                }
            });
        }
        depth
    }

    /// Triangulates the pixels of a depth map (X right, Y down, Z forward from the left camera, in the unit of the baseline), row by row,
    /// with their colors. Pixels without depth are left out; if the images differ in size, so are pixels outside either of them.
    pub fn cloud(&self, depth: ImageView<'_, f32, 1>, color: ImageView<'_, u8, 3>) -> PointCloud {
        let (width, height) = (depth.width().min(color.width()), depth.height().min(color.height()));
        let mut cloud = PointCloud::default();
        for y in 0..height {
            for (x, (&z, rgb)) in depth.row(y).iter().zip(color.row(y).as_chunks::<3>().0).enumerate().take(width) {
                if z.is_finite() {
                    let scale = f64::from(z) / self.focal;
                    let position = [((x as f64 - self.cx) * scale) as f32, ((y as f64 - self.cy) * scale) as f32, z];
                    cloud.positions.push(position);
                    cloud.colors.push(*rgb);
                }
            }
        }
        cloud
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Image;

    const GEOMETRY: StereoGeometry = StereoGeometry { focal: 500.0, cx: 320.0, cy: 240.0, baseline: 0.12, offset: 3.0 };

    #[test]
    fn a_point_comes_back_from_its_two_projections() {
        // A point 2 m ahead, 0.5 m right, 0.3 m up, projected into both cameras of the geometry.
        let (x, y, z) = (0.5, -0.3, 2.0);
        let left = 500.0 * x / z + 320.0;
        let right = 500.0 * (x - 0.12) / z + 323.0;
        let row = 500.0 * y / z + 240.0;
        let d = left - right;
        let h = GEOMETRY.q() * nalgebra::Vector4::new(left, row, d, 1.0);
        // f64 arithmetic on numbers below a thousand.
        assert!((h.xyz() / h.w - nalgebra::Vector3::new(x, y, z)).norm() < 1e-12);
        assert!((GEOMETRY.depth(d as f32) - 2.0).abs() < 1e-5);
        assert!((GEOMETRY.disparity(2.0) - d).abs() < 1e-12);
    }

    #[test]
    fn the_cloud_and_q_agree_and_holes_stay_out() {
        let mut d = GrayF32::new(4, 2, [27.0]);
        d.set(1, 1, [f32::NAN]);
        d.set(2, 1, [-3.0]);
        let rgb = Image::<u8, 3>::from_fn(4, 2, |x, y| [x as u8, y as u8, 9]);
        let depth = GEOMETRY.depth_map(d.view(), (0.1, 100.0));
        let cloud = GEOMETRY.cloud(depth.view(), rgb.view());
        assert_eq!(cloud.len(), 6);
        assert_eq!(cloud.colors[5], [3, 1, 9]);
        let h = GEOMETRY.q() * nalgebra::Vector4::new(3.0, 1.0, 27.0, 1.0);
        for (axis, p) in cloud.positions[5].iter().enumerate() {
            // Six digits of f32 on a value of at most 2.
            assert!((f64::from(*p) - h[axis] / h.w).abs() < 1e-6);
        }
        assert!(GEOMETRY.depth_map(d.view(), (2.5, 9.0)).as_slice().iter().all(|z| z.is_nan()));
    }

    #[test]
    fn the_uncertainty_is_the_slope_of_depth() {
        let z = GEOMETRY.depth(20.0);
        let slope = (GEOMETRY.depth(19.99) - GEOMETRY.depth(20.01)) / 2.0;
        // A central difference over 0.01 px: relative truncation (0.01/23)², f32 rounding 1e-6 of 2.6 over 1e-3.
        assert!((GEOMETRY.depth_uncertainty(z, 0.01) / slope - 1.0).abs() < 1e-3);
    }

    #[test]
    fn nonsense_is_named() {
        assert!(matches!(
            StereoGeometry::from_focal(4, 4, 0.0, 1.0),
            Err(GeometryError::NotPositive { focal: 0.0, .. })
        ));
        assert!(matches!(StereoGeometry { cx: f64::NAN, ..GEOMETRY }.validate(), Err(GeometryError::NotFinite { .. })));
    }
}
