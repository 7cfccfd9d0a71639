//! Buffers that start on a cache line.

/// A reusable buffer of `T` that starts at a cache line.
#[derive(Debug, Default)]
pub(crate) struct AlignedBuffer<T> {
    data: Vec<T>,
    start: usize,
    len: usize,
}

const LINE: usize = 64;

impl<T: Copy> AlignedBuffer<T> {
    /// Resizes the buffer to `len` elements: `fill`, or, if the buffer was used before, unspecified values.
    pub(crate) fn resize(&mut self, len: usize, fill: T) {
        let needed = len + LINE / size_of::<T>();
        if self.data.len() < needed {
            // Without a copy of the old elements.
            self.data = vec![fill; needed];
        }
        self.start = self.data.as_ptr().align_offset(LINE).min(needed - len);
        self.len = len;
    }

    pub(crate) fn as_mut_slice(&mut self) -> &mut [T] {
        &mut self.data[self.start..self.start + self.len]
    }
}
