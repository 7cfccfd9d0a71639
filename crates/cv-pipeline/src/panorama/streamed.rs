//! Panoramas within a limit of memory: photographs are loaded when they are needed, and rows are handed on.

use super::order::{Order, sparse_hash, whole_hashes};
use super::register::{Photographs, Prepare, Prepared, register};
use super::{PanoramaError, PanoramaOptions, PanoramaPhoto, PanoramaResult, collected, known_registration};
use crate::Progress;
use cv_core::{Camera, Image, ImageView, Stage};
use cv_panorama::{
    EightBits, Layer, MemoryLimit, NO_PHOTO, NotWritten, PhotoMask, PhotoSample, PhotoSource, Registration,
    RenderError, RowSink, StreamError, StreamedFrame, check_masks, render_streamed,
};
use cv_parallel::prelude::*;
use std::borrow::Cow;

/// Prior knowledge of the camera of a photograph.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PanoramaPrior {
    /// Focal length in pixels from EXIF, where there is one.
    pub focal: Option<f64>,
    /// The calibrated camera, where there is one; kept constant, and its distortion is corrected.
    pub camera: Option<Camera>,
}

/// Stitches photographs as [`panorama`](super::panorama), or with a known registration as [`panorama_with`](super::panorama_with), within a limit of memory.
///
/// The pixels are the same; they are handed to `output` row by row, with the input index of each pixel's photograph, and `image`, `mask` and `labels` of the result are
/// empty. `priors` has an entry for each photograph. Photographs are loaded up to four times.
///
/// # Errors
/// [`PanoramaError`]; [`StreamError`] in [`RenderError::Stream`].
pub fn panorama_streamed<T: PhotoSample>(
    photos: &dyn PhotoSource<T>,
    priors: &[PanoramaPrior],
    registration: Option<&Registration>,
    options: &PanoramaOptions,
    limit: MemoryLimit,
    output: &mut dyn RowSink<T>,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    let sizes: Vec<_> = (0..priors.len()).map(|index| photos.size(index)).collect();
    if let Some(registration) = registration {
        registration.check_photographs(&sizes)?;
    }
    let masks: Vec<_> = (0..priors.len()).map(|index| photos.mask(index)).collect();
    check_masks(|index| sizes[index], &masks)?;
    let largest = sizes.iter().map(|(w, h)| w * h).max().unwrap_or(0);
    // The file, the decoder's output, a copy of 8 bits, and the features of the resized photograph, for which 100 bytes per pixel are ample.
    let each = largest * (4 * size_of::<T>() + 1) + 100 * options.registration_pixels;
    let at_once = (limit.bytes / 2 / each.max(1)).clamp(1, rayon::current_num_threads());
    let order = order(photos, &sizes, at_once, progress)?;
    let (sizes, priors) = (order.sorted(&sizes), order.sorted(priors));
    let sorted = Sorted { photos, inputs: order.inputs() };
    let mut rows = Renumbered { output, inputs: order.inputs() };
    let stitch = || {
        let found = match registration {
            Some(registration) => known_registration(order.sorted_alignment(registration.alignment()), &sizes),
            None => register(&Loaded { photos: &sorted, priors: &priors, at_once, progress }, options, progress)?,
        };
        collected(found, |alignment| render_streamed(&sorted, alignment, &options.render, limit, &mut rows, progress))
    };
    stitch().map(|result| order.restored_result(result)).map_err(|error| order.restored_error(error))
}

/// Loads a photograph.
fn load<T: PhotoSample>(photos: &dyn PhotoSource<T>, index: usize) -> Result<Cow<'_, Image<T, 3>>, RenderError> {
    let photo = photos.load(index).filter(|photo| photo.size() == photos.size(index));
    Ok(photo.ok_or(StreamError::Photograph { index })?)
}

