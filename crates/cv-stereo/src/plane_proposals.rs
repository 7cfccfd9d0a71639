//! The planes that are offered to a region: those of its pixels, one fitted to them, planes through matches, and changed ones (Taniai et al. 2018, section 4).

use crate::PixelState;
use crate::expansion_region::{Labels, Problem, Region, Scratch, pixels};
use crate::plane_cost::{Plane, Rectangle, at};
use crate::surfaces::Moments;
use cv_core::{Cancelled, Stage};

/// Disparities that are farther apart, in px, are of different surfaces.
pub(crate) const STEP: f32 = 1.0;
/// Steepest slopes of an offered plane, in px of disparity per px across and down.
const STEEPEST: (f32, f32) = (0.8, 2.0);
/// Matches of a region that planes are sampled from, how many of those planes, the distance in px at which a match supports one, and the least support.
const SAMPLES: usize = 60;
const TRIALS: usize = 40;
const SUPPORTS: f32 = 0.7;
const LEAST_SUPPORT: usize = 8;
/// First change of a disparity in px and of a slope; each further one is half of it.
const CHANGE: (f32, f32) = (1.0, 0.1);

/// How planes are offered to the regions of one size.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pass {
    /// Side of a cell in px.
    pub(crate) cell: usize,
    /// Planes that are sampled from the matches, and present ones that are changed.
    pub(crate) sampled: usize,
    pub(crate) changed: usize,
}

/// The plane of least squares of points relative to a center.
pub(crate) fn fit(points: impl Iterator<Item = (usize, usize, f32)>, center: (f32, f32)) -> Option<Plane> {
    let mut moments = Moments::default();
    for (x, y, d) in points {
        moments.add(f64::from(x as f32 - center.0), f64::from(y as f32 - center.1), f64::from(d));
    }
    (moments.n > 0.0).then(|| from_center(moments.fit().map(|v| v as f32), center))
}

/// A plane relative to a center, relative to the first pixel.
fn from_center([a, b, c]: Plane, (x, y): (f32, f32)) -> Plane {
    [a, b, c - a * x - b * y]
}

/// The middle of a rectangle.
pub(crate) fn middle(place: &Rectangle) -> (f32, f32) {
    (0.5 * (place.left + place.right) as f32, 0.5 * (place.top + place.bottom) as f32)
}

/// A cell and the eight around it.
pub(crate) fn cell_and_region(cell: usize, side: usize, (width, height): (usize, usize)) -> (Rectangle, Rectangle) {
    let columns = width.div_ceil(side);
    let (left, top) = (cell % columns * side, cell / columns * side);
    let own = Rectangle { left, top, right: (left + side).min(width), bottom: (top + side).min(height) };
    (own, own.grown(side, (width, height)))
}

/// Offers planes to the 3×3 cells around one; `None` where nothing took any.
pub(crate) fn offer(
    problem: &Problem<'_>,
    labels: &Labels,
    pass: Pass,
    cell: usize,
    mut random: Random,
    scratch: &mut Scratch,
    stage: &Stage<'_>,
) -> Result<Option<Region>, Cancelled> {
    let size = problem.cost.size();
    let (own, place) = cell_and_region(cell, pass.cell, size);
    let mut region = Region::new(place, labels, size);
    let center = middle(&own);
    // One that is there.
    let plane = any_plane(&region, &own, &mut random);
    region.take(problem, plane, scratch, stage)?;
    // The one of all pixels that lie near it.
    let mut plane = any_plane(&region, &own, &mut random);
    for _ in 0..if pass.cell > 24 { 3 } else { 1 } {
        let near = pixels(place).map(|(x, y)| (x, y, at(region.plane(x, y), x, y)));
        let near = near.filter(|&(x, y, d)| (d - at(plane, x, y)).abs() <= STEP);
        plane = fit(near, center).unwrap_or(plane);
    }
    region.take(problem, plane, scratch, stage)?;
    for _ in 0..pass.sampled {
        if let Some(plane) = sampled(problem, place, pass.cell, center, &mut random) {
            region.take(problem, plane, scratch, stage)?;
        }
    }
    for n in 0..pass.changed {
        let [a, b, c] = any_plane(&region, &own, &mut random);
        let share = 1.0 / (1 << n) as f32;
        let d = a * center.0 + b * center.1 + c + share * CHANGE.0 * random.signed();
        let (a, b) = (a + share * CHANGE.1 * random.signed(), b + share * CHANGE.1 * random.signed());
        let d = d.clamp(problem.range.0, problem.range.1);
        region.take(problem, from_center([a, b, d], center), scratch, stage)?;
    }
    Ok(region.has_changed.then_some(region))
}

/// The plane of some pixel of a part of a region.
fn any_plane(region: &Region, part: &Rectangle, random: &mut Random) -> Plane {
    region.plane(part.left + random.below(part.width()), part.top + random.below(part.height()))
}

/// Of planes through three matches of a region the one that most matches support (RANSAC); `None` where too few do.
fn sampled(
    problem: &Problem<'_>,
    place: Rectangle,
    side: usize,
    center: (f32, f32),
    random: &mut Random,
) -> Option<Plane> {
    let width = problem.cost.width;
    let mut points: Vec<[f32; 3]> = Vec::with_capacity(SAMPLES);
    for _ in 0..4 * SAMPLES {
        let (x, y) = (place.left + random.below(place.width()), place.top + random.below(place.height()));
        let i = y * width + x;
        if problem.states[i] == PixelState::Matched {
            points.push([x as f32 - center.0, y as f32 - center.1, problem.matches[i]]);
            if points.len() == SAMPLES {
                break;
            }
        }
    }
    if points.len() < LEAST_SUPPORT {
        return None;
    }
    let mut best: (usize, Plane) = (LEAST_SUPPORT - 1, [0.0; 3]);
    for _ in 0..TRIALS {
        let [p, q, r] = std::array::from_fn(|_| points[random.below(points.len())]);
        let ([qx, qy, qd], [rx, ry, rd]) = ([0, 1, 2].map(|i| q[i] - p[i]), [0, 1, 2].map(|i| r[i] - p[i]));
        let area = qx * ry - qy * rx;
        // Nearly on a line, or near each other.
        if area.abs() < 0.2 * (side * side) as f32 {
            continue;
        }
        let (a, b) = ((qd * ry - qy * rd) / area, (qx * rd - qd * rx) / area);
        if a.abs() > STEEPEST.0 || b.abs() > STEEPEST.1 {
            continue;
        }
        let c = p[2] - a * p[0] - b * p[1];
        let support = points.iter().filter(|[x, y, d]| (a * x + b * y + c - d).abs() < SUPPORTS).count();
        if support > best.0 {
            best = (support, [a, b, c]);
        }
    }
    (best.0 >= LEAST_SUPPORT).then(|| from_center(best.1, center))
}

/// SplitMix64 (Steele, Lea & Flood 2014), by its seed.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// 0 to `n - 1`.
    fn below(&mut self, n: usize) -> usize {
        (((self.next() >> 32) * n as u64) >> 32) as usize
    }

    /// −1 to 1.
    fn signed(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}
