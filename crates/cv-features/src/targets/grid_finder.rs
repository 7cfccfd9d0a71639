//! Finding grids of markers: ArUco grids and AprilGrids.
//!
//! Black quadrilaterals are read as markers; each that is read says, by its own four corners, where its neighbors on the board must lie. What agrees is a board.
//! The corners of an AprilGrid are then placed as those of a chessboard are (each lies between two black and two white squares), those of an ArUco grid by the lines
//! of their sides.

use super::board::BoardPoint;
use super::board_error::BoardError;
use super::chessboard::ChessboardOptions;
use super::marker::{MarkerShape, mapped, read_bits, square_to_picture, what_else};
use super::marker_grid::{GridStyle, MarkerGrid};
use super::quads::{marker_corner, quads};
use super::saddle::saddle;
use super::x_corner::smoothed;
use crate::error::check_image;
use crate::simd;
use cv_core::{GrayF32, ImageView, Matrix3, Point2, Progress, Stage, UnionFind, median};
use cv_imgproc::decode_srgb;
use rayon::prelude::*;

/// A marker that was read.
struct Seen {
    id: usize,
    /// Clockwise on screen from the corner at the top left of the sheet.
    corners: [Point2<f64>; 4],
    /// From the unit square.
    map: Matrix3<f64>,
}

/// How far from its place by its neighbor a marker may be found, as a share of the way between them: a wide lens bends a step by a tenth.
const OFF: f64 = 0.2;

/// Finds the corners of the markers of a grid: of as many markers as the picture shows.
///
/// `view` is gray, 0 to 1. The points are in the order of their ids, which are those of [`MarkerGrid::point`]. At least two markers must lie beside each other as they do on
/// the board, where the board has more than one.
///
/// # Errors
/// [`BoardError`]; where no marker of the board can be read, it says what was seen in their place.
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
    let quads = quads(view, options.least_contrast, &stage)?;
    let shape = |side| MarkerShape { side, frame: board.frame(), rim: (0.5 * board.spacing).min(0.15) };
    let mut seen: Vec<Seen> = Vec::new();
    for quad in &quads {
        let Some(map) = square_to_picture(*quad) else { continue };
        let bits = read_bits(view, &map, shape(board.dictionary.side()));
        let Some((id, turns)) = bits.and_then(|bits| board.dictionary.read(bits, board.count())) else { continue };
        // Corner of the quadrilateral that is the marker's own first, and how the marker stands on the sheet.
        let corners = std::array::from_fn(|k| quad[(k + turns + board.turns()) % 4]);
        let Some(map) = square_to_picture(corners) else { continue };
        seen.push(Seen { id, corners, map });
    }
    stage.check()?;
    let chosen = match agreeing(&seen, board) {
        Ok(chosen) => chosen,
        Err(several @ BoardError::SeveralBoards { .. }) => return Err(several),
        // One or another place reads as a marker by chance.
        Err(other) => {
            let maps: Vec<Matrix3<f64>> = quads.iter().take(400).filter_map(|quad| square_to_picture(*quad)).collect();
            // A frame of one cell and one of two: who has the wrong dictionary may have that wrong, too.
            let read = |i: usize, side: usize| {
                let of = |frame| read_bits(view, &maps[i], MarkerShape { frame, ..shape(side) });
                of(board.frame()).or_else(|| of(3 - board.frame()))
            };
            let none = BoardError::NoMarkers { dictionary: board.dictionary, seen: quads.len() };
            let reason = if seen.is_empty() { none } else { other };
            return Err(what_else(maps.len(), board.dictionary, read).unwrap_or(reason));
        }
    };
    let april = board.style == GridStyle::AprilGrid;
    // What corners are placed in: chessboard corners in the smoothed picture, corners of markers in its light.
    let placed_in = if april { smoothed(view, simd::level()) } else { light(view) };
    stage.check()?;
    let mut points = Vec::with_capacity(4 * chosen.len());
    for marker in chosen {
        let least =
            (0..4).map(|k| (marker.corners[(k + 1) % 4] - marker.corners[k]).norm()).fold(f64::INFINITY, f64::min);
        for k in 0..4 {
            let start = marker.corners[k];
            let found = if april {
                // Plain as far as the frame is thick, and the black square wide.
                let plain = least * board.spacing.min(0.2);
                let window = (0.75 * plain).min(options.largest_window.into()).max(2.0);
                saddle(placed_in.view(), start, window, 2e-4).map(|s| (s.position, s.deviation_unsmoothed()))
            } else {
                marker_corner(placed_in.view(), &marker.corners, k, 2.5)
            };
            let Some((position, deviation)) = found else { continue };
            if (position - start).norm() < (0.05 * least).max(1.5) {
                points.push(BoardPoint { id: 4 * marker.id + k, position, deviation });
            }
        }
    }
    if points.len() < 4 {
        return Err(BoardError::OtherLayout { markers: seen.len() });
    }
    points.sort_by_key(|p| p.id);
    Ok(points)
}

