//! Projections, alignment, exposure, seams and blending of overlapping photographs.
#![allow(dead_code)]

mod bundle;
mod focal;
mod graph;
mod projection;
mod straighten;
mod view;

pub use projection::Projection;
pub use view::View;
