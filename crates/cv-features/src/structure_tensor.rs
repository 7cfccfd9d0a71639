//! The structure tensor of an image and its corner measures, streamed row by row.
//!
//! Gradients, their products, the Gaussian window and the measure are computed within a few rows that stay in the
//! cache; only the measure is written. Sums are in the order of whole-image passes (vertical, then horizontal), so the
//! result is identical.

use crate::harris::CornerMeasure;
use crate::line_buffer::LineBuffer;
use crate::simd;
use cv_core::ImageView;
use cv_imgproc::{mirror_ends, mirror_index};
use fearless_simd::{Level, dispatch, prelude::*};

/// Input and parameters shared by all strips of an image.
pub(crate) struct StructureTensor<'a> {
    pub(crate) view: ImageView<'a, f32, 1>,
    /// Half-kernel of the Gaussian window.
    pub(crate) kernel: Vec<f32>,
    pub(crate) measure: CornerMeasure,
    pub(crate) level: Level,
}

/// Streaming computation of the rows of a strip.
pub(crate) struct RowStream<'a, 'b> {
    plan: &'b StructureTensor<'a>,
    /// Rows of gx², gx·gy, gy².
    products: [LineBuffer; 3],
    /// Next row of products to compute.
    next: usize,
    padded: Vec<f32>,
    smooth: [Vec<f32>; 3],
}

impl<'a, 'b> RowStream<'a, 'b> {
    /// Creates a stream whose first row is `first`.
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

    /// Computes the measure of row `y`. Rows must be requested in order.
    pub(crate) fn row(&mut self, y: usize, out: &mut [f32]) {
        let Self { plan, products, next, padded, smooth } = self;
        let (w, h) = plan.view.size();
        let r = plan.kernel.len() - 1;
        while *next <= (y + r).min(h - 1) {
            let rows = [-1, 0, 1].map(|d| plan.view.row(mirror_index(*next as isize + d, h)));
            let [xx, xy, yy] = products.each_mut().map(|p| p.row_mut(*next));
            gradient_products(plan.level, rows, [xx, xy, yy]);
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

/// Computes the gradient products (Sobel masks divided by 8) of the middle row, with mirrored borders.
fn gradient_products(level: Level, rows: [&[f32]; 3], out: [&mut [f32]; 3]) {
    dispatch!(level, simd => gradient_products_impl(simd, rows, out));
}

#[inline(always)]
fn gradient_products_impl<S: Simd>(simd: S, [a, b, c]: [&[f32]; 3], [xx, xy, yy]: [&mut [f32]; 3]) {
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
        // The last vector overlaps the previous one.
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

/// Computes gx², gx·gy and gy² at a pixel.
#[inline(always)]
pub(crate) fn products_at([a, b, c]: [&[f32]; 3], x: usize) -> [f32; 3] {
    let (l, r) = (mirror_index(x as isize - 1, b.len()), mirror_index(x as isize + 1, b.len()));
    let gx = ((a[r] - a[l]) + (b[r] - b[l]) * 2.0 + (c[r] - c[l])) * 0.125;
    let gy = ((c[l] - a[l]) + (c[x] - a[x]) * 2.0 + (c[r] - a[r])) * 0.125;
    [gx * gx, gx * gy, gy * gy]
}

/// Computes the corner measure of each tensor.
fn measure(level: Level, measure: CornerMeasure, tensor: [&[f32]; 3], out: &mut [f32]) {
    dispatch!(level, simd => measure_impl(simd, measure, tensor, out));
}

#[inline(always)]
fn measure_impl<S: Simd>(_: S, measure: CornerMeasure, [xx, xy, yy]: [&[f32]; 3], out: &mut [f32]) {
    let tensor = xx.iter().zip(xy).zip(yy);
    match measure {
        CornerMeasure::Harris { k } => {
            for (o, ((xx, xy), yy)) in out.iter_mut().zip(tensor) {
                *o = harris_measure(*xx, *xy, *yy, k);
            }
        }
        CornerMeasure::ShiTomasi => {
            for (o, ((xx, xy), yy)) in out.iter_mut().zip(tensor) {
                *o = smaller_eigenvalue(*xx, *xy, *yy);
            }
        }
    }
}

/// Computes Harris's measure, det − k·trace².
#[inline(always)]
pub(crate) fn harris_measure(xx: f32, xy: f32, yy: f32, k: f32) -> f32 {
    let trace = xx + yy;
    xx * yy - xy * xy - k * trace * trace
}

/// Computes the smaller eigenvalue.
#[inline(always)]
pub(crate) fn smaller_eigenvalue(xx: f32, xy: f32, yy: f32) -> f32 {
    let half = (xx - yy) * 0.5;
    (xx + yy) * 0.5 - (half * half + xy * xy).sqrt()
}
