//! What commands with a calibrated rig share.

use crate::frame::{Failure, Outcome};
use crate::words;
use cv_core::Camera;
use cv_io::{FormatError, RigFile};
use cv_pipeline::NoPairCause;
use std::path::Path;

/// Reads a calibration; with `exchange`, its second camera becomes the left one. `size` is for files that do not tell it.
pub(crate) fn read(path: &Path, size: (usize, usize), exchange: bool) -> Result<RigFile, Failure> {
    let file = cv_io::read_rig(path, Some(size)).map_err(|error| {
        // What the file lacks is best told by one that has it all.
        let content = !matches!(error.reason, FormatError::Os(_));
        let failure = Failure::from(error);
        if content { failure.advice("see `cv rectify --help` for what a rig file holds") } else { failure }
    })?;
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
        Some(cause @ (NoPairCause::Rows { .. } | NoPairCause::Exchanged { .. })) => {
            outcome.but(words::another_rig(rig, cause))
        }
        _ => outcome,
    }
}
