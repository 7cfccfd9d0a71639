//! Detection of chessboards in generated photographs.

use cv_core::{Cancelled, GrayF32, Point2, Progress, Silent};
use cv_features::{BoardError, BoardSize, Chessboard, ChessboardOptions, FeatureError, find_chessboard};
use cv_imgproc::{gray_to_f32, rgb_to_gray};
use cv_synth::{ChessboardPhoto, ChessboardTrial, chessboard_photo, photo_without_board};

const SIZE: BoardSize = BoardSize { columns: 9, rows: 6 };

fn photo(trial: ChessboardTrial, seed: u64) -> (GrayF32, ChessboardPhoto) {
    let photo = chessboard_photo((9, 6), trial, seed).unwrap();
    (gray_to_f32(rgb_to_gray(photo.image.view()).view()), photo)
}

fn find(gray: &GrayF32, size: Option<BoardSize>) -> Result<Chessboard, BoardError> {
    find_chessboard(gray.view(), size, &ChessboardOptions::default(), &Silent)
}

/// Sorted distances of the corners to the ground truth, in the order of the board.
fn errors(board: &Chessboard, photo: &ChessboardPhoto) -> Vec<f64> {
    let mut errors: Vec<f64> = board.corners.iter().zip(&photo.corners).map(|(c, t)| (c - t.unwrap()).norm()).collect();
    errors.sort_by(f64::total_cmp);
    errors
}

#[test]
fn complete_boards_are_localized_accurately() {
    use ChessboardTrial as T;
    // The medians over forty images of each kind are 0.009, 0.008, 0.032, 0.010, 0.023 and 0.011 px. A single
    // image may have about three times that: blur, noise and glare are random, and with a wide-angle lens edges are
    // curved within the window.
    for (trial, median) in
        [(T::Clean, 0.03), (T::Blur, 0.03), (T::Noise, 0.1), (T::Tilt, 0.03), (T::Glare, 0.07), (T::Wide, 0.035)]
    {
        let (gray, photo) = photo(trial, 100);
        let board = find(&gray, Some(SIZE)).unwrap_or_else(|e| panic!("{trial:?}: {e}"));
        let errors = errors(&board, &photo);
        // A wrong first corner would be an error of at least a square.
        assert!(errors[27] < median && errors[53] < 1.0, "{trial:?}: {} {}", errors[27], errors[53]);
        assert!(board.deviations.iter().all(|d| (0.01..0.5).contains(d)), "{trial:?}");
    }
}

#[test]
fn the_size_is_determined_and_other_sizes_are_rejected() {
    let (gray, photo) = photo(ChessboardTrial::Clean, 7);
    let board = find(&gray, None).unwrap();
    assert_eq!(board, find(&gray, Some(SIZE)).unwrap());
    assert!(errors(&board, &photo)[53] < 0.5);
    assert_eq!(board.points()[10].id, 10);
    // The transposed board: rotated by a quarter turn, also starting at a black corner.
    let turned = find(&gray, Some(SIZE.transposed())).unwrap();
    let last_column: Vec<_> = (0..6).map(|r| board.corners[9 * r]).rev().collect();
    let first_row = turned.corners[..6].to_vec();
    assert!(first_row == last_column || first_row.iter().eq((0..6).map(|r| &board.corners[9 * r + 8])));
    let asked = BoardSize::new(7, 5);
    assert_eq!(find(&gray, Some(asked)), Err(BoardError::OtherSize { seen: SIZE, asked }));
    assert_eq!(find(&gray, Some(asked)).unwrap_err().to_string(), "detected a board of 9×6, not 7×5 inner corners");
    let asked = BoardSize::new(2, 5);
    assert_eq!(find(&gray, Some(asked)), Err(BoardError::Size { asked }));
    // The order on the board does not change if the image is rotated by 180°.
    let (w, h) = gray.size();
    let upside_down = GrayF32::from_fn(w, h, |x, y| gray.at(w - 1 - x, h - 1 - y));
    for (a, b) in find(&upside_down, Some(SIZE)).unwrap().corners.iter().zip(&board.corners) {
        let turned = Point2::new(w as f64 - 1.0 - b.x, h as f64 - 1.0 - b.y);
        assert!((a - turned).norm() < 0.01, "{a} {turned}");
    }
}

#[test]
fn truncated_boards_are_reported_as_partial() {
    for seed in [3, 5] {
        let (gray, photo) = photo(ChessboardTrial::Cut, seed);
        let visible = photo.corners.iter().flatten().count();
        match find(&gray, Some(SIZE)) {
            Err(BoardError::Partial { found, cut_off, .. }) => {
                assert!(cut_off && found <= visible && 2 * found > visible, "{seed}: {found} of {visible}");
            }
            other => panic!("{seed}: {other:?}, {visible} corners visible"),
        }
    }
}

