//! Matching and verification of pairs of photographs.

use super::candidates::candidate_pairs;
use super::{SfmCamera, SfmJobOptions, SfmPhoto};
use crate::Progress;
use crate::guided::GuidedOptions;
use cv_core::{Camera, Cancelled, DMatch, Keypoint, Point2, Stage};
use cv_features::{
    ByteDescriptors, MatchError, MatchOptions, TwoViewModel, largest_keypoints, match_byte_descriptors,
    match_guided_bytes,
};
use cv_parallel::prelude::*;
use cv_sfm::{CameraKnowledge, PairMatches, ViewPair, ViewPairError, ViewPairModel, verify_view_pair};

/// A photograph prepared for matching.
struct PreparedPhoto<'p> {
    photo: &'p SfmPhoto,
    camera: &'p SfmCamera,
    /// Keypoint positions, undistorted where the camera is calibrated.
    positions: Vec<Point2<f32>>,
    /// Indices of the features of largest scale.
    coarse: Vec<usize>,
    coarse_descriptors: ByteDescriptors,
}

impl<'p> PreparedPhoto<'p> {
    fn new(photo: &'p SfmPhoto, camera: &'p SfmCamera, first: usize) -> Self {
        let position = |k: &Keypoint| match camera.knowledge.is_calibrated() {
            true => camera.camera.undistort_pixel(k.position.cast()).cast::<f32>(),
            false => k.position,
        };
        let coarse = largest_keypoints(&photo.keypoints, first);
        let coarse_descriptors = photo.descriptors.select(&coarse);
        Self { photo, camera, positions: photo.keypoints.iter().map(position).collect(), coarse, coarse_descriptors }
    }
}

/// Matches and verifies pairs of photographs. Returns the inlier matches and the geometry of each verified pair, in the
/// order of the photographs.
///
/// Each pair is matched with its features of largest scale first. Photographs with few firm pairs are matched with
/// their best others again, with all features. The best firm pairs of each photograph then get guided matching with all
/// features.
///
/// # Errors
/// [`Cancelled`].
pub fn sfm_pairs(
    photos: &[SfmPhoto],
    cameras: &[SfmCamera],
    options: &SfmJobOptions,
    progress: &dyn Progress,
) -> Result<(Vec<PairMatches>, Vec<ViewPairModel>), Cancelled> {
    let candidates = candidate_pairs(photos, options, progress)?;
    let prepared: Vec<Option<PreparedPhoto<'_>>> = photos
        .par_iter()
        .map(|photo| Some(PreparedPhoto::new(photo, cameras.get(photo.camera)?, options.first_features)))
        .collect();
    let stage = Stage::new(progress, "match", candidates.len())?;
    let pair_of = |&(a, b): &(usize, usize)| {
        Some(Pair { views: [a, b], sides: [prepared[a].as_ref()?, prepared[b].as_ref()?], options })
    };
    let pairs: Vec<Pair<'_>> = candidates.iter().filter_map(pair_of).collect();
    let mut states: Vec<PairState<'_>> = pairs
        .into_par_iter()
        .with_max_len(1)
        .map(|pair| {
            let state = pair.with_coarse_features(&stage)?;
            stage.add(1)?;
            Ok(state)
        })
        .try_collect::<_, Cancelled>()?;
    let needs_all_features =
        |t: &PairState<'_>| !t.is_firm() && !t.has_all_features && t.tentative >= options.pairs.min_inliers;
    let selected = best_of_each(&states, photos.len(), options.firm_partners, needs_all_features);
    states =
        process_selected(states, &selected, "match all", progress, |state, stage| state.pair.with_all_features(stage))?;
    let selected = best_of_each(&states, photos.len(), options.guided_partners, |t| t.is_firm());
    states = process_selected(states, &selected, "match along", progress, PairState::with_guided_matches)?;
    let into_verified = |state: PairState<'_>| {
        let [a, b] = state.pair.views;
        let (matches, pair) = state.verified?;
        Some((PairMatches { a, b, matches, sample: Some(state.sample) }, pair.model))
    };
    Ok(states.into_iter().filter_map(into_verified).unzip())
}

