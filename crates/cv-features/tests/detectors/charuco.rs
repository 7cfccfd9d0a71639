//! Detection of ChArUco boards.

use cv_core::{GrayF32, Matrix3, Point2, Silent, Vector3};
use cv_features::{BoardError, CharucoBoard, ChessboardOptions, Dictionary, find_charuco};

/// Renders a board by a homography from board to image, with 4×4 samples per pixel.
fn render(board: &CharucoBoard, map: &Matrix3<f64>, (w, h): (usize, usize)) -> GrayF32 {
    let back = map.try_inverse().unwrap();
    GrayF32::from_fn(w, h, |x, y| {
        let mut sum = 0.0;
        for k in 0..16 {
            let at =
                Vector3::new(x as f64 + (k % 4) as f64 / 4.0 - 0.375, y as f64 + (k / 4) as f64 / 4.0 - 0.375, 1.0);
            let p = back * at;
            sum += if board.is_black(p.x / p.z, p.y / p.z) { 0.1 } else { 0.8 };
        }
        [sum / 16.0]
    })
}

#[test]
fn partially_visible_boards_are_detected_with_their_ids() {
    for (dictionary, k) in [(Dictionary::Aruco4x4x50, 0), (Dictionary::Aruco6x6x250, 1), (Dictionary::AprilTag36h11, 2)]
    {
        let board = CharucoBoard { squares: (8, 6), square: 30.0, marker: 22.0, dictionary };
        // Rotated, with perspective, and partly outside.
        let (sin, cos) = (0.4 + 1.7 * k as f64).sin_cos();
        let map = Matrix3::new(1.9 * cos, -1.8 * sin, 0.0, 1.9 * sin, 1.8 * cos, 0.0, 4e-4, -5e-4, 1.0);
        let middle = map * Vector3::new(110.0, 80.0, 1.0);
        let (dx, dy) = (160.0 - middle.x / middle.z, 130.0 - middle.y / middle.z);
        let map = Matrix3::new(1.0, 0.0, dx, 0.0, 1.0, dy, 0.0, 0.0, 1.0) * map;
        let image = render(&board, &map, (360, 300));
        let found = find_charuco(image.view(), &board, &ChessboardOptions::default(), &Silent).unwrap();
        let place = |id: usize| {
            let p = board.point(id);
            let q = map * Vector3::new(p.x, p.y, 1.0);
            Point2::new(q.x / q.z, q.y / q.z)
        };
        let inside = |p: Point2<f64>| p.x > 8.0 && p.y > 8.0 && p.x < 352.0 && p.y < 292.0;
        let visible = (0..board.corners().corners()).filter(|&id| inside(place(id))).count();
        assert!(visible < 35 && found.len() + 4 >= visible, "{dictionary}: {} of {visible}", found.len());
        for point in &found {
            // Edges without blur in a window of five pixels; the mean error is 0.05 px.
            let off = (point.position - place(point.id)).norm();
            assert!(off < 0.3, "{dictionary} {}: {off}", point.id);
        }
        let two = GrayF32::from_fn(720, 300, |x, y| image.at(x % 360, y));
        assert_eq!(
            find_charuco(two.view(), &board, &ChessboardOptions::default(), &Silent),
            Err(BoardError::SeveralBoards { boards: 2 })
        );
        // A board with another dictionary.
        let other = CharucoBoard { dictionary: Dictionary::Aruco5x5x50, ..board };
        let find = |image: &GrayF32, board| find_charuco(image.view(), board, &ChessboardOptions::default(), &Silent);
        assert!(matches!(
            find(&image, &other),
            Err(BoardError::OtherDictionary { markers: 5.., asked: Dictionary::Aruco5x5x50, .. })
        ));
        let mirrored = GrayF32::from_fn(360, 300, |x, y| image.at(359 - x, y));
        assert!(matches!(find(&mirrored, &board), Err(BoardError::Mirrored { markers: 5.., .. })));
    }
}
