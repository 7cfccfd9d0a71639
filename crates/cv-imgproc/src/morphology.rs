//! Binary morphology: dilation, erosion, opening and closing of masks.
//!
//! Masks are packed 64 pixels to a word. A structuring element is a set of horizontal runs; dilation of a row by a run of length `n` takes
//! `log₂ n` shifts, and the result is the union over the element's runs.

use cv_core::{ImageView, Mask};
use cv_parallel::prelude::*;

/// A structuring element: a set of pixel offsets around its origin, the center.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StructuringElement {
    /// Row offset, first and last column offset of each run.
    runs: Vec<(isize, isize, isize)>,
}

impl StructuringElement {
    /// Makes a rectangle of `2 rx + 1` by `2 ry + 1` pixels.
    pub fn rectangle(rx: usize, ry: usize) -> Self {
        let (rx, ry) = (clamp_radius(rx), clamp_radius(ry));
        Self { runs: (-ry..=ry).map(|y| (y, -rx, rx)).collect() }
    }

    /// Makes a square of `2 r + 1` pixels a side.
    pub fn square(r: usize) -> Self {
        Self::rectangle(r, r)
    }

    /// Makes a disc of radius `r` pixels, equal to OpenCV's `getStructuringElement(MORPH_ELLIPSE, (2r + 1, 2r + 1))`.
    pub fn disc(r: usize) -> Self {
        let r = clamp_radius(r);
        let runs = (-r..=r).map(|y| {
            let half = if r > 0 {
                (r as f64 * ((r * r - y * y) as f64 / (r * r) as f64).sqrt()).round_ties_even() as isize
            } else {
                0
            };
            (y, -half, half)
        });
        Self { runs: runs.collect() }
    }

    /// Makes a cross with arms of `r` pixels.
    pub fn cross(r: usize) -> Self {
        let r = clamp_radius(r);
        Self { runs: (-r..=r).map(|y| if y == 0 { (0, -r, r) } else { (y, 0, 0) }).collect() }
    }

    /// Makes an element of any shape: the true pixels of a mask, with origin `(w / 2, h / 2)`.
    ///
    /// Dilation by an empty element gives an all-false mask, erosion an all-true one.
    pub fn from_mask(mask: ImageView<'_, bool, 1>) -> Self {
        let (cx, cy) = ((mask.width() / 2) as isize, (mask.height() / 2) as isize);
        let mut runs = Vec::new();
        for y in 0..mask.height() {
            let row = mask.row(y);
            let mut x = 0;
            while x < row.len() {
                let start = x;
                while x < row.len() && row[x] {
                    x += 1;
                }
                if x > start {
                    runs.push((y as isize - cy, start as isize - cx, x as isize - 1 - cx));
                }
                x += 1;
            }
        }
        Self { runs }
    }

    /// Reflects the element about its origin.
    fn reflected(&self) -> Self {
        Self { runs: self.runs.iter().map(|&(y, a, b)| (-y, -b, -a)).collect() }
    }
}

/// Clamps a radius to more than any image size, far from overflow.
fn clamp_radius(r: usize) -> isize {
    r.min(1 << 20) as isize
}

/// A mask packed 64 pixels to a word, rows of `words` words. Bits beyond the width are zero.
struct PackedMask {
    data: Vec<u64>,
    width: usize,
    height: usize,
    words: usize,
}

impl PackedMask {
    fn zeros(width: usize, height: usize) -> Self {
        let words = width.div_ceil(64).max(1);
        Self { data: vec![0; words * height], width, height, words }
    }

    fn pack(view: ImageView<'_, bool, 1>) -> Self {
        let mut bits = Self::zeros(view.width(), view.height());
        bits.data.par_chunks_mut(bits.words).with_min_len(64).enumerate().for_each(|(y, row)| {
            for (word, pixels) in row.iter_mut().zip(view.row(y).chunks(64)) {
                *word = pixels.iter().enumerate().fold(0, |w, (i, &p)| w | u64::from(p) << i);
            }
        });
        bits
    }

    fn unpack(&self) -> Mask {
        let mut mask = Mask::new(self.width, self.height, [false]);
        if !mask.is_empty() {
            let rows = mask.as_mut_slice().par_chunks_mut(self.width).with_min_len(64);
            rows.zip(self.data.par_chunks(self.words)).for_each(|(row, words)| {
                for (pixels, &word) in row.chunks_mut(64).zip(words) {
                    for (i, p) in pixels.iter_mut().enumerate() {
                        *p = word >> i & 1 != 0;
                    }
                }
            });
        }
        mask
    }

    /// Returns the bit mask of the valid pixels in the last word of a row.
    fn last_word_mask(&self) -> u64 {
        match self.width {
            0 => 0,
            w => u64::MAX >> (63 - (w - 1) % 64),
        }
    }

