//! X-corners put together to grids.
//!
//! Each corner looks along its four edges for the nearest corner whose colors are the other way round; where two choose each other, and the edge between them has black and white on its two sides,
//! they are neighbors. What hangs together is a grid. Places that are then still empty are looked up where their neighbors say that they lie (A. Geiger et al., "Automatic camera and range
//! sensor calibration using a single shot", ICRA 2012, grow their boards so, row by row).

use super::saddle::saddle;
use super::x_corner::{XCorner, edges};
use cv_core::{Cancelled, ImageView, Point2, Stage, Vector2};
use cv_imgproc::sample_bilinear;
use rayon::prelude::*;
use std::collections::{HashMap, VecDeque};
use std::f64::consts::{PI, TAU};

/// Most corners that a corner looks at for its neighbors.
const LOOKED_AT: usize = 80;

/// How exact places of a growing grid are, in pixels.
const ROUGH: f64 = 0.1;

/// A place of a grid.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Node {
    pub(crate) corner: XCorner,
    /// Quarter turns from the corner's own first edge to the columns of the grid. Even: the square between the grid's +x and +y is white.
    pub(crate) turns: usize,
}

/// Corners by column and row. The axes have no beginning: negative numbers occur.
#[derive(Debug, Clone, Default)]
pub(crate) struct Grid {
    pub(crate) nodes: HashMap<(i32, i32), Node>,
}

const STEPS: [(i32, i32); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];

/// Angle of local direction `k` (0 to 3, clockwise) of a corner.
fn direction(corner: &XCorner, k: usize) -> f64 {
    corner.axes[k & 1] + if k & 2 == 0 { 0.0 } else { PI }
}

/// Smallest angle between two lines.
fn between_lines(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(PI);
    d.min(PI - d)
}

/// Smallest angle between two directions.
fn between(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(TAU);
    d.min(TAU - d)
}

/// Corners by cells of the picture.
struct Buckets {
    side: f64,
    columns: usize,
    rows: usize,
    cells: Vec<Vec<u32>>,
}

impl Buckets {
    fn new(corners: &[XCorner], (w, h): (usize, usize)) -> Self {
        let side = ((w * h) as f64 / corners.len().max(1) as f64).sqrt().max(8.0);
        let (columns, rows) = ((w as f64 / side) as usize + 1, (h as f64 / side) as usize + 1);
        let mut cells = vec![Vec::new(); columns * rows];
        let mut buckets = Self { side, columns, rows, cells: Vec::new() };
        for (i, corner) in corners.iter().enumerate() {
            let (x, y) = buckets.cell(corner.position);
            cells[y * columns + x].push(i as u32);
        }
        buckets.cells = cells;
        buckets
    }

    fn cell(&self, p: Point2<f64>) -> (usize, usize) {
        let at = |v: f64, n: usize| ((v / self.side).max(0.0) as usize).min(n - 1);
        (at(p.x, self.columns), at(p.y, self.rows))
    }

    /// Calls `visit` with corners from near to far (by rings of cells), with the distance below which none is left out, until it says stop.
    fn around(&self, p: Point2<f64>, mut visit: impl FnMut(usize) -> bool, mut after: impl FnMut(f64) -> bool) {
        let (cx, cy) = self.cell(p);
        for k in 0..self.columns.max(self.rows) {
            let (x0, x1) = (cx as isize - k as isize, cx as isize + k as isize);
            let (y0, y1) = (cy as isize - k as isize, cy as isize + k as isize);
            for y in y0.max(0)..=y1.min(self.rows as isize - 1) {
                let whole = y == y0 || y == y1;
                let step = if whole || k == 0 { 1 } else { 2 * k };
                for x in (x0..=x1).step_by(step).filter(|&x| x >= 0 && x < self.columns as isize) {
                    for &i in &self.cells[y as usize * self.columns + x as usize] {
                        if !visit(i as usize) {
                            return;
                        }
                    }
                }
            }
            // All within k cells of the own one have been seen.
            if !after(k as f64 * self.side) {
                return;
            }
        }
    }
}

/// Whether the straight line between two corners has white on one side and black on the other, all along: white clockwise of its direction where `clockwise`.
fn is_edge(view: ImageView<'_, f32, 1>, from: Point2<f64>, to: Point2<f64>, clockwise: bool, contrast: f32) -> bool {
    let along = to - from;
    let length = along.norm();
    let across = Vector2::new(-along.y, along.x) / length * (0.15 * length).clamp(1.5, 12.0);
    let sign = if clockwise { 1.0 } else { -1.0 };
    let (mut sum, mut n) = (0.0f32, 0);
    for t in [0.3, 0.4, 0.5, 0.6, 0.7] {
        let middle = from + along * t;
        let at = |p: Point2<f64>| sample_bilinear(view, p.x, p.y).map(|[v]| v);
        let (Some(a), Some(b)) = (at(middle + across), at(middle - across)) else { return false };
        let d = sign * (a - b);
        if d < 0.1 * contrast {
            return false;
        }
        sum += d;
        n += 1;
    }
    sum >= 0.3 * contrast * n as f32
}

