//! Hole filling: the surrounding surfaces are extrapolated into holes as slanted planes, and each cell of a hole is assigned the surface that
//! best explains why it was not matched.
//!
//! The data term of a plane at a pixel models the three causes: see [`crate::fill_cost`]. Labels are propagated along geodesic paths, which image edges lengthen; then iterated conditional modes (Besag, JRSS
//! B 1986) replace the plane of a cell by that of a neighbor if the energy decreases (planes as labels: Bleyer, Rhemann & Rother,
//! "PatchMatch stereo", BMVC 2011).

use crate::PixelState;
use crate::border_mask::PairMasks;
use crate::fill_cost::{Matches, Pair, RightColumns, View, texture_weight, unmatched_state};
use crate::fill_uncertainty::Extrapolation;
use crate::surfaces::{CELL, NONE, Surfaces, center, extent, neighbors};
use cv_core::{Cancelled, Stage};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

// Set with the constants of `surfaces`; half and twice of each differ by 0.1 points of the errors above 2 px.
/// Smoothness term: its maximum, and the distance in px between the planes of neighbors at which it is reached.
const SMOOTHNESS: f32 = 8.0;
const MAX_DISTANCE: f32 = 4.0;
/// Difference in gray levels of neighboring cells that halves the smoothness term and doubles the geodesic distance.
const EDGE_GRAY: f32 = 8.0;
/// Number of cells of a surface from which geodesic distances have scale 1, and the range of the scale. Half and twice of each differ by 0.1
/// points of the errors above 2 px; without the scale Middlebury's Vintage has 17 % of errors above 2 px in place of 10.
const REFERENCE_SIZE: f32 = 64.0;
const DISTANCE_SCALE_RANGE: (f32, f32) = (0.25, 2.0);
/// Weight of the data term of a cell in the geodesic distance.
const PATH_COST_WEIGHT: f32 = 0.1;
/// Passes of iterated conditional modes, down and up.
const PASSES: usize = 2;
/// Truncation in gray levels of the difference between a pixel and the cells of a surface.
const MAX_GRAY_DIFFERENCE: f32 = 32.0;
/// Weight of the data term relative to that difference.
const DATA_WEIGHT: f32 = 2.0;
/// Number of values in the largest vector.
const MAX_LANES: usize = 16;
/// Distance in px below which two planes are the same over a cell.
const SAME_PLANE: f32 = 0.5;

/// Buffers of [`fill`], reused between frames.
#[derive(Debug, Default)]
pub(crate) struct Filling {
    surfaces: Surfaces,
    /// Disparity of the nearest match of each pixel of the right image, −∞ without any, +∞ without data.
    pub(crate) right: Vec<f32>,
    /// Cells without an initial surface.
    open: Vec<u32>,
    is_stale: Vec<bool>,
    heap: BinaryHeap<Reverse<(u64, u32, u32)>>,
    /// Of each cell.
    extrapolations: Vec<Extrapolation>,
}

/// Returns the bytes of the buffers of [`fill`].
pub(crate) fn bytes(width: usize, height: usize) -> usize {
    Surfaces::bytes(width, height).saturating_add(width.saturating_mul(height).saturating_mul(size_of::<f32>()))
}

/// Fills every NaN, sets the state of those pixels by their disparity, and smooths matches in low texture
/// ([`Surfaces::smooth_low_texture`]). Without any match everything stays NaN. O(n + c log c) for n pixels in c cells.
pub(crate) fn fill(
    level: Level,
    disparity: &mut [f32],
    states: &mut [PixelState],
    pair: Pair<'_>,
    filling: &mut Filling,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let width = pair.width;
    let Filling { surfaces, right, open, is_stale, heap, extrapolations } = filling;
    extrapolations.clear();
    surfaces.measure_cells(level, disparity, pair.gray, width);
    // Surfaces grow on one thread.
    let (matches, of_matches) = (&*disparity, &*states);
    rayon::join(
        || surfaces.segment(pair.min_disparity as f32),
        || project_matches(level, matches, of_matches, width, pair.masks, right),
    );
    stage.check()?;
    if surfaces.planes.is_empty() {
        return Ok(());
    }
    surfaces.smooth_low_texture(disparity, width);
    stage.check()?;
    surfaces.add_local_planes();
    let view = View { pair, right, columns: RightColumns::new(&pair) };
    let matches = Matches { disparity, states };
    open.clear();
    open.extend((0..surfaces.cells.len() as u32).filter(|&c| surfaces.labels[c as usize] == NONE));
    extrapolations.resize(surfaces.cells.len(), Extrapolation::default());
    propagate_labels(surfaces, view, matches, heap, extrapolations, stage)?;
    // Cells of which a neighbor changed since they were updated.
    is_stale.clear();
    is_stale.resize(surfaces.cells.len(), true);
    for pass in 0..PASSES {
        for i in 0..open.len() {
            let c = open[if pass % 2 == 0 { i } else { open.len() - 1 - i }] as usize;
            if std::mem::take(&mut is_stale[c]) && update_label(surfaces, view, matches, c) {
                surfaces.around(c).for_each(|n| is_stale[n] = n != c);
            }
            if i.is_multiple_of(1024) {
                stage.check()?;
            }
        }
    }
    for &c in open.iter() {
        extrapolations[c as usize].ambiguity = surfaces.ambiguity(c as usize);
    }
    let surfaces = &*surfaces;
    let rows = disparity.par_chunks_mut(CELL * width).zip(states.par_chunks_mut(CELL * width));
    rows.enumerate().for_each(|(row, (disparity, states))| {
        dispatch!(level, simd => fill_row(simd, surfaces, view, row, (disparity, states)));
    });
    Ok(())
}

