//! Seam finding by graph cuts (Kwatra et al. 2003; Agarwala et al. 2004).
//!
//! A label per canvas pixel selects the photograph. The smoothness term between neighbors `p` and `q` with labels `a` and `b` is the difference of the two
//! photographs at both pixels, in color and gradient, so that seams avoid moving objects and misalignments. The energy is minimized by alpha expansion: on a
//! preview first, then in full resolution in a band around the seams. Between the two, the breaks of objects that a seam must cut are measured.

mod alpha_expansion;
mod border;
mod breaks;
mod contradiction;
mod cost;
mod misalignment;
mod pair_costs;
mod transient;
mod upsample;
mod windows;

pub(crate) use breaks::find as find_breaks;
pub(crate) use upsample::{upsample, upsample_rows};
pub(crate) use windows::{refine_in_windows, window_memory};

use crate::blend::NO_PHOTO;
use crate::rows::{for_each_row, is_check_due};
use crate::surface::{Bounds, Piece, Preview, WarpedPhoto};
use alpha_expansion::{BeyondCost, Labeling};
use cost::difference;
use cv_core::{Cancelled, Image, Progress, Stage, named};
use cv_parallel::prelude::*;
use misalignment::Misalignments;
use pair_costs::PairCosts;
use transient::transient_costs;

/// Seam finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Seams {
    /// Where the centers of two photographs are equally far (a Voronoi diagram), regardless of content.
    Voronoi,
    /// Where the photographs agree, by graph cuts.
    #[default]
    GraphCut,
}

named!(Seams { GraphCut = "graphcut", Voronoi = "voronoi" | "middle" });

/// Data term at the border of a photograph; 0 at its center. A hundredth of a visible difference, so that it decides only where
/// the photographs agree.
const ECCENTRICITY_COST: f32 = 4.0;

/// Data term of a clipped pixel: balances a seam of 15 gray levels in every channel around a square of 20 clipped preview pixels. Two thirds of it show clipped pixels that another photograph
/// has unclipped; more leads more seams, at ±2 EV, through people in front of clipped walls.
const CLIPPED_COST: f32 = 36.0;
/// Data term of a clipped pixel where radiance is computed: more than a seam along the border of a photograph.
const CLIPPED_RADIANCE_COST: f32 = 400.0;

/// Returns the bounding box of each of `n` labels.
pub(crate) fn label_bounds(labels: &Image<u16, 1>, n: usize) -> Vec<Option<Bounds>> {
    let mut bounds: Vec<Option<Bounds>> = vec![None; n];
    for y in 0..labels.height() {
        for (x, label) in labels.row(y).iter().enumerate() {
            let Some(b) = bounds.get_mut(usize::from(*label)) else { continue };
            *b = Some(match *b {
                None => Bounds { left: x, top: y, right: x + 1, bottom: y + 1 },
                Some(b) => Bounds { left: b.left.min(x), top: b.top, right: b.right.max(x + 1), bottom: y + 1 },
            });
        }
    }
    bounds
}

/// Minimum number of pixels of the coarser resolutions in which the seams of the preview are found first: in fewer, objects that a seam must not cut are too
/// small.
const MIN_COARSE_PIXELS: usize = 10_000;
/// Half width, in pixels of a resolution, of the band around the seams of the coarser one in which its seams are found: a cut over the whole preview takes
/// several times as long for hardly less energy.
const BAND_RADIUS: usize = 6;

