//! Rows that lie a little apart in a pair that is rectified otherwise: how far, as an affine function of the place, and the right photograph
//! moved back.

use crate::depth::color_bytes;
use crate::disparity_range::matches_of;
use crate::vertical_matches::vertical_matches;
use crate::{DepthError, Progress, RangeError};
use cv_core::{Correspondence, Image, ImageView, Matrix3, Point2, Vector3};
use cv_imgproc::{Pixel, WarpMap};
use cv_stereo::{DisparityMap, DisparityMatcher, Intensity, RectifyError};

/// Where the blocks of matched pixels leave the offset open, and fewer pixels than this are matched and confirmed, features are asked: a pixel of offset takes a
/// third to a half of the matches of aligned pairs, of which 63 to 99 % are matched.
const FEW: f64 = 0.6;
/// Offsets in px that are corrected: less costs little more than moving the rows does, and more is no rectified pair. (A quarter of a pixel between the rows
/// already doubles the disparities that are wrong by half a pixel; the rows are moved by linear interpolation, which blurs.)
const LEAST: f64 = 1.0 / 3.0;
const MOST: f64 = 8.0;
/// Features that lie farther apart than this in y are matched wrongly: `MOST` and half of it again.
const REACH: f64 = 12.0;
/// Of larger offsets in px blocks see only where they are least: elsewhere nothing is matched, or they end at their reach.
const SEEN_BY_BLOCKS: f64 = 1.5;
/// Matches that must agree with the offset to a pixel, and their share of those within `REACH`: of features, and of blocks, which are looked for within 3 px
/// only, so that a third would agree by chance.
const NEEDED: usize = 32;
const FEATURES_AGREE: f64 = 0.5;
const BLOCKS_AGREE: f64 = 0.75;

/// How far below its row in the left photograph a point lies in the right one, in px: an affine function of its place in the right one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VerticalOffset {
    /// In the middle of the photograph.
    pub at_center: f64,
    /// More at the right border than at the left one.
    pub across: f64,
    /// More at the bottom than at the top.
    pub down: f64,
    /// Width and height in px.
    pub size: (usize, usize),
}

impl VerticalOffset {
    /// At a place of the right photograph.
    pub fn at(&self, x: f64, y: f64) -> f64 {
        terms(Point2::new(x, y), self.size).dot(&Vector3::new(self.at_center, self.across, self.down))
    }

    /// The largest one in the photograph, which is at a corner.
    pub fn largest(&self) -> f64 {
        self.at_center.abs() + 0.5 * (self.across.abs() + self.down.abs())
    }

    /// Whether the rows are apart, and not so far that this is no rectified pair.
    fn is_to_correct(&self) -> bool {
        (LEAST..=MOST).contains(&self.largest())
    }

    /// What matches of two photographs of this size show; `None` where fewer than the share `agreeing` agree.
    /// Least squares over the matches near the last estimate, from the most frequent offset on. O(n log n).
    fn from_matches(matches: &[Correspondence], agreeing: f64, size: (usize, usize)) -> Option<Self> {
        let apart = |m: &Correspondence| m.b.y - m.a.y;
        let near: Vec<&Correspondence> = matches.iter().filter(|m| apart(m).abs() <= REACH).collect();
        let mut sorted: Vec<f64> = near.iter().map(|m| apart(m)).collect();
        sorted.sort_unstable_by(f64::total_cmp);
        // The two pixels with the most matches.
        let within = |i: &usize| sorted.partition_point(|d| *d <= sorted[*i] + 2.0) - i;
        let first = (0..sorted.len()).max_by_key(|i| (within(i), std::cmp::Reverse(*i)))?;
        let mut model = Vector3::new(sorted[first + within(&first) / 2], 0.0, 0.0);
        let off = |model: &Vector3<f64>, m: &Correspondence| model.dot(&terms(m.b, size)) - apart(m);
        for reach in [4.0, 2.0, 1.0, 1.0] {
            // Slopes that the places of the matches do not determine are none.
            let mut normal = Matrix3::from_diagonal(&Vector3::new(1e-9, 0.1, 0.1));
            let mut right = Vector3::zeros();
            for m in near.iter().filter(|m| off(&model, m).abs() <= reach) {
                let terms = terms(m.b, size);
                normal += terms * terms.transpose();
                right += terms * apart(m);
            }
            model = normal.try_inverse()? * right;
        }
        let agree = near.iter().filter(|m| off(&model, m).abs() <= 1.0).count();
        let found = Self { at_center: model.x, across: model.y, down: model.z, size };
        (agree >= NEEDED && agree as f64 >= agreeing * near.len() as f64).then_some(found)
    }

