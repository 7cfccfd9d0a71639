//! Feature extractors: the built-in ones, and the trait for custom ones.

use crate::{DescriptorKind, FeatureError, Features, HarrisFeatures, MopsOptions, SiftOptions};
use cv_core::{ImageView, Progress};
use std::sync::Arc;

/// A feature detector with a descriptor. The result must not depend on the number of threads.
///
/// The implementing type is the options. See `tests/own_descriptor.rs` of this crate for an example.
pub trait FeatureExtractor: std::fmt::Debug + Send + Sync {
    /// Extracts the features of a gray image of 0 to 1. No features is not an error.
    ///
    /// # Errors
    /// [`FeatureError`] for unsuitable images and options out of range.
    fn extract(&self, image: ImageView<'_, f32, 1>, progress: &dyn Progress) -> Result<Features, FeatureError>;

    /// Returns the kind of the descriptors.
    fn kind(&self) -> DescriptorKind;
}

/// The built-in methods.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum FeatureMethod {
    /// [`FeatureOptions::Harris`].
    Harris,
    /// [`FeatureOptions::Mops`].
    Mops,
    /// [`FeatureOptions::Sift`].
    #[default]
    Sift,
}

cv_core::named!(FeatureMethod {
    Sift = "sift": "rootSIFT: photographs that turn, zoom, or change light or viewpoint",
    Mops = "mops": "corners at all scales with oriented 8×8 patches",
    Harris = "harris": "corners with upright 8×8 patches: neighboring frames of a film or of a slowly turned camera",
});

/// A method and its options.
#[derive(Debug, Clone)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum FeatureOptions {
    /// Harris corners with upright 8×8 patches: fast; for consecutive video frames or a slowly rotating camera.
    Harris(HarrisFeatures),
    /// Multi-scale corners with oriented 8×8 patches (MOPS): for moderate rotation and scale change, in half the time
    /// of SIFT.
    Mops(MopsOptions),
    /// rootSIFT: for changes of rotation, scale, illumination and viewpoint.
    Sift(SiftOptions),
    /// A custom method; not serialized.
    #[cfg_attr(feature = "serde", serde(skip))]
    Other(Arc<dyn FeatureExtractor>),
}

/// SIFT, which needs no prior knowledge of the images.
impl Default for FeatureOptions {
    fn default() -> Self {
        FeatureMethod::default().into()
    }
}

/// The defaults for image matching: if there are more SIFT features than the limit, those of the largest scale are kept
/// (as in COLMAP).
impl From<FeatureMethod> for FeatureOptions {
    fn from(method: FeatureMethod) -> Self {
        match method {
            FeatureMethod::Harris => Self::Harris(HarrisFeatures::default()),
            FeatureMethod::Mops => Self::Mops(MopsOptions::default()),
            FeatureMethod::Sift => Self::Sift(SiftOptions { coarse_first: true, ..SiftOptions::default() }),
        }
    }
}

/// Custom methods are equal if they are the same object.
impl PartialEq for FeatureOptions {
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Harris(a), Self::Harris(b)) => a == b,
            (Self::Mops(a), Self::Mops(b)) => a == b,
            (Self::Sift(a), Self::Sift(b)) => a == b,
            (Self::Other(a), Self::Other(b)) => Arc::ptr_eq(a, b),
            _ => false,
        }
    }
}

impl FeatureOptions {
    /// Returns the extractor.
    pub fn extractor(&self) -> &dyn FeatureExtractor {
        match self {
            Self::Harris(options) => options,
            Self::Mops(options) => options,
            Self::Sift(options) => options,
            Self::Other(method) => method.as_ref(),
        }
    }

    /// Sets the maximum number of features per image; custom methods are unchanged.
    #[must_use]
    pub fn at_most(mut self, features: usize) -> Self {
        match &mut self {
            Self::Harris(HarrisFeatures { max_features, .. })
            | Self::Mops(MopsOptions { max_features, .. })
            | Self::Sift(SiftOptions { max_features, .. }) => *max_features = features,
            Self::Other(_) => {}
        }
        self
    }
}
