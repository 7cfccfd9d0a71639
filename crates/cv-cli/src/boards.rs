//! The options that describe a calibration board, shared by `cv board` and `cv calibrate`.

use crate::frame::{Failure, named};
use cv_pipeline::BoardChoice;
use cv_pipeline::calibration::{Board, BoardKind, BoardSize, CharucoBoard, Dictionary, GridStyle, MarkerGrid};

/// The options of a calibration board.
#[derive(Debug, clap::Args)]
pub(crate) struct BoardArgs {
    /// Kind of board.
    #[arg(long, value_parser = named::<BoardKind>(), default_value_t = BoardKind::Chessboard)]
    kind: BoardKind,
    /// Columns by rows: the inner corners of a chessboard (9x6 for 10 by 7 squares), the squares of a ChArUco board, the markers of a grid. `auto`: the chessboard size found on
    /// most photographs.
    #[arg(long, value_name = "CxR|auto", default_value = "auto", value_parser = parse_counts)]
    board: Counts,
    /// Side of a square of a chessboard or ChArUco board.
    #[arg(long, value_name = "LENGTH")]
    square: Option<f64>,
    /// Side of a marker including its black border, for ChArUco boards and grids.
    #[arg(long, value_name = "LENGTH")]
    marker: Option<f64>,
    /// Marker dictionary of a ChArUco board or an ArUco grid; its markers are used from the first on [default: 5x5_100]. An AprilGrid has 36h11.
    #[arg(long, value_name = "NAME", value_parser = named::<Dictionary>())]
    dictionary: Option<Dictionary>,
    /// Gap between the markers of a grid, as a fraction of their side [default: 0.3].
    #[arg(long, value_name = "RATIO")]
    spacing: Option<f64>,
}

/// Columns and rows; `None`: to be detected.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Counts(Option<(usize, usize)>);

fn parse_counts(text: &str) -> Result<Counts, String> {
    if text == "auto" {
        return Ok(Counts(None));
    }
    let sides = text.split_once(['x', '×']).and_then(|(c, r)| Some((c.parse().ok()?, r.parse().ok()?)));
    let valid = sides.filter(|(c, r)| [c, r].iter().all(|n| (1..=BoardSize::MAX_SIDE).contains(n)));
    valid
        .map(|sides| Counts(Some(sides)))
        .ok_or_else(|| format!("give columns and rows as 9x6, up to {} on a side, or auto", BoardSize::MAX_SIDE))
}

impl BoardArgs {
    /// Whether a length is given, so that distances have a unit.
    pub(crate) fn has_lengths(&self) -> bool {
        self.square.is_some() || self.marker.is_some()
    }

    /// Returns the board, which must be fully specified (for printing).
    pub(crate) fn known(&self) -> Result<Board, Failure> {
        match self.choice()? {
            BoardChoice::Known(board) if self.has_lengths() => Ok(board),
            BoardChoice::Known(_) => Err(Failure::usage("the side of a square is not given").advice("--square 25")),
            BoardChoice::AnyChessboard { .. } => {
                Err(Failure::usage("the size of the board is not given").advice("--board 9x6"))
            }
        }
    }

    /// Returns the board to detect.
    pub(crate) fn choice(&self) -> Result<BoardChoice, Failure> {
        let unused = |given: bool, option: &str| {
            if given { Err(Failure::usage(format!("a {} takes no {option}", self.kind))) } else { Ok(()) }
        };
        let needed = |length: Option<f64>, option: &str| {
            length
                .ok_or_else(|| Failure::usage(format!("a {} needs {option}", self.kind)).advice(format!("{option} 25")))
        };
        let counts = || {
            self.board.0.ok_or_else(|| {
                Failure::usage(format!("a {} needs --board, its columns and rows", self.kind)).advice("--board 8x6")
            })
        };
        let board = match self.kind {
            BoardKind::Chessboard => {
                unused(self.marker.is_some(), "--marker")?;
                unused(self.dictionary.is_some(), "--dictionary")?;
                unused(self.spacing.is_some(), "--spacing")?;
                let square = self.square.unwrap_or(1.0);
                let Some((columns, rows)) = self.board.0 else { return Ok(BoardChoice::AnyChessboard { square }) };
                Board::Chessboard { size: BoardSize::new(columns, rows), square }
            }
            BoardKind::Charuco => {
                unused(self.spacing.is_some(), "--spacing")?;
                Board::Charuco(CharucoBoard {
                    squares: counts()?,
                    square: needed(self.square, "--square")?,
                    marker: needed(self.marker, "--marker")?,
                    dictionary: self.dictionary.unwrap_or(DEFAULT_DICTIONARY),
                })
            }
            BoardKind::ArucoGrid | BoardKind::Aprilgrid => {
                unused(self.square.is_some(), "--square")?;
                let april = self.kind == BoardKind::Aprilgrid;
                let other = self.dictionary.is_some_and(|d| d != Dictionary::AprilTag36h11);
                unused(april && other, "--dictionary but 36h11")?;
                let (style, dictionary) = if april {
                    (GridStyle::AprilGrid, Dictionary::AprilTag36h11)
                } else {
                    (GridStyle::Aruco, self.dictionary.unwrap_or(DEFAULT_DICTIONARY))
                };
                let (markers, marker) = (counts()?, needed(self.marker, "--marker")?);
                Board::MarkerGrid(MarkerGrid {
                    markers,
                    marker,
                    spacing: self.spacing.unwrap_or(DEFAULT_SPACING),
                    dictionary,
                    style,
                })
            }
        };
        board.check().map_err(Failure::usage)?;
        Ok(BoardChoice::Known(board))
    }
}

