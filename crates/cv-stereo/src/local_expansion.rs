//! Planes as labels, chosen by minimum cuts: local expansion moves (Taniai, Matsushita, Sato & Naemura, "Continuous 3D label stereo matching using local expansion
//! moves", PAMI 2018), begun from the map of semi-global matching.
//!
//! Each pixel has a plane of its own. What a labeling costs is how unlike the photographs are along the planes ([`crate::plane_cost`]), how far it leaves what was
//! matched, and how far the planes of neighbors are apart where the photograph has no edge. Region by region planes are offered to 3×3 cells: those of its pixels,
//! planes fitted to them, planes through matches, and changed ones; the pixels that take one are found by a minimum cut. Large cells come first, in
//! pictures of half the size: they give walls and roads their planes, and small ones the outlines.

use crate::PixelState;
use crate::census::Gray;
use crate::expansion_region::{Labels, Problem, Region, SMOOTH, Scratch, pixels};
use crate::plane_cost::{Plane, PlaneCost, at};
use crate::plane_proposals::{Pass, Random, STEP, cell_and_region, fit, middle, offer};
use cv_core::{Cancelled, Progress, Stage};
use fearless_simd::Level;
use rayon::prelude::*;

/// Larger cells are looked at in pictures of half the size each, where they have a quarter of the pixels.
const COARSE: [Pass; 2] = [Pass { cell: 60, sampled: 3, changed: 0 }, Pass { cell: 30, sampled: 2, changed: 0 }];
const FINE: [Pass; 2] = [Pass { cell: 24, sampled: 2, changed: 1 }, Pass { cell: FINEST, sampled: 0, changed: 2 }];
/// Side of the cells that get first planes.
const FINEST: usize = 10;

/// The passes over a picture of which three cells make no more than a side.
fn passes((width, height): (usize, usize), is_coarse: bool) -> impl Iterator<Item = Pass> {
    let fits = move |pass: &Pass| !is_coarse || 3 * pass.cell <= width.min(height);
    (if is_coarse { COARSE } else { FINE }).into_iter().filter(fits)
}

/// The size of the picture of half the size, where it has a pass.
fn half((width, height): (usize, usize)) -> Option<(usize, usize)> {
    let size = (width / 2, height / 2);
    passes(size, true).next().map(|_| size)
}

/// Units of progress: a cell of any size has about as much to do for each of its pixels.
fn work(size: (usize, usize), is_coarse: bool) -> usize {
    let own = passes(size, is_coarse).map(|pass| cells(size, pass.cell) * units(pass)).sum::<usize>();
    own + half(size).map_or(0, |size| work(size, true))
}

fn units(pass: Pass) -> usize {
    (pass.cell * pass.cell).div_ceil(100)
}

fn cells((width, height): (usize, usize), side: usize) -> usize {
    width.div_ceil(side) * height.div_ceil(side)
}

/// Bytes that [`expand`] takes.
pub(crate) fn bytes(width: usize, height: usize) -> usize {
    // Planes, costs, matches, start and two weights; states of the pictures of half the size.
    let pixel = size_of::<Plane>() + 5 * size_of::<f32>() + size_of::<PixelState>();
    let own = PlaneCost::bytes(width, height).saturating_add(width.saturating_mul(height).saturating_mul(pixel));
    // Pictures of half the size are done with before.
    own.max(
        half((width, height))
            .map_or(0, |(width, height)| bytes(width, height).saturating_add(width.saturating_mul(height) * 4)),
    )
}

/// Improves a map without holes. `gray` are both photographs and `range` the least and the greatest disparity. What was matched and is no longer within a pixel of that
/// is [`PixelState::Mismatched`] afterwards.
///
/// Of n pixels O(n log n): each pass is linear, as cuts are in practice.
pub(crate) fn expand(
    level: Level,
    gray: [&Gray; 2],
    range: (f32, f32),
    disparity: &mut [f32],
    states: &mut [PixelState],
    progress: &dyn Progress,
) -> Result<(), Cancelled> {
    let size = (gray[0].width, gray[0].height);
    let stage = Stage::new(progress, "expand", work(size, false))?;
    let matches = disparity.to_vec();
    let planes = solve(level, gray, range, &matches, states, false, &stage)?;
    for ((i, d), (state, matched)) in disparity.iter_mut().enumerate().zip(states.iter_mut().zip(&matches)) {
        *d = at(planes[i], i % size.0, i / size.0).clamp(range.0, range.1);
        if *state == PixelState::Matched && (*d - matched).abs() > 1.0 {
            *state = PixelState::Mismatched;
        }
    }
    Ok(())
}

