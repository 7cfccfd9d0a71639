//! Masks of photographs with a known registration, and in registration.

use super::order::Order;
use super::{PanoramaError, PanoramaResult, composite, known_registration};
use crate::Progress;
use cv_core::{GrayU8, ImageView, Point2, Scaling};
use cv_features::Features;
use cv_panorama::{CompositingOptions, PhotoMask, PhotoSample, PhotoUse, Registration, check_masks};

/// As [`panorama_with`](super::panorama_with), with the masks of the photographs; fewer than photographs where the last have none.
///
/// # Errors
/// [`PanoramaError`].
pub fn panorama_with_masks<T: PhotoSample>(
    registration: &Registration,
    photos: &[ImageView<'_, T, 3>],
    masks: &[Option<&PhotoMask>],
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    let sizes: Vec<_> = photos.iter().map(ImageView::size).collect();
    registration.check_photographs(&sizes)?;
    check_masks(|index| sizes.get(index).copied().unwrap_or((0, 0)), masks)?;
    let masks: Vec<_> = (0..photos.len()).map(|index| masks.get(index).copied().flatten()).collect();
    let order = Order::of(photos);
    let (photos, masks, sizes) = (order.sorted(photos), order.sorted(&masks), order.sorted(&sizes));
    let alignment = order.sorted_alignment(registration.alignment());
    let found = known_registration(alignment, &sizes);
    composite(&photos, &masks, found, options, progress).map(|result| order.restored_result(result))
}

/// Drops the features of removed pixels; their photograph is `factor` times as large as the image of the features.
pub(super) fn drop_removed(features: &mut Features, mask: &PhotoMask, factor: f64) {
    let keep: Vec<bool> = features.keypoints.iter().map(|k| !is_removed(k.position, mask, factor)).collect();
    features.retain(&keep);
}

/// Makes the removed pixels white: clipped ones, which [`cv_panorama::refine_alignment`] does not compare.
pub(super) fn clip_removed(gray: &mut GrayU8, mask: &PhotoMask, factor: f64) {
    for y in 0..gray.height() {
        for (x, value) in gray.row_mut(y).iter_mut().enumerate() {
            if is_removed(Point2::new(x as f32, y as f32), mask, factor) {
                *value = u8::MAX;
            }
        }
    }
}

/// Returns whether a position of an image is removed, of whose photograph this is the mask; that is `factor` times as large.
fn is_removed(position: Point2<f32>, mask: &PhotoMask, factor: f64) -> bool {
    let p = Scaling::uniform(factor).point_f32(position);
    mask.at(p.x.round().max(0.0) as usize, p.y.round().max(0.0) as usize) == PhotoUse::Remove
}
