//! Vectorized log odds of every pixel, in blocks of 64 pixels.
//!
//! Plain loops over arrays, compiled for each instruction set and dispatched at run time. Multiplications and additions
//! are never fused, so all instruction sets give identical results.

use crate::{ColorSpace, mixture::Whitened};
use cv_core::{Cancelled, GrayF32, ImageView, Progress, Stage};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch};
use std::f32::consts::{PI, TAU};

/// Pixels per block.
const LANES: usize = 64;
type Block = [f32; LANES];

/// A mixture component in f32: `log density = constant − ½ |A x + b|²`, with the lower triangle of `A` in row-major
/// order.
#[derive(Debug, Clone, Copy)]
struct PackedComponent {
    constant: f32,
    a: [f32; 6],
    b: [f32; 3],
}

impl From<&Whitened> for PackedComponent {
    fn from(w: &Whitened) -> Self {
        let a = [w.a[(0, 0)], w.a[(1, 0)], w.a[(1, 1)], w.a[(2, 0)], w.a[(2, 1)], w.a[(2, 2)]];
        Self { constant: w.constant as f32, a: a.map(|v| v as f32), b: std::array::from_fn(|i| w.b[i] as f32) }
    }
}

/// Evaluator of the log likelihood ratio of two mixtures in a color space.
#[derive(Debug, Clone)]
pub(crate) struct LogOdds {
    space: ColorSpace,
    hue: f32,
    foreground: Vec<PackedComponent>,
    /// If empty, the result is the foreground's log density.
    background: Vec<PackedComponent>,
    /// Lookup table from sRGB byte to linear intensity, for Lab.
    linear: [f32; 256],
}

impl LogOdds {
    pub(crate) fn new(space: ColorSpace, hue: f32, foreground: &[Whitened], background: &[Whitened]) -> Self {
        let bytes = cv_core::GrayU8::from_fn(256, 1, |x, _| [x as u8]);
        let mut linear = [0.0; 256];
        linear.copy_from_slice(cv_imgproc::srgb_to_linear(bytes.view()).as_slice());
        let pack = |w: &[Whitened]| w.iter().map(PackedComponent::from).collect();
        Self { space, hue, foreground: pack(foreground), background: pack(background), linear }
    }

    /// Computes the natural logarithm of the likelihood ratio at each pixel.
    pub(crate) fn log_odds(&self, view: ImageView<'_, u8, 3>, progress: &dyn Progress) -> Result<GrayF32, Cancelled> {
        self.log_odds_at(Level::new(), view, progress)
    }

    fn log_odds_at(
        &self,
        level: Level,
        view: ImageView<'_, u8, 3>,
        progress: &dyn Progress,
    ) -> Result<GrayF32, Cancelled> {
        let stage = Stage::new(progress, "classify", view.height())?;
        let mut out = GrayF32::new(view.width(), view.height(), [0.0]);
        if out.is_empty() {
            return Ok(out);
        }
        let rows = out.as_mut_slice().par_chunks_mut(view.width()).enumerate();
        let buffer = || vec![[0.0; LANES]; self.foreground.len().max(self.background.len())];
        rows.with_min_len(4).try_for_each_init(buffer, |terms, (y, out)| {
            stage.add(1)?;
            let (pixels, _) = view.row(y).as_chunks::<3>();
            dispatch!(level, _simd => self.row(pixels, out, terms));
            Ok::<(), Cancelled>(())
        })?;
        Ok(out)
    }

    #[inline(always)]
    fn row(&self, pixels: &[[u8; 3]], out: &mut [f32], terms: &mut [Block]) {
        for (pixels, out) in pixels.chunks(LANES).zip(out.chunks_mut(LANES)) {
            let mut odds = [0.0; LANES];
            if let Some(pixels) = pixels.first_chunk::<LANES>() {
                self.block(pixels, &mut odds, terms);
            } else {
                let mut padded = [[0; 3]; LANES];
                padded[..pixels.len()].copy_from_slice(pixels);
                self.block(&padded, &mut odds, terms);
            }
            out.copy_from_slice(&odds[..out.len()]);
        }
    }

