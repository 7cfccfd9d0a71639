//! Resident memory of the process: alone in its binary, as other tests would allocate meanwhile.

#![cfg(target_os = "linux")]

use cv_alloc::{ImageAllocator, LARGE};

#[global_allocator]
static ALLOCATOR: ImageAllocator = ImageAllocator;

#[test]
fn freed_memory_is_given_back() {
    // Resident memory of this process in MiB.
    let resident = || {
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse::<usize>().unwrap() / 1024
    };
    let before = resident();
    // A little more than what is asserted: the kernel counts pages in batches for each processor.
    let blocks: Vec<Vec<u8>> = (0..10).map(|_| vec![1; 61 * LARGE]).collect();
    assert!(resident() >= before + 600 * LARGE / (1 << 20), "{} {before}", resident());
    drop(blocks);
    // The allocator keeps up to 16 MiB for reuse.
    assert!(resident() <= before + 20, "{} {before}", resident());
}
