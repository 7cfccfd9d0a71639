//! Which photographs share a camera, and what is known of it.

use super::SfmCamera;
use crate::Progress;
use cv_core::Cancelled;

/// The cameras of the photographs so far: one for each size and focal length, and those that were added by themselves.
#[derive(Debug, Clone, Default)]
pub struct SfmCameras {
    list: Vec<SfmCamera>,
    /// By size and focal length in thousandths of a pixel.
    known: std::collections::BTreeMap<((usize, usize), u64), usize>,
}

/// A photograph has another size than the camera that is said to have taken it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("it has {photo:?} pixels where its camera has {camera:?}")]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct OtherSize {
    /// Width and height of the photograph.
    pub photo: (usize, usize),
    /// The camera's.
    pub camera: (usize, usize),
}

impl SfmCameras {
    /// The index of the camera of photographs of that size and, where it is known, about that focal length in pixels.
    ///
    /// `calibrated` is asked at the first of them: the camera, where one is given; else it is made of the focal length, or of nothing.
    ///
    /// # Errors
    /// Those of `calibrated`; within, [`OtherSize`] of a photograph that its camera has not taken.
    pub fn of<E>(
        &mut self,
        size: (usize, usize),
        focal: Option<f64>,
        calibrated: impl FnOnce() -> Result<Option<SfmCamera>, E>,
    ) -> Result<Result<usize, OtherSize>, E> {
        let key = (size, focal.map_or(0, |f| (f * 1000.0).round() as u64));
        if let Some(index) = self.known.get(&key) {
            return Ok(Ok(*index));
        }
        let made = || focal.map_or_else(|| SfmCamera::unknown(size), |focal| SfmCamera::of_focal(size, focal));
        let camera = calibrated()?.unwrap_or_else(made);
        let own = (camera.camera.width, camera.camera.height);
        if own != size {
            return Ok(Err(OtherSize { photo: size, camera: own }));
        }
        let index = self.add(camera);
        self.known.insert(key, index);
        Ok(Ok(index))
    }

    /// Adds a camera that is shared with none; its index.
    pub fn add(&mut self, camera: SfmCamera) -> usize {
        self.list.push(camera);
        self.list.len() - 1
    }

    /// All of them, by index.
    pub fn list(&self) -> &[SfmCamera] {
        &self.list
    }
}

/// The progress of looking at photographs one by one: what is done within one of them does not count.
pub struct PhotoProgress<'a> {
    /// Hears it.
    pub progress: &'a dyn Progress,
    /// Photographs that have been looked at.
    pub done: usize,
    /// All of them.
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
        let mut of = |size, focal| cameras.of(size, focal, || Ok::<_, Infallible>(None)).unwrap().unwrap();
        let (size, turned) = ((40, 30), (30, 40));
        assert_eq!(
            [of(size, None), of(size, Some(50.0)), of(size, Some(50.000_1)), of(turned, Some(50.0))],
            [0, 1, 1, 2]
        );
        assert_eq!([of(size, None), of(size, Some(50.01))], [0, 3]);
        assert_eq!(cameras.list()[1], SfmCamera::of_focal(size, 50.0));
        assert_eq!(cameras.list()[0], SfmCamera::unknown(size));
    }

    #[test]
    fn a_photograph_of_another_size_has_no_camera() {
        let mut cameras = SfmCameras::default();
        let given = SfmCamera::known(Camera::from_focal(40, 30, 35.0));
        let mut of = |size| cameras.of(size, None, || Ok::<_, Infallible>(Some(given))).unwrap();
        assert_eq!(of((30, 40)), Err(OtherSize { photo: (30, 40), camera: (40, 30) }));
        assert_eq!((of((40, 30)), of((40, 30))), (Ok(0), Ok(0)));
        assert_eq!((cameras.add(given), cameras.list().len()), (1, 2));
    }
}