/// Finds the labels on the preview: unrestricted at up to a quarter of its resolution, then in bands around the seams of the coarser resolution.
pub(crate) fn on_preview(
    preview: &Preview,
    photo_of: &[usize],
    seams: Seams,
    radiance: bool,
    removes_transients: bool,
    progress: &dyn Progress,
) -> Result<Image<u16, 1>, Cancelled> {
    let clipped = if radiance { CLIPPED_RADIANCE_COST } else { CLIPPED_COST };
    if seams == Seams::Voronoi {
        return Ok(voronoi(preview));
    }
    let coarser = |level: &Preview| {
        let half = (level.width / 2) * (level.height / 2) >= MIN_COARSE_PIXELS;
        half.then(|| level.halved())
    };
    let half = coarser(preview);
    let quarter = half.as_ref().and_then(coarser);
    // From coarse to fine, with the side of a pixel in preview pixels.
    let levels = [(quarter.as_ref(), 4), (half.as_ref(), 2), (Some(preview), 1)];
    let levels: Vec<(&Preview, usize)> = levels.into_iter().filter_map(|(level, side)| Some((level?, side))).collect();

    let stage = Stage::new(progress, "seams", 1 + levels.len())?;
    let found = Misalignments::find(preview, photo_of, &stage)?;
    stage.add(1)?;
    let costs = PairCosts::new(preview, &found);
    let mut coarse: Option<Image<u16, 1>> = None;
    for (level, side) in levels {
        let (mut labels, near) = match &coarse {
            None => (voronoi(level), vec![true; level.width * level.height]),
            Some(coarse) => {
                let labels = upsampled(coarse, level);
                let mut near = seam_band(&labels, BAND_RADIUS, &stage)?;
                if preview.full_circle {
                    border::add_band(&mut near, &labels, photo_of, BAND_RADIUS);
                }
                (labels, near)
            }
        };
        // The maximum over 2 × 2 preview pixels: their mean would hide a thin object that the seam cuts. Of larger pixels the mean of these: their maximum is
        // large almost everywhere.
        let differ = |a: usize, b: usize, x: usize, y: usize| {
            let costs = costs.of(a, b);
            let most = |x: usize, y: usize| {
                costs.at(x, y).max(costs.at(x + 1, y)).max(costs.at(x, y + 1)).max(costs.at(x + 1, y + 1))
            };
            let (x, y) = (side * x, side * y);
            match side {
                1 => costs.at(x, y),
                2 => most(x, y),
                _ => (most(x, y) + most(x + 2, y) + most(x, y + 2) + most(x + 2, y + 2)) / 4,
            }
        };
        let transients = removes_transients.then(|| transient_costs(level));
        // A pixel represents `side²` preview pixels, a unit of seam length `side`.
        let unary = |label: usize, x: usize, y: usize| {
            let transient = transient_at(transients.as_deref(), level, label, x, y);
            (side as f32 * (data_term(&level.pieces[label], clipped, x, y) + transient)) as i32
        };
        let reach: Vec<_> = level.pieces.iter().map(|p| Some(&p.warped)).collect();
        let free = |y: usize| &near[y * level.width..(y + 1) * level.width];
        // Further rounds hardly lower the energy.
        let rounds = if coarse.is_none() { 2 } else { 1 };
        let beyond =
            |own: usize, other: usize, x: usize, y: usize| border::cost(level, photo_of, &differ, own, other, (x, y));
        let beyond: Option<&BeyondCost<'_>> = if preview.full_circle { Some(&beyond) } else { None };
        Labeling { photos: &reach, unary, difference: differ, free, beyond }.expand(&mut labels, rounds, &stage)?;
        coarse = Some(labels);
        stage.add(1)?;
    }
    Ok(coarse.unwrap_or_else(|| voronoi(preview)))
}

/// Labels the pixels of a level as those of half its resolution, where their photographs reach; others with the photograph whose center is nearest.
fn upsampled(coarse: &Image<u16, 1>, level: &Preview) -> Image<u16, 1> {
    Image::from_fn(level.width, level.height, |x, y| match coarse.get(x / 2, y / 2) {
        Some([found]) if found != NO_PHOTO && level.pieces[usize::from(found)].warped.reaches(x, y) => [found],
        _ => [nearest(level, x, y)],
    })
}

/// Labels every pixel with the photograph whose center is nearest.
fn voronoi(preview: &Preview) -> Image<u16, 1> {
    Image::from_fn(preview.width, preview.height, |x, y| [nearest(preview, x, y)])
}

