//! Multigrid on a composite grid: the fine levels only near the sources of a Poisson equation (fast adaptive composite grid method, McCormick 1989;
//! correction by the full approximation scheme, Trottenberg, Multigrid, §5.3 and §9.4).
//!
//! Away from its sources the solution is harmonic, and the farther away from them, the coarser the grid that represents it. The work is proportional to the
//! length of the seams and not to the area of the image, as in Agarwala, "Efficient gradient-domain compositing using quadtrees" (2007). Only cells near the
//! sources are stored.

use crate::blend::grid_edges::GridEdges;
use crate::blend::runs::{Runs, children, coarse_runs, dilated};
use crate::rows::is_check_due;
use cv_core::{Cancelled, Stage};
use std::ops::Range;

/// Unknowns of the three channels; the fourth is 1, or 0 outside the image.
pub(crate) type Pixel = [f32; 4];

/// V-cycles on the whole grid after the full multigrid start, of one sweep of red-black Gauss-Seidel before and after the coarse correction. Each reduces the
/// error by a factor of about ten.
pub(crate) const CYCLES: usize = 3;
/// Sweeps on the coarsest level, of a few cells.
const COARSEST_SWEEPS: usize = 8;
/// Distance in coarse cells from the sources to which a level is refined. What the coarser level then lacks is about a hundredth of the steps at the seams, and
/// smooth.
const RADIUS: usize = 3;

/// Sources of the equation: for each row the positions and right-hand sides, ascending.
pub(crate) type Sources = Vec<Vec<(usize, Pixel)>>;

/// Cells of a row that are solved for.
#[derive(Clone, Copy)]
struct Segment {
    start: usize,
    count: usize,
    /// Indices of the first cell and of those above and below it; itself where there are none.
    at: usize,
    above: usize,
    below: usize,
    /// Whether all edges of all cells have weight 1.
    is_uniform: bool,
}

/// Stored cells of a row of the coarser level with their children.
struct Piece {
    count: usize,
    /// Indices of the first cell and of those above and below it in the coarser level; itself where there are none.
    at: usize,
    above: usize,
    below: usize,
    /// Indices of the first child in its two rows; one row at the bottom of an image of odd height.
    children: [Option<usize>; 2],
    /// Number of children in a row.
    child_count: usize,
    /// The segments of the children, if they are solved for; else their values are interpolated.
    segments: Option<[usize; 2]>,
}

/// One level.
struct Level {
    width: usize,
    height: usize,
    screen: f32,
    /// Index of the first cell of each stored run, which has a cell of padding on both sides.
    stored: Vec<Vec<(Range<usize>, usize)>>,
    value: Vec<Pixel>,
    right_side: Vec<Pixel>,
    /// The values before the coarse correction.
    before: Vec<Pixel>,
    /// Weights of the edges to the right and below.
    right: Vec<f32>,
    down: Vec<f32>,
    segments: Vec<Segment>,
    /// Range of the segments of each row.
    rows: Vec<Range<usize>>,
    /// Link to the coarser level; empty on the coarsest.
    pieces: Vec<Piece>,
}

impl Level {
    /// Creates a level with the given stored and active runs of cells.
    fn new(edges: &GridEdges, screen: f32, stored: &Runs, active: &Runs) -> Self {
        let (width, height) = (edges.width, edges.height);
        let mut end = 0;
        let mut place = |run: &Range<usize>| {
            let at = end + 1;
            end = at + run.len() + 1;
            (run.clone(), at)
        };
        let stored: Vec<Vec<(Range<usize>, usize)>> =
            stored.iter().map(|row| row.iter().map(&mut place).collect()).collect();
        let mut level = Self {
            width,
            height,
            screen,
            stored,
            value: vec![[0.0; 4]; end],
            right_side: vec![[0.0; 4]; end],
            before: vec![[0.0; 4]; end],
            right: vec![0.0; end],
            down: vec![0.0; end],
            segments: Vec::new(),
            rows: Vec::with_capacity(height),
            pieces: Vec::new(),
        };
        for (y, row) in level.stored.iter().enumerate() {
            for (run, at) in row {
                let (cells, count) = (y * width + run.start..y * width + run.end, run.len());
                level.right[*at..at + count].copy_from_slice(&edges.right[cells.clone()]);
                level.down[*at..at + count].copy_from_slice(&edges.down[cells]);
                for (value, x) in level.value[*at..].iter_mut().zip(run.clone()) {
                    value[3] = f32::from(edges.total(x, y) > 0.0);
                }
            }
        }
        for (y, row) in active.iter().enumerate() {
            let first = level.segments.len();
            for run in row {
                let at = level.index(run.start, y);
                let above = if y > 0 { level.index(run.start, y - 1) } else { at };
                let below = if y + 1 < height { level.index(run.start, y + 1) } else { at };
                let is_uniform = run.clone().all(|x| edges.is_uniform(x, y));
                level.segments.push(Segment { start: run.start, count: run.len(), at, above, below, is_uniform });
            }
            level.rows.push(first..level.segments.len());
        }
        level
    }

