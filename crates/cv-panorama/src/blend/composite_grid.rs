//! Multigrid on a composite grid: the fine levels only near the sources of a Poisson equation (fast adaptive composite grid method, McCormick 1989;
//! correction by the full approximation scheme, Trottenberg, Multigrid, §5.3 and §9.4).
//!
//! Away from its sources the solution is harmonic, and the coarser the grid, the farther away from them it is accurate enough. The work is proportional to the
//! length of the seams and not to the area of the image, as in Agarwala, "Efficient gradient-domain compositing using quadtrees" (2007).

use crate::rows::is_check_due;
use cv_core::{Cancelled, Stage};
use std::ops::Range;

/// Unknowns of the three channels; the fourth is padding.
pub(crate) type Pixel = [f32; 4];

/// Smoothing sweeps before and after each coarse correction, red-black Gauss-Seidel.
const SWEEPS: usize = 1;
/// V-cycles. Each reduces the error by a factor of about ten.
pub(crate) const CYCLES: usize = 5;
/// Distance in coarse cells from the sources to which a level is refined.
const RADIUS: usize = 6;

/// Runs of cells of each row, ascending and disjoint.
type Runs = Vec<Vec<Range<usize>>>;

/// One level: unknowns, right-hand side, and the weights of the edges to the right and below (zero where there is none), with a row of padding above
/// and below.
pub(crate) struct Level {
    width: usize,
    height: usize,
    pub(crate) value: Vec<Pixel>,
    pub(crate) right_side: Vec<Pixel>,
    pub(crate) right: Vec<f32>,
    pub(crate) down: Vec<f32>,
    screen: f32,
    /// The cells on which the equation of this level is solved: all of the coarsest level, those near the sources on finer ones.
    active: Runs,
    /// Link to the finer level; none on the finest.
    finer: Option<Finer>,
}

/// What a level knows of the finer one.
struct Finer {
    /// The cells whose children are active.
    refined: Vec<bool>,
    /// The refined cells and one cell around them.
    around: Runs,
    /// The values before the coarse correction.
    before: Vec<Pixel>,
    /// 1 for cells with edges, 0 for others.
    inside: Vec<f32>,
}

impl Level {
    /// Creates a level without edges and sources.
    pub(crate) fn new(width: usize, height: usize, screen: f32) -> Self {
        let n = width * (height + 2);
        // Zeroed pages that are never written take no memory.
        let (value, right_side) = (vec![[0.0; 4]; n], vec![[0.0; 4]; n]);
        let (right, down) = (vec![0.0; n], vec![0.0; n]);
        Self { width, height, value, right_side, right, down, screen, active: Vec::new(), finer: None }
    }

    /// Returns the index of the first cell of a row.
    pub(crate) fn row(&self, y: usize) -> usize {
        (y + 1) * self.width
    }

    /// Coarsens to half resolution. The weight of an edge between two cells is half the sum of the fine edges between them (number over doubled distance).
    fn coarser(&self, stage: &Stage<'_>) -> Result<Self, Cancelled> {
        let (w, h) = (self.width.div_ceil(2), self.height.div_ceil(2));
        // A cell represents four pixels.
        let mut coarse = Self::new(w, h, 4.0 * self.screen);
        for y in 0..self.height {
            if is_check_due(y, self.width) {
                stage.check()?;
            }
            let (fine, out) = (self.row(y)..self.row(y) + self.width, coarse.row(y / 2)..coarse.row(y / 2) + w);
            for (out, pair) in coarse.right[out.clone()].iter_mut().zip(self.right[fine.clone()].chunks(2)) {
                *out += 0.5 * pair.get(1).copied().unwrap_or(0.0);
            }
            if y % 2 == 1 {
                for (out, pair) in coarse.down[out].iter_mut().zip(self.down[fine].chunks(2)) {
                    *out += 0.5 * pair.iter().sum::<f32>();
                }
            }
        }
        Ok(coarse)
    }

