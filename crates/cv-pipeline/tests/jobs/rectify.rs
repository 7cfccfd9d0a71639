//! Rectification of a generated pair.

use cv_core::{Camera, Distortion, Pose, Rotation3, Silent, StereoRig, Vector3};
use cv_pipeline::rectify;
use cv_stereo::RectifyOptions;
use cv_synth::{RenderOptions, Scene, render};

#[test]
fn rectified_features_of_a_rotated_and_distorted_pair_have_no_vertical_disparity() {
    let scene = Scene::room(2);
    let mut camera = Camera::from_focal(320, 240, 260.0);
    camera.distortion = Distortion::radial(-0.12, 0.02);
    let relative = Pose::new(Rotation3::from_euler_angles(0.02, -0.03, 0.015), Vector3::new(-0.2, 0.01, 0.004));
    let first = scene.viewpoint();
    let options = RenderOptions::draft();
    let a = render(&scene, &camera, &first, &options).unwrap();
    let b = render(&scene, &camera, &relative.compose(&first), &options).unwrap();
    let rig = StereoRig { left: camera, right: camera, right_from_left: relative };
    let result = rectify(a.image.view(), b.image.view(), &rig, &RectifyOptions::default(), &Silent).unwrap();
    let (median, _) = result.vertical_px.unwrap();
    // Features are accurate to a few tenths of a pixel; the unrectified pair is off by five and more.
    assert!(median < 0.4 && result.matches > 30, "{median} px over {}", result.matches);
    assert_eq!(result.fault, None);
    assert!(result.valid_area[0] > 0.999 && result.valid_area[1] > 0.999);
}
