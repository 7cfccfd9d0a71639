//! Disparity and depth of the frames of a stereo film.

use crate::depth::{check_matched_fraction, check_range, compute_depth, initial_alignment, matcher_options, to_rgb8};
use crate::vertical_alignment::Alignment;
use crate::{DepthError, DepthOptions, DisparityRange, Progress, RigDepthResult};
use cv_core::{Image, ImageView, PointCloud, Pose, StageClock, Vector3};
use cv_imgproc::{Pixel, WarpMap};
use cv_stereo::{
    DisparityMap, Intensity, Rectification, RectifyError, StereoGeometry, StereoMatcher, StereoOptions, VerticalOffset,
};
use std::any::Any;

/// Matches the frames of a film with one allocation and one range of disparities. With [`DisparityRange::Auto`],
/// the first frame determines the range. With [`FrameDepth::forget`] also pairs that are not of one film.
#[derive(Debug)]
pub struct FrameDepth {
    options: DepthOptions,
    rectification: Option<Rectification>,
    /// Warp maps of both rectified views, computed at the first frame.
    maps: Option<[WarpMap; 2]>,
    /// The rectified images of the last frame, whose memory is used again: two images of the frames' type.
    rectified: Option<Box<dyn Any + Send + Sync>>,
    geometry: Option<StereoGeometry>,
    matcher: Option<StereoMatcher>,
    /// Vertical alignment of the (rectified) pairs.
    alignment: Alignment,
    map: DisparityMap,
}

impl FrameDepth {
    /// Creates a matcher for rectified pairs; depth is computed where the geometry is known.
    ///
    /// # Errors
    /// [`DepthError`] if an option is out of range or the geometry is invalid.
    pub fn new(options: DepthOptions, geometry: Option<StereoGeometry>) -> Result<Self, DepthError> {
        check_range(options.range, geometry.as_ref())?;
        // Validates the options before the first frame.
        let matcher = Some(StereoMatcher::new(options.stereo.clone())?);
        let matcher = matcher.filter(|_| fits_all_pairs(&options));
        Ok(Self {
            alignment: initial_alignment(&options),
            options,
            rectification: None,
            maps: None,
            rectified: None,
            geometry,
            matcher,
            map: DisparityMap::empty(),
        })
    }

    /// Creates a matcher for the images of a rig, which are rectified first.
    ///
    /// # Errors
    /// As [`FrameDepth::new`].
    pub fn of_rig(options: DepthOptions, rectification: &Rectification) -> Result<Self, DepthError> {
        let frames = Self::new(options, Some(rectification.geometry))?;
        Ok(Self { rectification: Some(*rectification), ..frames })
    }

    /// Makes the next pair independent of the previous ones: its vertical disparity and, with
    /// [`DisparityRange::Auto`], its range are determined anew. Memory and warp maps are kept.
    pub fn forget(&mut self) {
        self.alignment = initial_alignment(&self.options);
        self.matcher = self.matcher.take().filter(|_| fits_all_pairs(&self.options));
        self.matcher.iter_mut().for_each(StereoMatcher::forget_frame);
    }

    /// Returns the vertical disparity that is corrected, estimated on the first frame that determines it; `None` where
    /// none is.
    pub fn vertical_offset(&self) -> Option<VerticalOffset> {
        self.alignment.offset
    }

    /// Returns the smallest disparity and the number of disparities; `None` before the first frame determines them.
    pub fn disparities(&self) -> Option<(i32, usize)> {
        self.matcher.as_ref().map(|matcher| (matcher.options().min_disparity, matcher.options().disparities))
    }

    /// Computes the disparities of the next frame. The map is valid until the following frame.
    ///
    /// # Errors
    /// [`DepthError`] as of [`depth()`](crate::depth()).
    pub fn next<T: Intensity + Pixel, const C: usize>(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        progress: &dyn Progress,
    ) -> Result<&DisparityMap, DepthError> {
        let rectified = self.rectify([left, right], progress)?;
        let [left, right] = rectified.as_ref().map_or([left, right], |pair| pair.each_ref().map(Image::view));
        let matcher = get_or_create_matcher(
            &mut self.matcher,
            &self.options,
            &self.maps,
            &mut self.alignment,
            [left, right],
            progress,
        )?;
        if self.alignment.estimate([left, right], matcher.options(), progress)? {
            matcher.forget_frame();
        }
        let corrected = self.alignment.correct(right)?;
        let right = corrected.as_ref().map_or(right, Image::view);
        matcher.compute_into(left, right, &mut self.map, progress)?;
        let StereoOptions { min_disparity, disparities, .. } = *matcher.options();
        check_matched_fraction(
            &self.map,
            left,
            right,
            (min_disparity, disparities),
            self.options.few_matches,
            progress,
        )?;
        self.recycle(rectified);
        Ok(&self.map)
    }

