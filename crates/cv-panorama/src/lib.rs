//! Projections, alignment, exposure, seams and blending of overlapping photographs.
#![allow(dead_code)]

mod align;
mod bundle;
mod crop;
mod exposure;
mod feather;
mod focal;
mod graph;
mod layout;
mod maxflow;
mod multiband;
mod poisson;
mod preview;
mod projection;
mod render;
mod seams;
mod straighten;
mod verify;
mod view;
mod warp;

pub use align::{AlignError, AlignOptions, AlignedPair, Alignment, CameraMotion, Photo, Unplaced, align};
pub use exposure::{Exposure, Gains};
pub use layout::LayoutError;
pub use projection::Projection;
pub use render::{Blend, Panorama, RenderError, RenderOptions, render};
pub use seams::Seams;
pub use verify::{NotAPair, VerifiedPair, VerifyOptions, verify_pair};
pub use view::View;
pub use warp::Interpolation;
