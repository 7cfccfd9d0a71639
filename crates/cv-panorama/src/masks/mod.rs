//! Masks of photographs: which of their pixels must be in the panorama, and which must not (the include and exclude masks of Hugin and PTGui).
//!
//! A removed pixel counts as one beyond the border of its photograph, and so does a pixel of every other photograph where one is kept: exposure, seams,
//! blending and layers follow from that. Under removed pixels the colors are continued from around them, so that none of them reaches the panorama
//! through interpolation, pyramids or gradients.

mod fill;
mod placed;

pub(crate) use fill::{Filled, filled};
pub(crate) use placed::{PlacedMasks, PreviewMasks, is_removed, is_removed_near};

use cv_core::Image;

/// What a mask says about a pixel of a photograph.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PhotoUse {
    /// Nothing: it is used where the seams say.
    #[default]
    Free,
    /// It is in the panorama wherever it lies on the canvas. Where two photographs keep the same place, that whose center is nearer is used.
    Keep,
    /// It is not in the panorama. Where no other photograph covers the place, the panorama is empty.
    Remove,
}

/// Mask of a photograph, of its size. Run-length encoded: it takes memory by the length of the outlines.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PhotoMask {
    width: usize,
    /// Of each row the runs in order: the column after the last, and the use.
    rows: Vec<Vec<(u32, PhotoUse)>>,
}

impl PhotoMask {
    /// Creates the mask of a photograph of `width × height` pixels from the use of each pixel `(x, y)`.
    pub fn from_fn(width: usize, height: usize, mut of: impl FnMut(usize, usize) -> PhotoUse) -> Self {
        let row = |y: usize| {
            let mut runs: Vec<(u32, PhotoUse)> = Vec::new();
            for x in 0..width {
                let (end, own) = (x as u32 + 1, of(x, y));
                match runs.last_mut() {
                    Some(last) if last.1 == own => last.0 = end,
                    _ => runs.push((end, own)),
                }
            }
            runs
        };
        Self { width, rows: (0..height).map(row).collect() }
    }

    /// Returns width and height in pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.rows.len())
    }

    /// Returns the use of a pixel; [`PhotoUse::Free`] outside.
    pub fn at(&self, x: usize, y: usize) -> PhotoUse {
        let Some(row) = self.rows.get(y) else { return PhotoUse::Free };
        let run = row.partition_point(|run| run.0 as usize <= x);
        row.get(run).map_or(PhotoUse::Free, |run| run.1)
    }

    /// Returns the use of the pixel around a position, as warping rounds it.
    fn around(&self, u: f32, v: f32) -> PhotoUse {
        let (w, h) = self.size();
        let inside = u >= -0.5 && v >= -0.5 && u <= w as f32 - 0.5 && v <= h as f32 - 0.5;
        if !inside {
            return PhotoUse::Free;
        }
        self.at(((u + 0.5) as usize).min(w - 1), ((v + 0.5) as usize).min(h - 1))
    }

    /// Returns whether any pixel has this use.
    pub fn has(&self, what: PhotoUse) -> bool {
        self.runs().any(|run| run.2 == what)
    }

    /// Row, first column and column after the last, and use of every run.
    fn runs(&self) -> impl Iterator<Item = (usize, (usize, usize), PhotoUse)> {
        self.rows.iter().enumerate().flat_map(|(y, row)| {
            let starts = [0].into_iter().chain(row.iter().map(|run| run.0 as usize));
            starts.zip(row).map(move |(start, run)| (y, (start, run.0 as usize), run.1))
        })
    }

    /// Returns whether any pixel of each block of `step × step` is removed, and whether any is kept, as [`REMOVED`] and [`KEPT`]; pixels of incomplete blocks
    /// count for the last complete one.
    fn blocks(&self, step: usize) -> Image<u8, 1> {
        let (w, h) = self.size();
        let (across, down) = ((w / step).max(1), (h / step).max(1));
        let mut blocks = Image::new(across, down, [0]);
        for (y, (start, end), what) in self.runs() {
            let flag = match what {
                PhotoUse::Free => continue,
                PhotoUse::Keep => KEPT,
                PhotoUse::Remove => REMOVED,
            };
            let block = |v: usize, n: usize| (v / step).min(n - 1);
            let row = blocks.row_mut(block(y, down));
            row[block(start, across)..=block(end - 1, across)].iter_mut().for_each(|block| *block |= flag);
        }
        blocks
    }
}

/// Flag of a block with removed pixels.
const REMOVED: u8 = 1;
/// Flag of a block with kept pixels.
const KEPT: u8 = 2;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn uses() -> impl Strategy<Value = Vec<PhotoUse>> {
        let one = prop_oneof![Just(PhotoUse::Free), Just(PhotoUse::Keep), Just(PhotoUse::Remove)];
        proptest::collection::vec(one, 7 * 5)
    }

    proptest! {
        #[test]
        fn runs_and_blocks_are_those_of_the_pixels(uses in uses(), step in 1..4_usize) {
            let mask = PhotoMask::from_fn(7, 5, |x, y| uses[7 * y + x]);
            prop_assert_eq!(mask.size(), (7, 5));
            let places = || (0..5).flat_map(|y| (0..7).map(move |x| (x, y)));
            let mut blocks = Image::new(7 / step, 5 / step, [0]);
            for (x, y) in places() {
                let own = uses[7 * y + x];
                prop_assert_eq!(mask.at(x, y), own);
                let (x, y) = ((x / step).min(7 / step - 1), (y / step).min(5 / step - 1));
                blocks.row_mut(y)[x] |= match own {
                    PhotoUse::Free => 0,
                    PhotoUse::Keep => KEPT,
                    PhotoUse::Remove => REMOVED,
                };
            }
            prop_assert_eq!(mask.blocks(step), blocks);
            for what in [PhotoUse::Free, PhotoUse::Keep, PhotoUse::Remove] {
                prop_assert_eq!(mask.has(what), uses.contains(&what));
            }
            prop_assert_eq!((mask.at(7, 0), mask.at(0, 5)), (PhotoUse::Free, PhotoUse::Free));
        }
    }

    #[test]
    fn positions_are_rounded_and_lie_within_half_a_pixel_of_the_border() {
        let mask = PhotoMask::from_fn(4, 3, |x, _| if x == 3 { PhotoUse::Remove } else { PhotoUse::Keep });
        let at = |u: f32, v: f32| mask.around(u, v);
        assert_eq!([at(2.4, 1.0), at(2.6, 1.0), at(3.5, 2.5)], [PhotoUse::Keep, PhotoUse::Remove, PhotoUse::Remove]);
        assert_eq!([at(-0.5, -0.5), at(-0.6, 0.0), at(3.6, 0.0)], [PhotoUse::Keep, PhotoUse::Free, PhotoUse::Free]);
        assert_eq!([at(f32::NAN, 0.0), at(1.0, f32::INFINITY)], [PhotoUse::Free; 2]);
        let none = PhotoMask::from_fn(0, 0, |_, _| PhotoUse::Keep);
        assert_eq!((none.around(0.0, 0.0), none.size()), (PhotoUse::Free, (0, 0)));
    }
}
