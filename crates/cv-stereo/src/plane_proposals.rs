//! Plane proposals of a region: planes of its pixels, planes fitted to them, RANSAC planes of matches, planes of other slopes, and perturbed
//! planes (Taniai et al. 2018, section 4).

use crate::PixelState;
use crate::expansion_region::{Labels, Problem, Region, Scratch, pixels};
use crate::moments::Moments;
use crate::plane_cost::{Plane, Rectangle, at};
use cv_core::{Cancelled, Stage};

/// Difference of disparities in px above which they are of different surfaces.
pub(crate) const MAX_STEP: f32 = 1.0;
/// Maximum horizontal and vertical slope of a proposed plane, in px of disparity per px.
const MAX_SLOPE: (f32, f32) = (0.8, 2.0);
/// RANSAC planes: matches drawn from a region, number of minimal samples, inlier threshold in px, and minimum number of inliers.
const RANSAC_POINTS: usize = 60;
const RANSAC_ITERATIONS: usize = 40;
const INLIER_THRESHOLD: f32 = 0.7;
const MIN_INLIERS: usize = 8;
/// Maximum of the first perturbation of a disparity in px and of a slope; it is halved for each further one.
const PERTURBATION: (f32, f32) = (1.0, 0.1);

/// The proposals of the regions of one size.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pass {
    /// Side of a cell in px.
    pub(crate) cell: usize,
    /// Number of RANSAC planes, of planes with a random vertical slope, and of perturbed planes.
    pub(crate) ransac: usize,
    pub(crate) sloped: usize,
    pub(crate) perturbed: usize,
}

/// Fits a plane to points by least squares, relative to a center for conditioning.
pub(crate) fn fit_plane(points: impl Iterator<Item = (usize, usize, f32)>, center: (f32, f32)) -> Option<Plane> {
    let mut moments = Moments::default();
    for (x, y, d) in points {
        moments.add(f64::from(x as f32 - center.0), f64::from(y as f32 - center.1), f64::from(d));
    }
    (moments.n > 0.0).then(|| from_center(moments.fit().map(|v| v as f32), center))
}

/// Converts a plane relative to a center to pixel coordinates.
fn from_center([a, b, c]: Plane, (x, y): (f32, f32)) -> Plane {
    [a, b, c - a * x - b * y]
}

/// Returns the center of a rectangle.
pub(crate) fn center_of(place: &Rectangle) -> (f32, f32) {
    (0.5 * (place.left + place.right) as f32, 0.5 * (place.top + place.bottom) as f32)
}

/// Returns a cell and its expansion region, the 3×3 cells around it.
pub(crate) fn cell_and_region(cell: usize, side: usize, (width, height): (usize, usize)) -> (Rectangle, Rectangle) {
    let columns = width.div_ceil(side);
    let (left, top) = (cell % columns * side, cell / columns * side);
    let own = Rectangle { left, top, right: (left + side).min(width), bottom: (top + side).min(height) };
    (own, own.grown(side, (width, height)))
}

