//! Stereo rigs.

use crate::{Camera, Pose};

/// A stereo rig: two rigidly mounted cameras and their relative pose.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct StereoRig {
    /// The left (or upper) camera.
    pub left: Camera,
    /// The right (or lower) camera.
    pub right: Camera,
    /// Relative pose from the left camera's frame to the right one's: `x_right = R x_left + t`. The unit of `t` is the
    /// unit of every depth computed with the rig.
    pub right_from_left: Pose,
}

impl StereoRig {
    /// Returns the baseline: the distance between the camera centers, in the unit of `t`.
    pub fn baseline(&self) -> f64 {
        self.right_from_left.translation.norm()
    }

    /// Returns the rig with left and right camera exchanged.
    pub fn exchanged(&self) -> Self {
        Self { left: self.right, right: self.left, right_from_left: self.right_from_left.inverse() }
    }
}
