//! Calibration of cameras and rigs from views of a flat target: lenses, poses, the target's own shape, and how well all of it is known.
//!
//! Takes corners, never pictures: `cv-pipeline` joins detectors and this. One camera is a rig of one.
//!
//! ```
//! use cv_calib::{CalibrateOptions, LensChoice, Sightings, TargetCorner, TargetPoints, calibrate};
//! use cv_core::{Camera, Distortion, Pose, Rotation3, Silent, Vector3};
//!
//! // Ten views of a board of 9 × 6 corners, 25 mm apart, by a camera with a barrel.
//! let target = TargetPoints::grid(9, 6, 25.0)?;
//! let distortion = Distortion::radial_tangential4([-0.2, 0.05, 0.0, 0.0]);
//! let camera = Camera { distortion, ..Camera::from_focal(640, 480, 500.0) };
//! let view = |i: u32| {
//!     let turn = Vector3::new(0.4 * f64::from(i).sin(), 0.4 * f64::from(i).cos(), 0.1);
//!     let pose = Pose::new(Rotation3::new(turn), Vector3::new(-100.0, -60.0, 320.0 + 10.0 * f64::from(i)));
//!     let corner = |point| {
//!         let pixel = camera.project(&pose.transform(&target.bent(point, [0.0; 2])))?;
//!         Some(TargetCorner { point, pixel })
//!     };
//!     vec![(0..54).filter_map(corner).collect()]
//! };
//! let data = Sightings { target: target.clone(), sizes: vec![(640, 480)], views: (0..10).map(view).collect() };
//! let options = CalibrateOptions { lens: LensChoice::RadialTangential4, ..CalibrateOptions::default() };
//! let found = calibrate(&data, &options, &Silent)?;
//! assert!((found.cameras[0].camera.fx - 500.0).abs() < 1e-3 && found.rms_px < 1e-6);
//! # Ok::<(), cv_calib::CalibrateError>(())
//! ```
//!
//! # Conventions
//!
//! * The target's frame has x right and y down on its face. A pose takes it to a camera's frame, in the target's unit.
//! * A root mean square is of the distances of corners, both coordinates together, as OpenCV prints it. Deviations are of one coordinate.
//! * The same corners and options give the same bytes at any number of threads.

mod adjustment;
mod calibrate;
mod calibration;
mod corner_residual;
mod error;
mod fit;
mod holdout;
mod lens_choice;
mod options;
mod plane_pose;
mod rig_start;
mod start;
mod target;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
mod uncertainty;
mod verdict;
mod zhang;

pub use calibrate::calibrate;
pub use calibration::{
    CalibratedCamera, CalibratedCorner, CalibratedParameter, CalibratedPicture, CalibratedView, Calibration,
    PictureOutcome, TargetShape,
};
pub use error::CalibrateError;
pub use lens_choice::{LensTrial, LensVerdict};
pub use options::{CalibrateOptions, LensChoice};
pub use target::{Sightings, TargetCorner, TargetPoints};
pub use uncertainty::{CoverageMap, UncertaintyMap};
pub use verdict::{CaptureNote, PictureSide, Trust, Verdict};
