//! Which pairs of photographs hold, and their matches.

use super::candidates::candidate_pairs;
use super::{SfmCamera, SfmJobOptions, SfmPhoto};
use crate::Progress;
use crate::guided::GuidedOptions;
use cv_core::{Camera, Cancelled, DMatch, Keypoint, Point2, Stage};
use cv_features::{
    ByteDescriptors, MatchError, MatchOptions, TwoViewModel, largest_keypoints, match_byte_descriptors,
    match_guided_bytes,
};
use cv_sfm::{CameraKnowledge, PairMatches, ViewPair, ViewPairError, ViewPairModel, verify_view_pair};
use rayon::prelude::*;

/// A photograph, made ready for its pairs.
struct Ready<'p> {
    photo: &'p SfmPhoto,
    camera: &'p SfmCamera,
    /// Where the keypoints are, undistorted where the camera is known.
    positions: Vec<Point2<f32>>,
    /// The features of largest scale.
    coarse: Vec<usize>,
    coarse_descriptors: ByteDescriptors,
}

impl<'p> Ready<'p> {
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

/// The pairs of photographs that hold: their matches and their geometry, in order of the photographs.
///
/// Each pair is tried with its features of largest scale first. Of each photograph that has few pairs then, the best others are tried with all features; and of each, those pairs of which
/// most matches agree are matched once more along their geometry, with all features.
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
    let ready: Vec<Option<Ready<'_>>> = photos
        .par_iter()
        .map(|photo| Some(Ready::new(photo, cameras.get(photo.camera)?, options.first_features)))
        .collect();
    let stage = Stage::new(progress, "match", candidates.len())?;
    let mut tried: Vec<Tried<'_>> = candidates
        .par_iter()
        .with_max_len(1)
        .filter_map(|&(a, b)| Some(Pair { views: [a, b], sides: [ready[a].as_ref()?, ready[b].as_ref()?], options }))
        .map(|pair| {
            let tried = pair.with_largest(&stage)?;
            stage.add(1)?;
            Ok(tried)
        })
        .collect::<Result<_, Cancelled>>()?;
    let open = |t: &Tried<'_>| !t.firm() && !t.whole && t.tentative >= options.pairs.min_inliers;
    let again = best_of_each(&tried, photos.len(), options.firm_partners, open);
    tried = each(tried, &again, "match all", progress, |tried, stage| tried.pair.with_all(stage))?;
    let chosen = best_of_each(&tried, photos.len(), options.guided_partners, |t| t.firm());
    tried = each(tried, &chosen, "match along", progress, Tried::along_geometry)?;
    let held = |tried: Tried<'_>| {
        let [a, b] = tried.pair.views;
        let (matches, pair) = tried.held?;
        Some((PairMatches { a, b, matches, sample: Some(tried.sample) }, pair.model))
    };
    Ok(tried.into_iter().filter_map(held).unzip())
}

/// Of each photograph, the `count` best pairs, as far as they are `wanted`; a firm one that is not counts too.
fn best_of_each(tried: &[Tried<'_>], photos: usize, count: usize, wanted: impl Fn(&Tried<'_>) -> bool) -> Vec<bool> {
    let mut order: Vec<usize> = (0..tried.len()).filter(|i| tried[*i].firm() || wanted(&tried[*i])).collect();
    // Stable: the earlier of equals.
    order.sort_by_key(|i| std::cmp::Reverse(tried[*i].rank()));
    let (mut chosen, mut of) = (vec![false; tried.len()], vec![0usize; photos]);
    for i in order {
        let [a, b] = tried[i].pair.views;
        chosen[i] = wanted(&tried[i]) && (of[a] < count || of[b] < count);
        of[a] += 1;
        of[b] += 1;
    }
    chosen
}

/// Does more for some pairs.
fn each<'p>(
    tried: Vec<Tried<'p>>,
    chosen: &[bool],
    what: &'static str,
    progress: &dyn Progress,
    more: impl Fn(Tried<'p>, &Stage<'_>) -> Result<Tried<'p>, Cancelled> + Sync,
) -> Result<Vec<Tried<'p>>, Cancelled> {
    let stage = Stage::new(progress, what, chosen.iter().filter(|c| **c).count())?;
    let one = |(tried, chosen): (Tried<'p>, &bool)| {
        if !chosen {
            return Ok(tried);
        }
        let done = more(tried, &stage)?;
        stage.add(1)?;
        Ok(done)
    };
    tried.into_par_iter().zip(chosen).with_max_len(1).map(one).collect()
}

