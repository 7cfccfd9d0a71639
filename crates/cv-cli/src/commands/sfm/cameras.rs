//! The cameras of the photographs: which photographs share one, and the prior knowledge of its intrinsics.

use super::Args;
use super::earlier::Earlier;
use crate::frame::{Context, Failure};
use crate::rig;
use cv_core::{Camera, ModelImage, Pose, SparseModel};
use cv_io::CalibrationFormat;
use cv_pipeline::{OtherSize, SfmCamera, SfmCameras};
use std::collections::BTreeMap;
use std::path::Path;

/// The cameras of the photographs so far.
#[derive(Default)]
pub(super) struct Cameras {
    all: SfmCameras,
    /// Index of each camera of an earlier model, by its id there.
    earlier: BTreeMap<u32, usize>,
}

/// Words a mismatch of the sizes of a photograph and its camera.
fn other_size(OtherSize { photo: (width, height), camera: (w, h) }: OtherSize, file: &Path) -> String {
    format!("it is {width}×{height} px, its camera in {} is {w}×{h} px", file.display())
}

impl Cameras {
    /// Returns the index of a camera of an earlier model, or why it does not fit a photograph of that size.
    pub(super) fn of_earlier(
        &mut self,
        size: (usize, usize),
        (number, camera): (u32, Camera),
        earlier: &Earlier,
        args: &Args,
    ) -> Result<Result<usize, String>, Failure> {
        let own = (camera.width, camera.height);
        if own != size {
            return Ok(Err(other_size(OtherSize { photo: size, camera: own }, earlier.folder())));
        }
        if let Some(index) = self.earlier.get(&number) {
            return Ok(Ok(*index));
        }
        args.check_lens(earlier.folder(), &camera)?;
        let index = self.all.add(SfmCamera::known(camera));
        self.earlier.insert(number, index);
        Ok(Ok(index))
    }

    /// Returns the index of the camera of a photograph with that size and EXIF focal length in pixels, or why it has none.
    pub(super) fn of(
        &mut self,
        size: (usize, usize),
        exif: Option<f64>,
        args: &Args,
        context: &Context,
    ) -> Result<Result<usize, String>, Failure> {
        let exif = exif.filter(|_| !args.ignore_exif && args.camera.is_none());
        let Some(file) = &args.camera else {
            let found = self.all.get_or_add(size, args.focal.or(exif), || Ok::<_, Failure>(None))?;
            return Ok(found.map_err(|error| error.to_string()));
        };
        let calibrated = || {
            let (camera, lens_known) = rig::camera_and_lens(file, Some(size), args.undistorted, context)?;
            if !lens_known {
                return Ok(Some(SfmCamera::from_matrix(camera)));
            }
            if (camera.width, camera.height) == size {
                args.check_lens(file, &camera)?;
            }
            Ok::<_, Failure>(Some(SfmCamera::known(camera)))
        };
        Ok(self.all.get_or_add(size, None, calibrated)?.map_err(|error| other_size(error, file)))
    }

    /// Returns all cameras, by index.
    pub(super) fn list(&self) -> &[SfmCamera] {
        self.all.list()
    }
}

impl Args {
    /// Refuses, before the computation, a distortion model that the output formats cannot represent.
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
