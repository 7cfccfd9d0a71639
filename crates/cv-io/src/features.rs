//! Keypoints and descriptors in the formats of other programs: COLMAP's feature text and NumPy arrays.
//!
//! COLMAP's text starts with a line `count 128`; then a row per feature: `x y scale orientation d1 … d128`, the center of the top-left pixel at
//! (0.5, 0.5), the angle in radians, the descriptor as integers 0 to 255, 512 times a descriptor of unit length. It has no responses: they read
//! as 0.

use crate::files::{read_text, write_bytes};
use crate::npy::{NpyArray, NpyData};
use crate::{FormatError, IoError};
use cv_core::{Keypoint, Point2};
use std::fmt::Write as _;
use std::path::Path;

const NAME: &str = "COLMAP feature text";
/// Coordinate of the center of the top-left pixel in COLMAP's convention.
const CENTER: f32 = 0.5;
/// Scale of COLMAP's integer descriptors.
const DESCRIPTOR_SCALE: f32 = 512.0;
/// Dimension of COLMAP's descriptors.
const DIMENSION: usize = 128;

/// Keypoints with one descriptor each.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FeatureRows {
    /// The points, pixel centers at integers.
    pub keypoints: Vec<Keypoint>,
    /// Dimension of the descriptors.
    pub dimension: usize,
    /// Descriptors, row-major, one per keypoint.
    pub descriptors: Vec<f32>,
}

/// Parses COLMAP's feature text.
///
/// # Errors
/// [`FormatError`] with the line of an invalid row.
pub fn parse_colmap_features(text: &str) -> Result<FeatureRows, FormatError> {
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#'));
    let (at, head) = lines.next().ok_or_else(|| FormatError::line(1, "“count 128” is missing"))?;
    let words: Vec<&str> = head.split_whitespace().collect();
    let [count, DIMENSION] = words.iter().filter_map(|w| w.parse::<usize>().ok()).collect::<Vec<_>>()[..] else {
        return Err(FormatError::line(at + 1, format!("“{head:.40}” is not a count and 128")));
    };
    let mut rows = FeatureRows { dimension: DIMENSION, ..FeatureRows::default() };
    for (at, line) in lines {
        let mut values = Vec::with_capacity(DIMENSION + 4);
        for word in line.split_whitespace() {
            let value: f32 =
                word.parse().map_err(|_| FormatError::line(at + 1, format!("“{word:.40}” is not a number")))?;
            values.push(value);
        }
        let [x, y, scale, angle, ref descriptor @ ..] = values[..] else {
            return Err(FormatError::line(at + 1, "a feature needs x, y, scale, orientation and 128 numbers"));
        };
        if descriptor.len() != DIMENSION {
            return Err(FormatError::line(at + 1, format!("{} numbers in a descriptor, not 128", descriptor.len())));
        }
        rows.keypoints.push(Keypoint { position: Point2::new(x - CENTER, y - CENTER), response: 0.0, scale, angle });
        rows.descriptors.extend(descriptor.iter().map(|v| v / DESCRIPTOR_SCALE));
    }
    if rows.keypoints.len() != count {
        return Err(FormatError::corrupt(
            NAME,
            format!("the header has {count} features, the file {}", rows.keypoints.len()),
        ));
    }
    Ok(rows)
}

/// Reads COLMAP's feature text.
///
/// # Errors
/// As [`parse_colmap_features`], and where the file cannot be read.
pub fn read_colmap_features(path: impl AsRef<Path>) -> Result<FeatureRows, IoError> {
    let path = path.as_ref();
    parse_colmap_features(&read_text(path)?).map_err(|reason| IoError::reading(path, reason))
}

/// Writes COLMAP's feature text, which `colmap feature_importer` reads.
///
/// # Errors
/// [`FormatError::NotRepresentable`] for descriptors that are not 128 numbers of 0 to 0.5, and where the file cannot be written.
pub fn write_colmap_features(path: impl AsRef<Path>, rows: &FeatureRows) -> Result<(), IoError> {
    let path = path.as_ref();
    write_bytes(path, format_rows(rows).map_err(|reason| IoError::writing(path, reason))?.as_bytes())
}

fn format_rows(rows: &FeatureRows) -> Result<String, FormatError> {
    let not_representable = |what: String| FormatError::NotRepresentable { format: NAME, what };
    if rows.dimension != DIMENSION || rows.descriptors.len() != DIMENSION * rows.keypoints.len() {
        return Err(not_representable(format!("{} descriptors of {} numbers", rows.keypoints.len(), rows.dimension)));
    }
    let mut text = format!("{} {DIMENSION}\n", rows.keypoints.len());
    for (k, row) in rows.keypoints.iter().zip(rows.descriptors.chunks_exact(DIMENSION)) {
        // `fmt::Write` on a String cannot fail.
        let _ = write!(text, "{} {} {} {}", k.position.x + CENTER, k.position.y + CENTER, k.scale, k.angle);
        for v in row {
            if !(0.0..=1.0).contains(v) {
                return Err(not_representable(format!("the number {v} in a descriptor")));
            }
            let _ = write!(text, " {}", (v * DESCRIPTOR_SCALE).round().min(255.0));
        }
        text.push('\n');
    }
    Ok(text)
}

/// Converts keypoints to an array with rows `x, y, scale, angle, response`.
pub fn keypoints_to_npy(keypoints: &[Keypoint]) -> NpyArray {
    let rows = keypoints.iter().flat_map(|k| [k.position.x, k.position.y, k.scale, k.angle, k.response]);
    NpyArray { shape: vec![keypoints.len(), 5], data: NpyData::F32(rows.collect()) }
}

/// Converts an array of two to five columns `x, y, scale, angle, response` to keypoints; missing columns are 1, 0, 0.
///
/// # Errors
/// [`FormatError`] for an array of another shape.
pub fn keypoints_from_npy(array: &NpyArray) -> Result<Vec<Keypoint>, FormatError> {
    let [_, columns @ 2..=5] = array.shape[..] else {
        return Err(FormatError::unsupported(
            "NumPy array",
            format!("an array of shape {:?} as keypoints", array.shape),
        ));
    };
    let values = array.to_f64();
    let row = |r: &[f64]| {
        let at = |i: usize, missing: f32| r.get(i).map_or(missing, |v| *v as f32);
        Keypoint {
            position: Point2::new(at(0, 0.0), at(1, 0.0)),
            scale: at(2, 1.0),
            angle: at(3, 0.0),
            response: at(4, 0.0),
        }
    };
    Ok(values.chunks_exact(columns).map(row).collect())
}

/// Converts descriptors to an array with one row each.
pub fn descriptors_to_npy(dimension: usize, descriptors: &[f32]) -> NpyArray {
    let rows = descriptors.len().checked_div(dimension).unwrap_or(0);
    NpyArray { shape: vec![rows, dimension], data: NpyData::F32(descriptors.to_vec()) }
}

/// Converts a two-dimensional array to descriptors: their dimension and values.
///
/// # Errors
/// [`FormatError`] for an array of another shape.
pub fn descriptors_from_npy(array: &NpyArray) -> Result<(usize, Vec<f32>), FormatError> {
    let [_, columns] = array.shape[..] else {
        return Err(FormatError::unsupported(
            "NumPy array",
            format!("an array of shape {:?} as descriptors", array.shape),
        ));
    };
    Ok((columns, array.to_f64().into_iter().map(|v| v as f32).collect()))
}