    #[inline(always)]
    fn block(&self, pixels: &[[u8; 3]; LANES], odds: &mut Block, terms: &mut [Block]) {
        let mut x = [[0.0; LANES]; 3];
        match self.space {
            ColorSpace::Hsv => hsv(pixels, self.hue, &mut x),
            ColorSpace::Rgb => rgb(pixels, &mut x),
            ColorSpace::Lab => lab(pixels, &self.linear, &mut x),
        }
        let (mut max, mut sum) = ([0.0; LANES], [0.0; LANES]);
        density(&self.foreground, &x, terms, &mut max, &mut sum);
        if self.background.is_empty() {
            for i in 0..LANES {
                odds[i] = max[i] + ln(sum[i]);
            }
        } else {
            let (mut max_b, mut sum_b) = ([0.0; LANES], [0.0; LANES]);
            density(&self.background, &x, terms, &mut max_b, &mut sum_b);
            for i in 0..LANES {
                odds[i] = (max[i] - max_b[i]) + ln(sum[i] / sum_b[i]);
            }
        }
    }
}

/// Evaluates a mixture's density as `sum · exp(max)` (log-sum-exp); `sum` is at least one.
#[inline(always)]
fn density(components: &[PackedComponent], x: &[Block; 3], terms: &mut [Block], max: &mut Block, sum: &mut Block) {
    *max = [f32::MIN; LANES];
    for (c, term) in components.iter().zip(terms.iter_mut()) {
        let PackedComponent { constant, a, b } = *c;
        for i in 0..LANES {
            let (x0, x1, x2) = (x[0][i], x[1][i], x[2][i]);
            let y0 = a[0] * x0 + b[0];
            let y1 = a[1] * x0 + a[2] * x1 + b[1];
            let y2 = a[3] * x0 + a[4] * x1 + a[5] * x2 + b[2];
            let t = constant - 0.5 * (y0 * y0 + y1 * y1 + y2 * y2);
            term[i] = t;
            max[i] = if t > max[i] { t } else { max[i] };
        }
    }
    *sum = [0.0; LANES];
    for term in terms.iter().take(components.len()) {
        for i in 0..LANES {
            sum[i] += exp(term[i] - max[i]);
        }
    }
}

/// Computes eᵛ for `v ≤ 0`, with a relative error below 1e-6; arguments below −87 are clamped. Range reduction to 2ⁿ
/// times a polynomial in the remainder.
#[inline(always)]
fn exp(v: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0; // 1.5 · 2²³: adding it rounds to the nearest integer, in the low bits
    let v = if v > -87.0 { v } else { -87.0 };
    let shifted = v * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    // ln 2 in two parts, the first short enough that its product is exact (Cody & Waite).
    let r = (v - n * 0.693_359_4) - n * -2.121_944_4e-4;
    let p = 1.0 + r * (1.0 + r * (0.5 + r * (1.0 / 6.0 + r * (1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0))))));
    let power = (shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127)) << 23;
    p * f32::from_bits(power)
}

/// Computes the natural logarithm of a positive normal number, to about 1e-6: exponent times ln 2 plus the series of 2
/// atanh for the mantissa.
#[inline(always)]
fn ln(v: f32) -> f32 {
    // Mantissa between √½ and √2.
    let bits = v.to_bits().wrapping_sub(0x3f35_04f3);
    let exponent = ((bits as i32) >> 23) as f32;
    let m = f32::from_bits((bits & 0x007f_ffff).wrapping_add(0x3f35_04f3));
    let s = (m - 1.0) / (m + 1.0);
    let z = s * s;
    exponent * std::f32::consts::LN_2
        + 2.0 * s * (1.0 + z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * (1.0 / 7.0 + z * (1.0 / 9.0)))))
}

#[inline(always)]
fn rgb(pixels: &[[u8; 3]; LANES], x: &mut [Block; 3]) {
    for i in 0..LANES {
        for c in 0..3 {
            x[c][i] = f32::from(pixels[i][c]) * (1.0 / 255.0);
        }
    }
}

#[inline(always)]
fn hsv(pixels: &[[u8; 3]; LANES], hue: f32, x: &mut [Block; 3]) {
    let mut planes = [[0.0; LANES]; 3];
    for i in 0..LANES {
        for c in 0..3 {
            planes[c][i] = f32::from(pixels[i][c]);
        }
    }
    let select = |condition: bool, a: f32, b: f32| if condition { a } else { b };
    for i in 0..LANES {
        let (r, g, b) = (planes[0][i], planes[1][i], planes[2][i]);
        let max = select(r > g, r, g);
        let max = select(max > b, max, b);
        let min = select(r < g, r, g);
        let min = select(min < b, min, b);
        let range = max - min;
        // For a gray (range zero) the numerator is zero too, and the hue is 0.
        let inverse = 1.0 / select(range > 0.0, range, 1.0);
        let hue_if_red_max = select(g < b, 6.0, 0.0) + (g - b) * inverse;
        let hue_if_green_max = 2.0 + (b - r) * inverse;
        let hue_if_blue_max = 4.0 + (r - g) * inverse;
        let sixths = select(max == r, hue_if_red_max, select(max == g, hue_if_green_max, hue_if_blue_max));
        let angle = sixths * (TAU / 6.0) - hue;
        let angle = select(angle > PI, angle - TAU, angle);
        x[0][i] = select(angle < -PI, angle + TAU, angle);
        x[1][i] = range / select(max > 0.0, max, 1.0);
        x[2][i] = max * (1.0 / 255.0);
    }
}

