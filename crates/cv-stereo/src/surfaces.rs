//! The surfaces of a disparity map: planes over cells of 8×8 pixels, grown from cell to cell (as plane segmentation of range images is
//! done: Besl & Jain, "Segmentation through variable-order surface fitting", PAMI 1988).
//!
//! Each cell is known by the moments of its matched pixels, so that planes are fitted, joined and judged without looking at pixels again.

use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;
use rayon::prelude::*;
use std::{collections::VecDeque, ops::Range};

/// Side of a cell in px.
pub(crate) const CELL: usize = 8;
/// No surface.
pub(crate) const NONE: u32 = u32::MAX;
/// Matched pixels that a cell needs for a plane of its own.
const LEAST: f64 = 12.0;
/// Disparities of a cell that spread over more px are of two surfaces, of which the larger one counts.
const SPREAD: f32 = 3.0;
/// Root mean squared distance in px from a surface's plane up to which a cell joins it, and what is added where the photograph is flat: there
/// matches are less exact. Together with the other constants below and those of [`crate::surface_filling`] set on 23 public pairs with truth
/// (Middlebury, DrivingStereo); 0.4 to 0.9 and 0.5 to 2 px differ by 0.3 points of the pixels that are wrong by more than 2 px, but on
/// roads, where 0.4 leaves 12 % and 0.9 leaves 9 %.
const FITS: f64 = 0.9;
const FITS_FLAT: f64 = 2.0;
/// Gray levels a horizontal step (mean of a cell) from which a cell is no longer flat, and below which it is wholly flat.
const FLAT: (f32, f32) = (3.0, 1.0);
/// Held against slopes in px² (as so many squared distances of pixels): 8×8 pixels have 336 of their own.
const RIDGE: f64 = 300.0;
/// Steepest slopes, in px of disparity per px across and down. (Across, 1 would be a surface seen edge-on by one camera.)
const STEEPEST: (f64, f64) = (0.8, 2.0);
/// Surfaces of so many cells smooth the flat ones among them, each by those up to so many cells away.
const LARGE: usize = 12;
const WINDOW: usize = 2;
/// Pixels farther from the plane than this are not smoothed.
const SMOOTHED: f32 = 3.0;

/// Sums over pixels, relative to a point.
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

    /// Relative to a point that lies `(-dx, -dy)` from the one before.
    fn shifted(&self, dx: f64, dy: f64) -> Self {
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

    /// Adds sums relative to the same point.
    fn join(&mut self, other: &Self) {
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

    /// The plane `a x + b y + c` of least squares, with [`RIDGE`]. There is a pixel at least.
    pub(crate) fn fit(&self) -> [f64; 3] {
        let (mx, my, md) = (self.x / self.n, self.y / self.n, self.d / self.n);
        let xx = self.xx - self.n * mx * mx + RIDGE;
        let yy = self.yy - self.n * my * my + RIDGE;
        let xy = self.xy - self.n * mx * my;
        let xd = self.xd - self.n * mx * md;
        let yd = self.yd - self.n * my * md;
        let det = xx * yy - xy * xy;
        let a = ((xd * yy - yd * xy) / det).clamp(-STEEPEST.0, STEEPEST.0);
        let b = ((yd * xx - xd * xy) / det).clamp(-STEEPEST.1, STEEPEST.1);
        [a, b, md - a * mx - b * my]
    }

    /// Root mean squared distance from a plane.
    fn distance(&self, [a, b, c]: [f64; 3]) -> f64 {
        let squares = self.dd - 2.0 * (a * self.xd + b * self.yd + c * self.d)
            + a * a * self.xx
            + 2.0 * a * b * self.xy
            + b * b * self.yy
            + 2.0 * c * (a * self.x + b * self.y)
            + c * c * self.n;
        (squares.max(0.0) / self.n).sqrt()
    }
}

/// What is known of a cell.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Cell {
    /// Of the matched pixels of its larger surface, relative to its center.
    moments: Moments,
    /// Range of their disparities.
    range: (f32, f32),
    /// Mean gray value.
    pub(crate) gray: f32,
    /// Mean difference between horizontal neighbors, in gray levels.
    pub(crate) texture: f32,
    /// Pixels without a disparity.
    pub(crate) holes: u32,
}

