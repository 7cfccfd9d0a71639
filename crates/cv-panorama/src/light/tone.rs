//! From levels of a photograph to levels of the panorama: to light, by the photograph's exposure to the light of all, and back by the camera's own curve, so that the
//! panorama looks as the photographs do. What the brightened photographs have above white is compressed, not cut off.

use crate::light::{Gains, Response};

/// Entries per stop of light.
const PER_STOP: f32 = 32.0;
/// log₂ of the least light there is an entry for.
const LEAST: f32 = -16.0;
/// Entries per level of a photograph: to the nearest of them a level is rounded by a sixteenth at most.
const PER_LEVEL: usize = 8;
/// The level from which on there is room made for light above white.
const KNEE: f64 = 190.0;

/// The curves that all photographs of a panorama share.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Tone {
    /// log₂ of light by level of a photograph, as a place among `levels`, the last one repeated.
    light: Box<[f32; 2048]>,
    /// Level of the panorama by log₂ of light, the last one repeated. (Lengths are powers of two, so that a mask bounds an index.)
    levels: Box<[f32; 1024]>,
}

impl Tone {
    /// The curves for photographs of a response whose white may come to `highest` stops above white.
    ///
    /// Above white the response goes on along its tangent in stops. Levels up to the knee stay; from there to that of `highest` they are compressed to 255 by a
    /// rational curve of continuous slope (Reinhard et al., "Photographic tone reproduction for digital images", 2002, with a straight part).
    ///
    /// The response is found at so many `parts` of a level, 1 for bytes and [`PER_LEVEL`] at the most, and is linear in stops between.
    pub(crate) fn new(response: &Response, highest: f64, parts: usize) -> Self {
        let parts = parts.clamp(1, PER_LEVEL);
        let at = |v: usize| response.log_light((v as f64 / parts as f64).min(255.0) / 255.0) as f32;
        let mut light: Vec<f32> = (0..=255 * parts + 1).map(at).collect();
        // Below a quarter of a level light falls in proportion; black stays black whatever the gain.
        for v in 1..parts.div_ceil(4) {
            light[v] = light[parts.div_ceil(4)] + (v as f32 / parts.div_ceil(4) as f32).log2();
        }
        light[0] = LEAST;
        let per_stop = 255.0 / response.slope(1.0);
        let white = 255.0 + per_stop * highest.max(0.0);
        let a = (white - KNEE) / (255.0 - KNEE);
        let mut below = 0;
        let mut levels = Box::new([255.0; 1024]);
        for (i, entry) in levels.iter_mut().enumerate() {
            let stops = f64::from(LEAST + i as f32 / PER_STOP);
            // The inverse of the response, whose entries rise.
            while below < 255 * parts - 1 && f64::from(light[below + 1]) < stops {
                below += 1;
            }
            let (low, high) = (f64::from(light[below]), f64::from(light[below + 1]));
            let level = if stops >= 0.0 {
                255.0 + per_stop * stops
            } else {
                (below as f64 + ((stops - low) / (high - low)).clamp(0.0, 1.0)) / parts as f64
            };
            let t = ((level - KNEE) / (white - KNEE)).clamp(0.0, 1.0);
            let level = if level <= KNEE { level } else { KNEE + (255.0 - KNEE) * a * t / (1.0 + (a - 1.0) * t) };
            *entry = level as f32;
        }
        let place = |k: usize| {
            let step = PER_LEVEL / parts;
            let (v, fraction) = ((k / step).min(255 * parts), (k % step) as f32 / step as f32);
            (light[v] + fraction * (light[v + 1] - light[v]) - LEAST) * PER_STOP
        };
        Self { light: Box::new(std::array::from_fn(place)), levels }
    }

    /// Where among `levels` the light of a level lies, which may be between two: that of the nearest entry, or, `FINE`, between two.
    #[inline(always)]
    fn light<const FINE: bool>(&self, level: f32) -> f32 {
        if FINE {
            let (i, fraction) = split(level.clamp(0.0, 255.0) * PER_LEVEL as f32);
            let (low, high) = (self.light[i & 2047], self.light[(i + 1) & 2047]);
            return low + fraction * (high - low);
        }
        let (i, _) = split(level.clamp(0.0, 255.0) * PER_LEVEL as f32 + 0.5);
        self.light[i & 2047]
    }

    /// The level of the panorama at a place among `levels`.
    #[inline(always)]
    fn level(&self, place: f32) -> f32 {
        let (i, fraction) = split(place.clamp(0.0, 1022.0));
        let (low, high) = (self.levels[i & 1023], self.levels[(i + 1) & 1023]);
        low + fraction * (high - low)
    }
}

