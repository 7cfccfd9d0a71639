//! Sparse reconstructions.

use crate::{Camera, Point2, Point3, Pose};
use std::collections::BTreeMap;

/// A sparse model as structure from motion reconstructs it: cameras, registered images and scene points, as in COLMAP.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SparseModel {
    /// Cameras by id.
    pub cameras: BTreeMap<u32, Camera>,
    /// Images by id.
    pub images: BTreeMap<u32, ModelImage>,
    /// Points by id.
    pub points: BTreeMap<u64, ModelPoint>,
}

/// A registered image.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelImage {
    /// File name, relative to the image folder.
    pub name: String,
    /// Id of its camera.
    pub camera: u32,
    /// World to camera.
    pub pose: Pose,
    /// Image points in pixels (centers at integers), and the id of the scene point each observes, if any.
    pub points: Vec<(Point2<f64>, Option<u64>)>,
}

/// A scene point.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelPoint {
    /// Position in the world.
    pub position: Point3<f64>,
    /// RGB color.
    pub color: [u8; 3],
    /// Mean reprojection error in pixels; negative or NaN where unknown.
    pub error: f64,
    /// Its observations: image id, index of the point in that image.
    pub track: Vec<(u32, u32)>,
}
