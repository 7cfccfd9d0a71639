//! The structure tensor of an image and the corner measures made of it, row by row.
//!
//! Gradients, their products, the Gaussian window and the measure follow each other within a few rows, which stay in the cache; only the measure
//! leaves. Sums are in the order of whole-image passes (window down, then along), so the result is theirs to the last bit.

use crate::harris::CornerMeasure;
use crate::line_buffer::LineBuffer;
use crate::simd;
use cv_core::ImageView;
use cv_imgproc::{mirror_ends, mirror_index};
use fearless_simd::{Level, dispatch, prelude::*};

/// What all strips of an image share.
pub(crate) struct StructureTensor<'a> {
    pub(crate) view: ImageView<'a, f32, 1>,
    /// The half-kernel of the window.
    pub(crate) kernel: Vec<f32>,
    pub(crate) measure: CornerMeasure,
    pub(crate) level: Level,
}

/// Walks down the rows of a strip.
pub(crate) struct Walk<'a, 'b> {
    plan: &'b StructureTensor<'a>,
    /// Rows of gx², gx·gy, gy².
    products: [LineBuffer; 3],
    /// The next row of products.
    next: usize,
    padded: Vec<f32>,
    smooth: [Vec<f32>; 3],
}

impl<'a, 'b> Walk<'a, 'b> {
    /// A walk whose first row is `first`.
    pub(crate) fn new(plan: &'b StructureTensor<'a>, first: usize) -> Self {
        let w = plan.view.width();
        let r = plan.kernel.len() - 1;
        Self {
            plan,
            products: [(); 3].map(|()| LineBuffer::new(0..w, 2 * r + 1)),
            next: first.saturating_sub(r),
            padded: vec![0.0; w + 2 * r],
            smooth: [(); 3].map(|()| vec![0.0; w]),
        }
    }

    /// Writes the measure of row `y`. Rows must be asked for one after the other.
    pub(crate) fn row(&mut self, y: usize, out: &mut [f32]) {
        let Self { plan, products, next, padded, smooth } = self;
        let (w, h) = plan.view.size();
        let r = plan.kernel.len() - 1;
        while *next <= (y + r).min(h - 1) {
            let rows = [-1, 0, 1].map(|d| plan.view.row(mirror_index(*next as isize + d, h)));
            let [xx, xy, yy] = products.each_mut().map(|p| p.row_mut(*next));
            multiply(plan.level, rows, [xx, xy, yy]);
            *next += 1;
        }
        let mut rows = Vec::with_capacity(2 * r + 1);
        for (product, smooth) in products.iter().zip(smooth.iter_mut()) {
            product.window(y as isize - r as isize, 2 * r + 1, h, &(0..w), &mut rows);
            simd::vertical(plan.level, &mut padded[r..r + w], &rows, &plan.kernel);
            mirror_ends::<1>(padded, r, r);
            simd::horizontal(plan.level, smooth, padded, &plan.kernel);
        }
        measure(plan.level, plan.measure, smooth.each_ref().map(Vec::as_slice), out);
    }
}

/// The products of the gradient (Sobel's masks divided by 8) along the middle row; ends mirrored.
fn multiply(level: Level, rows: [&[f32]; 3], out: [&mut [f32]; 3]) {
    dispatch!(level, simd => multiply_impl(simd, rows, out));
}

#[inline(always)]
fn multiply_impl<S: Simd>(simd: S, [a, b, c]: [&[f32]; 3], [xx, xy, yy]: [&mut [f32]; 3]) {
    let n = S::f32s::LEN;
    let w = b.len();
    let mut ends = |x: usize| {
        let [x2, x1, y2] = products_at([a, b, c], x);
        (xx[x], xy[x], yy[x]) = (x2, x1, y2);
    };
    ends(0);
    ends(w - 1);
    if w < n + 2 {
        (1..w - 1).for_each(ends);
        return;
    }
    let mut x = 1;
    while x < w - 1 {
        // The last vector overlaps the one before.
        x = x.min(w - 1 - n);
        let load = |row: &[f32], x: usize| S::f32s::from_slice(simd, &row[x..x + n]);
        let (al, am, ar) = (load(a, x - 1), load(a, x), load(a, x + 1));
        let (cl, cm, cr) = (load(c, x - 1), load(c, x), load(c, x + 1));
        let gx = ((ar - al) + (load(b, x + 1) - load(b, x - 1)) * 2.0 + (cr - cl)) * 0.125;
        let gy = ((cl - al) + (cm - am) * 2.0 + (cr - ar)) * 0.125;
        (gx * gx).store_slice(&mut xx[x..x + n]);
        (gx * gy).store_slice(&mut xy[x..x + n]);
        (gy * gy).store_slice(&mut yy[x..x + n]);
        x += n;
    }
}

/// gx², gx·gy and gy² at one pixel.
#[inline(always)]
pub(crate) fn products_at([a, b, c]: [&[f32]; 3], x: usize) -> [f32; 3] {
    let (l, r) = (mirror_index(x as isize - 1, b.len()), mirror_index(x as isize + 1, b.len()));
    let gx = ((a[r] - a[l]) + (b[r] - b[l]) * 2.0 + (c[r] - c[l])) * 0.125;
    let gy = ((c[l] - a[l]) + (c[x] - a[x]) * 2.0 + (c[r] - a[r])) * 0.125;
    [gx * gx, gx * gy, gy * gy]
}

/// The corner measure of each tensor.
fn measure(level: Level, measure: CornerMeasure, tensor: [&[f32]; 3], out: &mut [f32]) {
    dispatch!(level, simd => measure_impl(simd, measure, tensor, out));
}

#[inline(always)]
fn measure_impl<S: Simd>(_: S, measure: CornerMeasure, [xx, xy, yy]: [&[f32]; 3], out: &mut [f32]) {
    let tensor = xx.iter().zip(xy).zip(yy);
    match measure {
        CornerMeasure::Harris { k } => {
            for (o, ((xx, xy), yy)) in out.iter_mut().zip(tensor) {
                *o = harris_at(*xx, *xy, *yy, k);
            }
        }
        CornerMeasure::ShiTomasi => {
            for (o, ((xx, xy), yy)) in out.iter_mut().zip(tensor) {
                *o = smaller_eigenvalue(*xx, *xy, *yy);
            }
        }
    }
}

/// det − k·trace².
#[inline(always)]
pub(crate) fn harris_at(xx: f32, xy: f32, yy: f32, k: f32) -> f32 {
    let trace = xx + yy;
    xx * yy - xy * xy - k * trace * trace
}

/// The smaller eigenvalue.
#[inline(always)]
pub(crate) fn smaller_eigenvalue(xx: f32, xy: f32, yy: f32) -> f32 {
    let half = (xx - yy) * 0.5;
    (xx + yy) * 0.5 - (half * half + xy * xy).sqrt()
}
