//! Whether points of generated scenes are as far off as their covariances say, and how many matches along epipolar lines are wrong.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::Camera;
use cv_pipeline::{Intrinsics, ReconstructOptions, Silent, reconstruct};
use cv_synth::{RenderOptions, two_view};

#[test]
fn depths_are_off_by_what_the_covariances_say_and_few_matches_are_wrong() {
    let camera = Camera::from_focal(640, 480, 560.0);
    let (mut within, mut count) = (0.0, 0.0);
    let (mut wrong, mut all, mut kept_wrong, mut kept) = (0.0, 0.0, 0.0, 0.0);
    for seed in 0..4 {
        let views = two_view(seed, &camera, 0.4, &RenderOptions::default()).unwrap();
        let scale = views.relative.translation.norm();
        for guided in [false, true] {
            let options = ReconstructOptions { guided, ..ReconstructOptions::new(Intrinsics::Known([camera; 2])) };
            let result = reconstruct(views.a.image.view(), views.b.image.view(), &options, &Silent).unwrap();
            let (mut w, mut n, mut bad) = (0.0, 0.0, 0.0);
            for p in &result.scene.points {
                // Where the surface is on the ray to the point, and where the second camera sees it.
                let pixel = camera.project(&p.position).unwrap();
                let Some(truth) = views.scene.point_at(&camera, &views.a.pose, pixel) else { continue };
                let at = camera.project(&views.b.pose.transform(&truth));
                // Farther off than three pixels is no noise of the position: it is another thing.
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
    // 95 % would be within 1.96 standard deviations, had each position an error of its own that is normal; those of two features of one edge go together, and
    // matches up to three pixels off are counted among the right ones.
    assert!((0.88..0.975).contains(&share), "{share}");
    // Features on outlines belong to the thing before and the ground behind: a few in a hundred are matched by the one and lie on the other. Along epipolar lines
    // there is less to tell a wrong partner by: a quarter of what they add may be such, and they add an eighth.
    assert!(wrong / all < 0.04 && kept_wrong / kept < 0.06, "{} {}", wrong / all, kept_wrong / kept);
    assert!(kept - kept_wrong > 1.08 * (all - wrong), "matches along lines add points");
}
