//! Camera positions as text: a row per image, `name x y z`.

use crate::files::read_text;
use crate::{FormatError, IoError};
use cv_core::Point3;
use std::collections::HashSet;
use std::path::Path;

/// Image names with camera positions, in the order of the file.
pub type NamedPositions = Vec<(String, Point3<f64>)>;

/// Parses rows of a name and three numbers, separated by commas, semicolons or tabs, or else by spaces (names with spaces need the former). `#`
/// starts a comment, and a first row without numbers is a header.
///
/// # Errors
/// [`FormatError::Line`] for a row that is not a name and three finite numbers, and for a repeated name; [`FormatError::Empty`] without any row.
pub fn parse_camera_positions(text: &str) -> Result<NamedPositions, FormatError> {
    let mut places: NamedPositions = Vec::new();
    let mut seen = HashSet::new();
    let mut rows = 0;
    for (index, line) in text.lines().enumerate() {
        let content = line.split('#').next().unwrap_or("").trim_start_matches('\u{feff}').trim();
        if content.is_empty() {
            continue;
        }
        let separators = [',', ';', '\t'];
        let cells: Vec<&str> = match content.contains(separators) {
            true => content.split(separators).map(|cell| cell.trim().trim_matches('"')).collect(),
            false => content.split_whitespace().collect(),
        };
        rows += 1;
        let numbers: Vec<Option<f64>> = cells.iter().skip(1).map(|cell| cell.parse().ok()).collect();
        if rows == 1 && !numbers.is_empty() && numbers.iter().all(Option::is_none) {
            continue;
        }
        let [Some(x), Some(y), Some(z)] = numbers[..] else {
            let reason = format!("“{content:.60}” is not a name and three numbers x y z");
            return Err(FormatError::line(index + 1, reason));
        };
        let place = Point3::new(x, y, z);
        if !place.iter().all(|v| v.is_finite()) {
            return Err(FormatError::line(index + 1, "a coordinate is not finite"));
        }
        if !seen.insert(cells[0]) {
            return Err(FormatError::line(index + 1, format!("“{:.60}” occurs twice", cells[0])));
        }
        places.push((cells[0].to_owned(), place));
    }
    if places.is_empty() { Err(FormatError::Empty) } else { Ok(places) }
}

/// Reads camera positions; see [`parse_camera_positions`].
///
/// # Errors
/// [`IoError`]: cannot be read as text, or as [`parse_camera_positions`].
pub fn read_camera_positions(path: impl AsRef<Path>) -> Result<NamedPositions, IoError> {
    let path = path.as_ref();
    parse_camera_positions(&read_text(path)?).map_err(|reason| IoError::reading(path, reason))
}