#[inline(always)]
fn lab(pixels: &[[u8; 3]; LANES], linear: &[f32; 256], x: &mut [Block; 3]) {
    let mut planes = [[0.0; LANES]; 3];
    for i in 0..LANES {
        for c in 0..3 {
            planes[c][i] = linear[usize::from(pixels[i][c])];
        }
    }
    for i in 0..LANES {
        let lab = cv_imgproc::linear_rgb_to_lab([planes[0][i], planes[1][i], planes[2][i]]);
        for c in 0..3 {
            x[c][i] = lab[c];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Component, Mixture};
    use cv_core::{RgbU8, Silent};
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    #[test]
    fn exp_and_ln_are_within_their_error_bounds() {
        for i in 0..=87_000 {
            let v = -(i as f32) / 1000.0;
            let exact = f64::from(v).exp();
            // The first omitted term is (ln 2 / 2)⁷ / 5040 = 1.2e-7 of at least 0.7; the rest is rounding.
            assert!((f64::from(exp(v)) - exact).abs() < 6e-7 * exact, "{v}");
        }
        for i in 1..=100_000 {
            let v = i as f32 / 1000.0;
            // 2 s¹¹ / 11 at s = 0.1716 is 7e-10; the rest is rounding of values up to 7.
            assert!((f64::from(ln(v)) - f64::from(v).ln()).abs() < 2e-6, "{v}");
        }
        assert!(exp(-1e30) < 1e-37);
    }

    proptest! {
        #[test]
        fn log_odds_equal_the_reference_mixtures_in_every_space_and_instruction_set(
            width in 1usize..150, seed in any::<u32>(), hue in 0.0f32..TAU, space in 0usize..3, counts in (1usize..5, 0usize..5),
        ) {
            let space = [ColorSpace::Hsv, ColorSpace::Rgb, ColorSpace::Lab][space];
            let mut state = seed | 1;
            let mut random = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / (1 << 24) as f32
            };
            let image = RgbU8::from_fn(width, 2, |_, _| std::array::from_fn(|_| (256.0 * random()) as u8));
            let scale = if space == ColorSpace::Lab { 100.0 } else { 1.0 };
            let mut mixture = |n: usize| Mixture {
                components: (0..n).map(|_| {
                    let l = nalgebra::Matrix3::<f64>::from_fn(|i, j| {
                        scale * if i == j { 0.05 + 0.3 * f64::from(random()) } else if i > j { 0.2 * f64::from(random()) - 0.1 } else { 0.0 }
                    });
                    let s = l * l.transpose();
                    Component {
                        weight: 1.0 / n as f64,
                        mean: std::array::from_fn(|_| scale * f64::from(random())),
                        covariance: std::array::from_fn(|i| std::array::from_fn(|j| s[(i, j)])),
                    }
                }).collect(),
            };
            let (f, b) = (mixture(counts.0), mixture(counts.1));
            let background = if counts.1 == 0 { Vec::new() } else { b.whitened().unwrap() };
            let evaluator = LogOdds::new(space, hue, &f.whitened().unwrap(), &background);
            let first = evaluator.log_odds(image.view(), &Silent).unwrap();
            for y in 0..2 {
                for x in 0..width {
                    let p = space.coordinates(image.at(x, y), hue).map(f64::from);
                    // At the wrap-around opposite the mean hue, rounding decides the side.
                    if space == ColorSpace::Hsv && p[0].abs() > f64::from(PI) - 1e-4 {
                        continue;
                    }
                    let (f, b) = (f.log_density(p), if counts.1 == 0 { 0.0 } else { b.log_density(p) });
                    let got = f64::from(first.at(x, y)[0]);
                    // Rounding of squares of up to |f| and |b|; near black, hue and saturation are ratios of small
                    // integers, exact in both.
                    prop_assert!((got - (f - b)).abs() < 1e-4 + 4e-6 * (f.abs() + b.abs()), "{:?} {} {} {}", image.at(x, y), got, f, b);
                }
            }
            for level in instruction_sets() {
                prop_assert_eq!(&evaluator.log_odds_at(level, image.view(), &Silent).unwrap(), &first, "{:?}", level);
            }
        }
    }
}
