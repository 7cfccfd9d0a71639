//! What many views need of a photograph.

use crate::{Progress, extract_features};
use cv_core::{ImageView, Keypoint};
use cv_features::{ByteDescriptors, FeatureError, FeatureOptions};

/// The features of a photograph, and what is known of it.
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
    /// The descriptor of each.
    pub descriptors: ByteDescriptors,
    /// The color at each.
    pub colors: Vec<[u8; 3]>,
}

/// Why a photograph has no features for many views.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum SfmPhotoError {
    /// The photograph cannot be looked at.
    #[error(transparent)]
    Features(#[from] FeatureError),
    /// The descriptors cannot be rounded to bytes.
    #[error("{kind} descriptors have no scale to round them to bytes")]
    NoByteScale {
        /// Name of their kind.
        kind: &'static str,
    },
}

/// The features of a photograph and their colors: the photograph itself is not needed any more.
///
/// # Errors
/// [`SfmPhotoError`] for a photograph smaller than the method's window, for options out of range, and methods without [`DescriptorKind::bytes`](cv_features::DescriptorKind::bytes).
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
    let near = |v: f32, n: usize| v.round().clamp(0.0, n.saturating_sub(1) as f32) as usize;
    let color = |k: &Keypoint| {
        photo.get(near(k.position.x, photo.width()), near(k.position.y, photo.height())).unwrap_or([0; 3])
    };
    let colors = features.keypoints.iter().map(color).collect();
    Ok(SfmPhoto { name, size: photo.size(), camera, keypoints: features.keypoints, descriptors, colors })
}
