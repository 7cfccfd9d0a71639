//! Which pairs of photographs are tried.

use super::{PhotoOrder, SfmJobOptions, SfmPhoto};
use crate::Progress;
use cv_core::Cancelled;
use cv_features::{ByteDescriptors, Vocabulary, largest_keypoints, most_similar};
use rayon::prelude::*;

/// Words of the vocabulary of a set, those of Jégou et al.
const WORDS: usize = 64;
/// Most descriptors that the words are learned from.
const MOST_SAMPLES: usize = 20_000;
/// Features of largest scale that a photograph is told by.
const DESCRIBED: usize = 1024;
/// In a sequence: photographs before and after that each is tried with, and, among the others, those where it may have come back to an earlier place.
const NEIGHBORS: usize = 10;
const LOOPS: usize = 5;

/// The pairs to be tried, first before second, in order: all of them in sets where each photograph has no more than twice [`SfmJobOptions::partners`] others; in larger ones those that look
/// most alike; in a sequence neighbors, and those that look most alike among the others.
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
        PhotoOrder::Sequence => (NEIGHBORS, LOOPS.min(options.partners)),
    };
    let mut pairs: Vec<(usize, usize)> =
        (0..n).flat_map(|a| (a + 1..n.min(a + 1 + near)).map(move |b| (a, b))).collect();
    if n > near + 1 && partners > 0 {
        let alike = alike(photos, partners, near, progress)?;
        pairs.extend(alike.iter().enumerate().flat_map(|(a, of)| of.iter().map(move |&b| (a.min(b), a.max(b)))));
    }
    pairs.sort_unstable();
    pairs.dedup();
    Ok(pairs)
}

/// For each photograph the `count` that look most like it, but for those up to `near` places from it.
fn alike(
    photos: &[SfmPhoto],
    count: usize,
    near: usize,
    progress: &dyn Progress,
) -> Result<Vec<Vec<usize>>, Cancelled> {
    let largest: Vec<ByteDescriptors> =
        photos.par_iter().map(|p| p.descriptors.select(&largest_keypoints(&p.keypoints, DESCRIBED))).collect();
    let each = (MOST_SAMPLES / photos.len()).max(1);
    let sample =
        |set: &ByteDescriptors| (0..set.len().min(each)).map(|i| i * set.len() / each.min(set.len())).collect();
    let samples: Vec<(usize, Vec<usize>)> = largest.iter().map(sample).enumerate().collect();
    let Some(samples) = ByteDescriptors::gather(samples.iter().map(|(p, rows)| (&largest[*p], &rows[..]))) else {
        return Ok(vec![Vec::new(); photos.len()]);
    };
    let Some(words) = Vocabulary::learn(&samples, WORDS, progress)? else {
        return Ok(vec![Vec::new(); photos.len()]);
    };
    let described: Vec<Vec<f32>> = largest
        .par_iter()
        .map(|set| Ok(words.describe(set, progress)?.unwrap_or_default()))
        .collect::<Result<_, Cancelled>>()?;
    most_similar(&described, count, |a, b| a.abs_diff(b) > near, progress)
}
