//! Depth from images of 16 bits.

use cv_core::{Camera, Image, Pose, Rotation3, Silent, StereoRig, Vector3};
use cv_pipeline::{DepthOptions, depth_by_rig};
use cv_stereo::{PixelState, Rectification, RectifyOptions, StereoOptions};
use cv_synth::{RenderOptions, Scene, render};

#[test]
fn sixteen_bit_images_with_a_constant_upper_byte_are_matched() {
    let scene = Scene::room(2);
    let camera = Camera::from_focal(320, 240, 260.0);
    let relative = Pose::new(Rotation3::from_euler_angles(0.02, -0.03, 0.015), Vector3::new(-0.2, 0.01, 0.004));
    let first = scene.viewpoint();
    let photo = |pose: &Pose| render(&scene, &camera, pose, &RenderOptions::draft()).unwrap().image;
    let photos = [photo(&first), photo(&relative.compose(&first))];
    let rig = StereoRig { left: camera, right: camera, right_from_left: relative };
    let rectification = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
    let stereo = StereoOptions { disparities: 64, ..StereoOptions::default() };
    let options = DepthOptions { stereo, ..DepthOptions::default() };
    let bytes = depth_by_rig(photos[0].view(), photos[1].view(), &rectification, &options, &Silent).unwrap();
    let low: Vec<Image<u16, 3>> = photos.iter().map(|p| p.map(|c| c.map(|v| 0x4e00 + u16::from(v)))).collect();
    let deep = depth_by_rig(low[0].view(), low[1].view(), &rectification, &options, &Silent).unwrap();
    // As 8-bit images they are uniform: at most two neighboring values.
    assert!(deep.images[0].as_slice().iter().all(|v| (78..=79).contains(v)));
    // The census transform is independent of contrast; only terms that depend on the height of edges (penalties,
    // smoothing) change. Rectified pairs are accurate to half a pixel.
    let (a, b) = (&bytes.maps.map, &deep.maps.map);
    let states = a.state.as_slice().iter().zip(b.state.as_slice());
    let both_matched: Vec<bool> = states.map(|(a, b)| *a == PixelState::Matched && *b == PixelState::Matched).collect();
    let pairs = a.disparity.as_slice().iter().zip(b.disparity.as_slice()).zip(&both_matched);
    let count = both_matched.iter().filter(|k| **k).count();
    let similar = pairs.filter(|((a, b), both_matched)| **both_matched && (**a - **b).abs() < 0.5).count();
    assert!(b.matched_fraction() > 0.5 && similar * 10 > count * 9, "{} {similar} of {count}", b.matched_fraction());
    assert!(deep.cloud.len() > 40_000 && deep.maps.stages[0].0 == "rectify");
}
