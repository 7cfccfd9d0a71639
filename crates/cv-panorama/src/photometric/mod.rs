//! Photometric calibration: camera response, exposure and white balance, vignetting, and tone mapping of the panorama.

mod adaptation;
mod exposure;
mod radiance;
mod response;
mod tone;

pub(crate) use adaptation::{Adaptation, mean_stops, well_exposed};
pub use exposure::{Exposure, Gains};
pub(crate) use exposure::{SATURATED_LEVEL, estimate_gains};
pub(crate) use radiance::{decode_radiance, fill_saturated, relative_gains};
pub(crate) use response::Response;
pub(crate) use tone::{ExposureCorrection, Tone};
