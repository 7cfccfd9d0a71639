//! The census transform (Zabih & Woodfill, ECCV 1994): what a pixel's neighbourhood looks like, in bits that no
//! change of exposure touches.

use crate::{Blend, Census};
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;
use rayon::prelude::*;

/// Columns by which a row of grey values is continued on both sides: the largest radius of a window.
pub(crate) const MARGIN: usize = 4;

/// Grey values 0 to 65535, each row continued by [`MARGIN`] copies of its first and last value.
#[derive(Debug, Default)]
pub(crate) struct Grey {
    pub(crate) values: Vec<u16>,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl Grey {
    pub(crate) fn stride(&self) -> usize {
        self.width + 2 * MARGIN
    }

    /// The upper eight bits of every value, without margins, into `out` (resized).
    pub(crate) fn to_bytes(&self, out: &mut Vec<u8>) {
        out.resize(self.width * self.height, 0);
        out.par_chunks_mut(self.width.max(1)).zip(self.values.par_chunks(self.stride())).for_each(|(out, row)| {
            for (byte, &value) in out.iter_mut().zip(&row[MARGIN..]) {
                *byte = (value >> 8) as u8;
            }
        });
    }

    /// Row `y` with its margins; beyond the top and bottom the first and last row.
    fn row(&self, y: isize) -> &[u16] {
        let y = y.clamp(0, self.height as isize - 1) as usize;
        &self.values[y * self.stride()..][..self.stride()]
    }
}

/// Number of bytes per pixel.
pub(crate) fn planes(window: Census) -> usize {
    window.bits().div_ceil(8)
}

/// Census bytes of every pixel, a plane per byte, into `out` (resized). Bit `i` tells whether the `i`-th neighbour, row
/// by row, is darker than the centre.
pub(crate) fn census(level: Level, grey: &Grey, window: Census, out: &mut Vec<Vec<u8>>) {
    let width = grey.width;
    out.resize_with(planes(window), Vec::new);
    for (plane, bytes) in out.iter_mut().enumerate() {
        bytes.resize(width * grey.height, 0);
        bytes
            .par_chunks_mut(width)
            .enumerate()
            .for_each(|(y, row)| dispatch!(level, simd => census_row(simd, grey, window, plane, y, row)));
    }
}

/// As [`census`], each row mirrored: element `j` of its `stride` elements is column `width − 1 − min_disparity − j`, zero
/// outside the image.
pub(crate) fn census_mirrored(
    level: Level,
    grey: &Grey,
    window: Census,
    min_disparity: i64,
    stride: usize,
    out: &mut Vec<Vec<u8>>,
) {
    out.resize_with(planes(window), Vec::new);
    for (plane, bytes) in out.iter_mut().enumerate() {
        mirrored(grey, min_disparity, stride, bytes, |y, row| {
            dispatch!(level, simd => census_row(simd, grey, window, plane, y, row));
        });
    }
}

/// Rows of bytes that `fill` makes, mirrored as [`census_mirrored`] says, into `out` (resized).
fn mirrored(grey: &Grey, min_disparity: i64, stride: usize, out: &mut Vec<u8>, fill: impl Fn(usize, &mut [u8]) + Sync) {
    let width = grey.width;
    // Element of the last column, and where it would be were the row long enough on both sides.
    let first = -min_disparity;
    let inside = first.clamp(0, stride as i64) as usize..(first + width as i64).clamp(0, stride as i64) as usize;
    // The column of the first element inside.
    let last_column = (width as i64 - 1 + first - inside.start as i64).max(0) as usize;
    out.resize(stride * grey.height, 0);
    out.par_chunks_mut(stride).enumerate().for_each_init(
        || vec![0u8; width],
        |row, (y, mirrored)| {
            fill(y, row);
            mirrored[..inside.start].fill(0);
            mirrored[inside.end..].fill(0);
            for (to, from) in mirrored[inside.clone()].iter_mut().zip(row[..=last_column].iter().rev()) {
                *to = *from;
            }
        },
    );
}

/// What [`Blend`] compares, of every pixel of the left image and, laid out as [`census_mirrored`] says, of the right one.
pub(crate) fn blend_planes(
    level: Level,
    grey: &[Grey; 2],
    blend: Blend,
    min_disparity: i64,
    stride: usize,
    [left, right]: &mut [Vec<u8>; 2],
) {
    if blend == Blend::None {
        return;
    }
    let fill = |side: usize, y: usize, row: &mut [u8]| {
        dispatch!(level, simd => blend_row(simd, &grey[side], blend, y, row));
    };
    left.resize(grey[0].width * grey[0].height, 0);
    left.par_chunks_mut(grey[0].width).enumerate().for_each(|(y, row)| fill(0, y, row));
    mirrored(&grey[1], min_disparity, stride, right, |y, row| fill(1, y, row));
}

#[simd]
fn blend_row<S: Simd>(_: S, grey: &Grey, blend: Blend, y: usize, out: &mut [u8]) {
    let row = grey.row(y as isize);
    let width = grey.width;
    match blend {
        Blend::None => {}
        Blend::Grey { per_bit, .. } => {
            // Rounded; at most 255.
            let step = u32::from(per_bit) * 257;
            for (byte, &v) in out.iter_mut().zip(&row[MARGIN..]) {
                *byte = ((u32::from(v) + step / 2) / step).min(255) as u8;
            }
        }
        Blend::Gradient { per_bit, .. } => {
            // Half the difference of the neighbours, 128 for none.
            let step = i32::from(per_bit) * 514;
            let neighbours = row[MARGIN - 1..].iter().zip(&row[MARGIN + 1..]);
            for (byte, (&before, &after)) in out[..width].iter_mut().zip(neighbours) {
                *byte = (128 + (i32::from(after) - i32::from(before)) / step).clamp(0, 255) as u8;
            }
        }
    }
}

/// The neighbours of bits `8·plane` to `8·plane + 7`, of every pixel of row `y`.
#[simd]
fn census_row<S: Simd>(_: S, grey: &Grey, window: Census, plane: usize, y: usize, out: &mut [u8]) {
    let (w, h) = window.size();
    let (rx, ry) = (w / 2, h / 2);
    let centre = &grey.row(y as isize)[MARGIN..MARGIN + grey.width];
    out.fill(0);
    for bit in 0..8 {
        let index = plane * 8 + bit;
        if index >= window.bits() {
            break;
        }
        // The centre itself, at index bits / 2, has no bit.
        let at = index + usize::from(index >= window.bits() / 2);
        let (dx, dy) = (at % w, at / w);
        let row = grey.row(y as isize + dy as isize - ry as isize);
        let neighbours = &row[MARGIN + dx - rx..][..grey.width];
        for ((byte, &c), &n) in out.iter_mut().zip(centre).zip(neighbours) {
            *byte |= u8::from(n < c) << bit;
        }
    }
}
