//! Limits on the memory for reading a file, checked by its header before allocation.

use std::sync::OnceLock;

use crate::FormatError;

/// Memory limit in bytes for reading one file, unless set by [`set_default_max_memory`]: 4 GiB, for the
/// largest float image within [`DEFAULT_MAX_PIXELS`](crate::DEFAULT_MAX_PIXELS), 3 GiB, and the working memory.
pub const DEFAULT_MAX_MEMORY: u64 = 4 << 30;

static DEFAULT: OnceLock<u64> = OnceLock::new();

/// Sets [`default_max_memory`] in bytes, once per process. For the `main` of a program, before it reads its first file; libraries pass
/// [`ReadOptions::max_memory`](crate::ReadOptions::max_memory) instead.
///
/// # Errors
/// The present value, where it has been set before; it is unchanged.
pub fn set_default_max_memory(bytes: u64) -> Result<(), u64> {
    DEFAULT.set(bytes).map_err(|_| default_max_memory())
}

/// Returns the default memory limit in bytes for reading one file: that of [`set_default_max_memory`], else
/// [`DEFAULT_MAX_MEMORY`].
pub fn default_max_memory() -> u64 {
    DEFAULT.get().copied().unwrap_or(DEFAULT_MAX_MEMORY)
}

/// Checks that `needed` bytes are within the limit. `size`: width and height of an image or map.
pub(crate) fn check_limit(needed: u64, allowed: u64, size: Option<(u64, u64)>) -> Result<(), FormatError> {
    if needed > allowed { Err(FormatError::TooMuchMemory { needed, allowed, size }) } else { Ok(()) }
}

/// Computes the product of the factors, saturating.
pub(crate) fn saturating_product(factors: &[u64]) -> u64 {
    factors.iter().fold(1, |n, factor| n.saturating_mul(*factor))
}
