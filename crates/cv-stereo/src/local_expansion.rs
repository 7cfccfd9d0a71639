//! Local expansion moves over slanted planes (Taniai, Matsushita, Sato & Naemura, "Continuous 3D label stereo matching using local
//! expansion moves", PAMI 2018), initialized by semi-global matching.
//!
//! The label of a pixel is a plane. The energy has a data term, the dissimilarity of both images along the planes ([`crate::plane_cost`]), the
//! distance from the matches of semi-global matching, and a smoothness term, the distance between the planes of neighbors, which image
//! edges reduce. Regions of 3×3 cells get plane proposals in turn, and a minimum cut finds the pixels that take one. Large cells at half
//! resolution come first, for walls and roads; small ones recover depth discontinuities.

use crate::PixelState;
use crate::census::Gray;
use crate::expansion_region::{Labels, Problem, Region, SMOOTHNESS, Scratch, pixels};
use crate::plane_cost::{Plane, PlaneCost, at};
use crate::plane_proposals::{MAX_STEP, Pass, Random, cell_and_region, center_of, fit_plane, propose_planes};
use cv_core::{Cancelled, Progress, Stage};
use cv_parallel::prelude::*;
use fearless_simd::Level;

/// Passes at coarser levels, where large cells have fewer pixels, and at full resolution.
const COARSE: [Pass; 3] = [
    Pass { cell: 60, ransac: 3, sloped: 0, perturbed: 0 },
    Pass { cell: 30, ransac: 2, sloped: 0, perturbed: 0 },
    Pass { cell: 20, ransac: 2, sloped: 0, perturbed: 0 },
];
/// Sloped planes only in small cells: in larger ones they spread over textureless walls. Without any, 3.7 % of the errors of Middlebury's
/// Teddy are above 2 px in place of 2.3. Two sizes of them, whose cells have different borders: one size of 10 px leaves 2.5 % where these
/// leave 1.9.
const FINE: [Pass; 3] = [
    Pass { cell: 24, ransac: 2, sloped: 0, perturbed: 1 },
    Pass { cell: 12, ransac: 0, sloped: 3, perturbed: 1 },
    Pass { cell: 8, ransac: 0, sloped: 3, perturbed: 2 },
];
/// Side in px of the cells that the initial planes are fitted to.
const INITIAL_CELL: usize = 10;

/// Returns the passes over an image; at coarser levels those whose regions fit into it.
fn passes((width, height): (usize, usize), is_coarse: bool) -> impl Iterator<Item = Pass> {
    let fits = move |pass: &Pass| !is_coarse || 3 * pass.cell <= width.min(height);
    (if is_coarse { COARSE } else { FINE }).into_iter().filter(fits)
}

/// Returns the size at half resolution, if that level has a pass.
fn half_resolution_size((width, height): (usize, usize)) -> Option<(usize, usize)> {
    let size = (width / 2, height / 2);
    passes(size, true).next().map(|_| size)
}

/// Returns the units of progress: in proportion to pixels times passes.
fn progress_units(size: (usize, usize), is_coarse: bool) -> usize {
    let own = passes(size, is_coarse).map(|pass| cell_count(size, pass.cell) * cell_units(pass)).sum::<usize>();
    own + half_resolution_size(size).map_or(0, |size| progress_units(size, true))
}

fn cell_units(pass: Pass) -> usize {
    (pass.cell * pass.cell).div_ceil(100)
}

fn cell_count((width, height): (usize, usize), side: usize) -> usize {
    width.div_ceil(side) * height.div_ceil(side)
}

/// Returns the bytes that [`expand`] takes.
pub(crate) fn bytes(width: usize, height: usize) -> usize {
    // Planes, costs, matches, initial disparities and two weights; states at half resolution.
    let pixel = size_of::<Plane>() + 5 * size_of::<f32>() + size_of::<PixelState>();
    let own = PlaneCost::bytes(width, height).saturating_add(width.saturating_mul(height).saturating_mul(pixel));
    // The coarser level is freed before.
    own.max(
        half_resolution_size((width, height))
            .map_or(0, |(width, height)| bytes(width, height).saturating_add(width.saturating_mul(height) * 4)),
    )
}