/// Runs the moves of all proposals in the expansion region of a cell; `None` if no pixel changed.
pub(crate) fn propose_planes(
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
    let center = center_of(&own);
    // A plane of the cell.
    let plane = any_plane(&region, &own, &mut random);
    region.expand(problem, plane, scratch, stage)?;
    // The plane fitted to the pixels near one.
    let mut plane = any_plane(&region, &own, &mut random);
    for _ in 0..if pass.cell > 24 { 3 } else { 1 } {
        let near = pixels(place).map(|(x, y)| (x, y, at(region.plane(x, y), x, y)));
        let near = near.filter(|&(x, y, d)| (d - at(plane, x, y)).abs() <= MAX_STEP);
        plane = fit_plane(near, center).unwrap_or(plane);
    }
    region.expand(problem, plane, scratch, stage)?;
    for _ in 0..pass.ransac {
        if let Some(plane) = ransac_plane(problem, place, pass.cell, center, &mut random) {
            region.expand(problem, plane, scratch, stage)?;
        }
    }
    for _ in 0..pass.sloped {
        // Through a pixel of the region. A floor or table at a grazing angle is steep, and has few matches.
        let (x, y) = (place.left + random.below(place.width()), place.top + random.below(place.height()));
        let plane = region.plane(x, y);
        let (a, b) = (plane[0], MAX_SLOPE.1 * random.signed());
        let c = at(plane, x, y) - a * x as f32 - b * y as f32;
        region.expand(problem, [a, b, c], scratch, stage)?;
    }
    for n in 0..pass.perturbed {
        let [a, b, c] = any_plane(&region, &own, &mut random);
        let scale = 1.0 / (1 << n) as f32;
        let d = a * center.0 + b * center.1 + c + scale * PERTURBATION.0 * random.signed();
        let (a, b) = (a + scale * PERTURBATION.1 * random.signed(), b + scale * PERTURBATION.1 * random.signed());
        let d = d.clamp(problem.range.0, problem.range.1);
        region.expand(problem, from_center([a, b, d], center), scratch, stage)?;
    }
    Ok(region.has_changed.then_some(region))
}

/// Returns the plane of a random pixel of a part of a region.
fn any_plane(region: &Region, part: &Rectangle, random: &mut Random) -> Plane {
    region.plane(part.left + random.below(part.width()), part.top + random.below(part.height()))
}

/// Returns the plane through three matches of a region with the most inliers (RANSAC); `None` if there are too few.
fn ransac_plane(
    problem: &Problem<'_>,
    place: Rectangle,
    side: usize,
    center: (f32, f32),
    random: &mut Random,
) -> Option<Plane> {
    let width = problem.cost.width;
    let mut points: Vec<[f32; 3]> = Vec::with_capacity(RANSAC_POINTS);
    for _ in 0..4 * RANSAC_POINTS {
        let (x, y) = (place.left + random.below(place.width()), place.top + random.below(place.height()));
        let i = y * width + x;
        if problem.states[i] == PixelState::Matched {
            points.push([x as f32 - center.0, y as f32 - center.1, problem.matches[i]]);
            if points.len() == RANSAC_POINTS {
                break;
            }
        }
    }
    if points.len() < MIN_INLIERS {
        return None;
    }
    let mut best: (usize, Plane) = (MIN_INLIERS - 1, [0.0; 3]);
    for _ in 0..RANSAC_ITERATIONS {
        let [p, q, r] = std::array::from_fn(|_| points[random.below(points.len())]);
        let ([qx, qy, qd], [rx, ry, rd]) = ([0, 1, 2].map(|i| q[i] - p[i]), [0, 1, 2].map(|i| r[i] - p[i]));
        let area = qx * ry - qy * rx;
        // Degenerate: nearly collinear or coincident.
        if area.abs() < 0.2 * (side * side) as f32 {
            continue;
        }
        let (a, b) = ((qd * ry - qy * rd) / area, (qx * rd - qd * rx) / area);
        if a.abs() > MAX_SLOPE.0 || b.abs() > MAX_SLOPE.1 {
            continue;
        }
        let c = p[2] - a * p[0] - b * p[1];
        let inliers = points.iter().filter(|[x, y, d]| (a * x + b * y + c - d).abs() < INLIER_THRESHOLD).count();
        if inliers > best.0 {
            best = (inliers, [a, b, c]);
        }
    }
    (best.0 >= MIN_INLIERS).then(|| from_center(best.1, center))
}

/// The SplitMix64 generator (Steele, Lea & Flood 2014) with its state.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Returns a number from 0 to `n − 1`.
    fn below(&mut self, n: usize) -> usize {
        (((self.next() >> 32) * n as u64) >> 32) as usize
    }

    /// Returns a number from −1 to 1.
    fn signed(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}
