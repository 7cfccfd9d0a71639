//! Colors under the removed pixels of a photograph, by push and pull (Gortler, Grzeszczuk, Szeliski & Cohen 1996, §5.2.1): means of what is known at coarser
//! and coarser resolution, interpolated where finer ones know nothing.

use super::{PhotoMask, PhotoUse};
use crate::bit_depth::{Channel, PhotoSample};
use crate::rows::{for_each_row, is_check_due};
use crate::stream::PhotoSource;
use cv_core::{Cancelled, Image, ImageView, Progress, Silent, Stage};
use cv_parallel::prelude::*;
use std::borrow::Cow;

/// Pixels around the removed ones from which colors are taken.
const MARGIN: usize = 16;

/// Colors, and 1 where they are known.
type Pixel = [f32; 4];

struct Level {
    width: usize,
    height: usize,
    data: Vec<Pixel>,
}

impl PhotoMask {
    /// Returns the photograph with the removed pixels replaced by a smooth continuation of those around them; `None` where none is removed. Black where all are
    /// removed. O(bounding box of the removed pixels).
    ///
    /// # Errors
    /// [`Cancelled`] where `stage` says so.
    pub fn filled<T: Channel>(
        &self,
        photo: ImageView<'_, T, 3>,
        stage: &Stage<'_>,
    ) -> Result<Option<Image<T, 3>>, Cancelled> {
        let removed = || self.runs().filter(|(_, _, what)| *what == PhotoUse::Remove);
        let (w, h) = photo.size();
        let (mut left, mut top, mut right, mut bottom) = (w, h, 0, 0);
        for (y, (start, end), _) in removed() {
            (left, right, top, bottom) = (left.min(start), right.max(end), top.min(y), bottom.max(y + 1));
        }
        let (left, top) = (left.saturating_sub(MARGIN), top.saturating_sub(MARGIN));
        let (right, bottom) = ((right + MARGIN).min(w), (bottom + MARGIN).min(h));
        if removed().next().is_none() || left >= right || top >= bottom {
            return Ok(None);
        }
        let (width, height) = ((right - left).div_ceil(2), (bottom - top).div_ceil(2));
        let mut half = Level { width, height, data: vec![[0.0; 4]; width * height] };
        for_each_row(&mut half.data, width, stage, |y, row| {
            for (x, out) in row.iter_mut().enumerate() {
                let (x, y) = (left + 2 * x, top + 2 * y);
                let four = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)];
                let known =
                    four.into_iter().filter(|&(x, y)| x < right && y < bottom && self.at(x, y) != PhotoUse::Remove);
                *out = mean(known.map(|(x, y)| {
                    let [r, g, b] = photo.at(x, y).map(T::to_f32);
                    [r, g, b, 1.0]
                }));
            }
        })?;
        half.complete(stage)?;
        let mut image = photo.to_image();
        for (y, (start, end), _) in removed().filter(|(y, _, _)| *y < h) {
            if is_check_due(y, 3 * w) {
                stage.check()?;
            }
            let row = image.row_mut(y).as_chunks_mut::<3>().0;
            for (x, out) in (start..end).zip(&mut row[start.min(w)..end.min(w)]) {
                let [r, g, b, _] = half.enlarged(x - left, y - top);
                *out = [r, g, b].map(T::from_f32);
            }
        }
        Ok(Some(image))
    }
}

/// Returns a copy of each photograph with removed pixels, without their colors. Reports as the stage "elastic", once for each.
pub(crate) fn filled<T: PhotoSample>(
    photos: &[ImageView<'_, T, 3>],
    masks: &[Option<&PhotoMask>],
    progress: &dyn Progress,
) -> Result<Vec<Option<Image<T, 3>>>, Cancelled> {
    let masked = photos.par_iter().zip(masks).map(|(photo, mask)| {
        let Some(mask) = mask else { return Ok(None) };
        mask.filled(*photo, &Stage::new(progress, "elastic", 1)?)
    });
    masked.try_collect()
}

/// Photographs without the colors of their removed pixels.
pub(crate) struct Filled<'a, T>(pub(crate) &'a dyn PhotoSource<T>);

impl<T: PhotoSample> PhotoSource<T> for Filled<'_, T> {
    fn size(&self, index: usize) -> (usize, usize) {
        self.0.size(index)
    }

    fn load(&self, index: usize) -> Option<Cow<'_, Image<T, 3>>> {
        let photo = self.0.load(index)?;
        let Some(mask) = self.0.mask(index) else { return Some(photo) };
        // As reading a file, not stopped in between.
        let filled = mask.filled(photo.view(), &Stage::new(&Silent, "read", 1).ok()?).ok()?;
        Some(filled.map_or(photo, Cow::Owned))
    }

    fn mask(&self, index: usize) -> Option<&PhotoMask> {
        self.0.mask(index)
    }
}

