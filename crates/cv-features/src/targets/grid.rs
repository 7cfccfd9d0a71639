//! Assembly of X-corners to grids.
//!
//! For each corner, the nearest corner of opposite polarity is searched along its four edges. Two corners that select
//! each other, with an edge between black and white along their connection, are neighbors. Connected components of
//! neighbors are grids. Missing corners are then searched at the positions predicted by their neighbors (A. Geiger et
//! al., "Automatic camera and range sensor calibration using a single shot", ICRA 2012, grow their boards this way, row
//! by row).

use super::saddle::{border_distance, refine_saddle};
use super::x_corner::{XCorner, edge_directions};
use cv_core::{Cancelled, ImageView, Point2, Stage, Vector2};
use cv_imgproc::sample_bilinear;
use cv_parallel::prelude::*;
use std::collections::{HashMap, VecDeque};
use std::f64::consts::{PI, TAU};

/// Maximum number of candidates for the neighbors of a corner.
const MAX_CANDIDATES: usize = 80;
/// Convergence tolerance of corner positions during grid growth, in pixels.
const COARSE_TOLERANCE: f64 = 0.1;

/// Maximum distance in pixels of two detections of one corner.
pub(crate) const SAME_CORNER: f64 = 3.0;

/// A node of a grid.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Node {
    pub(crate) corner: XCorner,
    /// Quarter turns from the corner's first edge to the +x direction of the grid. Even: the square between +x and +y
    /// is white.
    pub(crate) turns: usize,
}

/// Corners by column and row, which may be negative.
#[derive(Debug, Clone, Default)]
pub(crate) struct Grid {
    pub(crate) nodes: HashMap<(i32, i32), Node>,
    /// Radius around a corner, relative to the distance to the next, in which its four squares are uniform.
    pub(crate) clearance: f64,
}

const STEPS: [(i32, i32); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];

/// Returns the angle of edge direction `k` (0 to 3, clockwise) of a corner.
fn direction(corner: &XCorner, k: usize) -> f64 {
    corner.axes[k & 1] + if k & 2 == 0 { 0.0 } else { PI }
}

/// Computes the angle between two undirected lines, 0 to π/2.
fn line_angle(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(PI);
    d.min(PI - d)
}

/// Computes the angle between two directions, 0 to π.
fn direction_angle(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(TAU);
    d.min(TAU - d)
}

/// A spatial index of corners by image cells.
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

    /// Visits corners by rings of cells around `p` until `visit` returns false, or `after` returns false for the radius
    /// within which all corners were visited.
    fn visit_rings(&self, p: Point2<f64>, mut visit: impl FnMut(usize) -> bool, mut after: impl FnMut(f64) -> bool) {
        let (cx, cy) = self.cell(p);
        for k in 0..self.columns.max(self.rows) {
            let (x0, x1) = (cx as isize - k as isize, cx as isize + k as isize);
            let (y0, y1) = (cy as isize - k as isize, cy as isize + k as isize);
            for y in y0.max(0)..=y1.min(self.rows as isize - 1) {
                let is_full_row = y == y0 || y == y1;
                let step = if is_full_row || k == 0 { 1 } else { 2 * k };
                for x in (x0..=x1).step_by(step).filter(|&x| x >= 0 && x < self.columns as isize) {
                    for &i in &self.cells[y as usize * self.columns + x as usize] {
                        if !visit(i as usize) {
                            return;
                        }
                    }
                }
            }
            // All corners within k cells were visited.
            if !after(k as f64 * self.side) {
                return;
            }
        }
    }
}

/// Tests whether the line between two corners is an edge: white on one side and black on the other. White is clockwise
/// of its direction if `clockwise`.
fn is_edge(
    view: ImageView<'_, f32, 1>,
    from: Point2<f64>,
    to: Point2<f64>,
    clockwise: bool,
    contrast: f32,
    clearance: f64,
) -> bool {
    let along = to - from;
    let length = along.norm();
    let inside = border_distance(view.size(), from).min(border_distance(view.size(), to));
    let offset = (0.5 * clearance * length).clamp(1.5, 12.0).min(inside.max(1.5));
    let across = Vector2::new(-along.y, along.x) / length * offset;
    let sign = if clockwise { 1.0 } else { -1.0 };
    let (mut sum, mut n) = (0.0f32, 0);
    for t in [0.3, 0.4, 0.5, 0.6, 0.7] {
        let midpoint = from + along * t;
        let at = |p: Point2<f64>| sample_bilinear(view, p.x, p.y).map(|[v]| v);
        let (Some(a), Some(b)) = (at(midpoint + across), at(midpoint - across)) else { return false };
        let d = sign * (a - b);
        if d < 0.1 * contrast {
            return false;
        }
        sum += d;
        n += 1;
    }
    sum >= 0.3 * contrast * n as f32
}