/// The picture in linear light.
fn light(view: ImageView<'_, f32, 1>) -> GrayF32 {
    let mut out = view.to_image();
    out.as_mut_slice().par_iter_mut().with_min_len(1 << 14).for_each(|v| *v = decode_srgb(*v));
    out
}

/// The markers that lie as on the board by one another.
fn agreeing<'a>(seen: &'a [Seen], board: &MarkerGrid) -> Result<Vec<&'a Seen>, BoardError> {
    let mut sets = UnionFind::new(seen.len());
    let middle = Point2::new(0.5, 0.5);
    let pitch = 1.0 + board.spacing;
    for i in 0..seen.len() {
        for j in 0..i {
            let (a, b) = (board.cell(seen[i].id), board.cell(seen[j].id));
            let step = |a: usize, b: usize| b as f64 - a as f64;
            let (dx, dy) = (step(a.0, b.0), step(a.1, b.1));
            // A marker tells little of what is farther than the second next.
            if dx.abs().max(dy.abs()) > 2.0 || (dx == 0.0 && dy == 0.0) {
                continue;
            }
            let near = |from: &Seen, to: &Seen, sign: f64| {
                let place = mapped(&from.map, middle.x + sign * pitch * dx, middle.y + sign * pitch * dy);
                let (own, other) = (mapped(&from.map, 0.5, 0.5), mapped(&to.map, 0.5, 0.5));
                (place - other).norm() < OFF * (other - own).norm()
            };
            if near(&seen[i], &seen[j], 1.0) && near(&seen[j], &seen[i], -1.0) {
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
    let of = |root: u32| (0..seen.len()).filter(|i| roots[*i] == root).map(|i| &seen[i]).collect::<Vec<&Seen>>();
    let least = board.count().min(2);
    let other = BoardError::OtherLayout { markers: seen.len() };
    let best = of(*groups.first().ok_or(other)?);
    if best.len() < least {
        return Err(other);
    }
    let again = |root: &&u32| {
        let group = of(**root);
        let twice = group.iter().filter(|m| best.iter().any(|b| b.id == m.id)).count();
        group.len() >= least && 2 * twice > group.len()
    };
    let several = groups.iter().filter(again).count();
    if several > 1 {
        return Err(BoardError::SeveralBoards { boards: several });
    }
    // Parts that something lies across belong together where they have different markers.
    let mut all = best;
    for root in &groups[1..] {
        let group = of(*root);
        if group.len() >= 2 && group.iter().all(|m| all.iter().all(|b| b.id != m.id)) {
            all.extend(group);
        }
    }
    // Of two quadrilaterals that read as one marker the one that lies where the others have it.
    let off = |marker: &Seen| {
        let mut all: Vec<f64> =
            all.iter().filter(|other| other.id != marker.id).filter_map(|other| off(board, other, marker)).collect();
        median(&mut all).unwrap_or(f64::INFINITY)
    };
    let mut once: Vec<(f64, &Seen)> = all.iter().map(|marker| (off(marker), *marker)).collect();
    once.sort_by(|a, b| (a.1.id, a.0).partial_cmp(&(b.1.id, b.0)).unwrap_or(std::cmp::Ordering::Equal));
    once.dedup_by_key(|marker| marker.1.id);
    Ok(once.into_iter().map(|marker| marker.1).collect())
}

/// Mean distance of a marker's corners from where another marker, at most two away, has them.
fn off(board: &MarkerGrid, from: &Seen, to: &Seen) -> Option<f64> {
    let (a, b) = (board.cell(from.id), board.cell(to.id));
    let step = |a: usize, b: usize| (1.0 + board.spacing) * (b as f64 - a as f64);
    let near = a.0.abs_diff(b.0).max(a.1.abs_diff(b.1)) <= 2;
    let unit = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
    let place = |(x, y): (f64, f64)| mapped(&from.map, x + step(a.0, b.0), y + step(a.1, b.1));
    near.then(|| unit.iter().zip(&to.corners).map(|(u, seen)| (place(*u) - seen).norm()).sum::<f64>() / 4.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::targets::{Board, Dictionary};
    use cv_core::{Silent, Vector3};
    use cv_imgproc::{gray_to_f32, linear_to_srgb};

    /// A picture of boards, each through a homography from board to picture, four samples of light to a pixel each way, as sRGB.
    fn picture(boards: &[(Board, Matrix3<f64>)], (w, h): (usize, usize)) -> GrayF32 {
        let all: Vec<_> = boards.iter().map(|(b, map)| (b.black(), map.try_inverse().unwrap())).collect();
        let light = GrayF32::from_fn(w, h, |x, y| {
            let mut sum = 0.0;
            for k in 0..16 {
                let at =
                    Vector3::new(x as f64 + (k % 4) as f64 / 4.0 - 0.375, y as f64 + (k / 4) as f64 / 4.0 - 0.375, 1.0);
                let black = all.iter().any(|(black, back)| {
                    let p = back * at;
                    let (u, v) = (p.x / p.z, p.y / p.z);
                    black.iter().any(|r| u >= r.x && v >= r.y && u < r.x + r.width && v < r.y + r.height)
                });
                sum += if black { 0.02 } else { 0.6 };
            }
            [sum / 16.0]
        });
        gray_to_f32(linear_to_srgb(light.view()).view())
    }

    fn grid(style: GridStyle, dictionary: Dictionary) -> MarkerGrid {
        MarkerGrid { markers: (5, 4), marker: 20.0, spacing: 0.3, dictionary, style }
    }

    /// Turned by `angle`, tilted, with the middle of the board at a place of the picture.
    fn map(scale: f64, angle: f64, at: (f64, f64)) -> Matrix3<f64> {
        let (sin, cos) = angle.sin_cos();
        let map = Matrix3::new(scale * cos, -scale * sin, 0.0, scale * sin, scale * cos, 0.0, 4e-4, -5e-4, 1.0);
        let middle = mapped(&map, 62.0, 49.0);
        Matrix3::new(1.0, 0.0, at.0 - middle.x, 0.0, 1.0, at.1 - middle.y, 0.0, 0.0, 1.0) * map
    }

    fn find(image: &GrayF32, board: &MarkerGrid) -> Result<Vec<BoardPoint>, BoardError> {
        find_marker_grid(image.view(), board, &ChessboardOptions::default(), &Silent)
    }

    #[test]
    fn parts_of_grids_are_found_with_their_numbers() {
        for (board, angle) in [
            (grid(GridStyle::Aruco, Dictionary::Aruco4x4x50), 0.4),
            (grid(GridStyle::Aruco, Dictionary::Aruco6x6x100), 2.1),
            (grid(GridStyle::AprilGrid, Dictionary::AprilTag36h11), 3.5),
            (grid(GridStyle::AprilGrid, Dictionary::AprilTag36h11), -0.3),
        ] {
            let map = map(3.2, angle, (210.0, 150.0));
            let image = picture(&[(Board::MarkerGrid(board), map)], (420, 300));
            let found = find(&image, &board).unwrap();
            let inside = |id: usize| {
                (0..4).all(|k| {
                    let o = board.point(4 * id + k);
                    let p = mapped(&map, o.x, o.y);
                    p.x > 15.0 && p.y > 15.0 && p.x < 405.0 && p.y < 285.0
                })
            };
            let visible = (0..20).filter(|id| inside(*id)).count();
            assert!(visible < 20 && found.len() >= 4 * visible, "{angle}: {} of {visible} markers", found.len());
            let mut errors: Vec<f64> = found
                .iter()
                .map(|point| {
                    let o = board.point(point.id);
                    (point.position - mapped(&map, o.x, o.y)).norm()
                })
                .collect();
            errors.sort_by(f64::total_cmp);
            // Edges without any blur: a quarter of a pixel is the step of the sampling, over which some tens of samples of an edge are averaged.
            let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
            assert!(median < 0.08 && worst < 0.4, "{angle}: {median} {worst}");
        }
    }

    #[test]
    fn what_is_not_the_board_is_told_apart() {
        let board = grid(GridStyle::Aruco, Dictionary::Aruco5x5x100);
        let straight = map(2.4, 0.2, (180.0, 130.0));
        let image = picture(&[(Board::MarkerGrid(board), straight)], (360, 260));
        let asked = MarkerGrid { dictionary: Dictionary::Aruco4x4x50, ..board };
        // Markers are named by the largest set that has them. Some lie partly outside.
        assert!(matches!(
            find(&image, &asked),
            Err(BoardError::OtherDictionary {
                seen: Dictionary::Aruco5x5x250,
                markers: 10..=20,
                asked: Dictionary::Aruco4x4x50,
            })
        ));
        let mirrored = GrayF32::from_fn(360, 260, |x, y| image.at(359 - x, y));
        assert!(matches!(find(&mirrored, &board), Err(BoardError::Mirrored { markers: 10..=20, .. })));
        let empty = GrayF32::new(100, 80, [0.5]);
        assert!(matches!(find(&empty, &board), Err(BoardError::NoMarkers { seen: 0, .. })));
        // A pitch that is not that of the board puts no neighbor where it is.
        let wide = MarkerGrid { spacing: 0.9, ..board };
        assert!(matches!(find(&image, &wide), Err(BoardError::OtherLayout { .. })));
        let two = [(Board::MarkerGrid(board), straight), (Board::MarkerGrid(board), map(2.4, -0.1, (520.0, 130.0)))];
        let image = picture(&two, (700, 260));
        assert_eq!(find(&image, &board), Err(BoardError::SeveralBoards { boards: 2 }));
    }
}
