//! `cv board`: calibration boards to print.

use crate::boards::{BoardArgs, board_options, describe_board};
use crate::frame::{Context, Failure, Global, Outcome, Output, Run};
use cv_pipeline::calibration::Board;
use cv_report::{PrintSheet, Raster};
use serde_json::json;
use std::path::PathBuf;

/// Draw a calibration board to print: chessboard, ChArUco, ArUco grid or AprilGrid, at its true size.
///
/// The sheet has a ruler to check the printed scale, and the options of `cv calibrate` for the board.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv board -o board.pdf --board 9x6 --square 25 --paper a4\n  \
    cv board -o board.pdf --kind charuco --board 7x5 --square 35 --marker 26 --paper a4\n  \
    cv board -o grid.svg --kind aruco-grid --board 4x6 --marker 30 --dictionary 6x6_250\n  \
    cv board -o tags.png --kind aprilgrid --board 6x6 --marker 45 --paper a2 --dpi 600")]
pub(crate) struct Args {
    /// Where to write it: .pdf, .svg or .png.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The board; lengths are millimeters.
    #[command(flatten)]
    board: BoardArgs,
    /// Paper: a0 to a5, letter, legal, tabloid, or width and height in millimeters. Portrait or landscape is chosen to fit the board.
    #[arg(long, value_name = "NAME|WxH", default_value = "a4", value_parser = parse_paper)]
    paper: Paper,
    /// Dots per inch of a .png [default: 300].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(50..=1200))]
    dpi: Option<u16>,
}

/// The extensions of the formats.
const ENDINGS: &[&str] = &["pdf", "svg", "png"];

/// A paper size: width and height in millimeters, in portrait orientation.
#[derive(Debug, Clone, PartialEq)]
struct Paper {
    name: String,
    size: (f64, f64),
}

/// ISO 216 and the sizes of North America, in millimeters.
const PAPERS: [(&str, (f64, f64)); 9] = [
    ("a0", (841.0, 1189.0)),
    ("a1", (594.0, 841.0)),
    ("a2", (420.0, 594.0)),
    ("a3", (297.0, 420.0)),
    ("a4", (210.0, 297.0)),
    ("a5", (148.0, 210.0)),
    ("letter", (215.9, 279.4)),
    ("legal", (215.9, 355.6)),
    ("tabloid", (279.4, 431.8)),
];

fn parse_paper(text: &str) -> Result<Paper, String> {
    let name = text.to_lowercase();
    if let Some((_, size)) = PAPERS.iter().find(|p| p.0 == name) {
        return Ok(Paper { name, size: *size });
    }
    let sides = text.split_once(['x', '×']).and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let valid = sides.filter(|(w, h): &(f64, f64)| [w, h].iter().all(|v| (50.0..=3000.0).contains(*v)));
    valid.map(|size| Paper { name, size }).ok_or_else(|| {
        let names: Vec<&str> = PAPERS.iter().map(|p| p.0).collect();
        format!("give one of {}, or millimeters from 50 to 3000 as 300x200", names.join(", "))
    })
}

/// White margin in mm around the board: the unprintable border of the paper.
const MARGIN_MM: f64 = 8.0;
/// Height in mm of the ruler and the text below the board.
const FOOTER_MM: f64 = 16.0;

/// Returns the width and height in mm available to the board on a sheet of `(width, height)` mm.
fn printable_area((width, height): (f64, f64)) -> (f64, f64) {
    (width - 2.0 * MARGIN_MM, height - 2.0 * MARGIN_MM - FOOTER_MM)
}

