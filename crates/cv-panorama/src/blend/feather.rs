//! Hard seams, and short linear transitions across them.

use crate::seams::{Labels, NONE};
use crate::surface::Warped;
use cv_core::RgbU8;
use rayon::prelude::*;

/// Half the width of the transition in pixels.
const RADIUS: usize = 8;

/// Every pixel from the piece its label names.
pub(crate) fn copy(pieces: &[Option<Warped>], labels: &Labels) -> RgbU8 {
    let (w, h) = (labels.width, labels.height);
    let mut image = RgbU8::new(w, h, [0; 3]);
    image.as_mut_slice().par_chunks_mut(3 * w.max(1)).enumerate().for_each(|(y, row)| {
        for (x, out) in row.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            if let Some(Some(p)) = pieces.get(usize::from(labels.at(x, y))) {
                let [r, g, b, _] = p.pixels.at(x - p.bounds.left, y - p.bounds.top);
                *out = [r, g, b];
            }
        }
    });
    image
}

/// Pieces weighted by the share of the labels around each pixel that name them.
pub(crate) fn blend(pieces: &[Option<Warped>], labels: &Labels) -> RgbU8 {
    let (w, h) = (labels.width, labels.height);
    let mut sums = vec![[0.0_f32; 4]; w * h];
    for (label, piece) in pieces.iter().enumerate() {
        let Some(piece) = piece else { continue };
        let b = piece.bounds;
        let (pw, ph) = (b.width(), b.height());
        // The label's own pixels, averaged over a square: along rows, then along columns by running sums of whole rows.
        let mut across = vec![0.0_f32; pw * ph];
        across.par_chunks_mut(pw.max(1)).enumerate().for_each(|(y, row)| {
            let names = &labels.data[(b.top + y) * w + b.left..][..pw];
            let own = |x: usize| if names[x] == label as u16 { 1.0 } else { 0.0 };
            let mut sum: f32 = (0..RADIUS.min(pw)).map(own).sum();
            for (x, out) in row.iter_mut().enumerate() {
                if x + RADIUS < pw {
                    sum += own(x + RADIUS);
                }
                if x > RADIUS {
                    sum -= own(x - RADIUS - 1);
                }
                *out = sum;
            }
        });
        let mut column: Vec<f32> = vec![0.0; pw];
        for y in 0..RADIUS.min(ph) {
            column.iter_mut().zip(&across[y * pw..(y + 1) * pw]).for_each(|(s, v)| *s += v);
        }
        for y in 0..ph {
            if y + RADIUS < ph {
                column.iter_mut().zip(&across[(y + RADIUS) * pw..]).for_each(|(s, v)| *s += v);
            }
            if y > RADIUS {
                column.iter_mut().zip(&across[(y - RADIUS - 1) * pw..]).for_each(|(s, v)| *s -= v);
            }
            let out = &mut sums[(b.top + y) * w + b.left..][..pw];
            for ((out, p), weight) in out.iter_mut().zip(piece.pixels.row(y).as_chunks::<4>().0).zip(&column) {
                if p[3] > 0 && *weight > 0.5 {
                    for c in 0..3 {
                        out[c] += weight * f32::from(p[c]);
                    }
                    out[3] += weight;
                }
            }
        }
    }
    let mut image = RgbU8::new(w, h, [0; 3]);
    image.as_mut_slice().par_chunks_mut(3 * w.max(1)).enumerate().for_each(|(y, row)| {
        let (sums, labels) = (&sums[y * w..(y + 1) * w], &labels.data[y * w..(y + 1) * w]);
        for ((out, s), l) in row.as_chunks_mut::<3>().0.iter_mut().zip(sums).zip(labels) {
            if *l != NONE {
                *out = [0, 1, 2].map(|c| (s[c] / s[3].max(1e-6) + 0.5) as u8);
            }
        }
    });
    image
}
