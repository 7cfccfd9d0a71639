//! Small copies of photographs for people to look at.

use cv_core::{ImageView, RgbU8};

/// The photograph reduced so that its longer side is at most `side` pixels, and the factor; itself where it is small
/// enough. A point at `x` is at `(x + 0.5) · factor − 0.5` in the copy.
pub fn preview(photo: ImageView<'_, u8, 3>, side: usize) -> (RgbU8, f64) {
    let (width, height) = photo.size();
    let longer = width.max(height);
    if longer <= side {
        return (photo.to_image(), 1.0);
    }
    let factor = side as f64 / longer as f64;
    let scaled = |n: usize| ((n as f64 * factor).round() as usize).max(1);
    match cv_imgproc::resize_area(photo, scaled(width), scaled(height)) {
        Ok(image) => (image, factor),
        // Smaller than what is in memory already: cannot be too large.
        Err(_) => (photo.to_image(), 1.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longer_side_fits_and_small_ones_stay() {
        let image = RgbU8::new(100, 40, [1, 2, 3]);
        let (small, factor) = preview(image.view(), 50);
        assert_eq!((small.size(), factor, small.at(3, 3)), ((50, 20), 0.5, [1, 2, 3]));
        assert_eq!(preview(image.view(), 100), (image.clone(), 1.0));
        assert_eq!(preview(RgbU8::new(1000, 1, [0; 3]).view(), 10).0.size(), (10, 1));
        assert_eq!(preview(RgbU8::new(0, 5, [0; 3]).view(), 10).0.size(), (0, 5));
    }
}
