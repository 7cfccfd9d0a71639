//! A reconstruction as a sparse model, as COLMAP and its like read them.

use super::ReconstructResult;
use cv_core::{ModelImage, ModelPoint, Point2, Pose, SparseModel};

impl ReconstructResult {
    /// The cameras, the two photographs under their `names`, and the points. Where both cameras are the same, the model has one.
    pub fn model(&self, names: [String; 2]) -> SparseModel {
        let [first, second] = self.scene.cameras;
        let numbers = [1, if first == second { 1 } else { 2 }];
        let mut model =
            SparseModel { cameras: [(numbers[0], first), (numbers[1], second)].into(), ..SparseModel::default() };
        let mut seen: [Vec<(Point2<f64>, Option<u64>)>; 2] = [Vec::new(), Vec::new()];
        for (i, (p, color)) in self.scene.points.iter().zip(&self.colors).enumerate() {
            let (id, pair) = (i as u64 + 1, self.pair(p));
            seen[0].push((pair.a, Some(id)));
            seen[1].push((pair.b, Some(id)));
            let track = vec![(1, i as u32), (2, i as u32)];
            model.points.insert(id, ModelPoint { position: p.position, color: *color, error: p.reprojection, track });
        }
        let poses = [Pose::identity(), self.scene.pose];
        for (i, ((name, points), pose)) in names.into_iter().zip(seen).zip(poses).enumerate() {
            model.images.insert(i as u32 + 1, ModelImage { name, camera: numbers[i], pose, points });
        }
        model
    }
}
