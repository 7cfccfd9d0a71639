//! Which pairs of photographs hold, and their matches.

use super::{SfmCamera, SfmJobOptions, SfmPhoto, keypoints};
use crate::guided::{GuidedOptions, match_along_lines};
use crate::{MatchingOptions, Progress, match_features};
use cv_core::{Camera, Cancelled, DMatch, Keypoint, Stage};
use cv_features::{Descriptors, Features, MatchError, TwoViewModel, match_guided};
use cv_sfm::{CameraKnowledge, PairMatches, ViewPair, ViewPairError, ViewPairModel, verify_view_pair};
use rayon::prelude::*;

/// The features of the largest scale, and which of all they are.
struct Coarse {
    features: Features,
    index: Vec<u32>,
}

impl Coarse {
    fn new(features: &Features, most: usize) -> Self {
        let mut index: Vec<u32> = (0..features.keypoints.len() as u32).collect();
        let scale = |i: &u32| features.keypoints[*i as usize].scale;
        index.sort_by(|a, b| scale(b).total_cmp(&scale(a)).then(a.cmp(b)));
        index.truncate(most);
        let rows = index.iter().flat_map(|i| features.descriptors.row(*i as usize)).copied().collect();
        let kind = features.descriptors.kind();
        let descriptors = Descriptors::from_vec(kind, rows).unwrap_or(Descriptors::new(kind));
        let keypoints: Vec<Keypoint> = index.iter().map(|i| features.keypoints[*i as usize]).collect();
        Self { features: Features { keypoints, descriptors, ..Features::new(kind) }, index }
    }
}

/// Pairs that hold, in order of their photographs.
///
/// Each pair is tried with its features of largest scale first. Where those agree with a geometry, all features are matched along it; where they are not enough to tell, all features
/// are matched without.
///
/// # Errors
/// [`Cancelled`].
pub(super) fn match_pairs(
    photos: &[SfmPhoto],
    cameras: &[SfmCamera],
    options: &SfmJobOptions,
    progress: &dyn Progress,
) -> Result<Vec<(PairMatches, ViewPairModel)>, Cancelled> {
    let pairs: Vec<(usize, usize)> =
        (0..photos.len()).flat_map(|a| (a + 1..photos.len()).map(move |b| (a, b))).collect();
    let coarse: Vec<Coarse> = photos.par_iter().map(|p| Coarse::new(&p.features, options.first_features)).collect();
    let stage = Stage::new(progress, "match", pairs.len())?;
    let found: Vec<Option<(PairMatches, ViewPairModel)>> = pairs
        .par_iter()
        .with_max_len(1)
        .map(|&(a, b)| {
            let job = Pair { photos: [&photos[a], &photos[b]], cameras, options, progress: &stage };
            let found = job.matches([&coarse[a], &coarse[b]])?;
            stage.add(1)?;
            Ok(found.map(|(matches, model)| (PairMatches { a, b, matches }, model)))
        })
        .collect::<Result<_, Cancelled>>()?;
    Ok(found.into_iter().flatten().collect())
}

/// Two photographs.
struct Pair<'p> {
    photos: [&'p SfmPhoto; 2],
    cameras: &'p [SfmCamera],
    options: &'p SfmJobOptions,
    progress: &'p dyn Progress,
}

impl Pair<'_> {
    fn camera(&self, side: usize) -> (&Camera, &CameraKnowledge) {
        let camera = &self.cameras[self.photos[side].camera];
        (&camera.camera, &camera.knowledge)
    }

    fn verify(&self, keypoints: [&[Keypoint]; 2], matches: &[DMatch]) -> Result<Option<ViewPair>, Cancelled> {
        let cameras = [self.camera(0), self.camera(1)];
        match verify_view_pair(cameras, keypoints, matches, &self.options.pairs, self.progress) {
            Ok(pair) => Ok(Some(pair)),
            Err(ViewPairError::Cancelled(stop)) => Err(stop),
            Err(_) => Ok(None),
        }
    }

    fn tentative(&self, a: &Features, b: &Features) -> Result<Vec<DMatch>, Cancelled> {
        let options = MatchingOptions { mutual: true, ..self.options.matching.clone() };
        match match_features(a, b, &options, self.progress) {
            Err(MatchError::Cancelled(stop)) => Err(stop),
            found => Ok(found.unwrap_or_default()),
        }
    }

    fn matches(&self, coarse: [&Coarse; 2]) -> Result<Option<(Vec<DMatch>, ViewPairModel)>, Cancelled> {
        let [a, b] = self.photos.map(|p| &p.features);
        let first = self.tentative(&coarse[0].features, &coarse[1].features)?;
        let mut found = self.verify([&coarse[0].features.keypoints, &coarse[1].features.keypoints], &first)?;
        let whole = coarse.iter().zip([a, b]).all(|(c, f)| c.index.len() == f.keypoints.len());
        let sure = |pair: &ViewPair| pair.inliers.len() >= 2 * self.options.pairs.min_inliers;
        if !whole && !found.as_ref().is_some_and(sure) && first.len() >= self.options.pairs.min_inliers {
            let all = self.tentative(a, b)?;
            found = self.verify(self.photos.map(keypoints), &all)?;
        }
        let Some(pair) = found else { return Ok(None) };
        let along = self.along(&pair.model)?;
        let Some(pair) = self.verify(self.photos.map(keypoints), &along)? else { return Ok(None) };
        Ok(Some((pair.inliers.iter().map(|i| along[*i]).collect(), pair.model)))
    }

    /// Matches of all features along a geometry.
    fn along(&self, model: &ViewPairModel) -> Result<Vec<DMatch>, Cancelled> {
        let [a, b] = self.photos.map(|p| &p.features);
        let cameras = [*self.camera(0).0, *self.camera(1).0];
        let known = [0, 1].iter().all(|i| *self.camera(*i).1 == CameraKnowledge::Known);
        let pixels = if known { self.options.pairs.threshold } else { self.options.pairs.threshold_uncalibrated };
        let options = GuidedOptions { threshold: pixels as f32, ..GuidedOptions::default() };
        let raw = |model: &TwoViewModel| match match_guided(a, b, None, model, &options, self.progress) {
            Err(MatchError::Cancelled(stop)) => Err(stop),
            found => Ok(found.unwrap_or_default()),
        };
        match model {
            ViewPairModel::Homography(h) => raw(&TwoViewModel::Homography(*h)),
            ViewPairModel::Fundamental(f) => raw(&TwoViewModel::Fundamental(*f)),
            ViewPairModel::Pose(_) => {
                let f = model.fundamental([&cameras[0], &cameras[1]]);
                f.map_or(Ok(Vec::new()), |f| match_along_lines(a, b, &cameras, &f, &options, self.progress))
            }
        }
    }
}
