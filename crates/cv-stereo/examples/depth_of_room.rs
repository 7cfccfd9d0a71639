//! Depth and a point cloud from a rectified pair, against the truth.
use cv_core::{Camera, Silent};
use cv_stereo::{StereoGeometry, StereoMatcher, StereoOptions, evaluate_disparity};
use cv_synth::{RenderOptions, Scene, stereo_pair};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (scene, camera) = (Scene::room(4), Camera::from_focal(320, 240, 280.0));
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default())?;

    let mut matcher = StereoMatcher::new(StereoOptions { disparities: 64, ..StereoOptions::default() })?;
    let map = matcher.compute(pair.left.image.view(), pair.right.image.view(), &Silent)?;
    let scores = evaluate_disparity(map.disparity.view(), pair.disparity.view(), Some(pair.visible.view()))?;
    println!("median error {:.2} px, {:.1} % off by more than 2 px", scores.a50, 100.0 * scores.bad[2]);

    let geometry = StereoGeometry::from_focal(320, 240, camera.fx, pair.baseline)?;
    let depth = geometry.depth_map(map.disparity.view(), (0.1, 50.0));
    println!("{} points in space", geometry.cloud(depth.view(), pair.left.image.view()).len());
    Ok(())
}