    /// Returns the sum of the edge weights of a cell and the weighted sum of its neighbors.
    fn stencil(&self, i: usize) -> (f32, Pixel) {
        let w = self.width;
        let weights = [self.right[i], self.right[i - 1], self.down[i], self.down[i - w]];
        let values = [self.value[i + 1], self.value[i - 1], self.value[i + w], self.value[i - w]];
        let sum = |c: usize| {
            (weights[0] * values[0][c] + weights[1] * values[1][c])
                + (weights[2] * values[2][c] + weights[3] * values[3][c])
        };
        ((weights[0] + weights[1]) + (weights[2] + weights[3]), std::array::from_fn(sum))
    }

    /// Performs one sweep of red-black Gauss-Seidel on the active cells.
    fn smooth(&mut self, stage: &Stage<'_>) -> Result<(), Cancelled> {
        for (color, y) in (0..2).flat_map(|color| (0..self.height).map(move |y| (color, y))) {
            if is_check_due(y, self.width) {
                stage.check()?;
            }
            for run in 0..self.active[y].len() {
                let Range { start, end } = self.active[y][run];
                let first = start + (start + y + color) % 2;
                for i in (self.row(y) + first..self.row(y) + end).step_by(2) {
                    let (total, sum) = self.stencil(i);
                    // Isolated cells are not corrected.
                    if total > 0.0 {
                        let (b, factor) = (self.right_side[i], 1.0 / (total + self.screen));
                        self.value[i] = std::array::from_fn(|c| (b[c] + sum[c]) * factor);
                    }
                }
            }
        }
        Ok(())
    }

    /// Returns the residual of a cell.
    fn residual(&self, i: usize) -> Pixel {
        let ((total, sum), v, b) = (self.stencil(i), self.value[i], self.right_side[i]);
        if total == 0.0 {
            return [0.0; 4];
        }
        std::array::from_fn(|c| b[c] + sum[c] - (total + self.screen) * v[c])
    }

    /// Returns the value at a cell of the finer level, interpolated bilinearly by `value` between the centers of the cells inside the image; `None`
    /// if there are none.
    fn interpolated(&self, x: usize, y: usize, inside: &[f32], value: impl Fn(usize) -> Pixel) -> Option<Pixel> {
        let place = |v: usize, n: usize| {
            let near = v / 2;
            let far = if v.is_multiple_of(2) { near.saturating_sub(1) } else { (near + 1).min(n - 1) };
            (near, far)
        };
        let ((x0, x1), (y0, y1)) = (place(x, self.width), place(y, self.height));
        let (mut total, mut sum) = (0.0, [0.0_f32; 4]);
        for (i, weight) in
            [(self.row(y0) + x0, 9.0), (self.row(y0) + x1, 3.0), (self.row(y1) + x0, 3.0), (self.row(y1) + x1, 1.0)]
        {
            let (weight, v) = (weight * inside[i], value(i));
            total += weight;
            sum = std::array::from_fn(|c| sum[c] + weight * v[c]);
        }
        (total > 0.0).then(|| sum.map(|s| s / total))
    }
}

/// A composite grid, the finest level first.
pub(crate) struct CompositeGrid {
    levels: Vec<Level>,
}

