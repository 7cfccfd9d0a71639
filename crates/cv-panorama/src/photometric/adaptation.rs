//! Local adaptation: every place of the panorama in the exposure of the photographs that show it.
//!
//! Where exposures span stops, one exposure of the panorama is too dark at one end and washed out at the other. Hugin blends one panorama per exposure and fuses them (Mertens,
//! Kautz & Van Reeth 2007, "Exposure fusion"), which needs pyramids of the whole canvas. Here a lift in stops is added to the log radiance before tone mapping, a function of canvas position and
//! luminance that all photographs share, so that no seam becomes visible that was not:
//!
//! * The target at a preview pixel is the exposure of the photographs there (minus their log gains), weighted by how well each is exposed there (as in exposure fusion) and by the distance
//!   from its center. Where one photograph alone shows a place, that is its exposure, whatever the content.
//! * The target is smoothed by a guided filter (He, Sun & Tang 2013, "Guided image filtering") with log luminance as the guide: sky and roof may get different lifts in one overlap
//!   without a halo between them. The filter's output is linear in the guide, `slope · guide + offset`, and the two coefficients are smooth: they are interpolated from the preview and applied
//!   to the guide at full resolution (He & Sun 2015, "Fast guided filter").
//!
//! Slopes are limited, so that order and two thirds of the contrast are kept; lifts are limited to the exposures of the photographs.

use crate::photometric::{Exposure, ExposureCorrection, Gains, SATURATED_LEVEL};
use crate::surface::{Layout, Piece, Preview};
use cv_core::{Cancelled, Progress, Scaling, Stage, luma_f32};
use cv_parallel::prelude::*;

/// Ranges of exposure, in stops, up to which the lift is 0 and from which on it is full: half a stop is the usual scatter of automatic exposure, which nobody sees as too dark; 1.5 stops exceed the
/// range of a photograph's midtones.
const RANGE_STOPS: [f32; 2] = [0.5, 1.5];
/// Window radius of the guided filter relative to the side of a photograph. It is applied twice (means of the data, means of the coefficients): transitions are twice as wide.
const RADIUS_RATIO: f64 = 1.0 / 10.0;
/// Regularization of the guided filter in stops²: contrasts of less than about its root are detail, to which the lift does not respond.
const REGULARIZATION: f64 = 0.25;
/// Minimum slope of the lift by log luminance: at −1 contrast would vanish. Steeper slopes give halos where the fits of windows with and without an edge are averaged.
const MIN_SLOPE: f64 = -0.35;
/// Mean and standard deviation of levels, 0 to 1, that are well exposed (Mertens et al. 2007).
const WELL_EXPOSED: [f32; 2] = [0.5, 0.2];
/// Exponent of the weight of a photograph by the squared distance from its center, 1 at the corners. The ratio of such Gaussian weights of two photographs side by side does not depend on the height: neither does the
/// target in a plain sky.
const CENTER_EXPONENT: f32 = 5.0;
/// Factor of the decline of weights at the border of a photograph: over an eighth of its half side.
const BORDER_SLOPE: f32 = 4.0;
/// Minimum weights of a badly exposed, of a clipped and of a border pixel: what only one photograph shows has its exposure.
const MIN_WEIGHT: f32 = 0.02;
/// Share of pixels above the highest radiance of the tone curve: glints.
const GLINTS: f64 = 1e-3;
/// Quantization of the histogram of log radiance per stop.
const BINS_PER_STOP: f32 = 32.0;

/// Lift in stops as a function of canvas position and log luminance.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Adaptation {
    /// Canvas pixels per preview pixel.
    step: usize,
    width: usize,
    height: usize,
    /// Slope and offset of the lift by log₂ luminance, per preview pixel.
    coefficients: Vec<[f32; 2]>,
    /// Range of log₂ luminance; beyond it the lift is constant.
    guide: [f32; 2],
    /// Range of lifts: the exposures of the photographs.
    lift: [f32; 2],
    /// Highest log₂ radiance after the lift, 0 or more.
    highest: f64,
}

