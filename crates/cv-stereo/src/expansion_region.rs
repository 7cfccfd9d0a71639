//! The planes of a region's pixels while others are offered to them: those that take one are found by a minimum cut.

use crate::PixelState;
use crate::plane_cost::{self, Plane, PlaneCost, Rectangle, at};
use cv_core::{Cancelled, Stage};
use cv_imgproc::GridCut;
use fearless_simd::Level;
use rayon::prelude::*;

// Set on public pairs with truth (Middlebury, DrivingStereo), together with those of [`crate::plane_cost`].
/// Weight of a px between the planes of neighbors, the distance in px that counts the most (of both pixels together), the gray levels at which the weight falls to
/// 1/e, and the share of it that is left at the strongest edge. With a weight of 0.8, 2.7 % of a road's pixels are wrong by more than 2 px in place of 3.5, and of
/// Middlebury's Pipes 6.2 in place of 5.8.
pub(crate) const SMOOTH: f32 = 0.6;
const APART: f32 = 2.0;
const EDGE: f32 = 8.0;
const LEAST_SMOOTH: f32 = 0.08;
/// Weight of a px between a plane and what was matched, up to so many px.
const MATCHED: f32 = 0.1;
const MOST_OFF: f32 = 2.0;
/// A plane is not offered to a region where what its pixels could save together is less, in pixels that are wholly unlike. With 1 all takes an eighth longer; with 8 it
/// takes a third less, and rendered tables lose two thirds of what the mode gains.
const LEAST_GAIN: f32 = 3.0;
/// Capacity of a cost of 1.
const UNIT: f32 = 1000.0;

/// What does not change while planes are offered.
pub(crate) struct Problem<'a> {
    pub(crate) level: Level,
    pub(crate) cost: &'a PlaneCost,
    /// Where it was matched, and the disparity.
    pub(crate) states: &'a [PixelState],
    pub(crate) matches: &'a [f32],
    /// Weight of the edge to the right neighbor, and to the one below.
    pub(crate) right: Vec<f32>,
    pub(crate) down: Vec<f32>,
    /// Disparities there are.
    pub(crate) range: (f32, f32),
}

/// The plane of each pixel and what it costs there.
pub(crate) struct Labels {
    pub(crate) planes: Vec<Plane>,
    pub(crate) costs: Vec<f32>,
}

/// Memory of a thread.
#[derive(Default)]
pub(crate) struct Scratch {
    pub(crate) cost: plane_cost::Scratch,
    pub(crate) cut: GridCut,
}

impl<'a> Problem<'a> {
    /// `smooth` is the weight of a px between neighbors where there is no edge.
    pub(crate) fn new(
        level: Level,
        cost: &'a PlaneCost,
        states: &'a [PixelState],
        matches: &'a [f32],
        range: (f32, f32),
        smooth: f32,
        stage: &Stage<'_>,
    ) -> Result<Self, Cancelled> {
        let (width, height) = cost.size();
        let pixels = width * height;
        let weight = |a: usize, b: usize| {
            let step = (cost.gray(a) - cost.gray(b)).abs();
            smooth * (-step / EDGE).exp().max(LEAST_SMOOTH)
        };
        let edge = |i: usize| if (i + 1).is_multiple_of(width) { 0.0 } else { weight(i, i + 1) };
        let right = (0..pixels).into_par_iter().map(edge).collect();
        stage.check()?;
        let edge = |i: usize| if i + width < pixels { weight(i, i + width) } else { 0.0 };
        let down = (0..pixels).into_par_iter().map(edge).collect();
        stage.check()?;
        Ok(Self { level, cost, states, matches, right, down, range })
    }

    /// What leaving the match of a pixel costs.
    #[inline(always)]
    pub(crate) fn off_match(&self, pixel: usize, d: f32) -> f32 {
        let off = (d - self.matches[pixel]).abs().min(MOST_OFF);
        if self.states[pixel] == PixelState::Matched { MATCHED * off } else { 0.0 }
    }
}

/// How far two planes are apart at two neighbors.
#[inline(always)]
fn apart(f: Plane, g: Plane, a: (usize, usize), b: (usize, usize)) -> f32 {
    ((at(f, a.0, a.1) - at(g, a.0, a.1)).abs() + (at(f, b.0, b.1) - at(g, b.0, b.1)).abs()).min(APART)
}

