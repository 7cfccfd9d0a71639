//! Harris and Shi–Tomasi corners.
//!
//! Sources: C. Harris & M. Stephens, "A combined corner and edge detector", Alvey Vision Conference 1988; J. Shi & C. Tomasi, "Good features to
//! track", CVPR 1994.

use crate::error::{FeatureError, check_image};
use crate::line_buffer::LineBuffer;
use crate::simd;
use crate::structure_tensor::{RowStream, StructureTensor};
use cv_core::{Cancelled, GrayF32, ImageView, Keypoint, OptionError, Progress, Stage};
use cv_imgproc::gaussian_half_kernel;
use cv_parallel::prelude::*;
use fearless_simd::Level;
use std::ops::Range;

/// The corner measure, a function of the eigenvalues λ₁ ≤ λ₂ of the structure tensor.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum CornerMeasure {
    /// λ₁λ₂ − k·(λ₁ + λ₂)² (Harris & Stephens).
    Harris {
        /// Weight of the squared trace. 0 to 0.25; usually 0.04 (Harris & Stephens' range is 0.04 to 0.06).
        k: f32,
    },
    /// λ₁ (Shi & Tomasi): more corners on weak texture for the same relative threshold.
    ShiTomasi,
}

cv_core::named!(CornerMeasure { Harris { k: 0.04 } = "harris", ShiTomasi = "shi-tomasi" });

/// Options of [`harris`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct HarrisOptions {
    /// The corner measure. Default Harris with `k` = 0.04.
    pub measure: CornerMeasure,
    /// Sigma in pixels of the Gaussian window of the gradient products (integration scale). 0.3 to 20; default 1:
    /// Brown, Szeliski & Winder use 1.5 for gradients without the smoothing of the Sobel mask.
    pub window_sigma: f32,
    /// Minimum response relative to the maximum response. 0 to 1; default 0.01, the usual value (OpenCV's tutorials and
    /// `goodFeaturesToTrack`).
    pub threshold: f32,
}

impl Default for HarrisOptions {
    fn default() -> Self {
        Self { measure: CornerMeasure::Harris { k: 0.04 }, window_sigma: 1.0, threshold: 0.01 }
    }
}

impl HarrisOptions {
    fn check(&self) -> Result<(), OptionError> {
        if let CornerMeasure::Harris { k } = self.measure {
            OptionError::check("k", k.into(), "from 0 to 0.25", |v| (0.0..=0.25).contains(&v))?;
        }
        OptionError::check("window_sigma", self.window_sigma.into(), "from 0.3 to 20 px", |v| {
            (0.3..=20.0).contains(&v)
        })?;
        OptionError::check("threshold", self.threshold.into(), "from 0 to 1", |v| (0.0..=1.0).contains(&v))
    }

    fn plan<'a>(&self, view: ImageView<'a, f32, 1>, level: Level) -> StructureTensor<'a> {
        StructureTensor { view, kernel: gaussian_half_kernel(self.window_sigma), measure: self.measure, level }
    }
}

/// Minimum image side: one pixel with all eight neighbors.
const MIN_SIDE: usize = 3;

/// Returns the number of rows of a parallel task: large enough for a small overlap of the windows, small enough for
/// load balancing.
fn rows_per_task(h: usize) -> usize {
    h.div_ceil(4 * rayon::current_num_threads()).max(48)
}

/// Computes the corner measure of every pixel: for Harris `det M − k·(trace M)²`, for Shi & Tomasi the smaller
/// eigenvalue of M.
///
/// The structure tensor M is the Gaussian-weighted sum of gradient products, with gradients by the 3×3 Sobel mask
/// divided by 8 (so that a ramp of slope s has gradient s). Borders are mirrored (OpenCV's BORDER_REFLECT_101).
///
/// # Errors
/// [`FeatureError`] for images below 3×3, pixels that are not finite, options out of range.
pub fn harris_response(view: ImageView<'_, f32, 1>, options: &HarrisOptions) -> Result<GrayF32, FeatureError> {
    options.check()?;
    check_image(view, MIN_SIDE)?;
    Ok(response(&options.plan(view, simd::level())))
}