    /// Returns the index of a stored cell; that of a cell of padding for others.
    fn index(&self, x: usize, y: usize) -> usize {
        let run = self.stored[y].iter().find(|(run, _)| run.contains(&x));
        run.map_or(0, |(run, at)| at + x - run.start)
    }

    /// Links the level to the coarser one, whose cells `refined` and `around` (these and those next to them) have stored children.
    fn link(&mut self, coarse: &Self, refined: &Runs, around: &Runs) {
        for (y, around) in around.iter().enumerate() {
            let rows = [Some(2 * y), Some(2 * y + 1).filter(|row| *row < self.height)];
            // Number of refined runs so far.
            let mut count = 0;
            for run in around {
                let inner = refined[y].iter().filter(|r| r.start >= run.start && r.end <= run.end).cloned();
                let mut start = run.start;
                for inner in inner.chain(std::iter::once(run.end..run.end)) {
                    for (part, is_refined) in [(start..inner.start, false), (inner.clone(), true)] {
                        if part.is_empty() {
                            continue;
                        }
                        let at = coarse.index(part.start, y);
                        let segments = rows.map(|row| row.map_or(0, |row| self.rows[row].start + count));
                        self.pieces.push(Piece {
                            count: part.len(),
                            at,
                            above: if y > 0 { coarse.index(part.start, y - 1) } else { at },
                            below: if y + 1 < coarse.height { coarse.index(part.start, y + 1) } else { at },
                            children: rows.map(|row| row.map(|row| self.index(2 * part.start, row))),
                            child_count: (2 * part.end).min(self.width) - 2 * part.start,
                            segments: is_refined.then_some(segments),
                        });
                        count += usize::from(is_refined);
                    }
                    start = inner.end;
                }
            }
        }
    }

    /// Performs one sweep of red-black Gauss-Seidel on the active cells: the black ones of a row after the red ones of the next.
    fn smooth(&mut self, stage: &Stage<'_>) -> Result<(), Cancelled> {
        for y in 0..=self.height {
            if is_check_due(y, self.width) {
                stage.check()?;
            }
            if y < self.height {
                self.relax_row(y, 0);
            }
            if y > 0 {
                self.relax_row(y - 1, 1);
            }
        }
        Ok(())
    }

    /// Solves for every second active cell of a row.
    fn relax_row(&mut self, y: usize, color: usize) {
        for segment in &self.segments[self.rows[y].clone()] {
            let Segment { start, count, at, above, below, is_uniform } = *segment;
            let first = (start + y + color) % 2;
            if is_uniform {
                let (head, rest) = self.value.split_at_mut(at - 1);
                let (row, tail) = rest.split_at_mut(count + 2);
                let (above, below) = (&head[above..above + count], &tail[below - at - count - 1..][..count]);
                let (b, factor) = (&self.right_side[at..at + count], 1.0 / (4.0 + self.screen));
                for k in (first..count).step_by(2) {
                    let (left, right) = (row[k], row[k + 2]);
                    let mean: Pixel = std::array::from_fn(|c| {
                        ((above[k][c] + below[k][c]) + (left[c] + right[c]) + b[k][c]) * factor
                    });
                    row[k + 1] = [mean[0], mean[1], mean[2], 1.0];
                }
            } else {
                for k in (first..count).step_by(2) {
                    let (total, sum) = self.stencil(at + k, above + k, below + k);
                    let (v, b, factor) = (self.value[at + k], self.right_side[at + k], 1.0 / (total + self.screen));
                    if v[3] > 0.0 {
                        let [r, g, b, _]: Pixel = std::array::from_fn(|c| (b[c] + sum[c]) * factor);
                        self.value[at + k] = [r, g, b, 1.0];
                    }
                }
            }
        }
    }

