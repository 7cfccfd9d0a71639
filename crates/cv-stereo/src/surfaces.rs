//! Segmentation of a disparity map into planar surfaces by region growing over cells of 8×8 pixels (as for range images: Besl & Jain,
//! "Segmentation through variable-order surface fitting", PAMI 1988).
//!
//! A cell has the moments of its matched pixels, from which planes are fitted, merged and tested without visiting pixels again.

use crate::moments::Moments;
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;
use std::{collections::VecDeque, ops::Range};

/// Side of a cell in px.
pub(crate) const CELL: usize = 8;
/// The label of cells without a surface.
pub(crate) const NONE: u32 = u32::MAX;
/// Minimum number of matched pixels of a cell of a surface.
const MIN_PIXELS: f64 = 12.0;
/// Range of the disparities of a cell in px above which they are of two surfaces, of which the larger one is used.
const MAX_CELL_RANGE: f32 = 3.0;
/// RMS distance in px from the plane of a surface up to which a cell joins it, and its increase in low texture, where matches are less
/// accurate. Set on 23 public pairs with ground truth (Middlebury, DrivingStereo), as the constants below and those of
/// [`crate::surface_filling`]; 0.4 to 0.9 and 0.5 to 2 px differ by 0.3 points of the errors above 2 px, except on roads, where 0.4 leaves
/// 12 % and 0.9 leaves 9 %.
const MAX_PLANE_RMS: f64 = 0.9;
const MAX_PLANE_RMS_LOW_TEXTURE: f64 = 2.0;
/// Mean absolute difference of horizontal neighbors in gray levels from which a cell is textured, and below which it is textureless.
const TEXTURE_RANGE: (f32, f32) = (3.0, 1.0);
/// Low-texture cells of surfaces of at least this many cells are smoothed, by the plane of those within a window of this radius in cells.
const MIN_SMOOTHED_CELLS: usize = 12;
const SMOOTHING_RADIUS: usize = 2;
/// Distance from the plane in px from which on pixels are not smoothed.
const MAX_SMOOTHED_DISTANCE: f32 = 3.0;

/// Statistics of a cell.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Cell {
    /// Moments of the matched pixels of its larger surface, relative to its center.
    pub(crate) moments: Moments,
    /// Minimum and maximum of their disparities.
    range: (f32, f32),
    /// Mean gray level.
    pub(crate) gray: f32,
    /// Mean absolute difference of horizontal neighbors, in gray levels.
    pub(crate) texture: f32,
    /// Number of pixels without a disparity.
    pub(crate) holes: u32,
}

/// A plane, clamped to a range of disparities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Plane {
    pub(crate) origin: (f64, f64),
    pub(crate) coefficients: [f64; 3],
    pub(crate) range: (f64, f64),
}

impl Plane {
    /// Returns the disparity at a pixel.
    #[inline(always)]
    pub(crate) fn at(&self, x: f64, y: f64) -> f32 {
        let [a, b, c] = self.coefficients;
        (a * (x - self.origin.0) + b * (y - self.origin.1) + c).clamp(self.range.0, self.range.1) as f32
    }

    /// Returns the disparities of `N` pixels of row `y`, `STEP` apart from column `x` on.
    #[inline(always)]
    pub(crate) fn row<const N: usize, const STEP: usize>(&self, x: usize, y: usize) -> [f32; N] {
        let [a, b, c] = self.coefficients;
        let (low, high) = self.range;
        std::array::from_fn(|i| {
            let d = a * (x as f64 + (i * STEP) as f64 - self.origin.0) + b * (y as f64 - self.origin.1) + c;
            // Vectorized, unlike `clamp`.
            let d = if d < low { low } else { d };
            (if d > high { high } else { d }) as f32
        })
    }
}

