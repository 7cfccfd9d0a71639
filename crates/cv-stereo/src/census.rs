//! The census transform (Zabih & Woodfill, ECCV 1994): a bit string of comparisons with the neighbors, invariant to monotonic changes of
//! intensity.

use crate::layout::Layout;
use crate::{Census, IntensityCost};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;

/// Columns by which rows of gray levels are extended on both sides: the largest radius of a window.
pub(crate) const MARGIN: usize = 4;

/// Gray levels 0 to 65535, each row extended by [`MARGIN`] copies of its first and last value.
#[derive(Debug, Default)]
pub(crate) struct Gray {
    pub(crate) values: Vec<u16>,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl Gray {
    /// Returns the smallest and the largest value; 65535 and 0 of no values.
    pub(crate) fn min_max(&self) -> (u16, u16) {
        let of_row = |row: &[u16]| row.iter().fold((u16::MAX, 0), |(low, high), &v| (low.min(v), high.max(v)));
        let rows = self.values.par_chunks(self.stride()).map(of_row).collect();
        rows.iter().fold((u16::MAX, 0), |a, b| (a.0.min(b.0), a.1.max(b.1)))
    }

    pub(crate) fn stride(&self) -> usize {
        self.width + 2 * MARGIN
    }

    /// Converts to gray levels 0 to 255 without margins into `out` (resized): the upper eight bits of every value; if all are within a quarter
    /// of the scale, as from some sensors of 12 bits, stretched from minimum to maximum.
    pub(crate) fn to_bytes(&self, out: &mut Vec<u8>) {
        out.resize(self.width * self.height, 0);
        let (low, high) = self.min_max();
        let span = u32::from(high.saturating_sub(low));
        let narrow = (1..=u32::from(u16::MAX) / 4).contains(&span);
        out.par_chunks_mut(self.width.max(1)).zip(self.values.par_chunks(self.stride())).for_each(|(out, row)| {
            for (byte, &value) in out.iter_mut().zip(&row[MARGIN..]) {
                *byte = if narrow { (u32::from(value - low) * 255 / span) as u8 } else { (value >> 8) as u8 };
            }
        });
    }

    /// Downsamples `from` to half resolution, each pixel the mean of four; a last odd row or column is left out.
    pub(crate) fn halve(&mut self, from: &Self) {
        (self.width, self.height) = (from.width / 2, from.height / 2);
        let (stride, from_stride, width) = (self.stride(), from.stride(), self.width);
        self.values.resize(stride * self.height, 0);
        self.values.par_chunks_mut(stride).zip(from.values.par_chunks(2 * from_stride)).for_each(|(row, pair)| {
            let (upper, lower) = pair.split_at(from_stride);
            let pairs = upper[MARGIN..].chunks_exact(2).zip(lower[MARGIN..].chunks_exact(2));
            for (to, (a, b)) in row[MARGIN..MARGIN + width].iter_mut().zip(pairs) {
                *to = ((u32::from(a[0]) + u32::from(a[1]) + u32::from(b[0]) + u32::from(b[1])) / 4) as u16;
            }
            let (first, last) = (row[MARGIN], row[MARGIN + width - 1]);
            row[..MARGIN].fill(first);
            row[MARGIN + width..].fill(last);
        });
    }

    /// Returns row `y` with its margins; the first or last row outside the image.
    fn row(&self, y: isize) -> &[u16] {
        let y = y.clamp(0, self.height as isize - 1) as usize;
        &self.values[y * self.stride()..][..self.stride()]
    }
}

/// Returns the number of bytes that describe a pixel: its census bits, and the value of the intensity cost.
pub(crate) fn planes(window: Census, intensity_cost: IntensityCost) -> usize {
    window.bits().div_ceil(8) + usize::from(intensity_cost != IntensityCost::None)
}

/// Describes every pixel, into `out` (resized), each row plane by plane. Bit `i` of the census is set if the `i`-th neighbor, in raster
/// order, is darker than the center.
pub(crate) fn describe(level: Level, gray: &Gray, window: Census, intensity_cost: IntensityCost, out: &mut Vec<u8>) {
    let stride = gray.width * planes(window, intensity_cost);
    out.resize(stride * gray.height, 0);
    out.par_chunks_mut(stride)
        .enumerate()
        .for_each(|(y, row)| describe_row(level, gray, window, intensity_cost, y, row));
}

/// As [`describe`], each row mirrored and split into the phases of `layout`: element `j` is column `width − 1 − min_disparity − j`, zero
/// outside the image.
pub(crate) fn describe_mirrored(
    level: Level,
    gray: &Gray,
    window: Census,
    intensity_cost: IntensityCost,
    min_disparity: i64,
    layout: Layout,
    out: &mut Vec<u8>,
) {
    let (width, planes) = (gray.width, planes(window, intensity_cost));
    let (n, phase, len) = (layout.vectors(), layout.phase(width), layout.right_row(width));
    // Element of the last column, possibly outside the row, and the elements inside the image.
    let first = -min_disparity;
    let inside = first.clamp(0, len as i64) as usize..(first + width as i64).clamp(0, len as i64) as usize;
    // One past the column of the first element inside.
    let columns = (width as i64 + first - inside.start as i64).max(0) as usize;
    out.resize(planes * len * gray.height, 0);
    out.par_chunks_mut(planes * len).enumerate().for_each_init(
        || (vec![0; width * planes], vec![0; len + n]),
        |(described, mirrored), (y, row)| {
            describe_row(level, gray, window, intensity_cost, y, described);
            for (p, plane) in described.chunks_exact(width).enumerate() {
                for (to, from) in mirrored[inside.clone()].iter_mut().zip(plane[..columns].iter().rev()) {
                    *to = *from;
                }
                for of in 0..n {
                    let to = &mut row[(of * planes + p) * phase..][..phase];
                    match n {
                        1 => to.copy_from_slice(&mirrored[..phase]),
                        2 => copy_every(&mirrored[of..], to, |v| u16::from_le_bytes(v) as u8),
                        4 => copy_every(&mirrored[of..], to, |v| u32::from_le_bytes(v) as u8),
                        _ => copy_every(&mirrored[of..], to, |v| u64::from_le_bytes(v) as u8),
                    }
                }
            }
        },
    );
}

/// Copies every `N`-th element from the first on, as a narrowing of integers, for which compilers have instructions.
fn copy_every<const N: usize>(from: &[u8], to: &mut [u8], first: impl Fn([u8; N]) -> u8) {
    for (to, from) in to.iter_mut().zip(from.as_chunks::<N>().0) {
        *to = first(*from);
    }
}

/// Describes row `y`, plane by plane.
fn describe_row(level: Level, gray: &Gray, window: Census, intensity_cost: IntensityCost, y: usize, out: &mut [u8]) {
    let bytes = planes(window, IntensityCost::None);
    for (plane, row) in out.chunks_exact_mut(gray.width).enumerate() {
        if plane < bytes {
            dispatch!(level, simd => census_row(simd, gray, window, plane, y, row));
        } else {
            dispatch!(level, simd => intensity_row(simd, gray, intensity_cost, y, row));
        }
    }
}

#[simd]
fn intensity_row<S: Simd>(_: S, gray: &Gray, intensity_cost: IntensityCost, y: usize, out: &mut [u8]) {
    let row = gray.row(y as isize);
    let width = gray.width;
    match intensity_cost {
        IntensityCost::None => {}
        IntensityCost::Gray { per_bit, .. } => {
            // Rounded; at most 255.
            let step = u32::from(per_bit) * 257;
            for (byte, &v) in out.iter_mut().zip(&row[MARGIN..]) {
                *byte = ((u32::from(v) + step / 2) / step).min(255) as u8;
            }
        }
        IntensityCost::Gradient { per_bit, .. } => {
            // Half the difference of the neighbors, 128 for none.
            let step = i32::from(per_bit) * 514;
            let neighbors = row[MARGIN - 1..].iter().zip(&row[MARGIN + 1..]);
            for (byte, (&before, &after)) in out[..width].iter_mut().zip(neighbors) {
                *byte = (128 + (i32::from(after) - i32::from(before)) / step).clamp(0, 255) as u8;
            }
        }
    }
}

/// Computes census bits `8·plane` to `8·plane + 7` of every pixel of row `y`.
#[simd]
fn census_row<S: Simd>(_: S, gray: &Gray, window: Census, plane: usize, y: usize, out: &mut [u8]) {
    let (w, h) = window.size();
    let (rx, ry) = (w / 2, h / 2);
    let center = &gray.row(y as isize)[MARGIN..MARGIN + gray.width];
    out.fill(0);
    for bit in 0..8 {
        let index = plane * 8 + bit;
        if index >= window.bits() {
            break;
        }
        // The center, at index bits / 2, has no bit.
        let at = index + usize::from(index >= window.bits() / 2);
        let (dx, dy) = (at % w, at / w);
        let row = gray.row(y as isize + dy as isize - ry as isize);
        let neighbors = &row[MARGIN + dx - rx..][..gray.width];
        for ((byte, &c), &n) in out.iter_mut().zip(center).zip(neighbors) {
            *byte |= u8::from(n < c) << bit;
        }
    }
}
