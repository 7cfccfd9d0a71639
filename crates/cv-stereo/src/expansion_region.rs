//! Expansion moves in a region: the pixels that take a proposed plane are found by a minimum cut.

use crate::PixelState;
use crate::plane_cost::{self, Plane, PlaneCost, Rectangle, at};
use cv_core::{Cancelled, Stage};
use cv_imgproc::GridCut;
use cv_parallel::prelude::*;
use fearless_simd::Level;

// Set on public pairs with truth (Middlebury, DrivingStereo), together with those of [`crate::plane_cost`].
/// Weight of the smoothness term per px of distance between the planes of neighbors. With 0.8, 2.7 % of a road's errors are above 2 px in
/// place of 3.5, and of Middlebury's Pipes 6.2 in place of 5.8.
pub(crate) const SMOOTHNESS: f32 = 0.6;
/// Truncation of the distance of planes in px, summed over both pixels.
const MAX_DISTANCE: f32 = 2.0;
/// Difference in gray levels at which the smoothness weight has decreased to 1/e, and its minimum relative to [`SMOOTHNESS`].
const EDGE_GRAY: f32 = 8.0;
const MIN_EDGE_WEIGHT: f32 = 0.08;
/// Weight of the distance between a plane and the match of a pixel, per px, and the truncation of that distance in px.
const MATCH_WEIGHT: f32 = 0.1;
const MAX_MATCH_DISTANCE: f32 = 2.0;
/// The same of a filled pixel: a weak prior, which decides where surfaces have no texture. Without, the white wall of Middlebury's Vintage may get
/// a plane that is 20 px nearer, for a few thousandths of the data term.
const FILLED_WEIGHT: f32 = 0.006;
const MAX_FILLED_DISTANCE: f32 = 8.0;
/// A plane is skipped if the data terms that it lowers, summed over the region, gain less than this. With 1 the mode takes an eighth longer;
/// with 8 it takes a third less, and rendered tables lose two thirds of its gain.
const MIN_GAIN: f32 = 3.0;
/// Capacity of an edge per unit of energy.
const CAPACITY_SCALE: f32 = 1000.0;

/// The energy: everything that is constant during the moves.
pub(crate) struct Problem<'a> {
    pub(crate) level: Level,
    pub(crate) cost: &'a PlaneCost,
    /// States and disparities of semi-global matching, without holes.
    pub(crate) states: &'a [PixelState],
    pub(crate) matches: &'a [f32],
    /// Smoothness weight of the edge to the right neighbor, and to the one below.
    pub(crate) right: Vec<f32>,
    pub(crate) down: Vec<f32>,
    /// Search range of the disparities.
    pub(crate) range: (f32, f32),
}

/// The labeling: the plane of each pixel, and its data term.
pub(crate) struct Labels {
    pub(crate) planes: Vec<Plane>,
    pub(crate) costs: Vec<f32>,
}

/// Buffers of a thread.
#[derive(Default)]
pub(crate) struct Scratch {
    pub(crate) cost: plane_cost::Scratch,
    pub(crate) cut: GridCut,
}

impl<'a> Problem<'a> {
    /// Creates the energy. `smoothness` is the weight per px between neighbors without an edge.
    pub(crate) fn new(
        level: Level,
        cost: &'a PlaneCost,
        states: &'a [PixelState],
        matches: &'a [f32],
        range: (f32, f32),
        smoothness: f32,
        stage: &Stage<'_>,
    ) -> Result<Self, Cancelled> {
        let (width, height) = cost.size();
        let pixels = width * height;
        let weight = |a: usize, b: usize| {
            let step = (cost.gray(a) - cost.gray(b)).abs();
            smoothness * (-step / EDGE_GRAY).exp().max(MIN_EDGE_WEIGHT)
        };
        let (mut right, mut down) = (vec![0.0; pixels], vec![0.0; pixels]);
        let rows = right.par_chunks_mut(width.max(1)).zip(down.par_chunks_mut(width.max(1))).enumerate();
        rows.try_for_each(|(y, (right, down))| {
            stage.check()?;
            let row = y * width..(y + 1) * width;
            right.iter_mut().zip(row.start..row.end - 1).for_each(|(edge, i)| *edge = weight(i, i + 1));
            if row.end < pixels {
                down.iter_mut().zip(row).for_each(|(edge, i)| *edge = weight(i, i + width));
            }
            Ok(())
        })?;
        Ok(Self { level, cost, states, matches, right, down, range })
    }

    /// Returns the cost of the distance from the match of a pixel, or from its filled disparity.
    #[inline(always)]
    pub(crate) fn match_cost(&self, pixel: usize, d: f32) -> f32 {
        let is_matched = self.states[pixel] == PixelState::Matched;
        let (weight, max) =
            if is_matched { (MATCH_WEIGHT, MAX_MATCH_DISTANCE) } else { (FILLED_WEIGHT, MAX_FILLED_DISTANCE) };
        weight * (d - self.matches[pixel]).abs().min(max)
    }
}

/// Returns the truncated distance of two planes at two neighbors (Taniai et al. 2018, equation 5).
#[inline(always)]
fn plane_distance(f: Plane, g: Plane, a: (usize, usize), b: (usize, usize)) -> f32 {
    ((at(f, a.0, a.1) - at(g, a.0, a.1)).abs() + (at(f, b.0, b.1) - at(g, b.0, b.1)).abs()).min(MAX_DISTANCE)
}

