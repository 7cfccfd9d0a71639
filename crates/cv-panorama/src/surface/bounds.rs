//! Rectangles of canvas pixels.

/// A rectangle of canvas pixels, right and bottom exclusive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// First column.
    pub left: usize,
    /// First row.
    pub top: usize,
    /// Column after the last.
    pub right: usize,
    /// Row after the last.
    pub bottom: usize,
}

impl Bounds {
    /// Columns.
    pub fn width(&self) -> usize {
        self.right - self.left
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.bottom - self.top
    }

    /// Returns whether a canvas pixel lies inside.
    #[inline]
    pub fn contains(&self, x: usize, y: usize) -> bool {
        x >= self.left && y >= self.top && x < self.right && y < self.bottom
    }

    /// Returns the row-major index of a pixel inside.
    #[inline(always)]
    pub(crate) fn index(&self, x: usize, y: usize) -> usize {
        (y - self.top) * self.width() + x - self.left
    }

    /// Returns the intersection; `None` where it is empty.
    pub fn intersection(&self, other: &Self) -> Option<Self> {
        let b = Self {
            left: self.left.max(other.left),
            top: self.top.max(other.top),
            right: self.right.min(other.right),
            bottom: self.bottom.min(other.bottom),
        };
        (b.left < b.right && b.top < b.bottom).then_some(b)
    }

    /// Returns the rectangle in the coordinates of one that contains it.
    pub(crate) fn relative_to(&self, outer: &Self) -> Self {
        Self {
            left: self.left - outer.left,
            top: self.top - outer.top,
            right: self.right - outer.left,
            bottom: self.bottom - outer.top,
        }
    }

    /// Grows the rectangle by `by` pixels on all sides, clipped to a canvas.
    pub(crate) fn grown(&self, by: usize, width: usize, height: usize) -> Self {
        Self {
            left: self.left.saturating_sub(by),
            top: self.top.saturating_sub(by),
            right: (self.right + by).min(width),
            bottom: (self.bottom + by).min(height),
        }
    }

    /// Grows the rectangle by the support of a pyramid of `levels` levels above its base, and rounds it out to whole pixels of every level.
    pub(crate) fn for_pyramid(&self, levels: usize, width: usize, height: usize) -> Self {
        let unit = 1 << levels;
        let grown = self.grown(2 * unit, width, height);
        Self {
            left: grown.left / unit * unit,
            top: grown.top / unit * unit,
            right: grown.right.next_multiple_of(unit).min(width),
            bottom: grown.bottom.next_multiple_of(unit).min(height),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rectangles_are_intersected_and_expanded_within_the_canvas() {
        let b = Bounds { left: 5, top: 2, right: 20, bottom: 9 };
        assert_eq!((b.width(), b.height()), (15, 7));
        assert!(b.contains(5, 8) && !b.contains(20, 8) && !b.contains(5, 9));
        let other = Bounds { left: 18, top: 0, right: 40, bottom: 3 };
        assert_eq!(b.intersection(&other), Some(Bounds { left: 18, top: 2, right: 20, bottom: 3 }));
        let inner = Bounds { left: 6, top: 4, right: 8, bottom: 9 };
        assert_eq!(inner.relative_to(&b), Bounds { left: 1, top: 2, right: 3, bottom: 7 });
        assert_eq!(b.intersection(&Bounds { left: 20, ..other }), None);
        assert_eq!(b.grown(3, 22, 100), Bounds { left: 2, top: 0, right: 22, bottom: 12 });
    }

    #[test]
    fn a_rectangle_for_a_pyramid_is_aligned_to_the_pixels_of_every_level() {
        let b = Bounds { left: 37, top: 70, right: 50, bottom: 75 };
        // Grown by 16, rounded out to multiples of 8.
        assert_eq!(b.for_pyramid(3, 1000, 90), Bounds { left: 16, top: 48, right: 72, bottom: 90 });
    }
}