/// Columns and rows of the pixels of a rectangle, row by row.
pub(crate) fn pixels(place: Rectangle) -> impl Iterator<Item = (usize, usize)> {
    (place.top..place.bottom).flat_map(move |y| (place.left..place.right).map(move |x| (x, y)))
}

/// The labels of a region while planes are offered to it.
pub(crate) struct Region {
    pub(crate) place: Rectangle,
    /// Its pixels and those beside it.
    around: Rectangle,
    /// Of `around` and of `place`, row by row.
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

    /// Takes over the plane where that lowers the cost the most.
    pub(crate) fn take(
        &mut self,
        problem: &Problem<'_>,
        plane: Plane,
        scratch: &mut Scratch,
        stage: &Stage<'_>,
    ) -> Result<(), Cancelled> {
        stage.check()?;
        let place = self.place;
        let (width, height) = problem.cost.size();
        problem.cost.of(problem.level, plane, place, &mut scratch.cost);
        let offered = &mut scratch.cost.result;
        let mut gain = 0.0;
        for (((x, y), offered), now) in pixels(place).zip(offered.iter_mut()).zip(&self.costs) {
            *offered += problem.off_match(y * width + x, at(plane, x, y));
            gain += (now - *offered).max(0.0);
        }
        if gain < LEAST_GAIN {
            return Ok(());
        }
        let cut = &mut scratch.cut;
        cut.set_rectangle(place.width(), place.height());
        // On the sink's side: takes the plane.
        let add = |cut: &mut GridCut, node: usize, cost: f32| {
            let cost = (UNIT * cost) as i32;
            cut.add_terminal(node, cost.max(0), (-cost).max(0));
        };
        for (node, ((x, y), (offered, now))) in pixels(place).zip(offered.iter().zip(&self.costs)).enumerate() {
            let (i, here, own) = (y * width + x, (x, y), self.plane(x, y));
            let mut difference = offered - now;
            // Pixels beside the region keep theirs.
            let mut beside = |weight: f32, there: (usize, usize)| {
                let other = self.plane(there.0, there.1);
                difference += weight * (apart(plane, other, here, there) - apart(own, other, here, there));
            };
            if x == place.left && x > 0 {
                beside(problem.right[i - 1], (x - 1, y));
            }
            if x + 1 == place.right && x + 1 < width {
                beside(problem.right[i], (x + 1, y));
            }
            if y == place.top && y > 0 {
                beside(problem.down[i - width], (x, y - 1));
            }
            if y + 1 == place.bottom && y + 1 < height {
                beside(problem.down[i], (x, y + 1));
            }
            // Of two pixels of the region: what it costs that both keep theirs, that the other alone takes the plane, and that this one alone does. The last two
            // together are never less than the first (the distance is a metric), so that a cut finds the least.
            let mut pair = |cut: &mut GridCut, weight: f32, there: (usize, usize), other_node: usize| {
                let other = self.plane(there.0, there.1);
                let both_keep = weight * apart(own, other, here, there);
                let other_takes = weight * apart(own, plane, here, there);
                let this_takes = weight * apart(plane, other, here, there);
                difference += this_takes - both_keep;
                add(cut, other_node, -this_takes);
                (UNIT * (other_takes + this_takes - both_keep).max(0.0)) as i32
            };
            if x + 1 < place.right {
                let capacity = pair(cut, problem.right[i], (x + 1, y), node + 1);
                cut.add_right(node, capacity, 0);
            }
            if y + 1 < place.bottom {
                let capacity = pair(cut, problem.down[i], (x, y + 1), node + place.width());
                cut.add_down(node, capacity, 0);
            }
            add(cut, node, difference);
        }
        cut.solve(stage)?;
        let columns = self.around.width();
        for (node, (x, y)) in pixels(place).enumerate() {
            if cut.is_on_sink_side(node) {
                self.planes[(y - self.around.top) * columns + x - self.around.left] = plane;
                self.costs[node] = offered[node];
                self.has_changed = true;
            }
        }
        Ok(())
    }

    /// Into the labels of the picture.
    pub(crate) fn write(&self, labels: &mut Labels, width: usize) {
        for (node, (x, y)) in pixels(self.place).enumerate() {
            labels.planes[y * width + x] = self.plane(x, y);
            labels.costs[y * width + x] = self.costs[node];
        }
    }
}
