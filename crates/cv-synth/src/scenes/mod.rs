//! Preset scenes, each with a layout by its seed.

mod furniture;
mod person;
mod room;
mod small;
mod street;
mod wall;

pub(crate) use person::{path, walker};
pub(crate) use wall::Wall;
