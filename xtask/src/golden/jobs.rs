//! The pipelines on their fixtures.
//!
//! Targets against the ground truth are those of the pipelines on generated scenes; a comment gives the reason for a wider one. The
//! images have an eighth of a photograph's width, so a given angular error is fewer pixels. Tolerances against the golden figures
//! cover differences between machines: math libraries and fused multiply-adds differ in the last bits, which can change
//! single matches and pixels.

use super::{Figure, Job, Outcome};
use crate::real::Check;
use anyhow::{Context, Result, ensure};
use cv_core::{Camera, Mask, Matrix3, Point2, RgbU8, Vector3};
use cv_pipeline::stereo::{StereoGeometry, StereoOptions};
use cv_pipeline::{
    DepthOptions, Intrinsics, MatchingOptions, ModelKind, PanoramaOptions, PanoramaPhoto, ReconstructOptions, Silent,
    depth, estimate, match_photos, panorama, reconstruct, segment, train_segment,
};
use cv_synth::{MaskScore, depth_score, direction_error, homography_corner_error, rotation_error};
use nalgebra::Rotation3;
use serde_json::Value;
use std::path::Path;

pub(super) const JOBS: &[Job] =
    &[("depth", stereo), ("plane", plane), ("panorama", views), ("reconstruct", two_views), ("segment", ball)];

fn read_image(fixtures: &Path, name: &str) -> Result<RgbU8> {
    Ok(cv_io::read_rgb(fixtures.join(name))?)
}

fn read_truth(fixtures: &Path, name: &str) -> Result<Value> {
    let path = fixtures.join("oracle").join(name);
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    Ok(serde_json::from_str(&text)?)
}

fn number(value: &Value, key: &str) -> Result<f64> {
    value[key].as_f64().with_context(|| format!("no number {key}"))
}

fn matrix(value: &Value) -> Result<Matrix3<f64>> {
    let entries: Vec<f64> =
        value.as_array().into_iter().flatten().flat_map(Value::as_array).flatten().flat_map(Value::as_f64).collect();
    ensure!(entries.len() == 9, "not a 3×3 matrix: {value}");
    Ok(Matrix3::from_row_slice(&entries))
}

fn stereo(fixtures: &Path) -> Result<Outcome> {
    let (left, right) = (read_image(fixtures, "stereo/left.jpg")?, read_image(fixtures, "stereo/right.jpg")?);
    let known = read_truth(fixtures, "stereo.json")?;
    let (focal, baseline) = (number(&known, "focal_px")?, number(&known, "baseline_m")?);
    let geometry = StereoGeometry::from_focal(left.width(), left.height(), focal, baseline)?;
    let options =
        DepthOptions { stereo: StereoOptions { disparities: 64, ..Default::default() }, ..Default::default() };
    let result = depth(left.view(), right.view(), Some(&geometry), &options, &Silent)?;
    let true_disparity = cv_io::kitti::read(fixtures.join("oracle/stereo-disparity.png"))?;
    let visible = cv_io::read_mask(fixtures.join("oracle/stereo-visible.png"))?;
    let true_depth = geometry.depth_map(true_disparity.view(), (0.0, f32::INFINITY));
    let estimated = result.depth.context("no depth")?;
    let score = depth_score(&estimated, &true_depth, &visible, 10.0, 0.05).context("nothing to score")?;
    let disparities: Vec<f64> =
        result.map.disparity.pixels().map(|[d]| f64::from(d)).filter(|d| d.is_finite()).collect();
    let mean = disparities.iter().sum::<f64>() / disparities.len() as f64;
    Ok(Outcome {
        checks: vec![Check::at_least("fraction of visible pixels within 5 % of the true depth", score.within, 0.95)],
        figures: vec![
            Figure { name: "within", value: score.within, tolerance: 0.002 },
            Figure { name: "valid_fraction", value: result.map.valid_fraction(), tolerance: 0.002 },
            Figure { name: "mean_disparity_px", value: mean, tolerance: 0.01 },
        ],
    })
}

fn plane(fixtures: &Path) -> Result<Outcome> {
    let (a, b) = (read_image(fixtures, "plane/a.jpg")?, read_image(fixtures, "plane/b.jpg")?);
    let known = matrix(&read_truth(fixtures, "plane.json")?["homography"])?;
    let found = match_photos(a.view(), b.view(), &MatchingOptions::default(), &Silent)?;
    let kind = ModelKind::Homography;
    let model = estimate(&found.pairs(), kind, &kind.options(), &Silent)?.robust;
    let error = homography_corner_error(&model.model, &known, a.width(), a.height());
    Ok(Outcome {
        checks: vec![Check::at_most("corner error, px", error, 0.3)],
        figures: vec![
            Figure { name: "corner_error_px", value: error, tolerance: 0.02 },
            Figure { name: "matches", value: found.matches.len() as f64, tolerance: 3.0 },
            Figure { name: "inliers", value: model.inliers.len() as f64, tolerance: 3.0 },
        ],
    })
}

