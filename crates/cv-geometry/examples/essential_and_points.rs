//! Relative pose and triangulated points of two calibrated views, from matches in pixels: `cargo run -p cv-geometry
//! --example essential_and_points`.

use cv_core::{Camera, Correspondence, Point3, Pose, Rotation3, Silent, Vector3};
use cv_geometry::{RobustOptions, estimate_relative_pose, normalize_matches, triangulate};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let camera = Camera::from_focal(640, 480, 500.0);
    let truth = Pose::new(Rotation3::new(Vector3::new(0.02, 0.1, 0.0)), Vector3::new(-0.8, 0.0, 0.6));
    let point = |i: i32| {
        Point3::new(f64::from(i * 7 % 11 - 5) * 0.4, f64::from(i * 5 % 9 - 4) * 0.4, 5.0 + f64::from(i % 13) * 0.3)
    };
    let project = |i: i32| {
        let p = point(i);
        Some(Correspondence { a: camera.project(&p)?, b: camera.project(&truth.transform(&p))? })
    };
    let matches: Vec<Correspondence> = (0..80).filter_map(project).collect();

    let (normalized, unit) = normalize_matches(&matches, &camera, &camera);
    let options = RobustOptions { threshold: unit, ..RobustOptions::essential() };
    let found = estimate_relative_pose(&normalized, &options, &Silent)?;
    println!("{} inliers, direction of the translation {:.3}", found.inliers.len(), found.model.translation);
    let first = triangulate(&normalized[0], &found.model)?;
    println!("the first point is at {first:.3}, in units of the baseline");
    if (first - point(0)).norm() < 1e-3 { Ok(()) } else { Err("the triangulated point is wrong".into()) }
}
