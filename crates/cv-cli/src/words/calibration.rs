//! What the program says of calibrations: why photographs are left out, what to photograph next.

use super::Failure;
use cv_pipeline::calibration::{
    BoardError, CalibrateError, CaptureNote, ImageOutcome, ImageSide, LensTrial, LensVerdict,
};
use cv_pipeline::{BoardCalibrationError, PhotoRefusal};

/// Why a photograph is not used.
pub(crate) fn refusal(refusal: &PhotoRefusal) -> String {
    match refusal {
        PhotoRefusal::NoPhoto => "there is no photograph".to_owned(),
        PhotoRefusal::Board(BoardError::OtherSize { seen, asked }) => {
            format!("shows a board of {seen} inner corners, not {asked}")
        }
        PhotoRefusal::Board(error) => error.to_string(),
        PhotoRefusal::OtherPictureSize { seen, first } => {
            format!("is {}×{} px, the first photograph {}×{} px", seen.0, seen.1, first.0, first.1)
        }
        PhotoRefusal::Corners(outcome) => match outcome {
            ImageOutcome::Used { .. } => "used".to_owned(),
            ImageOutcome::Nothing => "shows no board".to_owned(),
            ImageOutcome::TooFewCorners { got, needed } => format!("has {got} corners, {needed} are needed"),
            ImageOutcome::Flat => "shows the board from its edge".to_owned(),
            ImageOutcome::Mirrored => "shows the board mirrored".to_owned(),
            ImageOutcome::NoPose => "no pose of the board explains its corners".to_owned(),
            ImageOutcome::Inconsistent { near, of, limit_px } => format!(
                "does not fit the others: {near} of {of} corners are within {limit_px:.2} px of where they should be"
            ),
            other => format!("{other:?}"),
        },
    }
}

/// So many photographs.
fn photographs(count: usize) -> String {
    if count == 1 { "1 photograph".to_owned() } else { format!("{count} photographs") }
}

/// Why there is no calibration.
pub(crate) fn no_calibration(error: BoardCalibrationError, names: &[impl AsRef<str>], found: &str) -> Failure {
    let name = |camera: usize| match names.get(camera) {
        Some(name) if names.len() > 1 => format!("{} camera: ", name.as_ref()),
        _ => String::new(),
    };
    match error {
        BoardCalibrationError::NoBoards { .. } => Failure::new(format!("{error}{found}")).advice(
            "sharp photographs of the whole board, and its number of inner corners (--board 9x6 for one of 10 by 7 squares), or --board auto; of other boards than chessboards their --kind, and what `cv board` printed on them",
        ),
        BoardCalibrationError::Calibrate { source, .. } => {
            let (what, advice) = match source {
                CalibrateError::TooFewViews { camera, got, needed, mirrored, .. } if mirrored > 0 => (
                    format!("{}photographs show the board mirrored ({mirrored} of them); {got} can be used, {needed} are needed", name(camera)),
                    "photographs that are not mirrored (cameras for the desk often mirror what they show)",
                ),
                CalibrateError::TooFewViews { camera, got, needed, .. } => (
                    format!("{}the board can be used on {}, {needed} are needed{found}", name(camera), photographs(got)),
                    "more photographs, ten or twenty, of the whole board at different tilts",
                ),
                CalibrateError::Degenerate { camera, largest_tilt_degrees } => (
                    if largest_tilt_degrees.is_nan() {
                        format!("{}the photographs do not determine the lens", name(camera))
                    } else {
                        format!(
                            "{}the photographs do not determine the lens: the board is tilted by {largest_tilt_degrees:.0}° at most",
                            name(camera)
                        )
                    },
                    "photographs of the board tilted by 30° to 45° to all sides, near and far",
                ),
                CalibrateError::NoStart { camera, error_px, .. } => (
                    format!(
                        "{}no lens of this kind fits the photographs: the nearest is {error_px:.1} px off",
                        name(camera)
                    ),
                    "--lens auto, and the board that is on the photographs",
                ),
                CalibrateError::Unconnected { camera } => (
                    format!("{}no pair of photographs shows the board to it and to another camera", name(camera)),
                    "photographs taken by all cameras at the same time, with the whole board on each",
                ),
                other => (other.to_string(), "see the help (--help) for the range of each option"),
            };
            Failure::new(what).advice(advice)
        }
        BoardCalibrationError::Board(error) => Failure::usage(error),
        BoardCalibrationError::Option(error) => Failure::usage(error),
        BoardCalibrationError::Cancelled(stop) => stop.into(),
    }
}

