//! Erosion and dilation of masks.
//!
//! Masks are packed 64 pixels to a word. A structuring element is a set of horizontal runs; a row is dilated by a run of length `n` with
//! `log₂ n` shifts, and the result is the union over the element's rows.

use cv_core::{ImageView, Mask};
use rayon::prelude::*;

/// The set of offsets a mask is eroded or dilated by; its origin is its middle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StructuringElement {
    /// Row offset, first and last column offset of each run.
    runs: Vec<(isize, isize, isize)>,
}

impl StructuringElement {
    /// A rectangle of `2 rx + 1` by `2 ry + 1` pixels.
    pub fn rectangle(rx: usize, ry: usize) -> Self {
        let (rx, ry) = (clip(rx), clip(ry));
        Self { runs: (-ry..=ry).map(|y| (y, -rx, rx)).collect() }
    }

    /// A square of `2 r + 1` pixels a side.
    pub fn square(r: usize) -> Self {
        Self::rectangle(r, r)
    }

    /// A disc of radius `r` pixels, the pixels that OpenCV's `getStructuringElement(MORPH_ELLIPSE, (2r + 1, 2r + 1))` has.
    pub fn disc(r: usize) -> Self {
        let r = clip(r);
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

    /// A plus of arms of `r` pixels.
    pub fn cross(r: usize) -> Self {
        let r = clip(r);
        Self { runs: (-r..=r).map(|y| if y == 0 { (0, -r, r) } else { (y, 0, 0) }).collect() }
    }

    /// Any shape: the true pixels of a mask, around its middle pixel `(w / 2, h / 2)`.
    ///
    /// An element without pixels dilates to nothing and erodes to everything, as the definitions say.
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

    /// Mirrored about the origin.
    fn reflected(&self) -> Self {
        Self { runs: self.runs.iter().map(|&(y, a, b)| (-y, -b, -a)).collect() }
    }
}

/// No image is larger than this; keeps offsets far from overflow.
fn clip(r: usize) -> isize {
    r.min(1 << 20) as isize
}

/// A mask, 64 pixels to a word, rows of `words` words. Bits beyond the width are zero.
struct Bits {
    data: Vec<u64>,
    width: usize,
    height: usize,
    words: usize,
}

impl Bits {
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

    /// The bits of a row's last word that are pixels.
    fn last_word(&self) -> u64 {
        match self.width {
            0 => 0,
            w => u64::MAX >> (63 - (w - 1) % 64),
        }
    }