/// Improves a map without holes. `gray` are both images and `range` the smallest and the largest disparity. Matched pixels that move by more
/// than a pixel become [`PixelState::Mismatched`].
///
/// Linear in the number of pixels per pass, as minimum cuts of constant size are in practice.
pub(crate) fn expand(
    level: Level,
    gray: [&Gray; 2],
    range: (f32, f32),
    disparity: &mut [f32],
    states: &mut [PixelState],
    progress: &dyn Progress,
) -> Result<(), Cancelled> {
    let size = (gray[0].width, gray[0].height);
    let stage = Stage::new(progress, "expand", progress_units(size, false))?;
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

/// Returns the plane of each pixel. Unmatched pixels are initialized from the level of half resolution.
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
    let mut initial = matches.to_vec();
    if let Some((half_width, half_height)) = half_resolution_size(size) {
        let small = gray.map(|gray| {
            let mut small = Gray::default();
            small.halve(gray);
            small
        });
        let (small_matches, small_states) = halve(matches, states, width, (half_width, half_height));
        let range = (0.5 * range.0, 0.5 * range.1);
        let planes = solve(level, small.each_ref(), range, &small_matches, &small_states, true, stage)?;
        for (i, d) in initial.iter_mut().enumerate().filter(|(i, _)| states[*i] != PixelState::Matched) {
            let (x, y) = (i % width, i / width);
            // Pixel 0 at half resolution is between pixels 0 and 1; its disparities are half of those here.
            let [a, b, c] = planes[(y / 2).min(half_height - 1) * half_width + (x / 2).min(half_width - 1)];
            *d = a * (x as f32 - 0.5) + b * (y as f32 - 0.5) + 2.0 * c;
        }
    }
    let mut cost = PlaneCost::new(level, gray, range.0, stage)?;
    cost.set_known(matches, states);
    stage.check()?;
    // At half resolution boundaries have half the pixels, and surfaces a quarter.
    let smoothness = if is_coarse { 0.5 * SMOOTHNESS } else { SMOOTHNESS };
    let problem = Problem::new(level, &cost, states, matches, range, smoothness, stage)?;
    let mut labels = initial_labels(&problem, &initial, stage)?;
    for pass in passes(size, is_coarse) {
        let columns = width.div_ceil(pass.cell);
        // Expansion regions of every fourth cell are disjoint and not adjacent: their moves are independent.
        for group in 0..16 {
            let own = |cell: &usize| (cell % columns) % 4 == group % 4 && (cell / columns) % 4 == group / 4;
            let regions: Vec<Option<Region>> = (0..cell_count(size, pass.cell))
                .filter(own)
                .collect::<Vec<_>>()
                .into_par_iter()
                .map_init(Scratch::default, |scratch, cell| {
                    let seed = ((pass.cell as u64) << 32) + cell as u64;
                    let region = propose_planes(&problem, &labels, pass, cell, Random(seed), scratch, stage)?;
                    stage.add(cell_units(pass))?;
                    Ok(region)
                })
                .try_collect::<_, Cancelled>()?;
            for region in regions.into_iter().flatten() {
                region.write(&mut labels, width);
            }
        }
    }
    Ok(labels.planes)
}

/// Downsamples a map to half resolution: matched if all four pixels are matched and on one surface.
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
            let is_matched = high - low <= 2.0 * MAX_STEP && four.iter().all(|&i| states[i] == PixelState::Matched);
            let mean = 0.125 * (all[0] + all[1] + all[2] + all[3]);
            let d = if high - low <= 2.0 * MAX_STEP { mean } else { 0.5 * all[0] };
            (d, if is_matched { PixelState::Matched } else { PixelState::Mismatched })
        })
        .unzip()
}

