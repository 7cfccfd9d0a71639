//! Pixels without image data: the black borders of rectified images.
//!
//! A rectified image is black where the original has no pixel. There, black matches black at any disparity. OpenCV crops the map to the
//! rectangle without such pixels (`getValidDisparityROI`), libSGM invalidates every black pixel, Pandora takes masks. Here borders are
//! detected: regions of exactly 0 in all channels, in a corner of the image or along much of a side, as a rotation or the removal of distortion
//! leaves them. Noise leaves dark scenes other values in between, and the outline of a rectified image is smooth: regions with a long
//! outline are dark objects. (Of 340 photographs, of which some have 15 % of such pixels, only some of a figure on a black stage have a region
//! of this kind, of up to 1.6 %.)

use crate::PixelState;
use crate::census::{Gray, MARGIN};
use crate::winner::Winner;
use cv_core::{Mask, UnionFind, joined_ranges};
use cv_parallel::prelude::*;
use std::ops::Range;

/// Minimum area of a border region as a fraction of the image, along much of a side and in a corner.
const MIN_AREA: (f64, f64) = (1e-3, 5e-3);
/// Minimum contact of a border region with a side of the image, as a fraction of the side: a rotation about the center leaves black wedges
/// along half of each.
const MIN_CONTACT: f64 = 0.4;
/// Maximum length of the outline of a border region, in pixel sides inside the image, relative to half the perimeter of its bounding box. A
/// monotonic curve has 1, a frame around the image 2, one of a lens with pincushion distortion a little more.
const MAX_OUTLINE: f64 = 3.0;

/// Pixels without data, as runs of each row from left to right.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct BorderMask {
    width: usize,
    /// Index of the first run of each row, and the number of runs.
    first: Vec<u32>,
    runs: Vec<Range<u32>>,
}

/// Statistics of a connected region of black pixels.
struct Component {
    has_corner: bool,
    /// Number of pixels at the left, right, upper and lower side of the image.
    contacts: [usize; 4],
    area: usize,
    /// Pixel sides between the region and others.
    outline: usize,
    /// Bounding box.
    columns: Range<u32>,
    rows: Range<u32>,
}

impl BorderMask {
    /// Creates the mask of rows of runs; `None` if there are none, or nothing else.
    fn from_rows(width: usize, rows: Vec<Vec<Range<u32>>>) -> Option<Self> {
        let mut mask = Self { width, first: Vec::with_capacity(rows.len() + 1), runs: Vec::new() };
        let area: usize = rows.iter().flatten().map(ExactSizeIterator::len).sum();
        let pixels = width * rows.len();
        for row in rows {
            mask.first.push(mask.runs.len() as u32);
            mask.runs.extend(row);
        }
        mask.first.push(mask.runs.len() as u32);
        (1..pixels).contains(&area).then_some(mask)
    }

    /// Creates the mask of the pixels that are false in `valid`; `None` if all or none are.
    pub(crate) fn from_valid(valid: &Mask) -> Option<Self> {
        let rows = (0..valid.height()).into_par_iter().map(|y| runs(valid.row(y), |valid| !valid)).collect();
        Self::from_rows(valid.width(), rows)
    }