    fn not(mut self) -> Self {
        let last = self.last_word();
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

    /// Dilation: `out(p)` is true where `self(p − o)` is for some offset `o` of the element; outside is false.
    fn dilate(&self, element: &StructuringElement) -> Self {
        let mut out = Self::zeros(self.width, self.height);
        let w = self.width as isize;
        // Runs of one shape share the horizontal work: for each shape, the rows it applies to.
        let mut runs = element.runs.clone();
        runs.retain(|&(_, a, b)| a < w && b > -w);
        runs.sort_unstable_by_key(|&(y, a, b)| (a, b, y));
        for shape in runs.chunk_by(|p, q| (p.1, p.2) == (q.1, q.2)) {
            let (a, b) = (shape[0].1.max(-w), shape[0].2.min(w));
            let along = self.dilate_rows(a, b);
            let height = self.height as isize;
            out.data.par_chunks_mut(self.words).with_min_len(32).enumerate().for_each(|(y, out)| {
                for &(dy, ..) in shape {
                    let from = y as isize - dy;
                    if (0..height).contains(&from) {
                        let row = &along[from as usize * self.words..][..self.words];
                        out.iter_mut().zip(row).for_each(|(o, r)| *o |= r);
                    }
                }
            });
        }
        out
    }

    /// Every row dilated by the columns `a..=b`.
    fn dilate_rows(&self, a: isize, b: isize) -> Vec<u64> {
        let length = (b - a + 1) as usize;
        let mut out = vec![0; self.data.len()];
        let last = self.last_word();
        // Working space: the run of `length` starts up to |a| pixels left of the row, so shift the row right by |a|min first within a longer line.
        let (left, right) = ((-a).max(0) as usize, b.max(0) as usize);
        let line = (self.width + left + right).div_ceil(64) + 1;
        let buffers = || (vec![0u64; line], vec![0u64; line]);
        out.par_chunks_mut(self.words).zip(self.data.par_chunks(self.words)).with_min_len(32).for_each_init(
            buffers,
            |(grown, shifted), (out, row)| {
                // Pixel x sits at bit x + left; the run covers x + a ..= x + b, that is bits (x + left + a) + 0..length.
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

/// `to = from << bits` across words.
fn shift_up(bits: usize, from: &[u64], to: &mut [u64]) {
    let (words, bits) = (bits / 64, bits % 64);
    let at = |i: usize| i.checked_sub(words).and_then(|i| from.get(i)).copied().unwrap_or(0);
    for (i, to) in to.iter_mut().enumerate() {
        let carried = if bits > 0 && i > 0 { at(i - 1) >> (64 - bits) } else { 0 };
        *to = at(i) << bits | carried;
    }
}

/// `to = from >> bits` across words.
fn shift_down(bits: usize, from: &[u64], to: &mut [u64]) {
    let (words, bits) = (bits / 64, bits % 64);
    let at = |i: usize| from.get(i + words).copied().unwrap_or(0);
    for (i, to) in to.iter_mut().enumerate() {
        let carried = if bits > 0 { at(i + 1) << (64 - bits) } else { 0 };
        *to = at(i) >> bits | carried;
    }
}

/// True where the element, reflected and centered on the pixel, touches a true pixel. Outside the image counts as false.
pub fn dilate(view: ImageView<'_, bool, 1>, element: &StructuringElement) -> Mask {
    Bits::pack(view).dilate(element).unpack()
}

/// True where the element, centered on the pixel, covers only true pixels. Outside the image counts as true.
pub fn erode(view: ImageView<'_, bool, 1>, element: &StructuringElement) -> Mask {
    eroded(Bits::pack(view), element).unpack()
}

/// Erosion then dilation: takes away what the element does not fit into.
pub fn open(view: ImageView<'_, bool, 1>, element: &StructuringElement) -> Mask {
    eroded(Bits::pack(view), element).dilate(element).unpack()
}

/// Dilation then erosion: fills what the reflected element does not fit into.
pub fn close(view: ImageView<'_, bool, 1>, element: &StructuringElement) -> Mask {
    eroded(Bits::pack(view).dilate(element), element).unpack()
}

/// Erosion is dilation of the complement by the reflected element.
fn eroded(bits: Bits, element: &StructuringElement) -> Bits {
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

    /// The definitions, pixel by pixel.
    fn plain(mask: &Mask, element: &StructuringElement, grow: bool) -> Mask {
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
        fn all_four_are_their_definitions(
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
            let (grown, shrunk) = (plain(&mask, &element, true), plain(&mask, &element, false));
            prop_assert_eq!(&dilate(mask.view(), &element), &grown);
            prop_assert_eq!(&erode(mask.view(), &element), &shrunk);
            prop_assert_eq!(open(mask.view(), &element), plain(&shrunk, &element, true));
            prop_assert_eq!(close(mask.view(), &element), plain(&grown, &element, false));
        }
    }

    #[test]
    fn the_discs_are_opencvs() {
        // Half widths of the rows of getStructuringElement(MORPH_ELLIPSE, (2r+1, 2r+1)), read off OpenCV.
        let halves = |r| StructuringElement::disc(r).runs.iter().map(|&(_, _, b)| b).collect::<Vec<_>>();
        assert_eq!(halves(0), [0]);
        assert_eq!(halves(1), [0, 1, 0]);
        assert_eq!(halves(2), [0, 2, 2, 2, 0]);
        assert_eq!(halves(3), [0, 2, 3, 3, 3, 2, 0]);
    }

    #[test]
    fn the_border_neither_eats_nor_feeds() {
        let full = Mask::new(70, 5, [true]);
        let element = StructuringElement::square(2);
        for result in [erode(full.view(), &element), open(full.view(), &element), close(full.view(), &element)] {
            assert_eq!(result, full);
        }
        let none = Mask::new(70, 5, [false]);
        assert_eq!(dilate(none.view(), &element), none);
    }

    #[test]
    fn empty_images_and_elements_far_too_large() {
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
