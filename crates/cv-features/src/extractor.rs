//! Methods that find and describe features: ours, and those of other crates.

use crate::{DescriptorKind, FeatureError, Features, HarrisFeatures, MopsOptions, SiftOptions};
use cv_core::{ImageView, Progress};
use std::sync::Arc;

/// A method that finds the features of an image and describes them. The same image gives the same features at any number of threads.
///
/// Its options are the type itself. `tests/own_descriptor.rs` of this crate holds a small one.
pub trait FeatureExtractor: std::fmt::Debug + Send + Sync {
    /// Features of a gray image of 0 to 1. An image without any is no error.
    ///
    /// # Errors
    /// [`FeatureError`] for images that the method cannot work on, and options out of range.
    fn extract(&self, image: ImageView<'_, f32, 1>, progress: &dyn Progress) -> Result<Features, FeatureError>;

    /// The kind of its descriptors.
    fn kind(&self) -> DescriptorKind;
}

/// The methods of this crate, by name.
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

/// A method with its options.
#[derive(Debug, Clone)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum FeatureOptions {
    /// Harris corners with upright 8×8 patches: fast, for neighboring frames of a film or a slowly turned camera.
    Harris(HarrisFeatures),
    /// Corners at all scales with oriented 8×8 patches: for photographs that turn and zoom a little, at half the time of SIFT.
    Mops(MopsOptions),
    /// rootSIFT: for photographs that turn, zoom, or change light or viewpoint.
    Sift(SiftOptions),
    /// A method of another crate; not written as data.
    #[cfg_attr(feature = "serde", serde(skip))]
    Other(Arc<dyn FeatureExtractor>),
}

/// SIFT, which works on a stranger's photographs without knowing anything about them.
impl Default for FeatureOptions {
    fn default() -> Self {
        FeatureMethod::default().into()
    }
}

/// The defaults for matching photographs: of more SIFT features than asked for, the coarse ones stay (COLMAP's choice).
impl From<FeatureMethod> for FeatureOptions {
    fn from(method: FeatureMethod) -> Self {
        match method {
            FeatureMethod::Harris => Self::Harris(HarrisFeatures::default()),
            FeatureMethod::Mops => Self::Mops(MopsOptions::default()),
            FeatureMethod::Sift => Self::Sift(SiftOptions { coarse_first: true, ..SiftOptions::default() }),
        }
    }
}

/// Methods of other crates are the same where they are one value.
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
    /// The method.
    pub fn extractor(&self) -> &dyn FeatureExtractor {
        match self {
            Self::Harris(options) => options,
            Self::Mops(options) => options,
            Self::Sift(options) => options,
            Self::Other(method) => method.as_ref(),
        }
    }

    /// The same with another largest number of features in a photograph; methods of other crates stay as they are.
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
