//! Tone mapping from levels of a photograph to levels of the panorama: inverse response, exposure correction, then the camera's own response, so that the
//! panorama looks like the photographs. Radiance above white is compressed instead of clipped.

use crate::photometric::{Adaptation, Gains, Response};
use cv_core::luma_f32;
use cv_imgproc::integer_and_fraction;

/// Table entries per stop.
const ENTRIES_PER_STOP: f32 = 32.0;
/// log₂ radiance of the first table entry.
const MIN_LOG_RADIANCE: f32 = -16.0;
/// Table entries per level of a photograph: quantizes levels to within a sixteenth.
const ENTRIES_PER_LEVEL: usize = 8;
/// Level above which highlights are compressed.
const KNEE: f64 = 190.0;

/// Lookup tables shared by all photographs of a panorama.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Tone {
    /// log₂ radiance by level of a photograph, as a fractional index into `levels`; the last entry is repeated.
    log_radiance: Box<[f32; 2048]>,
    /// Level of the panorama by log₂ radiance; the last entry is repeated. (Lengths are powers of two, so that a mask bounds an index.)
    levels: Box<[f32; 1024]>,
}

impl Tone {
    /// Builds the tables for a response and highlights of up to `highest` stops above white.
    ///
    /// Above white the response continues along its tangent. Levels up to the knee are unchanged; from there to the level of `highest` they are compressed to
    /// 255 by a rational curve of continuous slope (Reinhard et al., "Photographic tone reproduction for digital images", 2002, with a linear part).
    ///
    /// The response is sampled at `parts` per level (1 for bytes, at most [`ENTRIES_PER_LEVEL`]) and interpolated linearly in stops.
    pub(crate) fn new(response: &Response, highest: f64, parts: usize) -> Self {
        let parts = parts.clamp(1, ENTRIES_PER_LEVEL);
        let at = |v: usize| response.log_radiance((v as f64 / parts as f64).min(255.0) / 255.0) as f32;
        let mut log_radiance: Vec<f32> = (0..=255 * parts + 1).map(at).collect();
        // Below a quarter of a level the response is linear; black stays black for any gain.
        for v in 1..parts.div_ceil(4) {
            log_radiance[v] = log_radiance[parts.div_ceil(4)] + (v as f32 / parts.div_ceil(4) as f32).log2();
        }
        log_radiance[0] = MIN_LOG_RADIANCE;
        let per_stop = 255.0 / response.slope(1.0);
        let white = 255.0 + per_stop * highest.max(0.0);
        let a = (white - KNEE) / (255.0 - KNEE);
        let mut below = 0;
        let mut levels = Box::new([255.0; 1024]);
        for (i, entry) in levels.iter_mut().enumerate() {
            let stops = f64::from(MIN_LOG_RADIANCE + i as f32 / ENTRIES_PER_STOP);
            // Inverse of the monotonic response.
            while below < 255 * parts - 1 && f64::from(log_radiance[below + 1]) < stops {
                below += 1;
            }
            let (low, high) = (f64::from(log_radiance[below]), f64::from(log_radiance[below + 1]));
            let level = if stops >= 0.0 {
                255.0 + per_stop * stops
            } else {
                (below as f64 + ((stops - low) / (high - low)).clamp(0.0, 1.0)) / parts as f64
            };
            let t = ((level - KNEE) / (white - KNEE)).clamp(0.0, 1.0);
            let level = if level <= KNEE { level } else { KNEE + (255.0 - KNEE) * a * t / (1.0 + (a - 1.0) * t) };
            *entry = level as f32;
        }
        let index_of = |k: usize| {
            let step = ENTRIES_PER_LEVEL / parts;
            let (v, fraction) = ((k / step).min(255 * parts), (k % step) as f32 / step as f32);
            (log_radiance[v] + fraction * (log_radiance[v + 1] - log_radiance[v]) - MIN_LOG_RADIANCE) * ENTRIES_PER_STOP
        };
        Self { log_radiance: Box::new(std::array::from_fn(index_of)), levels }
    }

    /// Returns the fractional index into `levels` for a level: that of the nearest table entry, or, if `FINE`, linearly interpolated.
    #[inline(always)]
    fn index<const FINE: bool>(&self, level: f32) -> f32 {
        let (i, fraction) = entry_of_level::<FINE>(level);
        let low = self.log_radiance[i & 2047];
        if FINE { low + fraction * (self.log_radiance[(i + 1) & 2047] - low) } else { low }
    }

    /// Returns log₂ of the radiance of a level; 0 for white.
    #[inline(always)]
    fn stops<const FINE: bool>(&self, level: f32) -> f32 {
        self.index::<FINE>(level) * (1.0 / ENTRIES_PER_STOP) + MIN_LOG_RADIANCE
    }

