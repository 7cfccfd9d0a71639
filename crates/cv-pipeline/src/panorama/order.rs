//! A canonical order of the photographs, by their pixels: the panorama is the same, byte for byte, in whatever order they are given.

use crate::panorama::{LeftOut, PanoramaError, PanoramaImage, PanoramaPair, PanoramaResult};
use cv_core::{Correspondence, DMatch, ImageView};
use cv_panorama::{AlignedPair, Alignment, PhotoSample, RenderError, StreamError};

/// A permutation of photographs.
pub(super) struct Order {
    /// Input index of each photograph in canonical order.
    inputs: Vec<usize>,
    /// The inverse: canonical index of each input.
    canonical: Vec<usize>,
}

/// Rows between those that are hashed first.
const ROW_STEP: usize = 16;

impl Order {
    /// Sorts photographs by size and by a hash of their pixels, rounded to 8 bits: the order, and with it the choice
    /// between equally good solutions, does not depend on the bit depth. O(pixels / 16) unless photographs are alike.
    pub(super) fn of<T: PhotoSample>(photos: &[ImageView<'_, T, 3>]) -> Self {
        let sparse: Vec<_> = photos.iter().map(|photo| (photo.size(), sparse_hash(photo))).collect();
        Self::by(&sparse, |index| whole_hashes(&photos[index]))
    }

    /// As [`Order::of`], of photographs by size and [`sparse_hash`]; `whole` returns the [`whole_hashes`] of one, where these are equal.
    pub(super) fn by(sparse: &[((usize, usize), u64)], whole: impl Fn(usize) -> [u64; 2]) -> Self {
        let mut inputs: Vec<usize> = (0..sparse.len()).collect();
        inputs.sort_by(|&a, &b| sparse[a].cmp(&sparse[b]).then_with(|| whole(a).cmp(&whole(b))));
        let mut canonical = vec![0; inputs.len()];
        inputs.iter().enumerate().for_each(|(k, &i)| canonical[i] = k);
        Self { inputs, canonical }
    }

    /// Items of the inputs, in canonical order.
    pub(super) fn sorted<U: Copy>(&self, items: &[U]) -> Vec<U> {
        self.inputs.iter().map(|&i| items[i]).collect()
    }

    /// An alignment of the inputs, in canonical order.
    pub(super) fn sorted_alignment(&self, alignment: Alignment) -> Alignment {
        renumbered(alignment, &self.canonical)
    }

    /// Items in canonical order, in the order of the inputs.
    fn restored<U>(&self, items: Vec<U>) -> Vec<U> {
        permuted(items, &self.inputs)
    }

    fn restored_images(&self, images: Vec<PanoramaImage>) -> Vec<PanoramaImage> {
        let mut images = self.restored(images);
        for image in &mut images {
            if let Some(LeftOut::NoOverlap { nearest: Some(nearest) }) = &mut image.reason {
                nearest.other = self.inputs[nearest.other];
            }
        }
        images
    }

    /// A result in canonical order, in the order of the inputs.
    pub(super) fn restored_result<T>(&self, result: PanoramaResult<T>) -> PanoramaResult<T> {
        let PanoramaResult { mut labels, mut map, .. } = result;
        for label in labels.as_mut_slice() {
            *label = self.inputs.get(usize::from(*label)).map_or(*label, |&i| i as u16);
        }
        map.renumber(&self.inputs);
        let features = if result.features.is_empty() { Vec::new() } else { self.restored(result.features) };
        let mut pairs: Vec<PanoramaPair> = result.pairs.into_iter().map(|pair| self.restored_pair(pair)).collect();
        pairs.sort_by_key(|pair| (pair.a, pair.b));
        let mut stacks: Vec<Vec<usize>> =
            result.stacks.iter().map(|stack| stack.iter().map(|&k| self.inputs[k]).collect()).collect();
        stacks.iter_mut().for_each(|stack| stack.sort_unstable());
        stacks.sort_unstable();
        PanoramaResult {
            labels,
            map,
            features,
            pairs,
            stacks,
            images: self.restored_images(result.images),
            alignment: renumbered(result.alignment, &self.inputs),
            ..result
        }
    }

    /// An error in canonical order, in the order of the inputs.
    pub(super) fn restored_error(&self, error: PanoramaError) -> PanoramaError {
        match error {
            PanoramaError::Align { source, images } => {
                PanoramaError::Align { source, images: self.restored_images(images) }
            }
            PanoramaError::Render(RenderError::Stream(StreamError::Photograph { index })) => {
                RenderError::from(StreamError::Photograph { index: self.inputs[index] }).into()
            }
            other => other,
        }
    }

    /// Returns the input index of each photograph in canonical order.
    pub(super) fn inputs(&self) -> &[usize] {
        &self.inputs
    }

    fn restored_pair(&self, mut pair: PanoramaPair) -> PanoramaPair {
        (pair.a, pair.b) = (self.inputs[pair.a], self.inputs[pair.b]);
        if pair.a > pair.b {
            (pair.a, pair.b) = (pair.b, pair.a);
            for m in &mut pair.matches {
                *m = DMatch { query: m.train, train: m.query, ..*m };
            }
        }
        pair
    }
}

/// Hashes every [`ROW_STEP`]-th row, rounded to 8 bits.
pub(super) fn sparse_hash<T: PhotoSample>(photo: &ImageView<'_, T, 3>) -> u64 {
    hash(photo, ROW_STEP, rounded)
}

/// Hashes all samples, rounded to 8 bits and exactly.
pub(super) fn whole_hashes<T: PhotoSample>(photo: &ImageView<'_, T, 3>) -> [u64; 2] {
    [hash(photo, 1, rounded), hash(photo, 1, |v: T| v.to_f32() as u64)]
}

fn rounded<T: PhotoSample>(v: T) -> u64 {
    (v.to_f32() * (255.0 / T::WHITE.to_f32())).round() as u64
}

/// Returns the FNV-1a hash of the values of the samples in every `step`-th row.
fn hash<T: PhotoSample>(photo: &ImageView<'_, T, 3>, step: usize, value: impl Fn(T) -> u64) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    let mut add = |v: u64| hash = (hash ^ v).wrapping_mul(0x100_0000_01b3);
    for y in (0..photo.height()).step_by(step) {
        photo.row(y).iter().for_each(|v| add(value(*v)));
    }
    hash
}

/// Moves item `k` to place `to[k]`.
fn permuted<U>(items: Vec<U>, to: &[usize]) -> Vec<U> {
    let mut keyed: Vec<(usize, U)> = to.iter().copied().zip(items).collect();
    keyed.sort_by_key(|(place, _)| *place);
    keyed.into_iter().map(|(_, item)| item).collect()
}

/// The alignment with photograph `k` as photograph `to[k]`; in each pair the first has the smaller index.
fn renumbered(alignment: Alignment, to: &[usize]) -> Alignment {
    let pair = |p: AlignedPair| {
        let (a, b) = (to[p.a], to[p.b]);
        if a < b {
            return AlignedPair { a, b, ..p };
        }
        let matches = p.matches.iter().map(|m| Correspondence { a: m.b, b: m.a }).collect();
        AlignedPair { a: b, b: a, matches, ..p }
    };
    let mut pairs: Vec<AlignedPair> = alignment.pairs.into_iter().map(pair).collect();
    pairs.sort_by_key(|p| (p.a, p.b));
    Alignment {
        views: permuted(alignment.views, to),
        reference: to.get(alignment.reference).copied().unwrap_or(alignment.reference),
        pairs,
        ..alignment
    }
}
