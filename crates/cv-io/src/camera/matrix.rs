//! The nine numbers of a calibration matrix, in three rows, with or without brackets.

use cv_core::Camera;

use super::format::{Format, Size};
use super::no_size;
use crate::FormatError;

const NAME: &str = "calibration matrix";

pub(super) const FORMAT: Format = Format {
    name: "matrix",
    is: |text| words(text).all(|w| w.parse::<f64>().is_ok()) && words(text).count() == 9,
    camera,
    rig: None,
    camera_text: None,
    rig_text: None,
};

/// The numbers, without brackets.
fn words(text: &str) -> impl Iterator<Item = &str> {
    let rows = text.lines().filter(|l| !l.trim_start().starts_with('#'));
    rows.flat_map(|l| l.split([' ', '\t', ',', ';', '[', ']', '\r']).filter(|w| !w.is_empty()))
}

fn camera(text: &str, size: Size) -> Result<Camera, FormatError> {
    let mut m = [0.0; 9];
    for (cell, word) in m.iter_mut().zip(words(text)) {
        *cell = word.parse().map_err(|_| FormatError::corrupt(NAME, format!("“{word}” is not a number")))?;
    }
    pinhole(NAME, m, size.ok_or_else(|| no_size(NAME))?)
}

/// A pinhole from the nine numbers of K.
pub(super) fn pinhole(
    format: &'static str,
    m: [f64; 9],
    (width, height): (usize, usize),
) -> Result<Camera, FormatError> {
    let [fx, skew, cx, zero, fy, cy, a, b, one] = m;
    let scale = fx.abs().max(fy.abs());
    if one == 0.0 || ![zero, a, b].iter().all(|v| v.abs() <= 1e-9 * scale) {
        return Err(FormatError::corrupt(format, "it does not have the form (fx 0 cx; 0 fy cy; 0 0 1)"));
    }
    if skew.abs() > 1e-6 * scale {
        return Err(FormatError::unsupported(format, format!("a skew of {skew}")));
    }
    Ok(Camera::pinhole(width, height, fx / one, fy / one, cx / one, cy / one))
}
