//! The report of `cv depth`.

use crate::frame::Failure;
use crate::pictures::{Width, map as colored, picture, turning};
use cv_core::{Camera, ImageView, Point3, PointCloud, Pose, RgbU8, Rotation3, Vector3};
use cv_pipeline::stereo::{PixelState, StereoGeometry};
use cv_pipeline::{DepthResult, RigDepthResult};
use cv_report::{MapStyle, Note, Plot, PointScene, Report, camera_color};
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
    page.section("Photographs").figures(vec![
        picture(left, Width::Half, "Left photograph.")?,
        picture(right, Width::Half, "Right photograph.")?,
    ]);
    page.section("Disparity").figures(vec![
        colored(
            map.disparity.view(),
            &MapStyle::disparity(),
            Width::Half,
            "Disparity: near (large) blue, far (small) red, unknown gray.",
        )?,
        picture(
            &draw_states(left.view(), map.state.view()),
            Width::Half,
            "Filled pixels: blue hidden from the right camera, orange mismatched, violet outside the right photograph.",
        )?,
    ]);
    let pixels = map.disparity.as_slice().iter().zip(map.state.as_slice());
    let matched = pixels.filter(|(_, state)| **state == PixelState::Matched);
    let fractions = fractions(matched.map(|(&d, _)| d));
    page.folded("Fractions of a pixel", |page| {
        page.plot(
            &fractions,
            "How often matched disparities have each fraction. Whole pixels that stand out (pixel locking) betray a poor fit \
             between pixels, unless the scene is of few planes that face the cameras.",
        );
    });
    if let (Some(depth), Some(geometry)) = (depth, geometry) {
        page.section("Depth").figure(colored(
            depth.view(),
            &MapStyle::depth(""),
            Width::Full,
            "Depth in the unit of the baseline: near blue, far red, unknown gray.",
        )?);
        page.section("Cloud");
        turning(&mut page, &scene(cloud, geometry, (width, height)), "The depth map in space, and the two cameras.")?;
    } else {
        page.note(Note::Info, "No depth: the focal length and the baseline were not given.");
    }
    page.section("Time").times(stages);
    Ok(page)
}

/// The cloud of a depth map with both cameras, and where each photograph of `width × height` pixels shows the points.
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

/// How the fractions of disparities are spread.
pub(crate) fn fractions(disparities: impl Iterator<Item = f32>) -> Plot {
    let values: Vec<f64> = disparities.filter(|d| d.is_finite()).map(|d| f64::from(d) - f64::from(d).floor()).collect();
    Plot::new("Fractions of disparities", "fraction of a pixel", "pixels").histogram_within("", &values, 20, (0.0, 1.0))
}