/// Selects the `count` best pairs of each photograph among the `wanted` ones; firm pairs that are not wanted count too.
fn best_of_each(
    states: &[PairState<'_>],
    photos: usize,
    count: usize,
    wanted: impl Fn(&PairState<'_>) -> bool,
) -> Vec<bool> {
    let mut order: Vec<usize> = (0..states.len()).filter(|i| states[*i].is_firm() || wanted(&states[*i])).collect();
    // A stable sort: the first one of equals.
    order.sort_by_key(|i| std::cmp::Reverse(states[*i].rank()));
    let (mut selected, mut count_of) = (vec![false; states.len()], vec![0usize; photos]);
    for i in order {
        let [a, b] = states[i].pair.views;
        selected[i] = wanted(&states[i]) && (count_of[a] < count || count_of[b] < count);
        count_of[a] += 1;
        count_of[b] += 1;
    }
    selected
}

/// Applies a further step to the selected pairs.
fn process_selected<'p>(
    states: Vec<PairState<'p>>,
    selected: &[bool],
    what: &'static str,
    progress: &dyn Progress,
    step: impl Fn(PairState<'p>, &Stage<'_>) -> Result<PairState<'p>, Cancelled> + Sync,
) -> Result<Vec<PairState<'p>>, Cancelled> {
    let stage = Stage::new(progress, what, selected.iter().filter(|c| **c).count())?;
    let one = |(state, is_selected): (PairState<'p>, &bool)| {
        if !is_selected {
            return Ok(state);
        }
        let processed = step(state, &stage)?;
        stage.add(1)?;
        Ok(processed)
    };
    states.into_par_iter().zip(selected).with_max_len(1).map(one).try_collect()
}

/// Minimum inlier ratio of a firm pair, whose geometry is reliable enough for guided matching (Brown and Lowe's test):
/// matches guided by a wrong geometry agree with it.
const FIRM_INLIER_RATIO: f64 = 0.3;
/// Largest ratio of the SSD of the best to the second candidate in guided matching. On two photographs of fountain-P11
/// with a viewpoint change of 108 degrees, 1,425 matches have a ratio of up to 0.8, three of four above 0.64 and nearly
/// all wrong; for neighboring photographs nine of ten are below 0.6.
const GUIDED_RATIO: f32 = 0.6;

/// A pair of photographs.
#[derive(Clone, Copy)]
struct Pair<'p> {
    views: [usize; 2],
    sides: [&'p PreparedPhoto<'p>; 2],
    options: &'p SfmJobOptions,
}

/// State of a pair.
struct PairState<'p> {
    pair: Pair<'p>,
    /// Number of tentative matches.
    tentative: usize,
    /// Inlier matches and geometry, if the pair is verified.
    verified: Option<(Vec<DMatch>, ViewPair)>,
    /// Inliers among the features of largest scale.
    sample: Vec<DMatch>,
    /// Whether all features have been matched.
    has_all_features: bool,
}

impl<'p> Pair<'p> {
    /// Estimates the geometry of matches and returns its inliers; `None` if the pair is not verified.
    fn verify(
        &self,
        matches: &[DMatch],
        progress: &dyn Progress,
    ) -> Result<Option<(Vec<DMatch>, ViewPair)>, Cancelled> {
        let cameras = self.sides.map(|s| (&s.camera.camera, &s.camera.knowledge));
        let keypoints = self.sides.map(|s| &s.photo.keypoints[..]);
        match verify_view_pair(cameras, keypoints, matches, &self.options.pairs, progress) {
            Ok(pair) => Ok(Some((pair.inliers.iter().map(|i| matches[*i]).collect(), pair))),
            Err(ViewPairError::Cancelled(stop)) => Err(stop),
            Err(_) => Ok(None),
        }
    }

    /// Returns tentative matches of two descriptor sets.
    fn match_descriptors(
        &self,
        sets: [&ByteDescriptors; 2],
        progress: &dyn Progress,
    ) -> Result<Vec<DMatch>, Cancelled> {
        let options = MatchOptions { ratio: self.options.ratio, mutual: true, ..MatchOptions::default() };
        match match_byte_descriptors(sets[0], sets[1], &options, progress) {
            Err(MatchError::Cancelled(stop)) => Err(stop),
            found => Ok(found.unwrap_or_default()),
        }
    }