    /// Detects the black borders of an image; `None` if there are none, or nothing else. O(width + height) without black pixels at the
    /// border.
    pub(crate) fn detect(gray: &Gray) -> Option<Self> {
        let (width, height) = (gray.width, gray.height);
        let row = |y: usize| &gray.values[y * gray.stride() + MARGIN..][..width];
        let is_black_at_side = |y: usize| row(y)[0] == 0 || row(y)[width - 1] == 0;
        if width * height == 0
            || ![row(0), row(height - 1)].iter().any(|row| row.contains(&0)) && !(0..height).any(is_black_at_side)
        {
            return None;
        }
        let mut rows: Vec<Vec<Range<u32>>> =
            (0..height).into_par_iter().map(|y| runs(row(y), |gray| gray == 0)).collect();
        let first: Vec<usize> = rows
            .iter()
            .scan(0, |count, row| {
                *count += row.len();
                Some(*count - row.len())
            })
            .collect();
        let mut sets = UnionFind::new(rows.iter().map(Vec::len).sum());
        // Pixel sides between the runs of neighboring rows, of each run.
        let mut shared = vec![0usize; sets.len()];
        for y in 1..height {
            for_each_overlap(&rows[y - 1], &rows[y], |a, b, overlap| {
                let [a, b] = [first[y - 1] + a, first[y] + b];
                sets.union(a as u32, b as u32);
                shared[a] += overlap;
                shared[b] += overlap;
            });
        }
        let roots = sets.into_roots();
        let mut components: Vec<Option<Component>> = roots.iter().map(|_| None).collect();
        for (y, row) in rows.iter().enumerate() {
            for (i, run) in row.iter().enumerate() {
                let (start, end) = (run.start as usize, run.end as usize);
                let is_first = |at: usize, last: usize| usize::from(at == 0) + usize::from(at + 1 == last);
                // Sides at the border of the image belong to no outline.
                let across = 2 - usize::from(start == 0) - usize::from(end == width);
                let along = (2 - is_first(y, height)) * run.len() - shared[first[y] + i];
                let component = components[roots[first[y] + i] as usize].get_or_insert_with(|| Component {
                    has_corner: false,
                    contacts: [0; 4],
                    area: 0,
                    outline: 0,
                    columns: run.clone(),
                    rows: y as u32..y as u32 + 1,
                });
                let (at_side, at_end) = ([start == 0, end == width], [y == 0, y + 1 == height]);
                component.has_corner |= at_side.contains(&true) && at_end.contains(&true);
                let lengths = [at_side.map(usize::from), at_end.map(|is_end| usize::from(is_end) * run.len())];
                for (contact, length) in component.contacts.iter_mut().zip(lengths.as_flattened()) {
                    *contact += length;
                }
                component.area += run.len();
                component.outline += across + along;
                component.columns.start = component.columns.start.min(run.start);
                component.columns.end = component.columns.end.max(run.end);
                component.rows.end = y as u32 + 1;
            }
        }
        let pixels = (width * height) as f64;
        let is_border = |root: u32| {
            components[root as usize].as_ref().is_some_and(|c| {
                let half_perimeter = (c.columns.len() + c.rows.len()) as f64;
                let sides = [height, height, width, width];
                let is_long =
                    c.contacts.iter().zip(sides).any(|(&contact, side)| contact as f64 >= MIN_CONTACT * side as f64);
                let min_area = if is_long { MIN_AREA.0 } else { MIN_AREA.1 };
                (c.has_corner || is_long)
                    && c.area as f64 >= min_area * pixels
                    && c.outline as f64 <= MAX_OUTLINE * half_perimeter
            })
        };
        for (row, &first) in rows.iter_mut().zip(&first) {
            let mut index = first;
            row.retain(|_| {
                index += 1;
                is_border(roots[index - 1])
            });
        }
        Self::from_rows(width, rows)
    }

    fn height(&self) -> usize {
        self.first.len() - 1
    }

    /// Returns the size of the image.
    pub(crate) fn size(&self) -> (usize, usize) {
        (self.width, self.height())
    }

    /// Returns the runs of row `y`.
    #[inline(always)]
    pub(crate) fn row(&self, y: usize) -> &[Range<u32>] {
        &self.runs[self.first[y] as usize..self.first[y + 1] as usize]
    }

    /// Returns the mask at half resolution: the pixels of which all four are without data.
    pub(crate) fn halved(&self) -> Option<Self> {
        let (width, height) = (self.width / 2, self.height() / 2);
        let rows = (0..height).map(|y| {
            let mut row = Vec::new();
            let (a, b) = (self.row(2 * y), self.row(2 * y + 1));
            for_each_overlap(a, b, |i, j, _| {
                let (start, end) = (a[i].start.max(b[j].start).div_ceil(2), a[i].end.min(b[j].end) / 2);
                let end = end.min(width as u32);
                if start < end {
                    row.push(start..end);
                }
            });
            row
        });
        Self::from_rows(width, rows.collect())
    }

    /// Returns the mask with the eight neighbors of its pixels.
    pub(crate) fn dilated(&self) -> Option<Self> {
        let (width, height) = self.size();
        let rows = (0..height).into_par_iter().map(|y| {
            let rows = y.saturating_sub(1)..(y + 2).min(height);
            let grown = rows.flat_map(|y| self.row(y)).map(|run| run.start.saturating_sub(1)..run.end + 1);
            joined_ranges(grown.map(|run| run.start..run.end.min(width as u32)).collect())
        });
        Self::from_rows(width, rows.collect())
    }

