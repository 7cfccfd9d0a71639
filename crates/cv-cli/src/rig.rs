//! Reading of calibrations, shared by the commands with calibrated cameras.

use crate::frame::{Context, Failure, Outcome};
use crate::words;
use cv_core::Camera;
use cv_io::{CalibrationNote, FormatError, RigFile};
use cv_pipeline::NoPairCause;
use std::path::{Path, PathBuf};

/// Reads the calibration of a camera and reports approximations made on reading. `size` is for files without the image size.
pub(crate) fn camera(path: &Path, size: Option<(usize, usize)>, context: &Context) -> Result<Camera, Failure> {
    let (camera, notes) = camera_and_notes(path, size)?;
    notes.iter().for_each(|note| context.note(format!("{}: {note}", path.display())));
    Ok(camera)
}

/// As [`camera`], and whether its distortion is known: from the file, or because the photographs are `undistorted`. If not, a note names the remedy.
pub(crate) fn camera_and_lens(
    path: &Path,
    size: Option<(usize, usize)>,
    undistorted: bool,
    context: &Context,
) -> Result<(Camera, bool), Failure> {
    let (camera, mut notes) = camera_and_notes(path, size)?;
    let is_stated = !notes.contains(&CalibrationNote::DistortionUnknown);
    notes.retain(|note| *note != CalibrationNote::DistortionUnknown);
    notes.iter().for_each(|note| context.note(format!("{}: {note}", path.display())));
    if !is_stated && !undistorted {
        let note = CalibrationNote::DistortionUnknown;
        context.note(format!("{}: {note}; give --undistorted if the photographs have none", path.display()));
    }
    Ok((camera, is_stated || undistorted))
}

fn camera_and_notes(path: &Path, size: Option<(usize, usize)>) -> Result<(Camera, Vec<CalibrationNote>), Failure> {
    cv_io::read_camera_with_notes(path, size).map_err(|error| {
        let no_size = size.is_none() && matches!(error.reason, FormatError::Missing { .. });
        let failure = Failure::from(error);
        if no_size { failure.advice("give the size of the images, such as --size 640x480") } else { failure }
    })
}

/// Reads the calibration of a rig from one or two files; with `exchange`, its second camera becomes the left one. `size` is for files without the image
/// size.
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
        // The help of `cv rectify` has a complete example.
        let (is_content, is_incomplete) = match error.reason {
            FormatError::Os(_) => (false, false),
            FormatError::Missing { .. } => (true, paths.len() == 1),
            _ => (true, false),
        };
        match Failure::from(error) {
            failure if is_incomplete => failure.advice(
                "see `cv rectify --help` for the contents of a rig file; give both of OpenCV's two files: --rig intrinsics.yml --rig extrinsics.yml",
            ),
            failure if is_content => failure.advice("see `cv rectify --help` for the contents of a rig file"),
            failure => failure,
        }
    })?;
    notes.iter().for_each(|note| context.note(note));
    Ok(if exchange { RigFile { rig: file.rig.exchanged(), ..file } } else { file })
}

/// Refuses a photograph whose size is not that of its camera.
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
    Err(Failure::new(what).advice("give photographs of the calibrated size, in the order of the calibration"))
}

/// Marks an outcome as failed if feature matches contradict the calibration.
pub(crate) fn checked(outcome: Outcome, rig: &Path, fault: Option<NoPairCause>) -> Outcome {
    match fault {
        Some(cause @ (NoPairCause::VerticalDisparity { .. } | NoPairCause::Exchanged { .. })) => {
            outcome.with_failure(words::contradicting_rig(rig, cause))
        }
        _ => outcome,
    }
}
