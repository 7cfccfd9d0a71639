//! Moments of pixels with disparities, from which planes are fitted, merged and tested without visiting the pixels again.

use crate::surfaces::CELL;

/// Ridge regularization of the slopes in px², added to the second central moments; those of 8×8 pixels are 336.
const RIDGE: f64 = 300.0;
/// Maximum horizontal and vertical slope, in px of disparity per px. (A horizontal slope of 1 is a surface seen edge-on by one camera.)
const MAX_SLOPE: (f64, f64) = (0.8, 2.0);

/// Moments of pixels with disparities, relative to a point.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Moments {
    pub(crate) n: f64,
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
    yy: f64,
    d: f64,
    xd: f64,
    yd: f64,
    dd: f64,
}

impl Moments {
    /// Adds a pixel.
    #[inline(always)]
    pub(crate) fn add(&mut self, x: f64, y: f64, d: f64) {
        let one = Self { n: 1.0, x, y, xx: x * x, xy: x * y, yy: y * y, d, xd: x * d, yd: y * d, dd: d * d };
        self.join(&one);
    }

    /// Computes the moments of the pixels of a cell with disparities from `low` to `high`, relative to its center.
    ///
    /// Columns are summed in single precision, relative to the lowest disparity: accurate to 1e-5 px.
    #[inline(always)]
    pub(crate) fn of_cell(pixels: &[[f32; CELL]; CELL], (low, high): (f32, f32)) -> Self {
        let middle = 0.5 * (CELL - 1) as f32;
        let [mut n, mut y1, mut y2, mut d1, mut yd, mut d2] = [[0f32; CELL]; 6];
        for (row, pixels) in pixels.iter().enumerate() {
            let y = row as f32 - middle;
            for x in 0..CELL {
                let d = pixels[x];
                // NaN compares false.
                let is_in = (d >= low) & (d <= high);
                let (weight, off) = (if is_in { 1.0 } else { 0.0 }, if is_in { d - low } else { 0.0 });
                n[x] += weight;
                y1[x] += weight * y;
                y2[x] += weight * (y * y);
                d1[x] += off;
                yd[x] += off * y;
                d2[x] += off * off;
            }
        }
        let [n, y, yy, d, yd, dd] = [n, y1, y2, d1, yd, d2].map(|sums| sums.map(f64::from));
        let column = |i: usize| i as f64 - 0.5 * (CELL - 1) as f64;
        let times_x = |sums: &[f64; CELL]| std::array::from_fn(|i| column(i) * sums[i]);
        let (x, xy, xd) = (times_x(&n), times_x(&y), times_x(&d));
        let xx = times_x(&x);
        let [n, x, y, xx, xy, yy, d, xd, yd, dd] = [n, x, y, xx, xy, yy, d, xd, yd, dd].map(sum);
        // Relative to 0 in place of the lowest disparity.
        let low = if n > 0.0 { f64::from(low) } else { 0.0 };
        let dd = dd + 2.0 * low * d + n * low * low;
        Self { n, x, y, xx, xy, yy, d: d + n * low, xd: xd + x * low, yd: yd + y * low, dd }
    }

    /// Returns the moments relative to a point at `(-dx, -dy)` from the current one.
    pub(crate) fn shifted(&self, dx: f64, dy: f64) -> Self {
        Self {
            n: self.n,
            x: self.x + dx * self.n,
            y: self.y + dy * self.n,
            xx: self.xx + 2.0 * dx * self.x + dx * dx * self.n,
            xy: self.xy + dx * self.y + dy * self.x + dx * dy * self.n,
            yy: self.yy + 2.0 * dy * self.y + dy * dy * self.n,
            d: self.d,
            xd: self.xd + dx * self.d,
            yd: self.yd + dy * self.d,
            dd: self.dd,
        }
    }

    /// Adds moments relative to the same point.
    pub(crate) fn join(&mut self, other: &Self) {
        self.n += other.n;
        self.x += other.x;
        self.y += other.y;
        self.xx += other.xx;
        self.xy += other.xy;
        self.yy += other.yy;
        self.d += other.d;
        self.xd += other.xd;
        self.yd += other.yd;
        self.dd += other.dd;
    }

    /// Fits the plane `a x + b y + c` by least squares with [`RIDGE`]. There is at least one pixel.
    pub(crate) fn fit(&self) -> [f64; 3] {
        let (mx, my, md) = (self.x / self.n, self.y / self.n, self.d / self.n);
        let xx = self.xx - self.n * mx * mx + RIDGE;
        let yy = self.yy - self.n * my * my + RIDGE;
        let xy = self.xy - self.n * mx * my;
        let xd = self.xd - self.n * mx * md;
        let yd = self.yd - self.n * my * md;
        let det = xx * yy - xy * xy;
        let a = ((xd * yy - yd * xy) / det).clamp(-MAX_SLOPE.0, MAX_SLOPE.0);
        let b = ((yd * xx - xd * xy) / det).clamp(-MAX_SLOPE.1, MAX_SLOPE.1);
        [a, b, md - a * mx - b * my]
    }

    /// Returns the RMS distance from a plane.
    pub(crate) fn rms_distance(&self, [a, b, c]: [f64; 3]) -> f64 {
        let squares = self.dd - 2.0 * (a * self.xd + b * self.yd + c * self.d)
            + a * a * self.xx
            + 2.0 * a * b * self.xy
            + b * b * self.yy
            + 2.0 * c * (a * self.x + b * self.y)
            + c * c * self.n;
        (squares.max(0.0) / self.n).sqrt()
    }
}

/// Adds in pairs, for vectors.
#[inline(always)]
fn sum(values: [f64; CELL]) -> f64 {
    let fours: [f64; CELL / 2] = std::array::from_fn(|i| values[i] + values[i + CELL / 2]);
    let twos: [f64; CELL / 4] = std::array::from_fn(|i| fours[i] + fours[i + CELL / 4]);
    twos[0] + twos[1]
}