    /// Replaces the gray levels without data by those of the nearest pixels with data, as the border of an image is extended: windows that
    /// reach beyond have no edge there. Two passes of a distance transform with the distance along rows and columns. `distances` is scratch.
    pub(crate) fn extend(&self, gray: &mut Gray, distances: &mut Vec<f32>) {
        let (width, height) = self.size();
        let stride = gray.stride();
        distances.clear();
        distances.resize(width * height, 0.0);
        for (y, run) in (0..height).flat_map(|y| self.row(y).iter().map(move |run| (y, run))) {
            distances[y * width..][run.start as usize..run.end as usize].fill(f32::INFINITY);
        }
        let mut relax = |values: &mut [u16], (x, y): (usize, usize), (nx, ny): (usize, usize)| {
            let distance = distances[ny * width + nx] + 1.0;
            if distance < distances[y * width + x] {
                distances[y * width + x] = distance;
                values[y * stride + MARGIN + x] = values[ny * stride + MARGIN + nx];
            }
        };
        let values = &mut gray.values[..];
        for y in 0..height {
            for x in self.row(y).iter().flat_map(|run| run.start as usize..run.end as usize) {
                if y > 0 {
                    relax(values, (x, y), (x, y - 1));
                }
                if x > 0 {
                    relax(values, (x, y), (x - 1, y));
                }
            }
        }
        for y in (0..height).rev() {
            for x in self.row(y).iter().rev().flat_map(|run| (run.start as usize..run.end as usize).rev()) {
                if y + 1 < height {
                    relax(values, (x, y), (x, y + 1));
                }
                if x + 1 < width {
                    relax(values, (x, y), (x + 1, y));
                }
            }
            let row = &mut values[y * stride..][..stride];
            let (first, last) = (row[MARGIN], row[MARGIN + width - 1]);
            row[..MARGIN].fill(first);
            row[MARGIN + width..].fill(last);
        }
    }
}

/// Returns the runs of the pixels of a row that `is_in`.
fn runs<T: Copy>(row: &[T], is_in: impl Fn(T) -> bool) -> Vec<Range<u32>> {
    let mut runs = Vec::new();
    let mut x = 0;
    while let Some(start) = row[x..].iter().position(|&v| is_in(v)).map(|at| x + at) {
        x = row[start..].iter().position(|&v| !is_in(v)).map_or(row.len(), |at| start + at);
        runs.push(start as u32..x as u32);
    }
    runs
}

/// Calls `found` with the indices of runs of two rows that overlap, and the width of the overlap. From left to right.
fn for_each_overlap(a: &[Range<u32>], b: &[Range<u32>], mut found: impl FnMut(usize, usize, usize)) {
    let (mut i, mut j) = (0, 0);
    while i < a.len() && j < b.len() {
        let overlap = (a[i].start.max(b[j].start)..a[i].end.min(b[j].end)).len();
        if overlap > 0 {
            found(i, j, overlap);
        }
        if a[i].end < b[j].end { i += 1 } else { j += 1 }
    }
}

/// The borders of a matcher's pairs.
#[derive(Debug, Default)]
pub(crate) struct Borders {
    /// Masks that are not to be detected.
    given: Option<[Option<BorderMask>; 2]>,
    /// Those of the current pair.
    current: [Option<BorderMask>; 2],
}

impl Borders {
    /// Sets the masks of pixels with data of all following pairs; with `None` they are detected.
    pub(crate) fn set_given(&mut self, valid: Option<[&Mask; 2]>) {
        let valid = valid.filter(|[left, right]| left.size() == right.size());
        self.given = valid.map(|masks| masks.map(BorderMask::from_valid));
    }

    /// Sets the masks of a pair, and extends its gray levels to pixels without data. `scratch` is scratch.
    pub(crate) fn update(&mut self, gray: &mut [Gray; 2], detects: bool, scratch: &mut Vec<f32>) {
        for (i, (gray, current)) in gray.iter_mut().zip(&mut self.current).enumerate() {
            let given = self.given.as_ref().map(|masks| &masks[i]);
            let given = given.filter(|mask| mask.as_ref().is_none_or(|mask| mask.size() == (gray.width, gray.height)));
            *current = match given {
                Some(mask) => mask.clone(),
                None => detects.then(|| BorderMask::detect(gray)).flatten(),
            };
            let Some(mask) = current else { continue };
            // The interpolation of an unknown rectification mixes the outermost pixels with black.
            let dilated = if given.is_none() { mask.dilated() } else { None };
            dilated.as_ref().unwrap_or(mask).extend(gray, scratch);
        }
    }

    /// Returns the borders at half resolution.
    pub(crate) fn halved(&self) -> Self {
        let current = self.current.each_ref().map(|mask| mask.as_ref().and_then(BorderMask::halved));
        Self { given: None, current }
    }

