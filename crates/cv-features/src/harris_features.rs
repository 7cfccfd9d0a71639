//! Harris corners with adaptive non-maximal suppression and upright patches.

use crate::{
    DescriptorKind, FeatureError, FeatureExtractor, Features, HarrisOptions, PatchOptions, anms, anms_square_covering,
    anms_tiled, describe_patches, harris,
};
use cv_core::{ImageView, Progress};

/// The non-maximal suppression that distributes Harris corners over the image.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Suppression {
    /// Adaptive non-maximal suppression by radius (Brown, Szeliski & Winder): [`anms`].
    Radius {
        /// Robustness factor, 0 to 1; default 0.9 (Brown, Szeliski & Winder).
        robust: f32,
    },
    /// Suppression via square covering (Bailo et al.), faster and nearly as uniform: [`anms_square_covering`].
    SquareCovering,
    /// Equal counts from 8 × 8 tiles: [`anms_tiled`].
    Tiles,
}

cv_core::named!(Suppression {
    Radius { robust: 0.9 } = "radius": "by suppression radius",
    SquareCovering = "squares": "by square covering: faster, nearly as even",
    Tiles = "tiles": "as many from each of 8×8 tiles",
});

impl Default for Suppression {
    fn default() -> Self {
        Self::Radius { robust: 0.9 }
    }
}

/// Options of Harris corners with upright patches.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct HarrisFeatures {
    /// Maximum number of features, 1 or more; default 500 (Brown, Szeliski & Winder).
    pub max_features: usize,
    /// Options of the detector.
    pub corners: HarrisOptions,
    /// The non-maximal suppression. Default by radius.
    pub suppression: Suppression,
    /// Options of the descriptor.
    pub patch: PatchOptions,
}

impl Default for HarrisFeatures {
    fn default() -> Self {
        Self {
            max_features: 500,
            corners: HarrisOptions::default(),
            suppression: Suppression::default(),
            patch: PatchOptions::default(),
        }
    }
}

impl FeatureExtractor for HarrisFeatures {
    fn extract(&self, image: ImageView<'_, f32, 1>, progress: &dyn Progress) -> Result<Features, FeatureError> {
        let corners = harris(image, &self.corners, progress)?;
        let selected = match self.suppression {
            Suppression::Radius { robust } => anms(&corners, self.max_features, robust),
            Suppression::SquareCovering => anms_square_covering(&corners, self.max_features),
            Suppression::Tiles => anms_tiled(&corners, self.max_features, (8, 8)),
        };
        let selected: Vec<_> = selected.into_iter().map(|i| corners[i]).collect();
        let described = describe_patches(image, &selected, &self.patch)?;
        Ok(Features { beyond_limit: corners.len() - selected.len(), candidates: corners, ..described })
    }

    fn kind(&self) -> DescriptorKind {
        DescriptorKind::PATCH
    }
}
