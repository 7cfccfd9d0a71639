//! Two-view reconstruction from keypoints and matches by index: `cargo run -p cv-geometry --example
//! two_views_by_index`.

use cv_core::{Camera, DMatch, Keypoint, Point3, Pose, Rotation3, Silent, Vector3};
use cv_geometry::{Intrinsics, MatchedViews, TwoViewOptions, reconstruct_two_views};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let camera = Camera::from_focal(640, 480, 500.0);
    let truth = Pose::new(Rotation3::new(Vector3::new(0.02, 0.1, 0.0)), Vector3::new(-0.8, 0.0, 0.6));
    let (mut keypoints, mut matches) = ([Vec::new(), Vec::new()], Vec::new());
    for i in 0..120 {
        let (x, y, z) = (f64::from(i * 7 % 29 - 14), f64::from(i * 5 % 23 - 11), f64::from(i * 11 % 17));
        let p = Point3::new(0.15 * x, 0.15 * y, 5.0 + 0.25 * z);
        let (Some(a), Some(b)) = (camera.project(&p), camera.project(&truth.transform(&p))) else { continue };
        matches.push(DMatch { query: matches.len() as u32, train: matches.len() as u32, distance: 0.0, ratio: 0.5 });
        keypoints[0].push(Keypoint::new(a.x as f32, a.y as f32, 1.0));
        keypoints[1].push(Keypoint::new(b.x as f32, b.y as f32, 1.0));
    }
    let views = MatchedViews { sizes: [(640, 480); 2], keypoints: [&keypoints[0], &keypoints[1]], matches: &matches };
    let options = TwoViewOptions { intrinsics: Intrinsics::Known([camera; 2]), ..TwoViewOptions::default() };
    let found = reconstruct_two_views(&views, &options, &Silent)?;
    for point in found.points.iter().take(3) {
        let m = found.matches[point.match_index];
        println!("keypoints {} and {}: point {:.3}", m.query, m.train, point.position);
    }
    if found.points.len() > 100 { Ok(()) } else { Err("points are missing".into()) }
}
