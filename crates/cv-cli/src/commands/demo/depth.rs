//! Depth of a room from a rectified pair.

use super::{Check, Demo, Part};
use crate::commands::depth::scene as scene_of;
use crate::frame::Failure;
use crate::pictures::still;
use cv_core::{GrayF32, Mask, RgbU8};
use cv_pipeline::stereo::{StereoGeometry, StereoOptions};
use cv_pipeline::{DepthOptions, depth};
use cv_report::{MapStyle, colors};
use cv_synth::{RenderOptions, Scene, depth_score, stereo_pair};

/// Meters between the two cameras.
const BASELINE: f64 = 0.2;
/// Relative depth error at which a pixel counts as correct.
const TOLERANCE: f32 = 0.05;
/// Largest true depth that is scored, in meters.
const MAX_DEPTH: f32 = 10.0;

pub(super) fn run(demo: &Demo<'_>) -> Result<Part, Failure> {
    let scene = Scene::room(demo.seed);
    let camera = demo.camera();
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), BASELINE, &RenderOptions::default())?;
    let geometry = StereoGeometry::from_focal(camera.width, camera.height, camera.fx, BASELINE)?;
    let options = DepthOptions {
        stereo: StereoOptions { disparities: 96, ..StereoOptions::default() },
        ..DepthOptions::default()
    };
    let (left, right) = (&pair.left.image, &pair.right.image);
    let result = match depth(left.view(), right.view(), Some(&geometry), &options, demo.context) {
        Ok(result) => result,
        Err(error) => return Ok(Part::failed("depth", &error)),
    };
    let unknown = || GrayF32::new(camera.width, camera.height, [f32::NAN]);
    let found = result.depth.unwrap_or_else(unknown);
    let truth = &pair.left.depth;
    let fraction = depth_score(&found, truth, &pair.visible, MAX_DEPTH, TOLERANCE).map_or(0.0, |s| s.within);
    let check = Check::at_least("depth", "pixels within 5 % of the true depth", fraction, 0.95, "%")
        .of(format!("median {:.3} m", median(truth, &pair.visible)), format!("{:.3} m", median(&found, &pair.visible)));

    let range = (0.0, MAX_DEPTH);
    let style = MapStyle::depth("m").with_range(range.0, range.1);
    let photos = vec![
        demo.figure("depth-left.png", left, "Left photograph.")?,
        demo.figure("depth-right.png", right, "Right photograph, 20 cm to the right.")?,
    ];
    let maps = vec![
        demo.map("depth-result.png", &found, &style, "Estimated depth: near blue, far red.")?,
        demo.map("depth-truth.png", truth, &style, "True depth.")?,
        demo.figure(
            "depth-errors.png",
            &errors(left, &found, truth, &pair.visible),
            "Red: error above 5 %. Blue: visible to one camera only, where stereo matching is impossible.",
        )?,
    ];
    let cloud = scene_of(&geometry.cloud(found.view(), left.view()), &geometry, found.size());
    let still = still(&cloud)?;
    Ok(Part::new(vec![check], move |page| {
        page.section("Depth")
            .paragraph("A room seen by two cameras side by side. Semi-global matching estimates the disparity of each pixel, and from it the depth.")
            .figures(photos)
            .figures(maps)
            .points(&cloud, Some(still), "The depth map as a point cloud. Drag to rotate.");
    }))
}

/// Computes the median depth of the pixels that are visible to both cameras.
fn median(depth: &GrayF32, visible: &Mask) -> f32 {
    let mut values: Vec<f32> = depth
        .as_slice()
        .iter()
        .zip(visible.as_slice())
        .filter(|(d, v)| **v && d.is_finite())
        .map(|(d, _)| *d)
        .collect();
    let middle = values.len() / 2;
    values.sort_by(f32::total_cmp);
    values.get(middle).copied().unwrap_or(f32::NAN)
}

/// Draws wrong pixels in red and occluded ones in blue over the darkened image.
fn errors(photo: &RgbU8, found: &GrayF32, truth: &GrayF32, visible: &Mask) -> RgbU8 {
    RgbU8::from_fn(photo.width(), photo.height(), |x, y| {
        let ([f], [t]) = (found.at(x, y), truth.at(x, y));
        let gray = photo.at(x, y).map(|c| u32::from(c) * 2 / 5);
        let gray = [(gray.iter().sum::<u32>() / 3 + 20) as u8; 3];
        match visible.at(x, y)[0] {
            false => [30, 60, 130],
            true if (f - t).abs() <= TOLERANCE * t || t >= MAX_DEPTH => gray,
            true => colors::RED,
        }
    })
}