fn response(plan: &StructureTensor<'_>) -> GrayF32 {
    let (w, h) = plan.view.size();
    let mut out = GrayF32::new(w, h, [0.0]);
    let rows = rows_per_task(h);
    out.as_mut_slice().par_chunks_mut(rows * w).enumerate().for_each(|(i, strip)| {
        let mut stream = RowStream::new(plan, i * rows);
        strip.chunks_exact_mut(w).enumerate().for_each(|(y, row)| stream.row(i * rows + y, row));
    });
    out
}

/// Detects corners: local maxima of [`harris_response`] above a threshold relative to the maximum, with sub-pixel
/// positions, in raster order.
///
/// A corner is an interior pixel whose response is not exceeded in its 3×3 neighborhood; of a plateau, the first pixel
/// in raster order. Its position is refined to the maximum of a quadratic fitted to the nine responses, at most half a
/// pixel away. A flat image has no corners. No full-size response image is stored.
///
/// # Errors
/// As [`harris_response`].
pub fn harris(
    view: ImageView<'_, f32, 1>,
    options: &HarrisOptions,
    progress: &dyn Progress,
) -> Result<Vec<Keypoint>, FeatureError> {
    options.check()?;
    check_image(view, MIN_SIDE)?;
    Ok(corners(&options.plan(view, simd::level()), options.threshold, progress)?)
}

/// Detects the local maxima of the measure above `threshold` relative to the maximum, in raster order.
pub(crate) fn corners(
    plan: &StructureTensor<'_>,
    threshold: f32,
    progress: &dyn Progress,
) -> Result<Vec<Keypoint>, Cancelled> {
    let h = plan.view.height();
    let stage = Stage::new(progress, "corners", h)?;
    let rows = rows_per_task(h);
    let strips: Vec<(f32, Vec<Keypoint>)> = (0..h.div_ceil(rows))
        .into_par_iter()
        .map(|i| strip_corners(plan, threshold, i * rows..((i + 1) * rows).min(h), &stage))
        .try_collect()?;
    let max = strips.iter().fold(0.0f32, |m, s| m.max(s.0));
    let mut corners: Vec<Keypoint> = strips.into_iter().flat_map(|s| s.1).collect();
    corners.retain(|c| c.response >= threshold * max);
    Ok(corners)
}

/// Computes the maximum response of a strip of rows, and its corners above the threshold relative to that maximum (a
/// superset of the final ones).
fn strip_corners(
    plan: &StructureTensor<'_>,
    threshold: f32,
    rows: Range<usize>,
    stage: &Stage<'_>,
) -> Result<(f32, Vec<Keypoint>), Cancelled> {
    let (w, h) = plan.view.size();
    let (first, last) = (rows.start.saturating_sub(1), (rows.end + 1).min(h));
    let mut stream = RowStream::new(plan, first);
    let mut buffer = LineBuffer::new(0..w, 3);
    let (mut max, mut peaks, mut found) = (0.0f32, Vec::new(), Vec::new());
    for y in first..last {
        stage.add(usize::from(rows.contains(&y)))?;
        stream.row(y, buffer.row_mut(y));
        max = simd::maximum(plan.level, buffer.row(y), max);
        if y < first + 2 {
            continue;
        }
        // The previous row now has both neighbors.
        let [above, here, below] = [y - 2, y - 1, y].map(|y| buffer.row(y));
        peaks.clear();
        simd::peaks(plan.level, [above, here, below], threshold * max, &mut peaks);
        for &x in &peaks {
            let v = here[x];
            // The first pixel of a plateau.
            if v > above[x - 1] && v > above[x] && v > above[x + 1] && v > here[x - 1] {
                let (dx, dy) = quadratic_peak([above, here, below].map(|r| [r[x - 1], r[x], r[x + 1]]));
                found.push(Keypoint::new(x as f32 + dx, (y - 1) as f32 + dy, v));
            }
        }
    }
    Ok((max, found))
}

