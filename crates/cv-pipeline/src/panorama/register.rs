//! Registration of photographs: features, matching, verification of pairs, alignment.

use crate::Progress;
use crate::matching::{MatchingOptions, correspondences, match_features, rescale};
use crate::panorama::masked::{clip_removed, drop_removed};
use crate::panorama::{
    LeftOut, NearestPair, PanoramaError, PanoramaImage, PanoramaOptions, PanoramaPair, PanoramaPhoto,
};
use crate::similar::similar_pairs;
use cv_core::{Camera, Cancelled, GrayF32, GrayU8, Image, ImageView, RgbU8, Scaling, Stage, StageClock, UnionFind};
use cv_features::{
    ByteDescriptors, FeatureError, FeatureOptions, Features, MatchError, SiftOptions, match_byte_descriptors,
};
use cv_imgproc::Pixel;
use cv_panorama::{
    AlignError, Alignment, PairRejection, Photo, PhotoMask, Unplaced, VerifiedPair, align, refine_alignment,
    verify_pair,
};
use cv_parallel::prelude::*;

/// Result of registration.
pub(super) struct Registered {
    pub(super) alignment: Alignment,
    pub(super) images: Vec<PanoramaImage>,
    pub(super) pairs: Vec<PanoramaPair>,
    pub(super) features: Vec<Features>,
    pub(super) clock: StageClock,
}

/// Registers photographs by their features.
pub(super) fn register(
    photos: &dyn Photographs,
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<Registered, PanoramaError> {
    let mut clock = StageClock::new();
    let n = photos.count();
    let indices: Vec<usize> = (0..n).collect();
    let mut prepared: Vec<Prepared> = Vec::with_capacity(n);
    {
        let stage = Stage::new(progress, "features", n)?;
        let resize = |p: &PanoramaPhoto<'_>| Prepared::new(p, &options.matching, options.registration_pixels, &stage);
        for batch in indices.chunks(photos.at_once()) {
            let batch = batch.par_iter().map(|index| photos.prepare(*index, &resize));
            prepared.extend(batch.try_collect()?);
        }
    }
    let extract = |prepared: &mut [Prepared], matching: &MatchingOptions, pixels: usize| -> Result<(), Cancelled> {
        let stage = Stage::new(progress, "features", n)?;
        prepared.par_iter_mut().try_for_each(|p| {
            p.extract(matching, pixels, &stage)?;
            stage.add(1)
        })?;
        Ok(())
    };
    let matching = &options.matching;
    // SIFT at twice the resolution takes most of the time, and low-contrast features are less accurate: both are used only where needed. Matches are refined at the resolution of the
    // registration in any case.
    let plain = match &matching.features {
        FeatureOptions::Sift(sift) if sift.upsample => {
            let features = FeatureOptions::Sift(SiftOptions { upsample: false, min_features: 0, ..sift.clone() });
            Some(MatchingOptions { features, ..matching.clone() })
        }
        _ => None,
    };
    match &plain {
        Some(plain) => extract(&mut prepared, plain, options.registration_pixels / 2)?,
        None => extract(&mut prepared, matching, usize::MAX)?,
    }
    clock.lap("features");
    let candidates = candidate_pairs(&prepared, progress)?;
    let mut matched = match_pairs(&prepared, &candidates, options, progress)?;
    clock.lap("match");
    let mut remaining = unconnected_pairs(n, &matched, &candidates);
    let strong = Components::new(n, &matched, MIN_STRONG_INLIERS);
    if plain.is_some() && strong.count() > 1 {
        extract(&mut prepared, matching, usize::MAX)?;
        clock.lap("features");
        // Of the pairs between strongly connected photographs only the verified ones.
        let is_repeated = |(pair, verified): &MatchedPair| verified.is_some() || !strong.joins(pair.a, pair.b);
        remaining.extend(matched.drain(..).filter(is_repeated).map(|(pair, _)| (pair.a, pair.b)));
    }
    if !remaining.is_empty() {
        matched.extend(match_pairs(&prepared, &remaining, options, progress)?);
        matched.sort_by_key(|(pair, _)| (pair.a, pair.b));
        clock.lap("match");
    }
    let (pairs, verified): (Vec<PanoramaPair>, Vec<Option<VerifiedPair>>) = matched.into_iter().unzip();
    let verified: Vec<VerifiedPair> = verified.into_iter().flatten().collect();
    let known: Vec<Photo> = prepared.iter().map(|p| p.photo).collect();
    let alignment = match align(&known, &verified, &options.align, progress) {
        Ok(alignment) => alignment,
        Err(AlignError::Cancelled(stop)) => return Err(stop.into()),
        Err(source) => {
            let views = vec![Err(Unplaced::NoOverlap); n];
            return Err(PanoramaError::Align { source, images: describe(&prepared, &views, &pairs) });
        }
    };
    let grays: Vec<GrayU8> = prepared.par_iter_mut().map(Prepared::take_gray).collect();
    let alignment = refine_alignment(&grays, &known, &verified, alignment, &options.align, progress)?;
    let mut images = describe(&prepared, &alignment.views, &pairs);
    let sizes: Vec<_> = prepared.iter().enumerate().map(|(index, p)| (p.factor, photos.size(index))).collect();
    for (image, (_, size)) in images.iter_mut().zip(&sizes) {
        image.size = *size;
    }
    let alignment = alignment.resized(&sizes);
    clock.lap("align");
    let features = prepared.into_iter().map(Prepared::into_features).collect();
    Ok(Registered { alignment, images, pairs, features, clock })
}

/// A function that prepares a photograph for the extraction of its features.
pub(super) type Prepare<'a> = dyn Fn(&PanoramaPhoto<'_>) -> Result<Prepared, Cancelled> + 'a;