/// Sums over the windows of a guided filter.
struct Windows {
    width: usize,
    height: usize,
    radius: usize,
    /// Whether the right edge continues at the left one.
    wraps: bool,
}

impl Adaptation {
    /// Computes the lift from an uncorrected preview; `None` where photographs keep the exposure of [`Exposure::Match`]: for other methods, and where exposures hardly differ.
    pub(crate) fn new(
        preview: &Preview,
        gains: &Gains,
        photo_of: &[usize],
        exposure: Exposure,
        layout: &Layout,
        progress: &dyn Progress,
    ) -> Result<Option<Self>, Cancelled> {
        let radius = (layout.typical_side() / preview.step as f64 * RADIUS_RATIO).round().max(2.0) as usize;
        Self::of_preview(preview, gains, photo_of, exposure, (radius, layout.full_circle), progress)
    }

    fn of_preview(
        preview: &Preview,
        gains: &Gains,
        photo_of: &[usize],
        exposure: Exposure,
        (radius, wraps): (usize, bool),
        progress: &dyn Progress,
    ) -> Result<Option<Self>, Cancelled> {
        let stops: Vec<f32> = photo_of.iter().map(|&photo| mean_stops(gains, photo)).collect();
        let extent = |stops: &[f32]| {
            stops.iter().fold([f32::INFINITY, f32::NEG_INFINITY], |[low, high], v| [low.min(*v), high.max(*v)])
        };
        let [low, high] = extent(&stops);
        let strength = ((high - low - RANGE_STOPS[0]) / (RANGE_STOPS[1] - RANGE_STOPS[0])).clamp(0.0, 1.0);
        let strength = strength * strength * (3.0 - 2.0 * strength);
        // A range of no photographs is NaN.
        if exposure != Exposure::Adapt || strength.is_nan() || strength <= 0.0 {
            return Ok(None);
        }
        let stage = Stage::new(progress, "exposure", 3)?;
        let targets: Vec<f32> = stops.iter().map(|stops| -strength * stops).collect();
        let (width, height) = (preview.width, preview.height);
        let tone = gains.tone(1);
        let corrections: Vec<_> = photo_of.iter().map(|&k| ExposureCorrection::new(&tone, gains, k)).collect();
        // Guide and target of every preview pixel that a photograph covers.
        let places: Vec<Option<[f32; 2]>> = (0..width * height)
            .into_par_iter()
            .map(|i| {
                let (x, y) = (i % width, i / width);
                let mut sums = [0.0_f32; 3];
                for ((piece, correction), target) in preview.pieces.iter().zip(&corrections).zip(&targets) {
                    let Some(color) = piece.warped.color(x, y) else { continue };
                    let k = piece.warped.bounds.index(x, y);
                    let luma = luma_f32(color.map(f32::from));
                    let weight = well_exposed(luma / 255.0, piece.clipped[k]) * central(piece, k);
                    let guide = correction.log_luminance(luma) + correction.vignetting_stops(piece.radius[k]);
                    sums = [sums[0] + weight, sums[1] + weight * guide, sums[2] + weight * target];
                }
                (sums[0] > 0.0).then(|| [sums[1] / sums[0], sums[2] / sums[0]])
            })
            .collect();
        stage.add(1)?;
        let guide = extent(&places.iter().flatten().map(|place| place[0]).collect::<Vec<_>>());
        if guide[0] > guide[1] {
            return Ok(None);
        }
        let windows = Windows { width, height, radius, wraps };
        let coefficients = windows.guided(&places, &stage)?;
        let mut adaptation =
            Self { step: preview.step, width, height, coefficients, guide, lift: extent(&targets), highest: 0.0 };
        stage.add(1)?;
        let strength = f64::from(strength);
        let highest = adaptation.highest_of(preview, &corrections);
        adaptation.highest = (1.0 - strength) * gains.headroom_stops() + strength * highest;
        stage.add(1)?;
        Ok(Some(adaptation))
    }