impl CompositeGrid {
    /// Creates the coarser levels; `sources` are the cells of each row with a right-hand side, ascending.
    pub(crate) fn new(finest: Level, sources: &[Vec<usize>], stage: &Stage<'_>) -> Result<Self, Cancelled> {
        let mut sources: Runs = sources.iter().map(|row| runs_of(row.iter().map(|x| *x..x + 1).collect())).collect();
        let mut levels = vec![finest];
        // Coarsened to a few cells, which a few sweeps solve.
        while let Some(fine) = levels.last_mut()
            && fine.width.max(fine.height) > 2
        {
            let mut coarse = fine.coarser(stage)?;
            sources = coarse_runs(&sources);
            let refined_runs = dilated(&sources, coarse.width, RADIUS);
            let mut refined = vec![false; coarse.value.len()];
            for (y, row) in refined_runs.iter().enumerate() {
                row.iter().for_each(|r| refined[coarse.row(y) + r.start..coarse.row(y) + r.end].fill(true));
            }
            let width = fine.width;
            let children = |y: usize| refined_runs[y / 2].iter().map(|r| 2 * r.start..(2 * r.end).min(width)).collect();
            fine.active = (0..fine.height).map(children).collect();
            let mut inside = vec![0.0; coarse.value.len()];
            for i in coarse.row(0)..coarse.row(coarse.height) {
                inside[i] = if coarse.stencil(i).0 > 0.0 { 1.0 } else { 0.0 };
            }
            let around = dilated(&sources, coarse.width, RADIUS + 1);
            coarse.finer = Some(Finer { refined, around, before: vec![[0.0; 4]; coarse.value.len()], inside });
            levels.push(coarse);
        }
        if let Some(coarsest) = levels.last_mut() {
            coarsest.active = vec![std::iter::once(0..coarsest.width).collect(); coarsest.height];
        }
        Ok(Self { levels })
    }

    /// Solves the equation; one unit of `stage` per cycle.
    pub(crate) fn solve(&mut self, stage: &Stage<'_>) -> Result<(), Cancelled> {
        for _ in 0..CYCLES {
            cycle(&mut self.levels, stage)?;
            stage.add(1)?;
        }
        // Values outside the active cells, of all but the finest level.
        for level in (1..self.levels.len().saturating_sub(1)).rev() {
            let (fine, coarse) = self.levels.split_at_mut(level + 1);
            let (fine, coarse) = (&mut fine[level], &coarse[0]);
            let Some(finer) = &coarse.finer else { continue };
            for y in 0..fine.height {
                if is_check_due(y, fine.width) {
                    stage.check()?;
                }
                for x in 0..fine.width {
                    if !finer.refined[coarse.row(y / 2) + x / 2] {
                        let value = coarse.interpolated(x, y, &finer.inside, |i| coarse.value[i]);
                        let i = fine.row(y) + x;
                        fine.value[i] = value.unwrap_or_default();
                    }
                }
            }
        }
        Ok(())
    }

    /// Returns the solution at a cell of the finest level.
    pub(crate) fn value(&self, x: usize, y: usize) -> Pixel {
        let finest = &self.levels[0];
        match self.levels.get(1).and_then(|coarse| Some((coarse, coarse.finer.as_ref()?))) {
            Some((coarse, finer)) if !finer.refined[coarse.row(y / 2) + x / 2] => {
                coarse.interpolated(x, y, &finer.inside, |i| coarse.value[i]).unwrap_or_default()
            }
            _ => finest.value[finest.row(y) + x],
        }
    }
}

/// Performs one V-cycle on the first of `levels`.
fn cycle(levels: &mut [Level], stage: &Stage<'_>) -> Result<(), Cancelled> {
    let Some((fine, coarser)) = levels.split_first_mut() else { return Ok(()) };
    let Some(coarse) = coarser.first_mut() else {
        for _ in 0..8 {
            fine.smooth(stage)?;
        }
        return Ok(());
    };
    for _ in 0..SWEEPS {
        fine.smooth(stage)?;
    }
    restrict(fine, coarse);
    cycle(coarser, stage)?;
    correct(fine, &coarser[0]);
    for _ in 0..SWEEPS {
        fine.smooth(stage)?;
    }
    Ok(())
}

/// Calls `work` for the children of a cell: their indices and coordinates.
fn for_children(fine: &Level, x: usize, y: usize, mut work: impl FnMut(usize, usize, usize)) {
    for fine_y in 2 * y..(2 * y + 2).min(fine.height) {
        for fine_x in 2 * x..(2 * x + 2).min(fine.width) {
            work(fine.row(fine_y) + fine_x, fine_x, fine_y);
        }
    }
}

