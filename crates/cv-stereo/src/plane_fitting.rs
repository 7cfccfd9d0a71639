//! Planes for large holes.
//!
//! Where a wall, a floor or a ceiling shows no texture, nothing matches. What lies around such a hole often does, and lies on
//! one plane: the hole is then a part of it, and the disparity of a plane is linear in the image. The nearest values that
//! [`crate::fill`] takes are a step on a slanted surface, and too far or too near where the hole reaches the border.

use crate::PixelState;
use cv_core::UnionFind;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// Smaller holes hardly differ from what is around them.
const MIN_SIZE: usize = 100;
/// Pixels around a hole that are looked at: enough for a plane, and the time does not grow with the outline.
const MAX_SAMPLES: usize = 128;
const MIN_SAMPLES: usize = 12;
/// Samples lie up to so many pixels beyond the hole.
const RING: usize = 2;
/// Gray levels up to which a pixel beside a hole looks like it.
const ALIKE: u8 = 36;
/// What counts as on the plane, in px.
const ON_PLANE: f64 = 1.0;
/// Share of the samples that must: most, so that no other plane has more.
const SHARE: f64 = 0.5;
/// Planes tried. One in eight is through three good samples where half of the samples are.
const TRIALS: usize = 32;
/// Primes by which the trials walk through the three thirds of the samples.
const STRIDES: [usize; 3] = [31, 43, 61];
/// Steepest plane, in px of disparity per px: a wall beside the cameras, three times as far from them as they are apart.
const MAX_SLOPE: f64 = 0.3;

/// Memory of [`fill_planes`], kept between frames.
#[derive(Debug, Default)]
pub(crate) struct Planes {
    runs: Vec<Run>,
    /// Which runs are of one hole.
    holes: UnionFind,
    /// Number of pixels of each hole, at its first run; then its place among the large ones.
    sizes: Vec<usize>,
    samples: Vec<Vec<Sample>>,
    planes: Vec<Option<Plane>>,
}

/// Pixels beside each other that belong to a hole.
#[derive(Debug, Clone, Copy)]
struct Run {
    y: usize,
    start: usize,
    end: usize,
}

#[derive(Debug, Clone, Copy)]
struct Sample {
    x: f64,
    y: f64,
    d: f64,
}

/// `d = dx (x − x₀) + dy (y − y₀) + d₀`, within a range.
#[derive(Debug, Clone, Copy)]
struct Plane {
    origin: (f64, f64),
    slope: (f64, f64),
    d: f64,
    range: (f64, f64),
}

/// Fills those 4-connected holes of [`PixelState::Mismatched`] pixels that have 100 pixels or more and whose surroundings of
/// the same gray lie on one plane. Linear in the number of pixels.
pub(crate) fn fill_planes(
    disparity: &mut [f32],
    states: &[PixelState],
    gray: &[u8],
    width: usize,
    memory: &mut Planes,
) {
    if width == 0 || disparity.is_empty() {
        return;
    }
    let Planes { runs, holes, sizes, samples, planes } = memory;
    find_runs(states, width, runs, holes);
    let roots = holes.flatten();
    sizes.clear();
    sizes.resize(runs.len(), 0);
    for (run, &root) in runs.iter().zip(roots) {
        sizes[root as usize] += run.end - run.start;
    }
    let mut large = 0;
    for size in sizes.iter_mut() {
        *size = if *size >= MIN_SIZE {
            large += 1;
            large - 1
        } else {
            usize::MAX
        };
    }
    if large == 0 {
        return;
    }
    samples.iter_mut().for_each(Vec::clear);
    samples.resize_with(large.max(samples.len()), Vec::new);
    for (run, &root) in runs.iter().zip(roots) {
        let place = sizes[root as usize];
        if let Some(samples) = samples.get_mut(place) {
            collect(disparity, states, gray, width, run, samples);
        }
    }
    samples[..large].par_iter().map(|samples| fit(samples)).collect_into_vec(planes);
    for (&Run { y, start, end }, &root) in runs.iter().zip(roots) {
        let place = sizes[root as usize];
        let Some(Some(plane)) = planes.get(place) else { continue };
        let first = plane.slope.1 * (y as f64 - plane.origin.1) + plane.d;
        for (x, d) in disparity[y * width..][start..end].iter_mut().enumerate() {
            let value = plane.slope.0 * ((start + x) as f64 - plane.origin.0) + first;
            *d = value.clamp(plane.range.0, plane.range.1) as f32;
        }
    }
}

