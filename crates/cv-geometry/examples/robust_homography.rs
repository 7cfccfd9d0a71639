//! The homography between two images of a plane, from matches with an outlier ratio of a third: `cargo run -p
//! cv-geometry --example robust_homography`.

use cv_core::{Correspondence, Matrix3, Point2, Silent};
use cv_geometry::{RobustOptions, estimate_homography};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let truth = Matrix3::new(0.9, -0.1, 40.0, 0.12, 1.05, -15.0, 1e-4, -5e-5, 1.0);
    let matches: Vec<Correspondence> = (0..90)
        .map(|i| {
            let a = Point2::new(f64::from(i * 37 % 640), f64::from(i * 53 % 480));
            let exact = Point2::from_homogeneous(truth * a.to_homogeneous()).unwrap_or(a);
            // Every third match is an outlier.
            let b = if i % 3 == 0 { Point2::new(f64::from(i * 71 % 640), f64::from(i * 29 % 480)) } else { exact };
            Correspondence { a, b }
        })
        .collect();
    let found = estimate_homography(&matches, &RobustOptions::homography(), &Silent)?;
    println!("{} of {} matches are inliers, RMS {:.3} px, of", found.inliers.len(), matches.len(), found.rms);
    println!("{:.5}", found.model);
    if (found.model - truth).norm() < 1e-3 { Ok(()) } else { Err("the homography is wrong".into()) }
}
