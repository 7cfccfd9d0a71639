//! Undistorted images and the model of their pinhole cameras: the input of dense reconstruction.

use super::photographs::Photograph;
use crate::commands::rectify::write_image;
use crate::commands::undistort::undistorted_pixels;
use crate::frame::{Context, Explain, Failure, Output, one_each, spare_inputs};
use cv_core::{Camera, SparseModel, Stage};
use cv_io::colmap::{self, ModelFormat};
use cv_io::{DynImage, ExifInfo, Metadata};
use cv_pipeline::stereo::{RectifiedView, RectifyOptions, WarpMap};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A folder with `images` and their model in `sparse`, in the layout of COLMAP's `image_undistorter`.
pub(super) struct PinholeFolder<'a> {
    folder: &'a Path,
    /// File names of the photographs in `images`.
    names: Vec<String>,
}

impl<'a> PinholeFolder<'a> {
    /// Refuses a folder where a photograph would be overwritten.
    pub(super) fn new(folder: &'a Path, photographs: &[Photograph]) -> Result<Self, Failure> {
        let names: Vec<String> = photographs.iter().map(|p| writable(&p.name)).collect();
        let results: Vec<PathBuf> = names.iter().map(|name| folder.join("images").join(name)).collect();
        let inputs: Vec<PathBuf> = photographs.iter().map(|p| p.path.clone()).collect();
        spare_inputs(&results, &inputs.iter().map(PathBuf::as_path).collect::<Vec<_>>())?;
        one_each(&inputs, &results)?;
        Ok(Self { folder, names })
    }

    /// Writes the undistorted images of a model and the model; image `k + 1` is photograph `used[k]`.
    pub(super) fn write(
        &self,
        model: &SparseModel,
        photographs: &[Photograph],
        used: &[usize],
        format: ModelFormat,
        context: &Context,
    ) -> Result<(), Failure> {
        let mut pinhole = pinhole_model(model)?;
        let stage = Stage::new(context, "undistort", model.images.len())?;
        // Images are grouped by camera, so that one map is kept at a time.
        let mut order: Vec<u32> = model.images.keys().copied().collect();
        order.sort_by_key(|id| (model.images[id].camera, *id));
        let mut made: Option<(u32, WarpMap)> = None;
        for id in order {
            let Some(&at) = used.get(id as usize - 1) else { continue };
            let camera = model.images[&id].camera;
            let map = match &made {
                Some((of, map)) if *of == camera => map,
                _ => &made.insert((camera, view(&model.cameras[&camera])?.map(&stage)?)).1,
            };
            let photo = cv_io::read_image(&photographs[at].path)?;
            let pixels = undistorted_pixels(&photo.pixels, map)?;
            let file = DynImage { pixels, exif: ExifInfo::default(), metadata: Metadata::default() };
            let path = self.folder.join("images").join(&self.names[at]);
            let parent = path.parent().unwrap_or(self.folder);
            context.write(Output::Folder(parent), |_| write_image(&path, &file, &photo.metadata))?;
            if let Some(image) = pinhole.images.get_mut(&id) {
                image.name.clone_from(&self.names[at]);
            }
            stage.add(1)?;
        }
        let sparse = self.folder.join("sparse");
        context.write(Output::Folder(&sparse), |folder| colmap::replace(folder, &pinhole, format))?;
        Ok(())
    }
}

/// Returns the output name of a photograph: formats that are not written become PNG.
fn writable(name: &str) -> String {
    let ending = Path::new(name).extension().unwrap_or_default().to_string_lossy().to_lowercase();
    if crate::frame::IMAGE.contains(&&*ending) { name.to_owned() } else { format!("{name}.png") }
}

/// Returns the undistorted view of a camera with valid pixels only, as COLMAP's default.
fn view(camera: &Camera) -> Result<RectifiedView, Failure> {
    RectifiedView::undistorted(camera, &RectifyOptions::default())
        .during("cannot undistort the photographs")
        .map_err(|failure| failure.advice("leave out --pinhole, or give a calibrated camera (--camera)"))
}

/// Converts a model to pinhole cameras; only keypoints with a 3D point are kept.
fn pinhole_model(model: &SparseModel) -> Result<SparseModel, Failure> {
    let views: BTreeMap<u32, RectifiedView> =
        model.cameras.iter().map(|(id, camera)| Ok((*id, view(camera)?))).collect::<Result<_, Failure>>()?;
    let mut out =
        SparseModel { cameras: views.iter().map(|(id, v)| (*id, v.camera)).collect(), ..SparseModel::default() };
    let mut places: BTreeMap<(u32, u32), u32> = BTreeMap::new();
    for (id, image) in &model.images {
        let view = &views[&image.camera];
        let mut undistorted = image.clone();
        undistorted.points.clear();
        for (i, (at, point)) in image.points.iter().enumerate().filter(|(_, (_, point))| point.is_some()) {
            let at = view.camera.denormalize(view.source.normalize(*at));
            // Some pixels have no viewing ray.
            if at.x.is_finite() && at.y.is_finite() {
                places.insert((*id, i as u32), undistorted.points.len() as u32);
                undistorted.points.push((at, *point));
            }
        }
        out.images.insert(*id, undistorted);
    }
    for (id, point) in &model.points {
        let mut point = point.clone();
        point.track = point.track.iter().filter_map(|seen| Some((seen.0, *places.get(seen)?))).collect();
        out.points.insert(*id, point);
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Distortion, ModelImage, ModelPoint, Point3, Pose, Vector3};

    #[test]
    fn keypoints_are_the_projections_by_the_pinhole_camera() {
        let camera = Camera { distortion: Distortion::radial(-0.2, 0.05), ..Camera::from_focal(400, 300, 350.0) };
        let mut model = SparseModel { cameras: [(3, camera)].into(), ..SparseModel::default() };
        let pose = Pose::new(cv_core::Rotation3::from_euler_angles(0.1, 0.2, 0.3), Vector3::new(0.1, 0.2, 0.3));
        let mut image = ModelImage { name: "a.jpg".into(), camera: 3, pose, points: Vec::new() };
        for k in 0..20u64 {
            let position = pose.inverse().transform(&Point3::new(0.1 * k as f64 - 1.0, 0.05 * k as f64 - 0.5, 4.0));
            // Every second keypoint has no 3D point.
            image.points.push((cv_core::Point2::new(k as f64, 1.0), None));
            image.points.push((camera.project(&pose.transform(&position)).unwrap(), Some(k)));
            model
                .points
                .insert(k, ModelPoint { position, color: [0; 3], error: 0.0, track: vec![(1, 2 * k as u32 + 1)] });
        }
        model.images.insert(1, image);
        let straight = pinhole_model(&model).unwrap();
        let camera = straight.cameras[&3];
        assert!(camera.distortion.is_none() && straight.images[&1].points.len() == 20);
        for (id, point) in &straight.points {
            let (at, of) = straight.images[&1].points[point.track[0].1 as usize];
            let p = camera.project(&pose.transform(&point.position)).unwrap();
            // The lens is inverted by Newton's method to the last bits of a float's square root.
            assert!(of == Some(*id) && (p - at).norm() < 1e-6, "{id}: {p} {at}");
        }
        assert_eq!([writable("a/b.JPG"), writable("b.webp")], ["a/b.JPG", "b.webp.png"]);
    }
}