/// The mean of known pixels.
fn mean(pixels: impl Iterator<Item = Pixel>) -> Pixel {
    let sum = pixels.fold([0.0; 4], |sum: Pixel, p| std::array::from_fn(|c| sum[c] + p[c]));
    if sum[3] > 0.0 { sum.map(|v| v / sum[3]) } else { sum }
}

impl Level {
    /// Fills the unknown pixels from the level of half resolution.
    fn complete(&mut self, stage: &Stage<'_>) -> Result<(), Cancelled> {
        let (w, h) = (self.width, self.height);
        if w * h <= 1 || self.data.iter().all(|p| p[3] > 0.0) {
            return Ok(());
        }
        let (width, height) = (w.div_ceil(2), h.div_ceil(2));
        let mut half = Self { width, height, data: vec![[0.0; 4]; width * height] };
        for_each_row(&mut half.data, width, stage, |y, row| {
            for (x, out) in row.iter_mut().enumerate() {
                let four = [(2 * x, 2 * y), (2 * x + 1, 2 * y), (2 * x, 2 * y + 1), (2 * x + 1, 2 * y + 1)];
                let known = four.into_iter().filter(|&(x, y)| x < w && y < h).map(|(x, y)| self.data[y * w + x]);
                *out = mean(known.filter(|p| p[3] > 0.0));
            }
        })?;
        half.complete(stage)?;
        for_each_row(&mut self.data, w, stage, |y, row| {
            for (x, out) in row.iter_mut().enumerate().filter(|(_, p)| p[3] == 0.0) {
                *out = half.enlarged(x, y);
            }
        })
    }

    /// Interpolates at a pixel of twice the resolution, bilinearly.
    fn enlarged(&self, x: usize, y: usize) -> Pixel {
        // A quarter of a pixel from the middle of the nearest, toward its neighbor on that side.
        let place = |v: usize, n: usize| {
            let near = (v / 2).min(n - 1);
            (near, if v.is_multiple_of(2) { near.saturating_sub(1) } else { (near + 1).min(n - 1) })
        };
        let ((x0, x1), (y0, y1)) = (place(x, self.width), place(y, self.height));
        let at = |x: usize, y: usize| self.data[y * self.width + x];
        let (a, b, c, d) = (at(x0, y0), at(x1, y0), at(x0, y1), at(x1, y1));
        std::array::from_fn(|i| 0.5625 * a[i] + 0.1875 * (b[i] + c[i]) + 0.0625 * d[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::stage;
    use cv_core::RgbU8;

    #[test]
    fn a_hole_continues_what_is_around_it_and_depends_on_nothing_else() {
        let ramp = |x: usize, y: usize| [40 + x as u8, 30 + 2 * y as u8, 120];
        let is_hole = |x: usize, y: usize| (20..70).contains(&x) && (15..45).contains(&y);
        let mask = PhotoMask::from_fn(100, 60, |x, y| if is_hole(x, y) { PhotoUse::Remove } else { PhotoUse::Keep });
        let photo = |hidden: [u8; 3]| RgbU8::from_fn(100, 60, |x, y| if is_hole(x, y) { hidden } else { ramp(x, y) });
        let filled = mask.filled(photo([255, 0, 0]).view(), &stage()).unwrap().unwrap();
        assert_eq!(Some(&filled), mask.filled(photo([0, 255, 9]).view(), &stage()).unwrap().as_ref());
        for (x, y) in (0..60).flat_map(|y| (0..100).map(move |x| (x, y))) {
            let (got, [r, g, b]) = (filled.at(x, y), ramp(x, y));
            if !is_hole(x, y) {
                assert_eq!(got, [r, g, b]);
                continue;
            }
            // Of a ramp means of means keep the range around the hole; along its outline, the values beside it to within the step of a few pixels.
            let edge = !(22..68).contains(&x) || !(17..43).contains(&y);
            let most = if edge { 12 } else { 60 };
            assert!(got[0].abs_diff(r) <= most && got[1].abs_diff(g) <= most && got[2] == b, "{x} {y} {got:?}");
        }
    }

    #[test]
    fn nothing_removed_is_no_copy_and_everything_removed_is_black() {
        let photo = RgbU8::new(9, 5, [200; 3]);
        let of = |what: PhotoUse| PhotoMask::from_fn(9, 5, |_, _| what).filled(photo.view(), &stage()).unwrap();
        assert!(of(PhotoUse::Keep).is_none() && of(PhotoUse::Free).is_none());
        assert_eq!(of(PhotoUse::Remove), Some(RgbU8::new(9, 5, [0; 3])));
        // A mask of another size.
        let wide = PhotoMask::from_fn(30, 2, |_, _| PhotoUse::Remove);
        assert_eq!(wide.filled(photo.view(), &stage()).unwrap().map(|image| image.at(0, 4)), Some([200; 3]));
        assert!(wide.filled(RgbU8::new(0, 0, [0; 3]).view(), &stage()).unwrap().is_none());
    }
}