/// An integer and a fraction of 0 to 1 that make up a number of 0 to some thousands; an integer may be split as one less and 1. Without a conversion, which
/// has to ask about what is no number: at 1.5 · 2²³ a float's last bits are its integer part.
#[inline(always)]
fn split(v: f32) -> (usize, f32) {
    const SHIFT: f32 = 12_582_912.0;
    let shifted = (v - 0.5) + SHIFT;
    (shifted.to_bits() as usize & 0xffff, v - (shifted - SHIFT))
}

/// What is done to the light of a photograph.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ExposureCorrection<'a> {
    pub(crate) tone: &'a Tone,
    /// Stops by which red, green and blue are lifted.
    pub(crate) gain: [f32; 3],
    /// `v₁` and `v₂`: `v₁ r² + v₂ r⁴` more stops at a distance r from the middle, 1 at the corners.
    pub(crate) vignetting: [f32; 2],
    /// Light from which on a photograph counts as clipped; white is 1. For linear light only.
    pub(crate) clipped: f32,
}

impl<'a> ExposureCorrection<'a> {
    /// That of one photograph.
    pub(crate) fn new(tone: &'a Tone, gains: &Gains, photo: usize) -> Self {
        let gain = gains.gains.get(photo).map_or([0.0; 3], |g| g.map(f32::log2));
        let clipped = gains.clipped();
        Self { tone, gain, clipped, vignetting: gains.vignetting.map(|v| v * std::f32::consts::LOG2_E) }
    }

    /// Stops more at the square of a distance from the middle.
    #[inline(always)]
    pub(crate) fn lift(&self, r2: f32) -> f32 {
        r2 * (self.vignetting[0] + r2 * self.vignetting[1])
    }

    /// The levels of the panorama for a color of the photograph that is lifted by as many stops more.
    ///
    /// A color whose channels were all clipped is a bound, not a measurement: it stays white whatever its gain.
    pub(crate) fn levels(&self, color: [f32; 3], lift: f32) -> [f32; 3] {
        let [mut r, mut g, mut b] = color.map(|v| [v]);
        self.row_of_levels::<false>([&mut r, &mut g, &mut b], &[lift], &mut [0.0]);
        [r[0], g[0], b[0]]
    }

    /// As [`Self::levels`], for rows of red, green and blue and of stops that are as long. `clipped` is a buffer as long. `FINE`: for more than bytes.
    #[inline(always)]
    pub(crate) fn row_of_levels<const FINE: bool>(&self, colors: [&mut [f32]; 3], lifts: &[f32], clipped: &mut [f32]) {
        /// Smallest channel from which on a color counts as clipped, more and more up to the second.
        const CLIPPED: [f32; 2] = [228.0, 252.0];
        let n = lifts.len();
        let ([r, g, b], clipped) = (colors.map(|c| &mut c[..n]), &mut clipped[..n]);
        for (((clipped, r), g), b) in clipped.iter_mut().zip(&*r).zip(&*g).zip(&*b) {
            let share = ((r.min(*g).min(*b) - CLIPPED[0]) * (1.0 / (CLIPPED[1] - CLIPPED[0]))).clamp(0.0, 1.0);
            *clipped = share * share * (3.0 - 2.0 * share);
        }
        // A channel at a time: pixels do not wait for each other.
        for (values, gain) in [r, g, b].into_iter().zip(self.gain) {
            for ((value, lift), clipped) in values.iter_mut().zip(lifts).zip(&*clipped) {
                let tone = self.tone.level(self.tone.light::<FINE>(*value) + (gain + lift) * PER_STOP);
                *value = tone + clipped * (255.0 - tone);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn correction(tone: &Tone, stops: f32) -> ExposureCorrection<'_> {
        ExposureCorrection { tone, gain: [stops; 3], vignetting: [0.0; 2], clipped: 1.0 }
    }

    #[test]
    fn without_a_gain_levels_stay_whatever_the_response() {
        for coefficients in [[0.0; 3], [0.8, -1.0, -1.2], [-0.4, 0.3, 0.2]] {
            let tone = Tone::new(&Response { coefficients }, 0.0, 1);
            for level in 0..=255 {
                let got = correction(&tone, 0.0).levels([level as f32; 3], 0.0)[0];
                // Chords of the curve over a 32nd of a stop, 2 % of the light, 1 % of the level: its curvature over that is a hundredth of it. Levels from 228 on go to white.
                assert!((got - level as f32).abs() < 0.06 || level > 228, "{coefficients:?} {level}: {got}");
            }
        }
    }

    #[test]
    fn a_number_is_its_integer_and_its_fraction() {
        for k in 0..=8184 {
            let v = k as f32 / 8.0;
            let (i, fraction) = split(v);
            assert!((0.0..=1.0).contains(&fraction) && i as f32 + fraction == v, "{v}: {i} {fraction}");
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
        let tone = Tone::new(&Response::default(), 0.0, PER_LEVEL);
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