/// Computes the offset from the center of the maximum of a quadratic fitted to 3×3 values (least squares for the cross
/// term), each coordinate clamped to ±0.5.
pub(crate) fn quadratic_peak(v: [[f32; 3]; 3]) -> (f32, f32) {
    // Relative to the center, for numerical precision.
    let v = v.map(|r| r.map(|a| f64::from(a) - f64::from(v[1][1])));
    let gx = 0.5 * (v[1][2] - v[1][0]);
    let gy = 0.5 * (v[2][1] - v[0][1]);
    let xx = v[1][2] + v[1][0];
    let yy = v[2][1] + v[0][1];
    let xy = 0.25 * (v[2][2] - v[2][0] - v[0][2] + v[0][0]);
    let det = xx * yy - xy * xy;
    let clamp = |a: f64| if a.is_finite() { a.clamp(-0.5, 0.5) as f32 } else { 0.0 };
    if det > 0.0 && xx < 0.0 {
        (clamp((xy * gy - yy * gx) / det), clamp((xy * gx - xx * gy) / det))
    } else {
        // Not a two-dimensional maximum (a ridge): each axis separately.
        (clamp(-gx / xx), clamp(-gy / yy))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::structure_tensor::{harris_measure, products_at, smaller_eigenvalue};
    use cv_core::{Image, Silent};
    use cv_imgproc::gaussian_blur;
    use cv_imgproc::mirror_index;
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    /// Reference: the definition, by whole-image passes.
    fn plain_response(view: ImageView<'_, f32, 1>, options: &HarrisOptions) -> GrayF32 {
        let (w, h) = view.size();
        let product = |i: usize| {
            GrayF32::from_fn(w, h, |x, y| {
                [products_at([-1, 0, 1].map(|dy| view.row(mirror_index(y as isize + dy, h))), x)[i]]
            })
        };
        let [xx, xy, yy] = [0, 1, 2].map(|i| gaussian_blur(product(i).view(), options.window_sigma));
        GrayF32::from_fn(w, h, |x, y| {
            let ([xx], [xy], [yy]) = (xx.at(x, y), xy.at(x, y), yy.at(x, y));
            [match options.measure {
                CornerMeasure::Harris { k } => harris_measure(xx, xy, yy, k),
                CornerMeasure::ShiTomasi => smaller_eigenvalue(xx, xy, yy),
            }]
        })
    }

    /// Reference: the corners by the definition of [`harris`].
    fn plain_corners(response: &GrayF32, threshold: f32) -> Vec<Keypoint> {
        let (w, h) = response.size();
        let max = response.as_slice().iter().fold(0.0f32, |m, &v| m.max(v));
        let mut corners = Vec::new();
        for y in 1..h - 1 {
            for x in 1..w - 1 {
                let around = [y - 1, y, y + 1].map(|y| [x - 1, x, x + 1].map(|x| response.at(x, y)[0]));
                let v = around[1][1];
                let before = around.iter().flatten().take(4).all(|&o| v > o);
                let after = around.iter().flatten().skip(5).all(|&o| v >= o);
                if v > 0.0 && v >= threshold * max && before && after {
                    let (dx, dy) = quadratic_peak(around);
                    corners.push(Keypoint::new(x as f32 + dx, y as f32 + dy, v));
                }
            }
        }
        corners
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn streaming_equals_whole_image_passes(
            w in 3usize..90, h in 3usize..150, sigma in 0.3f32..3.0, cell in 1usize..9, seed in any::<u32>(), shi in any::<bool>()
        ) {
            // Squares of random gray: corners, plateaus and flat regions.
            let image = GrayF32::from_fn(w, h, |x, y| {
                let mut v = ((x / cell) as u32).wrapping_mul(0x9E37_79B9) ^ ((y / cell) as u32).wrapping_mul(0x85EB_CA6B) ^ seed;
                v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
                v = (v ^ (v >> 12)).wrapping_mul(0x297A_2D39);
                [((v ^ (v >> 15)) >> 28) as f32 / 15.0]
            });
            let measure = if shi { CornerMeasure::ShiTomasi } else { CornerMeasure::Harris { k: 0.05 } };
            let options = HarrisOptions { measure, window_sigma: sigma, ..HarrisOptions::default() };
            let expected = plain_response(image.view(), &options);
            let expected_corners = plain_corners(&expected, options.threshold);
            for level in instruction_sets() {
                let plan = options.plan(image.view(), level);
                prop_assert_eq!(&response(&plan), &expected, "{:?}", level);
                prop_assert_eq!(&corners(&plan, options.threshold, &Silent).unwrap(), &expected_corners, "{:?}", level);
                // Independent of the strip boundaries.
                let mut stream = RowStream::new(&plan, h / 2);
                let mut row = vec![0.0; w];
                stream.row(h / 2, &mut row);
                prop_assert_eq!(&row[..], expected.row(h / 2), "{:?}", level);
            }
        }
    }

    #[test]
    fn a_square_has_four_corners() {
        let image =
            GrayF32::from_fn(40, 30, |x, y| [if (10..25).contains(&x) && (8..20).contains(&y) { 0.8 } else { 0.2 }]);
        for measure in [CornerMeasure::Harris { k: 0.04 }, CornerMeasure::ShiTomasi] {
            let mut corners =
                harris(image.view(), &HarrisOptions { measure, threshold: 0.1, ..HarrisOptions::default() }, &Silent)
                    .unwrap();
            corners.sort_by(|a, b| b.response.total_cmp(&a.response));
            // The edges are half-way between pixels: (9.5, 7.5) to (24.5, 19.5). The Harris maximum of a right angle
            // with a window of sigma 1 is inside the corner by less than sigma.
            for (x, y) in [(9.5, 7.5), (24.5, 7.5), (9.5, 19.5), (24.5, 19.5)] {
                let inside =
                    corners[..4].iter().filter(|c| (c.position.x - x).abs() < 1.0 && (c.position.y - y).abs() < 1.0);
                assert_eq!(inside.count(), 1, "near ({x}, {y}) in {corners:?}");
            }
            assert_eq!(corners.len(), 4);
        }
    }

    #[test]
    fn flat_images_have_no_corners_and_invalid_images_are_rejected() {
        let options = HarrisOptions::default();
        assert_eq!(harris(GrayF32::new(20, 20, [0.3]).view(), &options, &Silent), Ok(vec![]));
        for (w, h) in [(0, 0), (1, 1), (2, 50), (0, 9)] {
            assert_eq!(
                harris(GrayF32::new(w, h, [0.5]).view(), &options, &Silent),
                Err(FeatureError::ImageTooSmall { width: w, height: h, needed: 3 })
            );
        }
        for bad in [f32::NAN, f32::INFINITY] {
            let mut image = GrayF32::new(20, 20, [0.3]);
            image.set(7, 5, [bad]);
            assert_eq!(harris(image.view(), &options, &Silent), Err(FeatureError::NotFinite { x: 7, y: 5 }));
        }
        let bad = HarrisOptions { window_sigma: f32::NAN, ..options };
        assert!(matches!(
            harris(Image::new(9, 9, [0.0]).view(), &bad, &Silent),
            Err(FeatureError::Option(OptionError { name: "window_sigma", .. }))
        ));
    }

    #[test]
    fn the_maximum_of_a_quadratic_is_exact() {
        let f =
            |x: f32, y: f32| 5.0 - (x - 0.3) * (x - 0.3) - 2.0 * (y + 0.2) * (y + 0.2) + 0.5 * (x - 0.3) * (y + 0.2);
        let v = [-1.0, 0.0, 1.0].map(|y| [-1.0, 0.0, 1.0].map(|x| f(x, y)));
        let (dx, dy) = quadratic_peak(v);
        // f32 values of order 5, differences of order 1: five digits remain.
        assert!((dx - 0.3).abs() < 1e-5 && (dy + 0.2).abs() < 1e-5, "{dx} {dy}");
        assert_eq!(quadratic_peak([[0.0; 3]; 3]), (0.0, 0.0));
    }
}
