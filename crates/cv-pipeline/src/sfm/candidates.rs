//! Selection of the pairs to match: all, adjacent ones, or by image retrieval.

use super::{PhotoOrder, SfmJobOptions, SfmPhoto};
use crate::Progress;
use cv_core::Cancelled;
use cv_features::{ByteDescriptors, Vocabulary, largest_keypoints, most_similar};
use rayon::prelude::*;

/// Number of words of the VLAD vocabulary (Jégou et al.).
const VOCABULARY_SIZE: usize = 64;
/// Maximum number of descriptors that the vocabulary is trained on.
const MAX_TRAINING_DESCRIPTORS: usize = 20_000;
/// Maximum number of features of an image for retrieval, those of largest scale.
const MAX_RETRIEVAL_FEATURES: usize = 1024;
/// Number of preceding and following photographs that each is matched with, in a sequence.
const SEQUENCE_NEIGHBORS: usize = 10;
/// Number of loop closure candidates of each photograph, in a sequence.
const LOOP_CANDIDATES: usize = 5;

/// Returns the pairs to match, sorted, with the smaller index first: all pairs in sets of at most twice
/// [`SfmJobOptions::partners`] plus one photographs, the most similar ones in larger sets, neighbors and the most
/// similar others in a sequence.
///
/// # Errors
/// [`Cancelled`].
pub(super) fn candidate_pairs(
    photos: &[SfmPhoto],
    options: &SfmJobOptions,
    progress: &dyn Progress,
) -> Result<Vec<(usize, usize)>, Cancelled> {
    let n = photos.len();
    let (near, partners) = match options.order {
        PhotoOrder::Any if n <= 2 * options.partners + 1 => (n, 0),
        PhotoOrder::Any => (0, options.partners),
        PhotoOrder::Sequence => (SEQUENCE_NEIGHBORS, LOOP_CANDIDATES.min(options.partners)),
    };
    let mut pairs: Vec<(usize, usize)> =
        (0..n).flat_map(|a| (a + 1..n.min(a + 1 + near)).map(move |b| (a, b))).collect();
    if n > near + 1 && partners > 0 {
        let similar = similar_photos(photos, partners, near, progress)?;
        pairs.extend(similar.iter().enumerate().flat_map(|(a, of)| of.iter().map(move |&b| (a.min(b), a.max(b)))));
    }
    pairs.sort_unstable();
    pairs.dedup();
    Ok(pairs)
}

/// Returns for each photograph the `count` most similar ones by VLAD, without those up to `near` positions away.
fn similar_photos(
    photos: &[SfmPhoto],
    count: usize,
    near: usize,
    progress: &dyn Progress,
) -> Result<Vec<Vec<usize>>, Cancelled> {
    let largest: Vec<ByteDescriptors> = photos
        .par_iter()
        .map(|p| p.descriptors.select(&largest_keypoints(&p.keypoints, MAX_RETRIEVAL_FEATURES)))
        .collect();
    let each = (MAX_TRAINING_DESCRIPTORS / photos.len()).max(1);
    let sample =
        |set: &ByteDescriptors| (0..set.len().min(each)).map(|i| i * set.len() / each.min(set.len())).collect();
    let samples: Vec<(usize, Vec<usize>)> = largest.iter().map(sample).enumerate().collect();
    let Some(samples) = ByteDescriptors::gather(samples.iter().map(|(p, rows)| (&largest[*p], &rows[..]))) else {
        return Ok(vec![Vec::new(); photos.len()]);
    };
    let Some(words) = Vocabulary::learn(&samples, VOCABULARY_SIZE, progress)? else {
        return Ok(vec![Vec::new(); photos.len()]);
    };
    let described: Vec<Vec<f32>> = largest
        .par_iter()
        .map(|set| Ok(words.describe(set, progress)?.unwrap_or_default()))
        .collect::<Result<_, Cancelled>>()?;
    most_similar(&described, count, |a, b| a.abs_diff(b) > near, progress)
}