    fn not(mut self) -> Self {
        let last = self.last_word_mask();
        for row in self.data.chunks_exact_mut(self.words) {
            for word in row.iter_mut() {
                *word = !*word;
            }
            if let Some(word) = row.last_mut() {
                *word &= last;
            }
        }
        self
    }

    /// Dilates: `out(p)` is true where `self(p − o)` is true for some offset `o` of the element; outside is false.
    fn dilate(&self, element: &StructuringElement) -> Self {
        let mut out = Self::zeros(self.width, self.height);
        let w = self.width as isize;
        // Runs with the same columns share the horizontal dilation: group them, each with the rows it applies to.
        let mut runs = element.runs.clone();
        runs.retain(|&(_, a, b)| a < w && b > -w);
        runs.sort_unstable_by_key(|&(y, a, b)| (a, b, y));
        for shape in runs.chunk_by(|p, q| (p.1, p.2) == (q.1, q.2)) {
            let (a, b) = (shape[0].1.max(-w), shape[0].2.min(w));
            let dilated_rows = self.dilate_rows(a, b);
            let height = self.height as isize;
            out.data.par_chunks_mut(self.words).with_min_len(32).enumerate().for_each(|(y, out)| {
                for &(dy, ..) in shape {
                    let from = y as isize - dy;
                    if (0..height).contains(&from) {
                        let row = &dilated_rows[from as usize * self.words..][..self.words];
                        out.iter_mut().zip(row).for_each(|(o, r)| *o |= r);
                    }
                }
            });
        }
        out
    }

    /// Dilates every row by the column offsets `a..=b`.
    fn dilate_rows(&self, a: isize, b: isize) -> Vec<u64> {
        let length = (b - a + 1) as usize;
        let mut out = vec![0; self.data.len()];
        let last = self.last_word_mask();
        // Padded row buffers: the run may extend beyond both ends of the row.
        let (left, right) = ((-a).max(0) as usize, b.max(0) as usize);
        let padded_words = (self.width + left + right).div_ceil(64) + 1;
        let buffers = || (vec![0u64; padded_words], vec![0u64; padded_words]);
        out.par_chunks_mut(self.words).zip(self.data.par_chunks(self.words)).with_min_len(32).for_each_init(
            buffers,
            |(grown, shifted), (out, row)| {
                // Pixel x is bit x + left; the run covers x + a ..= x + b, that is bits (x + left + a) + 0..length.
                grown.fill(0);
                grown[..row.len()].copy_from_slice(row);
                shift_up((left as isize + a) as usize, grown, shifted);
                std::mem::swap(grown, shifted);
                let mut covered = 1;
                while covered < length {
                    let step = covered.min(length - covered);
                    shift_up(step, grown, shifted);
                    grown.iter_mut().zip(shifted.iter()).for_each(|(g, s)| *g |= s);
                    covered += step;
                }
                shift_down(left, grown, out);
                if let Some(word) = out.last_mut() {
                    *word &= last;
                }
            },
        );
        out
    }
}

/// Computes `to = from << bits` across words.
fn shift_up(bits: usize, from: &[u64], to: &mut [u64]) {
    let (words, bits) = (bits / 64, bits % 64);
    let at = |i: usize| i.checked_sub(words).and_then(|i| from.get(i)).copied().unwrap_or(0);
    for (i, to) in to.iter_mut().enumerate() {
        let carried = if bits > 0 && i > 0 { at(i - 1) >> (64 - bits) } else { 0 };
        *to = at(i) << bits | carried;
    }
}

/// Computes `to = from >> bits` across words.
fn shift_down(bits: usize, from: &[u64], to: &mut [u64]) {
    let (words, bits) = (bits / 64, bits % 64);
    let at = |i: usize| from.get(i + words).copied().unwrap_or(0);
    for (i, to) in to.iter_mut().enumerate() {
        let carried = if bits > 0 { at(i + 1) << (64 - bits) } else { 0 };
        *to = at(i) >> bits | carried;
    }
}

/// Dilates a mask: true where the reflected element, centered on the pixel, hits a true pixel. Pixels outside the image count as false.
pub fn dilate(view: ImageView<'_, bool, 1>, element: &StructuringElement) -> Mask {
    PackedMask::pack(view).dilate(element).unpack()
}

/// Erodes a mask: true where the element, centered on the pixel, covers only true pixels. Pixels outside the image count as true.
pub fn erode(view: ImageView<'_, bool, 1>, element: &StructuringElement) -> Mask {
    erode_packed(PackedMask::pack(view), element).unpack()
}

