//! Global allocator for programs that process images.
//!
//! Image buffers are large and short-lived. The system's allocator maps them at allocation and unmaps them when they are freed, and the kernel then maps each page of 4 KiB at its first
//! use: a page fault, which costs more than to fill the page. On Linux, [`ImageAllocator`] maps blocks from [`LARGE`] on with transparent huge pages of 2 MiB, and keeps up to 16 MiB of
//! freed ones for new blocks of the same size. Smaller blocks, and all blocks on other systems, are those of the system's allocator.
//!
//! ```
//! #[global_allocator]
//! static ALLOCATOR: cv_alloc::ImageAllocator = cv_alloc::ImageAllocator;
//!
//! let image = vec![0_u8; 12_000_000];
//! assert_eq!(image.len(), 12_000_000);
//! ```
//!
//! The only crate with unsafe code.

#[cfg(target_os = "linux")]
mod large;
#[cfg(target_os = "linux")]
mod spare;

use std::alloc::{GlobalAlloc, Layout, System};

/// Size in bytes from which a block has its own mapping with huge pages: half a huge page.
pub const LARGE: usize = 1 << 20;

/// The allocator, to be declared as `#[global_allocator]`.
#[derive(Debug, Clone, Copy, Default)]
pub struct ImageAllocator;

/// Returns whether a block has its own mapping. By its layout alone, so that it is freed as it was allocated.
fn is_large(layout: Layout) -> bool {
    // Mappings are aligned to pages.
    cfg!(target_os = "linux") && layout.size() >= LARGE && layout.align() <= 4096
}

// SAFETY: Small blocks are those of `System`. Large ones are mappings, at least as large as the layout and aligned to pages. Which of the two a block is depends on its layout alone.
// Nothing panics, and the list of spare mappings allocates nothing.
unsafe impl GlobalAlloc for ImageAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        #[cfg(target_os = "linux")]
        if is_large(layout) {
            return large::block(layout.size());
        }
        // SAFETY: the caller's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        #[cfg(target_os = "linux")]
        if is_large(layout) {
            return large::zeroed_block(layout.size());
        }
        // SAFETY: the caller's.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        #[cfg(target_os = "linux")]
        if is_large(layout) {
            // SAFETY: by its layout, the block is from `large::block`, `large::zeroed_block` or `large::remap`, for this size.
            return unsafe { large::free(block, layout.size()) };
        }
        // SAFETY: the caller's; by its layout, the block is from `System`.
        unsafe { System.dealloc(block, layout) }
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        // SAFETY: the caller guarantees that the new size, rounded up to the alignment, does not overflow.
        let new_layout = unsafe { Layout::from_size_align_unchecked(new_size, layout.align()) };
        match (is_large(layout), is_large(new_layout)) {
            // SAFETY: the caller's; by both layouts, the block is from `System` and stays there.
            (false, false) => unsafe { System.realloc(block, layout, new_size) },
            #[cfg(target_os = "linux")]
            // SAFETY: by its layout, the block is from `large::block`, `large::zeroed_block` or `large::remap`, for this size.
            (true, true) => unsafe { large::remap(block, layout.size(), new_size) },
            _ => {
                // SAFETY: the new layout is not empty: the caller guarantees that `new_size` is not 0.
                let new = unsafe { self.alloc(new_layout) };
                if !new.is_null() {
                    // SAFETY: the blocks do not overlap, and have at least the smaller of the sizes. The old one is freed once, by its layout.
                    unsafe {
                        new.copy_from_nonoverlapping(block, layout.size().min(new_size));
                        self.dealloc(block, layout);
                    }
                }
                new
            }
        }
    }
}
