//! Conversion of a reconstruction to a sparse model, such as COLMAP's.

use super::{SfmPhoto, SfmResult};
use cv_core::{ModelImage, ModelPoint, SparseModel};

impl SfmResult {
    /// Returns a model with the names and colors of its photographs, all keypoints, and the points. Identifiers start
    /// at 1, in the order of the input. `None` if there is no such model.
    pub fn sparse_model(&self, index: usize, photos: &[SfmPhoto]) -> Option<SparseModel> {
        let model = self.models.get(index)?;
        let mut out = SparseModel::default();
        for (i, (photo, pose)) in photos.iter().zip(&model.poses).enumerate() {
            let Some(pose) = pose else { continue };
            let points = photo.keypoints.iter().map(|k| (k.position.cast(), None)).collect();
            let camera = photo.camera as u32 + 1;
            out.cameras.insert(camera, *model.cameras.get(photo.camera)?);
            out.images.insert(i as u32 + 1, ModelImage { name: photo.name.clone(), camera, pose: *pose, points });
        }
        for (p, point) in model.points.iter().enumerate() {
            let id = p as u64 + 1;
            let mut sum = [0usize; 3];
            let mut track = Vec::with_capacity(point.observations.len());
            for o in &point.observations {
                let image = o.view + 1;
                out.images.get_mut(&image)?.points.get_mut(o.keypoint as usize)?.1 = Some(id);
                let color = photos.get(o.view as usize)?.colors.get(o.keypoint as usize)?;
                sum.iter_mut().zip(color).for_each(|(s, c)| *s += usize::from(*c));
                track.push((image, o.keypoint));
            }
            let color = sum.map(|s| (s / point.observations.len().max(1)) as u8);
            let point = ModelPoint { position: point.position, color, error: point.error, track };
            out.points.insert(id, point);
        }
        Some(out)
    }
}