/// Cells and surfaces of a map, reused between frames.
#[derive(Debug, Default)]
pub(crate) struct Surfaces {
    pub(crate) columns: usize,
    pub(crate) cells: Vec<Cell>,
    /// The surface of each cell, or [`NONE`].
    pub(crate) labels: Vec<u32>,
    pub(crate) planes: Vec<Plane>,
    /// The plane by which each is extrapolated: see [`crate::local_planes`].
    pub(crate) local_planes: Vec<Plane>,
    /// Number of cells of each surface.
    pub(crate) sizes: Vec<usize>,
    order: Vec<(u64, u32)>,
    queue: VecDeque<usize>,
}

/// Returns the center of a cell in px.
pub(crate) fn center(cell: usize, columns: usize) -> (f64, f64) {
    let middle = |i: usize| (i * CELL) as f64 + 0.5 * (CELL - 1) as f64;
    (middle(cell % columns), middle(cell / columns))
}

/// Returns the columns and rows of a cell.
pub(crate) fn extent(cell: usize, columns: usize, (width, height): (usize, usize)) -> (Range<usize>, Range<usize>) {
    let (left, top) = (cell % columns * CELL, cell / columns * CELL);
    (left..(left + CELL).min(width), top..(top + CELL).min(height))
}

impl Surfaces {
    /// Returns the bytes for images of this size.
    pub(crate) fn bytes(width: usize, height: usize) -> usize {
        let cell = size_of::<Cell>() + 2 * size_of::<u32>() + 2 * size_of::<Plane>() + size_of::<usize>() + 16;
        width.div_ceil(CELL).saturating_mul(height.div_ceil(CELL)).saturating_mul(cell)
    }

    /// Computes the statistics of the cells of a map (NaN where unknown).
    pub(crate) fn measure_cells(&mut self, level: Level, disparity: &[f32], gray: &[u8], width: usize) {
        let height = disparity.len() / width;
        self.columns = width.div_ceil(CELL);
        self.cells.resize(self.columns * height.div_ceil(CELL), Cell::default());
        let columns = self.columns;
        self.cells.par_chunks_mut(columns).enumerate().for_each(|(row, cells)| {
            dispatch!(level, simd => compute_cells(simd, disparity, gray, (width, height), row, cells));
        });
    }

    /// Segments the cells into surfaces, of disparities from `lowest` on. O(c log c) for c cells.
    pub(crate) fn segment(&mut self, lowest: f32) {
        self.grow(MIN_PIXELS, lowest);
        if self.planes.is_empty() {
            // Thin structures only.
            self.grow(1.0, lowest);
        }
    }

    /// Returns how textureless a cell is, 0 to 1.
    pub(crate) fn texturelessness(&self, cell: usize) -> f64 {
        f64::from(((TEXTURE_RANGE.0 - self.cells[cell].texture) / (TEXTURE_RANGE.0 - TEXTURE_RANGE.1)).clamp(0.0, 1.0))
    }