/// Markers of 5×5 cells are detected from farther away than those of 6×6, and give fewer false detections than those of 4×4.
const DEFAULT_DICTIONARY: Dictionary = Dictionary::Aruco5x5x100;
/// Gap between markers over their side: the `tagSpacing` of Kalibr's boards.
const DEFAULT_SPACING: f64 = 0.3;

/// Formats the options that specify a board.
pub(crate) fn board_options(board: &Board) -> String {
    let (columns, rows) = board.counts();
    let kind = match board.kind() {
        BoardKind::Chessboard => String::new(),
        kind => format!("--kind {kind} "),
    };
    let lengths = match board {
        Board::Chessboard { square, .. } => format!("--square {square}"),
        Board::Charuco(b) => format!("--square {} --marker {} --dictionary {}", b.square, b.marker, b.dictionary),
        Board::MarkerGrid(g) if g.style == GridStyle::AprilGrid => {
            format!("--marker {} --spacing {}", g.marker, g.spacing)
        }
        Board::MarkerGrid(g) => format!("--marker {} --spacing {} --dictionary {}", g.marker, g.spacing, g.dictionary),
    };
    format!("{kind}--board {columns}x{rows} {lengths}")
}

/// Describes a board for people, with lengths in `unit`.
pub(crate) fn describe_board(board: &Board, unit: &str) -> String {
    let (columns, rows) = board.counts();
    match board {
        Board::Chessboard { square, .. } => {
            format!("chessboard of {columns}x{rows} inner corners, squares of {square} {unit}")
        }
        Board::Charuco(b) => format!(
            "ChArUco board of {columns}x{rows} squares of {} {unit}, markers of {} {unit} from {}",
            b.square, b.marker, b.dictionary
        ),
        Board::MarkerGrid(g) => {
            let what = if g.style == GridStyle::AprilGrid { "AprilGrid" } else { "ArUco grid" };
            format!(
                "{what} of {columns}x{rows} markers of {} {unit} from {}, spacing {}",
                g.marker, g.dictionary, g.spacing
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        board: BoardArgs,
    }

    fn parsed(text: &str) -> Result<BoardChoice, Failure> {
        let args = Line::try_parse_from(std::iter::once("cv").chain(text.split_whitespace()));
        args.map_err(|e| Failure::usage(e.to_string().trim_end()))?.board.choice()
    }

    #[test]
    fn board_options_round_trip() {
        for text in [
            "--board 9x6 --square 25",
            "--kind charuco --board 8x6 --square 30 --marker 22.5 --dictionary 4x4_50",
            "--kind aruco-grid --board 5x7 --marker 30 --spacing 0.2 --dictionary 6x6_250",
            "--kind aprilgrid --board 6x6 --marker 24 --spacing 0.3",
        ] {
            let Ok(BoardChoice::Known(board)) = parsed(text) else { panic!("{text}") };
            assert_eq!(board_options(&board), text);
        }
        assert!(matches!(parsed(""), Ok(BoardChoice::AnyChessboard { square: 1.0 })));
    }

    #[test]
    fn incompatible_options_are_refused() {
        for text in [
            "--board 9",
            "--board 2x2",
            "--board 9x6x2",
            "--board 999x6",
            "--board 9x6 --marker 3",
            "--kind charuco --board 8x6 --square 30",
            "--kind charuco --board 8x6 --square 30 --marker 30",
            "--kind aruco-grid --marker 30",
            "--kind aprilgrid --board 6x6 --marker 24 --dictionary 4x4_50",
            "--kind aruco-grid --board 20x20 --marker 5 --dictionary 4x4_50",
        ] {
            assert!(parsed(text).is_err(), "{text}");
        }
    }
}
