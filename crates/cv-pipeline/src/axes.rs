//! Axis conventions of point clouds.

use cv_core::PointCloud;

/// Axis convention of a point cloud. Ours is that of OpenCV.
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
    /// Converts a cloud from our convention to this one.
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
    fn opengl_flips_y_and_z() {
        let mut cloud =
            PointCloud { normals: vec![[0.0, 0.0, -1.0]], ..PointCloud::from_positions(vec![[1.0, 2.0, 3.0]]) };
        Axes::Opencv.turn(&mut cloud);
        assert_eq!(cloud.positions, [[1.0, 2.0, 3.0]]);
        Axes::Opengl.turn(&mut cloud);
        assert_eq!((cloud.positions[0], cloud.normals[0]), ([1.0, -2.0, -3.0], [0.0, -0.0, 1.0]));
    }
}