/// The selected neighbor in each of a corner's four directions: its index, and its direction that points back.
type Neighbors = [Option<(usize, usize)>; 4];

/// Selects for each corner the nearest neighbor along each of its four directions.
fn select_neighbors(
    corners: &[XCorner],
    view: ImageView<'_, f32, 1>,
    clearance: f64,
    stage: &Stage<'_>,
) -> Result<Vec<Neighbors>, Cancelled> {
    let buckets = Buckets::new(corners, view.size());
    let axes: Vec<[Vector2<f64>; 2]> = corners.iter().map(|c| c.axes.map(|a| Vector2::new(a.cos(), a.sin()))).collect();
    (0..corners.len())
        .into_par_iter()
        .with_min_len(64)
        .map(|i| {
            if i % 256 == 0 {
                stage.check()?;
            }
            Ok(neighbors_of(i, corners, &axes, &buckets, view, clearance))
        })
        .try_collect()
}

/// Sine of the maximum angle, 23°, between an edge direction and the line to the neighbor. Directions have errors of
/// about 10°, and change by as much between neighbors under fisheye distortion.
const MAX_SINE_ALONG: f64 = 0.39;
/// Sine of the maximum angle, 40°, between the transverse edges of two neighbors, which perspective also rotates.
const MAX_SINE_ACROSS: f64 = 0.64;

fn neighbors_of(
    i: usize,
    corners: &[XCorner],
    axes: &[[Vector2<f64>; 2]],
    buckets: &Buckets,
    view: ImageView<'_, f32, 1>,
    clearance: f64,
) -> Neighbors {
    let (corner, own) = (&corners[i], axes[i]);
    // Cost, index.
    let best = std::cell::Cell::new([None::<(f64, usize)>; 4]);
    let mut candidates = 0;
    let visit = |j: usize| {
        candidates += usize::from(i != j);
        let (other, theirs) = (&corners[j], axes[j]);
        let d = other.position - corner.position;
        let squared_distance = d.norm_squared();
        // Most candidates are in other directions.
        let across = own.map(|a| a.perp(&d).abs());
        let axis = usize::from(across[1] < across[0]);
        let limit = MAX_SINE_ALONG * MAX_SINE_ALONG * squared_distance;
        let too_close = (0.9 * corner.radius.min(other.radius)).max(3.0);
        if i == j || across[axis] * across[axis] >= limit || squared_distance < too_close * too_close {
            return candidates < MAX_CANDIDATES;
        }
        let distance = squared_distance.sqrt();
        let sine = across[axis] / distance;
        let k = axis + if own[axis].dot(&d) < 0.0 { 2 } else { 0 };
        let cost = distance * (1.0 + 4.0 * sine * sine);
        let mut now = best.get();
        let is_neighbor = now[k].is_none_or(|b| cost < b.0)
            && theirs[1 - axis].perp(&d).abs() < MAX_SINE_ALONG * distance
            && theirs[axis].perp(&own[1 - axis]).abs() < MAX_SINE_ACROSS
            && other.contrast < 5.0 * corner.contrast
            && corner.contrast < 5.0 * other.contrast
            && is_edge(
                view,
                corner.position,
                other.position,
                axis == 0,
                corner.contrast.min(other.contrast),
                clearance,
            );
        if is_neighbor {
            now[k] = Some((cost, j));
            best.set(now);
        }
        candidates < MAX_CANDIDATES
    };
    buckets
        .visit_rings(corner.position, visit, |reached| !best.get().iter().all(|b| b.is_some_and(|b| b.0 <= reached)));
    let mut k = 0;
    best.get().map(|b| {
        let axis = k & 1;
        k += 1;
        let (_, j) = b?;
        // The other's direction along this line that points back.
        let is_ahead = axes[j][1 - axis].dot(&(corners[j].position - corner.position)) > 0.0;
        Some((j, 1 - axis + if is_ahead { 2 } else { 0 }))
    })
}