/// A chessboard of squares of `side` pixels, whose first inner corner is at `first`; turned by 3°. With 8 × 8 samples per pixel.
fn drawn_board((width, height): (usize, usize), first: Point2<f64>, side: f64) -> GrayF32 {
    let (sin, cos) = 3f64.to_radians().sin_cos();
    let is_black = |x: f64, y: f64| {
        let (dx, dy) = (x - first.x, y - first.y);
        let (i, j) = ((dx * cos + dy * sin).div_euclid(side) as i64, (dy * cos - dx * sin).div_euclid(side) as i64);
        (-1..9).contains(&i) && (-1..6).contains(&j) && (i + j) % 2 == 0
    };
    let offset = |k: usize| (k as f64 + 0.5) / 8.0 - 0.5;
    GrayF32::from_fn(width, height, |x, y| {
        let black = (0..64).filter(|k| is_black(x as f64 + offset(k / 8), y as f64 + offset(k % 8))).count();
        [0.9 - 0.8 * black as f32 / 64.0]
    })
}

#[test]
fn boards_are_detected_up_to_the_image_border() {
    // All inner corners are in the image; of the outer squares, those of the first row and column are cut off. A corner that is
    // less than 4 px from the border is not localized.
    let side = 40.0;
    let (sin, cos) = 3f64.to_radians().sin_cos();
    for near in [6.0, 9.0, 14.0] {
        let first = Point2::new(near + 5.0 * side * sin, near);
        let gray = drawn_board((400, 280), first, side);
        let board = find(&gray, Some(SIZE)).unwrap_or_else(|error| panic!("{near}: {error}"));
        let mut errors: Vec<f64> = (0..54)
            .map(|k| {
                let (i, j) = ((k % 9) as f64 * side, (k / 9) as f64 * side);
                let truth = Point2::new(first.x + i * cos - j * sin, first.y + i * sin + j * cos);
                board.corners.iter().map(|c| (c - truth).norm()).fold(f64::INFINITY, f64::min)
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        // The aliasing of unblurred edges; more in the small windows at the border.
        assert!(errors[27] < 0.02 && errors[53] < 0.1, "{near}: {} {}", errors[27], errors[53]);
    }
    let cut_off = find(&drawn_board((400, 280), Point2::new(2.0 + 5.0 * side * sin, 2.0), side), Some(SIZE));
    assert!(matches!(cut_off, Err(BoardError::Partial { found: 40..54, cut_off: true, .. })), "{cut_off:?}");
}

#[test]
fn several_boards_are_reported() {
    // Two boards of 10×7 squares of 20 px, with white margins of 40 px.
    let image = GrayF32::from_fn(560, 220, |x, y| {
        let (i, j) = ((x as i64 % 260 - 40).div_euclid(20), (y as i64 - 40).div_euclid(20));
        let black = (0..10).contains(&i) && (0..7).contains(&j) && (i + j) % 2 == 0 && x < 510;
        [if black { 0.1 } else { 0.9 }]
    });
    assert_eq!(find(&image, Some(SIZE)), Err(BoardError::SeveralBoards { boards: 2 }));
    assert_eq!(find(&image, None).map(|board| board.size), Ok(SIZE));
    // The picture of the board on a screen beside it has a quarter of its extent.
    let large = drawn_board((520, 340), Point2::new(150.0, 60.0), 40.0);
    let small = drawn_board((520, 340), Point2::new(15.0, 60.0), 10.0);
    let image = GrayF32::from_fn(520, 340, |x, y| if x < 100 { small.at(x, y) } else { large.at(x, y) });
    let found = find(&image, Some(SIZE)).unwrap();
    assert!(found == find(&large, Some(SIZE)).unwrap() && find(&small, Some(SIZE)).is_ok());
}

#[test]
fn images_without_a_board_have_no_detection() {
    for seed in 0..4 {
        let gray = gray_to_f32(rgb_to_gray(photo_without_board(seed).unwrap().view()).view());
        for size in [Some(SIZE), None] {
            assert!(find(&gray, size).is_err(), "{seed}");
        }
    }
}

#[test]
fn unsuitable_input_is_an_error() {
    for (w, h) in [(0, 0), (1, 1), (15, 400), (16, 16), (60, 17)] {
        assert!(find(&GrayF32::new(w, h, [0.5]), Some(SIZE)).is_err());
    }
    let mut image = GrayF32::new(40, 40, [0.5]);
    image.set(3, 4, [f32::NAN]);
    assert_eq!(find(&image, None), Err(FeatureError::NotFinite { x: 3, y: 4 }.into()));
    // Tens of thousands of corners, a board that fills the image, and intensities far above 1.
    for (period, scale) in [(4, 1.0), (9, 1.0), (24, 1e30)] {
        let image = GrayF32::from_fn(500, 400, |x, y| [((x / period + y / period) % 2) as f32 * scale]);
        assert!(find(&image, Some(SIZE)).is_err(), "{period}");
    }
    let options = ChessboardOptions { max_window_radius: 1.0, ..ChessboardOptions::default() };
    let refused = find_chessboard(image.view(), None, &options, &Silent);
    assert!(matches!(refused, Err(BoardError::Feature(FeatureError::Option(_)))));
    struct Stop;
    impl Progress for Stop {
        fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
            Err(Cancelled)
        }
    }
    let stopped = find_chessboard(GrayF32::new(64, 64, [0.5]).view(), None, &ChessboardOptions::default(), &Stop);
    assert_eq!(stopped, Err(Cancelled.into()));
}

#[test]
fn the_result_does_not_depend_on_the_number_of_threads() {
    let (gray, _) = photo(ChessboardTrial::Noise, 4);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| find(&gray, Some(SIZE)))
    };
    assert_eq!(with(1), with(3));
}
