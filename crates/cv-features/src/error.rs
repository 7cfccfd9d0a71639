//! What can be wrong with an image handed to a detector or descriptor.

use cv_core::ImageView;

/// Why an image has no features to give.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum FeatureError {
    /// The image is smaller than the smallest window the method looks at.
    #[error("a {width}×{height} image is smaller than the {needed}×{needed} pixels this method needs")]
    ImageTooSmall {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
        /// Smallest side the method can work on.
        needed: usize,
    },
    /// A sample is NaN or infinite.
    #[error("the pixel at column {x}, row {y} is not a finite number")]
    NotFinite {
        /// Column of the first such pixel.
        x: usize,
        /// Its row.
        y: usize,
    },
    /// An option is outside its range.
    #[error("option {name} = {value} is outside its range ({range})")]
    BadOption {
        /// Name of the field.
        name: &'static str,
        /// Its value.
        value: f64,
        /// The range in words.
        range: &'static str,
    },
}

/// Refuses images with a side below `needed` or with a sample that is not finite.
pub(crate) fn check_image(view: ImageView<'_, f32, 1>, needed: usize) -> Result<(), FeatureError> {
    let (width, height) = view.size();
    if width < needed || height < needed {
        return Err(FeatureError::ImageTooSmall { width, height, needed });
    }
    for y in 0..height {
        // v·0 is 0 for every finite v and NaN for the rest: a sum that vectorises.
        let row = view.row(y);
        if row.iter().map(|v| v * 0.0).fold(false, |bad, z| bad | (z != 0.0))
            && let Some(x) = row.iter().position(|v| !v.is_finite())
        {
            return Err(FeatureError::NotFinite { x, y });
        }
    }
    Ok(())
}

/// Refuses an option outside `ok`.
pub(crate) fn check_option(
    name: &'static str,
    value: f64,
    range: &'static str,
    ok: impl Fn(f64) -> bool,
) -> Result<(), FeatureError> {
    if ok(value) { Ok(()) } else { Err(FeatureError::BadOption { name, value, range }) }
}
