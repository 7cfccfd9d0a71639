//! The nine numbers of a calibration matrix, in three rows, with or without brackets.

use cv_core::Camera;

use super::format::{Format, Given};
use super::{CalibrationNote, no_size};
use crate::FormatError;

const NAME: &str = "calibration matrix";

pub(super) const FORMAT: Format = Format {
    name: "matrix",
    is: |text| words(text).all(|w| w.parse::<f64>().is_ok()) && words(text).count() == 9,
    camera,
    rig: None,
    camera_text: None,
    rig_text: None,
    array: None,
    array_text: None,
};

/// The numbers, without brackets.
fn words(text: &str) -> impl Iterator<Item = &str> {
    let rows = text.lines().filter(|l| !l.trim_start().starts_with('#'));
    rows.flat_map(|l| l.split([' ', '\t', ',', ';', '[', ']', '\r']).filter(|w| !w.is_empty()))
}

fn camera(text: &str, given: &Given) -> Result<Camera, FormatError> {
    let mut m = [0.0; 9];
    for (cell, word) in m.iter_mut().zip(words(text)) {
        *cell = word.parse().map_err(|_| FormatError::corrupt(NAME, format!("“{word}” is not a number")))?;
    }
    given.note(CalibrationNote::DistortionUnknown);
    pinhole(NAME, m, given.size.ok_or_else(|| no_size(NAME))?, given)
}

/// The most that leaving out a skew may move a pixel, in px: features are placed no better than that.
const LARGEST_SKEW: f64 = 0.25;

/// A pinhole from the nine numbers of K. A skew that hardly moves a pixel is left out, and noted.
pub(super) fn pinhole(
    format: &'static str,
    m: [f64; 9],
    (width, height): (usize, usize),
    given: &Given,
) -> Result<Camera, FormatError> {
    let [fx, skew, cx, zero, fy, cy, a, b, one] = m;
    let scale = fx.abs().max(fy.abs());
    if one == 0.0 || ![zero, a, b].iter().all(|v| v.abs() <= 1e-9 * scale) {
        return Err(FormatError::corrupt(format, "it does not have the form (fx 0 cx; 0 fy cy; 0 0 1)"));
    }
    if skew != 0.0 {
        // The row farthest from the principal point moves most.
        let rows = (cy / one).abs().max((height as f64 - 1.0 - cy / one).abs());
        let (skew, px) = (skew / one, (skew / fy).abs() * rows);
        if px.is_nan() || px > LARGEST_SKEW {
            let what = format!(
                "a skew of {skew}, which moves pixels by up to {px:.2} px (at most {LARGEST_SKEW} px are left out),"
            );
            return Err(FormatError::unsupported(format, what));
        }
        given.note(CalibrationNote::SkewLeftOut { skew, px });
    }
    Ok(Camera::pinhole(width, height, fx / one, fy / one, cx / one, cy / one))
}
