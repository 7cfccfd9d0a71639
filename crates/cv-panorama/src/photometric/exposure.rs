//! Exposure, white balance, camera response and vignetting from the overlaps (after Goldman & Chen 2005, "Vignette and exposure calibration and
//! compensation", and Brown & Lowe 2007, §6).
//!
//! Overlapping photographs recorded the same radiance: `L(I_a) + g_a + v(r_a) = L(I_b) + g_b + v(r_b)`, with `L` the log radiance by the common response,
//! a log gain `g` per photograph and channel, and common vignetting `v(r) = v₁ r² + v₂ r⁴`. This is linear in all unknowns and solved by iteratively reweighted
//! least squares (Cauchy weights). A clipped level is a lower bound: an equation only where the other photograph violates it.

use crate::photometric::{Adaptation, ExposureCorrection, Response, Tone, response::COEFFICIENT_COUNT};
use crate::surface::{Piece, Preview};
use cv_core::{Cancelled, Progress, Stage, named};
use nalgebra::{DMatrix, DVector};

/// Exposure compensation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Exposure {
    /// None.
    None,
    /// Exposure and white balance of each photograph in linear radiance, with the response and the vignetting of the camera.
    #[default]
    Match,
    /// As [`Self::Match`], then every place in the exposure of the photographs that show it, by a smooth lift in log radiance that follows edges: where exposures span more than 1.5 stops, one
    /// exposure is too dark or washed out. Up to a range of half a stop the same as `Match`. Radiance ([`CompositingOptions::radiance`](crate::CompositingOptions::radiance)) has no
    /// exposure, and is the same as with `Match`.
    Adapt,
}

named!(Exposure { None = "none", Match = "match" | "gain" | "vignetting", Adapt = "adapt" });

/// Photometric parameters of all photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct Gains {
    /// Factors on the linear red, green and blue of each photograph.
    pub gains: Vec<[f32; 3]>,
    /// `v₁` and `v₂`: radiance at distance r from the image center (1 at the corners) is multiplied by `exp(v₁ r² + v₂ r⁴)`.
    pub vignetting: [f32; 2],
    /// `p₀`, `p₁`, `p₂`: the radiance of a level `v`, 0 to 1, is that of sRGB times `2^((1 − v)(p₀ + p₁ v + p₂ v²))`.
    pub response: [f64; 3],
}

impl Gains {
    pub(crate) fn none(photos: usize) -> Self {
        Self { gains: vec![[1.0; 3]; photos], vignetting: [0.0; 2], response: [0.0; 3] }
    }

    /// Returns the headroom above white in stops, 0 or more: the maximum gain with the vignetting correction at [`HEADROOM_R2`].
    pub(super) fn headroom_stops(&self) -> f64 {
        let gain = f64::from(self.gains.iter().flatten().copied().fold(f32::MIN_POSITIVE, f32::max).log2());
        let [v1, v2] = self.vignetting;
        let vignetting = f64::from(HEADROOM_R2 * (v1 + HEADROOM_R2 * v2)) * std::f64::consts::LOG2_E;
        (gain + vignetting.max(0.0)).max(0.0)
    }

    /// Returns the radiance above which a sample is clipped.
    pub(crate) fn clipped(&self) -> f32 {
        self.radiance(f64::from(CLIPPED) / 255.0)
    }

    /// Returns the radiance of a level of 0 to 1; 1 for white.
    pub(crate) fn radiance(&self, level: f64) -> f32 {
        // Linear below a quarter of a level.
        let held = level.max(0.25 / 255.0);
        (Response { coefficients: self.response }.log_radiance(held).exp2() * level / held) as f32
    }

    /// Builds the tone tables for photographs of `parts` quantization steps per gray level.
    pub(crate) fn tone(&self, parts: usize) -> Tone {
        self.adapted_tone(None, parts)
    }

    /// As [`Self::tone`], for the highest radiance after local adaptation.
    pub(crate) fn adapted_tone(&self, adaptation: Option<&Adaptation>, parts: usize) -> Tone {
        let highest = adaptation.map_or_else(|| self.headroom_stops(), Adaptation::highest);
        Tone::new(&Response { coefficients: self.response }, highest, parts)
    }
}