/// Loads all photographs, `at_once` at a time, for their canonical order.
fn order<T: PhotoSample>(
    photos: &dyn PhotoSource<T>,
    sizes: &[(usize, usize)],
    at_once: usize,
    progress: &dyn Progress,
) -> Result<Order, PanoramaError> {
    let stage = Stage::new(progress, "features", sizes.len())?;
    let indices: Vec<usize> = (0..sizes.len()).collect();
    let mut sparse = Vec::with_capacity(sizes.len());
    for batch in indices.chunks(at_once) {
        let hash = |&index: &usize| -> Result<((usize, usize), u64), PanoramaError> {
            let hash = sparse_hash(&load(photos, index)?.view());
            stage.add(1)?;
            Ok((sizes[index], hash))
        };
        sparse.extend(batch.par_iter().map(hash).try_collect()?);
    }
    // One that cannot be read again is reported by the next that loads it.
    Ok(Order::by(&sparse, |index| load(photos, index).map_or([0; 2], |photo| whole_hashes(&photo.view()))))
}

/// Photographs in canonical order.
struct Sorted<'a, T> {
    photos: &'a dyn PhotoSource<T>,
    inputs: &'a [usize],
}

impl<T: PhotoSample> PhotoSource<T> for Sorted<'_, T> {
    fn size(&self, index: usize) -> (usize, usize) {
        self.inputs.get(index).map_or((0, 0), |&input| self.photos.size(input))
    }

    fn load(&self, index: usize) -> Option<Cow<'_, Image<T, 3>>> {
        self.photos.load(*self.inputs.get(index)?)
    }

    fn mask(&self, index: usize) -> Option<&PhotoMask> {
        self.photos.mask(*self.inputs.get(index)?)
    }
}

/// Photographs for registration.
struct Loaded<'a, T> {
    photos: &'a Sorted<'a, T>,
    priors: &'a [PanoramaPrior],
    at_once: usize,
    progress: &'a dyn Progress,
}

impl<T: PhotoSample> Photographs for Loaded<'_, T> {
    fn count(&self) -> usize {
        self.priors.len()
    }

    fn size(&self, index: usize) -> (usize, usize) {
        self.photos.size(index)
    }

    fn at_once(&self) -> usize {
        self.at_once
    }

    fn prepare(&self, index: usize, prepare: &Prepare<'_>) -> Result<Prepared, PanoramaError> {
        let photo = load(self.photos, index)?;
        let views = [photo.view()];
        let bytes = EightBits::new(&views, "features", self.progress)?;
        let PanoramaPrior { focal, camera } = self.priors[index];
        let [image] = bytes.views()[..] else {
            return Err(RenderError::from(StreamError::Photograph { index }).into());
        };
        Ok(prepare(&PanoramaPhoto { image, focal, camera, mask: self.photos.mask(index) })?)
    }
}

/// Rows with labels in canonical order, handed on with those of the inputs.
struct Renumbered<'a, T> {
    output: &'a mut dyn RowSink<T>,
    inputs: &'a [usize],
}

impl<T: PhotoSample> RowSink<T> for Renumbered<'_, T> {
    fn begin(&mut self, frame: &StreamedFrame) -> Result<(), NotWritten> {
        let mut photos: Vec<usize> = frame.photos.iter().map(|&photo| self.inputs[photo]).collect();
        photos.sort_unstable();
        self.output.begin(&StreamedFrame { size: frame.size, reference: self.inputs[frame.reference], photos })
    }

    fn wants_layers(&self) -> bool {
        self.output.wants_layers()
    }

    fn layer(&mut self, layer: Layer<T>) -> Result<(), NotWritten> {
        let photo = self.inputs[layer.photo];
        self.output.layer(Layer { photo, ..layer })
    }

    fn rows(&mut self, colors: ImageView<'_, T, 3>, labels: ImageView<'_, u16, 1>) -> Result<(), NotWritten> {
        let labels = labels.to_image().map(|[l]| [self.inputs.get(usize::from(l)).map_or(NO_PHOTO, |&i| i as u16)]);
        self.output.rows(colors, labels.view())
    }
}
