//! A scene as points, seen by cameras.

use crate::{Camera, Point2, Point3, Pose};
use std::collections::BTreeMap;

/// Cameras, pictures and the scene points they show: what a structure-from-motion job finds, and what COLMAP reads.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SparseModel {
    /// Cameras by number.
    pub cameras: BTreeMap<u32, Camera>,
    /// Pictures by number.
    pub images: BTreeMap<u32, ModelImage>,
    /// Points by number.
    pub points: BTreeMap<u64, ModelPoint>,
}

/// A registered picture.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelImage {
    /// File name, relative to the pictures' folder.
    pub name: String,
    /// Number of its camera.
    pub camera: u32,
    /// World to camera.
    pub pose: Pose,
    /// Image points in pixels (centers at integers), and the scene point each belongs to, if any.
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
    /// Where it is seen: number of the picture, index of the point in it.
    pub track: Vec<(u32, u32)>,
}