/// Sets the refined cells of the coarse level to the means of their children, and their right-hand sides so that the coarse level corrects the residuals
/// of the fine one (sums over the children).
fn restrict(fine: &Level, coarse: &mut Level) {
    let Some(mut finer) = coarse.finer.take() else { return };
    for (y, runs) in finer.around.iter().enumerate() {
        for x in runs.iter().cloned().flatten() {
            let i = coarse.row(y) + x;
            if finer.refined[i] {
                let (mut n, mut sum) = (0.0, [0.0; 4]);
                for_children(fine, x, y, |child, _, _| {
                    let weight = if fine.stencil(child).0 > 0.0 { 1.0 } else { 0.0 };
                    n += weight;
                    let v = fine.value[child];
                    sum = std::array::from_fn(|c| sum[c] + weight * v[c]);
                });
                coarse.value[i] = if n > 0.0 { sum.map(|s| s / n) } else { [0.0; 4] };
            }
        }
    }
    for (y, runs) in finer.around.iter().enumerate() {
        for x in runs.iter().cloned().flatten() {
            let i = coarse.row(y) + x;
            finer.before[i] = coarse.value[i];
            if finer.refined[i] {
                coarse.right_side[i] = [0.0; 4];
                let mut sum = coarse.residual(i).map(|r| -r);
                for_children(fine, x, y, |child, _, _| {
                    let r = fine.residual(child);
                    sum = std::array::from_fn(|c| sum[c] + r[c]);
                });
                coarse.right_side[i] = sum;
            }
        }
    }
    coarse.finer = Some(finer);
}

/// Adds the change of the coarse level to the active cells of the fine one, and sets the cells around them to the coarse values, both interpolated.
fn correct(fine: &mut Level, coarse: &Level) {
    let Some(finer) = &coarse.finer else { return };
    let change = |i: usize| -> Pixel { std::array::from_fn(|c| coarse.value[i][c] - finer.before[i][c]) };
    let (width, height) = (fine.width, fine.height);
    for (y, runs) in finer.around.iter().enumerate() {
        for x in runs.iter().cloned().flatten() {
            let is_refined = finer.refined[coarse.row(y) + x];
            for fine_y in 2 * y..(2 * y + 2).min(height) {
                for fine_x in 2 * x..(2 * x + 2).min(width) {
                    let i = fine.row(fine_y) + fine_x;
                    if is_refined {
                        if let Some(change) = coarse.interpolated(fine_x, fine_y, &finer.inside, change) {
                            fine.value[i] = std::array::from_fn(|c| fine.value[i][c] + change[c]);
                        }
                    } else {
                        let value = coarse.interpolated(fine_x, fine_y, &finer.inside, |i| coarse.value[i]);
                        fine.value[i] = value.unwrap_or_default();
                    }
                }
            }
        }
    }
}

/// Joins overlapping and adjacent runs.
fn runs_of(mut runs: Vec<Range<usize>>) -> Vec<Range<usize>> {
    runs.sort_unstable_by_key(|r| r.start);
    let mut joined: Vec<Range<usize>> = Vec::with_capacity(runs.len());
    for run in runs {
        match joined.last_mut() {
            Some(last) if run.start <= last.end => last.end = last.end.max(run.end),
            _ => joined.push(run),
        }
    }
    joined
}

/// Returns the runs of the cells of half resolution with one of these cells.
fn coarse_runs(rows: &Runs) -> Runs {
    let coarse =
        |pair: &[Vec<Range<usize>>]| runs_of(pair.iter().flatten().map(|r| r.start / 2..r.end.div_ceil(2)).collect());
    rows.chunks(2).map(coarse).collect()
}

/// Returns the runs of the cells at most `radius` cells away along both axes.
fn dilated(rows: &Runs, width: usize, radius: usize) -> Runs {
    let near = |y: usize| {
        let rows = &rows[y.saturating_sub(radius)..(y + radius + 1).min(rows.len())];
        runs_of(rows.iter().flatten().map(|r| r.start.saturating_sub(radius)..(r.end + radius).min(width)).collect())
    };
    (0..rows.len()).map(near).collect()
}