    /// Returns the level of the panorama at a fractional index into `levels`.
    #[inline(always)]
    fn level(&self, index: f32) -> f32 {
        let (i, fraction) = entry_of_index(index);
        let (low, high) = (self.levels[i & 1023], self.levels[(i + 1) & 1023]);
        low + fraction * (high - low)
    }

    /// Replaces levels of a photograph by those of the panorama, after a gain in table entries: [`Self::level`] of [`Self::index`], one loop per step, so that all but the lookups are
    /// vectorized.
    #[inline(always)]
    fn map<const FINE: bool>(&self, values: &mut [f32; LANES], gains: &[f32; LANES]) {
        let (mut entries, mut fractions) = ([0; LANES], [0.0; LANES]);
        let (mut low, mut high) = ([0.0; LANES], [0.0; LANES]);
        for k in 0..LANES {
            let (i, fraction) = entry_of_level::<FINE>(values[k]);
            (entries[k], fractions[k]) = (i as u32, fraction);
        }
        for k in 0..LANES {
            let i = entries[k] as usize;
            low[k] = self.log_radiance[i & 2047];
            if FINE {
                high[k] = self.log_radiance[(i + 1) & 2047];
            }
        }
        for k in 0..LANES {
            let index = if FINE { low[k] + fractions[k] * (high[k] - low[k]) } else { low[k] };
            let (i, fraction) = entry_of_index(index + gains[k]);
            (entries[k], fractions[k]) = (i as u32, fraction);
        }
        for k in 0..LANES {
            let i = entries[k] as usize;
            (low[k], high[k]) = (self.levels[i & 1023], self.levels[(i + 1) & 1023]);
        }
        for k in 0..LANES {
            values[k] = low[k] + fractions[k] * (high[k] - low[k]);
        }
    }
}

/// Number of samples that are mapped at a time: two vectors of eight.
const LANES: usize = 16;

/// Returns the entry of `log_radiance` for a level (the nearest, or, if `FINE`, the one before it) and the fraction of the way to the next.
#[inline(always)]
fn entry_of_level<const FINE: bool>(level: f32) -> (usize, f32) {
    let (i, fraction) =
        integer_and_fraction(level.clamp(0.0, 255.0) * ENTRIES_PER_LEVEL as f32 + if FINE { 0.0 } else { 0.5 });
    (i as usize, fraction)
}

/// Returns the entry of `levels` before a fractional index, and the fraction of the way to the next.
#[inline(always)]
fn entry_of_index(index: f32) -> (usize, f32) {
    let (i, fraction) = integer_and_fraction(index.clamp(0.0, 1022.0));
    (i as usize, fraction)
}

/// Exposure correction of one photograph.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ExposureCorrection<'a> {
    pub(crate) tone: &'a Tone,
    /// Gains of red, green and blue in stops.
    pub(crate) gain: [f32; 3],
    /// Vignetting correction `v₁ r² + v₂ r⁴` in stops, r the distance from the image center, 1 at the corners.
    pub(crate) vignetting: [f32; 2],
    /// Radiance above which a sample is clipped; white is 1. For linear radiance only.
    pub(crate) clipped: f32,
    /// Local adaptation; not for linear radiance.
    pub(crate) adaptation: Option<&'a Adaptation>,
}

impl<'a> ExposureCorrection<'a> {
    /// Returns the correction of one photograph.
    pub(crate) fn new(tone: &'a Tone, gains: &Gains, photo: usize) -> Self {
        let gain = gains.gains.get(photo).map_or([0.0; 3], |g| g.map(f32::log2));
        let clipped = gains.clipped();
        let vignetting = gains.vignetting.map(|v| v * std::f32::consts::LOG2_E);
        Self { tone, gain, clipped, vignetting, adaptation: None }
    }

    /// Returns the correction with local adaptation.
    pub(crate) fn adapted(self, adaptation: Option<&'a Adaptation>) -> Self {
        Self { adaptation, ..self }
    }

    /// Returns log₂ of the corrected radiance of a channel's level, without vignetting correction; 0 for white.
    pub(crate) fn log_radiance(&self, channel: usize, level: f32) -> f32 {
        self.tone.stops::<false>(level) + self.gain[channel]
    }

    /// Returns log₂ of the corrected luminance of a luma level, without vignetting correction; 0 for white.
    pub(crate) fn log_luminance(&self, luma: f32) -> f32 {
        self.tone.stops::<false>(luma) + self.mean_gain()
    }