/// The levels of two photographs at one canvas position.
#[derive(Debug, Clone, Copy)]
struct Sample {
    a: usize,
    b: usize,
    /// Levels.
    levels: [[u8; 3]; 2],
    /// Squared distances r² from the image centers.
    radius: [f64; 2],
    /// Local gradient in gray levels per preview pixel: scales the uncertainty due to misalignment.
    slope: f64,
}

/// Maximum number of samples per overlap.
const MAX_SAMPLES: usize = 2000;
/// Minimum level that counts as clipped; JPEG compression varies clipped levels.
const CLIPPED: u8 = 250;
/// Squared distance from the image center up to which corrected vignetting clips nothing. Farther out, toward the corners, are few highlights, and more headroom would
/// set all others off from clipped whites.
const HEADROOM_R2: f32 = 0.5;
/// Minimum level that is used: noise and the black point dominate below.
const MIN_LEVEL: u8 = 5;
/// Level above which another photograph is preferred.
pub(crate) const SATURATED_LEVEL: u8 = CLIPPED;
/// Standard deviation of a preview level, in gray levels: rounding, compression, residual noise.
const NOISE_SIGMA: f64 = 0.8;
/// Standard deviation of the misalignment in preview pixels.
const MISALIGNMENT_SIGMA_PX: f64 = 0.25;
/// Scale of the Cauchy weight in standard deviations.
const CAUCHY_SCALE: f64 = 2.5;
/// Prior standard deviation of the vignetting coefficients, in stops.
const VIGNETTING_SIGMA: f64 = 0.5;
/// Prior standard deviation of the response coefficients.
const RESPONSE_SIGMA: f64 = 1.0;
/// Prior standard deviation of the exponent of the response relative to sRGB, which overlaps do not determine: a power of all radiances fits them equally (Grossberg & Nayar
/// 2003, "Determining the camera response from images: what is knowable?").
const EXPONENT_SIGMA: f64 = 0.1;
/// Weight of the priors of vignetting and exponent relative to the sum of the weights of all samples.
const PRIOR_WEIGHT: f64 = 2e-3;
/// Weight of the prior of the response coefficients. Overlaps determine the shape of the response, but weakly: at ten times this weight the gains of the outer
/// photographs of a chain of eight are off by 0.1 to 0.2 stops.
const SHAPE_PRIOR_WEIGHT: f64 = 2e-4;

/// Unknowns of an equation: two gains, vignetting, response.
const TERMS: usize = 4 + COEFFICIENT_COUNT;

/// Which unknowns are estimated.
#[derive(Clone, Copy)]
struct Unknowns {
    photos: usize,
    vignetting: bool,
    curve: bool,
}

impl Unknowns {
    /// Returns the number of unknowns: three gains per photograph, vignetting, response, in this order.
    fn count(&self) -> usize {
        3 * self.photos + 2 + COEFFICIENT_COUNT
    }

    /// Returns the coefficients of the gains of the first and the second photograph, of the vignetting, and of the response.
    #[inline(always)]
    fn terms(&self, s: &Sample, c: usize, basis: &[[f64; COEFFICIENT_COUNT]; 256]) -> [f64; TERMS] {
        let lens = if self.vignetting { 1.0 } else { 0.0 };
        let curve = if self.curve { 1.0 } else { 0.0 };
        let [a, b] = s.levels.map(|l| &basis[usize::from(l[c])]);
        let [p, q] = s.radius;
        let mut terms = [1.0, -1.0, lens * (p - q), lens * (p * p - q * q), 0.0, 0.0, 0.0];
        for (term, (a, b)) in terms[4..].iter_mut().zip(a.iter().zip(b)) {
            *term = curve * (a - b);
        }
        terms
    }
}

