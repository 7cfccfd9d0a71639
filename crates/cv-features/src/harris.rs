//! Harris corners.
//!
//! Source: C. Harris & M. Stephens, "A combined corner and edge detector", Alvey Vision Conference 1988.

use crate::error::{FeatureError, check_image, check_option};
use crate::rows::mirror;
use cv_core::{GrayF32, ImageView, Keypoint};
use cv_imgproc::gaussian_blur;

/// Settings of [`harris`].
#[derive(Debug, Clone, PartialEq)]
pub struct HarrisOptions {
    /// Weight of the squared trace in `det − k·trace²`. 0 to 0.25; default 0.04 (Harris & Stephens' range is 0.04 to 0.06).
    pub k: f32,
    /// Standard deviation of the Gaussian window over the gradient products, in pixels. 0.3 to 20; default 1, the integration
    /// scale that Brown, Szeliski & Winder pair with single-pixel gradients (their 1.5, less what the Sobel mask smooths).
    pub window_sigma: f32,
    /// Corners weaker than this share of the strongest response are left out. 0 to 1; default 0.01, the usual value
    /// (OpenCV's tutorials and `goodFeaturesToTrack`).
    pub threshold: f32,
}

impl Default for HarrisOptions {
    fn default() -> Self {
        Self { k: 0.04, window_sigma: 1.0, threshold: 0.01 }
    }
}

impl HarrisOptions {
    fn check(&self) -> Result<(), FeatureError> {
        check_option("k", self.k.into(), "0 to 0.25", |v| (0.0..=0.25).contains(&v))?;
        check_option("window_sigma", self.window_sigma.into(), "0.3 to 20 px", |v| (0.3..=20.0).contains(&v))?;
        check_option("threshold", self.threshold.into(), "0 to 1", |v| (0.0..=1.0).contains(&v))
    }
}

/// The smallest image with a pixel that has all its eight neighbours.
const SMALLEST: usize = 3;

/// The Harris response `det M − k·(trace M)²` of every pixel.
///
/// M is the Gaussian-weighted sum of gradient products, the gradient being the 3×3 Sobel mask divided by 8 (so that a ramp of slope s
/// has gradient s). Borders are mirrored (OpenCV's BORDER_REFLECT_101).
///
/// # Errors
/// [`FeatureError`] for images below 3×3, samples that are not finite, options out of range.
pub fn harris_response(view: ImageView<'_, f32, 1>, options: &HarrisOptions) -> Result<GrayF32, FeatureError> {
    options.check()?;
    check_image(view, SMALLEST)?;
    let (w, h) = view.size();
    let mut products = [(); 3].map(|()| GrayF32::new(w, h, [0.0]));
    for y in 0..h {
        let rows = [-1, 0, 1].map(|dy| view.row(mirror(y as isize + dy, h)));
        for x in 0..w {
            let (l, r) = (mirror(x as isize - 1, w), mirror(x as isize + 1, w));
            let [a, b, c] = rows;
            let gx = ((a[r] - a[l]) + 2.0 * (b[r] - b[l]) + (c[r] - c[l])) * 0.125;
            let gy = ((c[l] - a[l]) + 2.0 * (c[x] - a[x]) + (c[r] - a[r])) * 0.125;
            products[0].set(x, y, [gx * gx]);
            products[1].set(x, y, [gx * gy]);
            products[2].set(x, y, [gy * gy]);
        }
    }
    let [xx, xy, yy] = products.map(|p| gaussian_blur(p.view(), options.window_sigma));
    Ok(GrayF32::from_fn(w, h, |x, y| {
        let ([xx], [xy], [yy]) = (xx.at(x, y), xy.at(x, y), yy.at(x, y));
        let trace = xx + yy;
        [xx * yy - xy * xy - options.k * trace * trace]
    }))
}

/// Harris corners: local maxima of [`harris_response`] above a share of the strongest, with sub-pixel positions, in raster order.
///
/// A corner is a pixel (not of the outermost ring) whose response is not exceeded in its 3×3 neighbourhood; of a plateau, the first
/// pixel in raster order. Its position is refined to the maximum of the quadratic through the nine responses, at most
/// half a pixel away. A flat image has no corners: the result is empty.
///
/// # Errors
/// As [`harris_response`].
pub fn harris(view: ImageView<'_, f32, 1>, options: &HarrisOptions) -> Result<Vec<Keypoint>, FeatureError> {
    let response = harris_response(view, options)?;
    let (w, h) = response.size();
    let max = response.as_slice().iter().fold(0.0f32, |m, &v| m.max(v));
    let least = options.threshold * max;
    let mut corners = Vec::new();
    for y in 1..h - 1 {
        let [above, here, below] = [response.row(y - 1), response.row(y), response.row(y + 1)];
        for x in 1..w - 1 {
            let v = here[x];
            if v > 0.0
                && v >= least
                && v > above[x - 1]
                && v > above[x]
                && v > above[x + 1]
                && v > here[x - 1]
                && v >= here[x + 1]
                && v >= below[x - 1]
                && v >= below[x]
                && v >= below[x + 1]
            {
                let (dx, dy) = quadratic_peak([above, here, below].map(|r| [r[x - 1], r[x], r[x + 1]]));
                corners.push(Keypoint::new(x as f32 + dx, y as f32 + dy, v));
            }
        }
    }
    Ok(corners)
}