    /// Returns the highest log₂ radiance after the lift that a photograph of the preview shows, but for glints; 0 or more.
    fn highest_of(&self, preview: &Preview, corrections: &[ExposureCorrection<'_>]) -> f64 {
        let mut counts = [0_usize; 512];
        let mut total = 0;
        for (piece, correction) in preview.pieces.iter().zip(corrections) {
            let b = piece.warped.bounds;
            for (x, y) in (b.top..b.bottom).flat_map(|y| (b.left..b.right).map(move |x| (x, y))) {
                let Some(color) = piece.warped.color(x, y) else { continue };
                let k = piece.warped.bounds.index(x, y);
                let own = correction.vignetting_stops(piece.radius[k]);
                let guide = correction.log_luminance(luma_f32(color.map(f32::from))) + own;
                total += 1;
                // White stays white.
                if color.iter().all(|v| *v >= SATURATED_LEVEL) {
                    continue;
                }
                let stops = own + self.at_preview(x, y, guide);
                let most = (0..3).map(|c| correction.log_radiance(c, f32::from(color[c]))).fold(f32::MIN, f32::max);
                let bin = ((most + stops) * BINS_PER_STOP).ceil();
                counts[bin.clamp(0.0, 511.0) as usize] += 1;
            }
        }
        let allowed = (GLINTS * total as f64) as usize;
        let mut above = 0;
        for (bin, count) in counts.iter().enumerate().rev() {
            above += count;
            if above > allowed {
                return bin as f64 / f64::from(BINS_PER_STOP);
            }
        }
        0.0
    }

    /// Returns the highest log₂ radiance after the lift.
    pub(crate) fn highest(&self) -> f64 {
        self.highest
    }

    /// Returns the lift at a preview pixel.
    pub(crate) fn at_preview(&self, x: usize, y: usize, guide: f32) -> f32 {
        self.lift(self.coefficients[y * self.width + x], guide)
    }

    #[inline(always)]
    fn lift(&self, [slope, offset]: [f32; 2], guide: f32) -> f32 {
        (slope * guide.clamp(self.guide[0], self.guide[1]) + offset).clamp(self.lift[0], self.lift[1])
    }

    /// Adds the lifts of a row of canvas pixels from `(left, y)`, with these log₂ luminances.
    #[inline(always)]
    pub(crate) fn add_row(&self, (left, y): (usize, usize), guides: &[f32], lifts: &mut [f32]) {
        // As labels are upsampled: bilinear, constant beyond the middles of the outer preview pixels.
        let place = |v: usize, n: usize| {
            let t = Scaling::coordinate(v as f64, 1.0 / self.step as f64).max(0.0) as f32;
            let i = (t as usize).min(n - 1);
            (i, (i + 1).min(n - 1), t - i as f32)
        };
        let (y0, y1, fy) = place(y, self.height);
        let (above, below) = (&self.coefficients[y0 * self.width..], &self.coefficients[y1 * self.width..]);
        for ((x, guide), lift) in (left..).zip(guides).zip(lifts) {
            let (x0, x1, fx) = place(x, self.width);
            let coefficient = |k: usize| {
                let (top, bottom) = (
                    above[x0][k] + fx * (above[x1][k] - above[x0][k]),
                    below[x0][k] + fx * (below[x1][k] - below[x0][k]),
                );
                top + fy * (bottom - top)
            };
            *lift += self.lift([coefficient(0), coefficient(1)], *guide);
        }
    }
}

/// Returns the mean gain of a photograph's channels in stops.
pub(crate) fn mean_stops(gains: &Gains, photo: usize) -> f32 {
    gains.gains.get(photo).map_or(0.0, |gain| gain.iter().map(|g| g.log2()).sum::<f32>() / 3.0)
}

/// Returns the weight of a photograph at a pixel by its place.
fn central(piece: &Piece, k: usize) -> f32 {
    let taper = (BORDER_SLOPE * (1.0 - piece.eccentricity[k])).clamp(MIN_WEIGHT, 1.0);
    (-CENTER_EXPONENT * piece.radius[k]).exp() * taper
}

/// Returns how well a pixel is exposed, above 0 to 1, by its luma of 0 to 1 and whether it is clipped (Mertens et al. 2007).
pub(crate) fn well_exposed(luma: f32, is_clipped: bool) -> f32 {
    let off = (luma - WELL_EXPOSED[0]) / WELL_EXPOSED[1];
    if is_clipped { MIN_WEIGHT } else { (-0.5 * off * off).exp().max(MIN_WEIGHT) }
}

impl Windows {
    /// Fits `target ≈ slope · guide + offset` in the window around every pixel, and returns the means of slope and offset over the windows that contain it. Pixels without data do not count.
    fn guided(&self, places: &[Option<[f32; 2]>], stage: &Stage<'_>) -> Result<Vec<[f32; 2]>, Cancelled> {
        let data = |place: &Option<[f32; 2]>| match place.map(|p| p.map(f64::from)) {
            Some([guide, target]) => [1.0, guide, target, guide * guide, guide * target],
            None => [0.0; 5],
        };
        let fits = self.sums(places.iter().map(data).collect(), stage)?;
        let fit = |(sums, place): (&[f64; 5], &Option<[f32; 2]>)| {
            if place.is_none() {
                return [0.0; 3];
            }
            let [n, guide, target, square, product] = *sums;
            let (guide, target) = (guide / n, target / n);
            let (variance, covariance) = (square / n - guide * guide, product / n - guide * target);
            let slope = (covariance / (variance.max(0.0) + REGULARIZATION)).clamp(MIN_SLOPE, 0.0);
            [1.0, slope, target - slope * guide]
        };
        let means = self.sums(fits.iter().zip(places).map(fit).collect(), stage)?;
        let mean =
            |[n, slope, offset]: [f64; 3]| if n > 0.0 { [(slope / n) as f32, (offset / n) as f32] } else { [0.0; 2] };
        Ok(means.into_iter().map(mean).collect())
    }

