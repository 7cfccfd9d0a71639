//! The features of a photograph for structure from motion.

use crate::{Progress, extract_features};
use cv_core::{ImageView, Keypoint};
use cv_features::{ByteDescriptors, FeatureError, FeatureOptions};

/// The features of a photograph, and its camera.
#[derive(Debug, Clone, PartialEq)]
pub struct SfmPhoto {
    /// Its name in the model.
    pub name: String,
    /// Width and height in pixels.
    pub size: (usize, usize),
    /// Index of its camera.
    pub camera: usize,
    /// Its keypoints.
    pub keypoints: Vec<Keypoint>,
    /// The descriptor of each keypoint.
    pub descriptors: ByteDescriptors,
    /// The color at each keypoint.
    pub colors: Vec<[u8; 3]>,
}

/// Why a photograph has no features for structure from motion.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum SfmPhotoError {
    /// Feature extraction failed.
    #[error(transparent)]
    Features(#[from] FeatureError),
    /// The descriptors cannot be quantized to bytes.
    #[error("{kind} descriptors have no scale for a quantization to bytes")]
    NoByteScale {
        /// Name of the descriptor kind.
        kind: &'static str,
    },
}

/// Extracts the features of a photograph and their colors. The photograph is not needed any more.
///
/// # Errors
/// [`SfmPhotoError`] for a photograph smaller than the method's window, options out of range, and methods without
/// [`DescriptorKind::bytes`](cv_features::DescriptorKind::bytes).
pub fn sfm_photo(
    photo: ImageView<'_, u8, 3>,
    name: String,
    camera: usize,
    options: &FeatureOptions,
    progress: &dyn Progress,
) -> Result<SfmPhoto, SfmPhotoError> {
    let features = extract_features(photo, options, progress)?;
    let kind = features.descriptors.kind().name;
    let descriptors = ByteDescriptors::new(&features.descriptors).ok_or(SfmPhotoError::NoByteScale { kind })?;
    let nearest = |v: f32, n: usize| v.round().clamp(0.0, n.saturating_sub(1) as f32) as usize;
    let color = |k: &Keypoint| {
        photo.get(nearest(k.position.x, photo.width()), nearest(k.position.y, photo.height())).unwrap_or([0; 3])
    };
    let colors = features.keypoints.iter().map(color).collect();
    Ok(SfmPhoto { name, size: photo.size(), camera, keypoints: features.keypoints, descriptors, colors })
}