/// Photographs to register, in memory or loaded one after the other.
pub(super) trait Photographs: Sync {
    fn count(&self) -> usize;

    fn size(&self, index: usize) -> (usize, usize);

    /// Number of photographs that may be in memory at a time.
    fn at_once(&self) -> usize;

    /// Calls `prepare` with a photograph.
    fn prepare(&self, index: usize, prepare: &Prepare<'_>) -> Result<Prepared, PanoramaError>;
}

impl Photographs for Vec<PanoramaPhoto<'_>> {
    fn count(&self) -> usize {
        self.len()
    }

    fn size(&self, index: usize) -> (usize, usize) {
        self[index].image.size()
    }

    fn at_once(&self) -> usize {
        self.len().max(1)
    }

    fn prepare(&self, index: usize, prepare: &Prepare<'_>) -> Result<Prepared, PanoramaError> {
        Ok(prepare(&self[index])?)
    }
}

/// A photograph with its features.
pub(super) struct Prepared {
    /// In pixels of the resized photograph.
    photo: Photo,
    /// Size of the photograph relative to the resized one.
    factor: f64,
    /// Luma of the resized photograph.
    gray: GrayF32,
    features: Features,
    /// The quantized descriptors of the features, if their kind supports it.
    bytes: Option<ByteDescriptors>,
    /// Why feature extraction failed.
    failure: Option<FeatureError>,
    /// Mask of the photograph.
    mask: Option<PhotoMask>,
}

impl Prepared {
    /// Resizes a photograph for registration; without features yet.
    fn new(
        p: &PanoramaPhoto<'_>,
        matching: &MatchingOptions,
        registration_pixels: usize,
        stage: &Stage<'_>,
    ) -> Result<Self, Cancelled> {
        stage.check()?;
        let filled = p.mask.map(|mask| mask.filled(p.image, stage)).transpose()?.flatten();
        let whole = filled.as_ref().map_or(p.image, RgbU8::view);
        let reduced = reduced(whole, registration_pixels);
        let image = reduced.as_ref().map_or(whole, Image::view);
        let factor = whole.width() as f64 / image.width() as f64;
        let (width, height) = image.size();
        let camera = p.camera.map(|c| Camera { width, height, ..c.scaled(1.0 / factor) });
        let photo = Photo { width, height, focal: p.focal.map(|f| f / factor), camera };
        let features = Features::new(matching.features.extractor().kind());
        let (gray, mask) = (cv_imgproc::rgb_to_gray_f32(image), p.mask.cloned());
        Ok(Self { photo, factor, gray, features, bytes: None, failure: None, mask })
    }

