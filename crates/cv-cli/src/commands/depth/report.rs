//! The report of `cv depth`.

use crate::frame::Failure;
use crate::pictures::{Width, interactive_cloud, map as colored, picture};
use cv_core::{Camera, ImageView, Point3, PointCloud, Pose, RgbU8, Rotation3, Vector3};
use cv_pipeline::stereo::{PixelState, StereoGeometry};
use cv_pipeline::{DepthResult, RigDepthResult};
use cv_report::{MapStyle, Note, Plot, PointScene, Report, camera_color};
use std::path::PathBuf;

/// Colors the pixels of the darkened image by state: occluded, mismatched, out of view.
fn draw_states(left: ImageView<'_, u8, 3>, states: ImageView<'_, PixelState, 1>) -> RgbU8 {
    RgbU8::from_fn(states.width(), states.height(), |x, y| {
        let pixel = left.at(x, y);
        let tint = match states.at(x, y)[0] {
            PixelState::Matched | PixelState::NoData => return pixel,
            PixelState::Occluded => [60u8, 110, 255],
            PixelState::Mismatched => [255, 150, 40],
            PixelState::OutOfView => [200, 60, 220],
        };
        std::array::from_fn(|c| ((u16::from(pixel[c]) + 3 * u16::from(tint[c])) / 4) as u8)
    })
}

/// Builds the page of a pair; of a sequence, the page of its first pair and the matched and valid fractions of all `frames`.
pub(super) fn report(job: &RigDepthResult, frames: &[(PathBuf, f64, f64)]) -> Result<Report, Failure> {
    let RigDepthResult { images: [left, right], maps, cloud } = job;
    let DepthResult { map, depth, geometry, stages, .. } = maps;
    let mut page = Report::new("Depth");
    let (width, height) = map.disparity.size();
    page.headline("size", &format!("{width}×{height}"))
        .headline("matched and confirmed", &format!("{:.1} %", 100.0 * map.matched_fraction()))
        .headline("with a disparity", &format!("{:.1} %", 100.0 * map.valid_fraction()));
    if !frames.is_empty() {
        let rows: Vec<Vec<String>> = frames
            .iter()
            .map(|(path, matched, valid)| {
                let percent = |fraction: f64| format!("{:.1} %", 100.0 * fraction);
                vec![path.display().to_string(), percent(*matched), percent(*valid)]
            })
            .collect();
        page.headline("frames", &frames.len().to_string());
        page.section("Frames").table(
            "The sections below show the first frame.",
            &["frame", "matched and confirmed", "with a disparity"],
            &rows,
        );
    }
    page.section("Photographs").figures(vec![
        picture(left, Width::Half, "Left photograph.")?,
        picture(right, Width::Half, "Right photograph.")?,
    ]);
    page.section("Disparity").figures(vec![
        colored(
            map.disparity.view(),
            &MapStyle::disparity(),
            Width::Half,
            "Disparity: near (large) blue, far (small) red, invalid gray.",
        )?,
        picture(
            &draw_states(left.view(), map.state.view()),
            Width::Half,
            "Filled pixels: blue occluded in the right image, orange mismatched, violet outside the right image.",
        )?,
    ]);
    let pixels = map.disparity.as_slice().iter().zip(map.state.as_slice());
    let matched = pixels.filter(|(_, state)| **state == PixelState::Matched);
    let fractions = fractions(matched.map(|(&d, _)| d));
    page.folded("Subpixel distribution", |page| {
        page.plot(
            &fractions,
            "Distribution of the fractional part of matched disparities. Peaks at whole pixels (pixel locking) indicate a biased subpixel \
             interpolation, unless the scene has few fronto-parallel planes.",
        );
    });
    if let (Some(depth), Some(geometry)) = (depth, geometry) {
        page.section("Depth").figure(colored(
            depth.view(),
            &MapStyle::depth(""),
            Width::Full,
            "Depth in the unit of the baseline: near blue, far red, invalid gray.",
        )?);
        page.section("Cloud");
        interactive_cloud(
            &mut page,
            &scene(cloud, geometry, (width, height)),
            "The depth map as a point cloud, and the two cameras.",
        )?;
    } else {
        page.note(Note::Info, "No depth: focal length and baseline are unknown.");
    }
    page.section("Time").times(stages);
    Ok(page)
}

/// Builds the scene of a depth map's cloud with both cameras and the projections of its points in the images of `width × height` pixels.
pub(crate) fn scene(cloud: &PointCloud, geometry: &StereoGeometry, (width, height): (usize, usize)) -> PointScene {
    let mut scene = PointScene::new(cloud);
    let focal = geometry.focal;
    let eyes = [("left", 0.0, 0.0), ("right", geometry.offset, -geometry.baseline)];
    for (i, (name, offset, shift)) in eyes.into_iter().enumerate() {
        let camera = Camera::pinhole(width, height, focal, focal, geometry.cx + offset, geometry.cy);
        let pose = Pose::new(Rotation3::identity(), Vector3::new(shift, 0.0, 0.0));
        scene.add_camera(&camera, &pose, camera_color(i)).add_observations(name, (width, height), |i| {
            camera.project(&pose.transform(&Point3::from(cloud.positions[i].map(f64::from))))
        });
    }
    scene
}

/// Plots the distribution of the fractional parts of disparities.
pub(crate) fn fractions(disparities: impl Iterator<Item = f32>) -> Plot {
    let values: Vec<f64> = disparities.filter(|d| d.is_finite()).map(|d| f64::from(d) - f64::from(d).floor()).collect();
    Plot::new("Fractional parts of disparities", "fraction of a pixel", "pixels").histogram_within(
        "",
        &values,
        20,
        (0.0, 1.0),
    )
}
