//! Depth from images of a calibrated rig, with rectification. Feature matches determine the range of disparities.

use cv_core::{Camera, Pose, Rotation3, StereoRig, Vector3};
use cv_pipeline::stereo::{Rectification, RectifyOptions};
use cv_pipeline::{DepthOptions, DisparityRange, Silent, depth_by_rig};
use cv_synth::{RenderOptions, Scene, render};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    // The right camera is 20 cm to the right and rotated by a degree or two.
    let rotation = Rotation3::from_euler_angles(0.02, -0.03, 0.015);
    let right_from_left = Pose::new(rotation, Vector3::new(-0.2, 0.01, 0.004));
    let (scene, camera) = (Scene::room(2), Camera::from_focal(320, 240, 260.0));
    let pose = scene.viewpoint();
    let left = render(&scene, &camera, &pose, &RenderOptions::default())?.image;
    let right = render(&scene, &camera, &right_from_left.compose(&pose), &RenderOptions::default())?.image;

    let rig = StereoRig { left: camera, right: camera, right_from_left };
    let rectification = Rectification::new(&rig, &RectifyOptions::default())?;
    let options = DepthOptions { disparities: DisparityRange::Auto { min: None }, ..DepthOptions::default() };
    let result = depth_by_rig(left.view(), right.view(), &rectification, &options, &Silent)?;

    println!("smallest disparity and number of them: {:?}", result.maps.disparities);
    println!("{} points in the left camera's frame", result.cloud.len());
    Ok(())
}
