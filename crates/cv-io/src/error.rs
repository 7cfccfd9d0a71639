//! What can go wrong between a file and its meaning.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use crate::sniff::PICTURES;

const CONVERT: &str = "convert it, for example to PNG or JPEG";

/// Why bytes could not be understood, or values not be stored. Carries no path: see [`IoError`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
    /// The operating system refused.
    #[error("{0}")]
    Os(#[from] io::Error),
    /// There are no bytes at all.
    #[error("the file is empty (0 bytes)")]
    Empty,
    /// The first bytes belong to no format this crate reads.
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
    /// A picture that this crate does not read, or something in the place of one.
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
    /// A line of a text file does not mean what it must.
    #[error("line {line}: {reason}")]
    Line {
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// The header asks for more pixels than the limit allows.
    #[error("{width}×{height} is more than the limit of {limit} pixels")]
    TooManyPixels {
        /// Width by the header.
        width: u64,
        /// Height by the header.
        height: u64,
        /// The limit in pixels.
        limit: u64,
    },
    /// The file, or what it unpacks to, is larger than the limit.
    #[error("{bytes} bytes are more than the limit of {limit}")]
    TooManyBytes {
        /// Size asked for.
        bytes: u64,
        /// The limit in bytes.
        limit: u64,
    },
    /// Reading the file would take more memory than allowed.
    #[error("{}it takes {} MiB of memory to read, {} MiB are allowed", sized(*size), needed.div_ceil(1 << 20), allowed >> 20)]
    TooMuchMemory {
        /// The most bytes held at one time, by the header: the file, what decoding holds, and the result.
        needed: u64,
        /// Bytes allowed.
        allowed: u64,
        /// Width and height in pixels by the header, of a picture or map.
        size: Option<(u64, u64)>,
    },
    /// An archive that does not hold the number of arrays wanted.
    #[error("{format}: it holds {got} arrays, not {wanted}")]
    ArrayCount {
        /// Name of the format.
        format: &'static str,
        /// Arrays in the archive, by its directory.
        got: usize,
        /// Arrays wanted.
        wanted: usize,
    },
    /// A value that the format cannot hold.
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

    /// What a person might try next, where there is something to say.
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
            Self::UnknownFormat { expected } if *expected == PICTURES => Some(CONVERT),
            Self::TooManyPixels { .. } => Some("make the image smaller, or raise the limit if the size is meant"),
            Self::TooManyBytes { .. } => Some("raise the limit if the size is meant"),
            Self::TooMuchMemory { .. } => Some("make it smaller, or allow more memory"),
            _ => None,
        }
    }
}

/// The size in front of a sentence, where there is one.
fn sized(size: Option<(u64, u64)>) -> String {
    size.map_or_else(String::new, |(width, height)| format!("{width}×{height} pixels: "))
}

/// A failure to read or write one file: which, why, and what to try.
#[derive(Debug)]
pub struct IoError {
    /// The file.
    pub path: PathBuf,
    /// True where it was being written.
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
