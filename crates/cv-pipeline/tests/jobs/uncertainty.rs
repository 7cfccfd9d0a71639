//! Depth errors of generated scenes against the covariances, and the outlier ratio of guided matches.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::Camera;
use cv_pipeline::{Intrinsics, ReconstructOptions, Silent, reconstruct};
use cv_synth::{RenderOptions, two_view};

#[test]
fn depth_errors_agree_with_the_covariances_and_few_matches_are_wrong() {
    let camera = Camera::from_focal(640, 480, 560.0);
    let (mut within, mut count) = (0.0, 0.0);
    let (mut wrong, mut all, mut kept_wrong, mut kept) = (0.0, 0.0, 0.0, 0.0);
    for seed in 0..4 {
        let views = two_view(seed, &camera, 0.4, &RenderOptions::draft()).unwrap();
        let scale = views.relative.translation.norm();
        for guided in [false, true] {
            let options = ReconstructOptions { guided, ..ReconstructOptions::new(Intrinsics::Known([camera; 2])) };
            let result = reconstruct(views.a.image.view(), views.b.image.view(), &options, &Silent).unwrap();
            let (mut w, mut n, mut bad) = (0.0, 0.0, 0.0);
            for p in &result.scene.points {
                // The surface on the ray to the point, and its projection into the second camera.
                let pixel = camera.project(&p.position).unwrap();
                let Some(truth) = views.scene.point_at(&camera, &views.a.pose, pixel) else { continue };
                let at = camera.project(&views.b.pose.transform(&truth));
                // More than three pixels off is an outlier.
                let miss = at.map_or(f64::INFINITY, |q| (q - result.pair(p).b).norm());
                n += 1.0;
                if miss > 3.0 {
                    bad += 1.0;
                    continue;
                }
                let truth = views.a.pose.transform(&truth).coords / scale;
                let ray = truth.normalize();
                let off = (p.position.coords - truth).dot(&ray);
                let squared = off * off / ray.dot(&(p.covariance * ray));
                w += f64::from(u8::from(squared < 3.841));
            }
            let right = n - bad;
            if guided {
                (kept, kept_wrong) = (kept + n, kept_wrong + bad);
                (within, count) = (within + w, count + right);
            } else {
                (all, wrong) = (all + n, wrong + bad);
            }
        }
    }
    let share = within / count;
    println!(
        "{:.1} % within 1.96 standard deviations; wrong: {:.1} % of {all} matches, {:.1} % of {kept} along lines",
        100.0 * share,
        100.0 * wrong / all,
        100.0 * kept_wrong / kept
    );
    // 95 % would be within 1.96 standard deviations for independent normal errors; those of two features of one edge
    // are correlated, and matches up to three pixels off count as inliers.
    assert!((0.88..0.975).contains(&share), "{share}");
    // Features at object boundaries belong to foreground and background: a few per cent are matched by one and lie on
    // the other. Guided matches have less to reject them by: up to a quarter of the matches they add, which are an
    // eighth of all.
    assert!(wrong / all < 0.04 && kept_wrong / kept < 0.06, "{} {}", wrong / all, kept_wrong / kept);
    assert!(kept - kept_wrong > 1.08 * (all - wrong), "matches along lines add points");
}
