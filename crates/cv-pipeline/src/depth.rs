//! Disparity and depth of a rectified pair.

use crate::disparity_range::image_range;
use crate::no_pair::{FeatureAgreement, FewMatches, NoPairCause, diagnose};
use crate::vertical_alignment::Alignment;
use crate::{Progress, RangeError};
use cv_core::{Cancelled, GrayF32, Image, ImageView, PointCloud, RgbU8, StageClock};
use cv_imgproc::Pixel;
use cv_stereo::{
    DisparityMap, DisparityMatcher, GeometryError, Intensity, RectifyError, StereoError, StereoGeometry, StereoMatcher,
    StereoOptions, VerticalOffset,
};

/// How the range of disparities is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum DisparityRange {
    /// Those of [`StereoOptions::min_disparity`] and [`StereoOptions::disparities`].
    #[default]
    Given,
    /// That of the images ([`disparity_range`](crate::disparity_range())), from `min` px up where it is given.
    Auto {
        /// Smallest disparity, in px.
        min: Option<i32>,
    },
}

/// Settings of [`depth`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct DepthOptions {
    /// Settings of the matcher.
    pub stereo: StereoOptions,
    /// The range of disparities. Default that of `stereo`.
    pub disparities: DisparityRange,
    /// Nearest and farthest depth kept, in the unit of the baseline. Default 0 to infinity: all. (In serialized form, a
    /// farthest depth of `null` is infinity.)
    #[cfg_attr(feature = "serde", serde(with = "open_range"))]
    pub range: (f32, f32),
    /// Policy for a pair with few matches. Default [`FewMatches::Check`].
    pub few_matches: FewMatches,
    /// Whether a vertical disparity of a tenth of a pixel to 8 px, estimated from coarse matches or from features, is
    /// corrected; for a film it is estimated on the first of eight frames that determines it. Default true.
    pub align: bool,
}

impl Default for DepthOptions {
    fn default() -> Self {
        Self {
            stereo: StereoOptions::default(),
            disparities: DisparityRange::Given,
            range: (0.0, f32::INFINITY),
            few_matches: FewMatches::default(),
            align: true,
        }
    }
}

/// Serialization of a range whose upper end may be infinite, as `null`.
#[cfg(feature = "serde")]
mod open_range {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub(super) fn serialize<S: Serializer>(&(near, far): &(f32, f32), to: S) -> Result<S::Ok, S::Error> {
        (near, far.is_finite().then_some(far)).serialize(to)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<(f32, f32), D::Error> {
        let (near, far) = <(f32, Option<f32>)>::deserialize(from)?;
        Ok((near, far.unwrap_or(f32::INFINITY)))
    }
}

/// Result of [`depth`].
#[derive(Debug, Clone, PartialEq)]
pub struct DepthResult {
    /// Disparities of the left image with the state of each pixel.
    pub map: DisparityMap,
    /// Depth of the left image in the unit of the baseline, NaN where unknown; `None` without a geometry.
    pub depth: Option<GrayF32>,
    /// Confidence of each disparity, 0 to 1, 0 where filled; `None` without [`StereoOptions::confidence`].
    pub confidence: Option<GrayF32>,
    /// Standard deviation of each disparity in px, of filled ones by how far their surface was extrapolated; NaN where unknown.
    pub sigma: GrayF32,
    /// Smallest disparity searched, in px, and number of disparities.
    pub disparities: (i32, usize),
    /// The geometry that converts disparity to depth; `None` where it was not given.
    pub geometry: Option<StereoGeometry>,
    /// Agreement of feature matches with a map of few matched pixels; `None` where enough are matched.
    pub feature_agreement: Option<FeatureAgreement>,
    /// The vertical disparity that was corrected; `None` where it was below a tenth of a pixel, or not estimated.
    pub vertical_offset: Option<VerticalOffset>,
    /// Stage names and their seconds. `align` is the estimate of the vertical disparity, and `match` the matcher from the
    /// gray images (with the correction of the right one) to checked disparities; `prepare` is its memory allocation and `free` its deallocation, for which the system takes a tenth of a millisecond per MB.
    pub stages: Vec<(&'static str, f64)>,
}

impl DepthResult {
    /// Returns whether fewer than half of the pixels are matched and most of the others are filled. On generated pairs
    /// of this kind, two to three of ten filled pixels are off by more than 2 px, on others at most one or two
    /// (`tests/jobs/filled.rs`).
    pub fn is_mostly_filled(&self) -> bool {
        let matched = self.map.matched_fraction();
        matched < 0.5 && self.map.valid_fraction() - matched > 0.5 * (1.0 - matched)
    }