/// The chosen neighbor of each of a corner's four directions: its index, and its direction that points back.
type Chosen = [Option<(usize, usize)>; 4];

/// For each corner its nearest neighbor along each of its four directions.
fn choose(corners: &[XCorner], view: ImageView<'_, f32, 1>, stage: &Stage<'_>) -> Result<Vec<Chosen>, Cancelled> {
    let buckets = Buckets::new(corners, view.size());
    let axes: Vec<[Vector2<f64>; 2]> = corners.iter().map(|c| c.axes.map(|a| Vector2::new(a.cos(), a.sin()))).collect();
    (0..corners.len())
        .into_par_iter()
        .with_min_len(64)
        .map(|i| {
            if i % 256 == 0 {
                stage.check()?;
            }
            Ok(chosen_by(i, corners, &axes, &buckets, view))
        })
        .collect()
}

/// The sine of 23°: how far the next corner may lie off an edge's direction, and the edges of two neighbors off the line between them. A direction is known to some 10°, and
/// bends from one corner to the next by as much under a fisheye.
const OFF: f64 = 0.39;
/// The sine of 40°, for the edges across, which perspective turns against each other too.
const OFF_ACROSS: f64 = 0.64;

fn chosen_by(
    i: usize,
    corners: &[XCorner],
    axes: &[[Vector2<f64>; 2]],
    buckets: &Buckets,
    view: ImageView<'_, f32, 1>,
) -> Chosen {
    let (corner, own) = (&corners[i], axes[i]);
    // Cost, index.
    let best = std::cell::Cell::new([None::<(f64, usize)>; 4]);
    let mut looked_at = 0;
    let visit = |j: usize| {
        looked_at += usize::from(i != j);
        let (other, theirs) = (&corners[j], axes[j]);
        let d = other.position - corner.position;
        let distance = d.norm();
        if i == j || distance < (0.9 * corner.radius.min(other.radius)).max(3.0) {
            return looked_at < LOOKED_AT;
        }
        let off = own.map(|a| a.perp(&d).abs() / distance);
        let axis = usize::from(off[1] < off[0]);
        let k = axis + if own[axis].dot(&d) < 0.0 { 2 } else { 0 };
        let cost = distance * (1.0 + 4.0 * off[axis] * off[axis]);
        let mut now = best.get();
        let fits = off[axis] < OFF
            && now[k].is_none_or(|b| cost < b.0)
            && theirs[1 - axis].perp(&d).abs() < OFF * distance
            && theirs[axis].perp(&own[1 - axis]).abs() < OFF_ACROSS
            && other.contrast < 5.0 * corner.contrast
            && corner.contrast < 5.0 * other.contrast
            && is_edge(view, corner.position, other.position, axis == 0, corner.contrast.min(other.contrast));
        if fits {
            now[k] = Some((cost, j));
            best.set(now);
        }
        looked_at < LOOKED_AT
    };
    buckets.around(corner.position, visit, |reached| !best.get().iter().all(|b| b.is_some_and(|b| b.0 <= reached)));
    let mut k = 0;
    best.get().map(|b| {
        let axis = k & 1;
        k += 1;
        let (_, j) = b?;
        // Of the other's two directions along this line the one that points back.
        let ahead = axes[j][1 - axis].dot(&(corners[j].position - corner.position)) > 0.0;
        Some((j, 1 - axis + if ahead { 2 } else { 0 }))
    })
}