    /// Extracts the features at about `pixels` pixels.
    fn extract(&mut self, matching: &MatchingOptions, pixels: usize, progress: &dyn Progress) -> Result<(), Cancelled> {
        let extractor = matching.features.extractor();
        let reduced = reduced(self.gray.view(), pixels);
        let gray = reduced.as_ref().unwrap_or(&self.gray);
        (self.features, self.failure) = match extractor.extract(gray.view(), progress) {
            Ok(mut features) => {
                rescale(&mut features, Scaling::uniform(self.gray.width() as f64 / gray.width() as f64));
                (features, None)
            }
            Err(FeatureError::Cancelled(stop)) => return Err(stop),
            Err(error) => (Features::new(extractor.kind()), Some(error)),
        };
        if let Some(mask) = &self.mask {
            drop_removed(&mut self.features, mask, self.factor);
        }
        self.bytes = ByteDescriptors::new(&self.features.descriptors);
        Ok(())
    }

    /// Rounds the luma to gray levels, with the removed pixels clipped, and frees it.
    fn take_gray(&mut self) -> GrayU8 {
        let gray = std::mem::replace(&mut self.gray, GrayF32::new(0, 0, [0.0]));
        let mut gray = cv_imgproc::f32_to_u8(gray.view());
        if let Some(mask) = &self.mask {
            clip_removed(&mut gray, mask, self.factor);
        }
        gray
    }

    /// Returns the features in pixels of the photograph.
    fn into_features(mut self) -> Features {
        rescale(&mut self.features, Scaling::uniform(self.factor));
        self.features
    }
}

/// Minimum factor by which an image is reduced: less would save little.
const MIN_REDUCTION: f64 = 1.2;

/// Reduces an image to about `pixels` pixels (10,000 or more); `None` if it has hardly more.
fn reduced<T: Pixel, const C: usize>(image: ImageView<'_, T, C>, pixels: usize) -> Option<Image<T, C>> {
    let (w, h) = image.size();
    let factor = ((w * h) as f64 / pixels.max(10_000) as f64).sqrt();
    if factor <= MIN_REDUCTION {
        return None;
    }
    let (width, height) = isotropic_size((w, h), factor);
    cv_imgproc::resize_area(image, width, height).ok()
}

/// Returns the size of an image reduced by `factor`, or by up to 3 % more where the factors of both axes then differ less: rounding the sides alone makes them
/// differ by up to the reciprocal of a side, and the focal length would be wrong by as much.
fn isotropic_size((width, height): (usize, usize), factor: f64) -> (usize, usize) {
    let largest = (width as f64 / factor).round() as usize;
    let size = |w: usize| (w, (w as f64 * height as f64 / width as f64).round() as usize);
    let anisotropy = |(w, h): (usize, usize)| ((w * height) as f64 / (h * width) as f64 - 1.0).abs();
    // Of equal ones the largest.
    let sizes = (largest - largest * 3 / 100..=largest).rev().map(size);
    sizes.min_by(|a, b| anisotropy(*a).total_cmp(&anisotropy(*b))).unwrap_or(size(largest))
}

/// A matched pair, and the verified one if it was accepted.
type MatchedPair = (PanoramaPair, Option<VerifiedPair>);

/// Minimum number of inliers of a strong pair. Relative poses from such pairs were within 0.16 px of the truth on sixteen rendered sets (0.05 to 0.08 px median);
/// with the upsampled octave within 0.08 px, at twice the time.
const MIN_STRONG_INLIERS: usize = 50;

/// The photographs that verified pairs connect.
struct Components(Vec<u32>);

impl Components {
    /// Connects `n` photographs by the pairs with at least `min_inliers` inliers.
    fn new(n: usize, matched: &[MatchedPair], min_inliers: usize) -> Self {
        let mut sets = UnionFind::new(n);
        for verified in matched.iter().filter_map(|(_, verified)| verified.as_ref()) {
            if verified.inliers.len() >= min_inliers {
                sets.union(verified.a as u32, verified.b as u32);
            }
        }
        Self(sets.into_roots())
    }

    fn count(&self) -> usize {
        self.0.iter().enumerate().filter(|(i, root)| *i == **root as usize).count()
    }

    /// Returns whether the pairs connect two photographs, directly or over others.
    fn joins(&self, a: usize, b: usize) -> bool {
        self.0[a] == self.0[b]
    }
}