/// Opens a mask (erosion, then dilation): removes parts that the element does not fit into.
pub fn open(view: ImageView<'_, bool, 1>, element: &StructuringElement) -> Mask {
    erode_packed(PackedMask::pack(view), element).dilate(element).unpack()
}

/// Closes a mask (dilation, then erosion): fills gaps that the reflected element does not fit into.
pub fn close(view: ImageView<'_, bool, 1>, element: &StructuringElement) -> Mask {
    erode_packed(PackedMask::pack(view).dilate(element), element).unpack()
}

/// Erodes as the complement of the dilation of the complement by the reflected element.
fn erode_packed(bits: PackedMask, element: &StructuringElement) -> PackedMask {
    bits.not().dilate(&element.reflected()).not()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn offsets(element: &StructuringElement) -> Vec<(isize, isize)> {
        element.runs.iter().flat_map(|&(y, a, b)| (a..=b).map(move |x| (x, y))).collect()
    }

    fn at(mask: &Mask, x: isize, y: isize) -> Option<bool> {
        let inside = x >= 0 && y >= 0 && (x as usize) < mask.width() && (y as usize) < mask.height();
        inside.then(|| mask.at(x as usize, y as usize)[0])
    }

    /// Reference implementation: the definitions, pixel by pixel.
    fn reference(mask: &Mask, element: &StructuringElement, grow: bool) -> Mask {
        let offsets = offsets(element);
        Mask::from_fn(mask.width(), mask.height(), |x, y| {
            let (x, y) = (x as isize, y as isize);
            [if grow {
                offsets.iter().any(|&(i, j)| at(mask, x - i, y - j).unwrap_or(false))
            } else {
                offsets.iter().all(|&(i, j)| at(mask, x + i, y + j).unwrap_or(true))
            }]
        })
    }

    fn noise(w: usize, h: usize, seed: u32, density: u32) -> Mask {
        let mut state = seed | 1;
        Mask::from_fn(w, h, |_, _| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            [(state >> 8) % 100 < density]
        })
    }

    proptest! {
        #[test]
        fn all_operations_equal_their_definitions(
            w in 1usize..200, h in 1usize..12, seed in any::<u32>(), kind in 0usize..5, r in 0usize..6, long in 0usize..150, density in 1u32..99,
        ) {
            let element = match kind {
                0 => StructuringElement::rectangle(long, r),
                1 => StructuringElement::disc(r),
                2 => StructuringElement::cross(r),
                3 => StructuringElement::from_mask(noise(r + 1, 4, seed ^ 77, 50).view()),
                _ => StructuringElement::from_mask(noise(long + 1, 2, seed ^ 99, 5).view()),
            };
            let mask = noise(w, h, seed, density);
            let (grown, shrunk) = (reference(&mask, &element, true), reference(&mask, &element, false));
            prop_assert_eq!(&dilate(mask.view(), &element), &grown);
            prop_assert_eq!(&erode(mask.view(), &element), &shrunk);
            prop_assert_eq!(open(mask.view(), &element), reference(&shrunk, &element, true));
            prop_assert_eq!(close(mask.view(), &element), reference(&grown, &element, false));
        }
    }

    #[test]
    fn discs_match_opencv() {
        // Half widths of the rows of OpenCV's getStructuringElement(MORPH_ELLIPSE, (2r+1, 2r+1)).
        let halves = |r| StructuringElement::disc(r).runs.iter().map(|&(_, _, b)| b).collect::<Vec<_>>();
        assert_eq!(halves(0), [0]);
        assert_eq!(halves(1), [0, 1, 0]);
        assert_eq!(halves(2), [0, 2, 2, 2, 0]);
        assert_eq!(halves(3), [0, 2, 3, 3, 3, 2, 0]);
    }

    #[test]
    fn the_border_neither_erodes_nor_dilates() {
        let full = Mask::new(70, 5, [true]);
        let element = StructuringElement::square(2);
        for result in [erode(full.view(), &element), open(full.view(), &element), close(full.view(), &element)] {
            assert_eq!(result, full);
        }
        let none = Mask::new(70, 5, [false]);
        assert_eq!(dilate(none.view(), &element), none);
    }

    #[test]
    fn empty_images_and_oversized_elements() {
        for size in [(0, 0), (0, 4), (4, 0)] {
            let mask = Mask::new(size.0, size.1, [true]);
            assert_eq!(open(mask.view(), &StructuringElement::disc(3)).size(), size);
        }
        let mut mask = Mask::new(9, 3, [false]);
        mask.set(4, 1, [true]);
        assert!(dilate(mask.view(), &StructuringElement::rectangle(usize::MAX, 2)).as_slice().iter().all(|&m| m));
        assert!(erode(mask.view(), &StructuringElement::square(1)).as_slice().iter().all(|&m| !m));
    }
}
