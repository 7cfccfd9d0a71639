//! Which way the axes of a cloud point.

use cv_core::PointCloud;

/// Which way the axes of a cloud point. Ours are those of OpenCV.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Axes {
    /// X right, Y down, Z forward.
    #[default]
    Opencv,
    /// X right, Y up, Z backward.
    Opengl,
}

cv_core::named!(Axes {
    Opencv = "opencv": "X right, Y down, Z forward",
    Opengl = "opengl": "X right, Y up, Z backward: Blender, MeshLab and most viewers look along −Z",
});

impl Axes {
    /// Brings a cloud from our axes to these.
    pub fn turn(self, cloud: &mut PointCloud) {
        if self == Self::Opengl {
            cloud.positions.iter_mut().chain(&mut cloud.normals).for_each(|p| *p = [p[0], -p[1], -p[2]]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_below_and_ahead_is_below_and_ahead_in_opengl_too() {
        let mut cloud =
            PointCloud { normals: vec![[0.0, 0.0, -1.0]], ..PointCloud::from_positions(vec![[1.0, 2.0, 3.0]]) };
        Axes::Opencv.turn(&mut cloud);
        assert_eq!(cloud.positions, [[1.0, 2.0, 3.0]]);
        Axes::Opengl.turn(&mut cloud);
        assert_eq!((cloud.positions[0], cloud.normals[0]), ([1.0, -2.0, -3.0], [0.0, -0.0, 1.0]));
    }
}