    /// Matches and verifies the pair with its features of largest scale.
    fn with_coarse_features(self, progress: &dyn Progress) -> Result<PairState<'p>, Cancelled> {
        let [a, b] = self.sides;
        let mut matches = self.match_descriptors([&a.coarse_descriptors, &b.coarse_descriptors], progress)?;
        for m in &mut matches {
            (m.query, m.train) = (a.coarse[m.query as usize] as u32, b.coarse[m.train as usize] as u32);
        }
        let has_all_features = self.sides.iter().all(|s| s.coarse.len() == s.photo.keypoints.len());
        let verified = self.verify(&matches, progress)?;
        let sample = verified.as_ref().map_or_else(Vec::new, |h| h.0.clone());
        Ok(PairState { pair: self, tentative: matches.len(), verified, sample, has_all_features })
    }

    /// Matches and verifies the pair with all features.
    fn with_all_features(self, progress: &dyn Progress) -> Result<PairState<'p>, Cancelled> {
        let matches = self.match_descriptors(self.sides.map(|s| &s.photo.descriptors), progress)?;
        let verified = self.verify(&matches, progress)?;
        Ok(PairState { pair: self, tentative: matches.len(), verified, sample: Vec::new(), has_all_features: true })
    }

    /// Returns guided matches of all features, near the predictions of a geometry.
    fn match_guided(&self, pair: &ViewPair, progress: &dyn Progress) -> Result<Vec<DMatch>, Cancelled> {
        let [a, b] = self.sides;
        let is_known = self.sides.iter().all(|s| s.camera.knowledge == CameraKnowledge::Known);
        let max_threshold =
            if is_known { self.options.pairs.threshold } else { self.options.pairs.threshold_uncalibrated };
        // Three standard deviations of the inliers.
        let threshold = (3.0 * pair.rms).clamp(1.0, max_threshold.max(1.0)) as f32;
        let options = GuidedOptions { threshold, ratio: GUIDED_RATIO, ..GuidedOptions::default() };
        let cameras: [&Camera; 2] = self.sides.map(|s| &s.camera.camera);
        let model = match &pair.model {
            ViewPairModel::Homography(h) => TwoViewModel::Homography(*h),
            ViewPairModel::Fundamental(f) => TwoViewModel::Fundamental(*f),
            model @ ViewPairModel::Pose(_) => match model.fundamental(cameras) {
                Some(f) => TwoViewModel::Fundamental(f),
                None => return Ok(Vec::new()),
            },
        };
        let [one, two] = [a, b].map(|s| (&s.photo.descriptors, &s.positions[..]));
        match match_guided_bytes(one, two, &model, &options, progress) {
            Err(MatchError::Cancelled(stop)) => Err(stop),
            found => Ok(found.unwrap_or_default()),
        }
    }
}

impl PairState<'_> {
    /// Returns the number of inliers.
    fn inliers(&self) -> usize {
        self.verified.as_ref().map_or(0, |h| h.0.len())
    }

    /// Returns the sort key of a pair.
    fn rank(&self) -> (bool, usize, usize) {
        (self.is_firm(), self.inliers(), self.tentative)
    }

    /// Returns whether enough matches are inliers for guided matching.
    fn is_firm(&self) -> bool {
        let min_inliers = self.pair.options.pairs.min_inliers;
        self.inliers() >= 2 * min_inliers && self.inliers() as f64 >= FIRM_INLIER_RATIO * self.tentative as f64
    }

    /// Replaces the matches by guided ones, if these have more inliers.
    fn with_guided_matches(self, progress: &Stage<'_>) -> Result<Self, Cancelled> {
        let Some((matches, pair)) = &self.verified else { return Ok(self) };
        let guided = self.pair.match_guided(pair, progress)?;
        let better = self.pair.verify(&guided, progress)?.filter(|better| better.0.len() > matches.len());
        Ok(if better.is_some() { Self { verified: better, ..self } } else { self })
    }
}
