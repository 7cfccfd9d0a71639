//! Detection of marker grids.

use cv_core::{GrayF32, Matrix3, Point2, Silent, Vector3};
use cv_features::{
    Board, BoardError, BoardPoint, ChessboardOptions, Dictionary, GridStyle, MarkerGrid, find_marker_grid,
};
use cv_imgproc::{gray_to_f32, linear_to_srgb};

fn apply_homography(map: &Matrix3<f64>, x: f64, y: f64) -> Point2<f64> {
    let p = map * Vector3::new(x, y, 1.0);
    Point2::new(p.x / p.z, p.y / p.z)
}

/// Renders boards by homographies from board to image, with 4×4 samples of linear intensity per pixel, encoded as
/// sRGB.
fn render(boards: &[(Board, Matrix3<f64>)], (w, h): (usize, usize)) -> GrayF32 {
    let all: Vec<_> = boards.iter().map(|(b, map)| (b.black_rectangles(), map.try_inverse().unwrap())).collect();
    let linear = GrayF32::from_fn(w, h, |x, y| {
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
    gray_to_f32(linear_to_srgb(linear.view()).view())
}

fn grid(style: GridStyle, dictionary: Dictionary) -> MarkerGrid {
    MarkerGrid { markers: (5, 4), marker: 20.0, spacing: 0.3, dictionary, style }
}

/// A homography with rotation by `angle` and perspective, which maps the board's center to `at`.
fn map(scale: f64, angle: f64, at: (f64, f64)) -> Matrix3<f64> {
    let (sin, cos) = angle.sin_cos();
    let map = Matrix3::new(scale * cos, -scale * sin, 0.0, scale * sin, scale * cos, 0.0, 4e-4, -5e-4, 1.0);
    let middle = apply_homography(&map, 62.0, 49.0);
    Matrix3::new(1.0, 0.0, at.0 - middle.x, 0.0, 1.0, at.1 - middle.y, 0.0, 0.0, 1.0) * map
}

fn find(image: &GrayF32, board: &MarkerGrid) -> Result<Vec<BoardPoint>, BoardError> {
    find_marker_grid(image.view(), board, &ChessboardOptions::default(), &Silent)
}

#[test]
fn partially_visible_grids_are_detected_with_their_ids() {
    for (board, angle) in [
        (grid(GridStyle::Aruco, Dictionary::Aruco4x4x50), 0.4),
        (grid(GridStyle::Aruco, Dictionary::Aruco6x6x100), 2.1),
        (grid(GridStyle::AprilGrid, Dictionary::AprilTag36h11), 3.5),
        (grid(GridStyle::AprilGrid, Dictionary::AprilTag36h11), -0.3),
    ] {
        let map = map(3.2, angle, (210.0, 150.0));
        let image = render(&[(Board::MarkerGrid(board), map)], (420, 300));
        let found = find(&image, &board).unwrap();
        let inside = |id: usize| {
            (0..4).all(|k| {
                let o = board.point(4 * id + k);
                let p = apply_homography(&map, o.x, o.y);
                p.x > 15.0 && p.y > 15.0 && p.x < 405.0 && p.y < 285.0
            })
        };
        let visible = (0..20).filter(|id| inside(*id)).count();
        assert!(visible < 20 && found.len() >= 4 * visible, "{angle}: {} of {visible} markers", found.len());
        let mut errors: Vec<f64> = found
            .iter()
            .map(|point| {
                let o = board.point(point.id);
                (point.position - apply_homography(&map, o.x, o.y)).norm()
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        // Edges without blur, sampled in steps of a quarter of a pixel; tens of samples per edge are averaged.
        let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
        assert!(median < 0.08 && worst < 0.4, "{angle}: {median} {worst}");
    }
}

#[test]
fn other_boards_are_diagnosed() {
    let board = grid(GridStyle::Aruco, Dictionary::Aruco5x5x100);
    let straight = map(2.4, 0.2, (180.0, 130.0));
    let image = render(&[(Board::MarkerGrid(board), straight)], (360, 260));
    let asked = MarkerGrid { dictionary: Dictionary::Aruco4x4x50, ..board };
    // The reported dictionary is the largest of its family. Some markers are partly outside.
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
    // With a wrong spacing, no neighbor is at its predicted position.
    let wide = MarkerGrid { spacing: 0.9, ..board };
    assert!(matches!(find(&image, &wide), Err(BoardError::OtherLayout { .. })));
    let two = [(Board::MarkerGrid(board), straight), (Board::MarkerGrid(board), map(2.4, -0.1, (520.0, 130.0)))];
    let image = render(&two, (700, 260));
    assert_eq!(find(&image, &board), Err(BoardError::SeveralBoards { boards: 2 }));
}
