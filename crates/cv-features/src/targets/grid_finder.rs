//! Detection of marker grids: ArUco grid boards and AprilGrids.
//!
//! Black quadrilaterals are decoded as markers. The homography of each decoded marker predicts the positions of its
//! neighbors on the board; consistent markers form a board. The corners of an AprilGrid are then localized as
//! X-corners, like those of a chessboard; those of an ArUco grid by intersection of their edge lines.

use super::board::BoardPoint;
use super::board_error::BoardError;
use super::chessboard::ChessboardOptions;
use super::marker::{MarkerShape, apply_homography, diagnose, sample_bits, unit_square_to_image};
use super::marker_grid::{GridStyle, MarkerGrid};
use super::quads::{detect_quads, refine_marker_corner};
use super::saddle::refine_saddle;
use super::x_corner::smoothed;
use crate::error::check_image;
use crate::simd;
use cv_core::{GrayF32, ImageView, Matrix3, Point2, Progress, Stage, UnionFind, median};
use cv_imgproc::decode_srgb;
use cv_parallel::prelude::*;

/// A decoded marker.
struct DetectedMarker {
    id: usize,
    /// Clockwise in the image from the corner at the top left of the sheet.
    corners: [Point2<f64>; 4],
    /// Homography from the unit square.
    map: Matrix3<f64>,
}

/// Maximum deviation of a marker from the position predicted by a neighbor, relative to their distance: the distortion
/// of wide-angle lenses is about 0.1.
const MAX_RELATIVE_DEVIATION: f64 = 0.2;

/// Detects the corners of the visible markers of a grid.
///
/// `view` is gray, 0 to 1. The points are sorted by id, see [`MarkerGrid::point`]. At least two adjacent markers must
/// be visible if the board has more than one.
///
/// # Errors
/// [`BoardError`]; if no marker of the board can be decoded, it reports other markers in the image.
pub fn find_marker_grid(
    view: ImageView<'_, f32, 1>,
    board: &MarkerGrid,
    options: &ChessboardOptions,
    progress: &dyn Progress,
) -> Result<Vec<BoardPoint>, BoardError> {
    options.check()?;
    board.check()?;
    check_image(view, 16)?;
    let stage = Stage::new(progress, "markers", 0)?;
    let quads = detect_quads(view, options.min_contrast, &stage)?;
    let shape = |side| MarkerShape { side, border: board.border(), margin: (0.5 * board.spacing).min(0.15) };
    let mut markers: Vec<DetectedMarker> = Vec::new();
    for quad in &quads {
        let Some(map) = unit_square_to_image(*quad) else { continue };
        let bits = sample_bits(view, &map, shape(board.dictionary.side()));
        let Some((id, turns)) = bits.and_then(|bits| board.dictionary.decode(bits, board.count())) else { continue };
        // The rotation of the quadrilateral relative to the dictionary, and of the marker on the sheet.
        let corners = std::array::from_fn(|k| quad[(k + turns + board.quarter_turns()) % 4]);
        let Some(map) = unit_square_to_image(corners) else { continue };
        markers.push(DetectedMarker { id, corners, map });
    }
    stage.check()?;
    let consistent = match consistent_markers(&markers, board) {
        Ok(consistent) => consistent,
        Err(several @ BoardError::SeveralBoards { .. }) => return Err(several),
        // A few quadrilaterals decode as markers by chance.
        Err(other) => {
            let maps: Vec<Matrix3<f64>> =
                quads.iter().take(400).filter_map(|quad| unit_square_to_image(*quad)).collect();
            // With borders of one and of two cells: markers of another dictionary may also have another border.
            let read = |i: usize, side: usize| {
                let with_border = |border| sample_bits(view, &maps[i], MarkerShape { border, ..shape(side) });
                with_border(board.border()).or_else(|| with_border(3 - board.border()))
            };
            let none = BoardError::NoMarkers { dictionary: board.dictionary, seen: quads.len() };
            let reason = if markers.is_empty() { none } else { other };
            return Err(diagnose(maps.len(), board.dictionary, read).unwrap_or(reason));
        }
    };
    let is_april_grid = board.style == GridStyle::AprilGrid;
    // X-corners are localized in the smoothed image, intersections of edges in linear intensity.
    let localization_image = if is_april_grid { smoothed(view, simd::level()) } else { linear_intensity(view) };
    stage.check()?;
    let mut points = Vec::with_capacity(4 * consistent.len());
    for marker in consistent {
        let shortest_side =
            (0..4).map(|k| (marker.corners[(k + 1) % 4] - marker.corners[k]).norm()).fold(f64::INFINITY, f64::min);
        for k in 0..4 {
            let start = marker.corners[k];
            let localized = if is_april_grid {
                // The window is limited by the border and the black squares.
                let clearance = shortest_side * board.spacing.min(0.2);
                let window = (0.75 * clearance).min(options.max_window_radius.into()).max(2.0);
                refine_saddle(localization_image.view(), start, window, 2e-4)
                    .map(|s| (s.position, s.deviation_unsmoothed()))
            } else {
                refine_marker_corner(localization_image.view(), &marker.corners, k, 2.5)
            };
            let Some((position, deviation)) = localized else { continue };
            if (position - start).norm() < (0.05 * shortest_side).max(1.5) {
                points.push(BoardPoint { id: 4 * marker.id + k, position, deviation });
            }
        }
    }
    if points.len() < 4 {
        return Err(BoardError::OtherLayout { markers: markers.len() });
    }
    points.sort_by_key(|p| p.id);
    Ok(points)
}