    /// Returns the sum of the edge weights of a cell and the weighted sum of its neighbors.
    fn stencil(&self, i: usize, above: usize, below: usize) -> (f32, Pixel) {
        let up = if above == i { 0.0 } else { self.down[above] };
        let weights = [self.right[i], self.right[i - 1], self.down[i], up];
        let values = [self.value[i + 1], self.value[i - 1], self.value[below], self.value[above]];
        let sum = |c: usize| {
            (weights[0] * values[0][c] + weights[1] * values[1][c])
                + (weights[2] * values[2][c] + weights[3] * values[3][c])
        };
        ((weights[0] + weights[1]) + (weights[2] + weights[3]), std::array::from_fn(sum))
    }

    /// Appends the residuals of consecutive cells, given the indices of the first one and of those above and below it.
    fn residuals(
        &self,
        (at, above, below): (usize, usize, usize),
        count: usize,
        is_uniform: bool,
        out: &mut Vec<Pixel>,
    ) {
        if is_uniform {
            let row = &self.value[at - 1..at + count + 1];
            let (above, below) = (&self.value[above..above + count], &self.value[below..below + count]);
            let (b, total) = (&self.right_side[at..at + count], 4.0 + self.screen);
            out.extend((0..count).map(|k| -> Pixel {
                std::array::from_fn(|c| {
                    (above[k][c] + below[k][c]) + (row[k][c] + row[k + 2][c]) + b[k][c] - total * row[k + 1][c]
                })
            }));
            return;
        }
        out.extend((0..count).map(|k| {
            let (total, sum) = self.stencil(at + k, above + k, below + k);
            let (v, b) = (self.value[at + k], self.right_side[at + k]);
            if v[3] == 0.0 {
                return [0.0; 4];
            }
            std::array::from_fn(|c| b[c] + sum[c] - (total + self.screen) * v[c])
        }));
    }

    /// Fills a row: the active cells with their values, the others with values interpolated from the rows of the coarser level next to it.
    fn fill_row(&self, y: usize, [near, far]: [&[Pixel]; 2], columns: &mut Vec<Pixel>, out: &mut [Pixel]) {
        columns.clear();
        columns.extend(near.iter().zip(far).map(|(n, f)| blend(n, f)));
        for (k, out) in out.chunks_mut(2).enumerate() {
            out.iter_mut().zip(interpolated_pair(columns, k)).for_each(|(out, value)| *out = value);
        }
        for s in &self.segments[self.rows[y].clone()] {
            out[s.start..s.start + s.count].copy_from_slice(&self.value[s.at..s.at + s.count]);
        }
    }
}

/// Interpolates between the centers of cells at a quarter of their distance.
#[inline(always)]
fn blend(near: &Pixel, far: &Pixel) -> Pixel {
    std::array::from_fn(|c| 0.75 * near[c] + 0.25 * far[c])
}

/// Returns the values at the two children of cell `k` in a row whose first cell is `columns[1]`; outside the image only 0.
#[inline(always)]
fn interpolated_pair(columns: &[Pixel], k: usize) -> [Pixel; 2] {
    [&columns[k], &columns[k + 2]].map(|far| {
        let sum = blend(&columns[k + 1], far);
        // The weight of the cells inside the image.
        let factor = if sum[3] > 0.0 { 1.0 / sum[3] } else { 0.0 };
        sum.map(|s| s * factor)
    })
}

/// A composite grid, the finest level first.
pub(crate) struct CompositeGrid {
    levels: Vec<Level>,
    /// All values of the second level, row by row with a cell of padding on both sides.
    coarse_values: Vec<Pixel>,
}

impl CompositeGrid {
    /// Creates the levels for a right-hand side at the sources; `screen` is the weight of the screening term.
    pub(crate) fn new(finest: GridEdges, sources: &Sources, screen: f32, stage: &Stage<'_>) -> Result<Self, Cancelled> {
        let single = |row: &Vec<(usize, Pixel)>| row.iter().map(|(x, _)| *x..x + 1).collect();
        let mut near: Runs = sources.iter().map(single).collect();
        let mut levels: Vec<Level> = Vec::new();
        // The refined cells of the level and those around them.
        let mut refinement: Option<(Runs, Runs)> = None;
        let (mut edges, mut screen) = (finest, screen);
        loop {
            // Coarsened to a few cells, which a few sweeps solve.
            let coarse = if edges.width.max(edges.height) > 2 { Some(edges.coarser(stage)?) } else { None };
            let next = coarse.as_ref().map(|coarse| {
                near = coarse_runs(&near);
                (dilated(&near, coarse.width, RADIUS), dilated(&near, coarse.width, RADIUS + 1))
            });
            let size = (edges.width, edges.height);
            let level = match &next {
                Some((refined, around)) => {
                    Level::new(&edges, screen, &children(around, size), &children(refined, size))
                }
                None => {
                    let all: Runs = vec![std::iter::once(0..edges.width).collect(); edges.height];
                    Level::new(&edges, screen, &all, &all)
                }
            };
            if let (Some(fine), Some((refined, around))) = (levels.last_mut(), &refinement) {
                fine.link(&level, refined, around);
            }
            levels.push(level);
            let Some(coarse) = coarse else { break };
            // A cell represents four of the finer level.
            (edges, screen, refinement) = (coarse, 4.0 * screen, next);
        }
        let finest = &mut levels[0];
        for (y, row) in sources.iter().enumerate() {
            for (x, right_side) in row {
                let i = finest.index(*x, y);
                finest.right_side[i] = *right_side;
            }
        }
        Ok(Self { levels, coarse_values: Vec::new() })
    }

