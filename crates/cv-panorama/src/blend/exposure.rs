//! Brightness and color differences between photographs (after Brown & Lowe 2007, §6, and Goldman & Chen 2005).
//!
//! Where photographs overlap they saw the same light, so `log I_a + g_a + v(r_a) = log I_b + g_b + v(r_b)`, with a gain `g` per photograph
//! and channel and one vignetting toward the corners, `v(r) = v₁ r² + v₂ r⁴`. In logarithms that is linear.

use crate::surface::{Piece, Preview};
use cv_core::{Cancelled, Progress, Stage, named};
use nalgebra::{DMatrix, DVector};

/// How exposure differences are evened out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Exposure {
    /// Not at all.
    None,
    /// One factor per photograph and channel: exposure and white balance.
    #[default]
    Gain,
    /// The same, and the vignetting of the lens.
    GainAndVignetting,
}

named!(Exposure { None = "none", Gain = "gain", GainAndVignetting = "vignetting" });

/// What to multiply each photograph with.
#[derive(Debug, Clone, PartialEq)]
pub struct Gains {
    /// Factors on red, green and blue of each photograph.
    pub gains: Vec<[f32; 3]>,
    /// `v₁` and `v₂`: a pixel at distance r from the middle (1 at the corners) is multiplied by `exp(v₁ r² + v₂ r⁴)`.
    pub vignetting: [f32; 2],
}

impl Gains {
    /// The level that becomes white, 255 or more: the brightest that a photograph's own white comes to. What a gain lifts above 255 is compressed, not
    /// cut off: the photographs that are brightened are often those with the brightest things in them.
    pub(crate) fn white(&self) -> f32 {
        255.0 * self.gains.iter().flatten().copied().fold(1.0, f32::max)
    }

    pub(crate) fn none(photos: usize) -> Self {
        Self { gains: vec![[1.0; 3]; photos], vignetting: [0.0; 2] }
    }
}

/// Two photographs' readings of one place.
struct Sample {
    a: usize,
    b: usize,
    /// log I_a − log I_b of each channel.
    difference: [f64; 3],
    /// r² of both.
    radius: [f64; 2],
}

/// Samples taken from each overlap at most.
const PER_OVERLAP: usize = 3000;
/// Channels outside this range say nothing: clipped, or noise.
const READABLE: std::ops::RangeInclusive<u8> = 10..=245;
/// Difference of logarithms at which a sample counts half: moving things and misalignment differ by more, exposure noise by less.
const SCALE: f64 = 0.1;
/// How strongly each gain is held to one, in samples per photograph: enough to settle the common factor, nothing else.
const PRIOR: f64 = 1.0;

/// Gains from the overlaps on the preview.
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
    let vignetting = exposure == Exposure::GainAndVignetting;
    let stage = Stage::new(progress, "exposure", 3 + usize::from(vignetting))?;
    let samples = samples(preview, photo_of, &stage)?;
    if samples.is_empty() {
        return Ok(gains);
    }
    let mut fall_off = [0.0; 2];
    if vignetting {
        let solution = solve(&samples, photos, |s| s.difference.iter().sum::<f64>() / 3.0, true, &stage)?;
        stage.add(1)?;
        // Corners are darkened, never by more than a factor of four; what says otherwise is not a lens.
        let (v1, v2) = (solution[photos], solution[photos + 1]);
        if (0.0..1.4).contains(&(v1 + v2)) {
            fall_off = [v1, v2];
            gains.vignetting = [v1 as f32, v2 as f32];
        }
    }
    for channel in 0..3 {
        let correction = |s: &Sample| {
            let v = |r2: f64| r2 * (fall_off[0] + r2 * fall_off[1]);
            s.difference[channel] + v(s.radius[0]) - v(s.radius[1])
        };
        let solution = solve(&samples, photos, correction, false, &stage)?;
        stage.add(1)?;
        for (gain, log) in gains.gains.iter_mut().zip(solution.iter()) {
            gain[channel] = log.clamp(-2.0, 2.0).exp() as f32;
        }
    }
    Ok(gains)
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
            let step = ((common.width() * common.height()) as f64 / PER_OVERLAP as f64).sqrt().ceil().max(1.0) as usize;
            for y in (common.top..common.bottom).step_by(step) {
                for x in (common.left..common.right).step_by(step) {
                    let (Some(a), Some(b)) = (p.warped.color(x, y), q.warped.color(x, y)) else { continue };
                    if !a.iter().chain(&b).all(|v| READABLE.contains(v)) {
                        continue;
                    }
                    let r2 = |piece: &Piece| {
                        let b = piece.warped.bounds;
                        f64::from(piece.radius[(y - b.top) * b.width() + x - b.left])
                    };
                    samples.push(Sample {
                        a: photo_of[i],
                        b: photo_of[j],
                        difference: std::array::from_fn(|c| (f64::from(a[c]) / f64::from(b[c])).ln()),
                        radius: [r2(p), r2(q)],
                    });
                }
            }
        }
    }
    Ok(samples)
}

