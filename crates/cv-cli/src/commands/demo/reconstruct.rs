//! Two-view reconstruction of a room.

use super::{Check, Demo, Part};
use crate::commands::reconstruct::sparse;
use crate::frame::Failure;
use crate::pictures::still;
use cv_core::Pose;
use cv_pipeline::{Intrinsics, ReconstructOptions, reconstruct};
use cv_report::{MatchStyle, draw_epipolar_lines, draw_matches};
use cv_synth::{RenderOptions, direction_error, rotation_error, two_view};

/// Distance between the two camera centers in meters.
const BASELINE: f64 = 0.6;

pub(super) fn run(demo: &Demo<'_>) -> Result<Part, Failure> {
    let camera = demo.camera();
    let pair = two_view(demo.seed, &camera, BASELINE, &RenderOptions::default())?;
    let (a, b) = (&pair.a.image, &pair.b.image);
    for (name, photo) in [("reconstruct-a.png", a), ("reconstruct-b.png", b)] {
        cv_io::write_png(demo.out.join(name), photo.view())?;
    }
    let options = ReconstructOptions::new(Intrinsics::Known([camera; 2]));
    let result = match reconstruct(a.view(), b.view(), &options, demo.context) {
        Ok(result) => result,
        Err(error) => return Ok(Part::failed("reconstruct", &error)),
    };
    let (truth, found) = (&pair.relative, &result.scene.pose);
    let angle = |pose: &Pose| format!("{:.2}°", pose.rotation_angle().to_degrees());
    let unit_translation = |pose: &Pose| {
        let t = pose.translation.normalize();
        format!("({:.3}, {:.3}, {:.3})", t.x, t.y, t.z)
    };
    let rotation = rotation_error(&found.rotation, &truth.rotation).to_degrees();
    let direction = direction_error(&found.translation, &truth.translation).to_degrees();
    let checks = vec![
        Check::at_most("reconstruct", "rotation", rotation, 0.2, "°").of(angle(truth), angle(found)),
        Check::at_most("reconstruct", "direction of translation", direction, 1.0, "°")
            .of(unit_translation(truth), unit_translation(found)),
    ];

    let pairs = &result.matching.pairs();
    let mut inliers = vec![false; pairs.len()];
    result.scene.inliers.iter().for_each(|&i| inliers[i] = true);
    let style = MatchStyle { limit: 160, ..MatchStyle::default() };
    let agree =
        format!("{} of {} matches are inliers of the relative pose (green).", result.scene.inliers.len(), pairs.len());
    let figures = vec![
        demo.figure(
            "reconstruct-matches.png",
            &draw_matches(a.view(), b.view(), pairs, Some(&inliers), &style),
            &agree,
        )?,
        demo.figure(
            "reconstruct-epipolar.png",
            &draw_epipolar_lines(
                a.view(),
                b.view(),
                &result.scene.fundamental(),
                &result.scene.inliers.iter().map(|&i| pairs[i]).collect::<Vec<_>>(),
                14,
            ),
            "Points and their epipolar lines in the other image.",
        )?,
    ];
    let cloud = sparse(&result, ["first", "second"]);
    let still = still(&cloud)?;
    let caption = format!("{} points and the two cameras. Drag to rotate.", result.scene.points.len());
    Ok(Part::new(checks, move |page| {
        page.section("Reconstruction")
            .paragraph("Two photographs with a baseline of 60 cm. The matches determine the rotation and the direction of translation of the camera, and the 3D points.");
        figures.into_iter().for_each(|figure| {
            page.figure(figure);
        });
        page.points(&cloud, Some(still), &caption);
    }))
}
