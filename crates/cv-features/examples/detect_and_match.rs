//! Detects SIFT features in two images and matches them: `cargo run -p cv-features --example detect_and_match`.

use cv_core::{GrayF32, Silent};
use cv_features::{MatchOptions, SiftOptions, match_descriptors, sift};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    // Gaussian blobs, and the same blobs shifted by (6, 4) pixels.
    let scene = |dx: f32, dy: f32| {
        let blobs =
            (0..60).map(|i| ((i * 73 % 190) as f32, (i * 41 % 150) as f32, (i % 3 + 2) as f32, (i % 5 + 1) as f32));
        let blobs: Vec<_> = blobs.collect();
        GrayF32::from_fn(200, 160, |x, y| {
            let distance = |s: &(f32, f32, f32, f32)| (x as f32 - dx - s.0).powi(2) + (y as f32 - dy - s.1).powi(2);
            [blobs.iter().map(|s| 0.15 * s.3 * (-distance(s) / (2.0 * s.2 * s.2)).exp()).sum::<f32>().min(1.0)]
        })
    };
    let options = SiftOptions { max_features: 500, ..SiftOptions::default() };
    let a = sift(scene(0.0, 0.0).view(), &options, &Silent)?;
    let b = sift(scene(6.0, 4.0).view(), &options, &Silent)?;
    let mutual = MatchOptions { mutual: true, ..MatchOptions::default() };
    let matches = match_descriptors(&a.descriptors, &b.descriptors, &mutual, &Silent)?;
    for m in matches.iter().take(5) {
        let (p, q) = (a.keypoints[m.query as usize].position, b.keypoints[m.train as usize].position);
        println!("({:.1}, {:.1}) -> ({:.1}, {:.1}), ratio {:.2}", p.x, p.y, q.x, q.y, m.ratio);
    }
    println!("{} matches between {} and {} features", matches.len(), a.keypoints.len(), b.keypoints.len());
    if matches.is_empty() { Err("no matches".into()) } else { Ok(()) }
}