/// Estimates gains, vignetting and response from the overlaps of the preview.
pub(crate) fn estimate_gains(
    preview: &Preview,
    photo_of: &[usize],
    photos: usize,
    exposure: Exposure,
    progress: &dyn Progress,
) -> Result<Gains, Cancelled> {
    let mut gains = Gains::none(photos);
    if exposure == Exposure::None {
        return Ok(gains);
    }
    let stage = Stage::new(progress, "exposure", 3)?;
    let samples = samples(preview, photo_of, &stage)?;
    stage.add(1)?;
    if samples.is_empty() {
        return Ok(gains);
    }
    // An implausible vignetting or response is dropped and the rest estimated again.
    let mut unknowns = Unknowns { photos, vignetting: true, curve: true };
    let solution = loop {
        let solution = solve(&samples, unknowns, &stage)?;
        let n = 3 * photos;
        let (lens, curve) = (solution.rows(n, 2), solution.rows(n + 2, COEFFICIENT_COUNT));
        // Vignetting darkens the corners, monotonically and by at most two stops.
        let falls = |r2: f64| r2 * (lens[0] + r2 * lens[1]);
        let is_lens = falls(0.5) >= -0.02 && falls(1.0) >= falls(0.5) - 0.02 && falls(1.0) < 2.0;
        let is_curve = Response { coefficients: std::array::from_fn(|k| curve[k]) }.is_plausible();
        if is_lens && is_curve {
            break solution;
        }
        unknowns =
            Unknowns { vignetting: unknowns.vignetting && is_lens, curve: unknowns.curve && is_curve, ..unknowns };
    };
    stage.add(1)?;
    for (gain, stops) in gains.gains.iter_mut().zip(solution.as_slice().as_chunks::<3>().0) {
        *gain = stops.map(|s| s.clamp(-5.0, 5.0).exp2() as f32);
    }
    let n = 3 * photos;
    gains.vignetting = std::array::from_fn(|k| (solution[n + k] * std::f64::consts::LN_2) as f32);
    gains.response = std::array::from_fn(|k| solution[n + 2 + k]);
    anchor(&mut gains, preview, photo_of);
    stage.add(1)?;
    Ok(gains)
}

/// Maximum number of preview pixels sampled for the mean level.
const MAX_MEAN_SAMPLES: usize = 10_000;

/// Margin in gray levels by which the mean level of the panorama stays inside the range of the photographs' means: of photographs with parallax, the choice at the seams changes it by up to one.
const MEAN_MARGIN: f64 = 1.0;

/// Chooses the common exposure, which the overlaps leave free: the mean level of the panorama is kept at that of the photographs, clamped to the range of their means. Each canvas
/// position counts once, with the mean of the photographs that cover it. (Where several photographs cover the dark parts of a scene and one the bright parts, that exceeds the mean of every photograph.)
fn anchor(gains: &mut Gains, preview: &Preview, photo_of: &[usize]) {
    let (width, height) = (preview.width, preview.height);
    let step = (width * height).div_ceil(MAX_MEAN_SAMPLES).max(1);
    let mut colors = Vec::new();
    let mut places = 0.0;
    for (x, y) in (0..width * height).step_by(step).map(|i| (i % width, i / width)) {
        let first = colors.len();
        for (piece, &photo) in preview.pieces.iter().zip(photo_of) {
            if let Some(color) = piece.warped.color(x, y) {
                let radius = piece.radius[piece.warped.bounds.index(x, y)];
                colors.push((color.map(f32::from), radius, photo, 0.0));
            }
        }
        let share = 1.0 / (colors.len() - first).max(1) as f64;
        colors[first..].iter_mut().for_each(|c| c.3 = share);
        places += f64::from(u8::from(colors.len() > first));
    }
    let means = || preview.pieces.iter().map(|piece| piece.mean_level);
    let (darkest, brightest) = (means().fold(f64::INFINITY, f64::min), means().fold(0.0, f64::max));
    let middle = 0.5 * (darkest + brightest);
    let (low, high) = ((darkest + MEAN_MARGIN).min(middle), (brightest - MEAN_MARGIN).max(middle));
    let before: f64 = colors.iter().map(|(color, _, _, share)| share * f64::from(color[0] + color[1] + color[2])).sum();
    let before = before.min(3.0 * high * places).max(3.0 * low * places);
    let shifted = |stops: f64| {
        let factor = stops.exp2() as f32;
        Gains { gains: gains.gains.iter().map(|g| g.map(|g| g * factor)).collect(), ..gains.clone() }
    };
    let (mut low, mut high) = (-2.0_f64, 2.0_f64);
    for _ in 0..12 {
        let middle = 0.5 * (low + high);
        let tried = shifted(middle);
        let tone = tried.tone(1);
        let corrections: Vec<_> =
            (0..gains.gains.len()).map(|photo| ExposureCorrection::new(&tone, &tried, photo)).collect();
        let after: f64 = colors
            .iter()
            .map(|(color, r2, photo, share)| {
                let correction = &corrections[*photo];
                let levels = correction.levels(*color, correction.vignetting_stops(*r2));
                share * f64::from(levels[0] + levels[1] + levels[2])
            })
            .sum();
        if after < before { low = middle } else { high = middle }
    }
    *gains = shifted(0.5 * (low + high));
}

