//! Projections, alignment, exposure, seams and blending of overlapping photographs.
#![allow(dead_code)]

mod align;
mod bundle;
mod focal;
mod graph;
mod layout;
mod projection;
mod straighten;
mod verify;
mod view;
mod warp;

pub use align::{AlignError, AlignOptions, AlignedPair, Alignment, CameraMotion, Photo, Unplaced, align};
pub use layout::LayoutError;
pub use projection::Projection;
pub use verify::VerifiedPair;
pub use view::View;
pub use warp::Interpolation;
