//! The interface that each calibration format implements.

use std::cell::RefCell;

use cv_core::{Camera, Distortion, DistortionModel};

use super::{CalibrationNote, CameraArray, RigFile};
use crate::FormatError;

/// Context of a reader: the image size if known, and the notes that it collects.
pub(super) struct ReadContext {
    /// Width and height of the images, for files without them.
    pub(super) size: Option<(usize, usize)>,
    /// Deviations from the file.
    notes: RefCell<Vec<CalibrationNote>>,
}

impl ReadContext {
    pub(super) fn new(size: Option<(usize, usize)>) -> Self {
        Self { size, notes: RefCell::default() }
    }

    pub(super) fn note(&self, note: CalibrationNote) {
        self.notes.borrow_mut().push(note);
    }

    pub(super) fn into_notes(self) -> Vec<CalibrationNote> {
        self.notes.into_inner()
    }
}

/// Parses a text as a camera or a rig.
type Read<T> = fn(&str, &ReadContext) -> Result<T, FormatError>;
/// Formats a camera or a rig as text; the notes become comments.
type Write<T> = fn(&T, &[&str]) -> Result<String, FormatError>;

/// A calibration format.
pub(super) struct Format {
    /// Its name, for choosing the format to write.
    pub(super) name: &'static str,
    /// Whether a text is of this format. Evaluated in the order of the table.
    pub(super) matches: fn(&str) -> bool,
    /// Reads a camera.
    pub(super) camera: Read<Camera>,
    /// Reads a rig, where the format has them.
    pub(super) rig: Option<Read<RigFile>>,
    /// Writes a valid camera, where the format is written.
    pub(super) camera_text: Option<Write<Camera>>,
    /// Writes a rig of valid cameras and a finite motion, where the format is written.
    pub(super) rig_text: Option<Write<RigFile>>,
    /// Reads any number of cameras, where the format has them.
    pub(super) array: Option<Read<CameraArray>>,
    /// Writes any number of valid cameras and finite motions, where the format supports them.
    pub(super) array_text: Option<Write<CameraArray>>,
}

/// Converts a camera's distortion to the model with the fewest parameters among those of a format.
pub(super) fn simplest_distortion(
    camera: &Camera,
    format: &'static str,
    models: impl Iterator<Item = DistortionModel>,
) -> Result<Distortion, FormatError> {
    let converted = models.filter_map(|model| camera.distortion.converted(model));
    converted.min_by_key(|distortion| distortion.parameters().len()).ok_or_else(|| unsupported_lens(camera, format))
}

/// The error that a format does not have a camera's lens model.
pub(super) fn unsupported_lens(camera: &Camera, format: &'static str) -> FormatError {
    FormatError::NotRepresentable {
        format,
        what: format!("a lens of the model {}", camera.distortion.model().info().name),
    }
}

/// Formats notes as comment lines.
pub(super) fn comments(notes: &[&str]) -> String {
    let printable = |line: &str| line.chars().filter(|&c| printable(c)).collect::<String>();
    notes.iter().flat_map(|n| n.lines()).map(|line| format!("# {}\n", printable(line))).collect()
}

/// Whether YAML allows a character anywhere, and it does not end a line.
pub(super) fn printable(c: char) -> bool {
    !c.is_control() && !matches!(c, '\u{feff}' | '\u{fffe}' | '\u{ffff}' | '\u{2028}' | '\u{2029}')
}
