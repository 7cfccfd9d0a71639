//! Disparity and depth of the frames of a film, one pair after the other.

use crate::depth::{alignment_of, check_pair, check_range, color_bytes, depth_of, matcher_options};
use crate::vertical_offset::{Alignment, VerticalOffset};
use crate::{DepthError, DepthOptions, DisparityRange, Progress, RigDepthResult};
use cv_core::{Image, ImageView, PointCloud, Pose, StageClock, Vector3};
use cv_imgproc::{Pixel, WarpMap};
use cv_stereo::{DisparityMap, Intensity, Rectification, RectifyError, StereoGeometry, StereoMatcher, StereoOptions};
use std::any::Any;

/// Matches frame after frame with the same memory and the same disparities: where those are to be found
/// ([`DisparityRange::FromMatches`]), the first frame shows them for all.
#[derive(Debug)]
pub struct FrameDepth {
    options: DepthOptions,
    rectification: Option<Rectification>,
    /// Of both views of the rectification, made with the first frame.
    maps: Option<[WarpMap; 2]>,
    /// The rectified photographs of the last frame, whose memory the next one's take: two images of the frames' type.
    rectified: Option<Box<dyn Any + Send + Sync>>,
    geometry: Option<StereoGeometry>,
    matcher: Option<StereoMatcher>,
    /// How far apart the rows of the (rectified) pairs are.
    alignment: Alignment,
    map: DisparityMap,
}

impl FrameDepth {
    /// For rectified pairs; there is depth where their geometry is known.
    ///
    /// # Errors
    /// [`DepthError`] where an option is out of range or the geometry is none.
    pub fn new(options: DepthOptions, geometry: Option<StereoGeometry>) -> Result<Self, DepthError> {
        check_range(options.range, geometry.as_ref())?;
        // What is wrong with the options is told before the first frame.
        let matcher = Some(StereoMatcher::new(options.stereo.clone())?);
        let matcher = matcher.filter(|_| options.disparities == DisparityRange::Given);
        Ok(Self {
            alignment: alignment_of(&options),
            options,
            rectification: None,
            maps: None,
            rectified: None,
            geometry,
            matcher,
            map: DisparityMap::empty(),
        })
    }

    /// For the photographs of a rig, which are rectified first.
    ///
    /// # Errors
    /// As [`FrameDepth::new`].
    pub fn of_rig(options: DepthOptions, rectification: &Rectification) -> Result<Self, DepthError> {
        let frames = Self::new(options, Some(rectification.geometry))?;
        Ok(Self { rectification: Some(*rectification), ..frames })
    }

    /// How far apart the rows of the pairs are, which are aligned from the first pair on that showed it; `None` where they are not.
    pub fn vertical_offset(&self) -> Option<VerticalOffset> {
        self.alignment.offset
    }

    /// Smallest disparity and number of them that are tried; `None` while the first frame has not shown them.
    pub fn disparities(&self) -> Option<(i32, usize)> {
        self.matcher.as_ref().map(|matcher| (matcher.options().min_disparity, matcher.options().disparities))
    }

    /// Disparities of the next frame's left image alone. The map stays until the frame after it.
    ///
    /// # Errors
    /// [`DepthError`] as of [`depth()`](crate::depth()).
    pub fn next<T: Intensity + Pixel, const C: usize>(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        progress: &dyn Progress,
    ) -> Result<&DisparityMap, DepthError> {
        let rectified = self.rectified([left, right], progress)?;
        let [left, right] = rectified.as_ref().map_or([left, right], |pair| pair.each_ref().map(Image::view));
        let matcher = matcher(&mut self.matcher, &self.options, &mut self.alignment, [left, right], progress)?;
        let corrected = self.alignment.compute(matcher, [left, right], &mut self.map, progress)?;
        let right = corrected.as_ref().map_or(right, Image::view);
        let StereoOptions { min_disparity, disparities, .. } = *matcher.options();
        check_pair(&self.map, left, right, (min_disparity, disparities), self.options.few_matches, progress)?;
        self.keep(rectified);
        Ok(&self.map)
    }