fn views(fixtures: &Path) -> Result<Outcome> {
    let images: Vec<RgbU8> =
        (0..3).map(|i| read_image(fixtures, &format!("panorama/view{i}.jpg"))).collect::<Result<_>>()?;
    let known = read_truth(fixtures, "panorama.json")?;
    let photos: Vec<PanoramaPhoto<'_>> = images.iter().map(|p| PanoramaPhoto::new(p.view())).collect();
    let result = panorama(&photos, &PanoramaOptions::default(), &Silent)?;
    let used = result.images.iter().filter(|image| image.used).count();
    let mut worst = 0.0f64;
    for (pair, homography) in known["homographies"].as_array().into_iter().flatten().enumerate() {
        let homography = matrix(homography)?;
        let view =
            |i: usize| result.alignment.views[i].as_ref().ok().with_context(|| format!("view {i} is not placed"));
        let (from, to) = (view(pair)?, view(pair + 1)?);
        let through = |p: Point2<f64>| to.project(&from.ray(p)?);
        // The views are at most 120° apart, so no pixel of one is behind another.
        let there = |p: Point2<f64>| {
            let q = homography * nalgebra::Vector3::new(p.x, p.y, 1.0);
            Some(Point2::new(q.x / q.z, q.y / q.z))
        };
        let error = cv_synth::alignment_error(through, there, images[0].width(), images[0].height());
        worst = worst.max(error.context("the views do not overlap")?);
    }
    let focal = result.images[1].focal.unwrap_or(f64::NAN);
    Ok(Outcome {
        checks: vec![
            Check::at_least("photographs used", used as f64, 3.0),
            Check::at_most("alignment error of neighbors, px", worst, 0.5),
            Check::at_most(
                "error of the focal length, %",
                100.0 * (focal / number(&known, "focal_px")? - 1.0).abs(),
                3.0,
            ),
        ],
        figures: vec![
            Figure { name: "alignment_error_px", value: worst, tolerance: 0.05 },
            Figure { name: "focal_px", value: focal, tolerance: 1.0 },
            Figure { name: "width", value: result.image.width() as f64, tolerance: 4.0 },
            Figure { name: "height", value: result.image.height() as f64, tolerance: 4.0 },
        ],
    })
}

fn two_views(fixtures: &Path) -> Result<Outcome> {
    let (a, b) = (read_image(fixtures, "two-view/a.jpg")?, read_image(fixtures, "two-view/b.jpg")?);
    let known = read_truth(fixtures, "two-view.json")?;
    let camera = Camera::from_focal(a.width(), a.height(), number(&known, "focal_px")?);
    let options = ReconstructOptions::new(Intrinsics::Known([camera; 2]));
    let found = reconstruct(a.view(), b.view(), &options, &Silent)?;
    let rotation = Rotation3::from_matrix_unchecked(matrix(&known["rotation"])?);
    let translation: Vec<f64> =
        known["translation_m"].as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
    ensure!(translation.len() == 3, "no translation");
    let rotation_error_deg = rotation_error(&found.scene.pose.rotation, &rotation).to_degrees();
    let direction_error_deg =
        direction_error(&found.scene.pose.translation, &Vector3::from_column_slice(&translation)).to_degrees();
    Ok(Outcome {
        checks: vec![
            Check::at_most("error of the rotation, degrees", rotation_error_deg, 0.2),
            Check::at_most("error of the translation direction, degrees", direction_error_deg, 1.0),
        ],
        figures: vec![
            Figure { name: "rotation_error_deg", value: rotation_error_deg, tolerance: 0.01 },
            Figure { name: "direction_error_deg", value: direction_error_deg, tolerance: 0.1 },
            Figure { name: "points", value: found.scene.points.len() as f64, tolerance: 10.0 },
            Figure { name: "reprojection_rms_px", value: found.scene.reprojection_rms, tolerance: 0.02 },
        ],
    })
}

fn ball(fixtures: &Path) -> Result<Outcome> {
    let photos: Vec<(RgbU8, Mask)> = (0..8)
        .map(|i| {
            let mask = cv_io::read_mask(fixtures.join(format!("oracle/ball-masks/ball{i}_mask.png")))?;
            Ok((read_image(fixtures, &format!("ball/ball{i}.jpg"))?, mask))
        })
        .collect::<Result<_>>()?;
    let half: Vec<_> = photos.iter().step_by(2).map(|(photo, mask)| (photo.view(), mask.view())).collect();
    let model = train_segment(&half, &Default::default(), &Silent)?.trained.model;
    let score = photos
        .iter()
        .skip(1)
        .step_by(2)
        .map(|(photo, mask)| {
            MaskScore::new(&segment(photo.view(), &model, &Silent)?.mask, mask).context("sizes differ")
        })
        .try_fold(MaskScore::default(), |sum, score| score.map(|s| sum.plus(s)))?;
    Ok(Outcome {
        checks: vec![Check::at_least("F1", score.f1(), 0.97)],
        figures: vec![
            Figure { name: "precision", value: score.precision(), tolerance: 0.01 },
            Figure { name: "recall", value: score.recall(), tolerance: 0.01 },
        ],
    })
}