    /// Matches as if the right photograph had been corrected.
    pub(crate) fn correct(&self, matches: &mut [Correspondence]) {
        for m in matches {
            m.b.y -= self.at(m.b.x, m.b.y);
        }
    }
}

/// One, and the place from the middle in widths and heights.
fn terms(p: Point2<f64>, (width, height): (usize, usize)) -> Vector3<f64> {
    let from_middle = |at: f64, n: usize| (at + 0.5) / n as f64 - 0.5;
    Vector3::new(1.0, from_middle(p.x, width), from_middle(p.y, height))
}

/// What is known of the rows of a pair, or of all pairs of a film.
#[derive(Debug, Default)]
pub(crate) struct Alignment {
    /// There is no more to ask: the offset is known, or nothing tells it.
    is_closed: bool,
    pub(crate) offset: Option<VerticalOffset>,
    map: Option<WarpMap>,
}

impl Alignment {
    /// One that never corrects anything.
    pub(crate) fn off() -> Self {
        Self { is_closed: true, ..Self::default() }
    }

    /// Takes what features say, where that is more than blocks will tell better: features lie a few tenths of a pixel off.
    pub(crate) fn learn(&mut self, matches: &[Correspondence], size: (usize, usize)) -> Result<(), DepthError> {
        let found = VerticalOffset::from_matches(matches, FEATURES_AGREE, size);
        let larger = found.filter(|offset| !self.is_closed && offset.largest() > SEEN_BY_BLOCKS);
        larger.map_or(Ok(()), |offset| self.take(offset))
    }

    /// Takes an offset, and makes the map of it where the rows are apart.
    fn take(&mut self, offset: VerticalOffset) -> Result<(), DepthError> {
        self.is_closed = true;
        if !offset.is_to_correct() {
            return Ok(());
        }
        let size = offset.size;
        let last = (size.1 - 1) as f64;
        let map = WarpMap::new(size, size, |x, y| {
            // The offset is known by the place in the right photograph, which is sought: it changes by hundredths of a pixel in one.
            let (x, row) = (x as f64, y as f64);
            let y = row + offset.at(x, row);
            Some(Point2::new(x, (row + offset.at(x, y)).clamp(0.0, last)))
        });
        let (width, height) = size;
        self.map = Some(map.map_err(|_| DepthError::Rectify(RectifyError::TooLarge { width, height }))?);
        self.offset = Some(offset);
        Ok(())
    }

    /// The right photograph with its rows where they ought to be; `None` where they are, and for a size that has not been seen.
    fn corrected<T: Pixel, const C: usize>(
        &self,
        right: ImageView<'_, T, C>,
    ) -> Result<Option<Image<T, C>>, DepthError> {
        let (width, height) = right.size();
        let map = self.map.as_ref().filter(|map| map.source_size() == (width, height));
        let corrected = map.map(|map| map.compute(right)).transpose();
        corrected.map_err(|_| DepthError::Rectify(RectifyError::TooLarge { width, height }))
    }

