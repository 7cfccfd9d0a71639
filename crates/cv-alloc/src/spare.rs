//! Spare blocks: mappings that were freed and are kept for the next block of the same capacity. The kernel clears every page of a new mapping, which takes longer than to map it.

use std::sync::{Mutex, PoisonError};

/// Maximum total capacity of the spare blocks in bytes. Twice as much raises the peak memory by as much, and saves no time.
const MAX_TOTAL: usize = 16 << 20;
/// Maximum number of spare blocks.
const MAX_COUNT: usize = 16;

/// A mapping that is not in use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Spare {
    /// Its exposed address.
    pub(crate) address: usize,
    /// Its size in bytes.
    pub(crate) capacity: usize,
}

/// A list of spare blocks, in the order in which they were freed; it allocates nothing.
struct Spares {
    blocks: [Spare; MAX_COUNT],
    count: usize,
    total: usize,
}

static SPARES: Mutex<Spares> = Mutex::new(Spares::EMPTY);

impl Spares {
    const EMPTY: Self = Self { blocks: [Spare { address: 0, capacity: 0 }; MAX_COUNT], count: 0, total: 0 };

    fn remove(&mut self, index: usize) -> Spare {
        let block = self.blocks[index];
        self.blocks.copy_within(index + 1..self.count, index);
        self.count -= 1;
        self.total -= block.capacity;
        block
    }

    fn take(&mut self, capacity: usize) -> Option<Spare> {
        let index = (0..self.count).rev().find(|&i| self.blocks[i].capacity == capacity)?;
        Some(self.remove(index))
    }

    fn put(&mut self, block: Spare, mut release: impl FnMut(Spare)) {
        if block.capacity > MAX_TOTAL {
            return release(block);
        }
        while self.count == MAX_COUNT || self.total + block.capacity > MAX_TOTAL {
            release(self.remove(0));
        }
        self.blocks[self.count] = block;
        self.count += 1;
        self.total += block.capacity;
    }
}

/// Takes the spare block of exactly this capacity that was freed last: it is most likely in the cache.
pub(crate) fn take(capacity: usize) -> Option<Spare> {
    SPARES.lock().unwrap_or_else(PoisonError::into_inner).take(capacity)
}

/// Keeps a freed block. Passes to `release` the oldest ones beyond the limits, or the block itself if it is larger than all spare blocks may be.
pub(crate) fn put(block: Spare, release: impl FnMut(Spare)) {
    SPARES.lock().unwrap_or_else(PoisonError::into_inner).put(block, release);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(address: usize, mib: usize) -> Spare {
        Spare { address, capacity: mib << 20 }
    }

    #[test]
    fn the_last_block_of_exactly_the_capacity_is_taken_once() {
        let mut spares = Spares::EMPTY;
        for b in [block(1, 2), block(2, 3), block(3, 2), block(4, 4)] {
            spares.put(b, |_| panic!("11 MiB are within the limit"));
        }
        assert_eq!(spares.take(2 << 20), Some(block(3, 2)));
        assert_eq!(spares.take(2 << 20), Some(block(1, 2)));
        assert_eq!(spares.take(2 << 20), None);
        assert_eq!(spares.take((3 << 20) - 1), None);
        assert_eq!(spares.take(3 << 20), Some(block(2, 3)));
        assert_eq!((spares.count, spares.total), (1, 4 << 20));
    }

    #[test]
    fn the_oldest_blocks_beyond_the_limits_are_released() {
        let mut spares = Spares::EMPTY;
        let mut released = Vec::new();
        for b in [block(1, 6), block(2, 6), block(3, 5), block(4, 17), block(5, 16)] {
            spares.put(b, |b| released.push(b));
        }
        // The third exceeds the total with the first; the fourth alone; the fifth with all others.
        assert_eq!(released, [block(1, 6), block(4, 17), block(2, 6), block(3, 5)]);
        assert_eq!(spares.take(16 << 20), Some(block(5, 16)));
        released.clear();
        for address in 0..MAX_COUNT + 2 {
            spares.put(Spare { address, capacity: 1 }, |b| released.push(b));
        }
        assert_eq!(released.iter().map(|b| b.address).collect::<Vec<_>>(), [0, 1]);
        assert_eq!((spares.count, spares.total), (MAX_COUNT, MAX_COUNT));
    }
}