/// Assembles the corners to grids of at least `min_corners`, by decreasing size. `clearance`: see [`Grid`].
pub(crate) fn assemble_grids(
    corners: &[XCorner],
    view: ImageView<'_, f32, 1>,
    min_corners: usize,
    clearance: f64,
    stage: &Stage<'_>,
) -> Result<Vec<Grid>, Cancelled> {
    let neighbors = select_neighbors(corners, view, clearance, stage)?;
    let mutual = |i: usize, k: usize| {
        let (j, back) = neighbors[i][k]?;
        (neighbors[j][back].map(|c| c.0) == Some(i)).then_some((j, back))
    };
    let links: Vec<[Option<(usize, usize)>; 4]> =
        (0..corners.len()).map(|i| std::array::from_fn(|k| mutual(i, k))).collect();
    // Seeds with all four neighbors first, which are the most reliable.
    let mut order: Vec<usize> = (0..corners.len()).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(links[i].iter().flatten().count()));
    let mut is_used = vec![false; corners.len()];
    let mut out = Vec::new();
    for seed in order {
        if is_used[seed] || links[seed].iter().flatten().count() < 2 {
            continue;
        }
        stage.check()?;
        let mut grid = Grid { clearance, ..Grid::default() };
        let mut members = Vec::new();
        let mut queue = VecDeque::from([(seed, (0i32, 0i32), 0usize)]);
        is_used[seed] = true;
        grid.nodes.insert((0, 0), Node { corner: corners[seed], turns: 0 });
        while let Some((i, at, turns)) = queue.pop_front() {
            members.push(i);
            for (g, step) in STEPS.iter().enumerate() {
                let Some((j, back)) = links[i][(g + turns) & 3] else { continue };
                let place = (at.0 + step.0, at.1 + step.1);
                if is_used[j] || grid.nodes.contains_key(&place) {
                    continue;
                }
                // Reject corners far from the predicted position. Perspective changes the spacing by at most a quarter
                // per step in usable images.
                if grid.predict(place).is_some_and(|(p, step)| (p - corners[j].position).norm() > 0.4 * step + 2.0) {
                    continue;
                }
                // Edge direction `back` of j is the grid's direction g + 2.
                let neighbor_turns = (back + 8 - g - 2) & 3;
                is_used[j] = true;
                grid.nodes.insert(place, Node { corner: corners[j], turns: neighbor_turns });
                queue.push_back((j, place, neighbor_turns));
            }
        }
        if grid.nodes.len() >= min_corners {
            out.push(grid);
        }
    }
    out.sort_by_key(|g| std::cmp::Reverse(g.nodes.len()));
    Ok(out)
}

/// Estimates the two edge directions and the contrast at a position, on a circle with a radius of 2 to 10 pixels, less
/// at the image border.
fn x_corner_at(view: ImageView<'_, f32, 1>, at: Point2<f64>, radius: f64) -> Option<([f64; 2], f32)> {
    let radius = radius.clamp(2.0, 10.0).min(border_distance(view.size(), at));
    if radius < 2.0 {
        return None;
    }
    let angle = |i: usize| i as f64 * (TAU / 16.0);
    let mut values = [0.0f32; 16];
    for (i, v) in values.iter_mut().enumerate() {
        let (sin, cos) = angle(i).sin_cos();
        [*v] = sample_bilinear(view, at.x + radius * cos, at.y + radius * sin)?;
    }
    edge_directions(&values, angle)
}

impl Grid {
    pub(crate) fn position(&self, at: (i32, i32)) -> Option<Point2<f64>> {
        Some(self.nodes.get(&at)?.corner.position)
    }

    /// Returns first and last column, first and last row; for an empty grid, the last are before the first.
    pub(crate) fn bounds(&self) -> [i32; 4] {
        if self.nodes.is_empty() {
            return [0, -1, 0, -1];
        }
        self.nodes.keys().fold([i32::MAX, i32::MIN, i32::MAX, i32::MIN], |b, &(x, y)| {
            [b[0].min(x), b[1].max(x), b[2].min(y), b[3].max(y)]
        })
    }