/// The plane of each pixel. Where nothing was matched it starts from what pictures of half the size show.
fn solve(
    level: Level,
    gray: [&Gray; 2],
    range: (f32, f32),
    matches: &[f32],
    states: &[PixelState],
    is_coarse: bool,
    stage: &Stage<'_>,
) -> Result<Vec<Plane>, Cancelled> {
    let size = (gray[0].width, gray[0].height);
    let width = size.0;
    let mut start = matches.to_vec();
    if let Some((half_width, half_height)) = half(size) {
        let small = gray.map(|gray| {
            let mut small = Gray::default();
            small.halve(gray);
            small
        });
        let (small_matches, small_states) = halve(matches, states, width, (half_width, half_height));
        let range = (0.5 * range.0, 0.5 * range.1);
        let planes = solve(level, small.each_ref(), range, &small_matches, &small_states, true, stage)?;
        for (i, d) in start.iter_mut().enumerate().filter(|(i, _)| states[*i] != PixelState::Matched) {
            let (x, y) = (i % width, i / width);
            // Pixel 0 of the half lies between 0 and 1; its disparities are half of ours.
            let [a, b, c] = planes[(y / 2).min(half_height - 1) * half_width + (x / 2).min(half_width - 1)];
            *d = a * (x as f32 - 0.5) + b * (y as f32 - 0.5) + 2.0 * c;
        }
    }
    let mut cost = PlaneCost::new(level, gray, range.0, stage)?;
    cost.see(matches, states);
    stage.check()?;
    // At half the size outlines are half as long, and surfaces have a quarter of the pixels.
    let smooth = if is_coarse { 0.5 * SMOOTH } else { SMOOTH };
    let problem = Problem::new(level, &cost, states, matches, range, smooth, stage)?;
    let mut labels = first_labels(&problem, &start, stage)?;
    for pass in passes(size, is_coarse) {
        let columns = width.div_ceil(pass.cell);
        // Regions of 3×3 cells that start every fourth cell touch each other nowhere: they do not depend on each other's order.
        for group in 0..16 {
            let own = |cell: &usize| (cell % columns) % 4 == group % 4 && (cell / columns) % 4 == group / 4;
            let regions: Vec<Option<Region>> = (0..cells(size, pass.cell))
                .filter(own)
                .collect::<Vec<_>>()
                .into_par_iter()
                .map_init(Scratch::default, |scratch, cell| {
                    let seed = ((pass.cell as u64) << 32) + cell as u64;
                    let region = offer(&problem, &labels, pass, cell, Random(seed), scratch, stage)?;
                    stage.add(units(pass))?;
                    Ok(region)
                })
                .collect::<Result<_, Cancelled>>()?;
            for region in regions.into_iter().flatten() {
                region.write(&mut labels, width);
            }
        }
    }
    Ok(labels.planes)
}

