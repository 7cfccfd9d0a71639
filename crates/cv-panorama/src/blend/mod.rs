//! From photographs drawn on the canvas to one picture: evening out their brightness and joining them at the seams.

mod exposure;
mod feather;
mod multiband;
mod poisson;

pub(crate) use exposure::estimate;
pub use exposure::{Exposure, Gains};
pub(crate) use feather::{blend as feather, copy};
pub(crate) use multiband::Blender;
pub(crate) use poisson::blend as poisson;