    /// Predicts the position and the local spacing of a node by extrapolation of collinear neighbors and of the other
    /// three corners of squares.
    pub(crate) fn predict(&self, (x, y): (i32, i32)) -> Option<(Point2<f64>, f64)> {
        let at = |dx: i32, dy: i32| self.position((x + dx, y + dy)).map(|p| p.coords);
        let (mut sum, mut weight, mut step) = (Vector2::zeros(), 0.0, f64::INFINITY);
        for (dx, dy) in STEPS {
            if let (Some(one), Some(two)) = (at(dx, dy), at(2 * dx, 2 * dy)) {
                // Quadratic extrapolation if there are three collinear neighbors, else linear.
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

    /// Refines every corner, and removes those that do not converge or are far from the predictions of their neighbors.
    pub(crate) fn refine(&mut self, view: ImageView<'_, f32, 1>) {
        let clearance = self.clearance;
        let steps: HashMap<(i32, i32), f64> = self.nodes.keys().map(|&p| (p, self.spacing(p))).collect();
        self.nodes.retain(|p, node| {
            let (step, corner) = (steps[p], &mut node.corner);
            // Large enough for the localization error of a coarse octave.
            let window = (clearance * step).clamp(2.0, (0.5 * corner.radius).max(4.0));
            let Some(saddle) = refine_saddle(view, corner.position, window, COARSE_TOLERANCE) else { return false };
            let is_near = (saddle.position - corner.position).norm() < 0.3 * step;
            let has_same_edges = |axes: [f64; 2]| (0..2).all(|i| line_angle(axes[i], corner.axes[i]) < 0.6);
            let is_valid = is_near
                && x_corner_at(view, saddle.position, clearance * step).is_some_and(|(axes, _)| has_same_edges(axes));
            corner.position = saddle.position;
            is_valid
        });
        let outliers: Vec<(i32, i32)> = self
            .nodes
            .iter()
            .filter(|(place, node)| {
                let predicted = self.predict(**place);
                predicted.is_some_and(|(p, step)| (p - node.corner.position).norm() > 0.3 * step + 1.0)
            })
            .map(|(place, _)| *place)
            .collect();
        // A wrong corner also affects the predictions of its neighbors: all are removed, and searched again later.
        if 2 * outliers.len() < self.nodes.len() {
            outliers.iter().for_each(|place| {
                self.nodes.remove(place);
            });
        }
    }

    /// Returns the distance from a corner to its nearest neighbor.
    pub(crate) fn spacing(&self, (x, y): (i32, i32)) -> f64 {
        let Some(p) = self.position((x, y)) else { return f64::INFINITY };
        let neighbors = STEPS.iter().filter_map(|(dx, dy)| self.position((x + dx, y + dy)));
        neighbors.fold(f64::INFINITY, |nearest, q| nearest.min((q - p).norm()))
    }

    /// Grows the grid: searches missing corners adjacent to existing ones within the bounds `within` (first and last
    /// column and row). Returns the number of corners added.
    pub(crate) fn grow(
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
                let Some((predicted, step)) = self.predict(place) else { continue };
                // Repeat only if new neighbors changed the prediction.
                if !tried.insert((place, (predicted.x * 4.0) as i64, (predicted.y * 4.0) as i64)) {
                    continue;
                }
                if let Some(node) = self.find_corner(view, place, predicted, step) {
                    self.nodes.insert(place, node);
                    (filled, any) = (filled + 1, true);
                }
            }
            if !any {
                return Ok(filled);
            }
        }
    }

    /// Searches the corner near a predicted position, with the polarity of the node.
    fn find_corner(
        &self,
        view: ImageView<'_, f32, 1>,
        (x, y): (i32, i32),
        predicted: Point2<f64>,
        step: f64,
    ) -> Option<Node> {
        let neighbors: Vec<&Node> = STEPS.iter().filter_map(|(dx, dy)| self.nodes.get(&(x + dx, y + dy))).collect();
        let contrast = neighbors.iter().map(|n| n.corner.contrast).fold(f32::INFINITY, f32::min);
        let neighbor = neighbors.first()?;
        let saddle = refine_saddle(view, predicted, (self.clearance * step).clamp(2.0, 8.0), COARSE_TOLERANCE)?;
        if (saddle.position - predicted).norm() > 0.3 * step {
            return None;
        }
        let radius = (self.clearance * step).clamp(2.0, 10.0);
        let (axes, measured_contrast) = x_corner_at(view, saddle.position, radius)?;
        let corner = XCorner { position: saddle.position, axes, contrast: measured_contrast, radius };
        // Adjacent corners have opposite polarity: the edges are exchanged.
        let has_opposite_polarity =
            line_angle(axes[1], neighbor.corner.axes[0]) < 0.5 && line_angle(axes[0], neighbor.corner.axes[1]) < 0.5;
        if measured_contrast < 0.25 * contrast || !has_opposite_polarity {
            return None;
        }
        // The odd number of turns whose +x direction is that of the neighbor.
        let columns = direction(&neighbor.corner, neighbor.turns);
        let turns = (0..4).filter(|t| (t + neighbor.turns) & 1 == 1).min_by(|&a, &b| {
            direction_angle(direction(&corner, a), columns).total_cmp(&direction_angle(direction(&corner, b), columns))
        })?;
        Some(Node { corner, turns })
    }
}