/// Gains (and two coefficients of vignetting) by iteratively reweighted least squares, so that what moved or does not fit counts little.
fn solve(
    samples: &[Sample],
    photos: usize,
    difference: impl Fn(&Sample) -> f64,
    vignetting: bool,
    stage: &Stage<'_>,
) -> Result<DVector<f64>, Cancelled> {
    let n = photos + if vignetting { 2 } else { 0 };
    let mut solution = DVector::zeros(n);
    for round in 0..12 {
        stage.check()?;
        let mut normal = DMatrix::<f64>::zeros(n, n);
        let mut right = DVector::<f64>::zeros(n);
        for s in samples {
            let d = difference(s);
            let radial = [s.radius[0] - s.radius[1], s.radius[0].powi(2) - s.radius[1].powi(2)];
            let terms = [(s.a, 1.0), (s.b, -1.0), (photos, radial[0]), (photos + 1, radial[1])];
            let terms = &terms[..if vignetting { 4 } else { 2 }];
            let residual = d + terms.iter().map(|&(k, c)| c * solution[k]).sum::<f64>();
            // The first rounds are wide: exposures may differ by stops.
            let scale = (1.0 / f64::from(1 << round.min(8))).max(SCALE);
            let weight = 1.0 / (1.0 + (residual / scale).powi(2));
            for &(k, c) in terms {
                right[k] -= weight * c * d;
                for &(l, e) in terms {
                    normal[(k, l)] += weight * c * e;
                }
            }
        }
        for k in 0..n {
            normal[(k, k)] += PRIOR;
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

    /// Three photographs of 60 x 40, 30 apart, of one scene, darkened by known factors and toward their corners.
    fn preview(factors: &[[f64; 3]; 3], fall_off: f64, moved: bool) -> Preview {
        let scene = |x: usize, y: usize, c: usize| {
            60.0 + 100.0 * (0.5 + 0.5 * ((x * (c + 2)) as f64 * 0.07).sin() * (y as f64 * 0.11).cos())
        };
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
                    let value = |c: usize| if person { 30.0 } else { scene(30 * k + x, y, c) * factors[k][c] * dim };
                    [value(0).round() as u8, value(1).round() as u8, value(2).round() as u8, 255]
                });
                Piece { warped: WarpedPhoto { bounds, pixels }, eccentricity: radius.clone(), radius }
            })
            .collect();
        Preview { step: 1, width: 120, height: 40, pieces }
    }

    #[test]
    fn factors_on_exposure_and_white_balance_are_undone_though_somebody_walked_through() {
        let factors = [[1.0, 1.0, 1.0], [0.7, 0.75, 0.8], [1.3, 1.2, 1.25]];
        let found = estimate_gains(&preview(&factors, 0.0, true), &[0, 1, 2], 3, Exposure::Gain, &Silent).unwrap();
        for c in 0..3 {
            let common = f64::from(found.gains[0][c]) * factors[0][c];
            for (gain, factor) in found.gains.iter().zip(&factors) {
                // Rounding to bytes is 0.5 of 60 to 200, averaged over hundreds of samples; the walker, at half weight or less, is a
                // seventh of one overlap.
                assert!((f64::from(gain[c]) * factor[c] / common - 1.0).abs() < 0.01, "{:?}", found.gains);
            }
        }
        // The most darkened channel is lifted most: red of the second photograph.
        assert_eq!(found.white(), 255.0 * found.gains[1][0]);
        assert_eq!(Gains { gains: vec![[0.5; 3], [0.9, 0.7, 0.8]], vignetting: [0.0; 2] }.white(), 255.0);
        // The common factor stays where the photographs' own mean is.
        let product: f32 = found.gains.iter().map(|g| g[0]).product();
        assert!((product - 1.0).abs() < 0.02, "{product}");
    }

    #[test]
    fn the_fall_off_toward_the_corners_is_found() {
        let found =
            estimate_gains(&preview(&[[1.0; 3]; 3], 0.4, false), &[0, 1, 2], 3, Exposure::GainAndVignetting, &Silent)
                .unwrap();
        let v = |r2: f32| r2 * (found.vignetting[0] + r2 * found.vignetting[1]);
        // Rounding to bytes again, now through differences of r² of up to 0.7.
        assert!((v(1.0) - 0.4).abs() < 0.04 && (v(0.5) - 0.2).abs() < 0.03, "{:?}", found.vignetting);
    }

    #[test]
    fn nothing_in_common_changes_nothing() {
        let mut apart = preview(&[[1.0; 3]; 3], 0.0, false);
        apart.pieces.remove(1);
        let found = estimate_gains(&apart, &[0, 2], 3, Exposure::Gain, &Silent).unwrap();
        assert_eq!(found, Gains::none(3));
    }

    #[test]
    fn the_gains_of_exact_samples_are_those_that_made_them() {
        let logs = [0.2, -0.35, 0.1, 0.05];
        let sample = |a: usize, b: usize| Sample { a, b, difference: [logs[b] - logs[a]; 3], radius: [0.3, 0.6] };
        let pairs = [(0, 1), (1, 2), (2, 3), (0, 3)];
        let samples: Vec<Sample> = (0..2000).map(|i| sample(pairs[i % 4].0, pairs[i % 4].1)).collect();
        let solution = solve(&samples, 4, |s| s.difference[0], false, &crate::testing::stage()).unwrap();
        // The prior (one sample's weight against a thousand) pulls logarithms of up to 0.35 by some 1e-3 of that.
        for i in 0..4 {
            assert!((solution[i] - logs[i]).abs() < 1e-3, "{solution}");
        }
    }
}