/// A plane within the range of disparities it is known for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Plane {
    origin: (f64, f64),
    coefficients: [f64; 3],
    range: (f64, f64),
}

impl Plane {
    /// Disparity at a pixel.
    #[inline(always)]
    pub(crate) fn at(&self, x: f64, y: f64) -> f32 {
        let [a, b, c] = self.coefficients;
        (a * (x - self.origin.0) + b * (y - self.origin.1) + c).clamp(self.range.0, self.range.1) as f32
    }
}

/// Cells and surfaces of a map, kept between frames.
#[derive(Debug, Default)]
pub(crate) struct Surfaces {
    pub(crate) columns: usize,
    pub(crate) cells: Vec<Cell>,
    /// The surface of each cell, [`NONE`] for those without a plane.
    pub(crate) labels: Vec<u32>,
    pub(crate) planes: Vec<Plane>,
    /// Cells of each surface.
    sizes: Vec<usize>,
    order: Vec<(u64, u32)>,
    queue: VecDeque<usize>,
}

/// Center of a cell in px.
pub(crate) fn center(cell: usize, columns: usize) -> (f64, f64) {
    let middle = |i: usize| (i * CELL) as f64 + 0.5 * (CELL - 1) as f64;
    (middle(cell % columns), middle(cell / columns))
}

/// Columns and rows of a cell.
pub(crate) fn extent(cell: usize, columns: usize, (width, height): (usize, usize)) -> (Range<usize>, Range<usize>) {
    let (left, top) = (cell % columns * CELL, cell / columns * CELL);
    (left..(left + CELL).min(width), top..(top + CELL).min(height))
}

impl Surfaces {
    /// Bytes for images of this size.
    pub(crate) fn bytes(width: usize, height: usize) -> usize {
        let cell = size_of::<Cell>() + 2 * size_of::<u32>() + size_of::<Plane>() + size_of::<usize>() + 16;
        width.div_ceil(CELL).saturating_mul(height.div_ceil(CELL)).saturating_mul(cell)
    }

    /// Finds the surfaces of a map (NaN where unknown). Linear in the number of pixels; sorting the cells is not, and takes no time.
    pub(crate) fn find(&mut self, level: Level, disparity: &[f32], gray: &[u8], width: usize, lowest: f32) {
        let height = disparity.len() / width;
        self.columns = width.div_ceil(CELL);
        self.cells.resize(self.columns * height.div_ceil(CELL), Cell::default());
        let columns = self.columns;
        self.cells.par_chunks_mut(columns).enumerate().for_each(|(row, cells)| {
            dispatch!(level, simd => find_cells(simd, disparity, gray, (width, height), row, cells));
        });
        self.grow(LEAST, lowest);
        if self.planes.is_empty() {
            // Thin things only.
            self.grow(1.0, lowest);
        }
    }

    /// How flat the photograph is in a cell, 0 to 1.
    fn flatness(&self, cell: usize) -> f64 {
        f64::from(((FLAT.0 - self.cells[cell].texture) / (FLAT.0 - FLAT.1)).clamp(0.0, 1.0))
    }

