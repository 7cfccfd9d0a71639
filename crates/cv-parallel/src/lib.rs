//! Parallel iteration over rows and items on rayon's threads.
//!
//! The traits have the names and methods of rayon's that this workspace needs, with two differences:
//!
//! * A loop is a trait object for rayon, which is instantiated once, in this crate: with some 200 loops, the program is a fifteenth smaller than with
//!   rayon's iterators, and a crate with many loops, `cv-stereo`, compiles in 0.94 of the time.
//! * Of several errors the one of the first item is returned, whatever the number of threads.
//!
//! The items of a loop are listed before it begins (a row of an image is one item): it is for rows, tiles, images and other items of a microsecond and
//! more. Complexity: O(n) memory in the number of items.
//!
//! ```
//! use cv_parallel::prelude::*;
//!
//! let mut image = vec![0; 640 * 480];
//! image.par_chunks_mut(640).enumerate().for_each(|(y, row)| row.fill(y));
//! let sums = image.par_chunks(640).map(|row| row.iter().sum::<usize>()).collect();
//! assert_eq!(sums[3], 3 * 640);
//! ```

mod batches;
mod map;
mod parallel_iterator;

pub use map::ParallelMap;
pub use parallel_iterator::{IntoParallelIterator, ParallelIterator, ParallelSlice, ParallelSliceMut};

/// The traits, for `use cv_parallel::prelude::*`.
pub mod prelude {
    pub use crate::{IntoParallelIterator, ParallelSlice, ParallelSliceMut};
}
