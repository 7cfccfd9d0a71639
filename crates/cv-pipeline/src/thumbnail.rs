//! Small copies of photographs, for reports.

use cv_core::{ImageView, RgbU8};
use cv_imgproc::resize_area;

/// A copy whose longer side has at most `longest` pixels, each the mean of what it covers; a smaller photograph is copied as it is.
pub fn thumbnail(photo: ImageView<'_, u8, 3>, longest: usize) -> RgbU8 {
    let (w, h) = photo.size();
    let longer = w.max(h);
    if longer <= longest {
        return photo.to_image();
    }
    let scaled = |n: usize| {
        ((n as f64 * longest as f64 / longer as f64).round() as usize).max(usize::from(n > 0 && longest > 0))
    };
    // A smaller image than the one that is there fits into memory.
    resize_area(photo, scaled(w), scaled(h)).unwrap_or_else(|_| photo.to_image())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longer_side_is_limited_and_the_shape_kept() {
        let size = |w, h, n| thumbnail(RgbU8::new(w, h, [9; 3]).view(), n).size();
        assert_eq!(size(400, 200, 100), (100, 50));
        assert_eq!(size(200, 400, 100), (50, 100));
        assert_eq!(size(80, 50, 100), (80, 50));
        assert_eq!(size(5000, 1, 100), (100, 1));
        assert_eq!(size(0, 300, 100), (0, 100));
        assert_eq!(size(30, 30, 0), (0, 0));
    }
}
