//! Cameras shared by photographs, and the knowledge of their intrinsics.

use super::SfmCamera;
use crate::Progress;
use cv_core::Cancelled;

/// The cameras of a set of photographs: one for each image size and focal length, and those added separately.
#[derive(Debug, Clone, Default)]
pub struct SfmCameras {
    list: Vec<SfmCamera>,
    /// Camera index by image size and focal length in thousandths of a pixel.
    by_size_and_focal: std::collections::BTreeMap<((usize, usize), u64), usize>,
}

/// A photograph does not have the size of its camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("it has {photo:?} pixels but its camera has {camera:?}")]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct OtherSize {
    /// Width and height of the photograph.
    pub photo: (usize, usize),
    /// Width and height of the camera.
    pub camera: (usize, usize),
}

impl SfmCameras {
    /// Returns the index of the camera for photographs of an image size and, if known, a focal length in pixels. The
    /// camera is added if there is none.
    ///
    /// `calibrated` is called for a new camera and may return a calibrated one; else it is created from the focal
    /// length, or as unknown.
    ///
    /// # Errors
    /// Errors of `calibrated`; inside the result, [`OtherSize`] for a photograph of another size than the calibrated
    /// camera.
    pub fn get_or_add<E>(
        &mut self,
        size: (usize, usize),
        focal: Option<f64>,
        calibrated: impl FnOnce() -> Result<Option<SfmCamera>, E>,
    ) -> Result<Result<usize, OtherSize>, E> {
        let key = (size, focal.map_or(0, |f| (f * 1000.0).round() as u64));
        if let Some(index) = self.by_size_and_focal.get(&key) {
            return Ok(Ok(*index));
        }
        let uncalibrated =
            || focal.map_or_else(|| SfmCamera::unknown(size), |focal| SfmCamera::from_focal(size, focal));
        let camera = calibrated()?.unwrap_or_else(uncalibrated);
        let camera_size = (camera.camera.width, camera.camera.height);
        if camera_size != size {
            return Ok(Err(OtherSize { photo: size, camera: camera_size }));
        }
        let index = self.add(camera);
        self.by_size_and_focal.insert(key, index);
        Ok(Ok(index))
    }

    /// Adds a camera that is not shared, and returns its index.
    pub fn add(&mut self, camera: SfmCamera) -> usize {
        self.list.push(camera);
        self.list.len() - 1
    }

    /// Returns all cameras, by index.
    pub fn list(&self) -> &[SfmCamera] {
        &self.list
    }
}

/// The progress over a list of photographs; the progress within one is not reported.
pub struct PhotoProgress<'a> {
    /// The receiver.
    pub progress: &'a dyn Progress,
    /// Number of processed photographs.
    pub done: usize,
    /// Total number.
    pub total: usize,
}

impl Progress for PhotoProgress<'_> {
    fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        self.progress.report("photographs", self.done, self.total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Camera;
    use std::convert::Infallible;

    #[test]
    fn photographs_of_one_size_and_one_focal_length_share_a_camera() {
        let mut cameras = SfmCameras::default();
        let mut of = |size, focal| cameras.get_or_add(size, focal, || Ok::<_, Infallible>(None)).unwrap().unwrap();
        let (size, turned) = ((40, 30), (30, 40));
        assert_eq!(
            [of(size, None), of(size, Some(50.0)), of(size, Some(50.000_1)), of(turned, Some(50.0))],
            [0, 1, 1, 2]
        );
        assert_eq!([of(size, None), of(size, Some(50.01))], [0, 3]);
        assert_eq!(cameras.list()[1], SfmCamera::from_focal(size, 50.0));
        assert_eq!(cameras.list()[0], SfmCamera::unknown(size));
    }

    #[test]
    fn a_photograph_of_another_size_has_no_camera() {
        let mut cameras = SfmCameras::default();
        let given = SfmCamera::known(Camera::from_focal(40, 30, 35.0));
        let mut of = |size| cameras.get_or_add(size, None, || Ok::<_, Infallible>(Some(given))).unwrap();
        assert_eq!(of((30, 40)), Err(OtherSize { photo: (30, 40), camera: (40, 30) }));
        assert_eq!((of((40, 30)), of((40, 30))), (Ok(0), Ok(0)));
        assert_eq!((cameras.add(given), cameras.list().len()), (1, 2));
    }
}
