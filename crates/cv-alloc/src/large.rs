//! Large blocks: anonymous mappings with transparent huge pages, of which some are kept when they are freed.

use crate::spare::{self, Spare};
use std::ptr::{null_mut, with_exposed_provenance_mut};

/// Size of a huge page on x86-64, and on AArch64 with pages of 4 KiB.
const HUGE_PAGE: usize = 2 << 20;

/// The largest size of a small page on any system.
const PAGE: usize = 64 << 10;

/// Returns the size of the mapping of a block: whole huge pages where at most half of one is unused, else whole small pages. `None` if it overflows.
fn capacity_of(size: usize) -> Option<usize> {
    let huge = size.checked_next_multiple_of(HUGE_PAGE)?;
    if huge - size <= HUGE_PAGE / 2 { Some(huge) } else { size.checked_next_multiple_of(PAGE) }
}

/// Returns a block of at least `size` bytes, aligned to pages; null where there is no memory.
pub(crate) fn block(size: usize) -> *mut u8 {
    let Some(capacity) = capacity_of(size) else { return null_mut() };
    spare::take(capacity).map_or_else(|| map(capacity), |spare| with_exposed_provenance_mut(spare.address))
}

/// As [`block`], all zero.
pub(crate) fn zeroed_block(size: usize) -> *mut u8 {
    let Some(capacity) = capacity_of(size) else { return null_mut() };
    let Some(spare) = spare::take(capacity) else { return map(capacity) };
    let block: *mut u8 = with_exposed_provenance_mut(spare.address);
    // SAFETY: the spare block is a mapping of this capacity that nothing uses.
    unsafe { block.write_bytes(0, size) };
    block
}

/// Maps a block, all zero and aligned to pages; null where there is no memory.
fn map(capacity: usize) -> *mut u8 {
    // The system aligns to small pages: one huge page more, whose surplus is unmapped.
    let Some(reserved) = capacity.checked_add(HUGE_PAGE) else { return null_mut() };
    let (access, kind) = (libc::PROT_READ | libc::PROT_WRITE, libc::MAP_PRIVATE | libc::MAP_ANONYMOUS);
    // SAFETY: a new private mapping at an address that the system chooses affects no other.
    let start = unsafe { libc::mmap(null_mut(), reserved, access, kind, -1, 0) };
    if start == libc::MAP_FAILED {
        return null_mut();
    }
    let start: *mut u8 = start.cast();
    let before = start.addr().wrapping_neg() % HUGE_PAGE;
    // SAFETY: `before` is at most a huge page, so both sums are within the mapping, and at the limits of pages. The advice does not change what the memory holds.
    unsafe {
        let block = start.add(before);
        release(start, before);
        release(block.add(capacity), HUGE_PAGE - before);
        // It fails where the system has no huge pages: small ones serve then.
        libc::madvise(block.cast(), capacity, libc::MADV_HUGEPAGE);
        block
    }
}

/// Frees a block.
///
/// # Safety
/// `block` is from [`block`], [`zeroed_block`] or [`remap`], for this size, and not used any more.
pub(crate) unsafe fn free(block: *mut u8, size: usize) {
    if let Some(capacity) = capacity_of(size) {
        spare::put(Spare { address: block.expose_provenance(), capacity }, |spare| {
            // SAFETY: the block is a mapping of its capacity, the caller's or a spare one, which nothing uses any more.
            unsafe { release(with_exposed_provenance_mut(spare.address), spare.capacity) };
        });
    }
}

/// Changes the size of a block, whose pages may be mapped elsewhere then but are not copied. Null where there is no memory; the block stays as it was then.
///
/// # Safety
/// As for [`free`].
pub(crate) unsafe fn remap(block: *mut u8, size: usize, new_size: usize) -> *mut u8 {
    let (Some(capacity), Some(new_capacity)) = (capacity_of(size), capacity_of(new_size)) else { return null_mut() };
    if capacity == new_capacity {
        return block;
    }
    // SAFETY: the block is a mapping of this capacity, which the caller alone uses.
    let moved = unsafe { libc::mremap(block.cast(), capacity, new_capacity, libc::MREMAP_MAYMOVE) };
    if moved == libc::MAP_FAILED { null_mut() } else { moved.cast() }
}

/// Gives memory back to the system.
///
/// # Safety
/// The memory is mapped, whole pages, and not used any more.
unsafe fn release(start: *mut u8, size: usize) {
    if size > 0 {
        // SAFETY: the caller's. It fails only where a mapping cannot be split because there are too many; the memory stays mapped then, unused.
        unsafe { libc::munmap(start.cast(), size) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mappings_waste_at_most_half_a_huge_page() {
        let (mib, kib) = (1 << 20, 1 << 10);
        for (size, capacity) in [
            (mib, 2 * mib),
            (2 * mib, 2 * mib),
            (2 * mib + 1, 2 * mib + 64 * kib),
            (3 * mib - 1, 3 * mib),
            (3 * mib, 4 * mib),
            (33 * mib + 1, 34 * mib),
        ] {
            assert_eq!(capacity_of(size), Some(capacity), "{size}");
        }
        assert_eq!(capacity_of(usize::MAX), None);
    }
}