    #[inline(always)]
    fn mean_gain(&self) -> f32 {
        (self.gain[0] + self.gain[1] + self.gain[2]) * (1.0 / 3.0)
    }

    /// Adds the lifts of local adaptation of a row of canvas pixels from `place` to their vignetting correction; `guides` is a scratch buffer. `FINE`: for 16 bits.
    #[inline(always)]
    pub(crate) fn add_adaptation<const FINE: bool>(
        &self,
        place: (usize, usize),
        [r, g, b]: [&[f32]; 3],
        guides: &mut [f32],
        lifts: &mut [f32],
    ) {
        let Some(adaptation) = self.adaptation else { return };
        let gain = self.mean_gain();
        for ((((guide, r), g), b), lift) in guides.iter_mut().zip(r).zip(g).zip(b).zip(&*lifts) {
            *guide = self.tone.stops::<FINE>(luma_f32([*r, *g, *b])) + (gain + lift);
        }
        adaptation.add_row(place, guides, lifts);
    }

    /// Returns the vignetting correction, in stops, at a squared distance from the image center.
    #[inline(always)]
    pub(crate) fn vignetting_stops(&self, r2: f32) -> f32 {
        r2 * (self.vignetting[0] + r2 * self.vignetting[1])
    }

    /// Maps a color of the photograph to levels of the panorama; `lift` is an additional gain in stops.
    ///
    /// A color clipped in all channels is a lower bound, not a measurement: it is not darkened, and stays white for any gain.
    pub(crate) fn levels(&self, color: [f32; 3], lift: f32) -> [f32; 3] {
        let [mut r, mut g, mut b] = color.map(|v| [v]);
        self.row_of_levels::<false>([&mut r, &mut g, &mut b], &[lift], &mut [0.0]);
        [r[0], g[0], b[0]]
    }

