//! Keypoints, descriptor matches and point correspondences.

use nalgebra::Point2;

/// A detected interest point (compare `cv::KeyPoint`).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Keypoint {
    /// Sub-pixel position, pixel centers at integers.
    pub position: Point2<f32>,
    /// Detector response; larger is stronger.
    pub response: f32,
    /// Sigma in pixels of the Gaussian scale at which the point was detected; 1 for single-scale detectors.
    pub scale: f32,
    /// Dominant orientation in radians, clockwise on screen from +x (y points down); 0 for upright features.
    pub angle: f32,
}

impl Keypoint {
    /// Makes a keypoint of orientation 0 at scale 1.
    pub fn new(x: f32, y: f32, response: f32) -> Self {
        Self { position: Point2::new(x, y), response, scale: 1.0, angle: 0.0 }
    }
}

/// A tentative match between descriptor `query` of a first set and descriptor `train` of a second one (`cv::DMatch`).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct DMatch {
    /// Index in the first set.
    pub query: u32,
    /// Index in the second set.
    pub train: u32,
    /// Descriptor distance in the matcher's metric; smaller is better.
    pub distance: f32,
    /// Distance ratio: `distance` over the distance of the second-nearest neighbor; 0 (distinctive) to 1 (ambiguous).
    pub ratio: f32,
}

impl DMatch {
    /// Returns the positions of the two keypoints; `None` where an index is out of range.
    pub fn correspondence(&self, query: &[Keypoint], train: &[Keypoint]) -> Option<Correspondence> {
        let (a, b) = (query.get(self.query as usize)?, train.get(self.train as usize)?);
        Some(Correspondence { a: a.position.cast(), b: b.position.cast() })
    }
}

/// A point correspondence: the same scene point at `a` in a first image and at `b` in a second one, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Correspondence {
    /// Position in the first image.
    pub a: Point2<f64>,
    /// Position in the second image.
    pub b: Point2<f64>,
}

impl Correspondence {
    /// Makes a correspondence from coordinates `x1 y1 x2 y2`.
    pub fn new(x1: f64, y1: f64, x2: f64, y2: f64) -> Self {
        Self { a: Point2::new(x1, y1), b: Point2::new(x2, y2) }
    }

    /// Returns the correspondence with the images exchanged.
    pub fn swapped(self) -> Self {
        Self { a: self.b, b: self.a }
    }

    /// Whether all four coordinates are finite.
    pub fn is_finite(&self) -> bool {
        [self.a.x, self.a.y, self.b.x, self.b.y].iter().all(|v| v.is_finite())
    }
}
