//! The cameras of the photographs: which of them share one, and what is known of it.

use super::Args;
use super::earlier::Earlier;
use crate::frame::{Context, Failure};
use crate::rig;
use cv_core::{Camera, ModelImage, Pose, SparseModel};
use cv_io::CalibrationFormat;
use cv_pipeline::SfmCamera;
use std::collections::BTreeMap;
use std::path::Path;

/// The cameras of the photographs so far.
#[derive(Default)]
pub(super) struct Cameras {
    pub(super) list: Vec<SfmCamera>,
    /// By size and focal length in thousandths of a pixel.
    known: BTreeMap<(usize, usize, u64), usize>,
    /// By their numbers in an earlier model.
    earlier: BTreeMap<u32, usize>,
}

impl Cameras {
    /// The index of a camera of an earlier model, or why it is not that of a photograph of that size.
    pub(super) fn of_earlier(
        &mut self,
        size: (usize, usize),
        (number, camera): (u32, Camera),
        earlier: &Earlier,
        args: &Args,
    ) -> Result<Result<usize, String>, Failure> {
        if (camera.width, camera.height) != size {
            let ((w, h), (width, height)) = ((camera.width, camera.height), size);
            let folder = earlier.folder().display();
            return Ok(Err(format!("it is {width}×{height} px, its camera in {folder} is {w}×{h} px")));
        }
        if let Some(index) = self.earlier.get(&number) {
            return Ok(Ok(*index));
        }
        args.check_lens(earlier.folder(), &camera)?;
        self.list.push(SfmCamera::known(camera));
        self.earlier.insert(number, self.list.len() - 1);
        Ok(Ok(self.list.len() - 1))
    }

    /// The index of the camera of a photograph of that size and, by EXIF, that focal length in pixels, or why it has none.
    pub(super) fn of(
        &mut self,
        (width, height): (usize, usize),
        exif: Option<f64>,
        args: &Args,
        context: &Context,
    ) -> Result<Result<usize, String>, Failure> {
        let exif = exif.filter(|_| !args.ignore_exif && args.camera.is_none());
        let focal = args.focal.or(exif);
        let key = (width, height, focal.map_or(0, |f| (f * 1000.0).round() as u64));
        if let Some(index) = self.known.get(&key) {
            return Ok(Ok(*index));
        }
        let camera = if let Some(file) = &args.camera {
            let (camera, lens_known) = rig::camera_and_lens(file, Some((width, height)), args.undistorted, context)?;
            if (camera.width, camera.height) != (width, height) {
                let (w, h) = (camera.width, camera.height);
                return Ok(Err(format!("it is {width}×{height} px, its camera in {} is {w}×{h} px", file.display())));
            }
            if lens_known {
                args.check_lens(file, &camera)?;
                SfmCamera::known(camera)
            } else {
                SfmCamera::of_matrix(camera)
            }
        } else {
            focal.map_or_else(
                || SfmCamera::unknown((width, height)),
                |focal| SfmCamera::of_focal((width, height), focal),
            )
        };
        self.list.push(camera);
        self.known.insert(key, self.list.len() - 1);
        Ok(Ok(self.list.len() - 1))
    }
}

impl Args {
    /// Refuses, before the work, a lens that the outputs cannot hold.
    fn check_lens(&self, file: &Path, camera: &Camera) -> Result<(), Failure> {
        let refuse = |error: cv_io::FormatError| {
            Failure::new(format!("{}: {error}", file.display()))
                .advice("photographs without distortion (`cv undistort`) and their camera")
        };
        if let Some(format) = CalibrationFormat::from_name("colmap") {
            format.camera_text(camera, &[]).map_err(refuse)?;
        }
        if self.transforms.is_some() {
            let image =
                ModelImage { name: "photograph".to_owned(), camera: 1, pose: Pose::identity(), points: Vec::new() };
            let model =
                SparseModel { cameras: [(1, *camera)].into(), images: [(1, image)].into(), ..SparseModel::default() };
            cv_io::transforms_json(&model, "").map_err(refuse)?;
        }
        Ok(())
    }
}