/// Fits planes to the surfaces of the `initial` disparities in cells.
fn initial_labels(problem: &Problem<'_>, initial: &[f32], stage: &Stage<'_>) -> Result<Labels, Cancelled> {
    let size = problem.cost.size();
    let (width, height) = size;
    let found: Vec<Vec<(usize, Plane, f32)>> = (0..cell_count(size, INITIAL_CELL))
        .into_par_iter()
        .map_init(Scratch::default, |scratch, cell| {
            stage.check()?;
            let (own, _) = cell_and_region(cell, INITIAL_CELL, size);
            let (around, center) = (own.grown(INITIAL_CELL / 2, size), center_of(&own));
            let mut order: Vec<(f32, usize)> =
                pixels(own).map(|(x, y)| y * width + x).map(|i| (initial[i], i)).collect();
            order.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut labels = Vec::with_capacity(order.len());
            for surface in order.chunk_by(|a, b| b.0 - a.0 <= MAX_STEP) {
                let mut plane = [0.0, 0.0, surface[surface.len() / 2].0];
                for limit in [2.0, 1.0] {
                    let near = pixels(around).map(|(x, y)| (x, y, initial[y * width + x]));
                    let near = near.filter(|&(x, y, d)| (d - at(plane, x, y)).abs() <= limit);
                    plane = fit_plane(near, center).unwrap_or(plane);
                }
                problem.cost.compute(problem.level, plane, own, &mut scratch.cost);
                labels.extend(surface.iter().map(|&(_, i)| {
                    let (x, y) = (i % width, i / width);
                    let data = scratch.cost.result[(y - own.top) * own.width() + x - own.left];
                    (i, plane, data + problem.match_cost(i, at(plane, x, y)))
                }));
            }
            Ok(labels)
        })
        .try_collect::<_, Cancelled>()?;
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

    /// Renders surfaces whose disparity and gray level are given by the pixel of the left image; the gray level also by the sub-pixel column.
    fn pair(disparity: impl Fn(usize, usize) -> f32, gray: impl Fn(f32, usize, usize) -> f32) -> [Gray; 2] {
        let (width, height) = SIZE;
        let stride = width + 2 * MARGIN;
        let empty = || Gray { values: vec![0; stride * height], width, height };
        let [mut left, mut right] = [empty(), empty()];
        for y in 0..height {
            // Twentieths of a pixel of the left image, rendered into the right one, the nearest last.
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

    /// Returns the map after [`expand`], and its states. The input is `start` where that is given, and matched and correct elsewhere.
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

    /// Returns the pixels that satisfy a condition.
    fn pixels_where(f: impl Fn(usize, usize) -> bool) -> Vec<usize> {
        (0..SIZE.0 * SIZE.1).filter(|i| f(i % SIZE.0, i / SIZE.0)).collect()
    }

    #[test]
    fn a_textureless_part_of_a_wall_gets_its_plane() {
        let truth = |x: usize, y: usize| 3.0 + 0.05 * x as f32 + 0.01 * y as f32;
        let is_flat = |x: usize, y: usize| (60..140).contains(&x) && (50..130).contains(&y);
        let pair = pair(truth, |x, column, y| if is_flat(column, y) { 128.0 } else { texture(x, y) });
        // Constant along the rows: up to 4 px off.
        let start = |x, y| is_flat(x, y).then(|| (truth(60, y), PixelState::Mismatched));
        let (map, _) = expanded(&pair, truth, start, &Silent).unwrap();
        let inside = pixels_where(is_flat);
        let right = inside.iter().filter(|&&i| (map[i] - truth(i % SIZE.0, i / SIZE.0)).abs() < 0.5).count();
        // All but pixels that a cell at the border of the textureless part may keep.
        assert!(right * 100 >= inside.len() * 98, "{right} of {}", inside.len());
    }

    #[test]
    fn a_wall_of_noise_keeps_the_plane_that_fills_it() {
        // Independent noise, which increases to the right, on a shaded wall: nearer planes have smaller costs.
        let noise = |seed: usize| {
            let mut hash = (seed as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            hash = (hash ^ (hash >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            (hash >> 40) as f32 / (1 << 24) as f32 - 0.5
        };
        let is_wall = |x: usize, y: usize| x < 150 && (20..170).contains(&y);
        let truth = |x: usize, _: usize| 8.0 + 0.05 * x as f32;
        let mut images = pair(truth, |x, column, y| if is_wall(column, y) { 200.0 } else { texture(x, y) });
        for (side, image) in images.iter_mut().enumerate() {
            for y in 20..170 {
                // Up to the column where the wall ends in this image.
                for x in 0..[150, 134][side] {
                    let level = 150.0 + x as f32 * (0.1 + 0.03 * noise((side * SIZE.1 + y) * SIZE.0 + x));
                    image.values[y * (SIZE.0 + 2 * MARGIN) + MARGIN + x] = (257.0 * level) as u16;
                }
            }
        }
        let start = |x, y| is_wall(x, y).then(|| (truth(x, y), PixelState::Mismatched));
        let (map, _) = expanded(&images, truth, start, &Silent).unwrap();
        let wall = pixels_where(is_wall);
        let kept = wall.iter().filter(|&&i| (map[i] - truth(i % SIZE.0, 0)).abs() < 2.0).count();
        // 91 % without the prior.
        assert!(kept * 100 >= wall.len() * 98, "{kept} of {}", wall.len());
    }

    #[test]
    fn a_table_at_a_grazing_angle_gets_its_slope() {
        // The lowest 30 rows, by a pixel per row; the map continues the wall.
        let is_table = |y: usize| y >= 160;
        let truth = |_: usize, y: usize| 6.0 + if is_table(y) { y as f32 - 160.0 } else { 0.0 };
        let pair = pair(truth, |x, _, y| texture(x, y));
        let start = |_, y| is_table(y).then_some((6.0, PixelState::Mismatched));
        let (map, _) = expanded(&pair, truth, start, &Silent).unwrap();
        // The table's last row has disparity 35: to the left of that it is out of view.
        let table = pixels_where(|x, y| is_table(y) && x >= 40);
        let right = table.iter().filter(|&&i| (map[i] - truth(0, i / SIZE.0)).abs() < 0.5).count();
        // Slopes are random: not every cell has the right one. Without them 4 % are right.
        assert!(right * 2 >= table.len(), "{right} of {}", table.len());
    }

    #[test]
    fn depth_discontinuities_move_to_image_edges() {
        // A box of another gray level in front of a wall; the map is 6 px too wide on either side.
        let is_near = |x: usize, y: usize| (80..130).contains(&x) && (60..140).contains(&y);
        let truth = |x: usize, y: usize| if is_near(x, y) { 20.0 } else { 6.0 };
        let gray =
            |x: f32, column: usize, y: usize| 0.6 * texture(1.3 * x, y) + if is_near(column, y) { 80.0 } else { 0.0 };
        let pair = pair(truth, gray);
        let is_wide = |x: usize, y: usize| (74..136).contains(&x) && (60..140).contains(&y) && !is_near(x, y);
        let start = |x, y| is_wide(x, y).then_some((20.0, PixelState::Mismatched));
        let (map, _) = expanded(&pair, truth, start, &Silent).unwrap();
        let around = pixels_where(is_wide);
        let wrong = around.iter().filter(|&&i| (map[i] - 6.0).abs() > 1.0).count();
        // One of six pixels on either side: the census windows have a radius of two.
        assert!(wrong * 6 <= around.len(), "{wrong} of {}", around.len());
        let near = pixels_where(is_near);
        let lost = near.iter().filter(|&&i| (map[i] - 20.0).abs() > 1.0).count();
        assert!(lost * 100 <= near.len(), "{lost} of {}", near.len());
    }

    #[test]
    fn matched_pixels_that_move_become_mismatched() {
        // A stripe of a wall was matched 9 px too near.
        let pair = pair(|_, _| 8.0, |x, _, y| texture(x, y));
        let is_stripe = |x: usize, y: usize| x > 30 && (100..104).contains(&y);
        let start = |x, y| is_stripe(x, y).then_some((17.0, PixelState::Matched));
        let (map, states) = expanded(&pair, |_, _| 8.0, start, &Silent).unwrap();
        let stripe = pixels_where(is_stripe);
        let corrected = stripe.iter().filter(|&&i| (map[i] - 8.0).abs() < 0.5);
        assert!(corrected.clone().count() * 10 >= stripe.len() * 9);
        assert!(corrected.into_iter().all(|&i| states[i] == PixelState::Mismatched));
        // And no other pixels.
        let others = pixels_where(|x, y| !is_stripe(x, y));
        let kept = others.iter().filter(|&&i| states[i] == PixelState::Matched && (map[i] - 8.0).abs() < 0.5).count();
        assert!(kept * 100 >= others.len() * 99, "{kept} of {}", others.len());
    }

    /// Stops after a number of reports, and records the last numbers.
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
    fn progress_is_reported_completely_and_stops_the_job() {
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
