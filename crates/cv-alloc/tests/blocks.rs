//! Blocks of the allocator, as Rust's collections use them.

use cv_alloc::{ImageAllocator, LARGE};
use std::alloc::{GlobalAlloc, Layout};

#[global_allocator]
static ALLOCATOR: ImageAllocator = ImageAllocator;

/// A value that depends on the place.
fn value(i: usize, seed: usize) -> u8 {
    (i.wrapping_mul(2_654_435_761).wrapping_add(seed) >> 7) as u8
}

#[test]
fn a_vector_keeps_its_values_while_it_grows_and_shrinks() {
    let mut bytes = Vec::new();
    for i in 0..5 * LARGE {
        bytes.push(value(i, 0));
    }
    bytes.reserve_exact(40 * LARGE);
    bytes.truncate(3 * LARGE);
    bytes.shrink_to_fit();
    assert!(bytes.iter().enumerate().all(|(i, v)| *v == value(i, 0)));
    bytes.truncate(LARGE / 2);
    bytes.shrink_to_fit();
    assert!(bytes.iter().enumerate().all(|(i, v)| *v == value(i, 0)));
}

#[test]
fn zeroed_blocks_are_zero() {
    for size in [LARGE - 1, LARGE, 3 * LARGE + 5, 20 * LARGE] {
        for _ in 0..4 {
            let mut block = vec![0_u8; size];
            assert!(block.iter().all(|v| *v == 0), "{size}");
            block.fill(0xa5);
        }
    }
}

#[test]
fn live_blocks_of_all_threads_are_disjoint() {
    std::thread::scope(|scope| {
        for thread in 0..4 {
            scope.spawn(move || {
                let mut blocks: Vec<(usize, Vec<u8>)> = Vec::new();
                for round in 0..60 {
                    let (seed, size) = (1000 * thread + round, LARGE / 2 + (round * 7919 % 7) * LARGE / 3);
                    blocks.push((seed, (0..size).map(|i| value(i, seed)).collect()));
                    if round % 3 == 2 {
                        let (seed, block) = blocks.swap_remove(round % blocks.len());
                        assert!(block.iter().enumerate().all(|(i, v)| *v == value(i, seed)), "{seed}");
                    }
                }
                for (seed, block) in blocks {
                    assert!(block.iter().enumerate().all(|(i, v)| *v == value(i, seed)), "{seed}");
                }
            });
        }
    });
}

#[test]
fn blocks_are_aligned_as_their_layouts_and_impossible_ones_are_null() {
    for size in [100, LARGE, 3 * LARGE] {
        for align in [1, 64, 4096, 1 << 16] {
            let layout = Layout::from_size_align(size, align).unwrap();
            // SAFETY: the layout is not empty; the block is used within its size and freed with its layout.
            unsafe {
                let block = ALLOCATOR.alloc(layout);
                assert!(!block.is_null() && block.addr().is_multiple_of(align), "{size} {align}");
                block.write_bytes(1, size);
                ALLOCATOR.dealloc(block, layout);
            }
        }
    }
    // More than any address space.
    let layout = Layout::from_size_align(1 << 60, 8).unwrap();
    // SAFETY: the layout is not empty; nothing is done with the null pointer.
    assert!(unsafe { ALLOCATOR.alloc(layout).is_null() && ALLOCATOR.alloc_zeroed(layout).is_null() });
    // A vector of them says so instead of aborting.
    assert!(Vec::<u8>::new().try_reserve_exact(1 << 60).is_err());
}