/// Maximum number of similar photographs that each is matched with, in sets of more than twice as many plus one; as in structure from motion.
const MAX_PARTNERS: usize = 20;

/// Returns the pairs to match, sorted, with the smaller index first: all, or in large sets the most similar ones.
fn candidate_pairs(prepared: &[Prepared], progress: &dyn Progress) -> Result<Vec<(usize, usize)>, Cancelled> {
    let bytes = prepared.iter().map(|p| Some((&p.features.keypoints[..], p.bytes.as_ref()?)));
    match bytes.collect::<Option<Vec<_>>>() {
        Some(bytes) if bytes.len() > 2 * MAX_PARTNERS + 1 => similar_pairs(&bytes, MAX_PARTNERS, 0, progress),
        _ => Ok(all_pairs(prepared.len()).collect()),
    }
}

/// Returns all pairs of `n` photographs, sorted.
fn all_pairs(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(move |a| (a + 1..n).map(move |b| (a, b)))
}

/// Returns the pairs that are not among the sorted `candidates` and whose photographs no verified pairs connect.
fn unconnected_pairs(n: usize, matched: &[MatchedPair], candidates: &[(usize, usize)]) -> Vec<(usize, usize)> {
    let components = Components::new(n, matched, 0);
    let is_new = |(a, b): &(usize, usize)| !components.joins(*a, *b) && candidates.binary_search(&(*a, *b)).is_err();
    all_pairs(n).filter(is_new).collect()
}

