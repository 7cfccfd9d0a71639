//! Depth of a rectified pair: disparities, depths, and points.

use cv_core::Camera;
use cv_pipeline::stereo::{StereoGeometry, StereoOptions};
use cv_pipeline::{DepthOptions, Silent, depth};
use cv_synth::{RenderOptions, Scene, stereo_pair};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    // Two cameras of 280 px focal length, 25 cm apart, in a room.
    let (scene, camera) = (Scene::room(1), Camera::from_focal(320, 240, 280.0));
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default())?;
    let (left, right) = (pair.left.image.view(), pair.right.image.view());

    let geometry = StereoGeometry::from_focal(320, 240, 280.0, 0.25)?;
    let stereo = StereoOptions { disparities: 64, ..StereoOptions::default() };
    let options = DepthOptions { stereo, ..DepthOptions::default() };
    let result = depth(left, right, Some(&geometry), &options, &Silent)?;

    println!("{:.0} % matched", 100.0 * result.map.matched_fraction());
    let cloud = result.cloud(left).ok_or("there is a geometry")?;
    println!("{} points, the first at {:?} m", cloud.len(), cloud.positions.first());
    Ok(())
}