    /// Returns the masks of the rows from `first` on.
    pub(crate) fn masks(&self, first: usize) -> PairMasks<'_> {
        let [left, right] = self.current.each_ref().map(Option::as_ref);
        PairMasks { left, right, first }
    }

    /// Clears the pixels of the left image without data.
    pub(crate) fn clear(&self, disparity: &mut [f32], states: &mut [PixelState]) {
        let Some(mask) = &self.current[0] else { return };
        let (width, height) = mask.size();
        for (y, run) in (0..height).flat_map(|y| mask.row(y).iter().map(move |run| (y, run))) {
            let pixels = y * width + run.start as usize..y * width + run.end as usize;
            disparity[pixels.clone()].fill(f32::NAN);
            states[pixels].fill(PixelState::NoData);
        }
    }
}

/// The masks of a pair, or of some rows of it.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PairMasks<'a> {
    pub(crate) left: Option<&'a BorderMask>,
    pub(crate) right: Option<&'a BorderMask>,
    /// The first row.
    pub(crate) first: usize,
}

impl<'a> PairMasks<'a> {
    /// Returns the masks of a row; `None` if all of its pixels have data.
    #[inline(always)]
    pub(crate) fn row(&self, y: usize) -> Option<RowMasks<'a>> {
        let row = |mask: Option<&'a BorderMask>| mask.map_or(&[][..], |mask| mask.row(self.first + y));
        let (left, right) = (row(self.left), row(self.right));
        (!left.is_empty() || !right.is_empty()).then_some(RowMasks { left, right })
    }
}

/// The masks of a row of a pair.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RowMasks<'a> {
    left: &'a [Range<u32>],
    right: &'a [Range<u32>],
}