    /// Computes disparity and depth of the next frame; the points only if `wanted`.
    ///
    /// # Errors
    /// [`DepthError`] as of [`depth()`](crate::depth()), and [`DepthError::Rectify`] if an image does not have its
    /// camera's size.
    pub fn next_depth<T: Intensity + Pixel, const C: usize>(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        wanted: bool,
        progress: &dyn Progress,
    ) -> Result<RigDepthResult, DepthError> {
        let mut clock = StageClock::new();
        let rectified = self.rectify([left, right], progress)?;
        let [left, right] = rectified.as_ref().map_or([left, right], |pair| pair.each_ref().map(Image::view));
        if rectified.is_some() {
            clock.lap("rectify");
        }
        let is_first = self.matcher.is_none();
        let matcher = get_or_create_matcher(
            &mut self.matcher,
            &self.options,
            &self.maps,
            &mut self.alignment,
            [left, right],
            progress,
        )?;
        if is_first {
            clock.lap("range");
        }
        if self.alignment.estimate([left, right], matcher.options(), progress)? {
            matcher.forget_frame();
        }
        clock.lap("align");
        let mut map = DisparityMap::empty();
        matcher.prepare(left.width(), left.height(), &mut map, progress)?;
        clock.lap("prepare");
        let limits = (self.options.range, self.options.few_matches);
        let geometry = self.geometry.as_ref();
        let (mut maps, corrected) =
            compute_depth(matcher, [left, right], map, geometry, limits, &self.alignment, progress)?;
        maps.stages.iter().for_each(|(stage, seconds)| clock.add(stage, *seconds));
        maps.stages = clock.into_stages();
        let images = [to_rgb8(left), to_rgb8(corrected.as_ref().map_or(right, Image::view))];
        let cloud = if wanted { maps.cloud(images[0].view()) } else { None };
        let mut cloud: PointCloud = cloud.unwrap_or_default();
        if let Some(rectification) = &self.rectification {
            cloud.transform(&Pose::new(rectification.left.rotation.inverse(), Vector3::zeros()));
        }
        self.recycle(rectified);
        Ok(RigDepthResult { images, maps, cloud })
    }

    /// Keeps the memory of the rectified images for the next frame.
    fn recycle<T: Pixel, const C: usize>(&mut self, rectified: Option<Box<[Image<T, C>; 2]>>) {
        self.rectified = rectified.map(|pair| -> Box<dyn Any + Send + Sync> { pair });
    }

    /// Rectifies the images of a rig; `None` if they are rectified already.
    fn rectify<T: Pixel, const C: usize>(
        &mut self,
        images: [ImageView<'_, T, C>; 2],
        progress: &dyn Progress,
    ) -> Result<Option<Box<[Image<T, C>; 2]>>, DepthError> {
        let Some(rectification) = &self.rectification else { return Ok(None) };
        let views = [&rectification.left, &rectification.right];
        for (view, image) in views.into_iter().zip(&images) {
            let expected = (view.source.width, view.source.height);
            if image.size() != expected {
                return Err(RectifyError::ImageSize { image: image.size(), expected }.into());
            }
        }
        let maps = match self.maps.take() {
            Some(maps) => maps,
            None => {
                let maps = [views[0].map(progress)?, views[1].map(progress)?];
                if let Some(matcher) = &mut self.matcher {
                    set_masks(matcher, &maps);
                }
                maps
            }
        };
        let maps = self.maps.insert(maps);
        // Without memory of the same type, it is allocated.
        let recycled = self.rectified.take().and_then(|recycled| recycled.downcast::<[Image<T, C>; 2]>().ok());
        let empty = || maps.each_ref().map(|map| Image::new(map.size().0, map.size().1, [T::default(); C]));
        let mut pair = recycled.unwrap_or_else(|| Box::new(empty()));
        for ((map, image), output) in maps.iter().zip(images).zip(pair.iter_mut()) {
            let (width, height) = map.size();
            map.compute_into(image, output).map_err(|_| RectifyError::TooLarge { width, height })?;
        }
        Ok(Some(pair))
    }
}

/// Whether one matcher serves any pair: its range is given.
fn fits_all_pairs(options: &DepthOptions) -> bool {
    options.disparities == DisparityRange::Given
}

/// Tells a matcher which pixels of the rectified images have data.
fn set_masks(matcher: &mut StereoMatcher, maps: &[WarpMap; 2]) {
    let [left, right] = maps.each_ref().map(WarpMap::inside);
    matcher.set_masks(Some([&left, &right]));
}

/// Returns the matcher. It is created for the range of disparities of this pair if there is none.
fn get_or_create_matcher<'m, T: Intensity + Pixel, const C: usize>(
    matcher: &'m mut Option<StereoMatcher>,
    options: &DepthOptions,
    maps: &Option<[WarpMap; 2]>,
    alignment: &mut Alignment,
    [left, right]: [ImageView<'_, T, C>; 2],
    progress: &dyn Progress,
) -> Result<&'m mut StereoMatcher, DepthError> {
    let created = match matcher.take() {
        Some(created) => created,
        None => {
            let mut created = StereoMatcher::new(matcher_options(left, right, options, alignment, progress)?)?;
            if let Some(maps) = maps {
                set_masks(&mut created, maps);
            }
            created
        }
    };
    Ok(matcher.insert(created))
}
