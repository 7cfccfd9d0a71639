//! The report of `cv depth`.

use crate::frame::Failure;
use cv_core::{ImageView, RgbU8};
use cv_pipeline::stereo::PixelState;
use cv_pipeline::{DepthResult, RigDepthResult};
use cv_report::{Figure, MapStyle, Note, Plot, PointScene, Report, Viewpoint, draw_map, render_points};
use std::path::PathBuf;

/// Where each disparity comes from, over the darkened photograph.
fn draw_states(left: ImageView<'_, u8, 3>, states: ImageView<'_, PixelState, 1>) -> RgbU8 {
    RgbU8::from_fn(states.width(), states.height(), |x, y| {
        let pixel = left.at(x, y);
        let tint = match states.at(x, y)[0] {
            PixelState::Matched => return pixel,
            PixelState::Occluded => [60u8, 110, 255],
            PixelState::Mismatched => [255, 150, 40],
            PixelState::OutOfView => [200, 60, 220],
        };
        std::array::from_fn(|c| ((u16::from(pixel[c]) + 3 * u16::from(tint[c])) / 4) as u8)
    })
}

/// The page of a pair; with `frames`, their names and the shares of pixels that were matched and that have a disparity, of the first of them.
pub(super) fn report(job: &RigDepthResult, frames: &[(PathBuf, f64, f64)]) -> Result<String, Failure> {
    let RigDepthResult { images: [left, right], maps, cloud } = job;
    let DepthResult { map, depth, stages, .. } = maps;
    let png = |image: &RgbU8| cv_io::encode_png(image.view());
    let mut page = Report::new("Depth");
    let (width, height) = map.disparity.size();
    page.headline("size", &format!("{width}×{height}"))
        .headline("matched and confirmed", &format!("{:.1} %", 100.0 * map.matched_fraction()))
        .headline("with a disparity", &format!("{:.1} %", 100.0 * map.valid_fraction()));
    if maps.is_mostly_filled() {
        page.note(
            Note::Warning,
            "Most of this map is not matched but filled in from around; of such pixels about four in ten are wrong.",
        );
    }
    if !frames.is_empty() {
        let rows: Vec<Vec<String>> = frames
            .iter()
            .map(|(path, matched, valid)| {
                let percent = |share: f64| format!("{:.1} %", 100.0 * share);
                vec![path.display().to_string(), percent(*matched), percent(*valid)]
            })
            .collect();
        page.headline("frames", &frames.len().to_string());
        page.section("Frames").table(
            "What follows is the first frame.",
            &["frame", "matched and confirmed", "with a disparity"],
            &rows,
        );
    }
    page.section("Photographs")
        .figures(vec![Figure::new(png(left)?, "Left photograph."), Figure::new(png(right)?, "Right photograph.")]);
    page.section("Disparity").figures(vec![
        Figure::new(
            png(&draw_map(map.disparity.view(), &MapStyle::disparity()))?,
            "Disparity: near (large) blue, far (small) red, unknown gray.",
        ),
        Figure::new(
            png(&draw_states(left.view(), map.state.view()))?,
            "Filled pixels: blue hidden from the right camera, orange mismatched, violet outside the right photograph.",
        ),
    ]);
    let pixels = map.disparity.as_slice().iter().zip(map.state.as_slice());
    let matched = pixels.filter(|(_, state)| **state == PixelState::Matched);
    page.section("Fractions").plot(
        &fractions(matched.map(|(&d, _)| d)),
        "How often matched disparities have each fraction. Whole pixels that stand out (pixel locking) betray a poor fit \
         between pixels, unless the scene is of few planes that face the cameras.",
    );
    if let Some(depth) = depth {
        page.section("Depth").figure(Figure::new(
            png(&draw_map(depth.view(), &MapStyle::depth("")))?,
            "Depth in the unit of the baseline: near blue, far red, unknown gray.",
        ));
        let scene = PointScene::new(cloud);
        let still = png(&render_points(&scene, Viewpoint::Camera, 960, 640))?;
        page.section("Cloud").points(&scene, Some(still), "The depth map in space.");
    } else {
        page.note(Note::Info, "No depth: the focal length and the baseline were not given.");
    }
    page.section("Time")
        .facts(&stages.iter().map(|(stage, seconds)| (*stage, format!("{:.1} ms", 1e3 * seconds))).collect::<Vec<_>>());
    Ok(page.to_html())
}

/// How the fractions of disparities are spread.
pub(crate) fn fractions(disparities: impl Iterator<Item = f32>) -> Plot {
    let values: Vec<f64> = disparities.filter(|d| d.is_finite()).map(|d| f64::from(d) - f64::from(d).floor()).collect();
    Plot::new("Fractions of disparities", "fraction of a pixel", "pixels").histogram_within("", &values, 20, (0.0, 1.0))
}
