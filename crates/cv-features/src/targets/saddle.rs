//! The exact place of a corner where straight edges meet, from the gradients around it.
//!
//! Source: W. Förstner & E. Gülch, "A fast operator for detection and precise location of distinct points, corners and centres of circular features", ISPRS
//! intercommission workshop 1987. The gradient at every pixel x of a window is at right angles to the edge it lies on, and the edge goes through the corner p: gᵀ(p − x) = 0.
//! Least squares over a Gaussian window gives p; the window follows it until it rests. Edges are straight under any perspective, and a change of contrast does
//! not move the place, so neither tilt nor the camera's tone curve makes an error.

use crate::simd;
use cv_core::{ImageView, Point2};
use fearless_simd::{Level, dispatch, prelude::*};

/// Where a corner is.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Saddle {
    pub(crate) position: Point2<f64>,
    /// Standard deviation along either axis, in pixels.
    pub(crate) deviation: f64,
}

/// Rounds before a window that does not come to rest is given up.
const ROUNDS: usize = 30;

/// Values on a grid of whole pixels about any place; `side` × `side` of them from −reach to +reach.
struct Patch {
    values: Vec<f32>,
    side: usize,
}

impl Patch {
    fn sample(&mut self, view: ImageView<'_, f32, 1>, at: Point2<f64>, reach: usize) -> Option<()> {
        let (w, h) = view.size();
        let (x0, y0) = (at.x - reach as f64, at.y - reach as f64);
        self.side = 2 * reach + 1;
        let (bx, by) = (x0.floor(), y0.floor());
        if bx < 0.0 || by < 0.0 || !(bx + by).is_finite() {
            return None;
        }
        let (ix, iy) = (bx as usize, by as usize);
        if ix + self.side >= w || iy + self.side >= h {
            return None;
        }
        let (fx, fy) = ((x0 - bx) as f32, (y0 - by) as f32);
        self.values.clear();
        for j in 0..self.side {
            let (above, below) = (&view.row(iy + j)[ix..=ix + self.side], &view.row(iy + j + 1)[ix..=ix + self.side]);
            for i in 0..self.side {
                let top = above[i] + fx * (above[i + 1] - above[i]);
                let bottom = below[i] + fx * (below[i + 1] - below[i]);
                self.values.push(top + fy * (bottom - top));
            }
        }
        Some(())
    }
}

/// The corner near `start`: the window reaches `window` pixels to each side (at least 1), and has come to rest where it moves by less than `rest` pixels. `None` where it leaves the picture, wanders off further than
/// its own reach, or sees no two edges.
pub(crate) fn saddle(view: ImageView<'_, f32, 1>, start: Point2<f64>, window: f64, rest: f64) -> Option<Saddle> {
    let reach = window.clamp(1.0, 64.0).round() as usize;
    let mut patch = Patch { values: Vec::new(), side: 0 };
    // As wide as its half-width: the rim weighs e⁻¹ along each axis.
    let weights: Vec<f32> =
        (0..=2 * reach).map(|i| (-((i as f64 - reach as f64) / window).powi(2)).exp() as f32).collect();
    let level = simd::level();
    let mut at = start;
    for _ in 0..ROUNDS {
        patch.sample(view, at, reach + 1)?;
        let normal = normal_equations(level, &patch, reach, &weights);
        let step = normal.solve()?;
        at = Point2::new(at.x + step[0], at.y + step[1]);
        let off = (at - start).norm();
        if off > window.max(1.5) || !off.is_finite() {
            return None;
        }
        if step[0].hypot(step[1]) < rest {
            return Some(Saddle { position: at, deviation: normal.deviation(&patch) });
        }
    }
    // It swings between places closer than anyone can tell.
    Some(Saddle { position: at, deviation: 0.5 })
}

/// Sums of g·gᵀ and of g·gᵀ·x over a window about the middle of a patch.
struct NormalEquations {
    xx: f64,
    xy: f64,
    yy: f64,
    bx: f64,
    by: f64,
}

fn normal_equations(level: Level, patch: &Patch, reach: usize, weights: &[f32]) -> NormalEquations {
    dispatch!(level, simd => normal_equations_impl(simd, patch, reach, weights))
}

#[inline(always)]
fn normal_equations_impl<S: Simd>(_: S, patch: &Patch, reach: usize, weights: &[f32]) -> NormalEquations {
    let (side, n) = (patch.side, 2 * reach + 1);
    let mut sums = [0.0f64; 5];
    for j in 0..n {
        let row = &patch.values[(j + 1) * side..][..side];
        let above = &patch.values[j * side + 1..][..n];
        let below = &patch.values[(j + 2) * side + 1..][..n];
        let (left, right) = (&row[..n], &row[2..][..n]);
        let y = j as f32 - reach as f32;
        // Eight sums side by side of each kind, in an order that does not depend on the machine.
        let mut lanes = [[0.0f32; 8]; 5];
        for start in (0..n).step_by(8) {
            let count = (n - start).min(8);
            let mut gx = [0.0f32; 8];
            let mut gy = [0.0f32; 8];
            let mut w = [0.0f32; 8];
            for i in 0..count {
                gx[i] = right[start + i] - left[start + i];
                gy[i] = below[start + i] - above[start + i];
                w[i] = weights[start + i] * weights[j];
            }
            for i in 0..8 {
                let x = (start + i) as f32 - reach as f32;
                let (xx, xy, yy) = (w[i] * gx[i] * gx[i], w[i] * gx[i] * gy[i], w[i] * gy[i] * gy[i]);
                lanes[0][i] += xx;
                lanes[1][i] += xy;
                lanes[2][i] += yy;
                lanes[3][i] += xx * x + xy * y;
                lanes[4][i] += xy * x + yy * y;
            }
        }
        for (sum, lanes) in sums.iter_mut().zip(&lanes) {
            *sum += lanes.iter().map(|&v| f64::from(v)).sum::<f64>();
        }
    }
    let [xx, xy, yy, bx, by] = sums;
    NormalEquations { xx, xy, yy, bx, by }
}

impl NormalEquations {
    /// The corner relative to the middle; `None` where there is only one direction of edges.
    fn solve(&self) -> Option<[f64; 2]> {
        let det = self.xx * self.yy - self.xy * self.xy;
        let trace = self.xx + self.yy;
        // Edges at an angle of less than some 5° tell nothing along themselves.
        (det > 2e-3 * trace * trace)
            .then(|| [(self.yy * self.bx - self.xy * self.by) / det, (self.xx * self.by - self.xy * self.bx) / det])
    }

    /// What noise makes of the position: its size from how far the window differs from itself turned by half a turn, in which an X-corner looks the same; then the bound that any
    /// estimate of a place obeys, σ²·(Σ g·gᵀ)⁻¹.
    fn deviation(&self, patch: &Patch) -> f64 {
        let n = patch.values.len();
        let sum: f64 = (0..n / 2).map(|i| f64::from(patch.values[i] - patch.values[n - 1 - i]).powi(2)).sum();
        let variance = sum / (2.0 * (n / 2).max(1) as f64);
        let det = self.xx * self.yy - self.xy * self.xy;
        // Gradients here are differences over two pixels: twice the slope.
        (variance * 4.0 * 0.5 * (self.xx + self.yy) / det).sqrt()
    }
}