/// Runs of mismatched pixels, joined where they touch from row to row.
fn find_runs(states: &[PixelState], width: usize, runs: &mut Vec<Run>, holes: &mut UnionFind) {
    runs.clear();
    holes.clear();
    let mut above = 0..0;
    for (y, row) in states.chunks_exact(width).enumerate() {
        let first = runs.len();
        let mut x = 0;
        while let Some(start) = next(row, x) {
            let end = row[start..].iter().position(|&s| s != PixelState::Mismatched).map_or(width, |n| start + n);
            holes.push();
            runs.push(Run { y, start, end });
            x = end;
        }
        let mut up = above.start;
        for i in first..runs.len() {
            while up < above.end && runs[up].end <= runs[i].start {
                up += 1;
            }
            let mut other = up;
            while other < above.end && runs[other].start < runs[i].end {
                holes.union(other as u32, i as u32);
                other += 1;
            }
        }
        above = first..runs.len();
    }
}

/// The first mismatched pixel from `x` on, found block by block.
fn next(row: &[PixelState], x: usize) -> Option<usize> {
    let mismatched = |state: &PixelState| *state == PixelState::Mismatched;
    let block = row[x..].chunks(32).position(|block| block.iter().fold(false, |any, state| any | mismatched(state)))?;
    let from = x + 32 * block;
    row[from..].iter().position(mismatched).map(|n| from + n)
}

/// Matched pixels before, after, above and below a run that look like the pixel of it next to them.
fn collect(
    disparity: &[f32],
    states: &[PixelState],
    gray: &[u8],
    width: usize,
    &Run { y, start, end }: &Run,
    samples: &mut Vec<Sample>,
) {
    let height = disparity.len() / width;
    let mut take = |x: usize, y: usize, beside: usize| {
        let at = y * width + x;
        let alike = gray[at].abs_diff(gray[beside]) <= ALIKE;
        if states[at] == PixelState::Matched && alike && disparity[at].is_finite() {
            samples.push(Sample { x: x as f64, y: y as f64, d: f64::from(disparity[at]) });
        }
    };
    let row = y * width;
    for away in 1..=RING {
        if start >= away {
            take(start - away, y, row + start);
        }
        if end + away <= width {
            take(end + away - 1, y, row + end - 1);
        }
        for x in start..end {
            if y >= away {
                take(x, y - away, row + x);
            }
            if y + away < height {
                take(x, y + away, row + x);
            }
        }
    }
}

