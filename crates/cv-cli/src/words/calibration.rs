//! Messages about calibrations: why photographs are not used, what to photograph next.

use super::Failure;
use cv_pipeline::calibration::{
    BoardError, CalibrateError, CaptureNote, ImageOutcome, ImageSide, LensTrial, LensVerdict,
};
use cv_pipeline::{BoardCalibrationError, PhotoRefusal};

/// Words why a photograph is not used.
pub(crate) fn refusal(refusal: &PhotoRefusal) -> String {
    match refusal {
        PhotoRefusal::NoPhoto => "there is no photograph".to_owned(),
        PhotoRefusal::Board(BoardError::OtherSize { seen, asked }) => {
            format!("shows a board of {seen} inner corners, not {asked}")
        }
        PhotoRefusal::Board(error) => error.to_string(),
        PhotoRefusal::OtherPictureSize { seen, first } => {
            format!("is {}×{} px, the first photograph is {}×{} px", seen.0, seen.1, first.0, first.1)
        }
        PhotoRefusal::Corners(outcome) => match outcome {
            ImageOutcome::Used { .. } => "used".to_owned(),
            ImageOutcome::Nothing => "shows no board".to_owned(),
            ImageOutcome::TooFewCorners { got, needed } => format!("has {got} corners, {needed} are needed"),
            ImageOutcome::Flat => "shows the board edge-on".to_owned(),
            ImageOutcome::Mirrored => "shows the board mirrored".to_owned(),
            ImageOutcome::NoPose => "no pose of the board explains its corners".to_owned(),
            ImageOutcome::Inconsistent { near, of, limit_px } => {
                format!("does not fit the others: {near} of {of} corners have a residual below {limit_px:.2} px")
            }
            other => format!("{other:?}"),
        },
    }
}

/// Formats a number of photographs.
fn photographs(count: usize) -> String {
    if count == 1 { "1 photograph".to_owned() } else { format!("{count} photographs") }
}

/// Words a failed calibration.
pub(crate) fn no_calibration(error: BoardCalibrationError, names: &[impl AsRef<str>], found: &str) -> Failure {
    let name = |camera: usize| match names.get(camera) {
        Some(name) if names.len() > 1 => format!("{} camera: ", name.as_ref()),
        _ => String::new(),
    };
    match error {
        BoardCalibrationError::NoBoards { .. } => Failure::new(format!("{error}{found}")).advice(
            "sharp photographs of the whole board, and its number of inner corners (--board 9x6 for 10 by 7 squares), or --board auto; for other boards than chessboards the --kind and the options printed by `cv board`",
        ),
        BoardCalibrationError::Calibrate { source, .. } => {
            let (what, advice) = match source {
                CalibrateError::TooFewViews { camera, got, needed, mirrored, .. } if mirrored > 0 => (
                    format!("{}photographs show the board mirrored ({mirrored} of them); {got} can be used, {needed} are needed", name(camera)),
                    "photographs that are not mirrored (webcams often mirror the image)",
                ),
                CalibrateError::TooFewViews { camera, got, needed, .. } => (
                    format!("{}the board can be used on {}, {needed} are needed{found}", name(camera), photographs(got)),
                    "ten to twenty photographs of the whole board at different tilts",
                ),
                CalibrateError::Degenerate { camera, largest_tilt_degrees } => (
                    if largest_tilt_degrees.is_nan() {
                        format!("{}the photographs do not determine the intrinsics", name(camera))
                    } else {
                        format!(
                            "{}the photographs do not determine the intrinsics: the largest tilt of the board is {largest_tilt_degrees:.0}°",
                            name(camera)
                        )
                    },
                    "photographs of the board tilted by 30° to 45° to all sides, near and far",
                ),
                CalibrateError::NoStart { camera, error_px, .. } => (
                    format!(
                        "{}this distortion model does not fit the photographs: initial residual {error_px:.1} px",
                        name(camera)
                    ),
                    "--lens auto, and the options of the board in the photographs",
                ),
                CalibrateError::Unconnected { camera } => (
                    format!("{}no simultaneous photographs show the board to it and to another camera", name(camera)),
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

/// Words the verdict on a distortion model.
pub(crate) fn lens(trial: &LensTrial) -> String {
    match trial.verdict {
        LensVerdict::Asked => "taken, as asked".to_owned(),
        LensVerdict::Chosen => "taken".to_owned(),
        LensVerdict::LessExact => "larger error on held-out photographs".to_owned(),
        LensVerdict::NotNeeded => "not significantly better than the one taken".to_owned(),
        LensVerdict::Folds => "not monotonic within the image".to_owned(),
        LensVerdict::Undetermined => "not determined by the photographs".to_owned(),
        LensVerdict::NoStart { error_px } => format!("does not fit: initial residual {error_px:.0} px"),
    }
}

/// Words an assessment of the photographs, with what to photograph next.
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
            format!(
                "{}hardly any corners in the {quarter} quarter of the image; place the board there too",
                name(camera)
            )
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
            "{}the RMS error on held-out photographs is {holdout_rms_px:.2} px, on the fitted ones {rms_px:.2} px; take more photographs, with a rigid board",
            name(camera)
        ),
        CaptureNote::LeftOut { camera, images, of } => {
            format!("{}{images} of {of} photographs with a board are left out", name(camera))
        }
        CaptureNote::FewShared { camera, got, wanted } => {
            format!(
                "{}only {got} views show the board to it and to another camera; take {wanted} or more",
                name(camera)
            )
        }
        CaptureNote::BentTarget { share } => {
            format!("the board is bent by {:.1} % of its longer side, which the model includes", 100.0 * share)
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
        assert!(note(&side, &["left", "right"]).starts_with("right camera: hardly any corners in the right quarter"));
        assert!(note(&side, &["camera"]).starts_with("hardly any corners"));
        let few = CalibrateError::TooFewViews { camera: 0, got: 1, needed: 3, small: 0, mirrored: 0 };
        let error = BoardCalibrationError::Calibrate { source: few, refusals: Vec::new() };
        let text = no_calibration(error, &["camera"], "").text();
        assert!(text.contains("on 1 photograph, 3 are needed") && text.contains("different tilts"), "{text}");
    }
}
