//! Point clouds with colors, normals and line segments.

use crate::{Camera, Point3, Pose};

/// 3D points, optionally with colors and normals, and line segments between them: the contents of a PLY file.
#[derive(Debug, Clone, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct PointCloud {
    /// Positions in the unit of the scene.
    pub positions: Vec<[f32; 3]>,
    /// One RGB color per point, or empty.
    pub colors: Vec<[u8; 3]>,
    /// One unit normal per point, or empty.
    pub normals: Vec<[f32; 3]>,
    /// Line segments as pairs of indices into `positions`, such as a camera frustum.
    pub edges: Vec<[u32; 2]>,
}

impl PointCloud {
    /// Makes a cloud of points without attributes.
    pub fn from_positions(positions: Vec<[f32; 3]>) -> Self {
        Self { positions, ..Self::default() }
    }

    /// Makes a cloud of colored points.
    pub fn colored(positions: Vec<[f32; 3]>, colors: Vec<[u8; 3]>) -> Self {
        Self { positions, colors, ..Self::default() }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Applies the rigid motion to every position, and its rotation to every normal.
    pub fn transform(&mut self, motion: &Pose) {
        let (r, t) = (motion.rotation, motion.translation);
        self.positions.iter_mut().for_each(|p| *p = (r * Point3::from(*p).cast::<f64>() + t).cast::<f32>().into());
        self.normals.iter_mut().for_each(|n| *n = (r * Point3::from(*n).cast::<f64>()).cast::<f32>().into());
    }

    /// Adds points of one color connected by `edges`, whose indices count from the first added point.
    ///
    /// Points without colors stay without; where the cloud has normals, those of the added points are zero.
    pub fn add_wireframe(&mut self, corners: &[[f32; 3]], edges: &[[u32; 2]], color: [u8; 3]) {
        let first = self.positions.len() as u32;
        let colored = self.positions.is_empty() || !self.colors.is_empty();
        let with_normals = !self.normals.is_empty();
        self.positions.extend_from_slice(corners);
        if colored {
            self.colors.extend(std::iter::repeat_n(color, corners.len()));
        }
        if with_normals {
            self.normals.extend(std::iter::repeat_n([0.0; 3], corners.len()));
        }
        self.edges.extend(edges.iter().map(|e| e.map(|i| i + first)));
    }

    /// Adds a camera frustum: the camera center, and the image corners at distance `depth` in front of it.
    pub fn add_camera(&mut self, camera: &Camera, pose: &Pose, depth: f64, color: [u8; 3]) {
        let (right, bottom) = (camera.width as f64 - 0.5, camera.height as f64 - 0.5);
        let to_world = pose.inverse();
        let corner = |x: f64, y: f64| {
            // Without lens distortion: the frustum has straight edges.
            let ray = Point3::new((x - camera.cx) / camera.fx * depth, (y - camera.cy) / camera.fy * depth, depth);
            to_world.transform(&ray)
        };
        let corners =
            [pose.center(), corner(-0.5, -0.5), corner(right, -0.5), corner(right, bottom), corner(-0.5, bottom)];
        let corners = corners.map(|p| [p.x as f32, p.y as f32, p.z as f32]);
        self.add_wireframe(&corners, &[[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]], color);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Rotation3, Vector3};

    #[test]
    fn wireframes_keep_the_cloud_consistent() {
        let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]];
        for mut cloud in [
            PointCloud::default(),
            PointCloud::from_positions(vec![[5.0; 3]]),
            PointCloud::colored(vec![[5.0; 3]], vec![[1, 2, 3]]),
            PointCloud { normals: vec![[0.0, 0.0, 1.0]], ..PointCloud::from_positions(vec![[5.0; 3]]) },
        ] {
            let first = cloud.len() as u32;
            cloud.add_wireframe(&corners, &[[0, 1]], [255, 0, 0]);
            assert_eq!(cloud.edges, [[first, first + 1]]);
            assert!(cloud.colors.is_empty() || cloud.colors.len() == cloud.len());
            assert!(cloud.normals.is_empty() || cloud.normals.len() == cloud.len());
        }
    }

    #[test]
    fn frustum_corners_project_to_the_image_corners() {
        let camera = Camera::pinhole(200, 100, 100.0, 100.0, 99.5, 49.5);
        let pose = Pose::look_at(Point3::new(1.0, 2.0, 3.0), Point3::new(4.0, 2.0, 3.0), Vector3::y()).unwrap();
        let mut cloud = PointCloud::default();
        cloud.add_camera(&camera, &pose, 2.0, [9, 9, 9]);
        assert_eq!(cloud.positions[0], [1.0, 2.0, 3.0]);
        let seen: Vec<_> = cloud.positions[1..]
            .iter()
            .map(|p| camera.project(&pose.transform(&Point3::from(*p).cast())).unwrap())
            .collect();
        let corners = [(-0.5, -0.5), (199.5, -0.5), (199.5, 99.5), (-0.5, 99.5)];
        // The points are stored as f32, with seven digits.
        assert!(seen.iter().zip(corners).all(|(p, (x, y))| (p.x - x).hypot(p.y - y) < 1e-3), "{seen:?}");
        assert_eq!((cloud.edges.len(), cloud.colors.len()), (8, 5));
    }

    #[test]
    fn a_rigid_motion_transforms_points_and_rotates_normals() {
        let quarter = Rotation3::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
        let mut cloud =
            PointCloud { normals: vec![[1.0, 0.0, 0.0]], ..PointCloud::from_positions(vec![[1.0, 0.0, 2.0]]) };
        cloud.transform(&Pose::new(quarter, Vector3::new(0.0, 0.0, 3.0)));
        // A cosine of a right angle is 6e-17 in f64.
        let near = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(near(cloud.positions[0], [0.0, 1.0, 5.0]) && near(cloud.normals[0], [0.0, 1.0, 0.0]));
    }
}