    /// Grows surfaces from cells of at least `min_pixels` matched pixels, the most planar ones first.
    fn grow(&mut self, min_pixels: f64, lowest: f32) {
        let columns = self.columns;
        let rows = self.cells.len() / columns;
        self.labels.clear();
        self.labels.resize(self.cells.len(), NONE);
        self.planes.clear();
        self.sizes.clear();
        self.order.clear();
        for (c, cell) in self.cells.iter().enumerate().filter(|(_, cell)| cell.moments.n >= min_pixels) {
            // In eighths of a pixel; of equals the one with the most pixels.
            let distance = cell.moments.rms_distance(cell.moments.fit());
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
            let open =
                |surfaces: &Self, c: usize| surfaces.labels[c] == NONE && surfaces.cells[c].moments.n >= min_pixels;
            // The slope of a single cell is inaccurate: that of the 3×3 cells, if they are one plane.
            let mut all = self.cells[seed].moments;
            let mut around = all;
            for c in self.around(seed) {
                if c != seed && open(self, c) {
                    around.join(&moved(&self.cells, c));
                }
            }
            let mut plane = around.fit();
            if around.rms_distance(plane) >= MAX_PLANE_RMS {
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
                    if moments.rms_distance(plane) > MAX_PLANE_RMS + MAX_PLANE_RMS_LOW_TEXTURE * self.texturelessness(n)
                    {
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
            // Extrapolated by no more than its own range of disparities.
            let reach = range.1 - range.0 + 1.0;
            let range = (f64::from((range.0 - reach).max(lowest)), f64::from(range.1 + reach));
            self.planes.push(Plane { origin, coefficients: all.fit(), range: (range.0.min(range.1), range.1) });
            self.sizes.push(size);
        }
    }

    /// Returns a cell and its 8-neighbors.
    pub(crate) fn around(&self, c: usize) -> impl Iterator<Item = usize> + use<> {
        let columns = self.columns;
        let (x, y) = (c % columns, c / columns);
        let (xs, ys) =
            (x.saturating_sub(1)..(x + 2).min(columns), y.saturating_sub(1)..(y + 2).min(self.cells.len() / columns));
        ys.flat_map(move |y| xs.clone().map(move |x| y * columns + x))
    }

    /// Returns the moments of the cells of the same surface, `spacing` apart within a radius, relative to the center of the cell, and how
    /// textureless they are, 0 to 1.
    pub(crate) fn moments_around(&self, c: usize, radius: usize, spacing: usize) -> (Moments, f64) {
        let columns = self.columns;
        let rows = self.cells.len() / columns;
        let (x, y) = (c % columns, c / columns);
        let inside = |at: usize, count: usize| {
            let steps = (radius / spacing) as isize;
            let offsets = (-steps..=steps).map(move |step| step * spacing as isize);
            offsets.filter(move |&offset| at.checked_add_signed(offset).is_some_and(|at| at < count))
        };
        let (mut all, mut texturelessness) = (Moments::default(), 0.0);
        for dy in inside(y, rows) {
            for dx in inside(x, columns) {
                let n = c.wrapping_add_signed(dy * columns as isize + dx);
                if self.labels[n] == self.labels[c] {
                    let cell = &self.cells[n].moments;
                    all.join(&cell.shifted((dx * CELL as isize) as f64, (dy * CELL as isize) as f64));
                    texturelessness += self.texturelessness(n) * cell.n;
                }
            }
        }
        (all, texturelessness / all.n)
    }

    /// Returns the distinct labels of a cell and its 8-neighbors, and their number.
    pub(crate) fn labels_around(&self, c: usize) -> ([u32; 9], usize) {
        let (mut found, mut count) = ([NONE; 9], 0);
        for label in self.around(c).map(|n| self.labels[n]) {
            if label != NONE && !found[..count].contains(&label) {
                found[count] = label;
                count += 1;
            }
        }
        (found, count)
    }

    /// Returns the largest difference in px between the surface of a cell and those of its 8-neighbors.
    pub(crate) fn ambiguity(&self, c: usize) -> f32 {
        let (around, count) = self.labels_around(c);
        let (x, y) = center(c, self.columns);
        let at = |label: u32| self.planes[label as usize].at(x, y);
        let own = at(self.labels[c]);
        around[..count].iter().map(|&label| (at(label) - own).abs()).fold(0.0, f32::max)
    }

    /// Moves the disparities of low-texture cells of large surfaces to the plane of the surrounding cells of the surface: matches in low
    /// texture are accurate to a pixel or two, the plane of many cells to a fraction of one.
    pub(crate) fn smooth_low_texture(&self, disparity: &mut [f32], width: usize) {
        let columns = self.columns;
        disparity.par_chunks_mut(CELL * width).enumerate().for_each(|(row, disparity)| {
            let height = disparity.len() / width;
            for x in 0..columns {
                let c = row * columns + x;
                let label = self.labels[c];
                let texturelessness = self.texturelessness(c) as f32;
                if label == NONE || texturelessness == 0.0 || self.sizes[label as usize] < MIN_SMOOTHED_CELLS {
                    continue;
                }
                let [a, b, d] = self.moments_around(c, SMOOTHING_RADIUS, 1).0.fit();
                let (middle_x, middle_y) = center(x, columns);
                let (xs, ys) = extent(x, columns, (width, height));
                for y in ys {
                    let first = b * (y as f64 - middle_y) + d;
                    for (x, d) in xs.clone().zip(&mut disparity[y * width..][xs.clone()]) {
                        let off = (a * (x as f64 - middle_x) + first) as f32 - *d;
                        // NaN compares false.
                        *d += if off.abs() < MAX_SMOOTHED_DISTANCE { texturelessness * off } else { 0.0 };
                    }
                }
            }
        });
    }
}

/// Returns the 4-neighbors of a cell.
pub(crate) fn neighbors(c: usize, columns: usize, rows: usize) -> [Option<usize>; 4] {
    let (x, y) = (c % columns, c / columns);
    [
        (x > 0).then(|| c - 1),
        (x + 1 < columns).then(|| c + 1),
        (y > 0).then(|| c - columns),
        (y + 1 < rows).then(|| c + columns),
    ]
}

/// Computes the statistics of a row of cells.
#[simd]
fn compute_cells<S: Simd>(_: S, disparity: &[f32], gray: &[u8], size: (usize, usize), row: usize, cells: &mut [Cell]) {
    for (column, cell) in cells.iter_mut().enumerate() {
        *cell = Cell::new(disparity, gray, size, (column, row));
    }
}

impl Cell {
    #[inline(always)]
    fn new(disparity: &[f32], gray: &[u8], (width, height): (usize, usize), (column, row): (usize, usize)) -> Self {
        let (left, top) = (column * CELL, row * CELL);
        let (right, bottom) = ((left + CELL).min(width), (top + CELL).min(height));
        // NaN outside the image: loops of constant length are vectorized.
        let mut pixels = [[f32::NAN; CELL]; CELL];
        let (mut sum, mut steps) = (0, 0);
        for (y, pixels) in (top..bottom).zip(&mut pixels) {
            let gray = &gray[y * width..][..width];
            let inside = &disparity[y * width..][left..right];
            match (inside.first_chunk(), gray[left..].first_chunk::<{ CELL + 1 }>()) {
                (Some(inside), Some(gray)) => {
                    *pixels = *inside;
                    sum += gray[..CELL].iter().map(|&g| u32::from(g)).sum::<u32>();
                    steps += (0..CELL).map(|x| u32::from(gray[x].abs_diff(gray[x + 1]))).sum::<u32>();
                }
                _ => {
                    pixels[..inside.len()].copy_from_slice(inside);
                    sum += gray[left..right].iter().map(|&g| u32::from(g)).sum::<u32>();
                    let next = gray[left + 1..].iter().chain(gray.last());
                    let pairs = gray[left..right].iter().zip(next);
                    steps += pairs.map(|(&a, &b)| u32::from(a.abs_diff(b))).sum::<u32>();
                }
            }
        }
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        let (mut least, mut most, mut unknown) = ([low; CELL], [high; CELL], [0; CELL]);
        for pixels in &pixels {
            for x in 0..CELL {
                // NaN compares false.
                least[x] = if pixels[x] < least[x] { pixels[x] } else { least[x] };
                most[x] = if pixels[x] > most[x] { pixels[x] } else { most[x] };
                unknown[x] += u32::from(pixels[x].is_nan());
            }
        }
        for x in 0..CELL {
            (low, high) = (low.min(least[x]), high.max(most[x]));
        }
        let count = (right - left) * (bottom - top);
        let holes = unknown.iter().sum::<u32>() - (CELL * CELL - count) as u32;
        // Split twice: a cell may have three surfaces.
        for _ in 0..2 {
            if high - low > MAX_CELL_RANGE {
                let middle = 0.5 * (low + high);
                let (mut above, mut least, mut below, mut most) = (0, high, 0, low);
                for &d in pixels.as_flattened() {
                    let (up, down) = (d > middle && d <= high, d <= middle && d >= low);
                    above += u32::from(up);
                    below += u32::from(down);
                    least = if up && d < least { d } else { least };
                    most = if down && d > most { d } else { most };
                }
                (low, high) = if above > below { (least, high) } else { (low, most) };
            }
        }
        let moments = Moments::of_cell(&pixels, (low, high));
        let count = count as f32;
        Self { moments, range: (low, high), gray: sum as f32 / count, texture: steps as f32 / count, holes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 84;
    const HEIGHT: usize = 60;

    fn segmented(d: impl Fn(usize, usize) -> f32, gray: u8) -> (Surfaces, Vec<f32>) {
        let disparity: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| d(i % WIDTH, i / WIDTH)).collect();
        let mut surfaces = Surfaces::default();
        surfaces.measure_cells(Level::new(), &disparity, &vec![gray; WIDTH * HEIGHT], WIDTH);
        surfaces.segment(0.0);
        (surfaces, disparity)
    }

    #[test]
    fn two_planes_are_two_surfaces() {
        // A road that rises by 0.4 px a row, and from column 40 on (a cell border) a wall in front of it.
        let road = |x: usize, y: usize| 5.0 + 0.4 * y as f32 - 0.05 * x as f32;
        let (surfaces, _) = segmented(|x, y| if x < 40 { road(x, y) } else { 45.0 + 0.1 * x as f32 }, 90);
        assert_eq!(surfaces.planes.len(), 2);
        for (c, &label) in surfaces.labels.iter().enumerate() {
            let (x, y) = center(c, surfaces.columns);
            let value = f64::from(surfaces.planes[label as usize].at(x, y));
            let truth = if x < 40.0 { 5.0 + 0.4 * y - 0.05 * x } else { 45.0 + 0.1 * x };
            // The ridge reduces the slope of thousands of pixels by a hundredth.
            assert!((value - truth).abs() < 0.1, "{x} {y}: {value} for {truth}");
        }
    }

    #[test]
    fn an_empty_map_has_no_surfaces_and_a_thin_structure_one() {
        assert!(segmented(|_, _| f32::NAN, 90).0.planes.is_empty());
        let (surfaces, _) = segmented(|x, _| if x == 20 { 7.0 } else { f32::NAN }, 90);
        assert_eq!(surfaces.planes.len(), 1);
        assert!((surfaces.planes[0].at(20.0, 30.0) - 7.0).abs() < 1e-3);
    }

    #[test]
    fn steps_of_a_textureless_road_become_a_slope() {
        // Whole pixels, as matches in low texture: errors of up to half a pixel, RMS 0.29.
        let road = |y: usize| 5.0 + 0.15 * y as f32;
        let (surfaces, mut disparity) = segmented(|_, y| road(y).round(), 90);
        surfaces.smooth_low_texture(&mut disparity, WIDTH);
        let squares: f32 = disparity.iter().enumerate().map(|(i, d)| (d - road(i / WIDTH)).powi(2)).sum();
        let off = (squares / disparity.len() as f32).sqrt();
        // Planes over forty rows, which have six steps, leave a third of it.
        assert!(off < 0.1, "{off}");
        // In texture, matches are kept.
        let textured: Vec<u8> = (0..WIDTH * HEIGHT).map(|i| (i % 2 * 40) as u8).collect();
        let mut surfaces = Surfaces::default();
        let steps: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| road(i / WIDTH).round()).collect();
        surfaces.measure_cells(Level::new(), &steps, &textured, WIDTH);
        surfaces.segment(0.0);
        let mut kept = steps.clone();
        surfaces.smooth_low_texture(&mut kept, WIDTH);
        assert_eq!(kept, steps);
    }

    #[test]
    fn a_row_of_a_plane_has_its_disparities() {
        let plane = Plane { origin: (3.5, 3.5), coefficients: [0.7, -1.3, 12.0], range: (10.0, 14.5) };
        for y in 0..CELL {
            let row = plane.row::<4, 2>(1, y);
            assert_eq!(row, std::array::from_fn(|i| plane.at((1 + 2 * i) as f64, y as f64)), "{y}");
        }
    }
}
