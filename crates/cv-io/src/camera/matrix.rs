//! A bare calibration matrix: nine numbers in three rows, with or without brackets.

use cv_core::Camera;

use super::format::{Format, ReadContext};
use super::{CalibrationNote, no_size};
use crate::FormatError;

const NAME: &str = "calibration matrix";

pub(super) const FORMAT: Format = Format {
    name: "matrix",
    matches: |text| words(text).all(|w| w.parse::<f64>().is_ok()) && words(text).count() == 9,
    camera,
    rig: None,
    camera_text: None,
    rig_text: None,
    array: None,
    array_text: None,
};

/// Splits a text into numbers, without brackets.
fn words(text: &str) -> impl Iterator<Item = &str> {
    let rows = text.lines().filter(|l| !l.trim_start().starts_with('#'));
    rows.flat_map(|l| l.split([' ', '\t', ',', ';', '[', ']', '\r']).filter(|w| !w.is_empty()))
}

fn camera(text: &str, context: &ReadContext) -> Result<Camera, FormatError> {
    let mut m = [0.0; 9];
    for (cell, word) in m.iter_mut().zip(words(text)) {
        *cell = word.parse().map_err(|_| FormatError::corrupt(NAME, format!("“{word}” is not a number")))?;
    }
    context.note(CalibrationNote::DistortionUnknown);
    pinhole(NAME, m, context.size.ok_or_else(|| no_size(NAME))?, context)
}

/// Maximum displacement of a pixel, in px, by ignoring a skew: about the localization accuracy of features.
const MAX_IGNORED_SKEW_PX: f64 = 0.25;

/// Makes a pinhole camera from the calibration matrix K. A negligible skew is ignored, with a note.
pub(super) fn pinhole(
    format: &'static str,
    m: [f64; 9],
    (width, height): (usize, usize),
    context: &ReadContext,
) -> Result<Camera, FormatError> {
    let [fx, skew, cx, zero, fy, cy, a, b, one] = m;
    let scale = fx.abs().max(fy.abs());
    if one == 0.0 || ![zero, a, b].iter().all(|v| v.abs() <= 1e-9 * scale) {
        return Err(FormatError::corrupt(format, "it does not have the form (fx 0 cx; 0 fy cy; 0 0 1)"));
    }
    if skew != 0.0 {
        // The displacement is largest in the row farthest from the principal point.
        let rows = (cy / one).abs().max((height as f64 - 1.0 - cy / one).abs());
        let (skew, px) = (skew / one, (skew / fy).abs() * rows);
        if px.is_nan() || px > MAX_IGNORED_SKEW_PX {
            let what = format!(
                "a skew of {skew}, which moves pixels by up to {px:.2} px (at most {MAX_IGNORED_SKEW_PX} px are ignored),"
            );
            return Err(FormatError::unsupported(format, what));
        }
        context.note(CalibrationNote::SkewLeftOut { skew, px });
    }
    Ok(Camera::pinhole(width, height, fx / one, fy / one, cx / one, cy / one))
}
