//! Global descriptors: photographs that show the same are found among many without matching their features.
//!
//! Sources: H. Jégou, M. Douze, C. Schmid & P. Pérez, "Aggregating local descriptors into a compact image representation", CVPR 2010 (VLAD); R. Arandjelović & A. Zisserman, "All about
//! VLAD", CVPR 2013 (each word's sum normalized by itself, so that a repeated pattern does not outweigh all else).

use crate::ByteDescriptors;
use crate::byte_neighbors::{MAX_DIMENSION, TASK, nearest_bytes};
use crate::simd;
use cv_core::{Cancelled, Progress, Stage};
use rayon::prelude::*;

/// Rounds of k-means; of photographs, the words hardly move any more after as many.
const ROUNDS: usize = 8;

/// Words: the centers of clusters of descriptors, learned from the photographs that are to be compared, or others.
#[derive(Debug, Clone, PartialEq)]
pub struct Vocabulary {
    words: ByteDescriptors,
}

impl Vocabulary {
    /// At most `count` words of the given descriptors, by k-means (Lloyd 1982) from words evenly spread over them. `None` where there are no descriptors. O(descriptors × words).
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
        for _ in 0..ROUNDS {
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

    /// The global descriptor: for each word the sum of the differences of its descriptors from it, of unit length each and together; all zero without descriptors. Dot products tell how
    /// alike photographs are, from −1 to 1. `None` for descriptors of another kind than the words.
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

/// The nearest word of each descriptor.
fn assign(
    descriptors: &ByteDescriptors,
    words: &ByteDescriptors,
    progress: &dyn Progress,
) -> Result<Vec<usize>, Cancelled> {
    if descriptors.is_empty() {
        return Ok(Vec::new());
    }
    let stage = Stage::new(progress, "words", descriptors.len().div_ceil(TASK))?;
    let (nearest, _) = nearest_bytes(simd::level(), descriptors, words, false, &stage)?;
    Ok(nearest.into_iter().map(|n| n.best as usize).collect())
}

fn normalize(v: &mut [f32]) {
    let length = v.iter().map(|x| f64::from(*x) * f64::from(*x)).sum::<f64>().sqrt() as f32;
    if length > 0.0 {
        v.iter_mut().for_each(|x| *x /= length);
    }
}

/// For each global descriptor the indices of the others by how alike they are, the most alike first: `count` of them for which `allowed` holds. O(n² × length).
///
/// # Errors
/// [`Cancelled`].
pub fn most_alike(
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
            let mut rated: Vec<(f32, usize)> = others.map(|j| (dot(&descriptors[i], &descriptors[j]), j)).collect();
            rated.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            rated.truncate(count);
            stage.add(1)?;
            Ok(rated.into_iter().map(|r| r.1).collect())
        })
        .collect()
}

/// In lanes of their own, so that sums are vectors.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0f32; 16];
    for (a, b) in a.as_chunks::<16>().0.iter().zip(b.as_chunks::<16>().0) {
        for i in 0..16 {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DescriptorKind, Descriptors};
    use cv_core::Silent;

    /// Numbers from 0 to 1.
    fn random(seed: u64) -> impl Iterator<Item = f32> {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        std::iter::repeat_with(move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1 << 24) as f32
        })
        .skip(8)
    }

    /// The descriptors of a photograph that sees these spots, each of which has a look of its own, with noise.
    fn photograph(spots: &[usize], noise: u64) -> ByteDescriptors {
        let mut data = Vec::new();
        for &spot in spots {
            let look = random(spot as u64 + 1).take(128).map(|v| if v > 0.7 { 0.16 } else { 0.0 });
            data.extend(look.zip(random(noise << 32 | spot as u64)).map(|(look, off)| look + 0.01 * off));
        }
        ByteDescriptors::new(&Descriptors::from_vec(DescriptorKind::ROOT_SIFT, data).unwrap()).unwrap()
    }

    #[test]
    fn photographs_of_one_place_are_most_alike() {
        // Two photographs of each of twelve places; each sees 40 of the 50 spots of its place.
        let spots = |place: usize, from: usize| (from..from + 40).map(|s| place * 50 + s).collect::<Vec<_>>();
        let photos: Vec<ByteDescriptors> =
            (0..24).map(|i| photograph(&spots(i / 2, 10 * (i % 2)), i as u64 + 1)).collect();
        let all: Vec<usize> = (0..12).flat_map(|place| spots(place, 5)).collect();
        let words = Vocabulary::learn(&photograph(&all, 99), 16, &Silent).unwrap().unwrap();
        let described: Vec<Vec<f32>> = photos.iter().map(|p| words.describe(p, &Silent).unwrap().unwrap()).collect();
        let alike = most_alike(&described, 1, |_, _| true, &Silent).unwrap();
        for (i, found) in alike.iter().enumerate() {
            assert_eq!(found, &[i ^ 1], "photograph {i}");
        }
        let others = most_alike(&described, 30, |a, b| a.abs_diff(b) > 1, &Silent).unwrap();
        assert!(others.iter().enumerate().all(|(i, o)| o.len() == 24 - if i == 0 || i == 23 { 2 } else { 3 }));
    }

    #[test]
    fn nothing_to_describe() {
        let none = ByteDescriptors::new(&Descriptors::new(DescriptorKind::ROOT_SIFT)).unwrap();
        assert_eq!(Vocabulary::learn(&none, 16, &Silent), Ok(None));
        let words = Vocabulary::learn(&photograph(&[1, 2, 3], 1), 16, &Silent).unwrap().unwrap();
        let described = words.describe(&none, &Silent).unwrap().unwrap();
        assert!(described.len() == 3 * 128 && described.iter().all(|v| *v == 0.0));
        let other = ByteDescriptors::new(&Descriptors::new(DescriptorKind::SIFT)).unwrap();
        assert_eq!(words.describe(&other, &Silent), Ok(None));
    }
}
