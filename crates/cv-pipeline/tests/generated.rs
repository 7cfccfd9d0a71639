//! Every pipeline on generated scenes, against exact truth, over several seeds.
//!
//! The bars are those of the project, for a 640×480 camera with the default lens blur and noise. They hold for every
//! seed here, with none left out; the seeds were not chosen by their results.

use cv_core::Camera;
use cv_geometry::{RobustOptions, estimate_homography};
use cv_pipeline::{DepthOptions, MatchingOptions, Silent, depth, match_photos};
use cv_stereo::{StereoGeometry, StereoOptions};
use cv_synth::{RenderOptions, Scene, depth_score, homography_corner_error, homography_pair, stereo_pair};

const SEEDS: std::ops::Range<u64> = 0..6;

fn camera() -> Camera {
    Camera::from_focal(640, 480, 520.0)
}

#[test]
fn a_homographys_corners_are_within_three_tenths_of_a_pixel() {
    for seed in SEEDS {
        let pair = homography_pair(seed, &camera(), 0.3, &RenderOptions::default()).unwrap();
        let options = MatchingOptions::default();
        let found = match_photos(pair.a.image.view(), pair.b.image.view(), &options, &Silent).unwrap();
        let model = estimate_homography(&found.pairs, &RobustOptions::homography()).unwrap();
        let error = homography_corner_error(&model.model, &pair.homography, 640, 480);
        println!("seed {seed}: {} matches, {} inliers, {error:.3} px", found.pairs.len(), model.inliers.len());
        assert!(error <= 0.3, "seed {seed}: {error} px");
    }
}

#[test]
fn depth_is_within_five_percent_nearly_everywhere() {
    for seed in SEEDS {
        // A room with a baseline of 20 cm, a table with one of 6 cm, so that both have about 50 px of disparity.
        for (name, scene, baseline) in [("room", Scene::room(seed), 0.2), ("table", Scene::tabletop(seed), 0.06)] {
            let camera = camera();
            let pose = scene.viewpoint();
            let pair = stereo_pair(&scene, &camera, &pose, baseline, &RenderOptions::default()).unwrap();
            let geometry = StereoGeometry::from_focal(camera.width, camera.height, camera.fx, baseline).unwrap();
            let stereo = StereoOptions { disparities: 96, ..StereoOptions::default() };
            let options = DepthOptions { stereo, ..DepthOptions::default() };
            let (left, right) = (pair.left.image.view(), pair.right.image.view());
            let found = depth(left, right, Some(&geometry), &options, &Silent).unwrap();
            let score = depth_score(&found.depth.unwrap(), &pair.left.depth, &pair.visible, 10.0, 0.05).unwrap();
            println!("{name} {seed}: {:.2} % within, {:.2} % dense", 100.0 * score.within, 100.0 * score.dense);
            // Less than 280,000 of 307,200 would mean that the scene was not the one meant.
            assert!(score.within >= 0.95 && score.pixels > 280_000, "{name} {seed}: {score:?}");
        }
    }
}
