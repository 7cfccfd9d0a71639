//! The light that photographs recorded: what their levels mean, how their exposures differ, and the levels of the panorama.

mod exposure;
mod radiance;
mod response;
mod tone;

pub use exposure::{Exposure, Gains};
pub(crate) use exposure::{UNREADABLE, estimate_gains};
pub(crate) use radiance::{fill_clipped, light_of, relative_to};
pub(crate) use response::Response;
pub(crate) use tone::{ExposureCorrection, Tone};
