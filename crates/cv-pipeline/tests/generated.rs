//! Every pipeline on generated scenes, against exact truth, over several seeds.
//!
//! The bars are those of the project, for a 640×480 camera with the default lens blur and noise. They hold for every
//! seed here, with none left out; the seeds were not chosen by their results.

use cv_core::Camera;
use cv_geometry::{RobustOptions, estimate_homography};
use cv_pipeline::{MatchingOptions, Silent, match_photos};
use cv_synth::{RenderOptions, homography_corner_error, homography_pair};

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
