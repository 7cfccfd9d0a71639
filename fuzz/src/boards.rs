//! Fuzzes the detectors of calibration boards with small images: any board, any viewpoint, damaged.

use crate::structured as make;
use arbitrary::Unstructured;
use cv_core::GrayF32;
use cv_pipeline::Silent;
use cv_pipeline::calibration::{
    Board, BoardSize, CharucoBoard, ChessboardOptions, Dictionary, GridStyle, MarkerGrid, find_board,
};
use libfuzzer_sys::Corpus;

/// Asserts that detected points have unique, valid ids and are inside the image.
pub fn board(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let shape = (make::whole(u, 2, 6), make::whole(u, 2, 5));
    let dictionary = [Dictionary::Aruco4x4x50, Dictionary::ArucoOriginal, Dictionary::AprilTag36h11];
    let dictionary = dictionary[make::whole(u, 0, dictionary.len() - 1)];
    let board = match make::whole(u, 0, 3) {
        0 => Board::Chessboard { size: BoardSize::new(shape.0, shape.1), square: 1.0 },
        1 => {
            Board::Charuco(CharucoBoard { squares: shape, square: 1.0, marker: make::within(u, 0.2, 1.0), dictionary })
        }
        kind => Board::MarkerGrid(MarkerGrid {
            markers: shape,
            marker: 1.0,
            spacing: make::within(u, 0.0, 1.1),
            dictionary,
            style: if kind == 2 { GridStyle::Aruco } else { GridStyle::AprilGrid },
        }),
    };
    if board.check().is_err() {
        return Corpus::Keep;
    }
    let (w, h) = (make::whole(u, 0, 160), make::whole(u, 0, 120));
    let image = render_board(u, &board, (w, h));
    if let Ok(points) = find_board(image.view(), &board, &ChessboardOptions::default(), &Silent) {
        let mut ids: Vec<usize> = points.iter().map(|point| point.id).collect();
        ids.sort_unstable();
        ids.dedup();
        assert!(ids.len() == points.len() && ids.last().is_none_or(|last| *last < board.points().len()));
        for point in points {
            let inside = |v: f64, n: usize| (-1.0..=n as f64).contains(&v);
            assert!(inside(point.position.x, w) && inside(point.position.y, h), "{point:?}");
            assert!(point.deviation.is_finite() && point.deviation >= 0.0, "{point:?}");
        }
    }
    Corpus::Keep
}

/// Renders the board under a rotation, tilt and illumination, partly covered by rectangles of any gray level.
fn render_board(u: &mut Unstructured<'_>, board: &Board, (w, h): (usize, usize)) -> GrayF32 {
    let (black, o) = (board.black_rectangles(), board.outline());
    let (sin, cos) = make::within(u, -3.2, 3.2).sin_cos();
    let size = make::within(u, 0.4, 1.3) * (w as f64 / o.width).min(h as f64 / o.height);
    let tilt = [make::within(u, -0.004, 0.004), make::within(u, -0.004, 0.004)];
    let light = [make::within(u, 0.0, 0.5) as f32, make::within(u, 0.4, 1.0) as f32];
    let mut image = GrayF32::from_fn(w, h, |x, y| {
        let (x, y) = (x as f64 - 0.5 * w as f64, y as f64 - 0.5 * h as f64);
        let scale = (1.0 + tilt[0] * x + tilt[1] * y) / size;
        let (x, y) = (scale * (cos * x - sin * y), scale * (sin * x + cos * y));
        let (x, y) = (x + o.x + 0.5 * o.width, y + o.y + 0.5 * o.height);
        let dark = black.iter().any(|r| x > r.x && y > r.y && x < r.x + r.width && y < r.y + r.height);
        [light[usize::from(!dark)]]
    });
    for _ in 0..make::whole(u, 0, 6) {
        let [x, y, wide, high, gray]: [u8; 5] = u.arbitrary().unwrap_or_default();
        let is_extreme = gray == 255;
        let gray = if is_extreme { make::number(u) as f32 } else { f32::from(gray) / 255.0 };
        for y in (usize::from(y)..h).take(1 + usize::from(high) / 8) {
            for x in (usize::from(x)..w).take(1 + usize::from(wide) / 8) {
                image.set(x, y, [gray]);
            }
        }
    }
    image
}
