//! Selection of the photographs that probably overlap, by image retrieval.

use crate::Progress;
use cv_core::{Cancelled, Keypoint};
use cv_features::{ByteDescriptors, Vocabulary, largest_keypoints, most_similar};
use cv_parallel::prelude::*;

/// Number of words of the VLAD vocabulary (Jégou et al.).
const VOCABULARY_SIZE: usize = 64;
/// Maximum number of descriptors that the vocabulary is trained on.
const MAX_TRAINING_DESCRIPTORS: usize = 20_000;
/// Maximum number of features of an image for retrieval, those of largest scale.
const MAX_RETRIEVAL_FEATURES: usize = 1024;

/// The features of a photograph: keypoints and their descriptors.
pub(crate) type PhotoFeatures<'a> = (&'a [Keypoint], &'a ByteDescriptors);

/// Returns the pairs of each photograph with the `count` most similar ones by VLAD, without those up to `near` positions away: sorted, with the smaller
/// index first. None where the photographs have too few features for a vocabulary.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn similar_pairs(
    photos: &[PhotoFeatures<'_>],
    count: usize,
    near: usize,
    progress: &dyn Progress,
) -> Result<Vec<(usize, usize)>, Cancelled> {
    let largest: Vec<ByteDescriptors> = photos
        .par_iter()
        .map(|(keypoints, descriptors)| descriptors.select(&largest_keypoints(keypoints, MAX_RETRIEVAL_FEATURES)))
        .collect();
    let each = (MAX_TRAINING_DESCRIPTORS / photos.len().max(1)).max(1);
    let sample =
        |set: &ByteDescriptors| (0..set.len().min(each)).map(|i| i * set.len() / each.min(set.len())).collect();
    let samples: Vec<(usize, Vec<usize>)> = largest.iter().map(sample).enumerate().collect();
    let Some(samples) = ByteDescriptors::gather(samples.iter().map(|(p, rows)| (&largest[*p], &rows[..]))) else {
        return Ok(Vec::new());
    };
    let Some(words) = Vocabulary::learn(&samples, VOCABULARY_SIZE, progress)? else {
        return Ok(Vec::new());
    };
    let described: Vec<Vec<f32>> = largest
        .par_iter()
        .map(|set| Ok(words.describe(set, progress)?.unwrap_or_default()))
        .try_collect::<_, Cancelled>()?;
    let similar = most_similar(&described, count, |a, b| a.abs_diff(b) > near, progress)?;
    let of_each = |(a, of): (usize, &Vec<usize>)| of.iter().map(|&b| (a.min(b), a.max(b))).collect::<Vec<_>>();
    let mut pairs: Vec<(usize, usize)> = similar.iter().enumerate().flat_map(of_each).collect();
    pairs.sort_unstable();
    pairs.dedup();
    Ok(pairs)
}
