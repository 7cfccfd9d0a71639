//! Selection of the pairs to match: all, adjacent ones, or by image retrieval.

use super::{PhotoOrder, SfmJobOptions, SfmPhoto};
use crate::Progress;
use crate::similar::{PhotoFeatures, similar_pairs};
use cv_core::Cancelled;

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
        let features: Vec<PhotoFeatures<'_>> = photos.iter().map(|p| (&p.keypoints[..], &p.descriptors)).collect();
        pairs.extend(similar_pairs(&features, partners, near, progress)?);
    }
    pairs.sort_unstable();
    pairs.dedup();
    Ok(pairs)
}