fn samples(preview: &Preview, photo_of: &[usize], stage: &Stage<'_>) -> Result<Vec<Sample>, Cancelled> {
    let mut samples = Vec::new();
    for (i, p) in preview.pieces.iter().enumerate() {
        stage.check()?;
        for (j, q) in preview.pieces.iter().enumerate().skip(i + 1) {
            let Some(common) = p.warped.bounds.intersection(&q.warped.bounds) else { continue };
            if photo_of[i] == photo_of[j] {
                continue;
            }
            let step = ((common.width() * common.height()) as f64 / MAX_SAMPLES as f64).sqrt().ceil().max(1.0) as usize;
            for y in (common.top..common.bottom).step_by(step) {
                for x in (common.left..common.right).step_by(step) {
                    let (Some(a), Some(b)) = (p.warped.color(x, y), q.warped.color(x, y)) else { continue };
                    let r2 = |piece: &Piece| f64::from(piece.radius[piece.warped.bounds.index(x, y)]);
                    let (Some(s), Some(t)) = (max_gradient(p, x, y, a), max_gradient(q, x, y, b)) else { continue };
                    let (a_of, b_of) = (photo_of[i], photo_of[j]);
                    let slope = f64::from(s.max(t));
                    samples.push(Sample { a: a_of, b: b_of, levels: [a, b], radius: [r2(p), r2(q)], slope });
                }
            }
        }
    }
    Ok(samples)
}

/// Returns the maximum absolute difference, over channels, to the four neighbors; `None` at the border.
fn max_gradient(piece: &Piece, x: usize, y: usize, color: [u8; 3]) -> Option<u8> {
    let around = [(x.checked_sub(1)?, y), (x + 1, y), (x, y.checked_sub(1)?), (x, y + 1)];
    around.into_iter().try_fold(0, |most, (x, y)| {
        let other = piece.warped.color(x, y)?;
        color.into_iter().zip(other).map(|(a, b)| a.abs_diff(b)).max().map(|d| d.max(most))
    })
}