    /// Disparities of a pair into `map`, its rows aligned first where they are known not to be, or where its matches show that they are not. The right
    /// photograph that was matched, where it was corrected.
    pub(crate) fn compute<T: Intensity + Pixel, const C: usize>(
        &mut self,
        matcher: &mut dyn DisparityMatcher<T, C>,
        [left, right]: [ImageView<'_, T, C>; 2],
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<Option<Image<T, C>>, DepthError> {
        let corrected = self.corrected(right)?;
        matcher.compute_into(left, corrected.as_ref().map_or(right, Image::view), map, progress)?;
        if self.is_closed {
            return Ok(corrected);
        }
        let blocks = vertical_matches(left, right, map);
        let seen = VerticalOffset::from_matches(&blocks, BLOCKS_AGREE, left.size());
        if let Some(offset) = seen.filter(|offset| offset.largest() <= SEEN_BY_BLOCKS) {
            self.take(offset)?;
        } else if seen.is_some() || map.matched_fraction() < FEW {
            // Once: in a film they would cost more than all else.
            self.is_closed = true;
            let [a, b] = [left, right].map(color_bytes);
            let matches = match matches_of(a.view(), b.view(), progress) {
                Ok(matches) => matches,
                Err(RangeError::Cancelled(stop)) => return Err(stop.into()),
                Err(_) => return Ok(corrected),
            };
            if let Some(offset) = VerticalOffset::from_matches(&matches, FEATURES_AGREE, left.size()) {
                self.take(offset)?;
            }
        }
        let Some(corrected) = self.corrected(right)? else { return Ok(None) };
        matcher.compute_into(left, corrected.view(), map, progress)?;
        Ok(Some(corrected))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (600, 400);

    /// Matches all over two photographs, `offset` px apart in y, of which every third is wrong.
    fn matches(offset: impl Fn(f64, f64) -> f64) -> Vec<Correspondence> {
        (0..300)
            .map(|i| {
                let (x, y) = ((i * 37 % 600) as f64, (i * 53 % 400) as f64);
                let wrong = if i % 3 == 0 { (i * 29 % 200) as f64 - 100.0 } else { 0.0 };
                let a = Point2::new(x + 20.0, y - offset(x, y) + wrong);
                Correspondence { a, b: Point2::new(x, y) }
            })
            .collect()
    }

    #[test]
    fn an_affine_offset_is_found_among_wrong_matches() {
        let truth = |x: f64, y: f64| 2.0 + 0.005 * (x - 299.5) - 0.004 * (y - 199.5);
        let found = VerticalOffset::from_matches(&matches(truth), FEATURES_AGREE, SIZE).unwrap();
        assert!(found.is_to_correct());
        for (x, y) in [(0.0, 0.0), (599.0, 0.0), (0.0, 399.0), (599.0, 399.0), (299.5, 199.5)] {
            // A tenth of a pixel: what wrong matches that happen to be near move it by.
            assert!((found.at(x, y) - truth(x, y)).abs() < 0.1, "{x} {y}: {found:?}");
        }
        assert!((found.largest() - 4.3).abs() < 0.1, "{found:?}");
        let mut corrected = matches(truth);
        found.correct(&mut corrected);
        assert_eq!(corrected.iter().filter(|m| (m.a.y - m.b.y).abs() < 0.1).count(), 200);
    }

    #[test]
    fn rows_that_are_aligned_or_far_apart_stay() {
        for apart in [0.2, 9.5] {
            let found = VerticalOffset::from_matches(&matches(|_, _| apart), FEATURES_AGREE, SIZE).unwrap();
            assert!((found.largest() - apart).abs() < 0.1 && !found.is_to_correct());
        }
        assert_eq!(VerticalOffset::from_matches(&[], FEATURES_AGREE, SIZE), None);
        // Anywhere: no offset has half of them.
        let chance = matches(|x, y| (x * 7.0 + y * 13.0) % 20.0 - 10.0);
        assert_eq!(VerticalOffset::from_matches(&chance, FEATURES_AGREE, SIZE), None);
    }
}