/// Smallest share of tentative matches that agree with a geometry before more are looked for along it: matches along the lines of a wrong geometry agree with it too. That of
/// Brown and Lowe's test.
const FIRM_SHARE: f64 = 0.3;
/// Largest ratio of the SSD of the best to that of the second candidate along a line. Of two photographs of fountain-P11 that see the same thing from 108 degrees apart, 1,425 matches
/// have a ratio of up to 0.8, three in four of them above 0.64 and nearly all wrong; of neighbors nine in ten are below 0.6.
const GUIDED_RATIO: f32 = 0.6;

/// Two photographs.
#[derive(Clone, Copy)]
struct Pair<'p> {
    views: [usize; 2],
    sides: [&'p Ready<'p>; 2],
    options: &'p SfmJobOptions,
}

/// What is known of a pair so far.
struct Tried<'p> {
    pair: Pair<'p>,
    /// Matches by how alike features are.
    tentative: usize,
    /// Those that agree with the geometry, and that.
    held: Option<(Vec<DMatch>, ViewPair)>,
    /// Those that agree of the features of largest scale.
    sample: Vec<DMatch>,
    /// Whether all features have been matched.
    whole: bool,
}

impl<'p> Pair<'p> {
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

    fn tentative(&self, sets: [&ByteDescriptors; 2], progress: &dyn Progress) -> Result<Vec<DMatch>, Cancelled> {
        let options = MatchOptions { ratio: self.options.ratio, mutual: true, ..MatchOptions::default() };
        match match_byte_descriptors(sets[0], sets[1], &options, progress) {
            Err(MatchError::Cancelled(stop)) => Err(stop),
            found => Ok(found.unwrap_or_default()),
        }
    }

    /// What its features of largest scale tell.
    fn with_largest(self, progress: &dyn Progress) -> Result<Tried<'p>, Cancelled> {
        let [a, b] = self.sides;
        let mut matches = self.tentative([&a.coarse_descriptors, &b.coarse_descriptors], progress)?;
        for m in &mut matches {
            (m.query, m.train) = (a.coarse[m.query as usize] as u32, b.coarse[m.train as usize] as u32);
        }
        let whole = self.sides.iter().all(|s| s.coarse.len() == s.photo.keypoints.len());
        let held = self.verify(&matches, progress)?;
        let sample = held.as_ref().map_or_else(Vec::new, |h| h.0.clone());
        Ok(Tried { pair: self, tentative: matches.len(), held, sample, whole })
    }

    /// What all features tell.
    fn with_all(self, progress: &dyn Progress) -> Result<Tried<'p>, Cancelled> {
        let matches = self.tentative(self.sides.map(|s| &s.photo.descriptors), progress)?;
        let held = self.verify(&matches, progress)?;
        Ok(Tried { pair: self, tentative: matches.len(), held, sample: Vec::new(), whole: true })
    }

    /// Matches of all features along a geometry.
    fn along(&self, pair: &ViewPair, progress: &dyn Progress) -> Result<Vec<DMatch>, Cancelled> {
        let [a, b] = self.sides;
        let known = self.sides.iter().all(|s| s.camera.knowledge == CameraKnowledge::Known);
        let pixels = if known { self.options.pairs.threshold } else { self.options.pairs.threshold_uncalibrated };
        // Three standard deviations of what agrees.
        let threshold = (3.0 * pair.rms).clamp(1.0, pixels.max(1.0)) as f32;
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

impl Tried<'_> {
    fn inliers(&self) -> usize {
        self.held.as_ref().map_or(0, |h| h.0.len())
    }

    /// How good it is among others.
    fn rank(&self) -> (bool, usize, usize) {
        (self.firm(), self.inliers(), self.tentative)
    }

    /// Whether enough of the matches agree for more to be looked for along their geometry.
    fn firm(&self) -> bool {
        let least = self.pair.options.pairs.min_inliers;
        self.inliers() >= 2 * least && self.inliers() as f64 >= FIRM_SHARE * self.tentative as f64
    }

    /// With the matches of all features along the geometry, where those are more.
    fn along_geometry(self, progress: &Stage<'_>) -> Result<Self, Cancelled> {
        let Some((matches, pair)) = &self.held else { return Ok(self) };
        let along = self.pair.along(pair, progress)?;
        let better = self.pair.verify(&along, progress)?.filter(|better| better.0.len() > matches.len());
        Ok(if better.is_some() { Self { held: better, ..self } } else { self })
    }
}