/// Offset from the middle of the maximum of the quadratic through 3×3 values (least squares for the cross term), each part held to ±0.5.
pub(crate) fn quadratic_peak(v: [[f32; 3]; 3]) -> (f32, f32) {
    // Relative to the centre, so that the differences keep their digits.
    let v = v.map(|r| r.map(|a| f64::from(a) - f64::from(v[1][1])));
    let gx = 0.5 * (v[1][2] - v[1][0]);
    let gy = 0.5 * (v[2][1] - v[0][1]);
    let xx = v[1][2] + v[1][0];
    let yy = v[2][1] + v[0][1];
    let xy = 0.25 * (v[2][2] - v[2][0] - v[0][2] + v[0][0]);
    let det = xx * yy - xy * xy;
    let hold = |a: f64| if a.is_finite() { a.clamp(-0.5, 0.5) as f32 } else { 0.0 };
    if det > 0.0 && xx < 0.0 {
        (hold((xy * gy - yy * gx) / det), hold((xy * gx - xx * gy) / det))
    } else {
        // Not a peak in two dimensions (a ridge): each axis by itself.
        (hold(-gx / xx), hold(-gy / yy))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Image;

    #[test]
    fn a_square_has_its_four_corners() {
        let image =
            GrayF32::from_fn(40, 30, |x, y| [if (10..25).contains(&x) && (8..20).contains(&y) { 0.8 } else { 0.2 }]);
        let mut corners = harris(image.view(), &HarrisOptions::default()).unwrap();
        corners.sort_by(|a, b| b.response.total_cmp(&a.response));
        // Edges lie half-way between pixels: (9.5, 7.5) to (24.5, 19.5). The Harris maximum of a right angle smoothed by a window of
        // sigma about 1 lies inside the corner by less than that sigma.
        for (x, y) in [(9.5, 7.5), (24.5, 7.5), (9.5, 19.5), (24.5, 19.5)] {
            let inside =
                corners[..4].iter().filter(|c| (c.position.x - x).abs() < 1.0 && (c.position.y - y).abs() < 1.0);
            assert_eq!(inside.count(), 1, "near ({x}, {y}) in {corners:?}");
        }
        assert_eq!(corners.len(), 4);
    }

    #[test]
    fn flat_images_have_none_and_bad_ones_are_refused() {
        let options = HarrisOptions::default();
        assert_eq!(harris(GrayF32::new(20, 20, [0.3]).view(), &options), Ok(vec![]));
        for (w, h) in [(0, 0), (1, 1), (2, 50), (0, 9)] {
            assert_eq!(
                harris(GrayF32::new(w, h, [0.5]).view(), &options),
                Err(FeatureError::ImageTooSmall { width: w, height: h, needed: 3 })
            );
        }
        for bad in [f32::NAN, f32::INFINITY] {
            let mut image = GrayF32::new(20, 20, [0.3]);
            image.set(7, 5, [bad]);
            assert_eq!(harris(image.view(), &options), Err(FeatureError::NotFinite { x: 7, y: 5 }));
        }
        let bad = HarrisOptions { window_sigma: f32::NAN, ..options };
        assert!(matches!(
            harris(Image::new(9, 9, [0.0]).view(), &bad),
            Err(FeatureError::BadOption { name: "window_sigma", .. })
        ));
    }

    #[test]
    fn the_peak_of_a_quadratic_is_found_exactly() {
        let f =
            |x: f32, y: f32| 5.0 - (x - 0.3) * (x - 0.3) - 2.0 * (y + 0.2) * (y + 0.2) + 0.5 * (x - 0.3) * (y + 0.2);
        let v = [-1.0, 0.0, 1.0].map(|y| [-1.0, 0.0, 1.0].map(|x| f(x, y)));
        let (dx, dy) = quadratic_peak(v);
        // f32 values of order 5, differences of order 1: five digits remain.
        assert!((dx - 0.3).abs() < 1e-5 && (dy + 0.2).abs() < 1e-5, "{dx} {dy}");
        assert_eq!(quadratic_peak([[0.0; 3]; 3]), (0.0, 0.0));
    }
}