    /// Grows surfaces from cells with `least` matched pixels, the most even ones first.
    fn grow(&mut self, least: f64, lowest: f32) {
        let columns = self.columns;
        let rows = self.cells.len() / columns;
        self.labels.clear();
        self.labels.resize(self.cells.len(), NONE);
        self.planes.clear();
        self.sizes.clear();
        self.order.clear();
        for (c, cell) in self.cells.iter().enumerate().filter(|(_, cell)| cell.moments.n >= least) {
            // In eighths of a pixel; among equals the fullest.
            let distance = cell.moments.distance(cell.moments.fit());
            let full = (CELL * CELL) as u64 - cell.moments.n as u64;
            self.order.push(((8.0 * distance) as u64 * 1024 + full, c as u32));
        }
        self.order.sort_unstable();
        for i in 0..self.order.len() {
            let seed = self.order[i].1 as usize;
            if self.labels[seed] != NONE {
                continue;
            }
            let origin = center(seed, columns);
            let moved = |cells: &[Cell], c: usize| {
                let (x, y) = center(c, columns);
                cells[c].moments.shifted(x - origin.0, y - origin.1)
            };
            let open = |surfaces: &Self, c: usize| surfaces.labels[c] == NONE && surfaces.cells[c].moments.n >= least;
            // The slope of a single cell is coarse: that of the nine around where they are one plane.
            let mut all = self.cells[seed].moments;
            let mut around = all;
            let (sx, sy) = (seed % columns, seed / columns);
            for y in sy.saturating_sub(1)..(sy + 2).min(rows) {
                for c in y * columns + sx.saturating_sub(1)..y * columns + (sx + 2).min(columns) {
                    if c != seed && open(self, c) {
                        around.join(&moved(&self.cells, c));
                    }
                }
            }
            let mut plane = around.fit();
            if around.distance(plane) >= FITS {
                plane = all.fit();
            }
            let label = self.planes.len() as u32;
            self.labels[seed] = label;
            let mut range = self.cells[seed].range;
            let (mut size, mut refit) = (1, 2);
            self.queue.clear();
            self.queue.push_back(seed);
            while let Some(c) = self.queue.pop_front() {
                for n in neighbors(c, columns, rows).into_iter().flatten() {
                    if !open(self, n) {
                        continue;
                    }
                    let moments = moved(&self.cells, n);
                    if moments.distance(plane) > FITS + FITS_FLAT * self.flatness(n) {
                        continue;
                    }
                    self.labels[n] = label;
                    all.join(&moments);
                    range = (range.0.min(self.cells[n].range.0), range.1.max(self.cells[n].range.1));
                    self.queue.push_back(n);
                    size += 1;
                    if size >= refit {
                        plane = all.fit();
                        refit = size + size / 2 + 1;
                    }
                }
            }
            // No farther than it reaches itself: beyond, a plane is a guess.
            let reach = range.1 - range.0 + 1.0;
            let range = (f64::from((range.0 - reach).max(lowest)), f64::from(range.1 + reach));
            self.planes.push(Plane { origin, coefficients: all.fit(), range: (range.0.min(range.1), range.1) });
            self.sizes.push(size);
        }
    }

    /// Draws the disparities of flat cells to the plane of the cells around that are of the same surface, where that is large: matches in
    /// flat surroundings are right within a pixel or two, and those of many cells together within a fraction of one.
    pub(crate) fn smooth_flat(&self, disparity: &mut [f32], width: usize) {
        let columns = self.columns;
        let rows = self.cells.len() / columns;
        disparity.par_chunks_mut(CELL * width).enumerate().for_each(|(row, disparity)| {
            let height = disparity.len() / width;
            for x in 0..columns {
                let c = row * columns + x;
                let label = self.labels[c];
                let flatness = self.flatness(c) as f32;
                if label == NONE || flatness == 0.0 || self.sizes[label as usize] < LARGE {
                    continue;
                }
                let mut around = Moments::default();
                for ny in row.saturating_sub(WINDOW)..(row + WINDOW + 1).min(rows) {
                    for nx in x.saturating_sub(WINDOW)..(x + WINDOW + 1).min(columns) {
                        let n = ny * columns + nx;
                        if self.labels[n] == label {
                            let away = |a: usize, b: usize| (a as f64 - b as f64) * CELL as f64;
                            around.join(&self.cells[n].moments.shifted(away(nx, x), away(ny, row)));
                        }
                    }
                }
                let [a, b, d] = around.fit();
                let (middle_x, middle_y) = center(x, columns);
                let (xs, ys) = extent(x, columns, (width, height));
                for y in ys {
                    let first = b * (y as f64 - middle_y) + d;
                    for (x, d) in xs.clone().zip(&mut disparity[y * width..][xs.clone()]) {
                        let off = (a * (x as f64 - middle_x) + first) as f32 - *d;
                        // NaN compares false.
                        *d += if off.abs() < SMOOTHED { flatness * off } else { 0.0 };
                    }
                }
            }
        });
    }
}

