//! The census transform (Zabih & Woodfill, ECCV 1994): what a pixel's neighbourhood looks like, in bits that no
//! change of exposure touches.

use crate::Census;
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
    let width = grey.width;
    out.resize_with(planes(window), Vec::new);
    // Element of the last column, and where it would be were the row long enough on both sides.
    let first = -min_disparity;
    let inside = first.clamp(0, stride as i64) as usize..(first + width as i64).clamp(0, stride as i64) as usize;
    // The column of the first element inside.
    let last_column = (width as i64 - 1 + first - inside.start as i64).max(0) as usize;
    for (plane, bytes) in out.iter_mut().enumerate() {
        bytes.resize(stride * grey.height, 0);
        bytes.par_chunks_mut(stride).enumerate().for_each_init(
            || vec![0u8; width],
            |row, (y, mirrored)| {
                dispatch!(level, simd => census_row(simd, grey, window, plane, y, row));
                mirrored[..inside.start].fill(0);
                mirrored[inside.end..].fill(0);
                for (to, from) in mirrored[inside.clone()].iter_mut().zip(row[..=last_column].iter().rev()) {
                    *to = *from;
                }
            },
        );
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
