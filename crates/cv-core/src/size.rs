//! The size of an image or of a view of one.

/// The accessors of a struct with the fields `width` and `height`, in pixels.
macro_rules! size_accessors {
    () => {
        /// Width in pixels.
        #[inline]
        pub fn width(&self) -> usize {
            self.width
        }

        /// Height in pixels.
        #[inline]
        pub fn height(&self) -> usize {
            self.height
        }

        /// Width and height in pixels.
        #[inline]
        pub fn size(&self) -> (usize, usize) {
            (self.width, self.height)
        }

        /// True where there are no pixels.
        #[inline]
        pub fn is_empty(&self) -> bool {
            self.width == 0 || self.height == 0
        }
    };
}

pub(crate) use size_accessors;