/// Returns the photograph whose center is nearest to a pixel; [`NO_PHOTO`] where none covers it.
fn nearest(preview: &Preview, x: usize, y: usize) -> u16 {
    let reaching = preview.pieces.iter().enumerate().filter(|(_, p)| p.warped.reaches(x, y));
    let nearest = reaching.map(|(i, p)| (eccentricity(p, x, y), i)).min_by(|a, b| a.0.total_cmp(&b.0));
    nearest.map_or(NO_PHOTO, |(_, i)| i as u16)
}

/// Data term of a pixel; `clipped` is the cost of a clipped one.
fn data_term(piece: &Piece, clipped: f32, x: usize, y: usize) -> f32 {
    let i = piece.warped.bounds.index(x, y);
    let own = piece.cost.get(i).copied().unwrap_or(0.0);
    ECCENTRICITY_COST * piece.eccentricity[i] + if piece.clipped[i] { clipped } else { 0.0 } + own
}

/// Returns the cost of [`transient_costs`] of a pixel, 0 without them.
fn transient_at(costs: Option<&[Vec<f32>]>, preview: &Preview, label: usize, x: usize, y: usize) -> f32 {
    let b = preview.pieces[label].warped.bounds;
    costs.map_or(0.0, |costs| costs[label][b.index(x, y)])
}

fn eccentricity(piece: &Piece, x: usize, y: usize) -> f32 {
    piece.eccentricity[piece.warped.bounds.index(x, y)]
}

/// Side, in canvas pixels, of the blocks on which seams are refined first where a preview pixel is larger.
const BLOCK: usize = 4;

/// Refines seams in full resolution in a band of two preview pixels (of `step` canvas pixels) around them. Wide bands are refined on blocks first, and then
/// in a band of a block and a half.
pub(crate) fn refine(
    labels: &mut Image<u16, 1>,
    photos: &[Option<WarpedPhoto>],
    step: usize,
    progress: &dyn Progress,
) -> Result<(), Cancelled> {
    let stage = Stage::new(progress, "seams", 3)?;
    let pieces: Vec<Option<&WarpedPhoto>> = photos.iter().map(Option::as_ref).collect();
    let mut reach = 2 * step;
    if let Some(radius) = refined_block_radius(step) {
        refine_blocks(labels, &pieces, radius, &stage)?;
        reach = BLOCK + BLOCK / 2;
    }
    stage.add(1)?;
    let near = seam_band(labels, reach, &stage)?;
    stage.add(1)?;
    let width = labels.width();
    let differ = |a: usize, c: usize, x: usize, y: usize| difference(pieces[a], pieces[c], x, y);
    let free = |y: usize| &near[y * width..(y + 1) * width];
    Labeling { photos: &pieces, unary: |_, _, _| 0, difference: differ, free, beyond: None }
        .expand(labels, 1, &stage)?;
    stage.add(1)
}

/// Returns by how many blocks seams are refined before single pixels, for a preview of this step; `None` where blocks are no smaller than its pixels.
fn refined_block_radius(step: usize) -> Option<usize> {
    (step > BLOCK).then(|| (2 * step).div_ceil(BLOCK))
}

/// Refines seams by up to `reach` blocks. The label of a block is that of its center; the difference is the maximum over four pixels.
fn refine_blocks(
    labels: &mut Image<u16, 1>,
    photos: &[Option<&WarpedPhoto>],
    reach: usize,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    const MIDDLE: usize = BLOCK / 2;
    let (w, h) = labels.size();
    // Blocks whose middles there are.
    let (across, down) = ((w + BLOCK - 1 - MIDDLE) / BLOCK, (h + BLOCK - 1 - MIDDLE) / BLOCK);
    let before = Image::from_fn(across, down, |x, y| labels.at(BLOCK * x + MIDDLE, BLOCK * y + MIDDLE));
    let subsampled: Vec<Option<WarpedPhoto>> = photos.par_iter().map(|photo| photo.map(subsampled)).collect();
    let reached: Vec<Option<&WarpedPhoto>> = subsampled.iter().map(Option::as_ref).collect();
    let near = seam_band(&before, reach, stage)?;
    let differ = |a: usize, c: usize, x: usize, y: usize| block_difference(photos, a, c, x, y);
    let free = |y: usize| &near[y * across..(y + 1) * across];
    let mut after = before.clone();
    Labeling { photos: &reached, unary: |_, _, _| 0, difference: differ, free, beyond: None }
        .expand(&mut after, 1, stage)?;
    for (i, (old, new)) in before.pixels().zip(after.pixels()).enumerate() {
        let (left, top) = (BLOCK * (i % across), BLOCK * (i / across));
        let Some(Some(photo)) = photos.get(usize::from(new[0])).filter(|_| old != new) else { continue };
        for y in top..(top + BLOCK).min(h) {
            for (x, label) in (left..).zip(&mut labels.row_mut(y)[left..(left + BLOCK).min(w)]) {
                if photo.reaches(x, y) {
                    *label = new[0];
                }
            }
        }
    }
    Ok(())
}