    /// Sums over the square window of each pixel, clipped to the image unless it wraps. Each sum is over prefix sums of its row and column in a fixed order.
    fn sums<const N: usize>(&self, values: Vec<[f64; N]>, stage: &Stage<'_>) -> Result<Vec<[f64; N]>, Cancelled> {
        let (width, height, radius) = (self.width, self.height, self.radius);
        let mut rows = values;
        rows.par_chunks_mut(width.max(1)).try_for_each(|row| {
            stage.check()?;
            running_sums(row, radius, self.wraps);
            Ok(())
        })?;
        let columns: Vec<Vec<[f64; N]>> = (0..width)
            .into_par_iter()
            .map(|x| {
                stage.check()?;
                let mut column: Vec<[f64; N]> = (0..height).map(|y| rows[y * width + x]).collect();
                running_sums(&mut column, radius, false);
                Ok(column)
            })
            .try_collect()?;
        rows.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
            row.iter_mut().zip(&columns).for_each(|(sum, column)| *sum = column[y]);
        });
        Ok(rows)
    }
}

/// Replaces each value by the sum of those within `radius`.
fn running_sums<const N: usize>(values: &mut [[f64; N]], radius: usize, wraps: bool) {
    let n = values.len();
    let mut prefix = Vec::with_capacity(n + 1);
    let mut sum = [0.0; N];
    prefix.push(sum);
    for value in values.iter() {
        sum = std::array::from_fn(|k| sum[k] + value[k]);
        prefix.push(sum);
    }
    let between = |first: usize, end: usize| -> [f64; N] { std::array::from_fn(|k| prefix[end][k] - prefix[first][k]) };
    // A window longer than a full circle would count values twice.
    let wraps = wraps && 2 * radius < n;
    for (i, value) in values.iter_mut().enumerate() {
        *value = between(i.saturating_sub(radius), (i + radius + 1).min(n));
        if wraps && i < radius {
            let beyond = between(n + i - radius, n);
            *value = std::array::from_fn(|k| value[k] + beyond[k]);
        }
        if wraps && i + radius >= n {
            let beyond = between(0, i + radius + 1 - n);
            *value = std::array::from_fn(|k| value[k] + beyond[k]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Bounds;
    use crate::testing::{StopAt, drawn, stage};
    use cv_core::Silent;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn window_sums_are_those_of_the_definition(values in proptest::collection::vec(-9..9_i32, 35), radius in 0..4_usize, wraps: bool) {
            let (w, h) = (7_usize, 5_usize);
            let windows = Windows { width: w, height: h, radius, wraps };
            // Whole numbers: exact in any order.
            let sums = windows.sums(values.iter().map(|v| [f64::from(*v), 1.0]).collect(), &stage()).unwrap();
            for (i, sum) in sums.iter().enumerate() {
                let (x, y) = (i % w, i / w);
                let around = |(u, v): &(usize, usize)| {
                    let across = u.abs_diff(x);
                    // A window of the whole circle or more does not wrap.
                    let across = if wraps && 2 * radius < w { across.min(w - across) } else { across };
                    across <= radius && v.abs_diff(y) <= radius
                };
                let places: Vec<_> = (0..h).flat_map(|v| (0..w).map(move |u| (u, v))).filter(around).collect();
                let expected: i32 = places.iter().map(|(u, v)| values[v * w + u]).sum();
                prop_assert_eq!(*sum, [f64::from(expected), places.len() as f64]);
            }
        }
    }

    /// Two photographs of 60 columns, 30 apart, of a dark roof below a bright sky; the second has `stops` more light.
    fn preview(stops: f32) -> (Preview, Gains) {
        let level = |light: f32| (255.0 * light.min(1.0).powf(1.0 / 2.2)).round() as u8;
        let pieces = (0..2).map(|k| {
            let bounds = Bounds { left: 30 * k, top: 0, right: 30 * k + 60, bottom: 40 };
            let exposure = (k as f32 * stops).exp2();
            let color = move |_: usize, y: usize| [level(exposure * if y < 20 { 0.4 } else { 0.02 }); 3];
            let eccentricity: Vec<f32> = (0..60 * 40).map(|i| (((i % 60) as f32 - 29.5) / 30.0).powi(2)).collect();
            let warped = drawn(bounds, color);
            let radius = eccentricity.iter().map(|e| 0.7 * e).collect();
            Piece::new(warped, eccentricity, radius, 0.0)
        });
        let preview = Preview { step: 1, width: 90, height: 40, full_circle: false, pieces: pieces.collect() };
        let gain = |stops: f32| [stops.exp2(); 3];
        (preview, Gains { gains: vec![gain(0.5 * stops), gain(-0.5 * stops)], ..Gains::none(2) })
    }

    fn adapted(stops: f32) -> Option<Adaptation> {
        let (preview, gains) = preview(stops);
        Adaptation::of_preview(&preview, &gains, &[0, 1], Exposure::Adapt, (4, false), &Silent).unwrap()
    }

    #[test]
    fn exposures_within_half_a_stop_are_left_alone() {
        for stops in [0.0, 0.3, -0.49] {
            assert_eq!(adapted(stops), None, "{stops}");
        }
        assert!(adapted(0.6).is_some());
        let (preview, gains) = preview(3.0);
        for exposure in [Exposure::Match, Exposure::None] {
            let none = Adaptation::of_preview(&preview, &gains, &[0, 1], exposure, (4, false), &Silent).unwrap();
            assert_eq!(none, None);
        }
        // A panorama of which nothing is seen.
        let empty = Preview { pieces: Vec::new(), ..preview };
        assert_eq!(Adaptation::of_preview(&empty, &gains, &[], Exposure::Adapt, (4, false), &Silent).unwrap(), None);
    }

    #[test]
    fn a_place_has_the_exposure_of_the_photograph_that_shows_it_and_in_overlaps_of_that_which_shows_it_well() {
        let map = adapted(3.0).unwrap();
        // 0.4 and 0.02 of white by the first photograph, which is lifted by 1.5 stops.
        let guide = |y: usize| (if y < 20 { 0.4_f32 } else { 0.02 }).log2() + 1.5;
        let at = |x: usize, y: usize| map.at_preview(x, y, guide(y));
        // Beyond the windows of the filter, 2 · 4, from the overlap.
        for y in [5, 35] {
            assert!((at(5, y) + 1.5).abs() < 1e-3 && (at(85, y) - 1.5).abs() < 1e-3, "{} {}", at(5, y), at(85, y));
        }
        // In the middle of the overlap the sky is clipped in the second, and the roof dark in the first.
        let (sky, roof) = (at(45, 5), at(45, 35));
        assert!(sky < -0.6 && roof > 0.6, "{sky} {roof}");
        // The lift never leaves the range of the photographs, whatever the guide, and falls with it.
        for x in 0..90 {
            let lifts: Vec<f32> = (-40..20).map(|g| map.at_preview(x, 20, 0.5 * g as f32)).collect();
            assert!(lifts.iter().all(|v| (-1.5..=1.5).contains(v)) && lifts.is_sorted_by(|a, b| a >= b), "{lifts:?}");
        }
    }

    #[test]
    fn order_and_two_thirds_of_the_contrast_are_kept() {
        let map = adapted(4.0).unwrap();
        for x in 0..90 {
            for y in 0..40 {
                let tones: Vec<f32> = (-24..16).map(|g| 0.25 * g as f32).map(|g| g + map.at_preview(x, y, g)).collect();
                // Rounding of numbers of some stops.
                assert!(tones.windows(2).all(|t| t[1] - t[0] >= 0.65 * 0.25 - 1e-5), "{x} {y}");
            }
        }
    }

    #[test]
    fn rows_of_the_canvas_interpolate_the_preview() {
        let map = Adaptation { step: 4, ..adapted(3.0).unwrap() };
        let guides = vec![-2.0; 360];
        let mut row = vec![0.25; 360];
        // Canvas row 41 is at preview row 9.875.
        map.add_row((0, 41), &guides, &mut row);
        let at = |x: usize| 0.125 * map.at_preview(x, 9, -2.0) + 0.875 * map.at_preview(x, 10, -2.0) + 0.25;
        for x in 1..89 {
            // Canvas columns 4 x + 1 and 4 x + 2 lie an eighth of a preview pixel on either side of its middle. Clamped lifts and products of coefficients are linear within it but for the
            // limits: a few ten thousandths.
            let middle = 0.5 * (row[4 * x + 1] + row[4 * x + 2]);
            assert!((middle - at(x)).abs() < 0.02, "{x}: {middle} {}", at(x));
        }
        // A part of a row is the same.
        let mut part = vec![0.25; 100];
        map.add_row((130, 41), &guides[..100], &mut part);
        assert_eq!(part, row[130..230]);
    }

    #[test]
    fn it_can_be_stopped() {
        let (preview, gains) = preview(3.0);
        let make = |progress: &dyn Progress| {
            Adaptation::of_preview(&preview, &gains, &[0, 1], Exposure::Adapt, (4, false), progress)
        };
        let watched = StopAt::never();
        make(&watched).unwrap();
        for at in 1..=watched.reports().min(20) {
            assert_eq!(make(&StopAt::report(at)), Err(Cancelled), "{at}");
        }
    }
}