impl Filling {
    /// Returns the standard deviation in px of a pixel that the last [`fill`] of an image of this width filled; NaN if there was none.
    pub(crate) fn sigma(&self, x: usize, y: usize, width: usize, state: PixelState) -> f32 {
        let columns = width.div_ceil(CELL);
        let cell = self.extrapolations.get(y / CELL * columns + x / CELL).filter(|_| columns == self.surfaces.columns);
        cell.map_or(f32::NAN, |cell| cell.sigma(state))
    }
}

/// Sets the states of unmatched pixels by their current disparities.
pub(crate) fn classify_unmatched(
    level: Level,
    disparity: &[f32],
    states: &mut [PixelState],
    width: usize,
    masks: PairMasks<'_>,
    filling: &mut Filling,
) {
    project_matches(level, disparity, states, width, masks, &mut filling.right);
    let rows = disparity.par_chunks(width).zip(filling.right.par_chunks(width));
    states.par_chunks_mut(width).zip(rows).for_each(|(states, (disparity, right))| {
        for (x, (state, d)) in states.iter_mut().zip(disparity).enumerate() {
            if *state != PixelState::Matched {
                *state = unmatched_state(x, *d, right);
            }
        }
    });
}

/// Projects the matches to the right image: the nearest at each pixel.
fn project_matches(
    level: Level,
    disparity: &[f32],
    states: &[PixelState],
    width: usize,
    masks: PairMasks<'_>,
    right: &mut Vec<f32>,
) {
    right.resize(disparity.len(), f32::NEG_INFINITY);
    let rows = disparity.par_chunks(width).zip(states.par_chunks(width));
    right.par_chunks_mut(width).zip(rows).enumerate().for_each_init(
        || (vec![0f32; width.next_multiple_of(MAX_LANES)], vec![0f32; width + 1]),
        |(columns, nearest), (y, (right, (disparity, states)))| {
            dispatch!(level, simd => project_row(simd, disparity, states, columns, nearest));
            right.copy_from_slice(&nearest[..width]);
            masks.row(y).iter().for_each(|masks| masks.fill_right(right, f32::INFINITY));
        },
    );
}

/// Projects the matches of a row; `columns` is scratch, and the last element of `nearest` is that of all other pixels.
#[simd]
fn project_row<S: Simd>(simd: S, disparity: &[f32], states: &[PixelState], columns: &mut [f32], nearest: &mut [f32]) {
    let width = disparity.len();
    for (x, (column, (&d, &state))) in columns.iter_mut().zip(disparity.iter().zip(states)).enumerate() {
        // Rounded to the nearest column. NaN compares false.
        let at = x as i32 as f32 - d + 0.5;
        let is_inside = (state == PixelState::Matched) & (at >= 0.0) & (at < width as f32);
        *column = if is_inside { at } else { width as f32 };
    }
    nearest.fill(f32::NEG_INFINITY);
    let lanes = S::f32s::LEN;
    for (columns, disparity) in columns.chunks_exact(lanes).zip(disparity.chunks(lanes)) {
        let columns = S::f32s::from_slice(simd, columns).to_int::<S::u32s>();
        for (&column, &d) in columns.as_slice().iter().zip(disparity) {
            let nearest = &mut nearest[column as usize];
            *nearest = if d > *nearest { d } else { *nearest };
        }
    }
}

