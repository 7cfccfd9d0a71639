//! Global image descriptors (VLAD) for image retrieval.
//!
//! Sources: H. Jégou, M. Douze, C. Schmid & P. Pérez, "Aggregating local descriptors into a compact image
//! representation", CVPR 2010 (VLAD); R. Arandjelović & A. Zisserman, "All about VLAD", CVPR 2013 (intra-normalization
//! against burstiness).

use crate::ByteDescriptors;
use crate::byte_neighbors::{MAX_DIMENSION, TASK_QUERIES, nearest_bytes};
use crate::simd;
use cv_core::{Cancelled, Progress, Stage};
use cv_parallel::prelude::*;

/// Iterations of k-means, after which the visual words of photographs hardly change.
const KMEANS_ITERATIONS: usize = 8;

/// A visual vocabulary: cluster centers of descriptors, learned from the images to be compared or from others.
#[derive(Debug, Clone, PartialEq)]
pub struct Vocabulary {
    words: ByteDescriptors,
}

impl Vocabulary {
    /// Learns at most `count` visual words by k-means (Lloyd 1982), initialized with evenly spaced samples. `None`
    /// without descriptors. O(descriptors × words).
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn learn(samples: &ByteDescriptors, count: usize, progress: &dyn Progress) -> Result<Option<Self>, Cancelled> {
        let count = count.min(samples.len());
        let d = samples.kind().dimension;
        if count == 0 || d > MAX_DIMENSION {
            return Ok(None);
        }
        let start: Vec<usize> = (0..count).map(|i| i * samples.len() / count).collect();
        let mut words = samples.select(&start);
        for _ in 0..KMEANS_ITERATIONS {
            let mut sums = vec![0u64; count * d];
            let mut members = vec![0u64; count];
            for (i, word) in assign(samples, &words, progress)?.into_iter().enumerate() {
                members[word] += 1;
                let sum = &mut sums[word * d..(word + 1) * d];
                sum.iter_mut().zip(samples.row(i)).for_each(|(s, v)| *s += u64::from(*v));
            }
            for (word, &n) in members.iter().enumerate().filter(|(_, n)| **n > 0) {
                let mean = |s: &u64| ((s + n / 2) / n) as u8;
                let center: Vec<u8> = sums[word * d..(word + 1) * d].iter().map(mean).collect();
                words.set_row(word, &center);
            }
        }
        Ok(Some(Self { words }))
    }

    /// Computes the VLAD descriptor: for each word the sum of residuals of its descriptors, L2-normalized per word and
    /// in total; zero without descriptors. The dot product of two is the similarity of the images, −1 to 1. `None` for
    /// descriptors of another kind than the words.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn describe(
        &self,
        descriptors: &ByteDescriptors,
        progress: &dyn Progress,
    ) -> Result<Option<Vec<f32>>, Cancelled> {
        if descriptors.kind() != self.words.kind() {
            return Ok(None);
        }
        let d = descriptors.kind().dimension;
        let mut sums = vec![0i32; self.words.len() * d];
        for (i, word) in assign(descriptors, &self.words, progress)?.into_iter().enumerate() {
            let rows = descriptors.row(i).iter().zip(self.words.row(word));
            let sum = sums[word * d..(word + 1) * d].iter_mut();
            sum.zip(rows).for_each(|(s, (v, w))| *s += i32::from(*v) - i32::from(*w));
        }
        let mut out: Vec<f32> = sums.into_iter().map(|s| s as f32).collect();
        out.chunks_exact_mut(d).for_each(normalize);
        normalize(&mut out);
        Ok(Some(out))
    }
}

/// Assigns each descriptor to its nearest word.
fn assign(
    descriptors: &ByteDescriptors,
    words: &ByteDescriptors,
    progress: &dyn Progress,
) -> Result<Vec<usize>, Cancelled> {
    if descriptors.is_empty() {
        return Ok(Vec::new());
    }
    let stage = Stage::new(progress, "words", descriptors.len().div_ceil(TASK_QUERIES))?;
    let (nearest, _) = nearest_bytes(simd::level(), descriptors, words, false, &stage)?;
    Ok(nearest.into_iter().map(|n| n.best as usize).collect())
}

fn normalize(v: &mut [f32]) {
    let length = v.iter().map(|x| f64::from(*x) * f64::from(*x)).sum::<f64>().sqrt() as f32;
    if length > 0.0 {
        v.iter_mut().for_each(|x| *x /= length);
    }
}

/// Finds for each global descriptor the indices of the `count` most similar others for which `allowed` is true, by
/// decreasing similarity. O(n² × dimension).
///
/// # Errors
/// [`Cancelled`].
pub fn most_similar(
    descriptors: &[Vec<f32>],
    count: usize,
    allowed: impl Fn(usize, usize) -> bool + Sync,
    progress: &dyn Progress,
) -> Result<Vec<Vec<usize>>, Cancelled> {
    let stage = Stage::new(progress, "alike", descriptors.len())?;
    (0..descriptors.len())
        .into_par_iter()
        .map(|i| {
            let others = (0..descriptors.len()).filter(|j| *j != i && allowed(i, *j));
            let mut ranked: Vec<(f32, usize)> = others.map(|j| (dot(&descriptors[i], &descriptors[j]), j)).collect();
            ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            ranked.truncate(count);
            stage.add(1)?;
            Ok(ranked.into_iter().map(|r| r.1).collect())
        })
        .try_collect()
}

/// Computes the dot product with 16 partial sums, so that it vectorizes.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0f32; 16];
    for (a, b) in a.as_chunks::<16>().0.iter().zip(b.as_chunks::<16>().0) {
        for i in 0..16 {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum()
}