/// Lays out a board in the center of a sheet of paper, with its ruler and text.
fn sheet(board: &Board, paper: &Paper) -> Result<PrintSheet, Failure> {
    let outline = board.outline();
    let (w, h) = (outline.width, outline.height);
    // The largest scale at which the board fits.
    let max_scale = |size: (f64, f64)| (printable_area(size).0 / w).min(printable_area(size).1 / h);
    let landscape = (paper.size.1, paper.size.0);
    let size = if max_scale(landscape) > max_scale(paper.size) { landscape } else { paper.size };
    let scale = max_scale(size);
    if scale < 1.0 {
        let (width, height) = printable_area(size);
        let what = format!(
            "the board is {w:.1}×{h:.1} mm, and paper of {} has room for {width:.1}×{height:.1} mm",
            paper.name
        );
        // Rounded down to tenths of a millimeter.
        let largest = |length: f64| (10.0 * length * scale).floor().max(0.0) / 10.0;
        let fits = match *board {
            Board::Chessboard { square, .. } => format!("--square {} at most", largest(square)),
            Board::Charuco(b) => format!("--square {} --marker {} at most", largest(b.square), largest(b.marker)),
            Board::MarkerGrid(g) => format!("--marker {} at most", largest(g.marker)),
        };
        return Err(Failure::new(what).advice(format!("{fits}, or larger paper (--paper)")));
    }
    let mut sheet = PrintSheet::new(size, &describe_board(board, "mm"));
    let (left, top) = ((size.0 - w) / 2.0, MARGIN_MM + (printable_area(size).1 - h) / 2.0);
    for r in board.black_rectangles() {
        sheet.rectangle([r.x - outline.x + left, r.y - outline.y + top, r.width, r.height]);
    }
    let length = [100.0, 50.0, 20.0].into_iter().find(|l| l + 12.0 <= printable_area(size).0).unwrap_or(10.0);
    let bottom = size.1 - MARGIN_MM;
    sheet.ruler([MARGIN_MM, bottom - 8.0], length as usize);
    let lines = [
        format!("{}. Print at 100 %: the ruler must be {length} mm long.", describe_board(board, "mm")),
        format!("cv calibrate mono {} PHOTOS -o camera.yaml", board_options(board)),
    ];
    for (line, below) in lines.iter().zip([4.0, 0.0]) {
        // Height of the capitals in mm, reduced until the line fits the paper.
        let capitals = (printable_area(size).0 / f64::from(Raster::text_width(line, 100.0)) * 100.0).min(2.2);
        sheet.text([MARGIN_MM, bottom - below], capitals, line);
    }
    Ok(sheet)
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        vec![Output::File(&self.output, ENDINGS)]
    }

    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed, Global::Report]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let board = self.board.known()?;
        let png = self.output.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"));
        if self.dpi.is_some() && !png {
            return Err(Failure::usage("--dpi applies to .png only: the other formats are vector graphics"));
        }
        let sheet = sheet(&board, &self.paper)?;
        let dpi = f64::from(self.dpi.unwrap_or(300));
        context.write(Output::File(&self.output, ENDINGS), |path| {
            match path.extension().and_then(|e| e.to_str()).map(str::to_lowercase).as_deref() {
                Some("png") => cv_io::write_png_to_print(path, sheet.to_pixels(dpi).view(), dpi),
                Some("svg") => cv_io::write_bytes(path, sheet.to_svg().as_bytes()),
                _ => cv_io::write_bytes(path, &sheet.to_pdf()),
            }
        })?;
        let (outline, (width, height)) = (board.outline(), sheet.size());
        let description = describe_board(&board, "mm");
        Ok(Outcome::new(Vec::new())
            .with("board", &description)
            .with("options", board_options(&board))
            .with("points", board.points().len())
            .with("board_mm", json!([outline.width, outline.height]))
            .with("paper_mm", json!([width, height]))
            .summary(format!(
                "{description}: {:.1}×{:.1} mm on {width}×{height} mm\nprint at 100 %, check the ruler, mount it flat; then: cv calibrate mono {} PHOTOS -o camera.yaml",
                outline.width,
                outline.height,
                board_options(&board)
            )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_pipeline::calibration::{
        BoardKind, BoardSize, CharucoBoard, ChessboardOptions, Dictionary, GridStyle, MarkerGrid, find_board,
    };

    fn boards() -> [Board; 4] {
        let april = MarkerGrid {
            markers: (6, 4),
            marker: 30.0,
            spacing: 0.3,
            dictionary: Dictionary::AprilTag36h11,
            style: GridStyle::AprilGrid,
        };
        let aruco = MarkerGrid { dictionary: Dictionary::Aruco4x4x50, style: GridStyle::Aruco, ..april };
        let charuco =
            CharucoBoard { squares: (8, 5), square: 30.0, marker: 22.0, dictionary: Dictionary::Aruco5x5x100 };
        [
            Board::Chessboard { size: BoardSize::new(9, 6), square: 25.0 },
            Board::Charuco(charuco),
            Board::MarkerGrid(aruco),
            Board::MarkerGrid(april),
        ]
    }

    #[test]
    fn every_point_of_a_printed_sheet_is_detected_at_its_position_in_millimeters() {
        let paper = parse_paper("a4").unwrap();
        for board in boards() {
            let sheet = sheet(&board, &paper).unwrap();
            assert_eq!(sheet.size(), (297.0, 210.0));
            let dpi = 100.0;
            // White coverage of each pixel. Corners of ArUco markers are refined in linear intensity, so encode as sRGB (IEC 61966-2-1); the others need no transfer curve.
            let aruco = board.kind() == BoardKind::ArucoGrid;
            let srgb = |v: f32| if v <= 0.0031308 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
            let image = sheet.to_pixels(dpi).map(|[v]| {
                let white = f32::from(v) / 255.0;
                [if aruco { srgb(white) } else { white }]
            });
            let found = find_board(image.view(), &board, &ChessboardOptions::default(), &cv_pipeline::Silent).unwrap();
            let (points, o) = (board.points(), board.outline());
            assert_eq!(found.len(), points.len(), "{}", board.kind());
            let (left, top) = ((297.0 - o.width) / 2.0, MARGIN_MM + (printable_area(sheet.size()).1 - o.height) / 2.0);
            for point in found {
                let p = points[point.id];
                // The corner of the sheet is the corner of the first pixel, whose center is at 0.
                let at = |v: f64, first: f64, from: f64| (v - first + from) * dpi / 25.4 - 0.5;
                let off = (point.position.x - at(p.x, o.x, left)).hypot(point.position.y - at(p.y, o.y, top));
                // Edges are exact to 1/255 px; lines are fitted to interpolated half-intensity crossings.
                // A marker's corner is the intersection of two such lines: both coordinates are uncertain.
                let most = if aruco { 0.1 * std::f64::consts::SQRT_2 } else { 0.1 };
                assert!(off < most, "{} {}: {off} px", board.kind(), point.id);
            }
        }
    }

    #[test]
    fn a_board_larger_than_the_paper_is_refused_with_the_largest_size() {
        let paper = parse_paper("letter").unwrap();
        let board = |square| Board::Chessboard { size: BoardSize::new(9, 6), square };
        let text = sheet(&board(30.0), &paper).unwrap_err().text();
        // 279.4 − 16 over ten squares; 215.9 − 32 over seven.
        assert!(text.contains("300.0×210.0 mm") && text.contains("--square 26.2 at most"), "{text}");
        assert!(sheet(&board(26.2), &paper).is_ok() && sheet(&board(26.3), &paper).is_err());
        assert_eq!(parse_paper("300x200").unwrap().size, (300.0, 200.0));
        for text in ["a9", "10x10", "300", "300x-2", "NaNx300"] {
            assert!(parse_paper(text).is_err(), "{text}");
        }
    }
}
