//! Sub-pixel refinement of corners by their symmetry.
//!
//! Where two black and two white squares meet, an image is symmetric under a rotation by 180° about the corner: I(c + d) =
//! I(c − d). The position c minimizes the weighted squares of the differences over a window (Gauss–Newton). Perspective,
//! symmetric blur, and the camera's tone curve preserve the symmetry, so none of them causes a bias, and the variance is the
//! Cramér–Rao bound of a known corner. The equations are those of template matching (Gruen, "Adaptive least squares
//! correlation", 1985) with the rotated window as the template.
//!
//! The Förstner operator (the intersection of the edges' tangents, iterated), which OpenCV's `cornerSubPix` uses as well, has
//! twice the error on rendered boards, and converges to wrong positions if the blur is as wide as the window.

use crate::simd;
use cv_core::{ImageView, Point2, Vector2};
use fearless_simd::{Level, dispatch, f32x8, prelude::*};

/// A refined corner.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Saddle {
    pub(crate) position: Point2<f64>,
    /// Standard deviation along either axis, in pixels.
    pub(crate) deviation: f64,
}

impl Saddle {
    /// Returns the standard deviation for an image that was smoothed by `[1 2 1]/4` along both axes: the noise before
    /// smoothing was 1 / 0.375 times larger, and aliasing of sharp edges adds 0.01 px. Up to half too
    /// large on synthetic images (0.013 px without, 0.04 px with noise).
    pub(crate) fn deviation_unsmoothed(&self) -> f64 {
        (self.deviation / 0.375).hypot(0.01)
    }
}

/// Maximum number of iterations.
const MAX_ITERATIONS: usize = 30;

/// Maximum step of an iteration in pixels: about the width of a sharp edge, within which the equations hold.
const MAX_STEP: f64 = 1.0;

/// Minimum radius of a window in pixels.
const MIN_RADIUS: usize = 2;

/// Number of samples that are processed at once.
const LANES: usize = 8;

/// A window of interpolated intensities around a position, `side` × `side` samples with a spacing of a pixel, as the sum of
/// an even and an odd part under the rotation by 180°. Rows have `stride` values of which the last are zero: [`LANES`] at a
/// time, up to two past each sample.
#[derive(Default)]
struct Patch {
    values: Vec<f32>,
    even: Vec<f32>,
    odd: Vec<f32>,
    side: usize,
    stride: usize,
}

impl Patch {
    /// Samples the window with the given radius; `None` if it extends beyond the image.
    fn sample(&mut self, view: ImageView<'_, f32, 1>, at: Point2<f64>, radius: usize) -> Option<()> {
        let (w, h) = view.size();
        let (x0, y0) = (at.x - radius as f64, at.y - radius as f64);
        let side = 2 * radius + 1;
        let (bx, by) = (x0.floor(), y0.floor());
        if bx < 0.0 || by < 0.0 || !(bx + by).is_finite() {
            return None;
        }
        let (ix, iy) = (bx as usize, by as usize);
        if ix + side >= w || iy + side >= h {
            return None;
        }
        let (fx, fy) = ((x0 - bx) as f32, (y0 - by) as f32);
        self.values.resize(side * side, 0.0);
        for (j, row) in self.values.chunks_exact_mut(side).enumerate() {
            let (above, below) = (&view.row(iy + j)[ix..=ix + side], &view.row(iy + j + 1)[ix..=ix + side]);
            for (i, value) in row.iter_mut().enumerate() {
                let top = above[i] + fx * (above[i + 1] - above[i]);
                let bottom = below[i] + fx * (below[i + 1] - below[i]);
                *value = top + fy * (bottom - top);
            }
        }
        (self.side, self.stride) = (side, side.next_multiple_of(LANES) + 2);
        self.even.resize(side * self.stride, 0.0);
        self.odd.resize(side * self.stride, 0.0);
        let parts = self.even.chunks_exact_mut(self.stride).zip(self.odd.chunks_exact_mut(self.stride));
        let rotated = self.values.chunks_exact(side).rev();
        for (((even, odd), row), rotated) in parts.zip(self.values.chunks_exact(side)).zip(rotated) {
            let parts = even.iter_mut().zip(odd.iter_mut());
            for (((even, odd), a), b) in parts.zip(row).zip(rotated.iter().rev()) {
                (*even, *odd) = (0.5 * (a + b), 0.5 * (a - b));
            }
            even[side..].fill(0.0);
            odd[side..].fill(0.0);
        }
        Some(())
    }
}