    /// All that there is of the next frame; the points only where they are `wanted`.
    ///
    /// # Errors
    /// [`DepthError`] as of [`depth()`](crate::depth()), and [`DepthError::Rectify`] where a photograph is not of its camera's size.
    pub fn next_depth<T: Intensity + Pixel, const C: usize>(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        wanted: bool,
        progress: &dyn Progress,
    ) -> Result<RigDepthResult, DepthError> {
        let mut clock = StageClock::new();
        let rectified = self.rectified([left, right], progress)?;
        let [left, right] = rectified.as_ref().map_or([left, right], |pair| pair.each_ref().map(Image::view));
        if rectified.is_some() {
            clock.lap("rectify");
        }
        let unknown = self.matcher.is_none();
        let matcher = matcher(&mut self.matcher, &self.options, &mut self.alignment, [left, right], progress)?;
        if unknown {
            clock.lap("range");
        }
        matcher.prepare(left.width(), left.height(), &mut self.map, progress)?;
        clock.lap("prepare");
        let kept = (self.options.range, self.options.few_matches);
        let geometry = self.geometry.as_ref();
        let (mut maps, corrected) = depth_of(matcher, [left, right], geometry, kept, &mut self.alignment, progress)?;
        maps.stages.iter().for_each(|(stage, seconds)| clock.add(stage, *seconds));
        maps.stages = clock.into_stages();
        let images = [color_bytes(left), color_bytes(corrected.as_ref().map_or(right, Image::view))];
        let cloud = if wanted { maps.cloud(images[0].view()) } else { None };
        let mut cloud: PointCloud = cloud.unwrap_or_default();
        if let Some(rectification) = &self.rectification {
            cloud.transform(&Pose::new(rectification.left.rotation.inverse(), Vector3::zeros()));
        }
        self.keep(rectified);
        Ok(RigDepthResult { images, maps, cloud })
    }

    /// Keeps the memory of rectified photographs for those of the next frame.
    fn keep<T: Pixel, const C: usize>(&mut self, rectified: Option<Box<[Image<T, C>; 2]>>) {
        self.rectified = rectified.map(|pair| -> Box<dyn Any + Send + Sync> { pair });
    }

    /// The photographs of a rig as they are rectified; `None` where they are already.
    fn rectified<T: Pixel, const C: usize>(
        &mut self,
        photographs: [ImageView<'_, T, C>; 2],
        progress: &dyn Progress,
    ) -> Result<Option<Box<[Image<T, C>; 2]>>, DepthError> {
        let Some(rectification) = &self.rectification else { return Ok(None) };
        let views = [&rectification.left, &rectification.right];
        for (view, photograph) in views.into_iter().zip(&photographs) {
            let expected = (view.source.width, view.source.height);
            if photograph.size() != expected {
                return Err(RectifyError::ImageSize { image: photograph.size(), expected }.into());
            }
        }
        let maps = match self.maps.take() {
            Some(maps) => maps,
            None => [views[0].map(progress)?, views[1].map(progress)?],
        };
        let maps = self.maps.insert(maps);
        // Of frames of another type, or the first one's, there is none.
        let kept = self.rectified.take().and_then(|kept| kept.downcast::<[Image<T, C>; 2]>().ok());
        let empty = || maps.each_ref().map(|map| Image::new(map.size().0, map.size().1, [T::default(); C]));
        let mut pair = kept.unwrap_or_else(|| Box::new(empty()));
        for ((map, photograph), image) in maps.iter().zip(photographs).zip(pair.iter_mut()) {
            let (width, height) = map.size();
            map.compute_into(photograph, image).map_err(|_| RectifyError::TooLarge { width, height })?;
        }
        Ok(Some(pair))
    }
}

/// The matcher; made where there is none yet, for the disparities that this pair shows.
fn matcher<'m, T: Intensity + Pixel, const C: usize>(
    matcher: &'m mut Option<StereoMatcher>,
    options: &DepthOptions,
    alignment: &mut Alignment,
    [left, right]: [ImageView<'_, T, C>; 2],
    progress: &dyn Progress,
) -> Result<&'m mut StereoMatcher, DepthError> {
    let made = match matcher.take() {
        Some(made) => made,
        None => StereoMatcher::new(matcher_options(left, right, options, alignment, progress)?)?,
    };
    Ok(matcher.insert(made))
}