    /// Returns the points in the frame of the (rectified) left camera, with the colors of its image; `None` without a
    /// geometry.
    pub fn cloud(&self, left: ImageView<'_, u8, 3>) -> Option<PointCloud> {
        Some(self.geometry?.cloud(self.depth.as_ref()?.view(), left))
    }

    /// Returns the standard deviation of each depth in the unit of the baseline, to first order, NaN where unknown; `None`
    /// without a geometry.
    pub fn depth_sigma(&self) -> Option<GrayF32> {
        let (geometry, depth) = (self.geometry?, self.depth.as_ref()?);
        Some(GrayF32::from_fn(depth.width(), depth.height(), |x, y| {
            [geometry.depth_uncertainty(depth.at(x, y)[0], self.sigma.at(x, y)[0])]
        }))
    }
}

/// Why there is no depth.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum DepthError {
    /// The pair cannot be matched.
    #[error(transparent)]
    Stereo(StereoError),
    /// The geometry is not valid.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// Too few pixels are matched.
    #[error(
        "only {:.1} % of the pixels were matched and confirmed, at least {:.0} % are expected of a rectified pair; {cause}",
        100.0 * .matched, 100.0 * .needed
    )]
    NoPair {
        /// Fraction of the pixels that were matched and confirmed.
        matched: f64,
        /// The minimum fraction.
        needed: f64,
        /// The cause, as far as feature matches show it.
        cause: NoPairCause,
    },
    /// Feature matches do not determine the range of disparities.
    #[error("the range of disparities is unknown: {0}")]
    NoRange(#[source] RangeError),
    /// The images cannot be rectified.
    #[error(transparent)]
    Rectify(RectifyError),
    /// No depth is within the range to keep.
    #[error("no disparity has a depth from {} to {}: {}", .kept.0, .kept.1, match .found {
        Some((near, far)) => format!("all depths are between {near} and {far}"),
        None => "no disparity is in front of the cameras".to_owned(),
    })]
    NoDepth {
        /// Range of depths to keep, in the unit of the baseline.
        kept: (f32, f32),
        /// Range of the depths found; `None` where no disparity, with the offset of the principal points, is positive.
        found: Option<(f32, f32)>,
    },
    /// The range of depths to keep is empty.
    #[error("the depth range {near} to {far} is empty")]
    Range {
        /// Nearest depth to keep.
        near: f32,
        /// Farthest depth to keep.
        far: f32,
    },
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<StereoError> for DepthError {
    fn from(error: StereoError) -> Self {
        match error {
            StereoError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Stereo(other),
        }
    }
}

impl From<RangeError> for DepthError {
    fn from(error: RangeError) -> Self {
        match error {
            RangeError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::NoRange(other),
        }
    }
}

impl From<RectifyError> for DepthError {
    fn from(error: RectifyError) -> Self {
        match error {
            RectifyError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Rectify(other),
        }
    }
}

/// Minimum fraction of matched and confirmed pixels. Of 56 generated pairs (distant scenes, three and six times the
/// usual baseline, noise, underexposure, blur) all have at least 20 %, the least with an overlap of half. Unrelated
/// images, in 1792 pairings with 16 to 256 disparities, reach at most 15 %, as do exchanged ones whose disparities are
/// not within a few pixels of zero.
pub(crate) const MIN_MATCHED_FRACTION: f64 = 0.18;