/// The cells beside, above and below one.
pub(crate) fn neighbors(c: usize, columns: usize, rows: usize) -> [Option<usize>; 4] {
    let (x, y) = (c % columns, c / columns);
    [
        (x > 0).then(|| c - 1),
        (x + 1 < columns).then(|| c + 1),
        (y > 0).then(|| c - columns),
        (y + 1 < rows).then(|| c + columns),
    ]
}

/// The cells of a row.
#[simd]
fn find_cells<S: Simd>(_: S, disparity: &[f32], gray: &[u8], size: (usize, usize), row: usize, cells: &mut [Cell]) {
    for (column, cell) in cells.iter_mut().enumerate() {
        *cell = Cell::new(disparity, gray, size, (column, row));
    }
}

impl Cell {
    #[inline(always)]
    fn new(disparity: &[f32], gray: &[u8], (width, height): (usize, usize), (column, row): (usize, usize)) -> Self {
        let (left, top) = (column * CELL, row * CELL);
        let (right, bottom) = ((left + CELL).min(width), (top + CELL).min(height));
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        let (mut sum, mut steps, mut holes) = (0, 0, 0);
        for y in top..bottom {
            let row = y * width..(y + 1) * width;
            for &d in &disparity[row.clone()][left..right] {
                holes += u32::from(d.is_nan());
                // NaN compares false.
                (low, high) = (if d < low { d } else { low }, if d > high { d } else { high });
            }
            let gray = &gray[row];
            sum += gray[left..right].iter().map(|&g| u32::from(g)).sum::<u32>();
            let next = gray[left + 1..].iter().chain(gray.last());
            steps += gray[left..right].iter().zip(next).map(|(&a, &b)| u32::from(a.abs_diff(b))).sum::<u32>();
        }
        // Halved twice: three surfaces in a cell.
        for _ in 0..2 {
            if high - low > SPREAD {
                let middle = 0.5 * (low + high);
                let (mut above, mut least, mut below, mut most) = (0, high, 0, low);
                for y in top..bottom {
                    for &d in &disparity[y * width..][left..right] {
                        let (up, down) = (d > middle && d <= high, d <= middle && d >= low);
                        above += u32::from(up);
                        below += u32::from(down);
                        least = if up && d < least { d } else { least };
                        most = if down && d > most { d } else { most };
                    }
                }
                (low, high) = if above > below { (least, high) } else { (low, most) };
            }
        }
        let mut moments = Moments::default();
        for y in top..bottom {
            // A row in single precision, relative to the lowest: exact to 1e-5 px.
            let [mut n, mut x1, mut x2, mut d1, mut xd, mut d2] = [0f32; 6];
            for (x, &d) in disparity[y * width..][left..right].iter().enumerate() {
                let (x, off) = (x as f32 - 0.5 * (CELL - 1) as f32, d - low);
                let (weight, off) = if d >= low && d <= high { (1.0, off) } else { (0.0, 0.0) };
                n += weight;
                x1 += weight * x;
                x2 += weight * x * x;
                d1 += off;
                xd += x * off;
                d2 += off * off;
            }
            let [n, x1, x2, d1, xd, d2] = [n, x1, x2, d1, xd, d2].map(f64::from);
            let (y, low) = ((y - top) as f64 - 0.5 * (CELL - 1) as f64, f64::from(low));
            if n > 0.0 {
                moments.join(&Moments {
                    n,
                    x: x1,
                    y: y * n,
                    xx: x2,
                    xy: y * x1,
                    yy: y * y * n,
                    d: d1 + n * low,
                    xd: xd + low * x1,
                    yd: y * (d1 + n * low),
                    dd: d2 + 2.0 * low * d1 + n * low * low,
                });
            }
        }
        let count = ((right - left) * (bottom - top)) as f32;
        Self { moments, range: (low, high), gray: sum as f32 / count, texture: steps as f32 / count, holes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 84;
    const HEIGHT: usize = 60;

    fn found(d: impl Fn(usize, usize) -> f32, gray: u8) -> (Surfaces, Vec<f32>) {
        let disparity: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| d(i % WIDTH, i / WIDTH)).collect();
        let mut surfaces = Surfaces::default();
        surfaces.find(Level::new(), &disparity, &vec![gray; WIDTH * HEIGHT], WIDTH, 0.0);
        (surfaces, disparity)
    }

    #[test]
    fn two_planes_are_two_surfaces_each_where_it_is() {
        // A road that rises by 0.4 px a row, and from column 40 on (a border of cells) a wall before it.
        let road = |x: usize, y: usize| 5.0 + 0.4 * y as f32 - 0.05 * x as f32;
        let (surfaces, _) = found(|x, y| if x < 40 { road(x, y) } else { 45.0 + 0.1 * x as f32 }, 90);
        assert_eq!(surfaces.planes.len(), 2);
        for (c, &label) in surfaces.labels.iter().enumerate() {
            let (x, y) = center(c, surfaces.columns);
            let value = f64::from(surfaces.planes[label as usize].at(x, y));
            let truth = if x < 40.0 { 5.0 + 0.4 * y - 0.05 * x } else { 45.0 + 0.1 * x };
            // The ridge takes a hundredth of the slope of thousands of pixels.
            assert!((value - truth).abs() < 0.1, "{x} {y}: {value} for {truth}");
        }
    }

    #[test]
    fn an_empty_map_has_no_surfaces_and_a_thin_thing_one() {
        assert!(found(|_, _| f32::NAN, 90).0.planes.is_empty());
        let (surfaces, _) = found(|x, _| if x == 20 { 7.0 } else { f32::NAN }, 90);
        assert_eq!(surfaces.planes.len(), 1);
        assert!((surfaces.planes[0].at(20.0, 30.0) - 7.0).abs() < 1e-3);
    }

    #[test]
    fn steps_of_a_flat_road_become_a_slope() {
        // Whole pixels, as matches without texture are: off by half a pixel, 0.29 in the mean of squares.
        let road = |y: usize| 5.0 + 0.15 * y as f32;
        let (surfaces, mut disparity) = found(|_, y| road(y).round(), 90);
        surfaces.smooth_flat(&mut disparity, WIDTH);
        let squares: f32 = disparity.iter().enumerate().map(|(i, d)| (d - road(i / WIDTH)).powi(2)).sum();
        let off = (squares / disparity.len() as f32).sqrt();
        // Planes over forty rows, which hold six steps, leave a third of it.
        assert!(off < 0.1, "{off}");
        // With texture, matches are believed.
        let textured: Vec<u8> = (0..WIDTH * HEIGHT).map(|i| (i % 2 * 40) as u8).collect();
        let mut surfaces = Surfaces::default();
        let steps: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| road(i / WIDTH).round()).collect();
        surfaces.find(Level::new(), &steps, &textured, WIDTH, 0.0);
        let mut kept = steps.clone();
        surfaces.smooth_flat(&mut kept, WIDTH);
        assert_eq!(kept, steps);
    }
}
