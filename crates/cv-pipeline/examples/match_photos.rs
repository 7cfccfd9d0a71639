//! Feature matches of two images, and the homography of most of them.

use cv_core::Camera;
use cv_pipeline::{MatchingOptions, ModelKind, Silent, estimate, match_photos};
use cv_synth::{RenderOptions, homography_pair};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    // A wall of posters from two viewpoints.
    let pair = homography_pair(1, &Camera::from_focal(320, 240, 280.0), 0.4, &RenderOptions::default())?;
    let (a, b) = (pair.a.image.view(), pair.b.image.view());

    let matching = match_photos(a, b, &MatchingOptions::default(), &Silent)?;
    let pairs = matching.pairs();
    let estimated = estimate(&pairs, ModelKind::Homography, &ModelKind::Homography.options(), &Silent)?.robust;

    println!("{} of {} matches agree, to {:.2} px", estimated.inliers.len(), pairs.len(), estimated.rms);
    println!("{:.4}", estimated.model);
    Ok(())
}
