//! Point correspondences as text: a row per match, `x1 y1 x2 y2` in pixels with an optional score; `#` starts a comment. Pixel
//! centers at integers.

use std::fmt::Write as _;
use std::path::Path;

use cv_core::Correspondence;

use crate::files::{read_text, write_bytes};
use crate::{FormatError, IoError};

/// The matches of a file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Matches {
    /// The pairs, in the order of the file.
    pub pairs: Vec<Correspondence>,
    /// One score per pair, where every row has one. Its meaning (ratio, distance, confidence) depends on the writer.
    pub scores: Option<Vec<f64>>,
}

/// Parses the text of a matches file. Columns are separated by spaces, tabs, commas or semicolons.
///
/// Infinite and NaN coordinates are returned as they are.
///
/// # Errors
/// [`FormatError::Line`] for a row that is not four or five numbers, or where only some rows have a score.
pub fn parse_matches(text: &str) -> Result<Matches, FormatError> {
    let mut pairs = Vec::new();
    let mut scores = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let line_number = index + 1;
        let content = line.split('#').next().unwrap_or("");
        let mut row = [0.0f64; 5];
        let mut columns = 0;
        for word in content.split([' ', '\t', ',', ';', '\r']).filter(|w| !w.is_empty()) {
            let Some(cell) = row.get_mut(columns) else {
                return Err(FormatError::line(
                    line_number,
                    "more than five columns; expected x1 y1 x2 y2 and an optional score",
                ));
            };
            *cell = word
                .parse()
                .map_err(|_| FormatError::line(line_number, format!("“{}” is not a number", truncate_word(word))))?;
            columns += 1;
        }
        match columns {
            0 => continue,
            4 => {}
            5 => scores.push(row[4]),
            n => {
                let reason = format!("{n} column(s); expected x1 y1 x2 y2 and an optional score");
                return Err(FormatError::line(line_number, reason));
            }
        }
        pairs.push(Correspondence::new(row[0], row[1], row[2], row[3]));
        if !scores.is_empty() && scores.len() != pairs.len() {
            return Err(FormatError::line(line_number, "some rows have a score and some have none"));
        }
    }
    let scores = (!scores.is_empty()).then_some(scores);
    Ok(Matches { pairs, scores })
}

/// Truncates a word to 40 characters.
fn truncate_word(word: &str) -> String {
    word.chars().take(40).collect()
}

/// Reads a matches file; see [`parse_matches`].
///
/// # Errors
/// [`IoError`]: cannot be read as text, or as [`parse_matches`].
pub fn read_matches(path: impl AsRef<Path>) -> Result<Matches, IoError> {
    let path = path.as_ref();
    parse_matches(&read_text(path)?).map_err(|reason| IoError::reading(path, reason))
}

/// Writes a matches file. Numbers round-trip exactly.
///
/// # Errors
/// [`FormatError::NotRepresentable`] where the number of scores is not that of pairs; else as [`crate::write_atomic`].
pub fn write_matches(path: impl AsRef<Path>, pairs: &[Correspondence], scores: Option<&[f64]>) -> Result<(), IoError> {
    let path = path.as_ref();
    if let Some(scores) = scores.filter(|s| s.len() != pairs.len()) {
        let what = format!("{} scores for {} pairs", scores.len(), pairs.len());
        return Err(IoError::writing(path, FormatError::NotRepresentable { format: "a matches file", what }));
    }
    let mut text = String::from(match scores {
        Some(_) => "# x1 y1 x2 y2 score (pixels, centers at integers)\n",
        None => "# x1 y1 x2 y2 (pixels, centers at integers)\n",
    });
    for (i, pair) in pairs.iter().enumerate() {
        let _ = write!(text, "{} {} {} {}", pair.a.x, pair.a.y, pair.b.x, pair.b.y);
        if let Some(scores) = scores {
            let _ = write!(text, " {}", scores[i]);
        }
        text.push('\n');
    }
    write_bytes(path, text.as_bytes())
}
