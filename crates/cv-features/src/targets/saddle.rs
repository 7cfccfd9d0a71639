//! The exact place of a corner where straight edges meet, from the gradients around it.
//!
//! Source: W. Förstner & E. Gülch, "A fast operator for detection and precise location of distinct points, corners and centres of circular features", ISPRS
//! intercommission workshop 1987. The gradient at every pixel x of a window is at right angles to the edge it lies on, and the edge goes through the corner p: gᵀ(p − x) = 0.
//! Least squares over a Gaussian window gives p; the window follows it until it rests. Edges are straight under any perspective, and a change of contrast does
//! not move the place, so neither tilt nor the camera's tone curve makes an error.

use cv_core::{ImageView, Point2};

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
    let weights: Vec<f64> = (0..=2 * reach).map(|i| (-((i as f64 - reach as f64) / window).powi(2)).exp()).collect();
    let mut at = start;
    for _ in 0..ROUNDS {
        patch.sample(view, at, reach + 1)?;
        let normal = normal_equations(&patch, reach, &weights);
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

fn normal_equations(patch: &Patch, reach: usize, weights: &[f64]) -> NormalEquations {
    let side = patch.side;
    let mut n = NormalEquations { xx: 0.0, xy: 0.0, yy: 0.0, bx: 0.0, by: 0.0 };
    for j in 0..=2 * reach {
        let row = &patch.values[(j + 1) * side..(j + 2) * side];
        let (above, below) = (&patch.values[j * side..], &patch.values[(j + 2) * side..]);
        let y = j as f64 - reach as f64;
        for i in 0..=2 * reach {
            let gx = f64::from(row[i + 2] - row[i]);
            let gy = f64::from(below[i + 1] - above[i + 1]);
            let x = i as f64 - reach as f64;
            let w = weights[i] * weights[j];
            let (xx, xy, yy) = (w * gx * gx, w * gx * gy, w * gy * gy);
            n.xx += xx;
            n.xy += xy;
            n.yy += yy;
            n.bx += xx * x + xy * y;
            n.by += xy * x + yy * y;
        }
    }
    n
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