    /// Solves the equation; one unit of `stage` per cycle.
    pub(crate) fn solve(&mut self, stage: &Stage<'_>) -> Result<(), Cancelled> {
        let count = self.levels.len();
        for level in 1..count {
            let (fine, coarse) = self.levels.split_at_mut(level);
            restrict_sources(&fine[level - 1], &mut coarse[0]);
        }
        for level in (0..count).rev() {
            if let [fine, coarse, ..] = &mut self.levels[level..] {
                prolong(fine, coarse, false);
            }
            for _ in 0..if level == 0 { CYCLES } else { 1 } {
                cycle(&mut self.levels[level..], stage)?;
                stage.add(usize::from(level == 0))?;
            }
        }
        // All values of each level but the finest, from coarse to fine.
        let mut columns = Vec::new();
        for level in (1..count).rev() {
            let fine = &self.levels[level];
            let stride = fine.width + 2;
            let mut values = vec![[0.0; 4]; stride * fine.height];
            for (y, row) in values.chunks_mut(stride).enumerate() {
                if is_check_due(y, stride) {
                    stage.check()?;
                }
                self.fill(level, y, &mut columns, &mut row[1..=fine.width]);
            }
            self.coarse_values = values;
        }
        Ok(())
    }

    /// Writes the solution of a row of the finest level. `columns` is a buffer.
    pub(crate) fn row(&self, y: usize, columns: &mut Vec<Pixel>, out: &mut [Pixel]) {
        self.fill(0, y, columns, out);
    }

    /// Fills a row of a level from the values of the next.
    fn fill(&self, level: usize, y: usize, columns: &mut Vec<Pixel>, out: &mut [Pixel]) {
        let fine = &self.levels[level];
        let Some(coarse) = self.levels.get(level + 1) else {
            let s = fine.segments[fine.rows[y].start];
            out.copy_from_slice(&fine.value[s.at..s.at + s.count]);
            return;
        };
        let near = y / 2;
        let far = if y.is_multiple_of(2) { near.saturating_sub(1) } else { (near + 1).min(coarse.height - 1) };
        let stride = coarse.width + 2;
        let rows = [near, far].map(|y| &self.coarse_values[y * stride..(y + 1) * stride]);
        fine.fill_row(y, rows, columns, out);
    }
}

/// Performs one V-cycle on the first of `levels`.
fn cycle(levels: &mut [Level], stage: &Stage<'_>) -> Result<(), Cancelled> {
    let Some((fine, coarser)) = levels.split_first_mut() else { return Ok(()) };
    let Some(coarse) = coarser.first_mut() else {
        return (0..COARSEST_SWEEPS).try_for_each(|_| fine.smooth(stage));
    };
    fine.smooth(stage)?;
    restrict(fine, coarse);
    cycle(coarser, stage)?;
    prolong(fine, &coarser[0], true);
    fine.smooth(stage)
}