/// Returns the distance from a position to the outermost pixel centers of an image, negative outside.
pub(super) fn border_distance((width, height): (usize, usize), at: Point2<f64>) -> f64 {
    at.x.min(at.y).min((width as f64 - 1.0) - at.x).min((height as f64 - 1.0) - at.y)
}

/// Refines the corner near `start` with a window radius of `window` pixels (at least 1), less at the image border, and a
/// convergence tolerance in pixels. `None` if the corner is within 4 px of the border or moves by more than the window's
/// radius, or if there are no two edge directions.
pub(crate) fn refine_saddle(
    view: ImageView<'_, f32, 1>,
    start: Point2<f64>,
    window: f64,
    tolerance: f64,
) -> Option<Saddle> {
    let largest = (1.25 * window.clamp(1.0, 64.0)).round() as usize;
    let (mut patch, mut weights, mut weights_radius) = (Patch::default(), Vec::new(), 0);
    let level = simd::level();
    let mut at = start;
    for _ in 0..MAX_ITERATIONS {
        // The samples between pixels extend a pixel further, gradients another.
        let radius = largest.min((border_distance(view.size(), at) - 2.0) as usize);
        if radius < MIN_RADIUS {
            return None;
        }
        if radius != weights_radius {
            fill_weights(&mut weights, radius);
            weights_radius = radius;
        }
        patch.sample(view, at, radius + 1)?;
        let normal = normal_equations(level, &patch, radius, &weights);
        let step = -normal.solve()?;
        if step.norm() < tolerance {
            return Some(Saddle { position: at + step, deviation: normal.deviation(&patch) });
        }
        at += step.cap_magnitude(MAX_STEP);
        let displacement = (at - start).norm();
        if displacement > window.max(1.5) || !displacement.is_finite() {
            return None;
        }
    }
    // Not converged: oscillation between nearby positions.
    Some(Saddle { position: at, deviation: 0.5 })
}

/// Biweights of the samples along an axis, similar to a Gaussian that is e⁻¹ at 0.8 of the radius, zero after the last one.
fn fill_weights(weights: &mut Vec<f32>, radius: usize) {
    let to = |i: usize| (i as f64 - radius as f64) / (radius + 1) as f64;
    weights.clear();
    weights.extend((0..=2 * radius).map(|i| (1.0 - to(i).powi(2)).powi(2) as f32));
    weights.resize((2 * radius + 1).next_multiple_of(LANES), 0.0);
}

/// Sums of g·gᵀ and of g times the odd part over a window, where g is the gradient of the even part, as a difference over two
/// pixels.
struct NormalEquations {
    xx: f64,
    xy: f64,
    yy: f64,
    bx: f64,
    by: f64,
}

fn normal_equations(level: Level, patch: &Patch, radius: usize, weights: &[f32]) -> NormalEquations {
    dispatch!(level, simd => normal_equations_impl(simd, patch, radius, weights))
}

#[inline(always)]
fn normal_equations_impl<S: Simd>(simd: S, patch: &Patch, radius: usize, weights: &[f32]) -> NormalEquations {
    let (stride, n) = (patch.stride, 2 * radius + 1);
    // The sums of each lane, in an order that does not depend on the machine.
    let mut sums = [[0.0f64; LANES]; 5];
    // The products are even: each row above the middle stands for one below it, too.
    for j in 0..=radius {
        let [above, row, below] = [0, 1, 2].map(|k| &patch.even[(j + k) * stride..][..stride]);
        let odd = &patch.odd[(j + 1) * stride..][..stride];
        let weight = if j < radius { 2.0 * weights[j] } else { weights[j] };
        let mut row_sums = [f32x8::splat(simd, 0.0); 5];
        for (start, weights_x) in (0..n).step_by(LANES).zip(weights.chunks_exact(LANES)) {
            let gx =
                f32x8::from_slice(simd, &row[start + 2..][..LANES]) - f32x8::from_slice(simd, &row[start..][..LANES]);
            let gy = f32x8::from_slice(simd, &below[start + 1..][..LANES])
                - f32x8::from_slice(simd, &above[start + 1..][..LANES]);
            let odd = f32x8::from_slice(simd, &odd[start + 1..][..LANES]);
            // Zero after the last sample.
            let w = f32x8::from_slice(simd, weights_x) * weight;
            let (wx, wy) = (w * gx, w * gy);
            row_sums[0] += wx * gx;
            row_sums[1] += wx * gy;
            row_sums[2] += wy * gy;
            row_sums[3] += wx * odd;
            row_sums[4] += wy * odd;
        }
        for (sum, row_sum) in sums.iter_mut().zip(&row_sums) {
            let mut lanes = [0.0f32; LANES];
            row_sum.store_slice(&mut lanes);
            for i in 0..LANES {
                sum[i] += f64::from(lanes[i]);
            }
        }
    }
    let [xx, xy, yy, bx, by] = sums.map(|lanes| lanes.iter().sum());
    NormalEquations { xx, xy, yy, bx, by }
}

