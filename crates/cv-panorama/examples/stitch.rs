//! Stitches two overlapping images from given matches.

use cv_core::{Correspondence, RgbU8, Silent};
use cv_panorama::{AlignOptions, CameraMotion, CompositingOptions, Photo, VerifyOptions, align, render, verify_pair};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    // Two crops of one image, 200 pixels apart; a matcher would return such matches.
    let scene = |x: usize, y: usize| [(x / 2 % 256) as u8, (y * 3 % 256) as u8, (x * y / 40 % 256) as u8];
    let left = RgbU8::from_fn(400, 300, scene);
    let right = RgbU8::from_fn(400, 300, |x, y| scene(x + 200, y));
    let points = (0..80).map(|i| (205.0 + f64::from(i % 10) * 19.0, 10.0 + f64::from(i / 10) * 40.0));
    let matches: Vec<_> = points.map(|(x, y)| Correspondence::new(x, y, x - 200.0, y)).collect();

    let pair = verify_pair((0, left.size()), (1, right.size()), &matches, &VerifyOptions::default())?;
    // The camera is translated along a plane; `CameraMotion::Auto` detects this for photographs.
    let options = AlignOptions { motion: CameraMotion::Homography, ..AlignOptions::default() };
    let alignment = align(&[Photo::new(400, 300); 2], &[pair], &options, &Silent)?;
    let panorama = render(&[left.view(), right.view()], &alignment, &CompositingOptions::default(), &Silent)?;
    println!("{:?}, matches agree to {:.3} px", panorama.image.size(), alignment.rms_px);
    assert!(panorama.image.width().abs_diff(600) <= 1);
    Ok(())
}
