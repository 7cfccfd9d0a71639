//! How much memory the contents of a file may take: judged by its header, before any of it is asked for.

use std::sync::OnceLock;

use crate::FormatError;

/// The memory that reading one file may take where [`set_default_max_memory`] was not called, in bytes: 4 GiB. That is the
/// largest picture of floats within [`DEFAULT_MAX_PIXELS`](crate::DEFAULT_MAX_PIXELS), 3 GiB, and what is held beside it.
pub const DEFAULT_MAX_MEMORY: u64 = 4 << 30;

static DEFAULT: OnceLock<u64> = OnceLock::new();

/// Sets what [`default_max_memory`] says, once for the life of the process, in bytes. It is meant for the `main` of a program, before it
/// reads its first file; a library passes [`ReadOptions::max_memory`](crate::ReadOptions::max_memory) instead.
///
/// # Errors
/// The value in force, where one has been set before: it stays.
pub fn set_default_max_memory(bytes: u64) -> Result<(), u64> {
    DEFAULT.set(bytes).map_err(|_| default_max_memory())
}

/// The memory that reading one file may take where nothing else is said, in bytes: what [`set_default_max_memory`] set, else
/// [`DEFAULT_MAX_MEMORY`].
pub fn default_max_memory() -> u64 {
    DEFAULT.get().copied().unwrap_or(DEFAULT_MAX_MEMORY)
}

/// Refuses what needs more bytes than allowed. `size`: width and height of a picture or map.
pub(crate) fn allow(needed: u64, allowed: u64, size: Option<(u64, u64)>) -> Result<(), FormatError> {
    if needed > allowed { Err(FormatError::TooMuchMemory { needed, allowed, size }) } else { Ok(()) }
}

/// The product, or the largest number where it is beyond.
pub(crate) fn product(factors: &[u64]) -> u64 {
    factors.iter().fold(1, |n, factor| n.saturating_mul(*factor))
}
