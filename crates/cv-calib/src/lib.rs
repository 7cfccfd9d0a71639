//! Calibration of cameras and rigs from views of a planar target: intrinsics, poses, the target's shape, and their
//! uncertainties.
//!
//! The input is corners, never images: `cv-pipeline` joins corner detection and this crate. A single camera is a rig of
//! one.
//!
//! ```
//! use cv_calib::{CalibrateOptions, LensChoice, TargetObservations, TargetCorner, TargetPoints, calibrate};
//! use cv_core::{Camera, Distortion, Pose, Rotation3, Silent, Vector3};
//!
//! // Ten views of a board with 9 × 6 corners, 25 mm apart, by a camera with barrel distortion.
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
//! let data = TargetObservations { target: target.clone(), sizes: vec![(640, 480)], views: (0..10).map(view).collect() };
//! let options = CalibrateOptions { lens: LensChoice::RadialTangential4, ..CalibrateOptions::default() };
//! let calibration = calibrate(&data, &options, &Silent)?;
//! assert!((calibration.cameras[0].camera.fx - 500.0).abs() < 1e-3 && calibration.rms_px < 1e-6);
//! # Ok::<(), cv_calib::CalibrateError>(())
//! ```
//!
//! # Conventions
//!
//! * Target frame: x right and y down on its face. A target pose maps it to a camera's frame, in the target's unit.
//! * A root mean square error is of distances (both coordinates), as in OpenCV. Standard deviations are of one
//!   coordinate.
//! * The same corners and options give the same bytes with any number of threads.

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
mod uncertainty;
mod verdict;
mod zhang;

pub use calibrate::calibrate;
pub use calibration::{
    CalibratedCamera, CalibratedCorner, CalibratedImage, CalibratedParameter, CalibratedView, Calibration,
    ImageOutcome, TargetShape,
};
pub use error::CalibrateError;
pub use lens_choice::{LensTrial, LensVerdict};
pub use options::{CalibrateOptions, LensChoice};
pub use target::{TargetCorner, TargetObservations, TargetPoints};
pub use uncertainty::{CoverageMap, UncertaintyMap};
pub use verdict::{CaptureNote, ImageSide, Trust, Verdict};
