//! Depth from a rectified pair.

use crate::disparity_range::{is_exchanged, matches_of, range_from};
use crate::no_pair::{FeatureAgreement, FewMatches, NoPairCause, cause};
use crate::vertical_offset::{Alignment, VerticalOffset};
use crate::{Progress, RangeError};
use cv_core::{Cancelled, GrayF32, Image, ImageView, PointCloud, RgbU8, StageClock};
use cv_imgproc::Pixel;
use cv_stereo::{
    DisparityMap, DisparityMatcher, GeometryError, Intensity, RectifyError, StereoError, StereoGeometry, StereoMatcher,
    StereoOptions,
};

/// Which disparities are tried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum DisparityRange {
    /// Those of [`StereoOptions::min_disparity`] and [`StereoOptions::disparities`].
    #[default]
    Given,
    /// Those that feature matches show ([`disparity_range`](crate::disparity_range())), from `min` px up where it is given.
    FromMatches {
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
    /// Which disparities are tried. Default those of `stereo`.
    pub disparities: DisparityRange,
    /// Nearest and farthest depth kept, in the unit of the baseline. Default 0 to infinity: all. (As data, a farthest depth of `null` is
    /// infinity, which JSON does not know.)
    #[cfg_attr(feature = "serde", serde(with = "open_range"))]
    pub range: (f32, f32),
    /// What becomes of a pair of which hardly anything is matched. Default [`FewMatches::Check`].
    pub few_matches: FewMatches,
    /// Whether rows that lie a third of a pixel to 8 px apart, by the pair's matches or features, are aligned; of a film, by the first frame that tells. Default true.
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

/// A range whose upper end may be infinite, which is written as none.
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

/// What [`depth`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthResult {
    /// Disparities of the left image, and where each comes from.
    pub map: DisparityMap,
    /// Depth of the left image in the unit of the baseline, NaN where unknown; `None` without a geometry.
    pub depth: Option<GrayF32>,
    /// How sure each disparity is, 0 to 1, 0 where filled; `None` without [`StereoOptions::confidence`].
    pub confidence: Option<GrayF32>,
    /// Standard deviation of each disparity in px, of filled ones by how far their surface was extrapolated; NaN where unknown.
    pub sigma: GrayF32,
    /// Smallest disparity tried, in px, and how many.
    pub disparities: (i32, usize),
    /// What made depth of disparity; `None` where it was not given.
    pub geometry: Option<StereoGeometry>,
    /// Where fewer pixels were matched than nearly all rectified pairs show: what features say of them. `None` where there were enough.
    pub few: Option<FeatureAgreement>,
    /// How far apart the rows of the pair were, which were aligned; `None` where they were not, and where they were less than a third of a pixel apart.
    pub vertical_offset: Option<VerticalOffset>,
    /// Stage names and their seconds. `match` is the matcher from the gray images to checked disparities; `prepare` is
    /// the memory it asks for beforehand.
    pub stages: Vec<(&'static str, f64)>,
}

impl DepthResult {
    /// Whether fewer than half of the pixels were matched and most of the others filled in from around: of generated pairs like that, two to three of
    /// ten filled pixels are off by more than 2 px, of others at most one or two (`tests/filled.rs`).
    pub fn is_mostly_filled(&self) -> bool {
        let matched = self.map.matched_fraction();
        matched < 0.5 && self.map.valid_fraction() - matched > 0.5 * (1.0 - matched)
    }

    /// The pixels with a depth as points in the frame of the (rectified) left camera, with the colors of its photograph; `None` without a
    /// geometry.
    pub fn cloud(&self, left: ImageView<'_, u8, 3>) -> Option<PointCloud> {
        Some(self.geometry?.cloud(self.depth.as_ref()?.view(), left))
    }

    /// Returns the standard deviation of each depth in the unit of the baseline, to first order, NaN where unknown; `None` without a geometry.
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
    /// The geometry is none.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// Hardly any pixel of one photograph has a partner in the other.
    #[error(
        "only {:.1} % of the pixels were matched and confirmed, fewer than the {:.0} % that a rectified pair shows at the least; {cause}",
        100.0 * .matched, 100.0 * .needed
    )]
    NoPair {
        /// Share of the pixels that were matched and confirmed.
        matched: f64,
        /// The least that counts.
        needed: f64,
        /// What features show.
        cause: NoPairCause,
    },
    /// Features do not tell which disparities to try.
    #[error("the range of disparities is unknown: {0}")]
    NoRange(#[source] RangeError),
    /// The photographs cannot be rectified.
    #[error(transparent)]
    Rectify(RectifyError),
    /// No disparity has a depth that is kept.
    #[error("no disparity has a depth from {} to {}: {}", .kept.0, .kept.1, match .found {
        Some((near, far)) => format!("those there are lie between {near} and {far}"),
        None => "none is in front of the cameras".to_owned(),
    })]
    NoDepth {
        /// Nearest and farthest depth kept, in the unit of the baseline.
        kept: (f32, f32),
        /// Nearest and farthest depth there is; `None` where no disparity, with the offset of the principal points, is above zero.
        found: Option<(f32, f32)>,
    },
    /// The range of depths is empty.
    #[error("the depth range {near} to {far} is empty")]
    Range {
        /// Nearest depth kept.
        near: f32,
        /// Farthest depth kept.
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

/// Share of the pixels that must be matched and confirmed. Of 56 generated pairs of four kinds (seeds 400 and 401: far things,
/// three and six times the usual distance of the cameras, much noise, little light, blur) every one has 20 % or more, the least
/// where half of the photograph is not in the other. Photographs of different things, in 1792 pairings with 16 to 256 disparities,
/// reach at most 15 %, and at most that exchanged ones whose disparities are not all within a few pixels of zero.
pub(crate) const LEAST_MATCHED: f64 = 0.18;

/// Refuses a map of `left` and `right` that has hardly any matches and of which features say why, unless it is to be kept: what was filled in would be made up. What they say of a map that is kept with few matches.
///
/// # Errors
/// [`DepthError::NoPair`] and [`DepthError::Cancelled`].
pub(crate) fn check_pair<T: Intensity, const C: usize>(
    map: &DisparityMap,
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    disparities: (i32, usize),
    few: FewMatches,
    progress: &dyn Progress,
) -> Result<Option<FeatureAgreement>, DepthError> {
    let matched = map.matched_fraction();
    if matched >= LEAST_MATCHED {
        return Ok(None);
    }
    let (cause, agreement) = cause(map, left, right, disparities, progress)?;
    let keeps = match few {
        FewMatches::Check => cause == NoPairCause::Unknown && matched > 0.0,
        FewMatches::Keep => matched > 0.0,
    };
    if keeps { Ok(Some(agreement)) } else { Err(DepthError::NoPair { matched, needed: LEAST_MATCHED, cause }) }
}

/// A photograph as bytes of color, 16 bits rounded to 8.
pub(crate) fn color_bytes<T: Intensity, const C: usize>(photo: ImageView<'_, T, C>) -> RgbU8 {
    RgbU8::from_fn(photo.width(), photo.height(), |x, y| {
        let pixel = photo.at(x, y);
        std::array::from_fn(|c| ((u32::from(pixel[if C >= 3 { c } else { 0 }].to_u16()) + 128) / 257) as u8)
    })
}

/// The matcher's options, with the disparities that the pair shows where they are asked for. In quality mode the rows are looked at here: a second run would
/// take seconds.
pub(crate) fn matcher_options<T: Intensity + Pixel, const C: usize>(
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    options: &DepthOptions,
    alignment: &mut Alignment,
    progress: &dyn Progress,
) -> Result<StereoOptions, DepthError> {
    let stereo = match options.disparities {
        DisparityRange::Given => options.stereo.clone(),
        DisparityRange::FromMatches { min } => {
            let (min_disparity, disparities) = range_of([left, right], min, alignment, progress)?;
            StereoOptions { min_disparity, disparities, ..options.stereo.clone() }
        }
    };
    if stereo.quality {
        let mut plain = StereoMatcher::new(StereoOptions { quality: false, ..stereo.clone() })?;
        alignment.compute(&mut plain, [left, right], &mut DisparityMap::empty(), progress)?;
    }
    Ok(stereo)
}

/// Smallest disparity, `min` where that is given, and how many there are, by the features of a pair.
fn range_of<T: Intensity, const C: usize>(
    [left, right]: [ImageView<'_, T, C>; 2],
    min: Option<i32>,
    alignment: &mut Alignment,
    progress: &dyn Progress,
) -> Result<(i32, usize), DepthError> {
    let mut matches = matches_of(color_bytes(left).view(), color_bytes(right).view(), progress)?;
    if left.size() == right.size() {
        alignment.learn(&matches, left.size())?;
    }
    if let Some(offset) = alignment.offset {
        offset.correct(&mut matches);
    }
    let (first, count) = range_from(&matches)?;
    let range = (first, first + count as i32 - 1);
    if min.is_none() && is_exchanged(range) {
        return Err(RangeError::Exchanged { range }.into());
    }
    let min_disparity = min.unwrap_or(first);
    Ok((min_disparity, (i64::from(first) + count as i64 - i64::from(min_disparity)).max(1) as usize))
}

/// Disparity of a rectified pair, and depth where its geometry is known.
///
/// # Errors
/// [`DepthError`] where the images do not fit together, the disparities do not fit the images, or an option is out of
/// range.
pub fn depth<T: Intensity + Pixel, const C: usize>(
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    geometry: Option<&StereoGeometry>,
    options: &DepthOptions,
    progress: &dyn Progress,
) -> Result<DepthResult, DepthError> {
    check_range(options.range, geometry)?;
    let mut clock = StageClock::new();
    let mut alignment = alignment_of(options);
    let stereo = matcher_options(left, right, options, &mut alignment, progress)?;
    if options.disparities != DisparityRange::Given {
        clock.lap("range");
    }
    let mut matcher = StereoMatcher::new(stereo)?;
    let kept = (options.range, options.few_matches);
    let mut run = || {
        matcher.prepare(left.width(), left.height(), &mut DisparityMap::empty(), progress)?;
        clock.lap("prepare");
        depth_of(&mut matcher, [left, right], geometry, kept, &mut alignment, progress).map(|(found, _)| found)
    };
    let mut result = match run() {
        Err(DepthError::Cancelled(stop)) => {
            free_elsewhere(matcher);
            return Err(stop.into());
        }
        result => result?,
    };
    result.stages.splice(0..0, clock.into_stages());
    Ok(result)
}

/// Gives memory back from a thread of its own: of gigabytes that takes the system some tenths of a second, for which nobody who stopped a job wants to wait.
fn free_elsewhere<T: Send + 'static>(memory: T) {
    // Where there are no threads, it is freed here.
    let _ = std::thread::Builder::new().spawn(move || drop(memory));
}

/// As [`depth`], by any matcher; rows are taken as they are. `range` is the nearest and the farthest depth kept, in the unit of the baseline.
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
    let kept = (range, FewMatches::default());
    depth_of(matcher, [left, right], geometry, kept, &mut Alignment::off(), progress).map(|(found, _)| found)
}