impl RowMasks<'_> {
    /// Returns whether a pixel of the left row has no data.
    #[inline(always)]
    pub(crate) fn hides_left(&self, x: usize) -> bool {
        self.left.iter().any(|run| run.contains(&(x as u32)))
    }

    /// Returns whether a pixel of the right row has no data.
    #[inline(always)]
    pub(crate) fn hides_right(&self, x: usize) -> bool {
        self.right.iter().any(|run| run.contains(&(x as u32)))
    }

    /// Returns the columns of the left and of the right row between the borders, of which some may have no data; `None` if that is so.
    pub(crate) fn interior(&self, width: usize) -> Option<[Range<usize>; 2]> {
        let interior = |runs: &[Range<u32>]| {
            let start = runs.first().filter(|run| run.start == 0).map_or(0, |run| run.end as usize);
            let end = runs.last().filter(|run| run.end as usize == width).map_or(width, |run| run.start as usize);
            let at_ends = usize::from(start > 0) + usize::from(end < width && end > 0);
            (runs.len() <= at_ends).then_some(start..end.max(start))
        };
        Some([interior(self.left)?, interior(self.right)?])
    }

    /// Rejects the matches of a row that have no data in one of the images.
    pub(crate) fn check(&self, first: i32, winners: &[Winner], states: &mut [PixelState], disparity: &mut [f32]) {
        for (x, (state, d)) in states.iter_mut().zip(disparity).enumerate() {
            let column = x as i64 - i64::from(first) - i64::from(winners[x].index);
            if self.hides_left(x) {
                (*state, *d) = (PixelState::NoData, f32::NAN);
            } else if usize::try_from(column).is_ok_and(|column| self.hides_right(column)) {
                (*state, *d) = (PixelState::OutOfView, f32::NAN);
            }
        }
    }

    /// Fills the pixels of the right row without data.
    pub(crate) fn fill_right(&self, values: &mut [f32], value: f32) {
        self.right.iter().for_each(|run| values[run.start as usize..run.end as usize].fill(value));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gray(width: usize, height: usize, value: impl Fn(usize, usize) -> u16) -> Gray {
        let mut gray = Gray { values: Vec::new(), width, height };
        for y in 0..height {
            let row: Vec<u16> = (0..width).map(|x| value(x, y)).collect();
            gray.values.extend([row[0]; MARGIN]);
            gray.values.extend_from_slice(&row);
            gray.values.extend([row[width - 1]; MARGIN]);
        }
        gray
    }

    /// Noise of 200 to 455 levels of 65535.
    fn texture(x: usize, y: usize) -> u16 {
        200 + ((x * 7919 + y * 104_729) as u32).wrapping_mul(2_654_435_761).to_le_bytes()[3] as u16
    }

    /// Returns the pixels that are detected, as a function.
    fn detected(value: impl Fn(usize, usize) -> u16) -> Option<BorderMask> {
        BorderMask::detect(&gray(160, 120, value))
    }

    fn contains(mask: &BorderMask, x: usize, y: usize) -> bool {
        mask.row(y).iter().any(|run| run.contains(&(x as u32)))
    }

    #[test]
    fn borders_of_rotations_and_of_lenses_are_detected_pixel_by_pixel() {
        let (cx, cy) = (79.5, 59.5);
        let center = |x: usize, y: usize| (x as f64 - cx, y as f64 - cy);
        let turned = |x: usize, y: usize| {
            let ((x, y), (sin, cos)) = (center(x, y), 0.05f64.sin_cos());
            (cos * x - sin * y).abs() < 80.0 && (sin * x + cos * y).abs() < 60.0
        };
        // Sides that bend inward: black in the middle of each, corners with data.
        let pincushion = |x: usize, y: usize| {
            let (x, y) = center(x, y);
            x.abs() < 72.0 + 8.0 * (y / 60.0).powi(2) && y.abs() < 54.0 + 6.0 * (x / 80.0).powi(2)
        };
        let circle = |x: usize, y: usize| center(x, y).0.hypot(center(x, y).1) < 70.0;
        let shifted = |x: usize, _: usize| x >= 9;
        let shapes: [&dyn Fn(usize, usize) -> bool; 4] = [&turned, &pincushion, &circle, &shifted];
        for (i, has_data) in shapes.into_iter().enumerate() {
            let mask = detected(|x, y| if has_data(x, y) { texture(x, y) } else { 0 }).unwrap();
            for (x, y) in (0..120).flat_map(|y| (0..160).map(move |x| (x, y))) {
                assert_eq!(contains(&mask, x, y), !has_data(x, y), "shape {i} at {x}, {y}");
            }
        }
    }

    #[test]
    fn dark_scenes_and_black_objects_are_none() {
        // Nothing black; black objects inside and at a side; a corner below the least area; all black.
        assert_eq!(detected(texture), None);
        let object = |x: usize, y: usize| (40..80).contains(&x) && (20..90).contains(&y);
        assert_eq!(detected(|x, y| if object(x, y) { 0 } else { texture(x, y) }), None);
        assert_eq!(detected(|x, y| if x < 40 && (30..70).contains(&y) { 0 } else { texture(x, y) }), None);
        assert_eq!(detected(|x, y| if x < 9 && y < 9 { 0 } else { texture(x, y) }), None);
        assert_eq!(detected(|_, _| 0), None);
        // Noise around black, of which one pixel in eight is one level or more.
        assert_eq!(detected(|x, y| if texture(x, y) < 424 { 0 } else { 257 }), None);
        // An almost black value is not black.
        assert_eq!(detected(|x, y| if x < 20 { 1 } else { texture(x, y) }), None);
    }

    #[test]
    fn gray_levels_are_extended_from_the_nearest_pixels() {
        // Black left of column 20 and above row 15.
        let mut image = gray(60, 50, |x, y| if x < 20 || y < 15 { 0 } else { (1000 * y + x) as u16 });
        let mask = BorderMask::detect(&image).unwrap();
        mask.extend(&mut image, &mut Vec::new());
        let at = |x: usize, y: usize| image.values[y * image.stride() + MARGIN + x];
        assert_eq!((at(0, 30), at(19, 30), at(20, 30)), (30_020, 30_020, 30_020));
        assert_eq!((at(40, 0), at(40, 14), at(40, 15)), (15_040, 15_040, 15_040));
        assert_eq!((at(0, 0), image.values[0]), (15_020, 15_020));
    }

    #[test]
    fn half_resolution_has_no_data_where_all_four_pixels_have_none() {
        let valid = Mask::from_fn(21, 10, |x, y| [x >= 5 && y >= 3 && x != 12]);
        let mask = BorderMask::from_valid(&valid).unwrap();
        let half = mask.halved().unwrap();
        assert_eq!(half.size(), (10, 5));
        for (x, y) in (0..5).flat_map(|y| (0..10).map(move |x| (x, y))) {
            let all = (0..4).all(|i| !valid.at(2 * x + i % 2, 2 * y + i / 2)[0]);
            assert_eq!(contains(&half, x, y), all, "{x}, {y}");
        }
        let grown = mask.dilated().unwrap();
        assert!(
            contains(&grown, 5, 9) && contains(&grown, 20, 3) && contains(&grown, 13, 9) && !contains(&grown, 7, 5)
        );
    }
}
