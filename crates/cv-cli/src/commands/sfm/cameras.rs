//! The cameras of the photographs: which of them share one, and what is known of it.

use super::Args;
use super::earlier::Earlier;
use crate::frame::{Context, Failure};
use crate::rig;
use cv_core::{Camera, Distortion, ModelImage, Pose, SparseModel};
use cv_io::CalibrationFormat;
use cv_pipeline::SfmCamera;
use cv_pipeline::many_views::CameraKnowledge;
use std::collections::BTreeMap;
use std::path::Path;

/// Relative standard deviation of focal lengths by EXIF.
const EXIF_DEVIATION: f64 = 0.03;

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
        self.list.push(SfmCamera { camera, knowledge: CameraKnowledge::Known });
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
        let lens = |camera: Camera| Camera { distortion: Distortion::radial(0.0, 0.0), ..camera };
        let camera = if let Some(file) = &args.camera {
            let (camera, lens_known) = rig::camera_and_lens(file, Some((width, height)), args.undistorted, context)?;
            if (camera.width, camera.height) != (width, height) {
                let (w, h) = (camera.width, camera.height);
                return Ok(Err(format!("it is {width}×{height} px, its camera in {} is {w}×{h} px", file.display())));
            }
            match lens_known {
                true => {
                    args.check_lens(file, &camera)?;
                    SfmCamera { camera, knowledge: CameraKnowledge::Known }
                }
                false => SfmCamera { camera: lens(camera), knowledge: CameraKnowledge::Matrix },
            }
        } else if let Some(focal) = focal {
            let camera = lens(Camera::from_focal(width, height, focal));
            SfmCamera { camera, knowledge: CameraKnowledge::Focal { focal, deviation: EXIF_DEVIATION } }
        } else {
            // 1.2 times the longer side, COLMAP's, where the pairs do not tell better.
            let camera = lens(Camera::from_focal(width, height, 1.2 * width.max(height) as f64));
            SfmCamera { camera, knowledge: CameraKnowledge::Unknown }
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