/// Returns the difference of two photographs in a block: the maximum over four pixels.
fn block_difference(photos: &[Option<&WarpedPhoto>], a: usize, c: usize, x: usize, y: usize) -> i32 {
    let of = |x: usize, y: usize| difference(photos[a], photos[c], x, y);
    let (x, y, middle) = (BLOCK * x, BLOCK * y, BLOCK / 2);
    of(x, y).max(of(x + middle, y)).max(of(x, y + middle)).max(of(x + middle, y + middle))
}

/// Returns the blocks whose centers lie inside the bounds.
fn block_bounds(b: Bounds) -> Bounds {
    // The first block whose middle is not before a column or row.
    let block = |v: usize| v.saturating_sub(BLOCK / 2).div_ceil(BLOCK);
    Bounds { left: block(b.left), top: block(b.top), right: block(b.right), bottom: block(b.bottom) }
}

/// Samples a photograph at the centers of the blocks.
fn subsampled(photo: &WarpedPhoto) -> WarpedPhoto {
    let b = photo.bounds;
    let bounds = block_bounds(b);
    let middle = |v: usize| BLOCK * v + BLOCK / 2;
    let pixels = Image::from_fn(bounds.width(), bounds.height(), |x, y| {
        photo.pixels.at(middle(bounds.left + x) - b.left, middle(bounds.top + y) - b.top)
    });
    WarpedPhoto { bounds, pixels }
}

/// Number of pixels of a row that [`seam_band`] compares at once.
const RUN: usize = 32;

