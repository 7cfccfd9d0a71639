//! Overlays, color maps, plots and the self-contained HTML report.
//!
//! Results become images ([`cv_core::RgbU8`]), SVG or HTML text in memory. Encoding PNG files and writing files is left to the
//! caller.
//!
//! ```
//! use cv_core::GrayF32;
//! use cv_report::{MapStyle, Note, Plot, Report, draw_map};
//!
//! let depth = GrayF32::from_fn(64, 48, |x, _| [1.0 + x as f32 / 16.0]);
//! let figure = draw_map(depth.view(), &MapStyle::depth("m"));
//! assert!(figure.width() > 64);
//!
//! let mut report = Report::new("Depth of a ramp");
//! report.headline("valid", "100 %").section("Result").note(Note::Good, "Every pixel has a depth.");
//! report.plot(&Plot::new("Depth", "meters", "pixels").histogram("", &[1.0, 2.0, 2.5], 10), "Distribution of depths.");
//! assert!(report.to_html().starts_with("<!doctype html>"));
//! ```
//!
//! | what | where |
//! |---|---|
//! | drawing | [`Raster`], [`colors`] |
//! | scalar maps | [`colorize`], [`color_bar`], [`draw_map`], [`MapStyle::colored`], [`draw_error_map`] |
//! | features and geometry | [`draw_keypoints`], [`draw_matches`], [`draw_epipolar_lines`], [`tile_patches`] |
//! | layout | [`side_by_side`], [`shrink_to_fit`] |
//! | masks | [`overlay_mask`], [`overlay_comparison`] |
//! | points and cameras | [`PointScene`], [`render_points`] |
//! | structure-from-motion models | [`PointScene::of_model`], [`draw_view_graph`], [`Report::registered_photographs`] |
//! | pages | [`Report`], [`Figure`], [`Plot`] |
//! | sheets to print at their true size | [`PrintSheet`] |

mod base64;
mod colormap;
mod font;
mod overlay;
mod plot;
mod print_sheet;
mod raster;
mod report;
mod sparse_model;
mod viewer;

pub use colormap::{
    ColorScale, Colormap, MapStyle, absolute_difference, color_bar, colorize, draw_map, quantile_range,
};
pub use overlay::{
    MatchStyle, draw_epipolar_lines, draw_error_map, draw_keypoints, draw_matches, overlay_comparison, overlay_mask,
    shrink_to_fit, side_by_side, tile_patches,
};
pub use plot::Plot;
pub use print_sheet::PrintSheet;
pub use raster::{Color, Raster, colors};
pub use report::{Figure, Note, Report};
pub use sparse_model::draw_view_graph;
pub use viewer::{PointScene, Viewpoint, camera_color, render_points};
