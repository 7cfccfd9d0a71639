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
