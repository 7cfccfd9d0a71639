//! Conversion of a two-view reconstruction to a sparse model, such as COLMAP's.

use super::ReconstructResult;
use cv_core::{ModelImage, ModelPoint, Point2, Pose, SparseModel};

impl ReconstructResult {
    /// Returns the cameras, the two images with their `names`, and the points. Equal cameras are one camera of the
    /// model.
    pub fn model(&self, names: [String; 2]) -> SparseModel {
        let [first, second] = self.scene.cameras;
        let camera_ids = [1, if first == second { 1 } else { 2 }];
        let mut model =
            SparseModel { cameras: [(camera_ids[0], first), (camera_ids[1], second)].into(), ..SparseModel::default() };
        let mut observations: [Vec<(Point2<f64>, Option<u64>)>; 2] = [Vec::new(), Vec::new()];
        for (i, (p, color)) in self.scene.points.iter().zip(&self.colors).enumerate() {
            let (id, pair) = (i as u64 + 1, self.pair(p));
            observations[0].push((pair.a, Some(id)));
            observations[1].push((pair.b, Some(id)));
            let track = vec![(1, i as u32), (2, i as u32)];
            model.points.insert(id, ModelPoint { position: p.position, color: *color, error: p.reprojection, track });
        }
        let poses = [Pose::identity(), self.scene.pose];
        for (i, ((name, points), pose)) in names.into_iter().zip(observations).zip(poses).enumerate() {
            model.images.insert(i as u32 + 1, ModelImage { name, camera: camera_ids[i], pose, points });
        }
        model
    }
}