/// Rejects a map with too few matched pixels, unless the policy keeps it: filled pixels would be made up. Returns the
/// agreement of feature matches with a map that is kept.
///
/// # Errors
/// [`DepthError::NoPair`] and [`DepthError::Cancelled`].
pub(crate) fn check_matched_fraction<T: Intensity, const C: usize>(
    map: &DisparityMap,
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    disparities: (i32, usize),
    policy: FewMatches,
    progress: &dyn Progress,
) -> Result<Option<FeatureAgreement>, DepthError> {
    let matched = map.matched_fraction();
    if matched >= MIN_MATCHED_FRACTION {
        return Ok(None);
    }
    let (cause, agreement) = diagnose(map, left, right, disparities, progress)?;
    let is_kept = match policy {
        FewMatches::Check => cause == NoPairCause::Unknown && matched > 0.0,
        FewMatches::Keep => matched > 0.0,
    };
    if is_kept { Ok(Some(agreement)) } else { Err(DepthError::NoPair { matched, needed: MIN_MATCHED_FRACTION, cause }) }
}

/// Converts an image to 8-bit RGB, 16 bits rounded.
pub(crate) fn to_rgb8<T: Intensity, const C: usize>(photo: ImageView<'_, T, C>) -> RgbU8 {
    let mut rgb = RgbU8::new(photo.width(), photo.height(), [0; 3]);
    for y in 0..photo.height() {
        let pixels = rgb.row_mut(y).as_chunks_mut::<3>().0;
        for (out, pixel) in pixels.iter_mut().zip(photo.row(y).as_chunks::<C>().0) {
            *out = std::array::from_fn(|c| ((u32::from(pixel[if C >= 3 { c } else { 0 }].to_u16()) + 128) / 257) as u8);
        }
    }
    rgb
}

/// Returns the matcher's options, with the range of disparities of feature matches where it is requested.
pub(crate) fn matcher_options<T: Intensity + Pixel, const C: usize>(
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    options: &DepthOptions,
    alignment: &mut Alignment,
    progress: &dyn Progress,
) -> Result<StereoOptions, DepthError> {
    Ok(match options.disparities {
        DisparityRange::Given => options.stereo.clone(),
        DisparityRange::Auto { min } => {
            let (min_disparity, disparities) = image_range([left, right], min, &options.stereo, alignment, progress)?;
            StereoOptions { min_disparity, disparities, ..options.stereo.clone() }
        }
    })
}

/// Computes the disparity of a rectified pair, and the depth where its geometry is known.
///
/// # Errors
/// [`DepthError`] where the images or disparities have unsuitable sizes, an option is out of range, or too few pixels
/// are matched.
pub fn depth<T: Intensity + Pixel, const C: usize>(
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    geometry: Option<&StereoGeometry>,
    options: &DepthOptions,
    progress: &dyn Progress,
) -> Result<DepthResult, DepthError> {
    check_range(options.range, geometry)?;
    let mut clock = StageClock::new();
    let mut alignment = initial_alignment(options);
    let stereo = matcher_options(left, right, options, &mut alignment, progress)?;
    if options.disparities != DisparityRange::Given {
        clock.lap("range");
    }
    let mut matcher = StereoMatcher::new(stereo)?;
    alignment.estimate([left, right], matcher.options(), progress)?;
    clock.lap("align");
    let limits = (options.range, options.few_matches);
    let mut run = || {
        let mut map = DisparityMap::empty();
        matcher.prepare(left.width(), left.height(), &mut map, progress)?;
        clock.lap("prepare");
        let found = compute_depth(&mut matcher, [left, right], map, geometry, limits, &alignment, progress)?;
        Ok(found.0)
    };
    let mut result = match run() {
        Err(DepthError::Cancelled(stop)) => {
            drop_in_background(matcher);
            return Err(stop.into());
        }
        result => result?,
    };
    result.stages.splice(0..0, clock.into_stages());
    let mut clock = StageClock::new();
    drop(matcher);
    clock.lap("free");
    result.stages.append(&mut clock.into_stages());
    Ok(result)
}