/// Assigns every cell without a surface that of the cell at the shortest geodesic distance (Dijkstra's algorithm).
fn propagate_labels(
    surfaces: &mut Surfaces,
    view: View<'_>,
    matches: Matches<'_>,
    heap: &mut BinaryHeap<Reverse<(u64, u32, u32)>>,
    extrapolations: &mut [Extrapolation],
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    heap.clear();
    let (columns, count) = (surfaces.columns, surfaces.cells.len());
    let rows = count / columns;
    let scales: Vec<[f32; 2]> = surfaces.sizes.iter().map(|&size| distance_scales(size)).collect();
    // In 1/1024 of a cell, as integers, so that ties are broken deterministically.
    let visit = |surfaces: &Surfaces, heap: &mut BinaryHeap<_>, c: usize, so_far: u64, label: u32| {
        for n in neighbors(c, columns, rows).into_iter().flatten().filter(|&n| surfaces.labels[n] == NONE) {
            let plane = view.plane(surfaces, label, n);
            let edge = (surfaces.cells[c].gray - surfaces.cells[n].gray).abs() / EDGE_GRAY;
            let [cost] = view.cell_costs::<1, 2, 4>(matches, surfaces, n, &[Some(plane)]);
            let (x, y) = center(n, columns);
            let is_out_of_view = x < f64::from(plane.at(x, y));
            let step = scales[label as usize][usize::from(is_out_of_view)] * (1.0 + edge + PATH_COST_WEIGHT * cost);
            heap.push(Reverse((so_far + (1024.0 * step) as u64, n as u32, label)));
        }
    };
    for c in 0..count {
        if surfaces.labels[c] != NONE {
            visit(surfaces, heap, c, 0, surfaces.labels[c]);
        }
    }
    let mut taken = 0usize;
    while let Some(Reverse((cost, c, label))) = heap.pop() {
        let c = c as usize;
        if surfaces.labels[c] == NONE {
            surfaces.labels[c] = label;
            extrapolations[c].distance = cost as f32 / 1024.0;
            visit(surfaces, heap, c, cost, label);
            taken += 1;
            if taken.is_multiple_of(1024) {
                stage.check()?;
            }
        }
    }
    Ok(())
}

/// Returns the scales of the geodesic distance from a surface of `size` cells, for cells in view and out of view. The distance is in units of
/// the extent of the surface, `√size`, since a large surface determines its extrapolation more accurately and is more likely to
/// continue; out of view its root, since there the object at the image border is mostly continued, whatever its size.
fn distance_scales(size: usize) -> [f32; 2] {
    let scale = (REFERENCE_SIZE / size.max(1) as f32).sqrt().clamp(DISTANCE_SCALE_RANGE.0, DISTANCE_SCALE_RANGE.1);
    [scale, scale.sqrt()]
}

/// Assigns a cell the surface of its neighborhood of the lowest energy: data term and smoothness term. Returns whether it changes.
fn update_label(surfaces: &mut Surfaces, view: View<'_>, matches: Matches<'_>, c: usize) -> bool {
    let (around, count) = surfaces.labels_around(c);
    // Surfaces of one plane are one.
    let (mut planes, mut labels, mut n) = ([None; 9], [NONE; 9], 0);
    for &label in &around[..count] {
        let plane = Some(view.plane(surfaces, label, c));
        if !planes[..n].contains(&plane) {
            (planes[n], labels[n]) = (plane, label);
            n += 1;
        }
    }
    if n < 2 {
        return false;
    }
    let columns = surfaces.columns;
    let rows = surfaces.cells.len() / columns;
    let (x, y) = center(c, columns);
    let half = 0.5 * CELL as f64;
    let borders = [(x - half, y), (x + half, y), (x, y - half), (x, y + half)];
    // The disparities of the neighbors at the borders, and the weights of the smoothness term.
    let others = neighbors(c, columns, rows).map(|n| n.filter(|&n| surfaces.labels[n] != NONE));
    let others: [Option<(f32, f32)>; 4] = std::array::from_fn(|i| {
        let (n, (x, y)) = (others[i]?, borders[i]);
        let edge = (surfaces.cells[c].gray - surfaces.cells[n].gray).abs();
        Some((view.plane(surfaces, surfaces.labels[n], n).at(x, y), SMOOTHNESS * EDGE_GRAY / (EDGE_GRAY + edge)))
    });
    let costs = view.cell_costs::<9, 4, 2>(matches, surfaces, c, &planes);
    let mut best = (f32::INFINITY, surfaces.labels[c]);
    for ((plane, label), mut cost) in planes.iter().zip(labels).zip(costs) {
        let Some(plane) = plane else { break };
        for ((x, y), (other, weight)) in borders.iter().zip(others).filter_map(|(at, other)| Some((*at, other?))) {
            cost += weight * ((plane.at(x, y) - other).abs() / MAX_DISTANCE).min(1.0);
        }
        if cost < best.0 {
            best = (cost, label);
        }
    }
    let is_changed = surfaces.labels[c] != best.1;
    surfaces.labels[c] = best.1;
    is_changed
}

