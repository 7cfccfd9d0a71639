//! Which pairs of photographs hold, and their matches.

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
/// Each pair is tried with its features of largest scale first, and where those are not enough to tell, with all of them. Where enough of the matches agree with a geometry, all
/// features are matched once more along it.
///
/// # Errors
/// [`Cancelled`].
pub fn sfm_pairs(
    photos: &[SfmPhoto],
    cameras: &[SfmCamera],
    options: &SfmJobOptions,
    progress: &dyn Progress,
) -> Result<(Vec<PairMatches>, Vec<ViewPairModel>), Cancelled> {
    let pairs: Vec<(usize, usize)> =
        (0..photos.len()).flat_map(|a| (a + 1..photos.len()).map(move |b| (a, b))).collect();
    let ready: Vec<Option<Ready<'_>>> = photos
        .par_iter()
        .map(|photo| Some(Ready::new(photo, cameras.get(photo.camera)?, options.first_features)))
        .collect();
    let stage = Stage::new(progress, "match", pairs.len())?;
    let found: Vec<Option<(PairMatches, ViewPairModel)>> = pairs
        .par_iter()
        .with_max_len(1)
        .map(|&(a, b)| {
            let (Some(one), Some(two)) = (&ready[a], &ready[b]) else { return Ok(None) };
            let found = Pair { sides: [one, two], options, progress: &stage }.matches()?;
            stage.add(1)?;
            Ok(found.map(|(matches, model)| (PairMatches { a, b, matches }, model)))
        })
        .collect::<Result<_, Cancelled>>()?;
    Ok(found.into_iter().flatten().unzip())
}

/// Smallest share of tentative matches that agree with a geometry before more are looked for along it: matches along the lines of a wrong geometry agree with it too. That of
/// Brown and Lowe's test.
const FIRM_SHARE: f64 = 0.3;
/// Largest ratio of the SSD of the best to that of the second candidate along a line. Of two photographs of fountain-P11 that see the same thing from 108 degrees apart, 1,425 matches
/// have a ratio of up to 0.8, three in four of them above 0.64 and nearly all wrong; of neighbors nine in ten are below 0.6.
const GUIDED_RATIO: f32 = 0.6;

/// Two photographs.
struct Pair<'p> {
    sides: [&'p Ready<'p>; 2],
    options: &'p SfmJobOptions,
    progress: &'p dyn Progress,
}

impl Pair<'_> {
    fn verify(&self, matches: &[DMatch]) -> Result<Option<ViewPair>, Cancelled> {
        let cameras = self.sides.map(|s| (&s.camera.camera, &s.camera.knowledge));
        let keypoints = self.sides.map(|s| &s.photo.keypoints[..]);
        match verify_view_pair(cameras, keypoints, matches, &self.options.pairs, self.progress) {
            Ok(pair) => Ok(Some(pair)),
            Err(ViewPairError::Cancelled(stop)) => Err(stop),
            Err(_) => Ok(None),
        }
    }

    fn tentative(&self, a: &ByteDescriptors, b: &ByteDescriptors) -> Result<Vec<DMatch>, Cancelled> {
        let options = MatchOptions { ratio: self.options.ratio, mutual: true, ..MatchOptions::default() };
        match match_byte_descriptors(a, b, &options, self.progress) {
            Err(MatchError::Cancelled(stop)) => Err(stop),
            found => Ok(found.unwrap_or_default()),
        }
    }

    fn matches(&self) -> Result<Option<(Vec<DMatch>, ViewPairModel)>, Cancelled> {
        let [a, b] = self.sides;
        let mut matches = self.tentative(&a.coarse_descriptors, &b.coarse_descriptors)?;
        for m in &mut matches {
            (m.query, m.train) = (a.coarse[m.query as usize] as u32, b.coarse[m.train as usize] as u32);
        }
        let mut found = self.verify(&matches)?;
        let least = self.options.pairs.min_inliers;
        let firm = |pair: &Option<ViewPair>, matches: &[DMatch]| {
            let inliers = pair.as_ref().map_or(0, |p| p.inliers.len());
            inliers >= 2 * least && inliers as f64 >= FIRM_SHARE * matches.len() as f64
        };
        let whole = self.sides.iter().all(|s| s.coarse.len() == s.photo.keypoints.len());
        if !whole && !firm(&found, &matches) && matches.len() >= least {
            matches = self.tentative(&a.photo.descriptors, &b.photo.descriptors)?;
            found = self.verify(&matches)?;
        }
        let firm = firm(&found, &matches);
        let Some(pair) = found else { return Ok(None) };
        let agreeing =
            |pair: &ViewPair, matches: &[DMatch]| pair.inliers.iter().map(|i| matches[*i]).collect::<Vec<_>>();
        if firm {
            let along = self.along(&pair)?;
            if let Some(better) = self.verify(&along)?.filter(|better| better.inliers.len() > pair.inliers.len()) {
                return Ok(Some((agreeing(&better, &along), better.model)));
            }
        }
        Ok(Some((agreeing(&pair, &matches), pair.model)))
    }

    /// Matches of all features along a geometry.
    fn along(&self, pair: &ViewPair) -> Result<Vec<DMatch>, Cancelled> {
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
        match match_guided_bytes(one, two, &model, &options, self.progress) {
            Err(MatchError::Cancelled(stop)) => Err(stop),
            found => Ok(found.unwrap_or_default()),
        }
    }
}