/// Frees memory in a background thread: for gigabytes it takes some tenths of a second, too long for a cancelled job.
fn drop_in_background<T: Send + 'static>(memory: T) {
    // Without threads it is freed here.
    let _ = std::thread::Builder::new().spawn(move || drop(memory));
}

/// As [`depth`], with any matcher, and without a correction of vertical disparity. `range` is the range of depths to
/// keep, in the unit of the baseline.
///
/// # Errors
/// As [`depth`].
pub fn depth_with<T: Intensity + Pixel, const C: usize>(
    matcher: &mut dyn DisparityMatcher<T, C>,
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    geometry: Option<&StereoGeometry>,
    range: (f32, f32),
    progress: &dyn Progress,
) -> Result<DepthResult, DepthError> {
    let limits = (range, FewMatches::default());
    compute_depth(matcher, [left, right], DisparityMap::empty(), geometry, limits, &Alignment::off(), progress)
        .map(|(result, _)| result)
}

/// Returns the initial state of the vertical alignment.
pub(crate) fn initial_alignment(options: &DepthOptions) -> Alignment {
    if options.align { Alignment::default() } else { Alignment::off() }
}

/// As [`depth_with`], with a policy for few matches and a vertical alignment. Also returns the corrected right image,
/// where it was corrected.
pub(crate) fn compute_depth<T: Intensity + Pixel, const C: usize>(
    matcher: &mut dyn DisparityMatcher<T, C>,
    [left, right]: [ImageView<'_, T, C>; 2],
    mut map: DisparityMap,
    geometry: Option<&StereoGeometry>,
    (range, policy): ((f32, f32), FewMatches),
    alignment: &Alignment,
    progress: &dyn Progress,
) -> Result<(DepthResult, Option<Image<T, C>>), DepthError> {
    check_range(range, geometry)?;
    let mut clock = StageClock::new();
    let corrected = alignment.correct(right)?;
    let right = corrected.as_ref().map_or(right, Image::view);
    matcher.compute_into(left, right, &mut map, progress)?;
    clock.lap("match");
    let disparities = matcher.disparities();
    let feature_agreement = check_matched_fraction(&map, left, right, disparities, policy, progress)?;
    progress.report("depth", 0, 1)?;
    let depth = geometry.map(|geometry| depth_in_range(geometry, &map, range)).transpose()?;
    let confidence = matcher.confidence(&map);
    progress.report("depth", 0, 1)?;
    let sigma = matcher.uncertainty(&map);
    clock.lap("depth");
    let geometry = geometry.copied();
    let (vertical_offset, stages) = (alignment.offset, clock.into_stages());
    let result = DepthResult {
        map,
        depth,
        confidence,
        sigma,
        disparities,
        geometry,
        feature_agreement,
        vertical_offset,
        stages,
    };
    Ok((result, corrected))
}

/// Computes the depths in `range`; an error if there is none.
fn depth_in_range(geometry: &StereoGeometry, map: &DisparityMap, range: (f32, f32)) -> Result<GrayF32, DepthError> {
    let depth = geometry.depth_map(map.disparity.view(), range);
    if depth.as_slice().iter().any(|z| z.is_finite()) {
        return Ok(depth);
    }
    let all = geometry.depth_map(map.disparity.view(), (0.0, f32::INFINITY));
    let finite = || all.as_slice().iter().copied().filter(|z| z.is_finite());
    let found = finite().reduce(f32::min).zip(finite().reduce(f32::max));
    Err(DepthError::NoDepth { kept: range, found })
}

/// Rejects an empty range of depths and an invalid geometry.
pub(crate) fn check_range((near, far): (f32, f32), geometry: Option<&StereoGeometry>) -> Result<(), DepthError> {
    // Also rejects NaN.
    if near.partial_cmp(&far) != Some(std::cmp::Ordering::Less) {
        return Err(DepthError::Range { near, far });
    }
    Ok(geometry.map_or(Ok(()), StereoGeometry::validate)?)
}