/// Disparities of pictures of half the size: matched where all four pixels are, on one surface.
fn halve(
    disparity: &[f32],
    states: &[PixelState],
    width: usize,
    (half_width, half_height): (usize, usize),
) -> (Vec<f32>, Vec<PixelState>) {
    (0..half_width * half_height)
        .map(|i| {
            let first = i / half_width * 2 * width + i % half_width * 2;
            let four = [first, first + 1, first + width, first + width + 1];
            let all = four.map(|i| disparity[i]);
            let (low, high) = all.iter().fold((all[0], all[0]), |(low, high), &d| (low.min(d), high.max(d)));
            let is_matched = high - low <= 2.0 * STEP && four.iter().all(|&i| states[i] == PixelState::Matched);
            let mean = 0.125 * (all[0] + all[1] + all[2] + all[3]);
            let d = if high - low <= 2.0 * STEP { mean } else { 0.5 * all[0] };
            (d, if is_matched { PixelState::Matched } else { PixelState::Mismatched })
        })
        .unzip()
}
/// Planes fitted to the surfaces of each of the smallest cells, as `start` has them.
fn first_labels(problem: &Problem<'_>, start: &[f32], stage: &Stage<'_>) -> Result<Labels, Cancelled> {
    let size = problem.cost.size();
    let (width, height) = size;
    let found: Vec<Vec<(usize, Plane, f32)>> = (0..cells(size, FINEST))
        .into_par_iter()
        .map_init(Scratch::default, |scratch, cell| {
            stage.check()?;
            let (own, _) = cell_and_region(cell, FINEST, size);
            let (around, center) = (own.grown(FINEST / 2, size), middle(&own));
            let mut order: Vec<(f32, usize)> = pixels(own).map(|(x, y)| y * width + x).map(|i| (start[i], i)).collect();
            order.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut labels = Vec::with_capacity(order.len());
            for surface in order.chunk_by(|a, b| b.0 - a.0 <= STEP) {
                let mut plane = [0.0, 0.0, surface[surface.len() / 2].0];
                for limit in [2.0, 1.0] {
                    let near = pixels(around).map(|(x, y)| (x, y, start[y * width + x]));
                    let near = near.filter(|&(x, y, d)| (d - at(plane, x, y)).abs() <= limit);
                    plane = fit(near, center).unwrap_or(plane);
                }
                problem.cost.of(problem.level, plane, own, &mut scratch.cost);
                labels.extend(surface.iter().map(|&(_, i)| {
                    let (x, y) = (i % width, i / width);
                    let seen = scratch.cost.result[(y - own.top) * own.width() + x - own.left];
                    (i, plane, seen + problem.off_match(i, at(plane, x, y)))
                }));
            }
            Ok(labels)
        })
        .collect::<Result<_, Cancelled>>()?;
    let mut labels = Labels { planes: vec![[0.0; 3]; width * height], costs: vec![0.0; width * height] };
    for (i, plane, cost) in found.into_iter().flatten() {
        (labels.planes[i], labels.costs[i]) = (plane, cost);
    }
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::census::MARGIN;
    use cv_core::Silent;
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

    const SIZE: (usize, usize) = (200, 190);

    /// Photographs of surfaces whose disparity and gray are given by the pixel of the left one; the gray also by its column between pixels.
    fn pair(disparity: impl Fn(usize, usize) -> f32, gray: impl Fn(f32, usize, usize) -> f32) -> [Gray; 2] {
        let (width, height) = SIZE;
        let stride = width + 2 * MARGIN;
        let empty = || Gray { values: vec![0; stride * height], width, height };
        let [mut left, mut right] = [empty(), empty()];
        for y in 0..height {
            // Twentieths of a pixel of the left photograph, painted where the right camera sees them, the nearest last.
            let mut samples: Vec<(f32, f32, f32)> = (0..20 * width)
                .map(|s| {
                    let x = s as f32 / 20.0;
                    let column = x.round() as usize;
                    let d = disparity(column, y);
                    (d, x - d, gray(x, column, y))
                })
                .collect();
            samples.sort_by(|a, b| a.0.total_cmp(&b.0));
            for (_, x, value) in samples {
                if (0.0..width as f32).contains(&x) && x.fract() < 0.06 {
                    right.values[y * stride + MARGIN + x as usize] = (257.0 * value) as u16;
                }
            }
            for x in 0..width {
                left.values[y * stride + MARGIN + x] = (257.0 * gray(x as f32, x, y)) as u16;
            }
        }
        [left, right]
    }

    fn texture(x: f32, y: usize) -> f32 {
        128.0 + 30.0 * (0.9 * x + 0.2 * y as f32).sin() + 30.0 * (0.37 * x - 0.8 * y as f32).cos()
    }

    /// The map after [`expand`], and its states. Before, it is as `start` says where that says something, and matched and right elsewhere.
    fn expanded(
        pair: &[Gray; 2],
        truth: impl Fn(usize, usize) -> f32,
        start: impl Fn(usize, usize) -> Option<(f32, PixelState)>,
        progress: &dyn Progress,
    ) -> Result<(Vec<f32>, Vec<PixelState>), Cancelled> {
        let all = (0..SIZE.0 * SIZE.1).map(|i| (i % SIZE.0, i / SIZE.0));
        let (mut disparity, mut states): (Vec<f32>, Vec<PixelState>) =
            all.map(|(x, y)| start(x, y).unwrap_or_else(|| (truth(x, y), PixelState::Matched))).unzip();
        expand(Level::new(), pair.each_ref(), (0.0, 40.0), &mut disparity, &mut states, progress)?;
        Ok((disparity, states))
    }

    /// The pixels of which something holds.
    fn where_it_holds(f: impl Fn(usize, usize) -> bool) -> Vec<usize> {
        (0..SIZE.0 * SIZE.1).filter(|i| f(i % SIZE.0, i / SIZE.0)).collect()
    }

    #[test]
    fn a_wall_is_one_plane_behind_what_is_flat() {
        let truth = |x: usize, y: usize| 3.0 + 0.05 * x as f32 + 0.01 * y as f32;
        let is_flat = |x: usize, y: usize| (60..140).contains(&x) && (50..130).contains(&y);
        let pair = pair(truth, |x, column, y| if is_flat(column, y) { 128.0 } else { texture(x, y) });
        // What lies left of it is continued along the rows: up to 4 px off.
        let start = |x, y| is_flat(x, y).then(|| (truth(60, y), PixelState::Mismatched));
        let (map, _) = expanded(&pair, truth, start, &Silent).unwrap();
        let inside = where_it_holds(is_flat);
        let right = inside.iter().filter(|&&i| (map[i] - truth(i % SIZE.0, i / SIZE.0)).abs() < 0.5).count();
        // All but what a cell at the border of the flat part may keep.
        assert!(right * 100 >= inside.len() * 98, "{right} of {}", inside.len());
    }

    #[test]
    fn outlines_move_to_the_edges_of_the_photograph() {
        // A box of another gray before a wall; the map is 6 px too wide on either side.
        let is_near = |x: usize, y: usize| (80..130).contains(&x) && (60..140).contains(&y);
        let truth = |x: usize, y: usize| if is_near(x, y) { 20.0 } else { 6.0 };
        let gray =
            |x: f32, column: usize, y: usize| 0.6 * texture(1.3 * x, y) + if is_near(column, y) { 80.0 } else { 0.0 };
        let pair = pair(truth, gray);
        let is_wide = |x: usize, y: usize| (74..136).contains(&x) && (60..140).contains(&y) && !is_near(x, y);
        let start = |x, y| is_wide(x, y).then_some((20.0, PixelState::Mismatched));
        let (map, _) = expanded(&pair, truth, start, &Silent).unwrap();
        let around = where_it_holds(is_wide);
        let wrong = around.iter().filter(|&&i| (map[i] - 6.0).abs() > 1.0).count();
        // A pixel of six on either side: the windows of the census reach over two.
        assert!(wrong * 6 <= around.len(), "{wrong} of {}", around.len());
        let near = where_it_holds(is_near);
        let lost = near.iter().filter(|&&i| (map[i] - 20.0).abs() > 1.0).count();
        assert!(lost * 100 <= near.len(), "{lost} of {}", near.len());
    }

    #[test]
    fn what_leaves_its_match_is_matched_no_more() {
        // A stripe of a wall was matched 9 px too near.
        let pair = pair(|_, _| 8.0, |x, _, y| texture(x, y));
        let is_stripe = |x: usize, y: usize| x > 30 && (100..104).contains(&y);
        let start = |x, y| is_stripe(x, y).then_some((17.0, PixelState::Matched));
        let (map, states) = expanded(&pair, |_, _| 8.0, start, &Silent).unwrap();
        let stripe = where_it_holds(is_stripe);
        let corrected = stripe.iter().filter(|&&i| (map[i] - 8.0).abs() < 0.5);
        assert!(corrected.clone().count() * 10 >= stripe.len() * 9);
        assert!(corrected.into_iter().all(|&i| states[i] == PixelState::Mismatched));
        // And nothing else is.
        let others = where_it_holds(|x, y| !is_stripe(x, y));
        let kept = others.iter().filter(|&&i| states[i] == PixelState::Matched && (map[i] - 8.0).abs() < 0.5).count();
        assert!(kept * 100 >= others.len() * 99, "{kept} of {}", others.len());
    }

    /// Stops at a report, and keeps the last numbers.
    struct Reports {
        left: AtomicUsize,
        done: AtomicUsize,
        total: AtomicUsize,
    }

    impl Reports {
        fn stop_after(reports: usize) -> Self {
            Self { left: reports.into(), done: 0.into(), total: 0.into() }
        }
    }

    impl Progress for Reports {
        fn report(&self, _: &str, done: usize, total: usize) -> Result<(), Cancelled> {
            self.done.fetch_max(done, Relaxed);
            self.total.store(total, Relaxed);
            self.left.fetch_update(Relaxed, Relaxed, |n| n.checked_sub(1)).map(|_| ()).map_err(|_| Cancelled)
        }
    }

    #[test]
    fn it_reports_all_of_its_work_and_stops_where_it_is_told() {
        let pair = pair(|_, _| 8.0, |x, _, y| texture(x, y));
        let run = |reports: &Reports| expanded(&pair, |_, _| 8.0, |_, _| None, reports);
        let all = Reports::stop_after(usize::MAX);
        run(&all).unwrap();
        assert_eq!(all.done.into_inner(), all.total.into_inner());
        for reports in [0, 1, 5, 50] {
            assert!(run(&Reports::stop_after(reports)).is_err(), "{reports}");
        }
    }
}