/// Solves for all unknowns, in stops, by iteratively reweighted least squares.
fn solve(samples: &[Sample], unknowns: Unknowns, stage: &Stage<'_>) -> Result<DVector<f64>, Cancelled> {
    let n = unknowns.count();
    let gains = 3 * unknowns.photos;
    let basis: [[f64; COEFFICIENT_COUNT]; 256] = std::array::from_fn(|v| Response::basis(v as f64 / 255.0));
    let srgb: Vec<f64> = (0..=255).map(|v| Response::srgb(f64::from(v) / 255.0)).collect();
    let exponent = Response::exponent();
    let mut solution = DVector::zeros(n);
    for round in 0..10 {
        let curve = Response { coefficients: std::array::from_fn(|k| solution[gains + 2 + k]) };
        let slopes: Vec<f64> = (0..=255).map(|v| curve.slope(f64::from(v) / 255.0) / 255.0).collect();
        let mut normal = DMatrix::<f64>::zeros(n, n);
        let mut right = DVector::<f64>::zeros(n);
        // The Cauchy scale shrinks from a wide initial value: exposures may differ by stops.
        let scale = (256.0 / f64::from(1 << round.min(8))).max(CAUCHY_SCALE);
        let mut total = 0.0;
        // All equations of two photographs and a channel have the same unknowns: their normal equations are summed apart.
        for overlap in samples.chunk_by(|s, t| (s.a, s.b) == (t.a, t.b)) {
            stage.check()?;
            for c in 0..3 {
                let indices: [usize; TERMS] = std::array::from_fn(|k| match k {
                    0 => 3 * overlap[0].a + c,
                    1 => 3 * overlap[0].b + c,
                    k => gains + k - 2,
                });
                let known: [f64; TERMS] = indices.map(|k| solution[k]);
                let (mut products, mut sums) = ([[0.0; TERMS]; TERMS], [0.0; TERMS]);
                for s in overlap {
                    let [a, b] = s.levels.map(|l| l[c]);
                    if a.min(b) < MIN_LEVEL || a.min(b) >= CLIPPED {
                        continue;
                    }
                    let terms = unknowns.terms(s, c, &basis);
                    let d = srgb[usize::from(a)] - srgb[usize::from(b)];
                    let residual = d + terms.iter().zip(&known).map(|(t, x)| t * x).sum::<f64>();
                    // A clipped level is a lower bound of the radiance.
                    if a >= CLIPPED && residual <= 0.0 || b >= CLIPPED && residual >= 0.0 {
                        continue;
                    }
                    let level = NOISE_SIGMA.powi(2) + (MISALIGNMENT_SIGMA_PX * s.slope).powi(2);
                    let variance = level * (slopes[usize::from(a)].powi(2) + slopes[usize::from(b)].powi(2));
                    // The Cauchy weight of the residual in standard deviations, over the variance.
                    let weight = 1.0 / (variance + (residual / scale).powi(2));
                    total += weight;
                    for (k, products) in products.iter_mut().enumerate() {
                        let weighted = weight * terms[k];
                        sums[k] -= weighted * d;
                        for (product, term) in products.iter_mut().zip(&terms) {
                            *product += weighted * term;
                        }
                    }
                }
                for (k, row) in indices.into_iter().zip(products) {
                    for (l, product) in indices.into_iter().zip(row) {
                        normal[(k, l)] += product;
                    }
                }
                indices.into_iter().zip(sums).for_each(|(k, sum)| right[k] += sum);
            }
        }
        // Fixes the gauge (the common factor) only.
        for k in 0..gains {
            normal[(k, k)] += 1e-6 * total.max(1.0);
        }
        let weight = total.max(1.0);
        for k in gains..gains + 2 {
            normal[(k, k)] += PRIOR_WEIGHT * weight / VIGNETTING_SIGMA.powi(2);
        }
        for (k, a) in exponent.iter().enumerate() {
            normal[(gains + 2 + k, gains + 2 + k)] += SHAPE_PRIOR_WEIGHT * weight / RESPONSE_SIGMA.powi(2);
            for (l, b) in exponent.iter().enumerate() {
                normal[(gains + 2 + k, gains + 2 + l)] += PRIOR_WEIGHT * weight * a * b / EXPONENT_SIGMA.powi(2);
            }
        }
        let Some(factor) = normal.cholesky() else { break };
        solution = factor.solve(&right);
    }
    Ok(solution)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::{Bounds, WarpedPhoto};
    use cv_core::{Image, Silent};

    /// What a camera makes of an amount of light, 0 to 1: sRGB, and a curve of this contrast on top of it.
    fn level(light: f64, contrast: f64) -> f64 {
        let light = light.clamp(0.0, 1.0);
        let v = if light <= 0.0031308 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
        v + contrast * v * (1.0 - v) * (2.0 * v - 1.0)
    }

    /// The light of a scene: smooth, from deep shadow to near white.
    fn scene(x: usize, y: usize, c: usize) -> f64 {
        let wave = ((x * (c + 2)) as f64 * 0.07).sin() * (y as f64 * 0.11).cos();
        (-3.0 + 2.2 * wave).exp2()
    }

    /// A piece that shows its whole photograph.
    fn piece(bounds: Bounds, pixels: Image<u8, 4>, radius: Vec<f32>) -> Piece {
        let colors = pixels.pixels().flat_map(|p| [p[0], p[1], p[2]]);
        let mean_level = colors.map(f64::from).sum::<f64>() / (3 * radius.len()) as f64;
        let warped = WarpedPhoto { bounds, pixels };
        Piece::new(warped, radius.clone(), radius, mean_level)
    }

    /// Three photographs of 60 x 40, 30 apart, of one scene, their light multiplied by known factors and less toward their corners.
    fn preview(factors: &[[f64; 3]; 3], fall_off: f64, contrast: f64, moved: bool) -> Preview {
        let pieces = (0..3)
            .map(|k| {
                let bounds = Bounds { left: 30 * k, top: 0, right: 30 * k + 60, bottom: 40 };
                let radius: Vec<f32> = (0..60 * 40)
                    .map(|i| {
                        let (x, y) = ((i % 60) as f32 - 29.5, (i / 60) as f32 - 19.5);
                        (x * x + y * y) / (30.0 * 30.0 + 20.0 * 20.0)
                    })
                    .collect();
                let pixels = Image::from_fn(60, 40, |x, y| {
                    let dim = (-fall_off * f64::from(radius[y * 60 + x])).exp();
                    let person = moved && k == 1 && (10..18).contains(&x);
                    let light = |c: usize| if person { 0.02 } else { scene(30 * k + x, y, c) * factors[k][c] * dim };
                    let [r, g, b] = [0, 1, 2].map(|c| (255.0 * level(light(c), contrast)).round() as u8);
                    [r, g, b, 255]
                });
                piece(bounds, pixels, radius)
            })
            .collect();
        Preview { step: 1, width: 120, height: 40, full_circle: false, pieces }
    }

    fn estimate(preview: &Preview) -> Gains {
        estimate_gains(preview, &[0, 1, 2], 3, Exposure::Match, &Silent).unwrap()
    }

    /// The greatest difference, in levels, of two photographs after correction where both show a place well.
    fn disagreement(preview: &mut Preview, gains: &Gains) -> u8 {
        let readable = |p: &Piece, x, y| p.warped.color(x, y).is_some_and(|c| c.iter().all(|v| (12..225).contains(v)));
        let both = |preview: &Preview, i: usize, x, y| {
            readable(&preview.pieces[i], x, y) && readable(&preview.pieces[i + 1], x, y)
        };
        let places = (0..2).flat_map(|i| (0..40).flat_map(move |y| (30 * i + 30..30 * i + 60).map(move |x| (i, x, y))));
        let places: Vec<_> = places.filter(|&(i, x, y)| both(preview, i, x, y)).collect();
        assert!(places.len() > 800, "{}", places.len());
        preview.correct(gains, None, &[0, 1, 2]);
        let off = |&(i, x, y): &(usize, usize, usize)| {
            let [a, b] = [i, i + 1].map(|k| preview.pieces[k].warped.color(x, y).unwrap());
            // Levels that are brightened magnify the rounding of dark ones.
            let rounding = a.into_iter().zip(b).map(|(a, b)| a.abs_diff(b)).max();
            rounding.unwrap_or(0)
        };
        let mut all: Vec<u8> = places.iter().map(off).collect();
        all.sort_unstable();
        all[all.len() * 95 / 100]
    }

    #[test]
    fn exposure_and_white_balance_are_undone_though_somebody_walked_through() {
        let factors = [[1.0, 1.0, 1.0], [0.5, 0.55, 0.6], [1.4, 1.3, 1.2]];
        let found = estimate(&preview(&factors, 0.0, 0.0, true));
        for c in 0..3 {
            let common = f64::from(found.gains[0][c]) * factors[0][c];
            for (gain, factor) in found.gains.iter().zip(&factors) {
                // Rounding to bytes is 2 % of the light of a dark level, averaged over hundreds of samples; what a common power of all light explains too is left to the
                // prior of the response: 5 % of a stop for each stop.
                assert!((f64::from(gain[c]) * factor[c] / common).log2().abs() < 0.08, "{:?}", found);
            }
        }
    }

    #[test]
    fn what_no_photograph_clipped_is_not_clipped_by_its_correction() {
        // Gains of up to half a stop, and half a stop more in the corners, two fifths of that at half of their squared distance.
        let gains = Gains { gains: vec![[0.8; 3], [1.4; 3]], vignetting: [0.2, 0.15], response: [0.0; 3] };
        let tone = gains.tone(1);
        let correction = ExposureCorrection::new(&tone, &gains, 1);
        for r2 in [0.0, 0.2, HEADROOM_R2] {
            let level = correction.levels([f32::from(CLIPPED - 1); 3], correction.vignetting_stops(r2))[0];
            assert!((200.0..254.0).contains(&level), "{r2}: {level}");
        }
    }

    #[test]
    fn photographs_agree_after_correction_whatever_the_curve_of_the_camera() {
        let factors = [[1.0, 1.0, 1.0], [0.4, 0.4, 0.45], [1.6, 1.5, 1.5]];
        for contrast in [0.0, 0.4] {
            for fall_off in [0.0, 0.4] {
                let mut set = preview(&factors, fall_off, contrast, false);
                let gains = estimate(&set);
                // A level of a photograph two stops darker is up to three levels after correction, half of that its rounding; the response is met to half a level.
                let off = disagreement(&mut set, &gains);
                assert!(off <= 3, "contrast {contrast}, fall-off {fall_off}: {off} {gains:?}");
            }
        }
    }

    #[test]
    fn the_fall_off_toward_the_corners_is_found() {
        let found = estimate(&preview(&[[1.0; 3]; 3], 0.4, 0.0, false));
        let v = |r2: f32| r2 * (found.vignetting[0] + r2 * found.vignetting[1]);
        // Rounding to bytes through differences of r² of up to 0.7, and a common power of all light, as above.
        assert!((v(1.0) - 0.4).abs() < 0.06 && (v(0.5) - 0.2).abs() < 0.04, "{:?}", found.vignetting);
    }

    #[test]
    fn the_mean_level_stays() {
        let factors = [[1.0; 3], [0.25; 3], [2.0; 3]];
        let mut set = preview(&factors, 0.0, 0.3, false);
        // Every place with the mean of the photographs that show it.
        let mean = |set: &Preview| {
            let places = (0..40).flat_map(|y| (0..120).map(move |x| (x, y)));
            let shown = places.map(|(x, y)| {
                let colors: Vec<_> = set.pieces.iter().filter_map(|p| p.warped.color(x, y)).collect();
                colors.iter().flatten().map(|v| f64::from(*v)).sum::<f64>() / (3 * colors.len()) as f64
            });
            shown.sum::<f64>() / (40.0 * 120.0)
        };
        let before = mean(&set);
        let gains = estimate(&set);
        set.correct(&gains, None, &[0, 1, 2]);
        // Halvings of four stops twelve times: a thousandth of a stop. Rounding does the rest.
        assert!((mean(&set) - before).abs() < 0.3, "{before} {}", mean(&set));
    }

    #[test]
    fn the_mean_level_is_one_that_a_photograph_could_have() {
        // Two photographs of 60 columns, 30 apart: what both show is dark, the rest bright. Each has a mean of 110; the panorama, place by place, one of 133.
        let bright = |x: usize| !(30..60).contains(&x);
        let shifted = |k: usize| {
            let bounds = Bounds { left: 30 * k, top: 0, right: 30 * k + 60, bottom: 40 };
            let value = |x: usize| if bright(30 * k + x) { 180 } else { 40 };
            let pixels = Image::from_fn(60, 40, |x, _| [value(x), value(x), value(x), 255]);
            piece(bounds, pixels, vec![0.0; 60 * 40])
        };
        let mut set =
            Preview { step: 1, width: 90, height: 40, full_circle: false, pieces: vec![shifted(0), shifted(1)] };
        let gains = estimate_gains(&set, &[0, 1], 2, Exposure::Match, &Silent).unwrap();
        set.correct(&gains, None, &[0, 1]);
        let level = |x: usize| f64::from(set.pieces[usize::from(x >= 60)].warped.color(x, 7).unwrap()[0]);
        let mean = (0..90).map(level).sum::<f64>() / 90.0;
        // Rounding.
        assert!((mean - 110.0).abs() < 1.0, "{mean} {gains:?}");
    }

    #[test]
    fn what_is_clipped_is_a_bound() {
        let unknowns = Unknowns { photos: 2, vignetting: false, curve: false };
        let gain = |samples: &[Sample]| {
            let solution = solve(samples, unknowns, &crate::testing::stage()).unwrap();
            solution[3] - solution[0]
        };
        // Clipped in the first, level 200 in the second: that is 0.79 stops below white (IEC 61966-2-1), so the second is to be lifted by as much, or more.
        let clipped = Sample { a: 0, b: 1, levels: [[255; 3], [200; 3]], radius: [0.3; 2], slope: 0.0 };
        // The prior that settles the common factor counts a millionth.
        assert!((gain(&vec![clipped; 500]) - 0.79).abs() < 0.01, "{}", gain(&vec![clipped; 500]));
        // Others say more: the bound is met and changes nothing.
        let darker = Sample { levels: [[220; 3], [100; 3]], ..clipped };
        let mut both = vec![darker; 500];
        both.extend(vec![clipped; 500]);
        assert!((gain(&both) - gain(&vec![darker; 500])).abs() < 1e-9);
    }

    #[test]
    fn nothing_in_common_changes_nothing() {
        let mut apart = preview(&[[1.0; 3]; 3], 0.0, 0.0, false);
        apart.pieces.remove(1);
        let found = estimate_gains(&apart, &[0, 2], 3, Exposure::Match, &Silent).unwrap();
        assert_eq!(found, Gains::none(3));
    }
}