/// The grids that the corners form, the largest first; of fewer than `least` corners none.
pub(crate) fn grids(
    corners: &[XCorner],
    view: ImageView<'_, f32, 1>,
    least: usize,
    stage: &Stage<'_>,
) -> Result<Vec<Grid>, Cancelled> {
    let chosen = choose(corners, view, stage)?;
    let mutual = |i: usize, k: usize| {
        let (j, back) = chosen[i][k]?;
        (chosen[j][back].map(|c| c.0) == Some(i)).then_some((j, back))
    };
    let links: Vec<[Option<(usize, usize)>; 4]> =
        (0..corners.len()).map(|i| std::array::from_fn(|k| mutual(i, k))).collect();
    // Begin where all four neighbors are there: least likely to be wrong.
    let mut order: Vec<usize> = (0..corners.len()).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(links[i].iter().flatten().count()));
    let mut used = vec![false; corners.len()];
    let mut out = Vec::new();
    for seed in order {
        if used[seed] || links[seed].iter().flatten().count() < 2 {
            continue;
        }
        stage.check()?;
        let mut grid = Grid::default();
        let mut members = Vec::new();
        let mut queue = VecDeque::from([(seed, (0i32, 0i32), 0usize)]);
        used[seed] = true;
        grid.nodes.insert((0, 0), Node { corner: corners[seed], turns: 0 });
        while let Some((i, at, turns)) = queue.pop_front() {
            members.push(i);
            for (g, step) in STEPS.iter().enumerate() {
                let Some((j, back)) = links[i][(g + turns) & 3] else { continue };
                let place = (at.0 + step.0, at.1 + step.1);
                if used[j] || grid.nodes.contains_key(&place) {
                    continue;
                }
                // Not where the neighbors say that it cannot lie. Perspective changes a step by a quarter from one to the next at most, in a picture worth using.
                if grid.expected(place).is_some_and(|(p, step)| (p - corners[j].position).norm() > 0.4 * step + 2.0) {
                    continue;
                }
                // Local direction `back` of j is the grid's g + 2.
                let turned = (back + 8 - g - 2) & 3;
                used[j] = true;
                grid.nodes.insert(place, Node { corner: corners[j], turns: turned });
                queue.push_back((j, place, turned));
            }
        }
        if grid.nodes.len() >= least {
            out.push(grid);
        }
    }
    out.sort_by_key(|g| std::cmp::Reverse(g.nodes.len()));
    Ok(out)
}

/// The two edges through a place and the contrast around it, on a circle that suits the distance to the next corner.
fn crossing(view: ImageView<'_, f32, 1>, at: Point2<f64>, step: f64) -> Option<([f64; 2], f32)> {
    let radius = (0.3 * step).clamp(2.0, 10.0);
    let angle = |i: usize| i as f64 * (TAU / 16.0);
    let mut values = [0.0f32; 16];
    for (i, v) in values.iter_mut().enumerate() {
        let (sin, cos) = angle(i).sin_cos();
        [*v] = sample_bilinear(view, at.x + radius * cos, at.y + radius * sin)?;
    }
    edges(&values, angle)
}

impl Grid {
    pub(crate) fn position(&self, at: (i32, i32)) -> Option<Point2<f64>> {
        Some(self.nodes.get(&at)?.corner.position)
    }

    /// First and last column, first and last row; of an empty grid the last come before the first.
    pub(crate) fn bounds(&self) -> [i32; 4] {
        if self.nodes.is_empty() {
            return [0, -1, 0, -1];
        }
        self.nodes.keys().fold([i32::MAX, i32::MIN, i32::MAX, i32::MIN], |b, &(x, y)| {
            [b[0].min(x), b[1].max(x), b[2].min(y), b[3].max(y)]
        })
    }

    /// Where an empty place must lie by its neighbors, and the length of a step there: from two in line, or from the other three of a square.
    pub(crate) fn expected(&self, (x, y): (i32, i32)) -> Option<(Point2<f64>, f64)> {
        let at = |dx: i32, dy: i32| self.position((x + dx, y + dy)).map(|p| p.coords);
        let (mut sum, mut weight, mut step) = (Vector2::zeros(), 0.0, f64::INFINITY);
        for (dx, dy) in STEPS {
            if let (Some(one), Some(two)) = (at(dx, dy), at(2 * dx, 2 * dy)) {
                // Between neighbors on both sides the middle of the two counts double.
                let three = at(3 * dx, 3 * dy);
                let p = three.map_or(one * 2.0 - two, |three| one * 3.0 - two * 3.0 + three);
                sum += p;
                weight += 1.0;
                step = step.min((one - two).norm());
            }
            let (ex, ey) = (-dy, dx);
            if let (Some(a), Some(b), Some(c)) = (at(dx, dy), at(ex, ey), at(dx + ex, dy + ey)) {
                sum += a + b - c;
                weight += 1.0;
                step = step.min((a - c).norm()).min((b - c).norm());
            }
        }
        (weight > 0.0).then(|| (Point2::from(sum / weight), step))
    }

