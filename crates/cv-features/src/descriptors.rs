//! Sets of descriptors that know what they are.

use crate::DescriptorKind;
use cv_core::Keypoint;

/// Descriptors of one kind, one row of [`DescriptorKind::dimension`] numbers each.
#[derive(Debug, Clone, PartialEq)]
pub struct Descriptors {
    kind: DescriptorKind,
    data: Vec<f32>,
}

impl Descriptors {
    /// No descriptors.
    pub fn new(kind: DescriptorKind) -> Self {
        Self { kind, data: Vec::new() }
    }

    /// Takes over rows of numbers; `None` where the length is not a multiple of the kind's dimension, or that is zero.
    pub fn from_vec(kind: DescriptorKind, data: Vec<f32>) -> Option<Self> {
        let whole = kind.dimension > 0 && data.len().is_multiple_of(kind.dimension);
        whole.then_some(Self { kind, data })
    }

    pub(crate) fn push(&mut self, row: &[f32]) {
        debug_assert_eq!(row.len(), self.dimension());
        self.data.extend_from_slice(row);
    }

    /// What the numbers mean.
    pub fn kind(&self) -> DescriptorKind {
        self.kind
    }

    /// Numbers in one descriptor.
    pub fn dimension(&self) -> usize {
        self.kind.dimension
    }

    /// Number of descriptors.
    pub fn len(&self) -> usize {
        self.data.len().checked_div(self.dimension()).unwrap_or(0)
    }

    /// True where there are none.
    pub fn is_empty(&self) -> bool {
        self.data.is_empty()
    }

    /// Descriptor `i`.
    ///
    /// # Panics
    /// Where there are not so many.
    pub fn row(&self, i: usize) -> &[f32] {
        &self.data[i * self.dimension()..(i + 1) * self.dimension()]
    }

    /// All numbers, row after row.
    pub fn as_slice(&self) -> &[f32] {
        &self.data
    }
}

/// Why a keypoint got no descriptor.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum DropReason {
    /// Its window leaves the image.
    #[error("the window of ±{margin} px leaves the image")]
    OutsideImage {
        /// Pixels needed on each side.
        margin: f32,
    },
    /// Its window is (nearly) one gray value: there is nothing to compare.
    #[error("the window is flat: standard deviation {deviation}")]
    Flat {
        /// Standard deviation of the samples, in the image's unit.
        deviation: f32,
    },
    /// The keypoint's position, scale or angle is not a finite number.
    #[error("the keypoint is not finite")]
    NotFinite,
}

/// A keypoint without a descriptor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dropped {
    /// Index in the keypoints handed in.
    pub index: usize,
    /// Why.
    pub reason: DropReason,
}

/// Keypoints with descriptors, and what became of the rest.
#[derive(Debug, Clone, PartialEq)]
pub struct Features {
    /// The keypoints that have a descriptor, in the order they came.
    pub keypoints: Vec<Keypoint>,
    /// Descriptor `i` belongs to keypoint `i`.
    pub descriptors: Descriptors,
    /// The keypoints without one; `index` counts those handed in, or found.
    pub dropped: Vec<Dropped>,
    /// Features left out only because there are more than the options allow. With this, everything handed in or found is accounted for.
    pub beyond_limit: usize,
    /// The points before they were spaced evenly, for pictures; empty for methods that do not space theirs.
    pub candidates: Vec<Keypoint>,
}

impl Features {
    /// No features.
    pub fn new(kind: DescriptorKind) -> Self {
        Self {
            keypoints: Vec::new(),
            descriptors: Descriptors::new(kind),
            dropped: Vec::new(),
            beyond_limit: 0,
            candidates: Vec::new(),
        }
    }

    /// Points found, or handed in: those kept, dropped, and beyond the limit.
    pub fn found(&self) -> usize {
        self.keypoints.len() + self.dropped.len() + self.beyond_limit
    }

    /// Leaves the features for which `keep` is true.
    pub(crate) fn retain(&mut self, keep: &[bool]) {
        let d = self.descriptors.dimension();
        let mut which = keep.iter();
        self.keypoints.retain(|_| which.next() == Some(&true));
        let rows = self.descriptors.data.chunks_exact(d).zip(keep).filter(|(_, keep)| **keep);
        self.descriptors.data = rows.flat_map(|(row, _)| row).copied().collect();
    }

    /// Adds a feature with its descriptor; false, and nothing added, where the descriptor has not as many numbers as the kind.
    pub fn push(&mut self, keypoint: Keypoint, descriptor: &[f32]) -> bool {
        let fits = descriptor.len() == self.descriptors.dimension();
        if fits {
            self.keypoints.push(keypoint);
            self.descriptors.push(descriptor);
        }
        fits
    }

    /// Adds a feature of another set of the same kind; `None` where the kinds differ or there is no such feature.
    pub fn add(&mut self, other: &Self, index: usize) -> Option<u32> {
        let keypoint = other.keypoints.get(index)?;
        if other.descriptors.kind() != self.descriptors.kind() {
            return None;
        }
        self.keypoints.push(*keypoint);
        self.descriptors.push(other.descriptors.row(index));
        u32::try_from(self.keypoints.len() - 1).ok()
    }
}
