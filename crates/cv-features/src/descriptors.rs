//! Descriptor sets and features.

use crate::DescriptorKind;
use cv_core::Keypoint;

/// A set of descriptors of one kind: a row of [`DescriptorKind::dimension`] values each.
#[derive(Debug, Clone, PartialEq)]
pub struct Descriptors {
    kind: DescriptorKind,
    data: Vec<f32>,
}

impl Descriptors {
    /// Creates an empty set.
    pub fn new(kind: DescriptorKind) -> Self {
        Self { kind, data: Vec::new() }
    }

    /// Creates a set from row-major values; `None` if the length is not a multiple of the kind's dimension, or that is
    /// zero.
    pub fn from_vec(kind: DescriptorKind, data: Vec<f32>) -> Option<Self> {
        let is_multiple = kind.dimension > 0 && data.len().is_multiple_of(kind.dimension);
        is_multiple.then_some(Self { kind, data })
    }

    pub(crate) fn push(&mut self, row: &[f32]) {
        assert_eq!(row.len(), self.dimension());
        self.data.extend_from_slice(row);
    }

    /// Returns the kind.
    pub fn kind(&self) -> DescriptorKind {
        self.kind
    }

    /// Returns the dimension of a descriptor.
    pub fn dimension(&self) -> usize {
        self.kind.dimension
    }

    /// Returns the number of descriptors.
    pub fn len(&self) -> usize {
        self.data.len().checked_div(self.dimension()).unwrap_or(0)
    }

    /// Returns whether there are none.
    pub fn is_empty(&self) -> bool {
        self.data.is_empty()
    }

    /// Returns descriptor `i`.
    ///
    /// # Panics
    /// If the index is out of range.
    pub fn row(&self, i: usize) -> &[f32] {
        &self.data[i * self.dimension()..(i + 1) * self.dimension()]
    }

    /// Returns all values in row-major order.
    pub fn as_slice(&self) -> &[f32] {
        &self.data
    }
}

/// Why a keypoint has no descriptor.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum DropReason {
    /// The window extends beyond the image.
    #[error("the window of ±{margin} px extends beyond the image")]
    OutsideImage {
        /// Half the window side in pixels.
        margin: f32,
    },
    /// The window has (nearly) constant intensity.
    #[error("the window is flat: standard deviation {deviation}")]
    Flat {
        /// Standard deviation of the samples, in the unit of the image.
        deviation: f32,
    },
    /// The keypoint's position, scale or angle is not a finite number.
    #[error("the keypoint is not finite")]
    NotFinite,
}

/// A keypoint without a descriptor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dropped {
    /// Index of the keypoint among the input or detected keypoints.
    pub index: usize,
    /// Reason.
    pub reason: DropReason,
}

/// Keypoints with descriptors, and the dropped keypoints.
#[derive(Debug, Clone, PartialEq)]
pub struct Features {
    /// The keypoints with a descriptor, in their original order.
    pub keypoints: Vec<Keypoint>,
    /// Descriptor `i` belongs to keypoint `i`.
    pub descriptors: Descriptors,
    /// The keypoints without a descriptor; `index` refers to the input or detected keypoints.
    pub dropped: Vec<Dropped>,
    /// Number of features dropped because of the maximum number in the options.
    pub beyond_limit: usize,
    /// The keypoints before non-maximal suppression, for visualization; empty for methods without suppression.
    pub candidates: Vec<Keypoint>,
}

impl Features {
    /// Creates an empty set.
    pub fn new(kind: DescriptorKind) -> Self {
        Self {
            keypoints: Vec::new(),
            descriptors: Descriptors::new(kind),
            dropped: Vec::new(),
            beyond_limit: 0,
            candidates: Vec::new(),
        }
    }

    /// Returns the number of input or detected keypoints: those with a descriptor, dropped, and beyond the limit.
    pub fn detected_count(&self) -> usize {
        self.keypoints.len() + self.dropped.len() + self.beyond_limit
    }

    /// Retains the features for which `keep`, one flag per feature, is true.
    pub fn retain(&mut self, keep: &[bool]) {
        let d = self.descriptors.dimension();
        let mut which = keep.iter();
        self.keypoints.retain(|_| which.next() == Some(&true));
        let rows = self.descriptors.data.chunks_exact(d).zip(keep).filter(|(_, keep)| **keep);
        self.descriptors.data = rows.flat_map(|(row, _)| row).copied().collect();
    }

    /// Appends a feature; returns false, without appending, if the descriptor's dimension is not that of the kind.
    pub fn push(&mut self, keypoint: Keypoint, descriptor: &[f32]) -> bool {
        let has_dimension = descriptor.len() == self.descriptors.dimension();
        if has_dimension {
            self.keypoints.push(keypoint);
            self.descriptors.push(descriptor);
        }
        has_dimension
    }

    /// Appends a feature of another set and returns its new index; `None` if the kinds differ or the index is out of
    /// range.
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