/// Sets the refined cells of the coarse level to the means of their children, and their right-hand sides so that the coarse level corrects the residuals
/// of the fine one (sums over the children).
fn restrict(fine: &Level, coarse: &mut Level) {
    let (mut residuals, mut sums) = (Vec::new(), Vec::new());
    for piece in &fine.pieces {
        let Some(segments) = piece.segments else { continue };
        let first = sums.len();
        sums.resize(first + piece.count, [[0.0; 4]; 2]);
        let sums = &mut sums[first..];
        for (segment, child) in segments.into_iter().zip(piece.children) {
            if child.is_none() {
                continue;
            }
            let s = &fine.segments[segment];
            residuals.clear();
            fine.residuals((s.at, s.above, s.below), s.count, s.is_uniform, &mut residuals);
            let values = fine.value[s.at..s.at + s.count].chunks(2);
            for ((sums, residuals), values) in sums.iter_mut().zip(residuals.chunks(2)).zip(values) {
                for (r, v) in residuals.iter().zip(values) {
                    *sums = [std::array::from_fn(|c| sums[0][c] + v[c]), std::array::from_fn(|c| sums[1][c] + r[c])];
                }
            }
        }
        for (value, [sum, _]) in coarse.value[piece.at..].iter_mut().zip(sums) {
            // The number of children inside the image.
            let factor = if sum[3] > 0.0 { value[3] / sum[3] } else { 0.0 };
            let [r, g, b, _] = sum.map(|s| s * factor);
            *value = [r, g, b, value[3]];
        }
    }
    let mut sums = &sums[..];
    for piece in &fine.pieces {
        let cells = piece.at..piece.at + piece.count;
        for (before, [r, g, b, _]) in coarse.before[cells.clone()].iter_mut().zip(&coarse.value[cells.clone()]) {
            // The change then has the weight of the value.
            *before = [*r, *g, *b, 0.0];
        }
        if piece.segments.is_some() {
            let (own, rest) = sums.split_at(piece.count);
            sums = rest;
            coarse.right_side[cells.clone()].fill([0.0; 4]);
            residuals.clear();
            coarse.residuals((piece.at, piece.above, piece.below), piece.count, false, &mut residuals);
            for ((b, [_, sum]), r) in coarse.right_side[cells].iter_mut().zip(own).zip(&residuals) {
                *b = std::array::from_fn(|c| sum[c] - r[c]);
            }
        }
    }
}

/// Interpolates the coarse level to the active cells of the fine one and those around them; to the active ones only adds the change since
/// [`restrict`] if `is_correction`.
fn prolong(fine: &mut Level, coarse: &Level, is_correction: bool) {
    let mut columns = Vec::new();
    for piece in &fine.pieces {
        let adds = is_correction && piece.segments.is_some();
        let rows = piece.children.iter().zip([piece.above, piece.below]);
        for (child, far) in rows.filter_map(|(child, far)| Some(((*child)?, far))) {
            columns.clear();
            let (near, far) = (piece.at - 1..piece.at + piece.count + 1, far - 1..far + piece.count + 1);
            let values = coarse.value[near.clone()].iter().zip(&coarse.value[far.clone()]);
            if adds {
                let before = coarse.before[near].iter().zip(&coarse.before[far]);
                let change = |v: &Pixel, b: &Pixel| -> Pixel { std::array::from_fn(|c| v[c] - b[c]) };
                let changes = values.zip(before).map(|((n, f), (n0, f0))| blend(&change(n, n0), &change(f, f0)));
                columns.extend(changes);
            } else {
                columns.extend(values.map(|(n, f)| blend(n, f)));
            }
            for (k, out) in fine.value[child..child + piece.child_count].chunks_mut(2).enumerate() {
                for (out, value) in out.iter_mut().zip(interpolated_pair(&columns, k)) {
                    let (inside, kept) = (out[3], if adds { 1.0 } else { 0.0 });
                    let [r, g, b, _]: Pixel = std::array::from_fn(|c| kept * out[c] + inside * value[c]);
                    *out = [r, g, b, inside];
                }
            }
        }
    }
}

/// Restricts the right-hand side by the transposed interpolation: it preserves the moments of the dipoles along the seams, which sums over the children
/// do not.
fn restrict_sources(fine: &Level, coarse: &mut Level) {
    for piece in fine.pieces.iter().filter(|piece| piece.segments.is_some()) {
        for (child, far) in piece.children.into_iter().zip([piece.above, piece.below]) {
            let Some(child) = child else { continue };
            for (k, b) in fine.right_side[child..child + piece.child_count].iter().enumerate() {
                if b[..3] == [0.0; 3] {
                    continue;
                }
                let side = if k % 2 == 0 { -1 } else { 1 };
                let beside = |i: usize| (i + k / 2).wrapping_add_signed(side);
                let cells = [(piece.at + k / 2, 9.0), (beside(piece.at), 3.0), (far + k / 2, 3.0), (beside(far), 1.0)];
                let cells = cells.map(|(i, weight)| (i, weight * coarse.value[i][3]));
                let total = cells.iter().map(|(_, weight)| weight).sum::<f32>();
                for (i, weight) in cells.into_iter().filter(|_| total > 0.0) {
                    let sum = &mut coarse.right_side[i];
                    *sum = std::array::from_fn(|c| sum[c] + weight / total * b[c]);
                }
            }
        }
    }
}