/// Converts an sRGB image to linear intensity.
fn linear_intensity(view: ImageView<'_, f32, 1>) -> GrayF32 {
    let mut out = view.to_image();
    out.as_mut_slice().par_chunks_mut(1 << 14).for_each(|part| part.iter_mut().for_each(|v| *v = decode_srgb(*v)));
    out
}

/// Selects the markers whose relative positions are consistent with the board.
fn consistent_markers<'a>(
    markers: &'a [DetectedMarker],
    board: &MarkerGrid,
) -> Result<Vec<&'a DetectedMarker>, BoardError> {
    let mut sets = UnionFind::new(markers.len());
    let center = Point2::new(0.5, 0.5);
    let pitch = 1.0 + board.spacing;
    for i in 0..markers.len() {
        for j in 0..i {
            let (a, b) = (board.cell(markers[i].id), board.cell(markers[j].id));
            let step = |a: usize, b: usize| b as f64 - a as f64;
            let (dx, dy) = (step(a.0, b.0), step(a.1, b.1));
            // Predictions are accurate up to the second neighbor.
            if dx.abs().max(dy.abs()) > 2.0 || (dx == 0.0 && dy == 0.0) {
                continue;
            }
            let is_consistent = |from: &DetectedMarker, to: &DetectedMarker, sign: f64| {
                let predicted = apply_homography(&from.map, center.x + sign * pitch * dx, center.y + sign * pitch * dy);
                let (own, other) = (apply_homography(&from.map, 0.5, 0.5), apply_homography(&to.map, 0.5, 0.5));
                (predicted - other).norm() < MAX_RELATIVE_DEVIATION * (other - own).norm()
            };
            if is_consistent(&markers[i], &markers[j], 1.0) && is_consistent(&markers[j], &markers[i], -1.0) {
                sets.union(i as u32, j as u32);
            }
        }
    }
    let roots = sets.into_roots();
    let size = |root: u32| roots.iter().filter(|r| **r == root).count();
    let mut groups: Vec<u32> = roots.clone();
    groups.sort_unstable();
    groups.dedup();
    groups.sort_by_key(|root| std::cmp::Reverse(size(*root)));
    let group_of = |root: u32| {
        (0..markers.len()).filter(|i| roots[*i] == root).map(|i| &markers[i]).collect::<Vec<&DetectedMarker>>()
    };
    let min_markers = board.count().min(2);
    let other = BoardError::OtherLayout { markers: markers.len() };
    let best = group_of(*groups.first().ok_or(other)?);
    if best.len() < min_markers {
        return Err(other);
    }
    let is_duplicate_board = |root: &&u32| {
        let group = group_of(**root);
        let repeated = group.iter().filter(|m| best.iter().any(|b| b.id == m.id)).count();
        group.len() >= min_markers && 2 * repeated > group.len()
    };
    let several = groups.iter().filter(is_duplicate_board).count();
    if several > 1 {
        return Err(BoardError::SeveralBoards { boards: several });
    }
    // Parts of a board separated by an occluder have different markers.
    let mut all = best;
    for root in &groups[1..] {
        let group = group_of(*root);
        if group.len() >= 2 && group.iter().all(|m| all.iter().all(|b| b.id != m.id)) {
            all.extend(group);
        }
    }
    // Of quadrilaterals with the same id, the one most consistent with the others.
    let deviation = |marker: &DetectedMarker| {
        let mut all: Vec<f64> = all
            .iter()
            .filter(|other| other.id != marker.id)
            .filter_map(|other| corner_deviation(board, other, marker))
            .collect();
        median(&mut all).unwrap_or(f64::INFINITY)
    };
    let mut unique: Vec<(f64, &DetectedMarker)> = all.iter().map(|marker| (deviation(marker), *marker)).collect();
    unique.sort_by(|a, b| (a.1.id, a.0).partial_cmp(&(b.1.id, b.0)).unwrap_or(std::cmp::Ordering::Equal));
    unique.dedup_by_key(|marker| marker.1.id);
    Ok(unique.into_iter().map(|marker| marker.1).collect())
}

/// Computes the mean distance of a marker's corners from the positions predicted by another marker; `None` if that is
/// more than two markers away.
fn corner_deviation(board: &MarkerGrid, from: &DetectedMarker, to: &DetectedMarker) -> Option<f64> {
    let (a, b) = (board.cell(from.id), board.cell(to.id));
    let step = |a: usize, b: usize| (1.0 + board.spacing) * (b as f64 - a as f64);
    let is_near = a.0.abs_diff(b.0).max(a.1.abs_diff(b.1)) <= 2;
    let unit = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
    let predict = |(x, y): (f64, f64)| apply_homography(&from.map, x + step(a.0, b.0), y + step(a.1, b.1));
    is_near.then(|| unit.iter().zip(&to.corners).map(|(u, corner)| (predict(*u) - corner).norm()).sum::<f64>() / 4.0)
}
