//! Two cameras that are bolted together.

use crate::{Camera, Pose};

/// A stereo rig: two cameras and where the right one stands.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct StereoRig {
    /// The left (or upper) camera.
    pub left: Camera,
    /// The right (or lower) camera.
    pub right: Camera,
    /// Takes coordinates of the left camera's frame to the right one's: `x_right = R x_left + t`. The unit of `t` is the
    /// unit of every depth computed with the rig.
    pub right_from_left: Pose,
}

impl StereoRig {
    /// Distance between the two camera centers, in the unit of the rig.
    pub fn baseline(&self) -> f64 {
        self.right_from_left.translation.norm()
    }

    /// The same rig with its right camera as the left one.
    pub fn exchanged(&self) -> Self {
        Self { left: self.right, right: self.left, right_from_left: self.right_from_left.inverse() }
    }
}
