//! Errors of reading and writing files.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use crate::format_detection::IMAGE_FORMATS;

const CONVERT: &str = "convert it, for example to PNG or JPEG";

/// Why a file's content could not be decoded, or values could not be encoded. Without the path: see [`IoError`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
    /// The operating system reported an error.
    #[error("{0}")]
    Os(#[from] io::Error),
    /// The file has no bytes.
    #[error("the file is empty (0 bytes)")]
    Empty,
    /// The first bytes are those of no format that this crate reads.
    #[error("the first bytes are not those of {expected}")]
    UnknownFormat {
        /// The formats that would have been accepted.
        expected: &'static str,
    },
    /// A known format, or a variant of one, that this crate does not read or write.
    #[error("{format}: {what} is not supported")]
    Unsupported {
        /// Name of the format.
        format: &'static str,
        /// The variant or feature.
        what: String,
    },
    /// An image format or variant that this crate does not read, or a file that is no image.
    #[error("{format}: {what} is not supported")]
    UnsupportedPicture {
        /// Name of the format.
        format: &'static str,
        /// The variant or feature.
        what: String,
    },
    /// The file ends before its content does.
    #[error("{format}: the file is cut short")]
    Truncated {
        /// Name of the format.
        format: &'static str,
    },
    /// The bytes contradict the format or each other.
    #[error("{format}: {reason}")]
    Corrupt {
        /// Name of the format.
        format: &'static str,
        /// What is wrong.
        reason: String,
    },
    /// A line of a text file is invalid.
    #[error("line {line}: {reason}")]
    Line {
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// The image has more pixels, by its header, than the limit.
    #[error("{width}×{height} is more than the limit of {limit} pixels")]
    TooManyPixels {
        /// Width by the header.
        width: u64,
        /// Height by the header.
        height: u64,
        /// The limit in pixels.
        limit: u64,
    },
    /// The file, or its uncompressed content, is larger than the limit.
    #[error("{bytes} bytes are more than the limit of {limit}")]
    TooManyBytes {
        /// Size in bytes.
        bytes: u64,
        /// The limit in bytes.
        limit: u64,
    },
    /// Reading the file would take more memory than allowed.
    #[error("{}it takes {} MiB of memory to read, {} MiB are allowed", sized(*size), needed.div_ceil(1 << 20), allowed >> 20)]
    TooMuchMemory {
        /// Peak memory in bytes, by the header: the file, the decoder's working memory, and the result.
        needed: u64,
        /// Bytes allowed.
        allowed: u64,
        /// Width and height in pixels by the header, of an image or map.
        size: Option<(u64, u64)>,
    },
    /// An archive does not have the expected number of arrays.
    #[error("{format}: it has {got} arrays, not {wanted}")]
    ArrayCount {
        /// Name of the format.
        format: &'static str,
        /// Arrays in the archive, by its directory.
        got: usize,
        /// Expected number of arrays.
        wanted: usize,
    },
    /// A value that the format cannot represent.
    #[error("{format} cannot hold {what}")]
    NotRepresentable {
        /// Name of the format.
        format: &'static str,
        /// The value.
        what: String,
    },
    /// A needed entry is absent.
    #[error("{format}: there is no {what}")]
    Missing {
        /// Name of the format.
        format: &'static str,
        /// Name of the entry.
        what: String,
    },
}

impl FormatError {
    pub(crate) fn corrupt(format: &'static str, reason: impl Into<String>) -> Self {
        Self::Corrupt { format, reason: reason.into() }
    }

    pub(crate) fn unsupported(format: &'static str, what: impl Into<String>) -> Self {
        Self::Unsupported { format, what: what.into() }
    }

    pub(crate) fn unsupported_picture(format: &'static str, what: impl Into<String>) -> Self {
        Self::UnsupportedPicture { format, what: what.into() }
    }

    pub(crate) fn line(line: usize, reason: impl Into<String>) -> Self {
        Self::Line { line, reason: reason.into() }
    }

    pub(crate) fn missing(format: &'static str, what: impl Into<String>) -> Self {
        Self::Missing { format, what: what.into() }
    }

    /// Suggests a remedy, where there is one.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            Self::Os(error) => match error.kind() {
                io::ErrorKind::NotFound => Some("check the spelling and that the folder exists"),
                io::ErrorKind::PermissionDenied => Some("check the permissions of the file and its folder"),
                io::ErrorKind::IsADirectory => Some("name a file inside the folder"),
                io::ErrorKind::StorageFull => Some("free some space on the disk"),
                _ => None,
            },
            Self::Empty | Self::Truncated { .. } => Some("copy or export the file again"),
            Self::UnsupportedPicture { .. } => Some(CONVERT),
            Self::UnknownFormat { expected } if *expected == IMAGE_FORMATS => Some(CONVERT),
            Self::TooManyPixels { .. } => Some("make the image smaller, or raise the limit if the size is intended"),
            Self::TooManyBytes { .. } => Some("raise the limit if the size is intended"),
            Self::TooMuchMemory { .. } => Some("make it smaller, or allow more memory"),
            _ => None,
        }
    }
}

/// Formats the size as a prefix of a message.
fn sized(size: Option<(u64, u64)>) -> String {
    size.map_or_else(String::new, |(width, height)| format!("{width}×{height} pixels: "))
}

/// A failure to read or write a file: path, reason and remedy.
#[derive(Debug)]
pub struct IoError {
    /// The file.
    pub path: PathBuf,
    /// True for writing, false for reading.
    pub writing: bool,
    /// The reason.
    pub reason: FormatError,
}

impl IoError {
    pub(crate) fn reading(path: &Path, reason: impl Into<FormatError>) -> Self {
        Self { path: path.to_owned(), writing: false, reason: reason.into() }
    }

    pub(crate) fn writing(path: &Path, reason: impl Into<FormatError>) -> Self {
        Self { path: path.to_owned(), writing: true, reason: reason.into() }
    }
}

impl fmt::Display for IoError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verb = if self.writing { "write" } else { "read" };
        write!(f, "cannot {verb} {}: {}", self.path.display(), self.reason)?;
        match self.reason.hint() {
            Some(hint) => write!(f, " ({hint})"),
            None => Ok(()),
        }
    }
}

impl std::error::Error for IoError {}
