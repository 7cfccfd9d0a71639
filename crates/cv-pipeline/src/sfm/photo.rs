//! What many views need of a photograph.

use crate::{Progress, extract_features};
use cv_core::ImageView;
use cv_features::{FeatureError, FeatureOptions, Features};

/// The features of a photograph, and what is known of it.
#[derive(Debug, Clone, PartialEq)]
pub struct SfmPhoto {
    /// Its name in the model.
    pub name: String,
    /// Width and height in pixels.
    pub size: (usize, usize),
    /// Index of its camera.
    pub camera: usize,
    /// Its features.
    pub features: Features,
    /// The color at each of them.
    pub colors: Vec<[u8; 3]>,
}

/// The features of a photograph and their colors: the photograph itself is not needed any more.
///
/// # Errors
/// [`FeatureError`] for a photograph smaller than the method's window and for options out of range.
pub fn sfm_photo(
    photo: ImageView<'_, u8, 3>,
    name: String,
    camera: usize,
    options: &FeatureOptions,
    progress: &dyn Progress,
) -> Result<SfmPhoto, FeatureError> {
    let features = extract_features(photo, options, progress)?;
    let near = |v: f32, n: usize| v.round().clamp(0.0, n.saturating_sub(1) as f32) as usize;
    let color =
        |p: cv_core::Point2<f32>| photo.get(near(p.x, photo.width()), near(p.y, photo.height())).unwrap_or([0; 3]);
    let colors = features.keypoints.iter().map(|k| color(k.position)).collect();
    Ok(SfmPhoto { name, size: photo.size(), camera, features, colors })
}