impl NormalEquations {
    /// Solves for the position of the window relative to the corner; `None` if there is only one edge direction.
    fn solve(&self) -> Option<Vector2<f64>> {
        let det = self.xx * self.yy - self.xy * self.xy;
        let trace = self.xx + self.yy;
        // Edges with an angle below about 5° are degenerate.
        (det > 2e-3 * trace * trace).then(|| {
            // The gradients are twice the derivatives.
            2.0 / det * Vector2::new(self.yy * self.bx - self.xy * self.by, self.xx * self.by - self.xy * self.bx)
        })
    }

    /// Estimates the standard deviation of the position: the noise variance σ² from the odd part, which has half of it; then
    /// the Cramér–Rao bound, σ²·(Σ g·gᵀ)⁻¹.
    fn deviation(&self, patch: &Patch) -> f64 {
        let sum: f64 = patch.odd.iter().map(|odd| f64::from(*odd).powi(2)).sum();
        let variance = 2.0 * sum / (patch.side * patch.side) as f64;
        let det = self.xx * self.yy - self.xy * self.xy;
        // Gradients are differences over two pixels, twice the derivative.
        (variance * 4.0 * 0.5 * (self.xx + self.yy) / det).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::GrayF32;

    /// The product of tanh of the distances to two lines with an angle of 60°: an X-corner with a blur of about `blur` pixels,
    /// through a tone curve.
    fn x_corner(at: Point2<f64>, blur: f64, gamma: f64) -> GrayF32 {
        let side = |x: usize, y: usize, angle: f64| {
            let (sin, cos) = angle.sin_cos();
            (((y as f64 - at.y) * cos - (x as f64 - at.x) * sin) / blur).tanh()
        };
        let level = |x, y| 0.5 + 0.4 * side(x, y, 0.2) * side(x, y, 1.25);
        GrayF32::from_fn(40, 40, |x, y| [level(x, y).powf(gamma) as f32])
    }

    #[test]
    fn neither_wide_blur_nor_a_tone_curve_moves_a_corner() {
        let truth = Point2::new(20.3, 18.6);
        for (window, blur) in [(4.0, 4.0), (6.0, 4.0), (8.0, 3.0)] {
            let image = x_corner(truth, blur, 1.0 / 2.2);
            let found = refine_saddle(image.view(), Point2::new(21.3, 18.0), window, 1e-4).unwrap();
            // Interpolation is nearly exact at this blur.
            assert!((found.position - truth).norm() < 0.003, "{window} {blur}: {found:?}");
        }
    }

    #[test]
    fn corners_near_the_border_are_refined_in_smaller_windows() {
        // The distance to the lower border: 6.8 px.
        let truth = Point2::new(20.3, 32.2);
        let found = refine_saddle(x_corner(truth, 1.5, 1.0).view(), Point2::new(20.0, 33.0), 10.0, 1e-4).unwrap();
        assert!((found.position - truth).norm() < 0.01, "{found:?}");
    }

    #[test]
    fn the_position_of_a_smooth_x_corner_is_accurate() {
        let truth = Point2::new(20.3, 18.6);
        let image = x_corner(truth, 1.5, 1.0);
        for start in [Point2::new(20.0, 19.0), Point2::new(21.5, 17.5)] {
            let found = refine_saddle(image.view(), start, 6.0, 1e-4).unwrap();
            // Interpolation between pixels is skewed by up to a hundredth of a pixel at this blur.
            assert!((found.position - truth).norm() < 0.01 && found.deviation < 0.02, "{found:?}");
        }
        // Straight edges and flat images have no corner, nor do positions outside.
        let edge = GrayF32::from_fn(40, 40, |x, _| [(x > 20) as u8 as f32]);
        for (image, at) in [(&edge, 20.0), (&GrayF32::new(40, 40, [0.5]), 20.0), (&image, 1.0), (&image, f64::NAN)] {
            assert!(refine_saddle(image.view(), Point2::new(at, 20.0), 5.0, 1e-4).is_none());
        }
    }
}
