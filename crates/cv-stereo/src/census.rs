//! The census transform (Zabih & Woodfill, ECCV 1994): what a pixel's neighbourhood looks like, in bits that no
//! change of exposure touches.

use crate::Census;
use rayon::prelude::*;

/// Bits of every pixel into `out` (resized): bit `i` is set where the `i`-th neighbour, row by row, is darker than the
/// centre. Beyond the border the image repeats its edge.
pub(crate) fn census(grey: &[u16], width: usize, height: usize, window: Census, out: &mut Vec<u64>) {
    out.resize(width * height, 0);
    if out.is_empty() {
        return;
    }
    let (w, h) = window.size();
    let (rx, ry) = (w / 2, h / 2);
    out.par_chunks_mut(width).enumerate().for_each(|(y, bits)| {
        bits.fill(0);
        let centre = &grey[y * width..][..width];
        let mut index = 0;
        for dy in 0..h {
            let row = &grey[(y + dy).saturating_sub(ry).min(height - 1) * width..][..width];
            for dx in 0..w {
                if dy == ry && dx == rx {
                    continue;
                }
                // Columns whose neighbour lies inside; the rest compares with the edge.
                let at = |x: usize| row[(x + dx).saturating_sub(rx).min(width - 1)];
                let (from, to) = (
                    rx.saturating_sub(dx).min(width),
                    (width + rx - dx).min(width).max(rx.saturating_sub(dx).min(width)),
                );
                for x in (0..from).chain(to..width) {
                    bits[x] |= u64::from(at(x) < centre[x]) << index;
                }
                let shifted = &row[from + dx - rx..];
                for ((b, &c), &n) in bits[from..to].iter_mut().zip(&centre[from..to]).zip(shifted) {
                    *b |= u64::from(n < c) << index;
                }
                index += 1;
            }
        }
    });
}