/// Fills the holes of a row of cells: each pixel takes the surface of the neighboring cells of the lowest data term and difference in gray level.
#[simd]
fn fill_row<S: Simd>(
    _: S,
    surfaces: &Surfaces,
    view: View<'_>,
    row: usize,
    (disparity, states): (&mut [f32], &mut [PixelState]),
) {
    for c in row * surfaces.columns..(row + 1) * surfaces.columns {
        if surfaces.cells[c].holes > 0 {
            fill_cell(surfaces, view, c, (disparity, states));
        }
    }
}

/// Fills the holes of a cell, given its row of cells.
#[inline(always)]
fn fill_cell(surfaces: &Surfaces, view: View<'_>, c: usize, (disparity, states): (&mut [f32], &mut [PixelState])) {
    let columns = surfaces.columns;
    let (width, height) = (view.pair.width, view.height());
    let (around, count) = surfaces.labels_around(c);
    let (xs, ys) = extent(c, columns, (width, height));
    // Surfaces that are the same at the corners of the cell are merged.
    let corners = [(xs.start, ys.start), (xs.end - 1, ys.start), (xs.start, ys.end - 1), (xs.end - 1, ys.end - 1)];
    let (mut different, mut here, mut places) = ([None; 9], [[0f32; 4]; 9], [0; 9]);
    let mut n = 0;
    for (place, &label) in places.iter_mut().zip(&around[..count]) {
        let plane = view.plane(surfaces, label, c);
        let at = corners.map(|(x, y)| plane.at(x as f64, y as f64));
        let is_same = |other: &[f32; 4]| at.iter().zip(other).all(|(a, b)| (a - b).abs() < SAME_PLANE);
        *place = here[..n].iter().position(is_same).unwrap_or(n);
        if *place == n {
            (different[n], here[n]) = (Some(*plane), at);
            n += 1;
        }
    }
    let texture = texture_weight(surfaces, c);
    // Gray level and surface of the neighboring cells.
    let mut cells = [(0f32, 0usize); 9];
    let mut known = 0;
    for other in surfaces.around(c) {
        if let Some(place) = around[..count].iter().position(|&label| label == surfaces.labels[other]) {
            cells[known] = (surfaces.cells[other].gray, places[place]);
            known += 1;
        }
    }
    for (line, y) in ys.enumerate() {
        let first = line * width + xs.start;
        let (holes, states) = (&mut disparity[first..][..xs.len()], &mut states[first..][..xs.len()]);
        if holes.iter().all(|d| !d.is_nan()) {
            continue;
        }
        let mut values = [[f32::NAN; CELL]; 9];
        for (values, plane) in values.iter_mut().zip(different.iter().flatten()) {
            *values = plane.row::<CELL, 1>(xs.start, y);
        }
        let mut grays = [0f32; CELL];
        for (gray, &value) in grays.iter_mut().zip(&view.pair.gray[y * width..][xs.clone()]) {
            *gray = f32::from(value);
        }
        let mut differences = [[MAX_GRAY_DIFFERENCE; CELL]; 9];
        for &(of_cell, place) in &cells[..known] {
            for (least, gray) in differences[place].iter_mut().zip(grays) {
                let difference = (gray - of_cell).abs();
                *least = if difference < *least { difference } else { *least };
            }
        }
        let (row, visible) = (view.row(y), &view.right[y * width..][..width]);
        for (i, (hole, state)) in holes.iter_mut().zip(states).enumerate().filter(|(_, (d, _))| d.is_nan()) {
            let x = xs.start + i;
            let mut best = (f32::INFINITY, values[0][i]);
            if n > 1 {
                let bits = row.bits(x);
                for (values, differences) in values[..n].iter().zip(&differences) {
                    let d = values[i];
                    let cost = differences[i] / MAX_GRAY_DIFFERENCE + DATA_WEIGHT * row.cost(x, d, texture, bits);
                    // Of equal costs the farther one.
                    let is_better = (cost < best.0) | ((cost == best.0) & (d < best.1));
                    best = if is_better { (cost, d) } else { best };
                }
            }
            *hole = best.1;
            *state = unmatched_state(x, best.1, visible);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DisparityMap, Smoothing, StereoMatcher, StereoOptions};
    use cv_core::{GrayU8, Silent};

    const WIDTH: usize = 160;
    const HEIGHT: usize = 96;

    /// A texture of blocks of two pixels.
    fn texture(x: i64, y: i64) -> u8 {
        let mut z = ((x.div_euclid(2) as u64) << 32 ^ y.div_euclid(2) as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        40 + ((z >> 40) % 160) as u8
    }

    /// Matches a scene of integer disparities: the surfaces at a column and row of the left camera's frame (which extends beyond its image), as
    /// disparity and gray level, the nearest first.
    fn matched(surface: impl Fn(i64, i64) -> Vec<(i64, u8)>) -> DisparityMap {
        let left = GrayU8::from_fn(WIDTH, HEIGHT, |x, y| [surface(x as i64, y as i64)[0].1]);
        let right = GrayU8::from_fn(WIDTH, HEIGHT, |x, y| {
            // The nearest surface that projects here.
            let nearest = (0..=40).rev().find_map(|d| {
                let there = surface(x as i64 + d, y as i64);
                there.into_iter().find(|s| s.0 == d).map(|s| s.1)
            });
            [nearest.unwrap_or(0)]
        });
        let options = StereoOptions { disparities: 48, smoothing: Smoothing::None, ..Default::default() };
        StereoMatcher::new(options).unwrap().compute(left.view(), right.view(), &Silent).unwrap()
    }

    fn bad_fraction(
        map: &DisparityMap,
        pixels: impl Fn(usize, usize) -> bool,
        truth: impl Fn(usize, usize) -> f32,
    ) -> f64 {
        let all = (0..WIDTH * HEIGHT).map(|i| (i % WIDTH, i / WIDTH)).filter(|&(x, y)| pixels(x, y));
        let (mut n, mut bad) = (0, 0);
        for (x, y) in all {
            n += 1;
            let d = map.disparity.at(x, y)[0];
            // NaN compares false.
            let is_good = (d - truth(x, y)).abs() <= 2.0;
            bad += usize::from(!is_good);
        }
        bad as f64 / n as f64
    }

    #[test]
    fn occluded_pixels_are_filled_from_the_background() {
        // A box at 30 px in front of a wall at 8: 22 columns on its left are occluded.
        let inside = |x: i64, y: i64| (80..120).contains(&x) && (24..72).contains(&y);
        let map = matched(|x, y| {
            let wall = (8, texture(x, y));
            if inside(x, y) { vec![(30, texture(x + 1000, y)), wall] } else { vec![wall] }
        });
        let is_occluded = |x: usize, y: usize| (58..80).contains(&x) && (24..72).contains(&y);
        // The window of 5×5 pixels extends two pixels across the boundary on three sides: 10 + 4 of 22 × 48 pixels and their corners.
        let fraction = bad_fraction(&map, is_occluded, |_, _| 8.0);
        assert!(fraction < 0.15, "{fraction}");
    }

    #[test]
    fn out_of_view_pixels_are_filled_from_their_object() {
        // A near object at the left border, whose first 24 columns are out of view.
        let map = matched(|x, y| vec![if x < 60 { (24, texture(x + 1000, y)) } else { (4, texture(x, y)) }]);
        let fraction = bad_fraction(&map, |x, _| x < 24, |_, _| 24.0);
        // No other surface is near.
        assert!(fraction < 0.02, "{fraction}");
        let state = map.state.at(5, 40)[0];
        assert_eq!(state, PixelState::OutOfView);
    }

    #[test]
    fn a_wall_without_texture_is_the_plane_of_its_frame() {
        // A textureless poster on a slanted wall: its inside is matched only at the rim.
        let inside = |x: usize, y: usize| (50..130).contains(&x) && (16..80).contains(&y);
        let steps = |y: i64| 10 + y / 6;
        let map =
            matched(|x, y| vec![(steps(y), if inside(x.max(0) as usize, y as usize) { 120 } else { texture(x, y) })]);
        let fraction = bad_fraction(&map, inside, |_, y| 10.0 + y as f32 / 6.0 - 0.4);
        // One disparity for all of it would leave six of ten wrong; a quarter of those, for steps of whole pixels in the rim.
        assert!(fraction < 0.15, "{fraction}");
    }

    #[test]
    fn images_of_one_color_stay_without_disparity() {
        let map = matched(|_, _| vec![(0, 90)]);
        assert!(map.disparity.as_slice().iter().all(|d| d.is_nan()));
    }
}