    /// Moves every corner to its exact place, and drops those that have none, or lie where their neighbors say that they cannot.
    pub(crate) fn settle(&mut self, view: ImageView<'_, f32, 1>) {
        let steps: HashMap<(i32, i32), f64> = self.nodes.keys().map(|&p| (p, self.step(p))).collect();
        self.nodes.retain(|p, node| {
            let (step, corner) = (steps[p], &mut node.corner);
            // Wide enough to see edges from where a coarse octave put it.
            let window = (0.3 * step).clamp(2.0, (0.5 * corner.radius).max(4.0));
            let Some(found) = saddle(view, corner.position, window, ROUGH) else { return false };
            let near = (found.position - corner.position).norm() < 0.3 * step;
            let same = |axes: [f64; 2]| (0..2).all(|i| between_lines(axes[i], corner.axes[i]) < 0.6);
            let good = near && crossing(view, found.position, step).is_some_and(|(axes, _)| same(axes));
            corner.position = found.position;
            good
        });
        let wrong: Vec<(i32, i32)> = self
            .nodes
            .iter()
            .filter(|(place, node)| {
                let expected = self.expected(**place);
                expected.is_some_and(|(p, step)| (p - node.corner.position).norm() > 0.3 * step + 1.0)
            })
            .map(|(place, _)| *place)
            .collect();
        // One wrong corner makes its neighbors look wrong as well: all go, and are looked up again from the rest.
        if 2 * wrong.len() < self.nodes.len() {
            wrong.iter().for_each(|place| {
                self.nodes.remove(place);
            });
        }
    }

    /// Distance from a corner to its nearest neighbor.
    pub(crate) fn step(&self, (x, y): (i32, i32)) -> f64 {
        let Some(p) = self.position((x, y)) else { return f64::INFINITY };
        let near = STEPS.iter().filter_map(|(dx, dy)| self.position((x + dx, y + dy)));
        near.fold(f64::INFINITY, |least, q| least.min((q - p).norm()))
    }

    /// Fills empty places beside full ones within `within` (first and last column and row) where the picture has the corner that belongs there. Returns how many.
    pub(crate) fn fill(
        &mut self,
        view: ImageView<'_, f32, 1>,
        within: [i32; 4],
        stage: &Stage<'_>,
    ) -> Result<usize, Cancelled> {
        let mut filled = 0;
        let mut tried = std::collections::HashSet::new();
        loop {
            stage.check()?;
            let mut places: Vec<(i32, i32)> = self
                .nodes
                .keys()
                .flat_map(|&(x, y)| STEPS.map(|(dx, dy)| (x + dx, y + dy)))
                .filter(|p| (within[0]..=within[1]).contains(&p.0) && (within[2]..=within[3]).contains(&p.1))
                .filter(|p| !self.nodes.contains_key(p))
                .collect();
            places.sort_unstable();
            places.dedup();
            let mut any = false;
            for place in places {
                let Some((expected, step)) = self.expected(place) else { continue };
                // Again only where new neighbors moved the expectation.
                if !tried.insert((place, (expected.x * 4.0) as i64, (expected.y * 4.0) as i64)) {
                    continue;
                }
                if let Some(node) = self.look_up(view, place, expected, step) {
                    self.nodes.insert(place, node);
                    (filled, any) = (filled + 1, true);
                }
            }
            if !any {
                return Ok(filled);
            }
        }
    }

    /// The corner near an expected place, where it has the colors that the place must have.
    fn look_up(
        &self,
        view: ImageView<'_, f32, 1>,
        (x, y): (i32, i32),
        expected: Point2<f64>,
        step: f64,
    ) -> Option<Node> {
        let near: Vec<&Node> = STEPS.iter().filter_map(|(dx, dy)| self.nodes.get(&(x + dx, y + dy))).collect();
        let contrast = near.iter().map(|n| n.corner.contrast).fold(f32::INFINITY, f32::min);
        let neighbor = near.first()?;
        let found = saddle(view, expected, (0.3 * step).clamp(2.0, 8.0), ROUGH)?;
        if (found.position - expected).norm() > 0.3 * step {
            return None;
        }
        let (axes, seen) = crossing(view, found.position, step)?;
        let corner = XCorner { position: found.position, axes, contrast: seen, radius: (0.3 * step).clamp(2.0, 10.0) };
        // Its edge of the second kind runs along the neighbor's of the first.
        let flipped = between_lines(axes[1], neighbor.corner.axes[0]) < 0.5
            && between_lines(axes[0], neighbor.corner.axes[1]) < 0.5;
        if seen < 0.25 * contrast || !flipped {
            return None;
        }
        // Of the odd turns the one whose columns point as the neighbor's do.
        let columns = direction(&neighbor.corner, neighbor.turns);
        let turns = (0..4).filter(|t| (t + neighbor.turns) & 1 == 1).min_by(|&a, &b| {
            between(direction(&corner, a), columns).total_cmp(&between(direction(&corner, b), columns))
        })?;
        Some(Node { corner, turns })
    }
}