    /// As [`Self::levels`], for rows of red, green, blue and additional stops of equal length; `clipped` is a scratch buffer. `FINE`: for 16 bits.
    #[inline(always)]
    pub(crate) fn row_of_levels<const FINE: bool>(&self, colors: [&mut [f32]; 3], lifts: &[f32], clipped: &mut [f32]) {
        /// Smallest channel at which a color begins to count as clipped, and at which it counts fully.
        const CLIPPED: [f32; 2] = [228.0, 252.0];
        let n = lifts.len();
        let ([r, g, b], clipped) = (colors.map(|c| &mut c[..n]), &mut clipped[..n]);
        for (((clipped, r), g), b) in clipped.iter_mut().zip(&*r).zip(&*g).zip(&*b) {
            let share = ((r.min(*g).min(*b) - CLIPPED[0]) * (1.0 / (CLIPPED[1] - CLIPPED[0]))).clamp(0.0, 1.0);
            *clipped = share * share * (3.0 - 2.0 * share);
        }
        // One channel at a time, so that lookups of different pixels overlap.
        for (values, gain) in [r, g, b].into_iter().zip(self.gain) {
            let ((values, last), (lifts, last_lifts)) = (values.as_chunks_mut::<LANES>(), lifts.as_chunks::<LANES>());
            let (clipped, last_clipped) = clipped.as_chunks::<LANES>();
            for ((values, lifts), clipped) in values.iter_mut().zip(lifts).zip(clipped) {
                let mut gains = [0.0; LANES];
                for (entries, lift) in gains.iter_mut().zip(lifts) {
                    *entries = (gain + lift) * ENTRIES_PER_STOP;
                }
                let own = *values;
                self.tone.map::<FINE>(values, &gains);
                for ((value, clipped), own) in values.iter_mut().zip(clipped).zip(own) {
                    *value += clipped * (own - *value).max(0.0);
                }
            }
            for ((value, lift), clipped) in last.iter_mut().zip(last_lifts).zip(last_clipped) {
                let tone = self.tone.level(self.tone.index::<FINE>(*value) + (gain + lift) * ENTRIES_PER_STOP);
                *value = tone + clipped * (*value - tone).max(0.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn correction(tone: &Tone, stops: f32) -> ExposureCorrection<'_> {
        ExposureCorrection { tone, gain: [stops; 3], vignetting: [0.0; 2], clipped: 1.0, adaptation: None }
    }

    #[test]
    fn without_a_gain_levels_stay_whatever_the_response() {
        for coefficients in [[0.0; 3], [0.8, -1.0, -1.2], [-0.4, 0.3, 0.2]] {
            let tone = Tone::new(&Response { coefficients }, 0.0, 1);
            for level in 0..=255 {
                let got = correction(&tone, 0.0).levels([level as f32; 3], 0.0)[0];
                // Chords of the curve over a 32nd of a stop, 2 % of the light, 1 % of the level: its curvature over that is a hundredth of it.
                assert!((got - level as f32).abs() < 0.06, "{coefficients:?} {level}: {got}");
            }
        }
    }

    #[test]
    fn a_row_is_mapped_as_its_pixels() {
        let tone = Tone::new(&Response { coefficients: [0.3, -0.2, 0.1] }, 1.0, ENTRIES_PER_LEVEL);
        let correction = correction(&tone, 0.4);
        // Beyond both ends of the tables too; two whole blocks and a rest.
        let level = |c: usize, i: usize| 8.37 * (i + 3 * c) as f32 - 20.0;
        let lifts: Vec<f32> = (0..37).map(|i| 0.11 * i as f32 - 2.0).collect();
        for fine in [false, true] {
            let rows_of = |n: usize, first: usize| -> [Vec<f32>; 3] {
                std::array::from_fn(|c| (first..first + n).map(|i| level(c, i)).collect())
            };
            let map = |rows: &mut [Vec<f32>; 3], lifts: &[f32]| {
                let colors = rows.each_mut().map(|row| &mut row[..]);
                let clipped = &mut vec![0.0; lifts.len()];
                if fine {
                    correction.row_of_levels::<true>(colors, lifts, clipped)
                } else {
                    correction.row_of_levels::<false>(colors, lifts, clipped)
                }
            };
            let mut all = rows_of(37, 0);
            map(&mut all, &lifts);
            for i in 0..37 {
                let mut one = rows_of(1, i);
                map(&mut one, &lifts[i..=i]);
                assert_eq!(one.map(|row| row[0]), [0, 1, 2].map(|c| all[c][i]), "{fine} {i}");
            }
        }
    }

    #[test]
    fn a_stop_more_is_twice_the_light() {
        let tone = Tone::new(&Response::default(), 1.0, 1);
        // IEC 61966-2-1: levels 100, 137 and 188 are 0.1274, 0.2502 and 0.5029 of white.
        assert!((correction(&tone, 1.0).levels([100.0, 137.0, 20.0], 0.0)[0] - 138.4).abs() < 0.5);
        assert!((correction(&tone, 0.5).levels([100.0, 137.0, 20.0], 0.5)[1] - 187.6).abs() < 0.5);
    }

    /// IEC 61966-2-1, in levels.
    fn light(level: f64) -> f64 {
        let v = level / 255.0;
        if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    }

    #[test]
    fn fine_curves_follow_the_standard_to_a_hundredth_of_a_level() {
        let tone = Tone::new(&Response::default(), 0.0, ENTRIES_PER_LEVEL);
        for stops in [-1.0, -0.3, 0.0, 0.4, 1.5_f32] {
            let correction = correction(&tone, stops);
            for k in 1..2200 {
                // Up to the knee of 190 levels and what counts as clipped.
                let level = 0.13 + 0.101 * f64::from(k);
                let target = light(level) * f64::from(stops).exp2();
                if level > 220.0 || target > light(185.0) {
                    continue;
                }
                let [mut r, mut g, mut b] = [[level as f32]; 3];
                correction.row_of_levels::<true>([&mut r, &mut g, &mut b], &[0.0], &mut [0.0]);
                // Chords over an eighth of a level and a 32nd of a stop, of which both curves are straight to one in 10,000; near black, over an eighth of a level, to its own size.
                let off = (light(f64::from(r[0])) / target).log2() / (Response::default().slope(level / 255.0) / 255.0);
                assert!(off.abs() < 0.01 + 0.02 / level, "{stops} {level}: {} {off}", r[0]);
            }
        }
    }

    #[test]
    fn tones_rise_and_reach_white() {
        for (stops, highest) in [(-1.3, 0.0), (0.0, 0.0), (-1.0, 1.0), (0.0, 1.0), (1.0, 1.0), (3.0, 3.5)] {
            let tone = Tone::new(&Response::default(), highest, 1);
            let level = |v: u16| correction(&tone, stops).levels([f32::from(v); 3], 0.0)[0];
            for v in 1..255 {
                assert!(level(v + 1) > level(v) || level(v) >= 254.9, "{stops} {highest} {v}");
            }
            // Clipped stays clipped.
            assert!((level(255) - 255.0).abs() < 1e-2 && level(0) < 1.0, "{stops} {highest}: {}", level(255));
        }
        // A saturated color is no white.
        let tone = Tone::new(&Response::default(), 0.0, 1);
        assert!(correction(&tone, -1.0).levels([255.0, 120.0, 0.0], 0.0)[0] < 190.0);
    }
}