/// Matches and verifies pairs, in their order, but for those with a photograph without features.
fn match_pairs(
    prepared: &[Prepared],
    pairs: &[(usize, usize)],
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<Vec<MatchedPair>, Cancelled> {
    let stage = Stage::new(progress, "match", pairs.len())?;
    let compare = |&(a, b): &(usize, usize)| -> Result<Option<MatchedPair>, Cancelled> {
        let pair = match_pair(prepared, a, b, options, &stage)?;
        stage.add(1)?;
        Ok(pair)
    };
    let matched = pairs.par_iter().map(compare).try_collect::<_, Cancelled>()?;
    Ok(matched.into_iter().flatten().collect())
}

/// Matches and verifies a pair; `None` where a photograph has no features.
fn match_pair(
    prepared: &[Prepared],
    a: usize,
    b: usize,
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<Option<MatchedPair>, Cancelled> {
    let (p, q) = (&prepared[a], &prepared[b]);
    let matches = match (&p.bytes, &q.bytes) {
        (Some(p), Some(q)) => match_byte_descriptors(p, q, &options.matching.descriptor_matching(), progress),
        _ => match_features(&p.features, &q.features, &options.matching, progress),
    };
    let matches = match matches {
        Ok(matches) => matches,
        Err(MatchError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok(None),
    };
    let pixels = correspondences(&p.features, &q.features, &matches);
    let size = |p: &Prepared| (p.photo.width, p.photo.height);
    let verified = verify_pair((a, size(p)), (b, size(q)), &pixels, &options.verify);
    let (verified, rejected) = match verified {
        Ok(pair) => (Some(pair), None),
        Err(reason) => (None, Some(reason)),
    };
    let inliers = verified.as_ref().map(|v| v.inliers.clone()).unwrap_or_default();
    Ok(Some((PanoramaPair { a, b, matches, inliers, rejected }, verified)))
}

/// Collects the result of each photograph.
fn describe(
    prepared: &[Prepared],
    views: &[Result<cv_panorama::View, Unplaced>],
    pairs: &[PanoramaPair],
) -> Vec<PanoramaImage> {
    let nearest = |i: usize| {
        let miss = |p: &PanoramaPair| match p.rejected {
            Some(PairRejection::TooFewInliers { inliers: agree, in_overlap, needed }) if p.a == i || p.b == i => {
                Some(NearestPair { other: if p.a == i { p.b } else { p.a }, agree, in_overlap, needed })
            }
            _ => None,
        };
        pairs.iter().filter_map(miss).max_by_key(|miss| miss.agree)
    };
    let reason = |i: usize, why: Unplaced| match (why, &prepared[i].failure) {
        (_, Some(failure)) => LeftOut::Features(*failure),
        (Unplaced::OtherComponent { size }, _) => LeftOut::OtherComponent { size },
        (Unplaced::Inconsistent, _) => LeftOut::Inconsistent,
        (Unplaced::NoOverlap, _) if prepared[i].features.keypoints.is_empty() => LeftOut::NoFeatures,
        (Unplaced::NoOverlap, _) => LeftOut::NoOverlap { nearest: nearest(i) },
    };
    views
        .iter()
        .enumerate()
        .map(|(i, view)| PanoramaImage {
            size: (prepared[i].photo.width, prepared[i].photo.height),
            used: view.is_ok(),
            reason: view.as_ref().err().map(|why| reason(i, *why)),
            features: prepared[i].features.keypoints.len(),
            focal: None,
            gain: [1.0; 3],
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Correspondence, Matrix3};

    #[test]
    fn reduced_images_keep_their_aspect_ratio() {
        for (size, factor, expected) in
            [((1600, 1200), 1.549, (1032, 774)), ((4000, 3000), 3.873, (1032, 774)), ((5, 4), 1.3, (4, 3))]
        {
            assert_eq!(isotropic_size(size, factor), expected);
        }
        for size in [(1601, 1203), (2272, 1704), (1999, 3001), (6016, 4016), (3001, 1001)] {
            let (w, h) = isotropic_size(size, 2.3);
            let factors = [size.0 as f64 / w as f64, size.1 as f64 / h as f64];
            // A tenth of what rounding the sides alone can give; and hardly smaller.
            assert!((factors[0] / factors[1] - 1.0).abs() < 0.05 / w.min(h) as f64, "{size:?} {w} {h}");
            assert!((2.29..2.38).contains(&factors[0]), "{size:?} {w} {h}");
        }
        assert_eq!(isotropic_size((1, 90_000), 3.0).0, 0);
        // At full resolution.
        let image = GrayF32::new(300, 200, [0.0]);
        assert!(reduced(image.view(), usize::MAX).is_none() && reduced(image.view(), 50_000).is_none());
        assert_eq!(reduced(image.view(), 10_000).map(|image| image.size()), Some((120, 80)));
    }

    fn verified(a: usize, b: usize, agree: usize) -> MatchedPair {
        let pair = PanoramaPair { a, b, matches: Vec::new(), inliers: Vec::new(), rejected: None };
        let (inliers, matches) = ((0..agree).collect(), vec![Correspondence::new(0.0, 0.0, 0.0, 0.0); agree]);
        (pair, Some(VerifiedPair { a, b, homography: Matrix3::identity(), distortion: 0.0, inliers, matches }))
    }

    #[test]
    fn components_are_connected_by_verified_pairs_with_enough_inliers() {
        let count = |n, matched: &[MatchedPair]| Components::new(n, matched, MIN_STRONG_INLIERS).count();
        let rejected = (PanoramaPair { a: 0, b: 1, matches: Vec::new(), inliers: Vec::new(), rejected: None }, None);
        assert_eq!([count(0, &[]), count(1, &[]), count(2, &[]), count(2, &[rejected])], [0, 1, 2, 2]);
        let strong = MIN_STRONG_INLIERS;
        assert_eq!(count(3, &[verified(1, 2, strong), verified(0, 2, strong), verified(0, 1, 9)]), 1);
        // Two strong pairs and a weak one between them.
        let matched = [verified(2, 3, strong), verified(0, 1, 900), verified(0, 2, strong - 1)];
        let components = Components::new(4, &matched, strong);
        assert_eq!(components.count(), 2);
        assert!(components.joins(0, 1) && components.joins(3, 2) && !components.joins(0, 2));
    }

    #[test]
    fn pairs_that_were_not_tried_are_those_between_components() {
        let candidates = [(0, 1), (0, 3), (2, 3)];
        let matched = [verified(0, 1, 9), verified(2, 3, 9)];
        assert_eq!(unconnected_pairs(4, &matched, &candidates), [(0, 2), (1, 2), (1, 3)]);
        assert_eq!(unconnected_pairs(4, &[verified(0, 1, 9), verified(1, 3, 9), verified(2, 3, 9)], &candidates), []);
        assert_eq!(unconnected_pairs(3, &[], &all_pairs(3).collect::<Vec<_>>()), []);
    }
}
