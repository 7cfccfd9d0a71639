//! What commands with calibrated cameras share.

use crate::frame::{Context, Failure, Outcome};
use crate::words;
use cv_core::Camera;
use cv_io::{CalibrationNote, FormatError, RigFile};
use cv_pipeline::NoPairCause;
use std::path::{Path, PathBuf};

/// Reads the calibration of a camera and says what of it is not taken as it stands. `size` is for files that do not tell it.
pub(crate) fn camera(path: &Path, size: Option<(usize, usize)>, context: &Context) -> Result<Camera, Failure> {
    let (camera, notes) = camera_and_notes(path, size)?;
    notes.iter().for_each(|note| context.note(format!("{}: {note}", path.display())));
    Ok(camera)
}

/// The same, and whether its lens is known: by the file, or since the photographs are `undistorted`. Where it is not, what is to be said if it should be.
pub(crate) fn camera_and_lens(
    path: &Path,
    size: Option<(usize, usize)>,
    undistorted: bool,
    context: &Context,
) -> Result<(Camera, bool), Failure> {
    let (camera, mut notes) = camera_and_notes(path, size)?;
    let told = !notes.contains(&CalibrationNote::DistortionUnknown);
    notes.retain(|note| *note != CalibrationNote::DistortionUnknown);
    notes.iter().for_each(|note| context.note(format!("{}: {note}", path.display())));
    if !told && !undistorted {
        let note = CalibrationNote::DistortionUnknown;
        context.note(format!("{}: {note}; --undistorted where the photographs have none", path.display()));
    }
    Ok((camera, told || undistorted))
}

fn camera_and_notes(path: &Path, size: Option<(usize, usize)>) -> Result<(Camera, Vec<CalibrationNote>), Failure> {
    cv_io::read_camera_with_notes(path, size).map_err(|error| {
        let no_size = size.is_none() && matches!(error.reason, FormatError::Missing { .. });
        let failure = Failure::from(error);
        if no_size { failure.advice("give the size of the pictures, such as --size 640x480") } else { failure }
    })
}

/// Reads the calibration of a rig from its file or its two files; with `exchange`, its second camera becomes the left one. `size` is for files that do
/// not tell it.
pub(crate) fn read(
    paths: &[PathBuf],
    size: (usize, usize),
    exchange: bool,
    context: &Context,
) -> Result<RigFile, Failure> {
    if paths.len() > 2 {
        return Err(Failure::usage(format!("--rig is given {} times", paths.len()))
            .advice("one file, or OpenCV's two: --rig intrinsics.yml --rig extrinsics.yml"));
    }
    let (file, notes) = cv_io::read_rig_with_notes(paths, Some(size)).map_err(|error| {
        // What the file lacks is best told by one that has it all.
        let (content, lacks) = match error.reason {
            FormatError::Os(_) => (false, false),
            FormatError::Missing { .. } => (true, paths.len() == 1),
            _ => (true, false),
        };
        match Failure::from(error) {
            failure if lacks => failure.advice(
                "see `cv rectify --help` for what a rig file holds; of OpenCV's two files give both: --rig intrinsics.yml --rig extrinsics.yml",
            ),
            failure if content => failure.advice("see `cv rectify --help` for what a rig file holds"),
            failure => failure,
        }
    })?;
    notes.iter().for_each(|note| context.note(note));
    Ok(if exchange { RigFile { rig: file.rig.exchanged(), ..file } } else { file })
}

/// Refuses a photograph that is not of its camera's size.
pub(crate) fn check_size(rig: &Path, photo: &Path, size: (usize, usize), camera: &Camera) -> Result<(), Failure> {
    if size == (camera.width, camera.height) {
        return Ok(());
    }
    let what = format!(
        "{} is {}×{} px, its camera in {} was calibrated for {}×{} px",
        photo.display(),
        size.0,
        size.1,
        rig.display(),
        camera.width,
        camera.height
    );
    Err(Failure::new(what).advice("give photographs of the size they had for the calibration, in its order"))
}

/// The outcome, or the outcome with a failure where features lie as they cannot if the calibration is that of the photographs.
pub(crate) fn checked(outcome: Outcome, rig: &Path, fault: Option<NoPairCause>) -> Outcome {
    match fault {
        Some(cause @ (NoPairCause::VerticalDisparity { .. } | NoPairCause::Exchanged { .. })) => {
            outcome.but(words::another_rig(rig, cause))
        }
        _ => outcome,
    }
}