/// The plane that most samples lie on, by least squares over those; `None` where they are fewer than [`SHARE`].
///
/// Planes through three samples each are tried, which is robust where least squares over all would mix two surfaces.
fn fit(samples: &[Sample]) -> Option<Plane> {
    let step = samples.len().div_ceil(MAX_SAMPLES).max(1);
    let n = samples.len().div_ceil(step);
    if n < MIN_SAMPLES {
        return None;
    }
    let mut taken = [Sample { x: 0.0, y: 0.0, d: 0.0 }; MAX_SAMPLES];
    taken.iter_mut().zip(samples.iter().step_by(step)).for_each(|(to, from)| *to = *from);
    let samples = &taken[..n];
    let on = |p: &Vector3<f64>, s: &Sample| (p.x * s.x + p.y * s.y + p.z - s.d).abs() <= ON_PLANE;
    let count = |p: &Vector3<f64>| samples.iter().filter(|s| on(p, s)).count();
    // One sample of each third: they are in the order of the rows, so that the three lie far apart.
    let third = n / 3;
    let candidate = |trial: usize| {
        let [a, b, c] = [0, 1, 2].map(|part| &samples[part * third + trial * STRIDES[part] % third]);
        let rows = Matrix3::new(a.x, a.y, 1.0, b.x, b.y, 1.0, c.x, c.y, 1.0);
        let plane = rows.lu().solve(&Vector3::new(a.d, b.d, c.d))?;
        (plane.x.abs() <= MAX_SLOPE && plane.y.abs() <= MAX_SLOPE).then(|| (count(&plane), plane))
    };
    // The first of equals.
    let best = (0..TRIALS).filter_map(candidate).reduce(|a, b| if b.0 > a.0 { b } else { a });
    let (on_it, start) = best.filter(|&(count, _)| count as f64 >= SHARE * n as f64)?;
    let inliers = || samples.iter().filter(|s| on(&start, s));
    let mean = |f: fn(&Sample) -> f64| inliers().map(f).sum::<f64>() / on_it as f64;
    let origin = (mean(|s| s.x), mean(|s| s.y));
    // Slopes are held near zero where the samples spread over less than a pixel.
    let ridge = 0.5 * on_it as f64;
    let mut normal = Matrix3::from_diagonal(&Vector3::new(ridge, ridge, 0.0));
    let mut right = Vector3::zeros();
    for s in inliers() {
        let row = Vector3::new(s.x - origin.0, s.y - origin.1, 1.0);
        normal += row * row.transpose();
        right += s.d * row;
    }
    let plane = normal.cholesky()?.solve(&right);
    let low = inliers().map(|s| s.d).fold(f64::INFINITY, f64::min);
    let high = inliers().map(|s| s.d).fold(f64::NEG_INFINITY, f64::max);
    // Beyond the samples no farther than they reach themselves: farther out a plane is a guess.
    let reach = high - low + ON_PLANE;
    Some(Plane { origin, slope: (plane.x, plane.y), d: plane.z, range: (low - reach, high + reach) })
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 60;
    const HEIGHT: usize = 50;

    fn slope(x: usize, y: usize) -> f32 {
        20.0 - 0.2 * x as f32 + 0.1 * y as f32
    }

    /// A slanted plane with a hole where `hole` says, filled; what is there then.
    fn filled(hole: impl Fn(usize, usize) -> bool, d: impl Fn(usize, usize) -> f32) -> Vec<f32> {
        let at = |i: usize| (i % WIDTH, i / WIDTH);
        let states: Vec<PixelState> = (0..WIDTH * HEIGHT)
            .map(|i| if hole(at(i).0, at(i).1) { PixelState::Mismatched } else { PixelState::Matched })
            .collect();
        let value = |(i, state): (usize, &PixelState)| match state {
            PixelState::Matched => d(at(i).0, at(i).1),
            _ => f32::NAN,
        };
        let mut disparity: Vec<f32> = states.iter().enumerate().map(value).collect();
        fill_planes(&mut disparity, &states, &[90; WIDTH * HEIGHT], WIDTH, &mut Planes::default());
        disparity
    }

    #[test]
    fn a_hole_in_a_slanted_plane_is_of_the_plane_inside_and_at_the_border() {
        let inside = |x: usize, y: usize| x.abs_diff(30) + y.abs_diff(25) < 15;
        let corner = |x: usize, y: usize| x < 12 && y < 14;
        // Every tenth sample is of another surface.
        let noisy = |x: usize, y: usize| slope(x, y) + if (x * 7 + y * 3).is_multiple_of(10) { 6.0 } else { 0.0 };
        for (i, d) in filled(|x, y| inside(x, y) || corner(x, y), noisy).iter().enumerate() {
            let (x, y) = (i % WIDTH, i / WIDTH);
            if inside(x, y) || corner(x, y) {
                // The ridge takes a percent of the slope: a tenth of a pixel over the sixty of the image.
                assert!((d - slope(x, y)).abs() < 0.1, "{x} {y}: {d} for {}", slope(x, y));
            }
        }
    }

    #[test]
    fn many_surfaces_and_small_holes_are_left_alone() {
        // No plane holds half of what is around the hole.
        let steps = |x: usize, y: usize| [[5.0, 35.0], [15.0, 25.0]][usize::from(x < 30)][usize::from(y < 20)];
        let four = filled(|x, y| (20..40).contains(&x) && (10..30).contains(&y), steps);
        assert_eq!(four.iter().filter(|d| d.is_nan()).count(), 400);
        let small = filled(|x, y| (20..29).contains(&x) && (10..19).contains(&y), slope);
        assert_eq!(small.iter().filter(|d| d.is_nan()).count(), 81);
        let all = filled(|_, _| true, slope);
        assert!(all.iter().all(|d| d.is_nan()));
    }

    #[test]
    fn what_looks_different_does_not_count() {
        // Pixels above the hole are black and far away.
        let states: Vec<PixelState> = (0..WIDTH * HEIGHT)
            .map(|i| if (20..35).contains(&(i / WIDTH)) { PixelState::Mismatched } else { PixelState::Matched })
            .collect();
        let gray: Vec<u8> = (0..WIDTH * HEIGHT).map(|i| if i / WIDTH < 20 { 0 } else { 200 }).collect();
        let value = |i: usize| match i / WIDTH {
            0..20 => 1.0,
            20..35 => f32::NAN,
            _ => 30.0,
        };
        let mut d: Vec<f32> = (0..WIDTH * HEIGHT).map(value).collect();
        fill_planes(&mut d, &states, &gray, WIDTH, &mut Planes::default());
        // Exact but for the ridge, which holds the slope at the zero that it has.
        assert!(d[20 * WIDTH..35 * WIDTH].iter().all(|d| (d - 30.0).abs() < 1e-3));
    }
}