/// Returns the pixels of a rectangle in raster order.
pub(crate) fn pixels(place: Rectangle) -> impl Iterator<Item = (usize, usize)> {
    (place.top..place.bottom).flat_map(move |y| (place.left..place.right).map(move |x| (x, y)))
}

/// The labels of a region during its moves.
pub(crate) struct Region {
    pub(crate) place: Rectangle,
    /// The region with its neighbors.
    around: Rectangle,
    /// Of `around` and of `place`, in raster order.
    pub(crate) planes: Vec<Plane>,
    pub(crate) costs: Vec<f32>,
    pub(crate) has_changed: bool,
}

impl Region {
    pub(crate) fn new(place: Rectangle, labels: &Labels, size: (usize, usize)) -> Self {
        let around = place.grown(1, size);
        let index = |(x, y): (usize, usize)| y * size.0 + x;
        Self {
            place,
            around,
            planes: pixels(around).map(|p| labels.planes[index(p)]).collect(),
            costs: pixels(place).map(|p| labels.costs[index(p)]).collect(),
            has_changed: false,
        }
    }

    #[inline(always)]
    pub(crate) fn plane(&self, x: usize, y: usize) -> Plane {
        self.planes[(y - self.around.top) * self.around.width() + x - self.around.left]
    }

    /// Expansion move: assigns the plane to the pixels for which the energy becomes minimal.
    pub(crate) fn expand(
        &mut self,
        problem: &Problem<'_>,
        plane: Plane,
        scratch: &mut Scratch,
        stage: &Stage<'_>,
    ) -> Result<(), Cancelled> {
        stage.check()?;
        let place = self.place;
        let (width, height) = problem.cost.size();
        problem.cost.compute(problem.level, plane, place, &mut scratch.cost);
        let proposed = &mut scratch.cost.result;
        let mut gain = 0.0;
        for (((x, y), proposed), current) in pixels(place).zip(proposed.iter_mut()).zip(&self.costs) {
            *proposed += problem.match_cost(y * width + x, at(plane, x, y));
            gain += (current - *proposed).max(0.0);
        }
        if gain < MIN_GAIN {
            return Ok(());
        }
        let cut = &mut scratch.cut;
        cut.set_rectangle(place.width(), place.height());
        // Nodes on the sink side take the plane.
        let add = |cut: &mut GridCut, node: usize, cost: f32| {
            let cost = (CAPACITY_SCALE * cost) as i32;
            cut.add_terminal(node, cost.max(0), (-cost).max(0));
        };
        for (node, ((x, y), (proposed, current))) in pixels(place).zip(proposed.iter().zip(&self.costs)).enumerate() {
            let (i, here, own) = (y * width + x, (x, y), self.plane(x, y));
            let mut difference = proposed - current;
            // Neighbors of the region keep their planes.
            let mut add_border = |weight: f32, there: (usize, usize)| {
                let other = self.plane(there.0, there.1);
                difference +=
                    weight * (plane_distance(plane, other, here, there) - plane_distance(own, other, here, there));
            };
            if x == place.left && x > 0 {
                add_border(problem.right[i - 1], (x - 1, y));
            }
            if x + 1 == place.right && x + 1 < width {
                add_border(problem.right[i], (x + 1, y));
            }
            if y == place.top && y > 0 {
                add_border(problem.down[i - width], (x, y - 1));
            }
            if y + 1 == place.bottom && y + 1 < height {
                add_border(problem.down[i], (x, y + 1));
            }
            // The pairwise terms that both keep their planes, that only the other takes the proposed one, and that only this one does. The
            // sum of the last two is at least the first (the distance is a metric): the energy is submodular.
            let mut add_pair = |cut: &mut GridCut, weight: f32, there: (usize, usize), other_node: usize| {
                let other = self.plane(there.0, there.1);
                let both_keep = weight * plane_distance(own, other, here, there);
                let other_takes = weight * plane_distance(own, plane, here, there);
                let this_takes = weight * plane_distance(plane, other, here, there);
                difference += this_takes - both_keep;
                add(cut, other_node, -this_takes);
                (CAPACITY_SCALE * (other_takes + this_takes - both_keep).max(0.0)) as i32
            };
            if x + 1 < place.right {
                let capacity = add_pair(cut, problem.right[i], (x + 1, y), node + 1);
                cut.add_right(node, capacity, 0);
            }
            if y + 1 < place.bottom {
                let capacity = add_pair(cut, problem.down[i], (x, y + 1), node + place.width());
                cut.add_down(node, capacity, 0);
            }
            add(cut, node, difference);
        }
        cut.solve(stage)?;
        let columns = self.around.width();
        for (node, (x, y)) in pixels(place).enumerate() {
            if cut.is_on_sink_side(node) {
                self.planes[(y - self.around.top) * columns + x - self.around.left] = plane;
                self.costs[node] = proposed[node];
                self.has_changed = true;
            }
        }
        Ok(())
    }

    /// Writes the region to the labels of the image.
    pub(crate) fn write(&self, labels: &mut Labels, width: usize) {
        for (node, (x, y)) in pixels(self.place).enumerate() {
            labels.planes[y * width + x] = self.plane(x, y);
            labels.costs[y * width + x] = self.costs[node];
        }
    }
}