/// Returns the mask of pixels within `reach` pixels (Chebyshev distance) of a seam.
fn seam_band(labels: &Image<u16, 1>, reach: usize, stage: &Stage<'_>) -> Result<Vec<bool>, Cancelled> {
    let (w, h) = labels.size();
    // Along rows, then along columns: the pixels since the last seam and until the next.
    let mut near = vec![false; w * h];
    for_each_row(&mut near, w, stage, |y, near| {
        let own = labels.row(y);
        let below = labels.row((y + 1).min(h - 1));
        let differs = |a: u16, b: u16| a != b && a != NO_PHOTO && b != NO_PHOTO;
        // First column that is not marked yet.
        let mut marked = 0;
        for start in (0..w).step_by(RUN) {
            let end = (start + RUN).min(w);
            // Few runs of pixels have more than one label.
            let beside = &own[start..(end + 1).min(w)];
            let others = beside.iter().chain(&below[start..end]).fold(0, |bits, label| bits | (label ^ own[start]));
            if others == 0 {
                continue;
            }
            for x in start..end {
                if differs(own[x], below[x]) || x + 1 < w && differs(own[x], own[x + 1]) {
                    let end = (x + reach + 1).min(w);
                    near[marked.max(x.saturating_sub(reach))..end].fill(true);
                    marked = end;
                }
            }
        }
    })?;
    // Bands of columns: how many rows ago each of them last met a mark, downwards; those met upwards fill the rows between.
    let mut since = vec![usize::MAX; w];
    let mut until: Vec<usize> = vec![0; w];
    for y in 0..h {
        if is_check_due(y, w) {
            stage.check()?;
        }
        let (before, row) = near.split_at_mut(y * w);
        for (x, ((since, until), near)) in since.iter_mut().zip(&mut until).zip(row).enumerate() {
            if *near {
                // Rows before this one that are not marked yet.
                for above in (*until).max(y.saturating_sub(reach))..y {
                    before[above * w + x] = true;
                }
                (*since, *until) = (0, y + 1);
            } else {
                *since = since.saturating_add(1);
                if *since <= reach {
                    *near = true;
                    *until = y + 1;
                }
            }
        }
    }
    Ok(near)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{drawn, stage};
    use cv_core::Silent;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_band_along_seams_is_all_within_reach_of_a_step(labels in proptest::collection::vec(0..3_u16, 63), reach in 0..4_usize) {
            let labels = Image::from_fn(9, 7, |x, y| [if labels[9 * y + x] == 2 && x < 4 { NO_PHOTO } else { labels[9 * y + x] / 2 }]);
            let found = seam_band(&labels, reach, &stage()).unwrap();
            let step = |x: usize, y: usize| {
                let own = labels.at(x, y)[0];
                [(x + 1, y), (x, y + 1)].into_iter().any(|(nx, ny)| {
                    labels.get(nx, ny).is_some_and(|[other]| own != NO_PHOTO && other != NO_PHOTO && own != other)
                })
            };
            for (x, y) in (0..7).flat_map(|y| (0..9).map(move |x| (x, y))) {
                let around = |v: usize, n: usize| v.saturating_sub(reach)..(v + reach + 1).min(n);
                let near = around(y, 7).any(|y| around(x, 9).any(|x| step(x, y)));
                prop_assert_eq!(found[9 * y + x], near, "{} {}", x, y);
            }
        }
    }

    #[test]
    fn the_box_of_a_label_is_around_all_its_pixels() {
        let labels = Image::from_fn(8, 5, |x, y| [if x + y < 3 { NO_PHOTO } else { u16::from(x > 4) }]);
        let bounds = label_bounds(&labels, 3);
        assert_eq!(bounds[0], Some(Bounds { left: 0, top: 0, right: 5, bottom: 5 }));
        assert_eq!(bounds[1], Some(Bounds { left: 5, top: 0, right: 8, bottom: 5 }));
        assert_eq!(bounds[2], None);
    }

    const SIZE: (usize, usize) = (160, 90);

    /// A scene, and in it a pole that the second photograph shows 12 pixels farther to the right.
    fn scene(x: usize, y: usize, pole: usize) -> [u8; 3] {
        let wave = (90.0 + 40.0 * (x as f64 * 0.21).sin() + 30.0 * (y as f64 * 0.17 + x as f64 * 0.05).cos()) as u8;
        if (pole..pole + 10).contains(&x) && (15..75).contains(&y) {
            [240, 30 + (y % 3) as u8, 10]
        } else {
            [wave, wave, 90]
        }
    }

    /// Two photographs that overlap from column 40 to 120, with the pole on the line half-way between them.
    fn preview() -> Preview {
        let piece = |left: usize, right: usize, pole: usize| {
            let bounds = Bounds { left, top: 0, right, bottom: SIZE.1 };
            let middle = 0.5 * (left + right) as f32;
            let across = 0.5 * (right - left) as f32;
            let place = |i: usize| (i % bounds.width() + left, i / bounds.width());
            let eccentricity: Vec<f32> = (0..bounds.width() * bounds.height())
                .map(|i| ((place(i).0 as f32 + 0.5 - middle) / across).powi(2))
                .collect();
            Piece::new(drawn(bounds, |x, y| scene(x, y, pole)), eccentricity.clone(), eccentricity, 0.0)
        };
        Preview {
            step: 1,
            width: SIZE.0,
            height: SIZE.1,
            full_circle: false,
            pieces: vec![piece(0, 120, 70), piece(40, 160, 82)],
        }
    }

    /// What a seam costs in gray levels, by the colors on both of its sides.
    fn misfit(labels: &Image<u16, 1>, preview: &Preview) -> u32 {
        let mut sum = 0;
        for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0 - 1).map(move |x| (x, y))) {
            if labels.at(x, y) != labels.at(x + 1, y) {
                for x in [x, x + 1] {
                    let [a, b] = [0, 1].map(|k| preview.pieces[k].warped.color(x, y));
                    if let (Some(a), Some(b)) = (a, b) {
                        sum += a.into_iter().zip(b).map(|(a, b)| u32::from(a.abs_diff(b))).sum::<u32>();
                    }
                }
            }
        }
        sum
    }

    #[test]
    fn voronoi_takes_the_photograph_whose_middle_is_nearest() {
        let labels = on_preview(&preview(), &[0, 1], Seams::Voronoi, false, false, &Silent).unwrap();
        for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))) {
            // Both are 120 wide: half-way between columns 60 and 100.
            assert_eq!(labels.at(x, y)[0], u16::from(x >= 80), "{x} {y}");
        }
    }

    #[test]
    fn a_graph_cut_runs_around_what_the_photographs_show_at_two_places() {
        let preview = preview();
        let straight = on_preview(&preview, &[0, 1], Seams::Voronoi, false, false, &Silent).unwrap();
        let cut = on_preview(&preview, &[0, 1], Seams::GraphCut, false, false, &Silent).unwrap();
        assert!(misfit(&straight, &preview) > 10_000, "{}", misfit(&straight, &preview));
        // Around the pole both show the same: nothing is cut.
        assert_eq!(misfit(&cut, &preview), 0);
        for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))) {
            let label = usize::from(cut.at(x, y)[0]);
            assert!(preview.pieces[label].warped.reaches(x, y), "{x} {y}");
        }
    }

    #[test]
    fn refinement_moves_a_seam_by_no_more_than_its_reach_to_where_nothing_differs() {
        let preview = preview();
        let photos: Vec<Option<WarpedPhoto>> = preview.pieces.iter().map(|p| Some(p.warped.clone())).collect();
        // A straight seam beside the pole's right side in the second photograph, six pixels into it.
        let mut labels = Image::from_fn(SIZE.0, SIZE.1, |x, _| [u16::from(x >= 88)]);
        let before = misfit(&labels, &preview);
        // Two preview pixels of four.
        refine(&mut labels, &photos, 4, &Silent).unwrap();
        assert!(before > 5000 && misfit(&labels, &preview) < before / 10, "{before} {}", misfit(&labels, &preview));
        for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))) {
            // The step lies between columns 87 and 88; the band reaches 8 from the former.
            let free = (79..=95).contains(&x);
            assert!(free || labels.at(x, y)[0] == u16::from(x >= 88), "{x} {y}");
        }
    }

    #[test]
    fn refinement_by_blocks_finds_what_lies_far_off_and_leaves_labels_where_their_photographs_reach() {
        let preview = preview();
        let photos: Vec<Option<WarpedPhoto>> = preview.pieces.iter().map(|p| Some(p.warped.clone())).collect();
        // In the middle of the pole of the first photograph, whose right side lies 4 pixels off; the second's pole ends 16 pixels off.
        let mut labels = Image::from_fn(SIZE.0, SIZE.1, |x, _| [u16::from(x >= 76)]);
        let before = misfit(&labels, &preview);
        refine(&mut labels, &photos, 12, &Silent).unwrap();
        assert!(before > 5000 && misfit(&labels, &preview) < before / 10, "{before} {}", misfit(&labels, &preview));
        for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))) {
            assert!(preview.pieces[usize::from(labels.at(x, y)[0])].warped.reaches(x, y), "{x} {y}");
        }
    }

    #[test]
    fn subsampled_photographs_cover_the_blocks_whose_centers_they_cover() {
        for (left, right) in [(0, 13), (1, 14), (2, 15), (3, 16), (6, 7), (7, 9)] {
            let bounds = Bounds { left, top: left, right, bottom: right };
            let photo = drawn(bounds, |x, y| [x as u8, y as u8, 0]);
            let small = subsampled(&photo);
            for (x, y) in (0..5).flat_map(|y| (0..5).map(move |x| (x, y))) {
                assert_eq!(small.color(x, y), photo.color(BLOCK * x + 2, BLOCK * y + 2), "{left} {right} {x} {y}");
            }
        }
    }
}