/// What is known of the rows of a pair before it is looked at.
pub(crate) fn alignment_of(options: &DepthOptions) -> Alignment {
    if options.align { Alignment::default() } else { Alignment::off() }
}

/// As [`depth_with`], with what becomes of a pair of which hardly anything is matched, and of rows that are apart: the right photograph that was
/// matched comes back where it was corrected.
pub(crate) fn depth_of<T: Intensity + Pixel, const C: usize>(
    matcher: &mut dyn DisparityMatcher<T, C>,
    [left, right]: [ImageView<'_, T, C>; 2],
    geometry: Option<&StereoGeometry>,
    (range, few): ((f32, f32), FewMatches),
    alignment: &mut Alignment,
    progress: &dyn Progress,
) -> Result<(DepthResult, Option<Image<T, C>>), DepthError> {
    check_range(range, geometry)?;
    let mut clock = StageClock::new();
    let mut map = DisparityMap::empty();
    let corrected = alignment.compute(matcher, [left, right], &mut map, progress)?;
    let right = corrected.as_ref().map_or(right, Image::view);
    clock.lap("match");
    let disparities = matcher.disparities();
    let few = check_pair(&map, left, right, disparities, few, progress)?;
    progress.report("depth", 0, 1)?;
    let depth = geometry.map(|geometry| kept_depth(geometry, &map, range)).transpose()?;
    let confidence = matcher.confidence(&map);
    progress.report("depth", 0, 1)?;
    let sigma = matcher.uncertainty(&map);
    clock.lap("depth");
    let geometry = geometry.copied();
    let (vertical_offset, stages) = (alignment.offset, clock.into_stages());
    let found = DepthResult { map, depth, confidence, sigma, disparities, geometry, few, vertical_offset, stages };
    Ok((found, corrected))
}

/// The depths in `range`, of which there is at least one.
fn kept_depth(geometry: &StereoGeometry, map: &DisparityMap, range: (f32, f32)) -> Result<GrayF32, DepthError> {
    let depth = geometry.depth_map(map.disparity.view(), range);
    if depth.as_slice().iter().any(|z| z.is_finite()) {
        return Ok(depth);
    }
    let all = geometry.depth_map(map.disparity.view(), (0.0, f32::INFINITY));
    let finite = || all.as_slice().iter().copied().filter(|z| z.is_finite());
    let found = finite().reduce(f32::min).zip(finite().reduce(f32::max));
    Err(DepthError::NoDepth { kept: range, found })
}

/// Refuses an empty range of depths and a geometry that is none.
pub(crate) fn check_range((near, far): (f32, f32), geometry: Option<&StereoGeometry>) -> Result<(), DepthError> {
    // NaN fails as well.
    if near.partial_cmp(&far) != Some(std::cmp::Ordering::Less) {
        return Err(DepthError::Range { near, far });
    }
    Ok(geometry.map_or(Ok(()), StereoGeometry::validate)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use cv_core::Camera;
    use cv_synth::{RenderOptions, Scene, stereo_pair};

    #[test]
    fn depth_of_a_generated_room() {
        let scene = Scene::room(1);
        let camera = Camera::from_focal(400, 300, 350.0);
        let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
        let geometry = StereoGeometry::from_focal(400, 300, 350.0, 0.25).unwrap();
        let options =
            DepthOptions { stereo: StereoOptions { disparities: 64, ..Default::default() }, ..Default::default() };
        let result =
            depth(pair.left.image.view(), pair.right.image.view(), Some(&geometry), &options, &Silent).unwrap();
        let depth = result.depth.unwrap();
        let (mut good, mut all) = (0u32, 0u32);
        for y in 0..300 {
            for x in 0..400 {
                let truth = pair.left.depth.at(x, y)[0];
                if pair.visible.at(x, y)[0] && truth < 10.0 {
                    all += 1;
                    good += u32::from((depth.at(x, y)[0] - truth).abs() <= 0.05 * truth);
                }
            }
        }
        // The bar of the project: 95 % of the visible pixels within 5 %.
        assert!(f64::from(good) >= 0.95 * f64::from(all), "{good} of {all}");
    }

    #[test]
    fn what_is_no_pair_is_refused() {
        let scene = Scene::room(1);
        let camera = Camera::from_focal(320, 240, 280.0);
        let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
        let other =
            stereo_pair(&Scene::tabletop(2), &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
        let options =
            DepthOptions { stereo: StereoOptions { disparities: 64, ..Default::default() }, ..Default::default() };
        let gray = Image::<u8, 3>::new(320, 240, [90; 3]);
        let (left, right) = (pair.left.image.view(), pair.right.image.view());
        // One color twice, one color and a photograph, exchanged, of something else.
        let pairs = [(gray.view(), gray.view()), (gray.view(), right), (right, left), (left, other.right.image.view())];
        for (i, (a, b)) in pairs.into_iter().enumerate() {
            let error = depth(a, b, None, &options, &Silent).map(|found| found.map.matched_fraction()).unwrap_err();
            let DepthError::NoPair { cause, .. } = error else { panic!("{i}: {error}") };
            match i {
                2 => assert!(matches!(cause, NoPairCause::Exchanged { range: (..0, ..9) }), "{cause:?}"),
                _ => assert!(matches!(cause, NoPairCause::Unrelated { .. }), "{i}: {cause:?}"),
            }
        }
        // Exchanged, and the range left to the features: negative disparities are depths of nothing.
        let auto = DepthOptions { disparities: DisparityRange::FromMatches { min: None }, ..Default::default() };
        let error = depth(right, left, None, &auto, &Silent).map(|_| ()).unwrap_err();
        assert!(matches!(error, DepthError::NoRange(RangeError::Exchanged { range: (..-8, ..9) })), "{error}");
        // Who says that they are negative gets them.
        let min = auto_min(depth(left, right, None, &auto, &Silent).unwrap().disparities);
        let below = DepthOptions { disparities: DisparityRange::FromMatches { min: Some(min) }, ..Default::default() };
        assert!(depth(right, left, None, &below, &Silent).unwrap().map.matched_fraction() > 0.5);
        // Ten rows lower, and a range that ends before the nearest wall begins.
        let lower = pair.right.image.view().crop(0, 10, 320, 230).unwrap();
        let error =
            depth(pair.left.image.view().crop(0, 0, 320, 230).unwrap(), lower, None, &options, &Silent).unwrap_err();
        let DepthError::NoPair { cause: NoPairCause::Rows { apart }, .. } = error else { panic!("{error}") };
        assert!((apart - 10.0).abs() < 1.0, "{apart}");
        let far = StereoOptions { min_disparity: 200, disparities: 64, ..Default::default() };
        let error = depth(left, right, None, &DepthOptions { stereo: far, ..Default::default() }, &Silent).unwrap_err();
        assert!(matches!(error, DepthError::NoPair { cause: NoPairCause::Range { .. }, .. }), "{error}");
        assert!(depth(left, right, None, &options, &Silent).unwrap().map.matched_fraction() > 0.5);
    }

    #[test]
    fn few_matches_are_kept_where_features_agree() {
        let scene = Scene::room(1);
        let camera = Camera::from_focal(480, 360, 420.0);
        let of =
            |scene: &Scene| {
                let pair = stereo_pair(scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
                // A tenth of the rows; around them noise that both cameras have of their own.
                let strip =
                    |image: &cv_core::RgbU8, seed: u32| {
                        let noise = |x: usize, y: usize| {
                            let mixed = ((x * 480 + y) as u32 ^ seed).wrapping_mul(0x9E37_79B1);
                            80 + ((mixed ^ (mixed >> 15)).wrapping_mul(0x85EB_CA77) >> 28) as u8
                        };
                        let kept = 160..196;
                        cv_core::RgbU8::from_fn(480, 360, |x, y| {
                            if kept.contains(&y) { image.at(x, y) } else { [noise(x, y); 3] }
                        })
                    };
                ([strip(&pair.left.image, 1), strip(&pair.right.image, 0xABCD_EF01)], pair.disparity)
            };
        let ([left, right], truth) = of(&scene);
        let ([_, other], _) = of(&Scene::tabletop(2));
        let options = |disparities, few_matches| DepthOptions {
            stereo: StereoOptions { disparities, fill: false, ..Default::default() },
            few_matches,
            ..Default::default()
        };
        let run =
            |right: &cv_core::RgbU8, options: &DepthOptions| depth(left.view(), right.view(), None, options, &Silent);
        let found = run(&right, &options(96, FewMatches::Check)).unwrap();
        let few = found.few.unwrap();
        assert!(found.map.matched_fraction() < LEAST_MATCHED && few.is_enough(), "{few:?}");
        let known = (0..480 * 36).map(|i| (i % 480, 160 + i / 480));
        let known = known.filter(|(x, y)| found.map.disparity.at(*x, *y)[0].is_finite());
        let off = known.map(|(x, y)| (found.map.disparity.at(x, y)[0] - truth.at(x, y)[0]).abs());
        let off: Vec<f32> = off.collect();
        // As of a whole pair, the bar of which is nine of ten within a pixel; rows next to the noise see little of their own.
        assert!(off.len() > 480 * 18 && off.iter().filter(|d| **d < 1.0).count() * 10 > off.len() * 8, "{}", off.len());
        // Of something else, and where the range ends before what features show.
        let error = run(&other, &options(96, FewMatches::Check)).map(|d| d.few).unwrap_err();
        assert!(matches!(error, DepthError::NoPair { .. }), "{error}");
        let nearest = truth.as_slice().iter().copied().fold(0.0, f32::max) as usize;
        let error = run(&right, &options(nearest / 2, FewMatches::Check)).map(|d| d.few).unwrap_err();
        assert!(matches!(error, DepthError::NoPair { cause: NoPairCause::Range { .. }, .. }), "{error}");
        // Who wants it all the same gets it, where patches that match by chance are not removed.
        let keep = options(96, FewMatches::Keep);
        let keep = DepthOptions { stereo: StereoOptions { speckle_size: 10, ..keep.stereo }, ..keep };
        assert!(run(&other, &keep).unwrap().few.is_some());
    }

    /// Smallest disparity of the exchanged pair.
    fn auto_min((first, count): (i32, usize)) -> i32 {
        -(first + count as i32 - 1)
    }

    #[test]
    fn a_map_without_a_depth_is_no_success() {
        let scene = Scene::room(1);
        let camera = Camera::from_focal(320, 240, 280.0);
        let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
        let run = |offset: f64, range: (f32, f32)| {
            let geometry = StereoGeometry { offset, ..StereoGeometry::from_focal(320, 240, 280.0, 0.25).unwrap() };
            let options = DepthOptions {
                stereo: StereoOptions { disparities: 64, ..Default::default() },
                range,
                ..Default::default()
            };
            depth(pair.left.image.view(), pair.right.image.view(), Some(&geometry), &options, &Silent)
        };
        assert!(run(0.0, (0.0, f32::INFINITY)).is_ok());
        // The room ends at a few meters.
        let error = run(0.0, (1000.0, 2000.0)).unwrap_err();
        let DepthError::NoDepth { kept: (1000.0, 2000.0), found: Some((near, far)) } = error else { panic!("{error}") };
        let truth = pair.left.depth.as_slice();
        let farthest = truth.iter().copied().fold(0.0, f32::max);
        assert!(near > 0.0 && near < far && far < 3.0 * farthest, "{near} {far} {farthest}");
        // Principal points so far apart that everything lies behind the cameras.
        let error = run(-200.0, (0.0, f32::INFINITY)).unwrap_err();
        assert!(matches!(error, DepthError::NoDepth { found: None, .. }), "{error}");
    }

    #[test]
    fn what_makes_no_sense_is_an_error_with_the_numbers() {
        let (a, b) = (Image::<u8, 1>::new(40, 30, [7]), Image::<u8, 1>::new(40, 31, [7]));
        let run = |options: &DepthOptions| depth(a.view(), b.view(), None, options, &Silent).unwrap_err();
        assert_eq!(
            run(&DepthOptions::default()),
            DepthError::Stereo(StereoError::SizeMismatch { left: (40, 30), right: (40, 31) })
        );
        let range = (3.0, 2.0);
        assert_eq!(run(&DepthOptions { range, ..Default::default() }), DepthError::Range { near: 3.0, far: 2.0 });
        let geometry = StereoGeometry { focal: -1.0, cx: 0.0, cy: 0.0, baseline: 1.0, offset: 0.0 };
        assert!(matches!(
            depth(a.view(), a.view(), Some(&geometry), &DepthOptions::default(), &Silent),
            Err(DepthError::Geometry(GeometryError::NotPositive { .. }))
        ));
    }
}