/// What was made of a lens model.
pub(crate) fn lens(trial: &LensTrial) -> String {
    match trial.verdict {
        LensVerdict::Asked => "taken, as asked".to_owned(),
        LensVerdict::Chosen => "taken".to_owned(),
        LensVerdict::LessExact => "less exact on photographs that it was not fitted to".to_owned(),
        LensVerdict::NotNeeded => "no more exact than the one taken".to_owned(),
        LensVerdict::Folds => "bends back within the picture".to_owned(),
        LensVerdict::Undetermined => "not determined by the photographs".to_owned(),
        LensVerdict::NoStart { error_px } => format!("does not fit: {error_px:.0} px off"),
    }
}

/// What is to be known of the photographs, and what to photograph next.
pub(crate) fn note(note: &CaptureNote, names: &[impl AsRef<str>]) -> String {
    let name = |camera: usize| match names.get(camera) {
        Some(name) if names.len() > 1 => format!("{} camera: ", name.as_ref()),
        _ => String::new(),
    };
    match *note {
        CaptureNote::FewViews { camera, got, wanted } => {
            format!("{}{} are few; take {wanted} or more", name(camera), photographs(got))
        }
        CaptureNote::EmptySide { camera, side, .. } => {
            let quarter = match side {
                ImageSide::Left => "left",
                ImageSide::Right => "right",
                ImageSide::Top => "upper",
                ImageSide::Bottom => "lower",
            };
            format!("{}hardly a board in the {quarter} quarter of the picture; hold it there too", name(camera))
        }
        CaptureNote::ParallelTargets { camera, spread_degrees } => format!(
            "{}all boards are nearly parallel, within {spread_degrees:.0}°; tilt the board by 30° to 45° to all sides",
            name(camera)
        ),
        CaptureNote::Uncertain { camera, pixels, x, y, .. } => format!(
            "{}around ({x:.0}, {y:.0}) the projection is uncertain by {pixels:.1} px; photograph the board there",
            name(camera)
        ),
        CaptureNote::HoldOut { camera, rms_px, holdout_rms_px } => format!(
            "{}photographs that had no part in the fit are {holdout_rms_px:.2} px off, those that had {rms_px:.2} px; take more of them, with a stiff board",
            name(camera)
        ),
        CaptureNote::LeftOut { camera, pictures, of } => {
            format!("{}{pictures} of {of} photographs with a board are left out", name(camera))
        }
        CaptureNote::FewShared { camera, got, wanted } => {
            format!(
                "{}{got} views show the board to it and to another camera, which is few; take {wanted} or more",
                name(camera)
            )
        }
        CaptureNote::BentTarget { share } => {
            format!("the board is bent by {:.1} % of its longer side, which is allowed for", 100.0 * share)
        }
        ref other => format!("{other:?}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn notes_say_what_to_photograph_and_by_which_camera() {
        let side = CaptureNote::EmptySide { camera: 1, side: ImageSide::Right, covered: 0.1 };
        assert!(note(&side, &["left", "right"]).starts_with("right camera: hardly a board in the right quarter"));
        assert!(note(&side, &["camera"]).starts_with("hardly a board"));
        let few = CalibrateError::TooFewViews { camera: 0, got: 1, needed: 3, small: 0, mirrored: 0 };
        let error = BoardCalibrationError::Calibrate { source: few, refusals: Vec::new() };
        let text = no_calibration(error, &["camera"], "").text();
        assert!(text.contains("on 1 photograph, 3 are needed") && text.contains("different tilts"), "{text}");
    }
}
